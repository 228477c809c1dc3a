"""Generate a dataset: plan, simulate, publish, list."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, DatasetMismatchError, check_whole
from navrep_data.generate.executors import EXECUTORS, LocalExecutor, RayExecutor
from navrep_data.generate.inputs import named_from
from navrep_data.generate.parts import Part, parse_part
from navrep_data.generate.plan import Request, check_folder, check_same, check_settings, make_request
from navrep_data.generate.policy import make_policy
from navrep_data.generate.run import Run, Say, silent
from navrep_data.generate.storage import check_url
from navrep_data.generate.worker import DatasetSpec
from navrep_data.io import translate_os_error
from navrep_data.policies import AnyPolicy
from navrep_data.shards import MANIFEST_FILE, Manifest, writer_lock
from navrep_data.sim import check_seed, make_config

MAX_WORKERS = 256


@dataclass(frozen=True)
class GenerateResult:
    """What a run of :func:`generate` made.

    Attributes
    ----------
    root : str
        Dataset folder.
    rows, sequences, shards, bytes : int
        Of the whole dataset, also of what was there before.
    new_rows : int
        Rows made by this run.
    seconds : float
        Wall time of making them: simulate, compress, hash, write, start workers [s].
    rows_per_s : float
        `new_rows` / `seconds`.
    setup_seconds : float
        Wall time before that: imports, and compiling kernels where they are not cached [s].
    outcomes : dict of str to int
        Episodes by event, of the whole dataset.
    part : str or None
        ``i/n`` of a part, whose sizes these then are.
    """

    root: str
    rows: int
    sequences: int
    shards: int
    bytes: int
    new_rows: int
    seconds: float
    rows_per_s: float
    setup_seconds: float
    outcomes: dict[str, int] = field(default_factory=dict)
    part: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON values."""
        return asdict(self)


def generate(
    env: str = "soadrl",
    n: int = 100,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    workers: int | None = None,
    length: int = 1000,
    physics: str | None = None,
    humans: int | None = None,
    obstacles: int | None = None,
    legs: bool = True,
    maps: Sequence[str] | None = None,
    policy: AnyPolicy = "orca",
    policy_batch: int = 64,
    shard_size: int | None = None,
    scan_dtype: str | None = None,
    rings: bool = True,
    humans_column: bool = True,
    labels: bool = False,
    executor: str = "local",
    address: str | None = None,
    storage: str | None = None,
    shard_range: str | None = None,
    progress: bool = False,
    report: Callable[[str], None] | None = None,
) -> GenerateResult:
    """Generate a dataset, go on with an unfinished one, or extend a finished one.

    Parameters
    ----------
    env : str
        Environment name, see :func:`navrep_data.sim.environment_names`.
    n : int
        Number of sequences.
    out : path-like, optional
        Dataset folder; ``data/<env>`` by default.
    seed : int
        Dataset seed, 0 to 2**63 - 1. Sequence i is a function of (seed, i) and the settings alone.
    workers : int, optional
        Worker processes, 1 by default. With more than one, call this from a script guarded by
        ``if __name__ == "__main__":``. On Ray: most tasks at the same time, by default all that the cluster takes.
    length : int
        Rows per sequence.
    physics : str, optional
        ``"consistent"`` by default.
    humans : int, optional
        Mean number of humans.
    maps : sequence of str, optional
        Names or paths of the maps, for ``env="map"``.
    obstacles : int, optional
        Largest number of squares, and of walls.
    legs : bool
        Whether the lidar sees legs; otherwise trunks.
    policy : str, callable or BasePolicy
        ``"orca"``, another scripted name, or what :func:`navrep_data.policies.resolve_policy` takes: ``"dwa"``, a name
        of the zoo, ``"./folder"``, ``"module:function"``, a callable
        ``policy(scan (B, n_rays) [m], robot_state (B, 5)) -> action (B, 3) or (B, 2)`` in [-1, 1], shares of the
        robot's largest velocities.
    policy_batch : int
        Batch size that functions and networks always see.
    shard_size : int, optional
        Sequences per shard; about 20,000 rows by default.
    scan_dtype : {"uint16", "float32"}, optional
        Millimetres or metres; uint16 where the range fits.
    rings, humans_column, labels : bool
        Whether to store these columns (labels: ``scan_label``, what each ray hit).
    executor : {"local", "ray"}
        Where shards are made: on this machine, or as tasks of a Ray cluster (needs the extra ``ray``).
    address : str, optional
        The Ray cluster's ``host:port``, or ``auto``; by default ``RAY_ADDRESS``, or a cluster on this machine alone.
    storage : str, optional
        URL that fsspec can write, such as ``s3://bucket/name``: shards go there, `out` keeps the manifest, and a
        copy of it goes there at the end.
    shard_range : str, optional
        ``"i/n"``: make only the i-th of n parts (i from 0), to be joined by :func:`merge_manifest`.
    progress : bool
        Whether to show a bar on stderr.
    report : callable, optional
        Receives lines of text: the plan, a notice while kernels compile, what was found unfinished.

    Returns
    -------
    GenerateResult
        Sizes, speed and outcomes.

    Raises
    ------
    UnknownNameError, ConfigError, PolicyError
        If a setting cannot be used.
    FolderInUseError, FolderNotWritableError, DatasetLockedError, DiskSpaceError
        If the folder cannot be used.
    MissingExtraError, ClusterError
        If there is no Ray, or no cluster at the address.
    DatasetMismatchError
        If the folder holds a dataset made with other settings, or more sequences than `n`.

    Notes
    -----
    Source of the recipe: make_vae_dataset.py of the original. Difference: rows follow RLDS, with each episode's first
    observation and the action taken from it.
    """
    say = report or silent
    started = time.perf_counter()
    config = make_config(
        env, physics=physics, humans=humans, obstacles=obstacles, rendering=None if legs else "trunk",
        curriculum="constant", maps=None if maps is None else tuple(maps),
    )  # fmt: skip
    env = config.env  # in the spelling that is stored
    seed = check_seed(seed)
    part = _check_place(executor, address, storage, shard_range)
    if workers is not None:
        workers = check_whole("--workers", workers, 1, MAX_WORKERS)
    chosen = make_policy(policy, policy_batch)
    if chosen.spec is not None:
        chosen.spec.make(chosen.batch)  # fail here, not in a worker
    root = Path(out) if out is not None else Path("data") / env
    if executor != "local":
        root = root.absolute()  # workers elsewhere have other working folders
    config = named_from(config, root)
    settings = check_settings(config, length, scan_dtype, rings, humans_column, labels)
    request = make_request(root, config, settings, chosen, seed, n, shard_size, storage, part)
    request = replace(
        request, command=_command(request, env, physics, humans, obstacles, legs, maps, shard_size, scan_dtype)
    )

    def make_executor(spec: DatasetSpec, tasks: int) -> LocalExecutor | RayExecutor:
        if executor == "ray":
            return RayExecutor(spec, None if workers is None else min(workers, tasks), address, say)
        return LocalExecutor(spec, min(workers or 1, tasks))

    run = _locked(request, say, shard_size is not None, lambda run: run.go(make_executor, progress))
    seconds = max(time.perf_counter() - run.began, 1e-6)
    manifest = run.manifest
    outcomes = manifest.statistics.get("outcomes", {})  # a part may be empty
    return GenerateResult(
        root=str(root),
        rows=manifest.rows,
        sequences=manifest.sequences,
        shards=len(manifest.shards),
        bytes=manifest.bytes,
        new_rows=run.new_rows,
        seconds=round(seconds, 3),
        rows_per_s=round(run.new_rows / seconds, 1),
        setup_seconds=round(run.began - started, 3),
        outcomes={name: o["episodes"] for name, o in outcomes.items()},
        part=None if part is None else str(part),
    )


def _check_place(executor: str, address: str | None, storage: str | None, shard_range: str | None) -> Part | None:
    """Check where to run and where to write; return the part asked for."""
    if executor not in EXECUTORS:
        raise ConfigError(f"--executor is {executor!r}, expected one of: {', '.join(EXECUTORS)}.")
    if address is not None and executor != "ray":
        raise ConfigError(f"--address is {address}, which only Ray needs; expected --executor ray with it.")
    if storage is not None and shard_range is not None:
        raise ConfigError(
            "--shard-range cannot be combined with --storage: jobs of an array need an --out that all of them share."
        )
    if storage is not None:
        check_url(storage)
    return None if shard_range is None else parse_part(shard_range)


def _locked(request: Request, say: Say, explicit_shard_size: bool, go: Callable[[Run], None]) -> Run:
    """Do the run while no other process writes the same manifest; leave no trace of a refused one."""
    root, home = request.spec.root, request.home
    try:
        traces = [path for path in dict.fromkeys((home, home.parent, root)) if not path.exists()]
    except OSError as error:
        raise translate_os_error(error, root) from error
    try:
        check_folder(root, request.part)
        if request.part is not None and (root / MANIFEST_FILE).exists():
            _check_merged(request, explicit_shard_size)
        with writer_lock(home):
            run = Run(request, say, explicit_shard_size=explicit_shard_size)
            go(run)
    except BaseException:
        for path in traces:
            _remove_if_unused(path)
        raise
    return run


def _check_merged(request: Request, explicit_shard_size: bool) -> None:
    """Refuse to make parts of what has been merged: the same job again, or another dataset."""
    merged = Manifest.read(request.spec.root)
    check_same(merged, request, explicit_shard_size)
    raise DatasetMismatchError(
        f"{request.spec.root} is a dataset of {merged.sequences} sequences already, expected a new folder or parts "
        "that are not merged yet; leave --shard-range out to extend it, or choose another --out."
    )


def _command(
    request: Request, env: str, physics: str | None, humans: int | None, obstacles: int | None, legs: bool,
    maps: Sequence[str] | None, shard_size: int | None, scan_dtype: str | None,
) -> str:  # fmt: skip
    """Return the command line that makes the same dataset: for the card."""
    spec = request.spec
    words = ["navrep-data", "generate", "--env", env, "--n", str(request.n), "--seed", str(spec.seed)]
    if spec.settings.length != 1000:
        words += ["--length", str(spec.settings.length)]
    for flag, value in (("--physics", physics), ("--humans", humans), ("--obstacles", obstacles)):
        if value is not None:
            words += [flag, str(value)]
    words += [] if legs else ["--trunk"]
    words += [word for name in maps or () for word in ("--map", name)]
    if spec.policy.name != "orca":
        words += ["--policy", spec.policy.name]
    if spec.policy.spec is not None and spec.policy.batch != 64:
        words += ["--policy-batch", str(spec.policy.batch)]
    for flag, value in (("--shard-size", shard_size), ("--scan-dtype", scan_dtype)):
        if value is not None:
            words += [flag, str(value)]
    words += ["--labels"] if spec.settings.labels else []
    words += [] if spec.settings.rings else ["--no-rings"]
    words += [] if spec.settings.humans or not spec.config.max_others else ["--no-humans-column"]
    return shlex.join(words)


def _remove_if_unused(root: Path) -> None:
    """Remove a folder that this run made and left without a dataset, so that a refused run leaves no trace."""
    if root.is_dir() and not (root / MANIFEST_FILE).exists():
        for path in root.iterdir():
            if path.is_file() and path.name.startswith("."):
                path.unlink(missing_ok=True)
        if not any(root.iterdir()):
            root.rmdir()
