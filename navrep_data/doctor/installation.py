"""What this package needs to run here: versions, compiled kernels, folders, disk, optional parts."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from packaging.requirements import Requirement
from packaging.version import Version

from navrep_data._version import __version__
from navrep_data.errors import one_line
from navrep_data.io import cache_dir

DISTRIBUTION = "navrep-data"
Status = Literal["ok", "note", "problem"]

PYTHONS = ((3, 11), (3, 13))
"""First Python that works, and the last one that the suite was run with."""
KNOWN_GOOD: dict[str, str] = {
    "numpy": "<3",
    "numba": "<0.70",
    "scipy": "<2",
    "h5py": "<4",
    "isal": "<2",
    "deflate": "<1",
    "filelock": "<5",
    "fsspec": "<2027",
    "torch": "<3",
    "gymnasium": "<2",
    "stable-baselines3": "<3",
    "huggingface-hub": "<3",
    "httpx2": "<3",
    "safetensors": "<1",
    "tqdm": "<5",
    "typer": "<1",
    "platformdirs": "<5",
    "matplotlib": "<4",
    "pillow": "<14",
    "pyyaml": "<7",
    "packaging": "<27",
}
"""Versions up to which the suite is known to pass; newer ones may work. The least ones are the package's own."""
NOT_FOR_USERS = ("dev", "peers", "docs")
"""Extras for work on this package itself."""
MODULES = {"pillow": "PIL", "pyyaml": "yaml", "asl-pepper-2d-sim": "asl_pepper_2d_sim_maps"}
"""What is imported of a distribution whose module has another name."""
MIN_FREE_BYTES = 100 << 20
COMFORTABLE_BYTES = 2 << 30
"""A dataset of a million rows takes 1.7 GB."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes
    ----------
    name : str
        What.
    status : {"ok", "note", "problem"}
        A note is worth knowing and stops nothing.
    what : str
        One line: what was seen and, unless it is ok, what to do.
    """

    name: str
    status: Status
    what: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "what", one_line(self.what))


def check_installation(*, progress: Callable[[str], None] | None = None) -> list[Finding]:
    """Check this installation.

    Parameters
    ----------
    progress : callable, optional
        Called with the name of each check before it is made; some take seconds.

    Returns
    -------
    list of Finding
        In the order in which they were made; a problem never stops the others.
    """
    found: list[Finding] = []
    for name, make in (
        ("python", _python),
        ("packages", _packages),
        ("kernels", _kernels),
        ("cache", _cache),
        ("disk", _disk),
        ("optional parts", _optional),
        ("network", _network),
    ):
        if progress is not None:
            progress(name)
        try:
            found += make()
        except Exception as error:  # what is broken here may raise anything, and that is what we came to tell
            found.append(Finding(name, "problem", f"could not be checked: {type(error).__name__}: {error}"))
    return found


def _python() -> Iterator[Finding]:
    version = platform.python_version_tuple()
    seen = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    first, last = PYTHONS
    here = (int(version[0]), int(version[1]))
    if here < first:
        yield Finding("python", "problem", f"{seen}, expected {first[0]}.{first[1]} or newer: make a new environment")
    elif here > last:
        yield Finding("python", "note", f"{seen}, newer than {last[0]}.{last[1]}, the last one that was tried")
    else:
        yield Finding("python", "ok", seen)


def _packages() -> Iterator[Finding]:
    """Check each package that is needed: there, new enough, not newer than what was tried, and importable."""
    yield Finding("navrep-data", "ok", f"{__version__} in {Path(__file__).parents[1]}")
    for requirement in _requirements(None):
        check = check_package(requirement)
        if check.status != "problem":
            try:
                importlib.import_module(_module(requirement.name))
            except Exception as error:  # a broken binary raises anything
                again = f"pip install --force-reinstall {requirement.name}"
                check = Finding(requirement.name, "problem", f"cannot be imported ({error}): {again}")
        yield check


def _module(distribution: str) -> str:
    return MODULES.get(distribution.lower(), distribution.replace("-", "_").lower())


def _requirements(extra: str | None) -> list[Requirement]:
    """Return what the package (or one of its extras) requires in this Python."""
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:  # a bare checkout on the path
        return [Requirement(name) for name in KNOWN_GOOD] if extra is None else []
    found = []
    for requirement in map(Requirement, lines):
        plain = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": extra or ""})
        if plain if extra is None else wanted and not plain:
            found.append(requirement)
    return found


def check_package(requirement: Requirement) -> Finding:
    """Compare the installed version of a package with what is required and with what was tried.

    Parameters
    ----------
    requirement : packaging.requirements.Requirement
        Name and versions.
    """
    name = requirement.name
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return Finding(
            name, "problem", f"is not installed, expected {requirement.specifier or 'any'}: pip install {name}"
        )
    if not requirement.specifier.contains(version, prereleases=True):
        wanted = f"{name}{requirement.specifier}"
        return Finding(name, "problem", f"{version}, expected {requirement.specifier}: pip install '{wanted}'")
    limit = KNOWN_GOOD.get(name.lower())
    if limit is not None and Version(version) >= Version(limit.removeprefix("<")):
        return Finding(
            name, "note", f"{version}, newer than what was tried ({limit}); if something fails, try an older one"
        )
    return Finding(name, "ok", version)


def _kernels() -> Iterator[Finding]:
    """Check that kernels compile, and that they are kept for the next process."""
    import numba
    import numpy as np

    from navrep_data.kernels import kernel_cache_folder
    from navrep_data.observations import scan_to_rings

    config: Any = numba.config  # untyped: its switches are set dynamically
    if config.DISABLE_JIT:
        yield Finding(
            "kernels", "note", "NUMBA_DISABLE_JIT is set: all runs as plain Python, 100 times slower; unset it"
        )
        return
    folder = kernel_cache_folder()
    warm = sum(1 for _ in folder.glob("**/*.nbi"))  # before our own kernel below is compiled into it
    rings = scan_to_rings(np.full((1, 1080), 5.0, np.float32))
    if rings.shape != (1, 64, 64) or not (rings == 2).any():
        yield Finding("kernels", "problem", "a compiled kernel gave a wrong result: reinstall numba and llvmlite")
        return
    problem = _not_writable(folder)
    if problem:
        yield Finding(
            "kernels", "problem",
            f"work, but cannot be kept in {folder} ({problem}): every process compiles for half a minute; set "
            "NAVREP_DATA_HOME to a folder that you may write",
        )  # fmt: skip
    elif not warm:
        yield Finding(
            "kernels", "note", f"work; not compiled yet in {folder}: the first run takes half a minute longer"
        )
    else:
        yield Finding("kernels", "ok", f"{warm} compiled in {folder}")


def _not_writable(folder: Path) -> str:
    """Return why nothing can be written into `folder`, which is made if missing, or an empty string."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".doctor-"):
            return ""
    except OSError as error:
        return error.strerror or type(error).__name__


def _cache() -> Iterator[Finding]:
    folder = cache_dir()
    problem = _not_writable(folder)
    if problem:
        advice = "change its permissions, or set NAVREP_DATA_HOME to a folder that you may write"
        yield Finding("cache", "problem", f"{folder} cannot be written ({problem}): {advice}")
        return
    taken = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    yield Finding("cache", "ok", f"{folder}, {taken / 1e6:,.1f} MB")


def _disk() -> Iterator[Finding]:
    for name, folder in (("here", Path.cwd()), ("cache", cache_dir())):
        while not folder.exists():
            folder = folder.parent
        free = shutil.disk_usage(folder).free
        seen = f"{free / 1e9:,.1f} GB free in {folder}"
        if free < MIN_FREE_BYTES:
            yield Finding(f"disk ({name})", "problem", f"{seen}: too little to write anything; free some")
        elif free < COMFORTABLE_BYTES:
            yield Finding(f"disk ({name})", "note", f"{seen}; a million rows take 1.7 GB")
        else:
            yield Finding(f"disk ({name})", "ok", seen)


def _optional() -> Iterator[Finding]:
    """Say of each optional part whether it is there; one that is there must work."""
    try:
        extras = importlib.metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or []
    except importlib.metadata.PackageNotFoundError:
        extras = []
    for extra in sorted(set(extras) - set(NOT_FOR_USERS)):
        checks = [check_package(requirement) for requirement in _requirements(extra)]
        if not checks:
            yield Finding(f"[{extra}]", "note", "is not for this Python")
            continue
        missing = [check.name for check in checks if "is not installed" in check.what]
        wrong = [f"{check.name} {check.what}" for check in checks if check.status == "problem"]
        if missing:
            yield Finding(
                f"[{extra}]", "note", f"not installed ({', '.join(missing)}): pip install 'navrep-data[{extra}]'"
            )
        elif wrong:
            yield Finding(f"[{extra}]", "problem", "; ".join(wrong))
        elif extra == "maps":
            yield _maps()
        else:
            yield Finding(f"[{extra}]", "ok", ", ".join(f"{check.name} {check.what}" for check in checks))


def _maps() -> Finding:
    from navrep_data.sim.maps import load_map, map_names

    names = map_names()
    load_map("asl")
    return Finding("[maps]", "ok", f"{len(names)} maps")


def _network() -> Iterator[Finding]:
    from navrep_data.io import is_offline

    if is_offline():
        names = [name for name in ("NAVREP_DATA_OFFLINE", "HF_HUB_OFFLINE") if os.environ.get(name)]
        yield Finding("network", "note", f"switched off by {', '.join(names)}: only what is on this machine is used")
