"""One run over a dataset's folder: what is there, what is missing, make it, list it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from navrep_data.errors import CorruptDataError, DatasetError, DatasetMismatchError, NavrepDataError
from navrep_data.generate.compiling import Compiling, compile_ahead
from navrep_data.generate.executors import LocalExecutor, RayExecutor
from navrep_data.generate.plan import Request, check_manifest, check_same, check_space, new_manifest, versions
from navrep_data.generate.storage import check_storage, check_visible
from navrep_data.generate.worker import DatasetSpec, ShardTask, seconds_per_row
from navrep_data.io import PART_SUFFIX
from navrep_data.shards import MANIFEST_FILE, Manifest, ShardEntry, ShardRecipe, dataset_card, read_recipe

# The manifest is rewritten whole: not more often than this, nor so often that writing it takes 5 % of the time.
MANIFEST_SECONDS = 0.5
MANIFEST_SHARE = 0.05
# On resume the newest finished shards are hashed again: what a power cut may have damaged.
RECHECKED_SHARDS = 8

Say = Callable[[str], None]


class Run:
    """One run over a locked folder.

    Attributes
    ----------
    manifest : Manifest
        What is listed so far.
    new_rows : int
        Rows made by this run.
    began : float
        When making them began, by ``time.perf_counter``.
    """

    def __init__(self, request: Request, say: Say, *, explicit_shard_size: bool) -> None:
        self.request = request
        self.root = request.spec.root
        self.home = request.home
        self.store = request.spec.store
        self.say = say
        self.new_rows = 0
        self.began = time.perf_counter()
        self._saved_at = 0.0
        self._save_seconds = 0.0
        self._unsaved = False
        if (self.home / MANIFEST_FILE).exists():
            self.manifest = self._resume(explicit_shard_size)
            # the dataset keeps calling its maps what it called them first
            config = request.spec.config
            called = config.with_maps(self.manifest.config.get("maps", config.maps), config.map_files)
            self.request = replace(
                request, spec=replace(request.spec, config=called), shard_size=self.manifest.shard_size
            )
        else:
            check_storage(self.store)
            self.manifest = new_manifest(request)
        check_manifest(self.request)
        self._entries = {(entry.split, entry.sequences): entry for entry in self.manifest.shards}

    def _resume(self, explicit_shard_size: bool) -> Manifest:
        try:
            old = Manifest.read(self.home)
        except CorruptDataError as error:
            return self._start_over(error)
        check_same(old, self.request, explicit_shard_size)
        if self.request.part is not None and old.planned != self.request.n:
            raise DatasetMismatchError(
                f"{self.home} is a part of n={old.planned} sequences, asked for n={self.request.n}; a dataset in parts "
                "cannot grow: merge it first and extend it then, or choose another --out."
            )
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

        Every shard that can still be read must have been made with the settings, by the policy and from the maps of
        this request: then what is written over them are their own rows.
        """
        spec = self.request.spec
        if spec.storage is not None or self.request.part is not None:
            raise error  # shards are elsewhere, or others' as well
        wanted = ShardRecipe(spec.config.env, spec.config.to_dict(), spec.seed, spec.settings.length, spec.made_by)
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
            if part is not None and not self.store.intact(part, hashed=hashed):
                self.say(f"{part.file} is missing or damaged; making it again.")
                return False
        return True

    def _tasks(self) -> list[ShardTask]:
        """Return the shards still to be made; one that replaces a listed, shorter one is staged."""
        there = {entry.file for entry in self._entries.values()}
        return [
            replace(task, staged=task.file in there)
            for task in self.request.shards
            if (task.split, task.sequences) not in self._entries
        ]

    def go(self, make_executor: Callable[[DatasetSpec, int], LocalExecutor | RayExecutor], progress: bool) -> None:
        """Make what is missing and finish the manifest.

        Parameters
        ----------
        make_executor : callable
            Returns who makes a given number of shards of what is to be made.
        progress : bool
            Whether to show a bar on stderr.
        """
        tasks = self._tasks()
        done_rows = self.manifest.rows
        check_space(self.request, done_rows)
        self._clean_up()
        if not tasks:
            self._finish()
            self.say(f"{self.home} already holds all {self.request.sequences} sequences; nothing to do.")
            return
        with make_executor(self.request.spec, len(tasks)) as executor:
            with Compiling(self.say, progress):
                per_row = self._prepare(executor)
            self._announce(done_rows, executor, per_row)
            if self._entries or not (self.home / MANIFEST_FILE).exists():
                self._save()
            self.began = time.perf_counter()
            self._make(executor, tasks, done_rows, progress)
        self._finish()

    def _make(
        self, executor: LocalExecutor | RayExecutor, tasks: list[ShardTask], done_rows: int, progress: bool
    ) -> None:
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

    def _prepare(self, executor: LocalExecutor | RayExecutor) -> float | None:
        """Compile what workers like this process need; return how long a row will take [s] where somebody is told."""
        spec = self.request.spec
        if spec.policy.spec is not None or not executor.like_here:
            return None
        if not spec.config.maps:
            compile_ahead(spec)
        return None if self.say is silent else seconds_per_row(spec)  # costs a few hundred rows

    def _announce(self, done_rows: int, executor: LocalExecutor | RayExecutor, per_row: float | None) -> None:
        r, s = self.request, self.request.spec
        todo = r.rows - done_rows
        place = s.storage or s.root
        text = (
            f"{r.sequences} sequences x {s.settings.length} steps = {r.rows:,} rows, about {_size(r.bytes)} in {place}"
        )
        if r.part is not None:
            text = f"part {r.part}: {text}"
        if done_rows:
            text += f", {done_rows:,} rows are there already"
        if per_row is not None:
            text += f", about {_duration(todo * per_row / executor.workers)}"
        self.say(f"{text} on {executor.place}")

    def _clean_up(self) -> None:
        """Remove what killed processes left behind: temp files and shards that never left staging."""
        part = self.request.part  # others are at work on theirs
        self.store.clean_up(None if part is None else {Path(task.file).stem for task in self.request.shards})
        for path in self.home.glob(f".*{PART_SUFFIX}"):
            path.unlink(missing_ok=True)

    def _add(self, task: ShardTask, entry: ShardEntry) -> None:
        check_visible(self.store, entry, staged=task.staged)
        if task.staged:
            self._replace(entry)
        self._entries[entry.split, entry.sequences] = entry
        self.new_rows += entry.rows
        self._unsaved = True
        if task.staged:
            self._save()

    def _replace(self, entry: ShardEntry) -> None:
        """Put a staged shard in the place of the shorter one."""
        for key in [k for k, old in self._entries.items() if old.file == entry.file]:
            self.new_rows -= self._entries.pop(key).rows
        self._save()
        for part in (entry.worlds, entry):
            if part is not None:
                self.store.unstage(part.file)

    def _save_if_due(self) -> None:
        """List what is finished, unless that was done a moment ago."""
        pause = max(MANIFEST_SECONDS, self._save_seconds / MANIFEST_SHARE)
        if self._unsaved and time.monotonic() - self._saved_at > pause:
            self._save()

    def _save(self) -> None:
        begun = time.monotonic()
        self.manifest = self.manifest.with_shards(self._entries.values(), complete=False).save(self.home)
        self._unsaved = False
        self._saved_at = time.monotonic()
        self._save_seconds = self._saved_at - begun

    def _finish(self) -> None:
        """List everything; write the card and mark the dataset complete, unless this is a part of one."""
        entries: Iterable[ShardEntry] = self._entries.values()
        whole = self.request.part is None
        manifest = self.manifest.with_shards(entries, complete=whole)
        if manifest.sequences != self.request.sequences:
            raise DatasetError(
                f"{self.home} has {manifest.sequences} of {self.request.sequences} sequences; run the same command "
                "again."
            )
        self._clean_up()  # a worker killed in this run left its temp file too
        self.manifest = manifest.save(self.home, dataset_card(manifest) if whole else None)
        if whole:
            self.store.finish(self.root)


def silent(_: str) -> None:
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
