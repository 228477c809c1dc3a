"""Downloads over real HTTP from a server on the loopback that cuts, corrupts, redirects, stalls and refuses."""

import hashlib
import random
import subprocess
import threading

import pytest
from http_server import Site, serving

from navrep_data.errors import CorruptDataError, DownloadError, OfflineError
from navrep_data.io import FileId, download, git_blob_sha1, is_offline

pytestmark = pytest.mark.slow  # seconds in all; `make test` runs them

DATA = random.Random(0).randbytes(3001)
RIGHT = FileId(len(DATA), hashlib.sha256(DATA).hexdigest())
BLOB = FileId(git_blob_sha1=hashlib.sha1(b"blob 3001\0" + DATA).hexdigest())


@pytest.fixture(autouse=True)
def _direct_network(monkeypatch):
    for name in ("NAVREP_DATA_OFFLINE", "HF_HUB_OFFLINE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("no_proxy", "127.0.0.1")


@pytest.fixture
def site():
    with serving(Site(files={"/a.bin": DATA})) as running:
        yield running


def get(site, folder, expected=RIGHT, **options):
    options = {"timeout": 60.0, "attempts": 3, "backoff": 0.0, "progress": False, **options}
    return download(f"{site.url}/a.bin", folder / "deep" / "a.bin", expected, **options)


def leftovers(folder):
    """Names beside the target, lock files apart."""
    return sorted(p.name for p in folder.rglob("*") if p.is_file() and not p.name.endswith(".lock"))


def test_plain_download_and_second_call_asks_nobody(site, tmp_path):
    path = get(site, tmp_path)
    assert path.read_bytes() == DATA
    assert leftovers(tmp_path) == ["a.bin"]
    assert get(site, tmp_path) == path
    assert len(site.seen) == 1
    assert site.agents[0]["User-Agent"].startswith("navrep-data/")


@pytest.mark.parametrize("cut", [1, 2, 7, 250, 1500, 3000])
def test_a_server_that_cuts_every_k_bytes(site, tmp_path, cut):
    data = DATA[: min(len(DATA), 40 * cut)] if cut < 250 else DATA
    site.files["/a.bin"], site.cut_every = data, cut
    right = FileId(len(data), hashlib.sha256(data).hexdigest())
    assert get(site, tmp_path, right).read_bytes() == data
    starts = [0 if r is None else int(r[6:-1]) for _, r in site.seen]
    assert starts == list(range(0, len(data), cut)), "each connection goes on where the last was cut"


@pytest.mark.parametrize("length", [True, False])
def test_cut_download_never_counts_as_present_and_goes_on_later(site, tmp_path, length):
    site.length, site.cut_every = length, 1000
    site.ranges = False  # every attempt starts over and dies at byte 1000
    with pytest.raises(
        DownloadError, match=r"Gave up on .* after 3 attempts that brought nothing new.* 1,000 bytes are kept"
    ):
        get(site, tmp_path)
    assert not (tmp_path / "deep" / "a.bin").exists()
    assert (tmp_path / "deep" / leftovers(tmp_path)[0]).read_bytes() == DATA[:1000]

    site.cut_every, site.ranges, site.length = None, True, True
    asked = len(site.seen)
    assert get(site, tmp_path).read_bytes() == DATA
    assert site.seen[asked:] == [("/a.bin", "bytes=1000-")]
    assert leftovers(tmp_path) == ["a.bin"]


def test_wrong_part_file_is_thrown_away(site, tmp_path):
    folder = tmp_path / "deep"
    folder.mkdir()
    part = folder / f".a.bin.{RIGHT.sha256[:16]}.part"
    part.write_bytes(b"x" * 1000)
    assert get(site, tmp_path).read_bytes() == DATA
    assert [r for _, r in site.seen] == ["bytes=1000-", None]
    part.write_bytes(b"x" * 5000)  # longer than the file: 416
    (folder / "a.bin").unlink()
    assert get(site, tmp_path).read_bytes() == DATA


def test_server_that_answers_another_range(site, tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / f".a.bin.{RIGHT.sha256[:16]}.part").write_bytes(DATA[:1000])
    site.wrong_range = True
    assert get(site, tmp_path).read_bytes() == DATA


def test_corrupted_once_is_fetched_again_twice_is_refused(site, tmp_path):
    site.corrupt = 1
    assert get(site, tmp_path).read_bytes() == DATA
    site.corrupt = 100
    with pytest.raises(CorruptDataError, match=r"a file of sha256 [0-9a-f]{64}, expected " + RIGHT.sha256 + ", twice"):
        get(site, tmp_path / "again")
    assert leftovers(tmp_path / "again") == []


def test_right_size_but_old_file_in_place_is_replaced(site, tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.bin").write_bytes(b"y" * len(DATA))
    assert get(site, tmp_path).read_bytes() == DATA


def test_git_blob_id_is_checked_where_nothing_else_is_known(site, tmp_path):
    assert get(site, tmp_path, BLOB).read_bytes() == DATA
    site.corrupt = 100
    with pytest.raises(CorruptDataError, match=r"git blob id [0-9a-f]{40}, expected " + BLOB.git_blob_sha1):
        get(site, tmp_path / "again", BLOB)


def test_git_blob_id_is_gits(tmp_path):
    (tmp_path / "f").write_bytes(b"hello\n")
    assert git_blob_sha1(tmp_path / "f") == "ce013625030ba8dba906f756967f9e9ca394464a"
    try:
        found = subprocess.run(["git", "hash-object", tmp_path / "f"], capture_output=True, text=True, check=True)
    except FileNotFoundError:
        pytest.skip("needs git")
    assert found.stdout.strip() == git_blob_sha1(tmp_path / "f")


def test_redirects_are_followed_and_bounded(site, tmp_path):
    site.files["/b.bin"] = site.files.pop("/a.bin")
    site.moved["/a.bin"] = f"{site.url}/b.bin"
    assert get(site, tmp_path).read_bytes() == DATA
    site.moved["/a.bin"] = f"{site.url}/a.bin"
    with pytest.raises(DownloadError, match="redirect"):
        get(site, tmp_path / "loop")
    assert len(site.seen) < 20


def test_redirect_to_a_file_of_this_machine_is_refused(site, tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(DATA)
    site.moved["/a.bin"] = f"file://{secret}"
    with pytest.raises(DownloadError, match="plain http"):
        get(site, tmp_path / "x")


def test_credentials_stay_with_their_host(site, tmp_path):
    with serving(Site(files={"/a.bin": DATA})) as other:
        site.moved["/a.bin"] = f"{other.url}/a.bin"
        get(site, tmp_path, headers={"Authorization": "Bearer secret"})
        assert "Authorization" in site.agents[0]
        assert "Authorization" not in other.agents[0]


def test_stalled_server_is_left_and_the_rest_fetched(site, tmp_path):
    site.hangs = 1
    assert get(site, tmp_path, timeout=2.0).read_bytes() == DATA
    assert site.seen[1][1] == f"bytes={len(DATA) // 2}-"


def test_always_stalled_server_is_given_up(site, tmp_path):
    site.hangs = 1000
    site.ranges = False
    with pytest.raises(DownloadError, match=r"Gave up .* silent for 1 s"):
        get(site, tmp_path, timeout=1.0, attempts=2)


def test_server_that_drips_is_as_good_as_stalled(site, tmp_path):
    site.hangs, site.drip = 1, True
    expected = FileId(len(DATA), RIGHT.sha256)
    # dripped zeros are no part of the file: the first hash fails, the second download is whole
    assert get(site, tmp_path, expected, timeout=2.0).read_bytes() == DATA
    assert site.seen[1][1].startswith("bytes="), "left before the server had enough"


def test_404_says_what_was_expected_and_does_not_insist(site, tmp_path):
    site.files.clear()
    with pytest.raises(DownloadError, match=r"a\.bin answers 404 Not Found, expected the file \(sha256 "):
        get(site, tmp_path)
    assert len(site.seen) == 1
    assert leftovers(tmp_path) == []


def test_busy_server_is_asked_again(site, tmp_path):
    site.answers["/a.bin"] = [503, 429]
    assert get(site, tmp_path).read_bytes() == DATA
    site.answers["/a.bin"] = [503] * 100
    with pytest.raises(DownloadError, match="answers 503"):
        get(site, tmp_path / "x")


def test_another_size_is_refused_before_it_is_read(site, tmp_path):
    site.files["/a.bin"] = b"<html>log in to the hotel's network</html>"
    with pytest.raises(CorruptDataError, match="offers 42 bytes, expected 3,001"):
        get(site, tmp_path)
    site.files["/a.bin"] = DATA * 2
    site.length = False  # says nothing about its size
    with pytest.raises(CorruptDataError, match="more than the expected 3,001 bytes"):
        get(site, tmp_path)
    with pytest.raises(CorruptDataError, match="more than the expected 100 bytes"):
        get(site, tmp_path, FileId(), max_bytes=100)
    assert not (tmp_path / "deep" / "a.bin").exists()


def test_compressed_body_is_refused(site, tmp_path):
    site.encoding = "gzip"
    with pytest.raises(DownloadError, match="compressed"):
        get(site, tmp_path)
    assert site.agents[0]["Accept-Encoding"] == "identity"


def test_nobody_listens(tmp_path):
    with serving(Site()) as gone:
        pass
    with pytest.raises(DownloadError, match="Gave up on"):
        get(gone, tmp_path)


@pytest.mark.parametrize("name", ["NAVREP_DATA_OFFLINE", "HF_HUB_OFFLINE"])
def test_offline_asks_nobody(site, tmp_path, monkeypatch, name):
    monkeypatch.setenv(name, "0")
    assert not is_offline()
    monkeypatch.setenv(name, "1")
    assert is_offline()
    with pytest.raises(OfflineError, match=rf"switched off \({name}=1\), cannot get http"):
        get(site, tmp_path)
    assert site.seen == []


def test_two_at_once_download_once(site, tmp_path):
    results = []
    threads = [threading.Thread(target=lambda: results.append(get(site, tmp_path).read_bytes())) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=300)
    assert results == [DATA] * 4
    assert len(site.seen) == 1


def test_progress_goes_to_stderr(site, tmp_path, capsys):
    get(site, tmp_path, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "a.bin" in err
    assert "100%" in err
    get(site, tmp_path / "x", progress=None)
    assert capsys.readouterr().err == "", "silent where stderr is no terminal"
