"""Fixtures for all tests; and no test reaches another machine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# Networks here are small and test processes share the cores: threads that wait for each other would take half of them.
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent / "no_network"))

import loopback_only
from recorded import AUTHORS

loopback_only.install()


def pytest_sessionstart(session):
    """Where several processes are about to run tests: compile once what each of them would compile."""
    if getattr(session.config.option, "numprocesses", None) and os.environ.get("NUMBA_DISABLE_JIT", "0") == "0":
        script = str(Path(__file__).with_name("compile_kernels.py"))
        compiling = [subprocess.Popen([sys.executable, script, half]) for half in ("polygons", "maps")]
        assert [process.wait() for process in compiling] == [0, 0]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Tests of a file share its fixtures, so they share a process; pages of the docs take longest and may be apart."""
    for item in items:
        page = item.name[:-1].partition("test_code_blocks_run[")[2]
        item.add_marker(pytest.mark.xdist_group(page or item.nodeid.partition("::")[0]))
    items.sort(key=lambda item: not item.name.startswith("test_code_blocks_run"))  # stable: these first


@pytest.fixture(scope="session")
def released() -> Path:
    """The folder with the NavRep authors' weights, which are not part of the repository."""
    if not (AUTHORS / "models" / "gym").is_dir():
        pytest.skip("needs the authors' weights: let NAVREP_RELEASED_DIR name a checkout of their repository")
    return AUTHORS
