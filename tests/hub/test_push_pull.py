"""Datasets go up and come down whole, in the middle of failures too."""

import dataclasses
import json
import os
import shutil
import signal
import time
import types
from pathlib import Path

import pytest
from hub_server import TOKEN, Fault
from huggingface_hub import constants
from shards.synthetic import make_dataset
from warm_process import WarmProcess

from navrep_data.datasets import hub as module
from navrep_data.datasets import pull, push
from navrep_data.datasets.hub import parse_shards
from navrep_data.datasets.tools import _pieces, filter, merge
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetMismatchError,
    DatasetNotFoundError,
    DiskSpaceError,
    FolderInUseError,
    HubError,
    OfflineError,
)
from navrep_data.hub import client
from navrep_data.io import json_bytes, sha256_file
from navrep_data.shards import DatasetFolder, Manifest, content_hash, info, verify
from navrep_data.shards.manifest import _hash

pytestmark = pytest.mark.usefixtures("no_pictures")
REPO = "user/crowd"
LARGE = r"^/cdn/"


def few(cases, n):
    """The first n cases in quick runs, all of them in slow ones."""
    wrap = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [*cases[:n], *(pytest.param(*case, marks=pytest.mark.slow) for case in wrap[n:])]


def tree(root):
    return {
        p.relative_to(root).as_posix(): sha256_file(p)
        for p in sorted(root.rglob("*"))
        if p.is_file() and not p.name.startswith(".")
    }


def data_of(files):
    return {name: digest for name, digest in files.items() if name.startswith(("data/", "worlds/"))}


@pytest.fixture
def pushed(hub, template):
    result = push(template, REPO, license="cc-by-4.0")
    hub.seen.clear()
    return result


def check_whole(root, template):
    assert verify(root).problems == []
    assert data_of(tree(root)) == data_of(tree(template))
    assert sorted(p.name for p in root.iterdir() if p.name.startswith(".")) in ([], [".navrep-data.lock"])


# ---- without failures ----


@pytest.mark.slow
def test_what_tools_made_goes_up_and_comes_down_in_parts(hub, template, tmp_path, monkeypatch):
    monkeypatch.setattr(_pieces, "TARGET_SHARD_ROWS", 80)
    filter(template, tmp_path / "made", outcomes=["goal", "timeout", "stuck", "cut"])
    made = Manifest.read(tmp_path / "made")
    assert len(made.shards) > 1
    push(tmp_path / "made", REPO, license="mit")
    got = pull(REPO, tmp_path / "got", shards=[1])
    assert not got.complete
    assert verify(got.root).problems == []
    part = Manifest.read(got.root)
    assert part.source == made.source
    assert part.shards[0].source == made.shards[1].source != ()
    # rows are the same ones, by way of the Hub or not
    with pytest.raises(DatasetMismatchError, match="is both in"):
        merge([got.root, template], tmp_path / "twice")


def test_there_and_back(hub, template, tmp_path):
    before = tree(template)
    pushed = push(template, REPO, license="cc-by-4.0")
    assert tree(template) == before  # the folder stays as it is
    got = pull(REPO, tmp_path / "got")
    check_whole(got.root, template)
    assert (got.commit, got.complete, got.new_bytes) == (pushed.commit, True, got.bytes)
    assert got.content_hash == pushed.content_hash == content_hash(Manifest.read(template))
    told = info(got.root)
    assert told["origin"] == {
        "repo": REPO, "commit": pushed.commit, "asked": "main", "endpoint": hub.url,
        "manifest_sha256": Manifest.read(got.root).to_dict()["manifest_sha256"],
    }  # fmt: skip
    assert told["license"] == "cc-by-4.0"
    there = hub.repo(REPO).files()
    here = {name: (got.root / name).read_bytes() for name in tree(got.root) if name != "origin.json"}
    assert here == {name: data for name, data in there.items() if name != ".gitattributes"}
    assert b"license: cc-by-4.0" in there["README.md"]


@pytest.mark.slow
def test_what_was_pulled_goes_up_again_as_it_is(hub, pushed, tmp_path):
    got = pull(REPO, tmp_path / "got")
    again = push(got.root, "user/copy")
    one, other = hub.repo(REPO).files(), hub.repo("user/copy").files()
    assert one == other
    assert again.content_hash == pushed.content_hash
    assert push(got.root, "user/copy").commit == again.commit  # nothing changed: no commit


@pytest.mark.slow
def test_uploads_are_not_repeated(hub, template, pushed):
    assert len(hub.uploads) == 6
    push(template, REPO, license="mit")  # another licence, another card
    assert len(hub.uploads) == 6
    assert b"license: mit" in hub.repo(REPO).files()["README.md"]


@pytest.mark.slow
def test_a_smaller_version_leaves_nothing_behind_and_spares_what_is_not_ours(hub, template, tmp_path):
    push(template, REPO, license="mit")
    repo = hub.repo(REPO)
    repo.commit("main", {**repo.files(), "notes.md": b"mine", "data/mine.txt": b"mine"})
    make_dataset(tmp_path / "small", 2, 2, 40)
    push(tmp_path / "small", REPO, license="mit")
    names = set(repo.files())
    assert {n for n in names if n.endswith((".h5", ".npz"))} == {"data/train-00000.h5", "worlds/train-00000.npz"}
    assert {"notes.md", "data/mine.txt"} <= names
    assert pull(REPO, tmp_path / "got").complete


@pytest.mark.slow
def test_branches_tags_and_commits(hub, template, tmp_path):
    first = push(template, REPO, license="mit")
    second = push(template, REPO, license="mit", revision="v2", private=True)
    assert (first.revision, second.revision) == ("main", "v2")
    assert not hub.repo(REPO).private  # private is for new repositories
    push(template, REPO, license="cc0-1.0", revision="v2")
    assert info(pull(REPO, tmp_path / "a", revision="v2").root)["license"] == "cc0-1.0"
    assert info(pull(f"{REPO}@{first.commit}", tmp_path / "b").root)["license"] == "mit"
    with pytest.raises(HubError, match=r"Cannot find dataset user/crowd at revision v3 .*there is no such revision"):
        pull(REPO, tmp_path / "c", revision="v3")
    assert not (tmp_path / "c").exists()


@pytest.mark.slow
def test_a_private_repository(hub, template, tmp_path, monkeypatch):
    push(template, REPO, license="mit", private=True)
    assert hub.repo(REPO).private
    assert pull(REPO, tmp_path / "a").complete
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(HubError, match="there is no such repository, or it is private"):
        pull(REPO, tmp_path / "b")
    assert pull(REPO, tmp_path / "c", token=TOKEN).complete


# ---- parts ----


@pytest.mark.slow
def test_parts_add_up(hub, pushed, template, tmp_path):
    root = tmp_path / "got"
    part = pull(REPO, root, shards=[1])
    assert (part.shards, part.shards_in_all, part.complete) == (1, 3, False)
    assert verify(root).problems == []
    told = info(root)
    assert (told["complete"], told["sequences"], told["partial"]["sequences"]) == (False, 1, 4)
    with DatasetFolder(root) as folder:
        assert set(folder.episodes.sequence.tolist()) == {1}
    more = pull(REPO, root, split="train")
    assert more.shards == 2
    assert more.new_bytes < more.bytes
    assert verify(root).problems == []
    rest = pull(REPO, root)
    assert rest.complete
    check_whole(root, template)
    assert hub.count(LARGE, "GET") == 6  # each file once


@pytest.mark.slow
def test_a_part_is_no_dataset_to_push(hub, pushed, tmp_path):
    root = pull(REPO, tmp_path / "got", shards=[0]).root
    with pytest.raises(DatasetError, match="is a part of a dataset, expected a complete one"):
        push(root, "user/other")


@pytest.mark.parametrize(
    ("text", "numbers"), [("0-9", list(range(10))), ("3", [3]), ("1, 4-5", [1, 4, 5]), ("2,2,1-2", [1, 2])]
)
def test_parse_shards(text, numbers):
    assert parse_shards(text) == numbers


@pytest.mark.parametrize("text", ["", "a", "1-", "-1", "5-2", "1,,2", "1" * 9])
def test_parse_shards_refuses(text):
    with pytest.raises(ConfigError, match=r"expected numbers and ranges as in 0-9,12\."):
        parse_shards(text)


# ---- folders ----


@pytest.mark.slow
def test_a_folder_with_something_else_is_left_alone(hub, pushed, template, tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("x")
    with pytest.raises(FolderInUseError, match=r"holds 'thesis.tex' and no dataset of user/crowd; it is left alone"):
        pull(REPO, mine)
    made = Path(shutil.copytree(template, tmp_path / "made"))
    before = tree(made)
    with pytest.raises(FolderInUseError, match="holds a dataset that did not come from the Hub; it is left alone"):
        pull(REPO, made)
    assert tree(made) == before
    push(template, "user/other", license="mit")
    got = pull("user/other", tmp_path / "other").root
    with pytest.raises(FolderInUseError, match=r"holds a dataset from user/other@[0-9a-f]{40}; it is left alone"):
        pull(REPO, got)


@pytest.mark.slow
def test_a_version_that_grew_is_added_and_one_that_changed_is_refused(hub, tmp_path):
    make_dataset(tmp_path / "v1", 4, 2, 40)
    make_dataset(tmp_path / "v2", 6, 2, 40)
    make_dataset(tmp_path / "v3", 6, 2, 30)
    push(tmp_path / "v1", REPO, license="mit")
    first = pull(REPO, tmp_path / "got")
    push(tmp_path / "v2", REPO, license="mit")
    second = pull(REPO, tmp_path / "got")
    assert (first.shards, second.shards) == (2, 3)
    assert second.new_bytes < second.bytes
    check_whole(tmp_path / "got", tmp_path / "v2")
    push(tmp_path / "v3", REPO, license="mit")
    before = tree(tmp_path / "got")
    with pytest.raises(FolderInUseError, match=r"holds data/train-00000.h5 of another version than user/crowd@"):
        pull(REPO, tmp_path / "got")
    assert tree(tmp_path / "got") == before
    assert verify(tmp_path / "got").problems == []


@pytest.mark.slow
def test_a_damaged_copy_is_mended(hub, pushed, template, tmp_path):
    root = pull(REPO, tmp_path / "got").root
    path = root / "data" / "val-00000.h5"
    path.write_bytes(path.read_bytes()[:-1])
    (root / "worlds" / "test-00000.npz").unlink()
    hub.seen.clear()
    assert pull(REPO, root).complete
    check_whole(root, template)
    assert hub.count(LARGE, "GET") == 2


@pytest.mark.slow
def test_no_room(hub, pushed, tmp_path, monkeypatch):
    small = types.SimpleNamespace(disk_usage=lambda _: types.SimpleNamespace(free=1000), rmtree=shutil.rmtree)
    monkeypatch.setattr(module, "shutil", small)
    with pytest.raises(DiskSpaceError, match=r"needs [\d,]+ bytes, 1,000 are free: make room, or pull fewer shards"):
        pull(REPO, tmp_path / "got")


# ---- what may be pushed ----


def test_push_needs_a_licence(hub, template):
    with pytest.raises(ConfigError, match=r"has no licence, expected one to publish it under: --license cc-by-4.0"):
        push(template, REPO)
    with pytest.raises(ConfigError, match=r"^The licence is 'My own', expected an identifier such as cc-by-4.0"):
        push(template, REPO, license="My own")
    assert hub.seen == []


def test_push_finds_damage_before_it_sends(hub, template, tmp_path):
    root = Path(shutil.copytree(template, tmp_path / "copy"))
    path = root / "data" / "val-00000.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(CorruptDataError, match=r"val-00000.h5 differs from its SHA-256 .* Nothing was published"):
        push(root, REPO, license="mit")
    path.unlink()
    with pytest.raises((CorruptDataError, DatasetNotFoundError), match=r"val-00000.h5 is missing"):
        push(root, REPO, license="mit")
    assert hub.seen == []


@pytest.mark.parametrize(
    "name", few(["crowd", "a/b/c", "user/..", "../user/x", "user/a b", "http://x/y", "", "user/a--b"], 2)
)
def test_names_of_repositories_are_checked(hub, template, name, tmp_path):
    with pytest.raises(ConfigError, match="expected user/name as on the Hub"):
        push(template, name, license="mit")
    with pytest.raises(ConfigError, match="expected user/name as on the Hub"):
        pull(name, tmp_path / "got")
    assert hub.seen == []


def test_revisions_are_checked(hub, tmp_path):
    for revision in ("../x", "a b", "", "x" * 300):
        with pytest.raises(ConfigError, match="expected a branch, tag or commit"):
            pull(REPO, tmp_path / "got", revision=revision)
    with pytest.raises(ConfigError, match="names a revision, and another one is given"):
        pull(f"{REPO}@main", tmp_path / "got", revision="v2")


# ---- failures on the way down ----


@pytest.mark.slow
@pytest.mark.parametrize("every", [4099, 1 << 16, pytest.param(1031, marks=pytest.mark.slow)])
def test_connections_cut_every_k_bytes(hub, pushed, template, tmp_path, every):
    hub.cut_every = every
    got = pull(REPO, tmp_path / "got")
    check_whole(got.root, template)
    resumed = [r for _, path, r in hub.seen if r is not None and path.startswith("/cdn/")]
    largest = max(s.bytes for s in Manifest.read(template).shards)
    assert len(resumed) >= largest // every


@pytest.mark.slow
@pytest.mark.parametrize("at", range(40))
def test_a_connection_cut_once_after_any_byte(hub, pushed, template, tmp_path, at):
    size = min(s.bytes for s in Manifest.read(template).shards)
    hub.faults = [Fault("cut", LARGE, "GET", times=6, at=[0, 1, size - 1, size][at] if at < 4 else at * size // 40)]
    check_whole(pull(REPO, tmp_path / "got").root, template)


@pytest.mark.slow
@pytest.mark.parametrize("times", few([1, 2], 1))
def test_one_wrong_file_is_fetched_again(hub, pushed, template, tmp_path, times):
    hub.faults = [Fault("flip", LARGE, "GET", times=times)]
    check_whole(pull(REPO, tmp_path / "got").root, template)


@pytest.mark.slow
def test_a_file_that_stays_wrong_never_counts(hub, pushed, template, tmp_path):
    root = tmp_path / "got"
    shard = Manifest.read(template).shards[1]
    hub.faults = [Fault("flip", shard.sha256, "GET", times=1000)]
    with pytest.raises(CorruptDataError, match=r"data/val-00000.h5 that does not have its SHA-256 .* was not kept"):
        pull(REPO, root)
    assert not (root / "data" / "val-00000.h5").exists()
    with pytest.raises(DatasetNotFoundError):
        Manifest.read(root)
    kept = set(tree(root))
    assert {"data/train-00000.h5", "data/test-00000.h5"} <= kept
    hub.faults = []
    hub.seen.clear()
    assert pull(REPO, root).new_bytes == shard.bytes
    assert hub.count(LARGE, "GET") == 1
    check_whole(root, template)


@pytest.mark.slow
@pytest.mark.parametrize("path", few([r"/api/datasets", LARGE, r"/tree/", r"/resolve/", "manifest.json"], 2))
@pytest.mark.parametrize(
    "status", [429, pytest.param(500, marks=pytest.mark.slow), pytest.param(503, marks=pytest.mark.slow)]
)
def test_busy_servers_are_asked_again(hub, pushed, template, tmp_path, quick, path, status):
    hub.faults = [Fault("status", path, times=2, status=status, headers={"Retry-After": "7"})]
    check_whole(pull(REPO, tmp_path / "got").root, template)
    assert hub.faults[0].times == 0
    if status == 429:
        assert any(7 <= pause <= 8 for pause in quick)  # as long as it asks for


@pytest.mark.slow
def test_a_server_that_stays_busy(hub, pushed, tmp_path):
    hub.faults = [Fault("status", r"^/api/datasets", times=1000, status=429, headers={"Retry-After": "1"})]
    with pytest.raises(HubError, match=r"Gave up after 5 attempts .*: the Hub answers 429; it asks to come back in 1"):
        pull(REPO, tmp_path / "got")
    assert not (tmp_path / "got").exists()
    hub.faults = [Fault("status", r"^/api/datasets", times=1000, status=429, headers={"Retry-After": "3600"})]
    with pytest.raises(HubError, match=r"Gave up after 1 attempts .* it asks to come back in 3600 s"):
        pull(REPO, tmp_path / "got")


@pytest.mark.slow
@pytest.mark.parametrize("path", few([r"/api/datasets", r"/tree/", r"/resolve/", LARGE], 1))
def test_a_server_that_stalls_once(hub, pushed, template, tmp_path, impatient, path):
    hub.faults = [Fault("stall", path, times=1, seconds=600)]
    check_whole(pull(REPO, tmp_path / "got").root, template)
    assert hub.faults[0].times == 0


@pytest.mark.slow
@pytest.mark.parametrize("impatient", [0.05], indirect=True)
def test_a_server_that_stalls_for_good(hub, pushed, tmp_path, impatient):
    hub.faults = [Fault("stall", r"^/api/datasets", times=1000, seconds=600)]
    with pytest.raises(HubError, match=r"Gave up after 5 attempts to find dataset user/crowd .*: the Hub is silent"):
        pull(REPO, tmp_path / "got")


def test_nobody_listens(hub, tmp_path, monkeypatch):
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(HubError, match=r"Gave up after 5 attempts to find dataset user/crowd .* on http://127.0.0.1:9"):
        pull(REPO, tmp_path / "got")


@pytest.mark.slow
def test_a_revision_that_moves_while_it_is_pulled(hub, pushed, template, tmp_path):
    make_dataset(tmp_path / "new", 6, 2, 30)

    def move(running):
        running.repo(REPO).commit("main", {"manifest.json": b"{}"})

    hub.faults = [Fault("call", LARGE, "GET", after=2, action=move)]
    got = pull(REPO, tmp_path / "got")
    assert got.commit == pushed.commit  # all files are those of the commit that was found first
    check_whole(got.root, template)
    with pytest.raises(CorruptDataError, match=r"user/crowd/manifest\.json: field 'format' is 'missing'"):
        pull(REPO, tmp_path / "other")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("status", "words"),
    few(
        [
            (401, "it is private or not there, or the token is not accepted"),
            (403, "the token may not do that"),
            (404, "the Hub answers 404"),
            (418, "the Hub answers 418"),
        ],
        2,
    ),
)
def test_refusals_are_one_line(hub, pushed, tmp_path, status, words):
    hub.faults = [Fault("status", r"^/api/datasets", times=1000, status=status)]
    with pytest.raises(HubError, match=words) as caught:
        pull(REPO, tmp_path / "got")
    assert "\n" not in str(caught.value)
    assert hub.count("") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "status", "code", "words"),
    few(
        [
            (r"/resolve/.*/val-00000.h5", 404, "EntryNotFound", "it lacks a file; check that navrep-data wrote it"),
            (LARGE, 403, "", "the token may not do that"),  # as links that have expired do
            (r"/resolve/.*/val-00000.h5", 401, "", "it is private or not there, or the token is not accepted"),
            (r"/resolve/.*/val-00000.h5", 401, "GatedRepo", "it is gated: ask for access on its page"),
            (LARGE, 404, "", "the Hub answers 404"),
            (r"/tree/", 404, "RevisionNotFound", "there is no such revision"),
        ],
        2,
    ),
)
def test_refusals_on_the_way_are_one_line(hub, pushed, template, tmp_path, path, status, code, words):
    hub.faults = [Fault("status", path, times=1000, status=status, headers={"X-Error-Code": code})]
    with pytest.raises(HubError, match=words) as caught:
        pull(REPO, tmp_path / "got")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "got" / "manifest.json").exists()
    hub.faults = []
    check_whole(pull(REPO, tmp_path / "got").root, template)


@pytest.mark.slow
def test_a_wrong_token(hub, pushed, template, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(HubError, match=r"or the token is not accepted; log in with `hf auth login`, or set HF_TOKEN"):
        push(template, "user/new", license="mit")


# ---- hostile servers ----


def replace_manifest(hub, change):
    files = hub.repo(REPO).files()
    values = json.loads(files["manifest.json"])
    change(values)
    values["manifest_sha256"] = _hash(values)
    hub.repo(REPO).commit("main", {**files, "manifest.json": json_bytes(values)})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    few(
        [
            (lambda v: v["shards"][0].update(file="../../evil.h5"), "points outside the dataset"),
            (lambda v: v["shards"][0].update(file="/etc/evil.h5"), "points outside the dataset"),
            (lambda v: v["shards"][0].update(file="data/../x.h5"), "points outside the dataset"),
            (lambda v: v["shards"][0].update(file=".navrep-data.lock"), "'.navrep-data.lock', expected data/train-"),
            (lambda v: v["shards"][0].update(file="data/*.h5"), r"'data/\*.h5', expected data/train-, a number"),
            (lambda v: v["shards"][0].update(file="data/sub/x.h5"), "'data/sub/x.h5', expected data/train-"),
            (lambda v: v["shards"][0]["worlds"].update(file="origin.json"), "'origin.json', expected worlds/train-000"),
            (lambda v: v["extras"][0].update(file="media/x.html"), "'media/x.html', expected index.json, or a .png"),
            (
                lambda v: v["shards"][0].update(file="data/train-00009.h5", worlds=None),
                "lacks data/train-00009.h5, which",
            ),
            (lambda v: v["shards"][0].update(bytes=1), "holds another data/train-00000.h5"),
            (lambda v: v["shards"][0].update(sha256="0" * 64), "holds another data/train-00000.h5"),
            (lambda v: v.update(complete=False), "holds an unfinished dataset"),
        ],
        4,
    ),
)
def test_a_manifest_that_asks_for_too_much(hub, pushed, tmp_path, change, words):
    replace_manifest(hub, change)
    with pytest.raises((CorruptDataError, DatasetError), match=words):
        pull(REPO, tmp_path / "got")
    assert sorted(p.name for p in tmp_path.iterdir()) in ([], ["hf-cache"])


@pytest.mark.slow
def test_a_manifest_that_is_too_large(hub, pushed, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_MAX_MANIFEST_BYTES", 100)
    with pytest.raises(DatasetError, match=r"has a manifest.json of [\d,]+ bytes, expected at most"):
        pull(REPO, tmp_path / "got")
    assert hub.count("/resolve/") == 0


@pytest.mark.slow
def test_a_repository_without_a_dataset(hub, pushed, tmp_path):
    hub.repo(REPO).commit("main", {"README.md": b"x"})
    with pytest.raises(DatasetNotFoundError, match=r"has no manifest.json, expected a dataset from `navrep-data push`"):
        pull(REPO, tmp_path / "got")


@pytest.mark.slow
def test_a_server_that_sends_without_end(hub, pushed, tmp_path, monkeypatch):
    """It announces the right size and sends more, without a length; what it sends is bounded."""
    shard = hub.repo(REPO).files()["data/train-00000.h5"]
    monkeypatch.setattr(client, "_SLACK", 1000)
    import hashlib

    import hub_server

    def endless(handler, oid):
        handler.send_response(200)
        handler.send_header("Transfer-Encoding", "chunked")
        handler.end_headers()
        block = b"x" * (1 << 20)
        for _ in range(1000):
            handler.wfile.write(b"%x\r\n" % len(block) + block + b"\r\n")
            sent.append(len(block))

    sent: list[int] = []
    content = hub_server._Handler._cdn
    monkeypatch.setattr(
        hub_server._Handler,
        "_cdn",
        lambda self, oid: (endless if oid == hashlib.sha256(shard).hexdigest() else content)(self, oid),
    )
    with pytest.raises(CorruptDataError, match=r"The Hub sends more than the [\d,]+ bytes that the manifest lists"):
        pull(REPO, tmp_path / "got", shards=[0])
    assert sum(sent) < 100 << 20
    assert sum(p.stat().st_size for p in (tmp_path / "got").rglob("*") if p.is_file()) < 2 << 20


# ---- failures on the way up ----


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    few(
        [
            Fault("cut", r"^/lfs/", "PUT", times=1, at=0),
            Fault("cut", r"^/lfs/", "PUT", times=3, at=1000),
            Fault("status", r"^/lfs/", "PUT", times=2, status=503),
            Fault("status", r"/batch$", "POST", times=1, status=429, headers={"Retry-After": "3"}),
            Fault("status", r"/preupload/", "POST", times=1, status=500),
            Fault("status", r"/commit/", "POST", times=2, status=503),
            Fault("cut", r"/commit/", "POST", times=1, at=10),
            Fault("status", r"/repos/create", "POST", times=1, status=429, headers={"Retry-After": "1"}),
            Fault("stall", r"/commit/", "POST", times=1, seconds=600),
            Fault("stall", r"^/lfs/", "PUT", times=1, seconds=600),
        ],
        2,
    ),
    ids=lambda f: f"{f.kind}-{f.path.strip('/^$')}-{f.at or f.status}",
)
def test_push_goes_on_after_a_failure(hub, template, tmp_path, impatient, fault):
    hub.faults = [dataclasses.replace(fault)]
    pushed = push(template, REPO, license="mit")
    assert hub.faults[0].times == 0
    assert len(hub.uploads) == len(set(hub.uploads))
    got = pull(REPO, tmp_path / "got")
    assert got.commit == pushed.commit
    check_whole(got.root, template)


@pytest.mark.slow
def test_a_commit_whose_answer_is_lost_is_made_once(hub, template, tmp_path, monkeypatch):
    import hub_server

    take = hub_server._Handler._take_commit

    def lose(self, *arguments):
        answer, self._json = self._json, lambda *_: None
        take(self, *arguments)
        self._json = answer
        self.close_connection = True

    monkeypatch.setattr(hub_server._Handler, "_take_commit", lose)
    pushed = push(template, REPO, license="mit")
    assert len(hub.repo(REPO).commits) == 2
    assert pushed.commit == hub.repo(REPO).branches["main"]
    check_whole(pull(REPO, tmp_path / "got").root, template)


@pytest.mark.slow
def test_a_push_that_fails_publishes_nothing_and_goes_on_later(hub, template, tmp_path):
    hub.faults = [Fault("status", r"^/lfs/", "PUT", times=1000, after=4, status=403)]
    with pytest.raises(HubError, match="the token may not do that"):
        push(template, REPO, license="mit")
    assert set(hub.repo(REPO).files()) == {".gitattributes"}
    sent = list(hub.uploads)
    assert len(sent) == 4
    hub.faults = []
    push(template, REPO, license="mit")
    assert len(hub.uploads) == 6
    assert hub.uploads[:4] == sent
    check_whole(pull(REPO, tmp_path / "got").root, template)


@pytest.mark.slow
def test_somebody_else_pushes_meanwhile(hub, template):
    push(template, REPO, license="mit")
    other = {**hub.repo(REPO).files(), "notes.md": b"mine"}
    hub.faults = [Fault("call", r"/commit/", "POST", action=lambda running: running.repo(REPO).commit("main", other))]
    with pytest.raises(HubError, match="somebody else changed the repository meanwhile; run the same command again"):
        push(template, REPO, license="cc0-1.0")
    assert hub.repo(REPO).files() == other
    push(template, REPO, license="cc0-1.0")
    assert hub.repo(REPO).files()["notes.md"] == b"mine"


def test_somebody_elses_namespace(hub, template):
    with pytest.raises(HubError, match=r"the token may not do that; .* \(it says: You do not have the rights"):
        push(template, "other/crowd", license="mit")


# ---- offline ----


@pytest.mark.slow
@pytest.mark.parametrize("switch", few(["NAVREP_DATA_OFFLINE", "HF_HUB_OFFLINE"], 1))
def test_offline_asks_nobody(hub, pushed, template, tmp_path, monkeypatch, switch):
    monkeypatch.setenv(switch, "1")
    with pytest.raises(OfflineError, match=f"The network is switched off \\({switch}=1\\), cannot pull user/crowd"):
        pull(REPO, tmp_path / "got")
    with pytest.raises(OfflineError, match=f"{switch}=1"):
        push(template, REPO, license="mit")
    assert hub.seen == []
    assert not (tmp_path / "got").exists()


# ---- the command line, in processes of its own ----

# the command line, and how much of the pictures it draws, which takes seconds
PROGRAM = """
import sys
from navrep_data.cli.main import run
from navrep_data.datasets import _hub_extras, _hub_pictures
if sys.argv[1] == "pictures":
    _hub_pictures.FRAMES = 2
else:
    _hub_extras.draw_pictures = lambda folder: {}
run(sys.argv[2:])
"""


@pytest.fixture(scope="module")
def warm():
    """Each command imports huggingface_hub itself, which reads at import where the Hub is."""
    with WarmProcess(cold=["huggingface_hub"]) as process:
        yield process


@pytest.fixture
def command(hub, tmp_path, warm):
    environment = {
        **os.environ, "HF_ENDPOINT": hub.url, "HF_TOKEN": TOKEN, "HF_HUB_DISABLE_XET": "1",
        "HF_HOME": str(tmp_path / "hf-home"), "MPLCONFIGDIR": str(tmp_path),
    }  # fmt: skip
    del environment["NAVREP_DATA_HOME"]  # a home without kernels: each command would compile what it calls

    def start(*words, wait=True, pictures=False):
        """Return a command that runs, or with `wait` its exit status and what it said."""
        program = tmp_path / "program.py"
        program.write_text(PROGRAM)
        line = [program, "pictures" if pictures else "none", *words]
        running = warm.start(line, tmp_path, environment)
        if not wait:
            return running
        done = running.wait()
        return done.returncode, done.stdout, done.stderr

    return start


@pytest.mark.slow
def test_cli(command, hub, template, tmp_path):
    code, out, err = command("push", template, REPO)
    assert (code, out) == (2, "")
    assert err.startswith(f"Error: {template} has no licence, expected one to publish it under: --license cc-by-4.0")
    assert err.count("\n") == 1
    code, out, err = command("push", template, REPO, "--license", "cc-by-4.0", "--private", pictures=True)
    assert (code, err) == (0, "")
    commit = hub.repo(REPO).branches["main"]
    assert f"commit {commit} on main" in out
    assert hub.repo(REPO).private
    assert any(name.startswith("media/") for name in hub.repo(REPO).files())
    code, out, err = command("pull", REPO, "--shards", "0,2", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["shards"] == 2
    code, out, err = command("info", "data/crowd")
    assert f"from: {REPO} at commit {commit}" in out
    assert "(partial: 2 of 3 shards, 3 of 4 sequences)" in out
    code, out, err = command("verify", "data/crowd")
    assert code == 0, out
    code, out, err = command("pull", "user/none")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "there is no such repository, or it is private" in err


@pytest.mark.slow
def test_cli_of_models(command, hub, tmp_path):
    from navrep_data.models import checkpoint

    checkpoint.save(checkpoint.make("controller", {}), tmp_path / "m")
    code, out, err = command("push-model", "m", "user/brain")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("Error: m has no licence, expected one to publish it under: --license mit")
    code, out, err = command("push-model", "m", "user/brain", "--license", "mit", "--private", "--revision", "v2")
    assert (code, err) == (0, "")
    repo = hub.repo("user/brain", "model")
    assert repo.private
    assert f'next: navrep_data.zoo.load("hf://user/brain@{repo.branches["v2"]}")' in out
    assert repo.files("v2")["model.safetensors"] == (tmp_path / "m" / "model.safetensors").read_bytes()


def wait_for(condition):
    """However long that takes; pytest's own limit ends a hang."""
    while not condition():
        time.sleep(0.02)


def interrupt(running, stall, how):
    """Send a signal to a command whose requests stall; return how it ended.

    Its threads end with their requests, so these have to end. From then on all requests are cut, so that the command
    cannot get through before it takes the signal, however late that is.
    """
    running.send_signal(how)
    stall.over.set()
    return running.wait()


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("after", [0, 3, 5])
def test_a_killed_push_goes_on(command, hub, template, tmp_path, how, after):
    hub.faults = [stall := Fault("stall", r"^/lfs/[0-9a-f]*$", "PUT", times=1000, after=after, seconds=600)]
    running = command("push", template, REPO, "--license", "mit", wait=False)
    wait_for(lambda: len(hub.uploads) == after and stall.times < 1000)
    done = interrupt(running, stall, how)
    assert set(hub.repo(REPO).files()) == {".gitattributes"}
    if how == signal.SIGINT:
        assert (done.returncode, done.stderr.count("Interrupted.")) == (130, 1)
    hub.faults = []
    code, _, err = command("push", template, REPO, "--license", "mit")
    assert code == 0, err
    assert sorted(hub.uploads) == sorted(set(hub.uploads))
    check_whole(pull(REPO, tmp_path / "got").root, template)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("after", [0, 3, 5])
def test_a_killed_pull_goes_on(command, hub, pushed, template, tmp_path, how, after):
    root = tmp_path / "got"
    hub.faults = [stall := Fault("stall", LARGE, "GET", times=1000, after=after, seconds=600)]
    running = command("pull", REPO, "--out", root, wait=False)
    wait_for(lambda: stall.times < 1000)
    interrupt(running, stall, how)
    with pytest.raises(DatasetNotFoundError):
        Manifest.read(root)
    hub.faults = []
    hub.seen.clear()
    code, _, err = command("pull", REPO, "--out", root)
    assert code == 0, err
    check_whole(root, template)
    assert hub.count(LARGE, "GET") <= 6


def test_a_terminal_is_asked_for_the_licence(monkeypatch):
    from navrep_data.cli import hub as verbs

    asked = []
    monkeypatch.setattr(verbs.signal, "signal", lambda *_: None)
    monkeypatch.setattr(verbs.typer, "prompt", lambda text, err: asked.append((text, err)) or " mit ")
    for terminal, given, known, expected in (
        (True, None, None, "mit"),
        (True, "cc0-1.0", None, "cc0-1.0"),
        (True, None, "cc-by-4.0", "cc-by-4.0"),
        (False, None, None, None),
    ):
        monkeypatch.setattr(verbs.sys, "stdin", types.SimpleNamespace(isatty=lambda terminal=terminal: terminal))
        assert verbs._licence(given, known) == expected
    assert asked == [(verbs.LICENSE_QUESTION, True)]
