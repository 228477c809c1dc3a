"""Generate a dataset: plan, simulate, publish, list."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from navrep_data.errors import CorruptDataError, DatasetError, NavrepDataError
from navrep_data.generate.executors import LocalExecutor
from navrep_data.generate.plan import (
    Request,
    check_count,
    check_folder,
    check_same,
    check_settings,
    check_space,
    make_request,
    new_manifest,
    versions,
)
from navrep_data.generate.policy import load_callable, make_policy
from navrep_data.generate.worker import STAGING, ShardTask, seconds_per_row
from navrep_data.io import PART_SUFFIX, sha256_file, translate_os_error
from navrep_data.shards import (
    MANIFEST_FILE,
    Manifest,
    ShardEntry,
    ShardRecipe,
    dataset_card,
    read_recipe,
    writer_lock,
)
from navrep_data.sim import PolicyFunction, check_seed, make_config

MAX_WORKERS = 256
# The manifest is rewritten whole: not more often than this, nor so often that writing it takes 5 % of the time.
MANIFEST_SECONDS = 0.5
MANIFEST_SHARE = 0.05
# On resume the newest finished shards are hashed again: what a power cut may have damaged.
RECHECKED_SHARDS = 8
COMPILE_NOTICE_SECONDS = 3.0


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

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON values."""
        return asdict(self)


def generate(
    env: str = "soadrl",
    n: int = 100,
    out: str | os.PathLike[str] | None = None,
    seed: int = 0,
    workers: int = 1,
    length: int = 1000,
    physics: str | None = None,
    humans: int | None = None,
    obstacles: int | None = None,
    legs: bool = True,
    maps: Sequence[str] | None = None,
    policy: str | PolicyFunction = "orca",
    policy_batch: int = 64,
    shard_size: int | None = None,
    scan_dtype: str | None = None,
    rings: bool = True,
    humans_column: bool = True,
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
    workers : int
        Worker processes. With more than one, call this from a script guarded by ``if __name__ == "__main__":``.
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
    policy : str or callable
        ``"orca"``, another scripted name, ``"module:function"``, or a callable
        ``policy(scan (B, rays) [m], robot_state (B, 5)) -> action (B, 3) or (B, 2)`` [m/s, m/s, rad/s].
    policy_batch : int
        Batch size that a Python policy always sees.
    shard_size : int, optional
        Sequences per shard; about 20,000 rows by default.
    scan_dtype : {"uint16", "float32"}, optional
        Millimetres or metres; uint16 where the range fits.
    rings, humans_column : bool
        Whether to store these columns.
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
    DatasetMismatchError
        If the folder holds a dataset made with other settings, or more sequences than `n`.

    Notes
    -----
    Source of the recipe: make_vae_dataset.py of the original. Difference: rows follow RLDS, with each episode's first
    observation and the action taken from it.
    """
    say = report or _silent
    started = time.perf_counter()
    config = make_config(
        env, physics=physics, humans=humans, obstacles=obstacles, rendering=None if legs else "trunk",
        curriculum="constant", maps=None if maps is None else tuple(maps),
    )  # fmt: skip
    check_seed(seed)
    check_count("workers", workers, 1, MAX_WORKERS)
    chosen = make_policy(policy, policy_batch)
    if not chosen.scripted and chosen.function is None:
        load_callable(chosen.name)  # fail here, not in a worker
    root = Path(out) if out is not None else Path("data") / env
    settings = check_settings(config, length, scan_dtype, rings, humans_column)
    request = make_request(root, config, settings, chosen, seed, n, shard_size, "")
    request = replace(
        request, command=_command(request, env, physics, humans, obstacles, legs, maps, shard_size, scan_dtype)
    )
    try:
        existed = root.exists()
    except OSError as error:
        raise translate_os_error(error, root) from error
    try:
        check_folder(root)
        with writer_lock(root):
            run = _Run(request, say, explicit_shard_size=shard_size is not None)
            run.go(workers, progress)
    except BaseException:
        if not existed:
            _remove_if_unused(root)
        raise
    seconds = max(time.perf_counter() - run.began, 1e-6)
    manifest = run.manifest
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
        outcomes={name: o["episodes"] for name, o in manifest.statistics["outcomes"].items()},
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
    if not spec.policy.scripted and spec.policy.batch != 64:
        words += ["--policy-batch", str(spec.policy.batch)]
    for flag, value in (("--shard-size", shard_size), ("--scan-dtype", scan_dtype)):
        if value is not None:
            words += [flag, str(value)]
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


class _Run:
    """One run over a locked folder."""

    def __init__(self, request: Request, say: Callable[[str], None], *, explicit_shard_size: bool) -> None:
        self.request = request
        self.root = request.spec.root
        self.say = say
        self.new_rows = 0
        self.began = time.perf_counter()
        self._saved_at = 0.0
        self._save_seconds = 0.0
        self._unsaved = False
        if (self.root / MANIFEST_FILE).exists():
            self.manifest = self._resume(explicit_shard_size)
        else:
            self.manifest = new_manifest(request)
        self._entries = {entry.sequences: entry for entry in self.manifest.shards}

    def _resume(self, explicit_shard_size: bool) -> Manifest:
        try:
            old = Manifest.read(self.root)
        except CorruptDataError as error:
            return self._start_over(error)
        check_same(old, self.request, explicit_shard_size)
        if old.versions != versions():
            changed = [f"{k} {old.versions.get(k)} -> {v}" for k, v in versions().items() if old.versions.get(k) != v]
            self.say(
                f"Note: made with other versions ({', '.join(changed)}); new shards may differ in their last digits."
            )
        kept = tuple(
            e for k, e in enumerate(old.shards) if self._intact(e, hashed=k >= len(old.shards) - RECHECKED_SHARDS)
        )
        return replace(old, shards=kept, planned=self.request.n, command=self.request.command, complete=False)

    def _start_over(self, error: CorruptDataError) -> Manifest:
        """Return an empty manifest for a dataset whose own one is lost, if making it again can only restore it.

        Every shard that can still be read must have been made with the settings of this request: then what is
        written over them are their own bytes.
        """
        spec = self.request.spec
        wanted = ShardRecipe(spec.config.env, spec.config.to_dict(), spec.seed, spec.settings.length)
        for path in sorted((self.root / "data").glob("*.h5")):
            try:
                found = read_recipe(path)
            except CorruptDataError:
                continue
            if found != wanted:
                raise error
        self.say(f"{MANIFEST_FILE} is damaged; making the dataset again.")
        return new_manifest(self.request)

    def _intact(self, entry: ShardEntry, *, hashed: bool) -> bool:
        for part in (entry, entry.worlds):
            if part is None:
                continue
            path = self.root / part.file
            try:
                good = path.stat().st_size == part.bytes and (not hashed or sha256_file(path) == part.sha256)
            except OSError:
                good = False
            if not good:
                self.say(f"{part.file} is missing or damaged; making it again.")
                return False
        return True

    def _tasks(self) -> list[ShardTask]:
        """Return the shards still to be made; one that replaces a listed, shorter one is staged."""
        size, n = self.manifest.shard_size, self.request.n
        starts = {entry.sequences[0] for entry in self._entries.values()}
        tasks = []
        for index, first in enumerate(range(0, n, size)):
            stop = min(first + size, n)
            if (first, stop) not in self._entries:
                tasks.append(ShardTask(index, first, stop, staged=first in starts))
        return tasks

    def go(self, workers: int, progress: bool) -> None:
        """Make what is missing and finish the manifest."""
        tasks = self._tasks()
        done_rows = self.manifest.rows
        check_space(self.request, done_rows)
        self._clean_up()
        if not tasks:
            self._finish()
            self.say(f"{self.root} already holds all {self.request.n} sequences; nothing to do.")
            return
        workers = min(workers, len(tasks))
        self._announce(done_rows, workers)
        if self._entries or not (self.root / MANIFEST_FILE).exists():
            self._save()
        self.began = time.perf_counter()
        executor = LocalExecutor(self.request.spec, workers)
        with tqdm(
            total=self.request.rows,
            initial=done_rows,
            unit="rows",
            unit_scale=True,
            disable=not progress,
            smoothing=0.1,
            dynamic_ncols=True,
        ) as bar:
            try:
                for finished in executor.run(tasks):
                    if finished is not None:
                        self._add(*finished)
                    self._save_if_due()
                    bar.update(done_rows + executor.rows_made - bar.n)
            except BaseException:
                with contextlib.suppress(NavrepDataError):  # the disk may be full; the manifest in place is a good one
                    self._save()
                raise
        self._finish()

    def _announce(self, done_rows: int, workers: int) -> None:
        if self.say is _silent:
            return  # the estimate costs a few hundred rows
        r, s = self.request, self.request.spec
        with _Notice(self.say, "Compiling kernels (once, about 30 s)"):
            per_row = seconds_per_row(s) if s.policy.scripted else None
        todo = r.rows - done_rows
        text = f"{r.n} sequences x {s.settings.length} steps = {r.rows:,} rows, about {_size(r.bytes)} in {s.root}"
        if done_rows:
            text += f", {done_rows:,} rows are there already"
        if per_row is not None:
            text += f", about {_duration(todo * per_row / workers)}"
        self.say(f"{text} on {workers} core{'s' if workers > 1 else ''}")

    def _clean_up(self) -> None:
        """Remove what killed processes left behind: temp files and shards that never left staging."""
        shutil.rmtree(self.root / STAGING, ignore_errors=True)
        for folder in (self.root, self.root / "data", self.root / "worlds"):
            for path in folder.glob(f".*{PART_SUFFIX}"):
                path.unlink(missing_ok=True)

    def _add(self, task: ShardTask, entry: ShardEntry) -> None:
        if task.staged:
            self._replace(task, entry)
        self._entries[task.first, task.stop] = entry
        self.new_rows += entry.rows
        self._unsaved = True
        if task.staged:
            self._save()

    def _replace(self, task: ShardTask, entry: ShardEntry) -> None:
        """Put a staged shard in the place of the shorter one that starts at the same sequence."""
        for key in [k for k in self._entries if k[0] == task.first]:
            self.new_rows -= self._entries.pop(key).rows
        self._save()
        for part in (entry.worlds, entry):
            if part is not None:
                os.replace(self.root / STAGING / part.file, self.root / part.file)

    def _save_if_due(self) -> None:
        """List what is finished, unless that was done a moment ago."""
        pause = max(MANIFEST_SECONDS, self._save_seconds / MANIFEST_SHARE)
        if self._unsaved and time.monotonic() - self._saved_at > pause:
            self._save()

    def _save(self) -> None:
        begun = time.monotonic()
        self.manifest = self.manifest.with_shards(self._entries.values(), complete=False).save(self.root)
        self._unsaved = False
        self._saved_at = time.monotonic()
        self._save_seconds = self._saved_at - begun

    def _finish(self) -> None:
        """List everything, write the card, mark the dataset complete."""
        entries: Iterable[ShardEntry] = self._entries.values()
        manifest = self.manifest.with_shards(entries, complete=True)
        if manifest.sequences != self.request.n:
            raise DatasetError(
                f"{self.root} has {manifest.sequences} of {self.request.n} sequences; run the same command again."
            )
        self._clean_up()  # a worker killed in this run left its temp file too
        self.manifest = manifest.save(self.root, dataset_card(manifest))


class _Notice:
    """Say something if the block takes long; numba does not tell beforehand whether it must compile."""

    def __init__(self, say: Callable[[str], None], text: str) -> None:
        self._timer = threading.Timer(COMPILE_NOTICE_SECONDS, say, (text,))
        self._timer.daemon = True

    def __enter__(self) -> None:
        self._timer.start()

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()


def _silent(_: str) -> None:
    """Report to nobody."""


def _size(n_bytes: int) -> str:
    for unit, factor in (("GB", 1e9), ("MB", 1e6)):
        if n_bytes >= factor:
            return f"{n_bytes / factor:.3g} {unit}"
    return f"{max(1, round(n_bytes / 1e3))} kB"


def _duration(seconds: float) -> str:
    if seconds >= 5400:
        return f"{seconds / 3600:.1f} h"
    if seconds >= 90:
        return f"{seconds / 60:.0f} min"
    return f"{max(1, round(seconds))} s"
