"""Each check of `doctor` can fail, and says what to do."""

import json
import re
import shutil
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from navrep_data.cli import main
from navrep_data.doctor import installation
from navrep_data.doctor.installation import KNOWN_GOOD, NOT_FOR_USERS, check_installation, check_package

ROOT = Path(__file__).parents[2]


@pytest.fixture
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def of(checks, name):
    return next(check for check in checks if check.name == name)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_every_requirement_has_a_known_good_range(project):
    """Of the package's own requirements, none missing, and what the suite runs with is inside."""
    names = {Requirement(line).name.lower() for line in project["dependencies"]}
    assert set(KNOWN_GOOD) == names
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    pinned = {name.lower().replace("_", "-"): version for name, version in pins.items()}
    for name, limit in KNOWN_GOOD.items():
        assert limit.startswith("<")
        assert Version(pinned[name]) < Version(limit[1:]), name
    assert set(NOT_FOR_USERS) >= {"dev", "peers"}
    assert project["requires-python"] == ">={}.{}".format(*installation.PYTHONS[0])
    last = "{}.{}".format(*installation.PYTHONS[1])
    assert f"Programming Language :: Python :: {last}" in project["classifiers"]


@pytest.mark.slow
def test_this_installation_is_well(monkeypatch, home):
    checks = check_installation()
    assert [check for check in checks if check.status == "problem"] == []
    names = [check.name for check in checks]
    assert names[:2] == ["python", "navrep-data"]
    assert {"numpy", "numba", "torch", "kernels", "cache", "disk (here)", "disk (cache)", "[maps]"} <= set(names)
    assert re.fullmatch(r"\d+ maps", of(checks, "[maps]").what)


def test_versions(monkeypatch):
    assert check_package(Requirement("numpy>=2.0")).status == "ok"
    old = check_package(Requirement("numpy>=99"))
    assert (old.status, old.what.split(", ")[1]) == ("problem", "expected >=99: pip install 'numpy>=99'")
    gone = check_package(Requirement("no-such-package>=1"))
    assert gone.status == "problem"
    assert "is not installed, expected >=1: pip install no-such-package" in gone.what
    monkeypatch.setitem(KNOWN_GOOD, "numpy", "<2")
    new = check_package(Requirement("numpy>=1"))
    assert new.status == "note"
    assert "newer than what was tried (<2)" in new.what


def test_a_package_that_is_broken(monkeypatch):
    monkeypatch.setattr(installation, "_requirements", lambda extra: [Requirement("h5py>=3")])
    real = installation.importlib.import_module

    def broken(name):
        if name == "h5py":
            raise OSError("libhdf5.so: cannot open\nshared object file")
        return real(name)

    monkeypatch.setattr(installation.importlib, "import_module", broken)
    check = of(installation._packages(), "h5py")
    assert check.status == "problem"
    assert (
        "cannot be imported (libhdf5.so: cannot open shared object file): pip install --force-reinstall" in check.what
    )


def test_pythons(monkeypatch):
    for seen, status in (("3.10.1", "problem"), ("3.11.0", "ok"), ("3.99.0", "note")):
        monkeypatch.setattr(installation.platform, "python_version", lambda seen=seen: seen)
        monkeypatch.setattr(installation.platform, "python_version_tuple", lambda seen=seen: tuple(seen.split(".")))
        assert next(installation._python()).status == status


def test_kernels_cold_warm_and_without_a_place(monkeypatch, tmp_path):
    folder = tmp_path / "kernels"
    monkeypatch.setattr("navrep_data.kernels.kernel_cache_folder", lambda: folder)
    assert next(installation._kernels()).status == "note"
    (folder / "x").mkdir()
    (folder / "x" / "f.nbi").touch()
    warm = next(installation._kernels())
    assert (warm.status, warm.what) == ("ok", f"1 compiled in {folder}")
    monkeypatch.setattr("navrep_data.kernels.kernel_cache_folder", lambda: Path("/proc/nowhere"))
    place = next(installation._kernels())
    assert place.status == "problem"
    assert "set NAVREP_DATA_HOME" in place.what


def test_kernels_that_err_or_are_switched_off(monkeypatch):
    import numpy as np

    monkeypatch.setattr("navrep_data.observations.scan_to_rings", lambda scan: np.zeros((1, 64, 64), np.uint8))
    wrong = next(installation._kernels())
    assert (wrong.status, "wrong result" in wrong.what) == ("problem", True)
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    off = next(installation._kernels())
    assert (off.status, "NUMBA_DISABLE_JIT" in off.what) == ("note", True)


def test_cache_folder(home, monkeypatch):
    check = next(installation._cache())
    assert (check.status, check.what) == ("ok", f"{home}, 0.0 MB")
    (home / "x").write_bytes(bytes(2_000_000))
    assert next(installation._cache()).what == f"{home}, 2.0 MB"
    monkeypatch.setenv("NAVREP_DATA_HOME", "/proc/nowhere")
    check = next(installation._cache())
    assert check.status == "problem"
    assert "set NAVREP_DATA_HOME to a folder that you may write" in check.what


def test_disk(monkeypatch, home):
    for free, status in ((5 << 30, "ok"), (1 << 30, "note"), (1 << 20, "problem")):
        usage = type(shutil.disk_usage("/"))(1 << 40, 0, free)
        monkeypatch.setattr(installation.shutil, "disk_usage", lambda path, usage=usage: usage)
        assert [check.status for check in installation._disk()] == [status] * 2


def test_optional_parts(monkeypatch):
    lines = ["here>=1; extra == 'one'", "gone>=1; extra == 'two'", "old>=9; extra == 'three'", "plain>=1"]
    versions = {"here": "1.5", "old": "3.0", "plain": "1"}

    def version(name):
        try:
            return versions[name]
        except KeyError:
            raise metadata.PackageNotFoundError(name) from None

    class Extras:
        def get_all(self, name):
            return ["one", "two", "three", "dev"]

    monkeypatch.setattr(installation.importlib.metadata, "requires", lambda name: lines)
    monkeypatch.setattr(installation.importlib.metadata, "version", version)
    monkeypatch.setattr(installation.importlib.metadata, "metadata", lambda name: Extras())
    found = {check.name: (check.status, check.what) for check in installation._optional()}
    assert found == {
        "[one]": ("ok", "here 1.5"),
        "[two]": ("note", "not installed (gone): pip install 'navrep-data[two]'"),
        "[three]": ("problem", "old 3.0, expected >=9: pip install 'old>=9'"),
    }


def test_maps_that_are_broken(monkeypatch):
    def broken(name):
        raise ValueError("cut off")

    monkeypatch.setattr("navrep_data.sim.maps.load_map", broken)
    for name in ("_python", "_packages", "_kernels", "_cache", "_disk", "_network"):
        monkeypatch.setattr(installation, name, list)
    (check,) = [c for c in check_installation() if c.status == "problem"]
    assert (check.name, check.what) == ("optional parts", "could not be checked: ValueError: cut off")


def test_offline_is_told(monkeypatch):
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    (check,) = installation._network()
    assert (check.status, "switched off by NAVREP_DATA_OFFLINE" in check.what) == ("note", True)


@pytest.mark.slow
def test_the_command(monkeypatch, capsys):
    ok, bad = installation.Finding("a", "ok", "1.0"), installation.Finding("b", "problem", "is gone: get it")
    for checks, code, last in (([ok], 0, "all well"), ([ok, bad], 1, "1 problems")):
        monkeypatch.setattr("navrep_data.doctor.check_installation", lambda checks=checks: checks)
        with pytest.raises(SystemExit) as ended:
            main.run(["doctor"])
        out = capsys.readouterr().out
        assert (ended.value.code, out.splitlines()[-1]) == (code, last)
        with pytest.raises(SystemExit) as ended:
            main.run(["doctor", "--json"])
        found = json.loads(capsys.readouterr().out)
        assert (ended.value.code, found["ok"], len(found["checks"])) == (code, code == 0, len(checks))
