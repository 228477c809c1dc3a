"""Datasets go up and come down whole."""

import pytest

from navrep_data.datasets import pull, push
from navrep_data.io import sha256_file
from navrep_data.shards import Manifest, content_hash, info, verify

pytestmark = pytest.mark.usefixtures("no_pictures")
REPO = "user/crowd"


def tree(root):
    return {
        str(p.relative_to(root)): sha256_file(p)
        for p in sorted(root.rglob("*"))
        if p.is_file() and not p.name.startswith(".")
    }


def test_there_and_back(hub, template, tmp_path):
    before = tree(template)
    pushed = push(template, REPO, license="cc-by-4.0")
    assert tree(template) == before
    got = pull(REPO, tmp_path / "got")
    assert verify(got.root).problems == []
    down = tree(got.root)
    for name in before:
        if name.startswith(("data/", "worlds/")):
            assert down[name] == before[name]
    assert got.commit == pushed.commit
    assert got.content_hash == pushed.content_hash == content_hash(Manifest.read(template))
    told = info(got.root)
    assert told["origin"]["commit"] == pushed.commit
    assert told["license"] == "cc-by-4.0"
