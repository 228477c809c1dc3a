"""The package as a whole: lazy imports, errors, the test helper."""

import builtins
import importlib
import inspect
from pathlib import Path

import pytest
import yaml

import navrep_data
from navrep_data import errors
from navrep_data.shards import Manifest, verify
from navrep_data.testing import tiny_dataset


def test_every_public_package_loads():
    for name in navrep_data.__all__:
        assert getattr(navrep_data, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        navrep_data.nonsense  # noqa: B018


def test_every_error_is_ours_and_a_builtin():
    classes = [c for _, c in inspect.getmembers(errors, inspect.isclass) if c.__module__ == errors.__name__]
    assert len(classes) > 10
    for c in classes:
        if issubclass(c, Warning):  # nothing is raised by these
            continue
        assert issubclass(c, errors.NavrepDataError)
        if c is not errors.NavrepDataError:
            assert any(b.__name__ in dir(builtins) and b is not Exception for b in c.__mro__[1:-3]), c


def test_did_you_mean():
    assert errors.did_you_mean("soadlr", ["soadrl", "ian"]) == " Did you mean 'soadrl'?"
    assert errors.did_you_mean("zzz", ["soadrl"]) == ""


def test_public_functions_are_documented():
    for name in ("observations", "sim", "shards", "generate", "datasets", "io", "testing"):
        module = importlib.import_module(f"navrep_data.{name}")
        for symbol in getattr(module, "__all__", []):
            thing = getattr(module, symbol)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                assert inspect.getdoc(thing), f"{name}.{symbol}"


def test_tiny_dataset_is_real(tmp_path):
    root = tiny_dataset(tmp_path / "tiny")
    manifest = Manifest.read(root)
    assert (manifest.sequences, manifest.rows, len(manifest.shards)) == (4, 240, 3)
    assert set(manifest.splits) == {"train", "val", "test"}
    assert verify(root).ok
    assert tiny_dataset(tmp_path / "tiny") == root


def test_the_citation_names_the_paper_on_arxiv():
    cited = yaml.safe_load((Path(__file__).resolve().parents[1] / "CITATION.cff").read_text())["preferred-citation"]
    assert {"type": "other", "value": "arXiv:2012.04406"}.items() <= cited["identifiers"][0].items()
    assert cited["url"] == "https://arxiv.org/abs/2012.04406"
