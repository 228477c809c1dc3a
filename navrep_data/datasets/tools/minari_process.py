"""Write a Minari dataset, in a process of its own: the HDF5 library ends its process where the disk is full.

What fails while HDF5 closes a file leaves objects behind that crash the interpreter when it ends. That process tells
what went wrong in words and ends without looking back.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

import navrep_data
from navrep_data import errors
from navrep_data._version import __version__
from navrep_data.datasets.tools._pieces import Given, Progress
from navrep_data.errors import DiskSpaceError, NavrepDataError, WorkerDiedError
from navrep_data.io import translate_os_error, without_interrupts
from navrep_data.observations import metres_from_millimetres
from navrep_data.schema import ACTION_SIZE, ROBOT_STATE_SIZE

Arrays = dict[str, npt.NDArray[Any]]
_INFOS = ("event", "sequence", "robot_pose", "robot_radius", "humans")
# What the HDF5 library says of the operating system, as text only.
_ERRNO = re.compile(r"errno = (\d+)")
_FLOAT, _HUMAN = 4, 6
_OTHER_BYTES = 64
"""Bytes of a row besides scan and humans, rounded up."""


def write_apart(root: Path, out: Path, name: str, progress: Progress | None) -> dict[str, Any]:
    """Write the dataset in `root` as Minari's dataset `name` under `out`, in another process.

    Parameters
    ----------
    root, out : pathlib.Path
        Absolute: the dataset, and an existing folder.
    name : str
        As ``minari.load_dataset`` takes it.
    progress : callable or None
        Called with (sequences done, sequences in all).

    Returns
    -------
    dict
        Fields of ``ExportResult``: episodes, rows, skipped, dataset_id.

    Raises
    ------
    DiskSpaceError
        If there is too little room, before or while writing.
    WorkerDiedError
        If the process ends without a word.
    NavrepDataError
        What went wrong in it.
    """
    _check_space(root, out)
    package = str(Path(navrep_data.__file__).parent.parent)
    path = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", __name__, str(root), str(out), name]
    with tempfile.TemporaryFile() as said:  # of every object that HDF5 cannot close it says there what we say once
        with without_interrupts():
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, text=True, encoding="utf-8",
                env={**os.environ, "PYTHONPATH": path},
            )  # fmt: skip
        with process:
            try:
                counts = _follow(process, progress)
            finally:
                process.kill()
        if counts is None:
            raise WorkerDiedError(
                f"The process that writes for Minari ended without a result (exit status {process.returncode}: killed, "
                "or out of memory?). Nothing was left behind; run the same command again. It said: "
                + (_last_line(said) or "nothing")
            )
    return counts


def _follow(process: subprocess.Popen[str], progress: Progress | None) -> dict[str, Any] | None:
    """Return what the process tells at its end, None if it ends without; raise what it tells of errors."""
    counts: dict[str, Any] | None = None
    assert process.stdout is not None
    for line in process.stdout:
        told = json.loads(line)
        if "error" in told:
            raise getattr(errors, told["error"])(told["text"])
        if "done" in told and progress is not None:
            progress(*told["done"])
        counts = told.get("counts", counts)
    return counts


def _last_line(file: IO[bytes]) -> str:
    file.seek(0)
    lines = file.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def _check_space(root: Path, out: Path) -> None:
    m = Given(root).manifest
    per_row = m.sensor.n_rays * _FLOAT + (m.max_humans if "humans" in m.columns else 0) * _HUMAN * _FLOAT + _OTHER_BYTES
    needed, free = m.rows * per_row, shutil.disk_usage(out).free
    if needed > free:
        raise DiskSpaceError(
            f"Minari keeps scans uncompressed: {m.rows:,} rows take about {needed:,} bytes, and {free:,} are free in "
            f"{out.parent}. Free some space, choose another place with --out, or export a part (navrep-data split)."
        )


def _write(root: Path, out: Path, name: str) -> dict[str, Any]:
    spaces = importlib.import_module("gymnasium.spaces")
    storage = importlib.import_module("minari.dataset.minari_storage").MinariStorage
    buffer = importlib.import_module("minari.data_collector").EpisodeBuffer
    version = importlib.import_module("minari").__version__
    given = Given(root)
    m = given.manifest
    folder = out / name / "data"
    folder.mkdir(parents=True)
    everywhere = np.float32(np.inf)
    observed = {
        "scan": spaces.Box(np.float32(0), np.float32(m.sensor.range_max), (m.sensor.n_rays,), np.float32),
        "robot_state": spaces.Box(-everywhere, everywhere, (ROBOT_STATE_SIZE,), np.float32),
    }
    made = storage.new(
        folder,
        observation_space=spaces.Dict(observed),
        action_space=spaces.Box(-everywhere, everywhere, (ACTION_SIZE,), np.float32),
    )
    made.update_metadata(
        {
            "dataset_id": name,
            "algorithm_name": str(m.policy.get("name", "unknown")),
            "description": f"navrep-data {m.env}, {m.physics} physics. Made by: {m.command}",
            "minari_version": version,
            "requirements": [f"navrep-data=={__version__}"],
        }
    )
    splits: list[str] = []
    skipped = 0

    def buffers() -> Iterator[Any]:
        nonlocal skipped
        pieces = given.pieces()
        for k, piece in enumerate(pieces):
            columns = piece.columns()
            starts = np.flatnonzero(columns["is_first"])
            for start, stop in zip(starts, np.append(starts[1:], len(columns["step"])), strict=True):
                if stop - start < 2:
                    skipped += 1
                    continue
                splits.append(str(piece.split))
                yield buffer(**_episode({c: v[start:stop] for c, v in columns.items()}))
            _tell({"done": [k + 1, len(pieces)]})

    made.update_episodes(buffers())
    made.update_episode_metadata([{"split": one} for one in splits])
    return {"episodes": len(splits), "rows": m.rows - skipped, "skipped": skipped, "dataset_id": name}


def _episode(rows: Arrays) -> dict[str, Any]:
    """Return the fields of Minari's buffer for one episode."""
    scan, ended = rows["scan"], np.zeros(len(rows["step"]) - 1, bool)
    ended[-1] = True
    terminal = bool(rows["is_terminal"][-1])
    return {
        "observations": {
            "scan": metres_from_millimetres(scan) if scan.dtype == np.uint16 else scan,
            "robot_state": rows["robot_state"],
        },
        "actions": rows["action"][:-1],
        "rewards": rows["reward"][:-1],
        "terminations": ended & terminal,
        "truncations": ended & (not terminal),
        "infos": {name: rows[name] for name in _INFOS if name in rows},
    }


def _tell(value: dict[str, Any]) -> None:
    print(json.dumps(value), flush=True)


def _explained(error: Exception, out: Path) -> NavrepDataError | None:
    """Return an error of ours for one of the HDF5 library or of the operating system; None for a bug."""
    found = _ERRNO.search(str(error))
    if found and not (isinstance(error, OSError) and error.errno is not None):
        error = OSError(int(found[1]), os.strerror(int(found[1])))
    if isinstance(error, OSError):
        error = translate_os_error(error, out.parent)
    return error if isinstance(error, NavrepDataError) else None


def _main(root: Path, out: Path, name: str) -> None:
    """Write, tell, and end at once: leaving in the usual way is what crashes."""
    try:
        _tell({"counts": _write(root, out, name)})
    except Exception as error:
        told = _explained(error, out)
        if told is None:
            raise
        _tell({"error": type(told).__name__, "text": str(told)})
        os._exit(1)


if __name__ == "__main__":
    _main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
