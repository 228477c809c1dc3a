"""World-model errors as results files, tables and figures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from navrep_data._version import __version__
from navrep_data.errors import ConfigError, CorruptDataError
from navrep_data.evaluate.world_model import WorldModelError
from navrep_data.io import atomic_write_json, read_json, translate_os_error

FORMAT, FORMAT_VERSION = "navrep-data-world-model", 1
FOLDER = "world-model"
_MAX_BYTES = 1 << 20


def save(
    result: WorldModelError, out: Path | str, data: dict[str, Any], files: dict[str, str], limit: int | None = None
) -> Path:
    """Write one result as ``out/world-model/NAME.SPLIT.json``.

    Parameters
    ----------
    result : WorldModelError
        What was measured.
    out : path-like
        Results folder.
    data : dict
        What identifies the dataset: its record, see :func:`navrep_data.shards.dataset_record`.
    files : dict of str to str
        Hashes of the weights, by file.
    limit : int, optional
        Windows looked at where not all were.

    Returns
    -------
    pathlib.Path
        The file.
    """
    folder = Path(out) / FOLDER
    plain = "".join(c if c.isalnum() or c in "._-" else "-" for c in result.name).strip("-")
    path = folder / f"{plain}.{result.split}.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise translate_os_error(error, folder) from error
    atomic_write_json(
        path,
        {
            "format": FORMAT, "version": FORMAT_VERSION, "navrep_data": __version__, "data": data, "files": files,
            "result": result.to_dict(), **({} if limit is None else {"limit": limit}),
        },
    )  # fmt: skip
    return path


def load(path: Path | str) -> tuple[WorldModelError, dict[str, Any]]:
    """Read a results file.

    Returns
    -------
    result : WorldModelError
    about : dict
        ``data``, ``files`` and ``limit`` as given to :func:`save`, ``navrep_data`` the version.

    Raises
    ------
    CorruptDataError
        If it is none.
    """
    value = read_json(path, _MAX_BYTES)
    try:
        if value["format"] != FORMAT or value["version"] != FORMAT_VERSION:
            raise ValueError(f"format {value['format']!r} version {value['version']!r}")
        result = WorldModelError(**value["result"])
        about = {key: value[key] for key in ("data", "files", "navrep_data")} | {"limit": value.get("limit")}
        if type(about["limit"]) not in (int, type(None)):
            raise ValueError(f"limit {str(about['limit'])!r}")
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptDataError(
            f"{os.fspath(path)} is no world-model result of this version ({error}). Expected one written by "
            "navrep-data evaluate world-model --out; run it again."
        ) from error
    return result, about


# Longer labels would leave the axes of a figure no room.
LABEL_LENGTH = 28


def table(results: Sequence[WorldModelError]) -> list[str]:
    """Return lines for people: one model per line, errors of lidar and goal apart."""
    width = max([len(r.name) for r in results] + [5])
    k = max(len(r.dream_scan_mse) for r in results)
    dreamed = f"dream {k}"
    lines = [f"{'model':{width}}  lidar  {'scan':>9} {'goal m2':>9}  {'V alone':>9}  {dreamed:>9} {'goal m2':>9}  rows"]
    for r in results:
        lines.append(
            f"{r.name:{width}}  {r.lidar:5}  {_number(r.scan_mse)} {_number(r.goal_mse)}  "
            f"{_number(r.reconstruction_mse)}  {_last(r.dream_scan_mse)} {_last(r.dream_goal_mse)}  {r.rows:,}"
        )
        lines.append(
            f"{'(standing still)':{width}}  {'':5}  {_number(r.still_scan_mse)} {_number(r.still_goal_mse)}  {'':9}  "
            f"{_last(r.dream_still_scan_mse)} {_last(r.dream_still_goal_mse)}"
        )
    return lines


def _number(value: float | None) -> str:
    return f"{'-':>9}" if value is None else f"{value:9.5f}"


def _last(values: list[float]) -> str:
    return _number(values[-1] if values else None)


def _short(name: str) -> str:
    """Return a name, perhaps a path, that fits under a bar."""
    return name if len(name) <= LABEL_LENGTH else f"...{name[3 - LABEL_LENGTH :]}"


def figure(results: Sequence[WorldModelError], path: Path | str) -> None:
    """Draw the errors of the next step as bars and those of the dream as curves, lidar and goal apart.

    A V alone, which predicts nothing, is left out. The file's suffix is its format: png, pdf or svg.
    """
    from matplotlib.figure import Figure

    from navrep_data.evaluate.pictures import check_suffix, write_picture

    check_suffix(Path(path), False, "--figure")
    results = [r for r in results if r.scan_mse is not None]
    if not results:
        raise ConfigError("There is no world model to draw, expected one beside V: leave out --figure.")
    picture = Figure(figsize=(9.0, 6.0), dpi=120, layout="constrained")
    axes = picture.subplots(2, 2)
    picture.suptitle(f"World-model error, {results[0].split} split", fontsize=11)
    units = {"rings": "MSE of rings", "1d": "MSE of ranges / 25 m"}
    what = units[results[0].lidar] if len({r.lidar for r in results}) == 1 else "MSE"
    for j, (kind, label) in enumerate((("scan", what), ("goal", "MSE of the goal [m$^2$]"))):
        names = [_short(r.name) for r in results]
        bars, curves = axes[0, j], axes[1, j]
        bars.bar(names, [getattr(r, f"{kind}_mse") for r in results], color="#1f4e79", label="model")
        still = [getattr(r, f"still_{kind}_mse") for r in results]
        bars.scatter(names, still, color="#c0504d", marker="_", s=400, label="standing still")
        bars.set_ylabel(label)
        bars.set_title("next step" if j == 0 else "next step, goal", fontsize=9)
        bars.tick_params(axis="x", labelsize=8)
        bars.legend(fontsize=7)
        for r in results:
            values = getattr(r, f"dream_{kind}_mse")
            curves.plot(range(1, len(values) + 1), values, marker=".", label=_short(r.name))
        first = getattr(results[0], f"dream_still_{kind}_mse")
        curves.plot(range(1, len(first) + 1), first, "--", color="#888888", label="standing still")
        curves.set_xlabel("steps dreamed (0.2 s each)")
        curves.set_ylabel(label)
        curves.set_ylim(bottom=0)
        curves.legend(fontsize=7)
    write_picture(picture, Path(path))
