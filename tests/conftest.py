"""Fixtures for all tests; and no test reaches another machine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# Networks here are small and test processes share the cores: threads that wait for each other would take half of them.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Tests start many processes; where bytecode may not be kept, each of them would compile the package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.path.insert(0, str(Path(__file__).parent / "no_network"))

import hypothesis
import loopback_only
from recorded import AUTHORS

loopback_only.install()

# The same examples at every run, and no limit by the clock: what fails here fails elsewhere, however busy the machine.
# `make fuzz` draws fresh ones, with settings of its own.
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("fixed")

PAGES = "test_code_blocks_run["
LONGEST = (
    "test_code_blocks_run[tour", "test_code_blocks_run[README", PAGES, "test_ray.py", "test_push_pull.py",
    "evaluate/test_workers.py", "test_controllers.py", "test_training.py", "test_fuzz.py", "test_generate.py",
)  # fmt: skip


def pytest_sessionstart(session):
    """Where several processes are about to run tests: compile once what each of them would compile."""
    if getattr(session.config.option, "numprocesses", None) and os.environ.get("NUMBA_DISABLE_JIT", "0") == "0":
        script = str(Path(__file__).with_name("compile_kernels.py"))
        compiling = [subprocess.Popen([sys.executable, script, half]) for half in ("polygons", "maps")]
        assert [process.wait() for process in compiling] == [0, 0]


def pytest_collection_modifyitems(items):
    """What takes longest begins first, so that no process is left alone with it in the end."""
    items.sort(key=lambda item: next((k for k, name in enumerate(LONGEST) if name in item.nodeid), len(LONGEST)))


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_make_scheduler(config, log):
    """Let tests of a file share a process, and so its fixtures; pages of the docs may be apart."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return nodeid if PAGES in nodeid else nodeid.partition("::")[0]

    return ByFile(config, log)


@pytest.fixture(scope="session")
def released() -> Path:
    """The folder with the NavRep authors' weights, which are not part of the repository."""
    if not (AUTHORS / "models" / "gym").is_dir():
        pytest.skip("needs the authors' weights: let NAVREP_RELEASED_DIR name a checkout of their repository")
    return AUTHORS


@pytest.fixture
def maps() -> list[str]:
    """The names of the paper's maps, which an extra installs."""
    from navrep_data.errors import MissingExtraError
    from navrep_data.sim import map_names

    try:
        return map_names()
    except MissingExtraError as missing:
        pytest.skip(str(missing))
