"""The decorator of kernels: its only home, when it compiles anew, and that checked kernels are checked."""

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from numba.core.dispatcher import Dispatcher

import navrep_data
from navrep_data.kernels import kernel_cache_folder, kernel_sources

PACKAGE = Path(navrep_data.__file__).parent
COMPILERS = re.compile(r"\b(?:njit|jit|vectorize|guvectorize|cfunc|stencil|jitclass)\b")


def test_only_one_file_uses_numbas_own_decorators():
    sources = {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in PACKAGE.rglob("*.py")}
    assert [name for name, source in sources.items() if COMPILERS.search(source)] == ["kernels.py"]


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="kernels are plain Python here")
def test_every_kernel_is_kept_where_the_fingerprint_says():
    modules = [path for path in kernel_sources(PACKAGE) if "@kernel" in path.read_text() and path.name != "kernels.py"]
    names = [".".join(("navrep_data", *path.relative_to(PACKAGE).with_suffix("").parts)) for path in modules]
    found = 0
    for name in names:
        for label, thing in vars(importlib.import_module(name)).items():
            if isinstance(thing, Dispatcher) and thing.py_func.__module__ == name:
                found += 1
                assert Path(thing._cache.cache_path).is_relative_to(kernel_cache_folder()), f"{name}.{label}"
    assert found > 150


def test_the_fingerprint_holds_what_kernels_import(tmp_path):
    texts = {
        "caller.py": "from navrep_data.inner import (\n    callee,\n)\n\n@kernel\n",
        "inner/__init__.py": "",
        "inner/callee.py": "from navrep_data.constants import WIDTH\n\n@kernel(inline=True)\n",
        "constants.py": "WIDTH = 3\n",
        "kernels.py": "from navrep_data.io import cache_dir\n",
        "io.py": "",
        "other.py": "from navrep_data.caller import caller\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    found = {path.relative_to(tmp_path).as_posix() for path in kernel_sources(tmp_path)}
    assert found == {"caller.py", "inner/callee.py", "constants.py", "kernels.py"}


CALLEE = """
from navrep_data.kernels import kernel
from navrep_data.probe_constant import OFFSET

@kernel(inline=True)
def item(values, index):
    return values[index] + OFFSET + 1
"""
CALLER = """
from navrep_data.kernels import kernel
from navrep_data.probe_callee import item

@kernel
def total(values, n):
    return item(values, n - 1) + item(values, n - 1)
"""


@pytest.fixture
def run_probe(tmp_path):
    """Return a function that calls a probe kernel in a new process, with one cache for all calls."""
    package = tmp_path / "navrep_data"
    shutil.copytree(PACKAGE / "io", package / "io")
    for path in PACKAGE.glob("*.py"):
        shutil.copy(path, package)
    (package / "probe_constant.py").write_text("OFFSET = 0\n")
    (package / "probe_callee.py").write_text(CALLEE)
    (package / "probe_caller.py").write_text(CALLER)

    def run(n, checked=False, call="total"):
        code = (
            "import numpy as np\nfrom navrep_data.probe_caller import total, item\n"
            f"try:\n    print({call}(np.zeros(4, np.int64)[:2], {n}))\nexcept IndexError:\n    print('IndexError')"
        )
        env = {
            **os.environ,
            "PYTHONPATH": str(tmp_path),
            "NAVREP_DATA_HOME": str(tmp_path / "home"),
            "NUMBA_DISABLE_JIT": "0",
            "NUMBA_BOUNDSCHECK": str(int(checked)),
            # bytecode is told from stale by second and size: an edit of the same length within a second is not seen
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    run.package = package
    return run


@pytest.mark.slow
def test_an_edited_callee_or_constant_invalidates_its_callers(run_probe):
    assert run_probe(2) == "2"
    callee = run_probe.package / "probe_callee.py"
    callee.write_text(callee.read_text().replace("+ 1", "+ 5"))
    assert run_probe(2) == "10"
    (run_probe.package / "probe_constant.py").write_text("OFFSET = 7\n")
    assert run_probe(2) == "24"


@pytest.mark.slow
@pytest.mark.parametrize("warm", [False, True], ids=["fresh", "unchecked code is cached"])
def test_checked_kernels_raise_for_an_index_out_of_range(run_probe, warm):
    if warm:
        assert run_probe(3) == "2"  # past the end of what the kernel was given, and nobody looks
        assert run_probe(3, call="item") == "1"
    for _ in range(2):  # compiled, then from the cache
        assert run_probe(3, checked=True) == "IndexError"
        assert run_probe(3, checked=True, call="item") == "IndexError"
    assert run_probe(3) == "2"
