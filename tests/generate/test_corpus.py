"""What generate makes does not change by accident: recorded hashes of every environment, physics and option."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from navrep_data.errors import MissingExtraError
from navrep_data.generate.plan import versions

sys.path.insert(0, str(Path(__file__).resolve().parent))
import corpus

RECORDED = json.loads(corpus.RECORDED.read_text(encoding="utf-8"))
# What decides the last digits of numbers, and what decides how they are packed.
NUMBERS = ("numpy", "numba", "llvmlite", "machine", "cpu")
FILES = (*NUMBERS, "h5py", "deflate")


def differing(names: tuple[str, ...]) -> list[str]:
    here = versions()
    return [name for name in names if here[name] != RECORDED["versions"][name]]


@pytest.mark.slow
@pytest.mark.parametrize("name", corpus.RECIPES)
def test_corpus_is_as_recorded(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    corpus.write_hall(tmp_path)
    try:
        found = corpus.make(name, tmp_path / "d")
    except MissingExtraError as error:
        pytest.skip(str(error))
    expected = RECORDED["datasets"][name]
    if found["sequences"] != expected["sequences"] and differing(NUMBERS):
        pytest.skip(f"last digits may differ: another {' and '.join(differing(NUMBERS))} than in the recording")
    for kind in ("sequences", "worlds"):
        assert found[kind] == expected[kind], f"{kind} of {name} are not what they were"
    if not differing(FILES):
        assert found["files"] == expected["files"], f"files of {name} are packed otherwise"


def test_corpus_is_complete():
    assert list(RECORDED["datasets"]) == list(corpus.RECIPES)
