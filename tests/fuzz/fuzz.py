"""Fuzz the readers of everything that comes from outside: ``python tests/fuzz/fuzz.py --seconds 600``.

Each target (:mod:`fuzz_targets`) runs in a process of its own whose address space is bounded. Valid files are changed
(:mod:`fuzz_edits`) as hypothesis chooses and read. Either the reader takes them, or it raises an error of
:mod:`navrep_data.errors` on one line. Anything else is a finding: another exception, memory that ran out or grew by
more than :data:`MEMORY`, a read that takes more than :data:`HANG` or :data:`STANDSTILL`, a process that dies, a file
outside the folder. Exit code 1 if there is one; its files are kept.

With ``--examples N``, as in `make test`, nothing depends on the clock or on chance: each target reads N changed files
that follow from the seed (0 by default) alone, and only the processor's time is bounded.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import hypothesis
from fuzz_edits import BOUNDS, EDITS, MOST_EDITS, OUTSIDE, Edit, Files, apply
from fuzz_targets import TARGETS, Target, load_files
from hypothesis import strategies as st

from navrep_data.errors import LONGEST_MESSAGE, NavrepDataError

MEMORY = 512 << 20
"""Bytes that reading one small file may take at most."""
ADDRESS_SPACE = 1 << 30
"""Bytes that may be asked for beyond what the process has when it starts."""
HANG = 20.0
"""Seconds of the processor's time that reading one small file may take at most."""
STANDSTILL = 600.0
"""Seconds by the clock that it may take; long, since whole machines are stopped and go on. Not looked at where the
number of examples is given."""
_ROUND = 250


@dataclass
class Report:
    """What one target did.

    Attributes
    ----------
    target : str
        Its name.
    examples, taken, refused : int
        Changed files that were read; how many were taken for good, how many refused.
    seconds : float
        How long.
    finding : str
        What was found, empty for nothing.
    """

    target: str
    examples: int = 0
    taken: int = 0
    refused: int = 0
    seconds: float = 0.0
    finding: str = ""


@dataclass(frozen=True)
class Much:
    """How much is fuzzed.

    Attributes
    ----------
    seconds : float
        How long, where no number of examples is given.
    examples : int, optional
        How many changed files are read, however long that takes.
    standstill : float, optional
        Seconds by the clock that reading one may take; None: as long as it wants.
    """

    seconds: float = 0.0
    examples: int | None = None
    standstill: float | None = STANDSTILL


class _Found(Exception):  # noqa: N818
    """A reader did what it must not do."""


class _Fuzzer:
    """One target in this process."""

    def __init__(self, target: Target, files: Files, work: Path, standstill: float | None) -> None:
        self.standstill = standstill
        self.target, self.files, self.report = target, files, Report(target.name)
        self.case, self.outside = work / "case", work / Path(OUTSIDE).name
        self.outside.write_text("not to be touched")
        self.around = [*sorted(p.name for p in work.iterdir()), "case"]
        self._write(self.files)
        # a target whose own files are refused would find nothing; no limit here, reading may compile kernels first
        target.read(self.case)

    def run_fixed(self, examples: int, seed: int) -> None:
        """Read `examples` changed files, the same ones at every run."""
        start = time.monotonic()
        for k in range(examples):
            draw = random.Random(f"{seed} {self.target.name} {k}")
            edits = [Edit(*(draw.randrange(bound) for bound in BOUNDS)) for _ in range(draw.randint(1, MOST_EDITS))]
            self._example(edits, sealed=draw.randrange(8) > 0)
        self.report.seconds = time.monotonic() - start

    def run(self, end: float, seed: int) -> None:
        """Read changed files until `end`."""
        start = time.monotonic()
        k = 0
        while time.monotonic() < end:
            k += 1

            @hypothesis.seed(seed * 1_000_003 + k)
            @hypothesis.settings(
                max_examples=_ROUND, database=None, deadline=None, derandomize=False,
                suppress_health_check=list(hypothesis.HealthCheck), print_blob=False,
                phases=[hypothesis.Phase.generate, hypothesis.Phase.shrink],
            )  # fmt: skip
            @hypothesis.given(EDITS, st.integers(0, 7))
            def one(edits: list[Edit], sealed: int) -> None:
                if time.monotonic() < end or self.report.finding:
                    self._example(edits, sealed > 0)

            one()
            self.report.seconds = time.monotonic() - start

    def _example(self, edits: list[Edit], sealed: bool) -> None:
        files = apply(self.files, edits)
        if sealed:
            files = self.target.seal(files)
        self.report.examples += 1
        try:
            taken = self._read(files)
        except Exception as error:
            self.report.finding = "".join(traceback.format_exception(error)[-30:])
            raise
        self.report.taken += taken
        self.report.refused += not taken

    def _write(self, files: Files) -> None:
        shutil.rmtree(self.case, ignore_errors=True)
        for name, data in files.items():
            path = self.case / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    def _read(self, files: Files) -> bool:
        """Read files and say whether they were taken; raise for what must not happen."""
        self._write(files)
        before = _reset_peak()
        if self.standstill is not None:
            faulthandler.dump_traceback_later(self.standstill, exit=True)
        signal.setitimer(signal.ITIMER_PROF, HANG)  # its signal ends the process, wherever it is
        try:
            self.target.read(self.case)
            taken = True
        except NavrepDataError as error:
            _check_refusal(error)
            taken = False
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            faulthandler.cancel_dump_traceback_later()
        grown = _peak() - before
        if grown > MEMORY:
            raise _Found(f"reading took {grown >> 20} MiB")
        there = sorted(p.name for p in self.case.parent.iterdir())
        if there != sorted(self.around) or self.outside.read_text() != "not to be touched":
            raise _Found(f"files outside the folder: {there}")
        return taken


def _check_refusal(error: NavrepDataError) -> None:
    """Raise for a refusal that hides something else or cannot be shown on one line."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            raise _Found(f"memory ran out before it was refused: {error}") from error
        cause = cause.__cause__ or cause.__context__
    text = str(error)
    if len(text) > LONGEST_MESSAGE or len(text.splitlines()) > 1:
        raise _Found(f"the message has {len(text)} characters or several lines: {text[:300]!r}") from error
    text.encode()


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(name + ":"))) << 10


def _reset_peak() -> int:
    """Forget the peak of memory so far; return what is in use."""
    with open("/proc/self/clear_refs", "w") as handle:
        handle.write("5")
    return _status("VmRSS")


def _peak() -> int:
    return _status("VmHWM")


def _child(target: Target, files: Files, work: Path, much: Much, seed: int) -> None:
    """Fuzz one target and write its report; ends the process."""
    warnings.simplefilter("ignore")
    faulthandler.enable()
    faulthandler.register(signal.SIGPROF, chain=True)  # tells where it hangs before it ends
    os.environ["NAVREP_DATA_HOME"] = str(work / "home")
    os.environ["NAVREP_DATA_OFFLINE"] = "1"
    (work / "home").mkdir()
    fuzzer = None
    report = Report(target.name)
    try:
        fuzzer = _Fuzzer(target, files, work, much.standstill)
        report = fuzzer.report
        limit = _status("VmSize") + ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))
        if much.examples is not None:
            fuzzer.run_fixed(much.examples, seed)
        else:
            fuzzer.run(time.monotonic() + much.seconds, seed)
    except BaseException as error:
        report.finding = report.finding or "".join(traceback.format_exception(error))
    resource.setrlimit(resource.RLIMIT_AS, (resource.getrlimit(resource.RLIMIT_AS)[1],) * 2)
    (work / "report.json").write_text(json.dumps(asdict(report)))


_DIED, _EDITING, _READING = "the process died", "in edit_hdf5", "in _read"
_NEXT_SEED, _OTHER_SEEDS = 1_000_000, 5


def fuzz(target: Target, much: Much, seed: int, keep: Path | None = None) -> Report:
    """Fuzz one target; go on with another seed where the fuzzer itself dies while it edits an HDF5 file.

    Parameters as for :func:`fuzz_once`. libhdf5 may crash when it writes into a file that earlier edits have damaged;
    that says nothing about the readers, which the process had not called.
    """
    end = time.monotonic() + much.seconds
    while True:
        report = fuzz_once(target, replace(much, seconds=max(1.0, end - time.monotonic())), seed, keep)
        own = report.finding is not None and _DIED in report.finding and _EDITING in report.finding
        if not own or _READING in str(report.finding):
            return report
        if time.monotonic() > end and (much.examples is None or seed >= _OTHER_SEEDS * _NEXT_SEED):
            return Report(target.name)
        seed += _NEXT_SEED


def fuzz_once(target: Target, much: Much, seed: int, keep: Path | None = None) -> Report:
    """Fuzz one target in a process of its own.

    Parameters
    ----------
    target : Target
        What to read.
    much : Much
        How long, or how many examples.
    seed : int
        Same seed, same examples (as many of them as time allows).
    keep : Path, optional
        Folder that the files of a finding are copied into.
    """
    with tempfile.TemporaryDirectory(prefix="navrep-data-fuzz-") as name:
        work = Path(name)
        (work / "seeds").mkdir()
        target.make(work / "seeds")
        files = load_files(work / "seeds")
        sys.stdout.flush()
        sys.stderr.flush()
        log = work / "log"
        pid = os.fork()
        if pid == 0:
            handle = os.open(log, os.O_WRONLY | os.O_CREAT)
            os.dup2(handle, 1)
            os.dup2(handle, 2)
            inner = work / "work"
            inner.mkdir()
            try:
                _child(target, files, inner, much, seed)
            finally:
                os._exit(0)
        _, status = os.waitpid(pid, 0)
        written = work / "work" / "report.json"
        if written.is_file():
            report = Report(**json.loads(written.read_text()))
        else:
            said = log.read_text(errors="replace")[:4000]  # where it was comes first
            report = Report(target.name, finding=f"{_DIED} (status {status}):\n{said}")
        if report.finding and keep is not None:
            place = keep / f"{target.name}-{seed}"
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(work / "work" / "case", place / "files", symlinks=True)
            (place / "finding.txt").write_text(report.finding)
    return report


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns 1 where something was found."""
    parser = argparse.ArgumentParser(description="Fuzz the readers of files from outside.")
    parser.add_argument("--seconds", type=float, default=600.0, help="time in all, shared out over the targets")
    parser.add_argument("--examples", type=int, default=None, help="so many for each target, however long that takes")
    parser.add_argument(
        "--seed", type=int, default=None, help="same seed, same examples; random by default, 0 with --examples"
    )
    parser.add_argument("--only", nargs="*", choices=[t.name for t in TARGETS], help="these targets")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"), help="where the files of findings go")
    options = parser.parse_args(arguments)
    seed = options.seed
    if seed is None:
        seed = int.from_bytes(os.urandom(4), "little") if options.examples is None else 0
    targets = [t for t in TARGETS if not options.only or t.name in options.only]
    if options.examples is None:
        much = Much(options.seconds / len(targets))
        print(f"seed {seed}, {options.seconds:g} s for {len(targets)} targets", flush=True)
    else:
        much = Much(examples=options.examples, standstill=None)
        print(f"seed {seed}, {options.examples} examples for each of {len(targets)} targets", flush=True)
    _import_all()
    reports = []
    for target in targets:
        report = fuzz(target, much, seed, options.keep)
        reports.append(report)
        outcome = "FOUND" if report.finding else "clean"
        print(
            f"{report.target:15s} {report.examples:8,d} examples in {report.seconds:5.1f} s: {report.taken:,} taken, "
            f"{report.refused:,} refused, {outcome}",
            flush=True,
        )
        if report.finding:
            print(report.finding)
    total = sum(r.examples for r in reports)
    found = [r.target for r in reports if r.finding]
    print(f"{total:,} examples; findings: {', '.join(found) or 'none'}")
    return 1 if found else 0


def _import_all() -> None:
    """Import before forking what every target would import by itself."""
    import torch

    import navrep_data.datasets
    import navrep_data.doctor
    import navrep_data.evaluate
    import navrep_data.testing
    import navrep_data.train
    import navrep_data.view
    import navrep_data.zoo  # noqa: F401

    torch.set_num_threads(1)


if __name__ == "__main__":
    sys.exit(main())
