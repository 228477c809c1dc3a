"""Play policies in a suite, and write results, tables and figures."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from navrep_data._ray import RayCluster
from navrep_data.errors import ConfigError, DatasetNotFoundError, check_whole
from navrep_data.evaluate import tables
from navrep_data.evaluate.executors import Job, run, run_on_ray
from navrep_data.evaluate.results import Results, file_name, header_of, open_results
from navrep_data.evaluate.runner import Episode
from navrep_data.evaluate.scores import by_variant, compare, summary
from navrep_data.evaluate.suites import Suite, get_suite
from navrep_data.generate.executors import EXECUTORS
from navrep_data.io import atomic_write_bytes, translate_os_error
from navrep_data.policies import AnyPolicy, PolicySpec, resolve_policy

PHYSICS = ("original", "consistent")
SAVE_SECONDS = 2.0
"""The results file is written this often at most while episodes finish."""
MAX_WORKERS = 1024

Progress = Callable[[str, int, int], None]
"""Called with a policy's name, how many of its episodes are finished, and of how many."""


@dataclass
class Benchmark:
    """What :func:`benchmark` returns.

    Attributes
    ----------
    rows : list of dict
        One per policy, in the order asked for; see :func:`navrep_data.evaluate.summary`.
    variants : list of dict
        Variants of which several runs were played.
    baseline : dict
        The row of `goal`, asked for or not.
    pairs : list of dict
        Any two policies on the same episodes; see ``navrep_data.evaluate.scores.compare``.
    text : str
        The report as Markdown.
    files : list of Path
        What was written.
    seconds : dict of str to float
        Wall time that each policy took just now [s]; 0 where nothing was left to play.
    """

    rows: list[dict[str, Any]]
    variants: list[dict[str, Any]]
    baseline: dict[str, Any]
    pairs: list[dict[str, Any]]
    text: str
    files: list[Path] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return results as ``--json`` prints them."""
        shares = ("contact_free_rate", "success_rate")
        rows = [{**r, **{f"goal_{share}": self.baseline[share] for share in shares}} for r in self.rows]
        return {
            "results": rows,
            "variants": self.variants,
            "baseline": self.baseline,
            "pairs": self.pairs,
            "files": [str(f) for f in self.files],
            "seconds": self.seconds,
        }


def benchmark(
    policies: Sequence[AnyPolicy],
    suite: str = "navreptest",
    physics: str | None = None,
    episodes: int | None = None,
    workers: int | None = None,
    inference: str = "deterministic",
    source: str | os.PathLike[str] | None = None,
    out: str | os.PathLike[str] = "benchmark",
    figures: bool = True,
    batch: int | None = None,
    executor: str = "local",
    address: str | None = None,
    progress: Progress | None = None,
    ranges: str = "contract",
    scaling: str | None = None,
    first_round: int = 0,
) -> Benchmark:
    """Play policies in a suite; the same call goes on after an interruption, or with more episodes.

    Parameters
    ----------
    policies : sequence of str or callable
        Baselines (``goal``, ``random``, ``orca``, ``dwa``), names of the zoo, folders of policies (``./folder``,
        ``hf://user/name``), ``module:function``, callables
        ``(scan (64, 1080), robot_state (64, 5)) -> action (64, 2 or 3)`` in [-1, 1], or policies that
        :func:`navrep_data.zoo.load` returned, fed as by their names, or any :class:`navrep_data.policies.BasePolicy`.
        `goal` is always played.
    suite : str
        ``"navreptest"`` or ``"navrep27"``.
    physics : str, optional
        ``"original"`` (the suites' default) or ``"consistent"``.
    episodes : int, optional
        Episodes per scenario; the suite's own number by default.
    workers : int, optional
        Processes, 1 by default; numbers do not depend on it. On Ray: most tasks at the same time, by default all that
        the cluster takes.
    inference : str
        ``"deterministic"``, or ``"as_released"``: the zoo's memories with the noise that they were trained with.
    source : path-like or str, optional
        Folder or address with the zoo's files.
    out : path-like
        Results, tables and figures go to ``out/SUITE-PHYSICS/``.
    figures : bool
        Whether to draw.
    batch : int, optional
        Worlds per process; numbers do not depend on it.
    executor : {"local", "ray"}
        Where to play: on this machine, or as tasks of a Ray cluster (needs the extra ``ray``).
    address : str, optional
        The Ray cluster's ``host:port``, or ``auto``; by default ``RAY_ADDRESS``, or a cluster on this machine alone.
    progress : callable, optional
        Called with a policy's name, how many of its episodes are finished, and of how many.
    ranges : str
        ``"contract"``: networks get ranges cut where those of their training were (25 m). ``"as_released"``, for
        released networks only: uncut, as the authors' software feeds them (up to 109 m on the office map).
    scaling : str, optional
        ``"robot"``, the default: on another robot than that of training a network sees and moves in proportion, see
        :meth:`navrep_data.zoo.policy.Policy.for_robot`. ``"none"``: as trained, and the default for ranges as the
        authors fed them.
    first_round : int
        The first round: rounds ``first_round`` to ``first_round + episodes - 1`` of every scenario are played (in
        ``navreptest`` a round is an episode). Results of another first round than 0 lie apart, in
        ``out/SUITE-PHYSICS-roundR/``, and are never mixed with others.

    Returns
    -------
    Benchmark

    Raises
    ------
    UnknownNameError, ConfigError, PolicyError
        If a name or setting cannot be used.
    DatasetMismatchError
        If `out` holds results of other settings.
    MissingExtraError, ClusterError
        If there is no Ray, or no cluster at the address.
    """
    chosen = get_suite(suite)
    kind = chosen.physics if physics is None else physics
    _check(kind, workers, batch, policies)
    if executor not in EXECUTORS:
        raise ConfigError(f"executor is {executor!r}, expected one of: {', '.join(EXECUTORS)}.")
    if address is not None and executor != "ray":
        raise ConfigError(f"address is {address}, which only Ray needs; expected executor ray with it.")
    total = chosen.total(episodes, first_round)
    specs = _one_each([resolve_policy(p, source, inference, bool(chosen.maps), ranges, scaling) for p in policies])
    specs = [s if s.is_network else _plain(s) for s in specs]
    everybody = specs if any(s.name == "goal" for s in specs) else [resolve_policy("goal"), *specs]
    folder = Path(out) / chosen.folder(kind, first_round)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise translate_os_error(error, folder) from error
    # settings are compared before the first episode is played
    opened = [(s, open_results(folder / file_name(s), header_of(s, chosen, kind, first_round))) for s in everybody]
    seconds, found = {}, {}
    place: AbstractContextManager[RayCluster[tuple[int, ...], list[Episode]] | None]
    place = RayCluster(address, workers) if executor == "ray" else nullcontext()
    with place as cluster:
        play = (lambda job: run(job, workers or 1)) if cluster is None else (lambda job: run_on_ray(job, cluster))
        for spec, results in opened:
            begun = time.perf_counter()
            played = _play(chosen, kind, spec, results, total, folder / file_name(spec), batch, play, progress)
            seconds[spec.name] = round(time.perf_counter() - begun, 2) if played else 0.0
            found[spec.name] = results.first(total)
    report = write_report(list(found.values()), folder, figures, [s.name for s in specs])
    report.files = [*(folder / file_name(s) for s in everybody), *report.files]
    report.seconds = seconds
    return report


def _one_each(specs: Sequence[PolicySpec]) -> list[PolicySpec]:
    """Return each policy once; two that are not the same cannot share a name, since results go by it."""
    found: dict[str, PolicySpec] = {}
    for spec in specs:
        if found.setdefault(spec.name, spec).given is not spec.given:
            raise ConfigError(
                f"Two policies are called {spec.name}, expected a name for each: results go by it; play them in two "
                "folders (out=), or write a class or function for each."
            )
    return list(found.values())


def _plain(spec: PolicySpec) -> PolicySpec:
    """Return a spec without network, for which `inference` means nothing."""
    return PolicySpec(spec.name, spec.sees, spec.variant, spec.kind, files=spec.files, given=spec.given)


def _check(physics: str, workers: int | None, batch: int | None, policies: Sequence[Any]) -> None:
    if physics not in PHYSICS:
        raise ConfigError(f"physics is {physics!r}, expected one of: {', '.join(PHYSICS)}.")
    for name, value, most in (
        ("workers", 1 if workers is None else workers, MAX_WORKERS),
        ("batch", 1 if batch is None else batch, 4096),
    ):
        check_whole(name, value, 1, most)
    if not policies or isinstance(policies, str):
        raise ConfigError(f"policies is {policies!r}, expected a list of names, for example ['goal', 'dwa'].")


def _play(
    suite: Suite,
    physics: str,
    spec: PolicySpec,
    results: Results,
    total: int,
    path: Path,
    batch: int | None,
    play: Callable[[Job], Generator[list[Episode]]],
    progress: Progress | None,
) -> bool:
    """Play what is missing, saving as episodes finish; returns whether anything was."""
    todo = results.missing(total)  # numbers in the suite
    if not todo:
        return False
    job = Job(suite.name, physics, spec, tuple(todo), spec.inference == "as_released" and spec.is_network, batch)
    done, saved = total - len(todo), time.monotonic()
    try:
        with closing(play(job)) as played:
            for finished in played:
                results.add(finished)
                done += len(finished)
                if progress is not None:
                    progress(spec.name, done, total)
                if finished and time.monotonic() - saved > SAVE_SECONDS:
                    results.save(path)
                    saved = time.monotonic()
    finally:
        results.save(path)
    return True


def write_report(
    found: Sequence[Results], folder: Path, figures: bool = True, names: Sequence[str] | None = None
) -> Benchmark:
    """Write tables and figures of results, without playing anything.

    Parameters
    ----------
    found : sequence of Results
        Of policies in one suite and physics; `goal` among them is the baseline.
    folder : pathlib.Path
        Where to.
    figures : bool
        Whether to draw.
    names : sequence of str, optional
        Only these in tables and figures.
    """
    chosen = [r for r in found if names is None or r.header["name"] in names]
    rows = {r.name: summary(r) for r in found}
    baseline = next((rows[r.name] for r in found if r.header["name"] == "goal"), None)
    if baseline is None:
        raise DatasetNotFoundError(f"{folder} has no results of 'goal', expected them beside every score: play it too.")
    mine = [rows[r.name] for r in chosen]
    groups = by_variant(mine)
    pairs = compare(chosen)
    text = tables.report(mine, groups, baseline, chosen[0].suite.text, pairs)
    report = Benchmark(mine, groups, baseline, pairs, text)
    atomic_write_bytes(folder / "report.md", text.encode())
    report.files.append(folder / "report.md")
    if figures:
        from navrep_data.evaluate.figures import draw

        report.files += draw(chosen, mine, groups, baseline, folder)
    return report


def _check_one_each(found: Sequence[Results], files: Sequence[Path]) -> None:
    """Refuse two files of one policy that was run in one way: which of them counts is not ours to say."""
    first: dict[tuple[Any, ...], Path] = {}
    for results, file in zip(found, files, strict=True):
        other = first.setdefault((results.name, results.suite.name, results.physics, results.first_round), file)
        if other != file:
            raise ConfigError(f"{other} and {file} both hold results of {results.name}, expected one: move one away.")


def redraw(folder: str | os.PathLike[str], figures: bool = True) -> Benchmark:
    """Write the tables and figures of a folder of results again, without playing anything.

    Parameters
    ----------
    folder : path-like
        ``out/SUITE-PHYSICS`` of an earlier :func:`benchmark`, or one results file in it.
    figures : bool
        Whether to draw.

    Raises
    ------
    DatasetNotFoundError
        If there are no results.
    CorruptDataError
        If a file is none.
    ConfigError
        If results are of several suites, physics or first rounds, or two files are of one policy.
    """
    path = Path(folder)
    files = [path] if path.is_file() else sorted(path.glob("*.json"))
    if not files:
        raise DatasetNotFoundError(f"{path} holds no results (*.json), expected OUT/SUITE-PHYSICS of a benchmark.")
    names = None
    home = path.parent if path.is_file() else path
    found = [Results.load(f) for f in files]
    _check_one_each(found, files)
    if path.is_file():
        names = [found[0].header["name"]]
        if names != ["goal"] and (home / "goal.json").is_file():
            found.append(Results.load(home / "goal.json"))
    if len({(r.suite.name, r.physics, r.first_round) for r in found}) > 1:
        raise ConfigError(
            f"{path} holds results of several suites, physics or first rounds, expected one: move them apart."
        )
    return write_report(found, home, figures, names)
