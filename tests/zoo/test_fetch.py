"""Where files come from: folder, cache, network, in this order; over real HTTP."""

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from http_server import Site, serving

from navrep_data import zoo
from navrep_data.errors import ConfigError, CorruptDataError, DownloadError, ModelNotFoundError, OfflineError
from navrep_data.zoo import fetching, registry
from navrep_data.zoo.fetching import Source, get_file, locate, require_here
from navrep_data.zoo.registry import RecordFile

REAL = registry.records()["transformer_rings.released"]
DATA = b"weights" * 99
PATH = "models/W/navreptraingpt"


def entry(data=DATA, by="sha256"):
    blob = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
    if by == "git":
        return RecordFile(PATH, None, None, blob)
    return RecordFile(PATH, len(data), hashlib.sha256(data).hexdigest(), blob)


def record(by="sha256"):
    return replace(REAL, files=(entry(by=by),))


def get(source=None, by="sha256"):
    r = record(by)
    return get_file(r, r.files[0], Source.of(source), progress=False)


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """An empty cache, no variables of the user's, and no way out to the real network."""
    for name in ("NAVREP_DATA_OFFLINE", "HF_HUB_OFFLINE", "NAVREP_RELEASED_DIR", "NAVREP_RELEASED_URL", "HF_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def site(monkeypatch):
    with serving(Site(files={f"/{PATH}": DATA})) as running:
        monkeypatch.setenv("NAVREP_RELEASED_URL", running.url)
        yield running


@pytest.mark.slow
@pytest.mark.parametrize("place", [PATH, "W/navreptraingpt", "navreptraingpt"])
@pytest.mark.parametrize("by", ["sha256", "git"])
@pytest.mark.parametrize("how", ["source", "variable"])
def test_a_named_folder_comes_first(site, tmp_path, monkeypatch, place, by, how):
    path = tmp_path / "mine" / place
    path.parent.mkdir(parents=True)
    path.write_bytes(DATA)
    if how == "variable":
        monkeypatch.setenv("NAVREP_RELEASED_DIR", str(tmp_path / "mine"))
    assert get(tmp_path / "mine" if how == "source" else None, by) == path
    assert site.seen == []


def test_then_the_cache_then_the_network(site, tmp_path, home):
    (tmp_path / "empty").mkdir()
    path = get(tmp_path / "empty")
    assert path == home / "released" / PATH
    assert path.read_bytes() == DATA
    assert get(tmp_path / "empty") == get() == path
    assert len(site.seen) == 1, "the second and third come from the cache"


def test_wrong_file_in_a_named_folder_is_an_error_never_replaced(site, tmp_path):
    (tmp_path / "navreptraingpt").write_bytes(b"tampered" * 99)
    with pytest.raises(
        CorruptDataError, match=r"navreptraingpt is not the file that transformer_rings.released needs: 792"
    ):
        get(tmp_path)
    (tmp_path / "navreptraingpt").write_bytes(DATA[:-1] + b"S")
    with pytest.raises(
        CorruptDataError, match=r"needs: sha256 [0-9a-f]{64}, expected [0-9a-f]{64}\. Get it again from"
    ):
        get(tmp_path)
    with pytest.raises(CorruptDataError, match=r"needs: git blob id [0-9a-f]{40}, expected"):
        get(tmp_path, by="git")
    assert (tmp_path / "navreptraingpt").read_bytes() == DATA[:-1] + b"S"
    assert site.seen == []


def test_wrong_file_in_the_cache_is_fetched_again(site, home, monkeypatch):
    path = home / "released" / PATH
    path.parent.mkdir(parents=True)
    path.write_bytes(b"half a file")
    assert get().read_bytes() == DATA
    path.write_bytes(b"half a file")
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    with pytest.raises(OfflineError, match=r"is wrong in .*navreptraingpt \(11 bytes, expected 693\)"):
        get()


@pytest.mark.parametrize("name", ["NAVREP_DATA_OFFLINE", "HF_HUB_OFFLINE"])
def test_offline_error_names_file_id_and_place(site, home, monkeypatch, name):
    monkeypatch.setenv(name, "1")
    with pytest.raises(OfflineError) as caught:
        get(by="git")
    text = str(caught.value)
    assert "\n" not in text
    assert "transformer_rings.released needs models/W/navreptraingpt (git blob " in text
    assert entry().git_blob_sha1 in text
    assert f"put it at {home / 'released' / PATH}" in text
    assert "NAVREP_RELEASED_DIR" in text
    assert site.seen == []


def test_the_real_absent_file_is_named_by_its_git_blob(home, monkeypatch):
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    with pytest.raises(
        OfflineError, match=r"transformer_rings\.released needs .*git blob 5d4e82c51a129a8aabc45bef0a51649b9"
    ):
        zoo.load("transformer_rings_z.released")


def test_404_says_so_and_where_to_put_the_file(site, home):
    site.files.clear()
    with pytest.raises(DownloadError, match=r"needs models/W/navreptraingpt .*answers 404 Not Found.*Or put it at "):
        get()


def test_corrupted_by_the_server(site, home):
    site.corrupt = 99
    with pytest.raises(CorruptDataError, match="twice"):
        get()
    assert not (home / "released" / PATH).exists()


def test_cut_download_goes_on(site, home):
    site.cut_every = 100
    assert get(by="git").read_bytes() == DATA
    assert [r for _, r in site.seen] == [None] + [f"bytes={n}-" for n in range(100, 693, 100)]


def test_an_address_as_source(home, monkeypatch):
    with serving(Site(files={f"/mirror/{PATH}": DATA})) as other:
        assert get(f"{other.url}/mirror/").read_bytes() == DATA


def test_a_hub_repository_as_source(home, monkeypatch):
    from huggingface_hub import constants

    with serving(Site(files={f"/ann/navrep/resolve/v1/{PATH}": DATA})) as hub:
        monkeypatch.setattr(constants, "ENDPOINT", hub.url)
        monkeypatch.setenv("HF_TOKEN", "hf_secret")
        assert get("hf://ann/navrep@v1").read_bytes() == DATA
        assert hub.agents[0]["Authorization"] == "Bearer hf_secret"


@pytest.mark.parametrize("source", ["no/such/folder", "hf://ann", "hf://a/b/c"])
def test_bad_sources(source):
    with pytest.raises(ConfigError, match=r"source is|The repository is"):
        Source.of(source)


def test_bad_variable_is_named(monkeypatch):
    monkeypatch.setenv("NAVREP_RELEASED_DIR", "no/such/folder")
    with pytest.raises(ConfigError, match="NAVREP_RELEASED_DIR is 'no/such/folder'"):
        Source.of(None)


def test_default_address_is_the_authors_repository_at_the_pinned_commit():
    assert fetching._raw_url(REAL) == (
        "https://raw.githubusercontent.com/ethz-asl/navrep/f824612cc2649fa7d396647f1abc4516e10fae88"
    )


def test_paths_of_records_cannot_leave_the_cache(site, tmp_path):
    bad = replace(entry(), path="../../outside")
    with pytest.raises(CorruptDataError, match="points outside"):
        get_file(record(), bad, Source.of(None), progress=False)


def test_require_here_names_the_missing_part(tmp_path):
    with pytest.raises(
        ModelNotFoundError, match=r"transformer_1d_z\.20201015 needs models/W/navreptraingpt1d of transf"
    ):
        require_here(registry.find("transformer_1d_z.released"), Source.of(tmp_path))


def test_fetch_brings_policy_and_parts(released, home):
    files = zoo.fetch("transformer_1d_z.released", released)
    assert files[0].name == "navreptraingpt1d"
    assert len(files) == 2
    assert all(Path(f).is_relative_to(released) for f in files)
    wrong = [r.name for r in registry.records().values() for f in r.files if locate(f, Source(released))[1]]
    assert wrong == []


@pytest.mark.slow
def test_fetch_over_http_then_load_offline(released, home, monkeypatch):
    source = released / "models"
    names = ["W/navreptraingpt1d", "gym/navreptrainencodedenv_2020_10_15__09_18_59_PPO_GPT1D_V_ONLY_V64M64_ckpt.zip"]
    files = {f"/models/{name}": (source / name).read_bytes() for name in names}
    with serving(Site(files=files, cut_every=400_000)) as site:
        monkeypatch.setenv("NAVREP_RELEASED_URL", site.url)
        assert len(zoo.fetch("transformer_1d_z.released")) == 2
    monkeypatch.delenv("NAVREP_RELEASED_URL")
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    policy = zoo.load("transformer_1d_z.released")
    assert policy.name == "transformer_1d_z.20201015"
    shutil.rmtree(home)
    with pytest.raises(OfflineError):
        zoo.load("transformer_1d_z.released")
