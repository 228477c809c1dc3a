"""Check that files of the zoo are the right ones, load, and compute what the original software computed.

Notes
-----
Golden files hold outputs of TensorFlow 1.13, stable-baselines 2.10 and the authors' torch classes. The package has a
few rows of them (:mod:`navrep_data.zoo.golden`), and outputs of its own for checkpoints of which there is nothing else.
Verification reads what is on this machine and never asks the network.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, CorruptDataError, NavrepDataError
from navrep_data.io import raise_refusal
from navrep_data.io.npz import read_npz
from navrep_data.zoo.fetching import Source, locate, missing_here
from navrep_data.zoo.names import WILDCARDS
from navrep_data.zoo.registry import Record, find, list_models, records, variants

# The largest golden file has 1 MB.
_MAX_GOLDEN_BYTES = 256 << 20


@dataclass(frozen=True)
class Comparison:
    """One golden output beside ours.

    Attributes
    ----------
    file, output : str
        Golden file and what was compared.
    error, tolerance : float
        Largest absolute difference, and the largest allowed.
    original : bool
        Whether the original software computed the golden output; this package did otherwise, when the checkpoint was
        added to it.
    """

    file: str
    output: str
    error: float
    tolerance: float
    original: bool = True

    @property
    def ok(self) -> bool:
        """Whether the difference is allowed (NaN is not)."""
        return self.error <= self.tolerance


@dataclass(frozen=True)
class Check:
    """What verification found of one checkpoint.

    Attributes
    ----------
    name : str
        Full name.
    status : str
        ``ok``, ``missing`` (no file here) or ``wrong``.
    problems : tuple of str
        What is missing or wrong.
    missing : tuple of dict
        Files not on this machine: path, bytes, sha256, git_blob_sha1.
    needs : tuple of str
        Names of parts, not on this machine, without which a policy cannot run.
    comparisons : tuple of Comparison
        Golden outputs compared.
    not_compared : tuple of str
        Golden files that were not in the folder.
    """

    name: str
    status: str
    problems: tuple[str, ...] = ()
    missing: tuple[dict[str, Any], ...] = ()
    needs: tuple[str, ...] = ()
    comparisons: tuple[Comparison, ...] = ()
    not_compared: tuple[str, ...] = ()


_COUNTED = {"right": "ok", "missing": "missing", "wrong": "wrong"}


@dataclass(frozen=True)
class Report:
    """What verification found of all checkpoints asked for."""

    checks: tuple[Check, ...]

    def having(self, status: str) -> list[Check]:
        """Return the checks with a status."""
        return [check for check in self.checks if check.status == status]

    @property
    def ok(self) -> bool:
        """Whether nothing that is here is wrong; what is missing is told apart."""
        return not self.having("wrong")

    @property
    def cannot_run(self) -> list[str]:
        """Full names of the policies asked for that cannot run here."""
        every = records()
        return [c.name for c in self.checks if c.needs or (every[c.name].kind == "controller")]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON values."""
        counts = {word: len(self.having(status)) for word, status in _COUNTED.items()}
        checks = [asdict(check) for check in self.checks]
        return {"ok": self.ok, **counts, "cannot_run": self.cannot_run, "checks": checks}


def verify(
    pattern: str = "*",
    golden: str | os.PathLike[str] | None = None,
    source: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Check hashes of checkpoints, load them, and compare their outputs with those that the package holds.

    Parameters
    ----------
    pattern : str
        Name, variant or wildcards; default all.
    golden : path-like, optional
        Folder with more golden outputs of the original software, which are compared, too.
    source : path-like or str, optional
        Folder with the authors' files, looked in before the cache.
    progress : callable, optional
        Called with (done, total).

    Returns
    -------
    Report

    Raises
    ------
    UnknownNameError
        If there is no such name.
    ConfigError
        If a folder does not exist.
    """
    where = Source.of(source)
    folder = None if golden is None else Path(golden).expanduser()
    if folder is not None and not folder.is_dir():
        raise ConfigError(f"golden is {str(golden)!r}, expected a folder with golden outputs (*.npz): check it.")
    chosen = [r for r in _chosen(pattern) if r.is_checkpoint]
    checks = []
    for done, record in enumerate(chosen):
        if progress is not None:
            progress(done, len(chosen))
        checks.append(_check(record, where, folder))
    if progress is not None:
        progress(len(chosen), len(chosen))
    return Report(tuple(checks))


def _chosen(pattern: str) -> Iterable[Record]:
    """Return the records behind a pattern once each; a world model without files of its own stands for its parts."""
    if any(c in pattern for c in WILDCARDS) or pattern in variants():
        found = {find(name).name: find(name) for name in list_models(pattern)}
    else:
        found = {find(pattern).name: find(pattern)}
    for record in list(found.values()):
        if not record.is_checkpoint:
            found |= {name: records()[name] for name in record.parts.values()}
    return found.values()


def _check(record: Record, where: Source, golden: Path | None) -> Check:
    problems, missing = [], []
    path = None
    for entry in record.files:
        path, wrong = locate(entry, where)
        if path is None:
            missing.append(asdict(entry))
            where_not = "is not in this package: reinstall navrep-data" if entry.packaged else where.lacks()
            problems.append(f"{entry.path} ({entry.id}) {where_not}")
        elif wrong is not None:
            problems.append(f"{path} has {wrong}")
    needs = tuple(dict.fromkeys(part.name for part, _ in missing_here(record, where) if part != record))
    if missing or problems:
        status = "wrong" if len(problems) > len(missing) else "missing"
        return Check(record.name, status, tuple(problems), tuple(missing), needs)
    assert path is not None
    comparisons: list[Comparison] = []
    absent: list[str] = []
    try:
        module = open_alone(record, path)
        comparisons += compare_compact(record, module)
        for name in record.golden if golden is not None else ():
            assert golden is not None
            if (golden / name).is_file():
                comparisons += _compare(record, module, golden / name, where, needs)
            else:
                absent.append(name)
    except NavrepDataError as error:
        problems.append(f"{path}: {error}")
    problems += [
        f"{c.file}: {c.output} differs by {c.error:.3g}, expected at most {c.tolerance:.3g}"
        for c in comparisons
        if not c.ok
    ]
    status = "wrong" if problems else "ok"
    return Check(record.name, status, tuple(problems), (), needs, tuple(comparisons), tuple(absent))


def open_alone(record: Record, path: Path) -> Any:
    """Return the network in one checked file, without its parts.

    Parameters
    ----------
    record : Record
        Which checkpoint.
    path : pathlib.Path
        Its file.

    Raises
    ------
    CheckpointError
        If the file cannot be read, or the network has another size than the record says.
    """
    from navrep_data.errors import CheckpointError
    from navrep_data.models.vae import n_parameters
    from navrep_data.zoo import importers

    module: Any
    if record.format == "sb2-zip":
        module = importers.load_controller_zip(path)
    elif record.format == "safetensors":
        from navrep_data.models import checkpoint

        module = checkpoint.load(path)
    elif record.format == "torch-state-dict":
        module = importers.load_torch_world_model(path)
    else:
        kind = "memory" if record.kind == "memory" else f"vae_{record.lidar}"
        module = importers.load_tf_json(path, kind)
    count = n_parameters(module)
    if count != record.n_parameters:
        raise CheckpointError(
            f"{path} holds {count:,} numbers, expected {record.n_parameters:,} for {record.name}: get it again."
        )
    return module.eval()


def _compare(record: Record, module: Any, path: Path, where: Source, needs: tuple[str, ...]) -> list[Comparison]:
    from navrep_data.zoo import golden as outputs_of

    arrays = _arrays(path)
    if path.name.startswith("encoder_"):
        # from raw scans on, so the whole policy with its parts
        outputs = [] if needs else outputs_of.policy_outputs(record, _load_from(record, where), arrays)
        own = path.with_name(record.golden[0])
        if not needs and own != path and own.is_file():
            outputs += outputs_of.fed_controller_outputs(record, module, arrays, _arrays(own))
    elif record.format == "sb2-zip":
        outputs = outputs_of.controller_outputs(module, arrays)
    elif record.kind == "vae":
        outputs = outputs_of.vae_outputs(module, arrays)
    else:
        outputs = outputs_of.world_model_outputs(module, arrays)
    return [Comparison(path.name, *output) for output in outputs]


def compare_compact(record: Record, module: Any) -> list[Comparison]:
    """Compare a network's outputs with the few that the package holds of it.

    Parameters
    ----------
    record : Record
        Which checkpoint.
    module : torch.nn.Module
        Its network, as :func:`open_alone` gives it.
    """
    from navrep_data.zoo import golden as outputs_of

    path = outputs_of.COMPACT / f"{record.name}.npz"
    if not path.is_file():
        return []
    arrays = _arrays(path)
    if record.kind == "vae":
        outputs = outputs_of.vae_outputs(module, arrays, compact=True)
    elif record.kind == "world_model":
        outputs = outputs_of.world_model_outputs(module, arrays, compact=True)
    else:
        outputs = outputs_of.controller_outputs(module, arrays)
    found = [Comparison(path.name, *output, bool(arrays["original"])) for output in outputs]
    return [*found, Comparison(path.name, *outputs_of.weights_output(module, arrays), False)]


def _arrays(path: Path) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            return read_npz(file, _MAX_GOLDEN_BYTES)
    except (OSError, ValueError) as error:
        raise_refusal(error, path)
        raise CorruptDataError(f"{path} is no npz file ({error}): get the golden outputs again.") from error


def _load_from(record: Record, where: Source) -> Any:
    from navrep_data.zoo import load

    return load(record.name, where.folder)
