"""The package as a whole: lazy imports, errors, kernels' cache, the test helper."""

import builtins
import importlib
import inspect
import os
import subprocess
import sys

import pytest

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
    assert (manifest.sequences, manifest.rows, len(manifest.shards)) == (4, 240, 2)
    assert set(manifest.splits) == {"train", "val", "test"}
    assert verify(root).ok
    assert tiny_dataset(tmp_path / "tiny") == root


@pytest.mark.slow
def test_an_edited_kernel_invalidates_its_callers(tmp_path):
    """numba looks at the caller's file alone; our cache folder looks at all of them."""
    package = tmp_path / "navrep_data"
    source = os.path.dirname(navrep_data.__file__)
    subprocess.run(["cp", "-r", source, str(package)], check=True)
    (package / "sim" / "_probe_callee.py").write_text(
        "from navrep_data._kernels import kernel\n\n\n@kernel\ndef number():\n    return 1\n"
    )
    (package / "sim" / "_probe_caller.py").write_text(
        "from navrep_data._kernels import kernel\nfrom navrep_data.sim._probe_callee import number\n\n\n"
        "@kernel\ndef twice():\n    return 2 * number()\n"
    )
    code = "from navrep_data.sim._probe_caller import twice; print(twice())"
    env = {**os.environ, "PYTHONPATH": str(tmp_path), "NAVREP_DATA_HOME": str(tmp_path / "home")}

    def run():
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    assert run() == 2
    callee = package / "sim" / "_probe_callee.py"
    callee.write_text(callee.read_text().replace("return 1", "return 5"))
    assert run() == 10
