"""Reading map folders of the ROS map_server: a YAML file and an image, both taken for hostile until checked."""

from __future__ import annotations

import importlib.util
import math
import warnings
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from navrep_data.errors import MapError, MissingExtraError
from navrep_data.io import raise_refusal

EXTRA_PACKAGE = "asl_pepper_2d_sim_maps"
PIP_COMMAND = 'pip install "navrep-data[maps]"'
YAML_SUFFIXES = (".yaml", ".yml")
# Map descriptions have about 150 bytes.
MAX_YAML_BYTES = 1 << 16
# 8192 x 8192; the largest of the paper's maps has 8.3 million pixels. Bounds memory before anything is decoded.
MAX_PIXELS = 1 << 26
MAX_IMAGE_BYTES = 1 << 28
# Formats that the decoder may try: what map_server's users write. Others of pillow's decoders stay shut.
_FORMATS = ("PPM", "PNG")
_PIXEL_MODES = ("L", "1", "P", "RGB", "LA", "RGBA")
# Origins turned by less [rad] are not turned: over 100 m that is a centimetre.
_TURN_TOLERANCE = 1e-4
_REQUIRED = ("image", "resolution", "origin", "occupied_thresh", "free_thresh")
_MODES = ("trinary", "scale")


class _MapLoader(yaml.SafeLoader):
    """A safe loader without aliases: a few hundred bytes of them stand for more values than fit into memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose the next node, which must not be an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has an alias (*), which no map file needs")
        return super().compose_node(parent, index)


@dataclass(frozen=True)
class MapDescription:
    """What a map's YAML file says, checked.

    Attributes
    ----------
    yaml_path, image_path : pathlib.Path
        Absolute; the YAML file names an image in its folder or below. Either may be a link into a store.
    resolution : float
        Side of a cell [m].
    origin : tuple of float
        Lower-left corner of the lower-left cell [m].
    occupied_threshold, free_threshold : float
        Occupancies above and below which a cell is solid and free.
    negate : bool
        Whether dark means free.
    mode : str
        How map_server reads it: "trinary" or "scale".
    """

    yaml_path: Path
    image_path: Path
    resolution: float
    origin: tuple[float, float]
    occupied_threshold: float
    free_threshold: float
    negate: bool
    mode: str = "trinary"


def packaged_folder() -> Path:
    """Return the folder of the paper's maps in the optional package, without importing its modules.

    Raises
    ------
    MissingExtraError
        If the package is not installed.
    """
    try:
        spec = importlib.util.find_spec(EXTRA_PACKAGE)
    except (ImportError, ValueError):
        spec = None
    for place in (spec.submodule_search_locations or []) if spec is not None else []:
        folder = Path(place) / "maps"
        if folder.is_dir():
            return folder
    raise MissingExtraError(
        f"The paper's maps are not installed: they come with the package asl-pepper-2d-sim. Run {PIP_COMMAND}, "
        "or give the path of a map of your own (a YAML file or its folder)."
    )


def is_bare(name: str) -> bool:
    """Return whether a map is given by a bare word, which is a name first."""
    path = Path(name)
    return path.name == name and path.suffix not in YAML_SUFFIXES


def map_file(name: str) -> str:
    """Return where a map is read from that is given by name or path: paths that lead somewhere become absolute."""
    try:
        if is_bare(name) and (not Path(name).is_dir() or _is_packaged(name)):
            return name
        return str(Path(name).absolute()) if Path(name).exists() else name
    except (OSError, ValueError):  # no working folder, or nothing that can be a path: said where it is read
        return name


def _is_packaged(name: str) -> bool:
    try:
        return (packaged_folder() / f"{name}.yaml").is_file()
    except MissingExtraError:
        return False


def yaml_in_folder(folder: Path) -> Path:
    """Return the only YAML file of `folder`.

    Raises
    ------
    MapError
        If there is none, or several.
    """
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in YAML_SUFFIXES)
    if len(found) == 1:
        return found[0]
    seen = "none" if not found else ", ".join(path.name for path in found[:5])
    raise MapError(f"Map folder {folder} must hold one YAML file, found {seen}: give the path of the YAML file itself.")


def read_description(path: Path, *, packaged: bool = False) -> MapDescription:
    """Read and check a map's YAML file.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    packaged : bool
        Whether it is one of the paper's: there an absolute image path stands for the file of that name beside it.

    Raises
    ------
    MapError
        If the file is missing, too large, not YAML, or has a key that is missing or cannot be used.
    """
    if not path.is_file():
        raise MapError(f"Map file {path} does not exist: expected a map_server YAML file.")
    if path.stat().st_size > MAX_YAML_BYTES:
        raise MapError(f"{path} has {path.stat().st_size:,} bytes, expected at most {MAX_YAML_BYTES:,}: no map file.")
    try:
        content = yaml.load(path.read_bytes(), _MapLoader)  # a SafeLoader
    except Exception as error:  # values such as `!!int ''` make PyYAML raise nearly anything
        raise_refusal(error, path)
        raise MapError(f"{path} is not valid YAML ({error}): expected a map_server map file.") from error
    if not isinstance(content, dict):
        raise MapError(f"{path} holds {type(content).__name__}, expected keys {', '.join(_REQUIRED)}: no map file.")
    missing = [key for key in _REQUIRED if key not in content]
    if missing:
        raise MapError(f"{path} lacks {', '.join(missing)}, expected {', '.join(_REQUIRED)}: add them.")
    resolution = _number(path, "resolution", content["resolution"])
    if not resolution > 0.0:
        raise MapError(f"{path}: resolution is {resolution:g}, expected a positive number of metres: correct it.")
    occupied = _number(path, "occupied_thresh", content["occupied_thresh"])
    free = _number(path, "free_thresh", content["free_thresh"])
    if not 0.0 <= free < occupied <= 1.0:
        raise MapError(
            f"{path}: free_thresh is {free:g} and occupied_thresh {occupied:g}, expected 0 <= free_thresh < "
            "occupied_thresh <= 1: correct them."
        )
    negate = content.get("negate", 0)
    if negate not in (0, 1):
        raise MapError(f"{path}: negate is {_seen(negate)}, expected 0 or 1: correct it.")
    if content.get("mode", "trinary") not in _MODES:
        raise MapError(
            f"{path}: mode is {_seen(content['mode'])}, expected {' or '.join(_MODES)}: export the map in one."
        )
    return MapDescription(
        yaml_path=path.absolute(),
        image_path=_image_path(path, content["image"], packaged),
        resolution=resolution,
        origin=_origin(path, content["origin"]),
        occupied_threshold=occupied,
        free_threshold=free,
        negate=bool(negate),
        mode=str(content.get("mode", "trinary")),
    )


def _seen(value: Any) -> str:
    """Return a value as text."""
    try:
        return repr(str(value))
    except ValueError:  # a whole number of more than 4300 digits has no text
        return "a number of thousands of digits"


def _number(path: Path, key: str, value: Any) -> float:
    try:
        # YAML 1.1 takes 5e-2 for text; map_server does not
        number = float(value) if isinstance(value, int | float | str) and not isinstance(value, bool) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise MapError(f"{path}: {key} is {_seen(value)}, expected a number: correct it.")
    return number


def _origin(path: Path, value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise MapError(f"{path}: origin is {_seen(value)}, expected [x, y, 0]: correct it.")
    numbers = [_number(path, "origin", item) for item in value]
    if len(numbers) == 3 and abs(math.remainder(numbers[2], 2.0 * math.pi)) > _TURN_TOLERANCE:
        raise MapError(
            f"{path}: origin turns the map by {numbers[2]:g} rad, expected 0: rotate the image and set it to 0."
        )
    return numbers[0], numbers[1]


def _image_path(path: Path, image: Any, packaged: bool) -> Path:
    if not isinstance(image, str) or not image or "\0" in image:
        raise MapError(f"{path}: image is {_seen(image)}, expected a file name: correct it.")
    pure = PurePosixPath(image)
    if packaged and pure.is_absolute():
        # cla_glass_hall.yaml names a path of its author's machine
        image, pure = pure.name, PurePosixPath(pure.name)
    windows = PureWindowsPath(image)
    if pure.is_absolute() or windows.is_absolute() or windows.drive or ".." in windows.parts:
        raise MapError(
            f"{path}: image {image!r} is absolute or leaves the folder, expected a file beside the YAML file: "
            "copy the image there and name it."
        )
    found = path.absolute().parent / pure
    if not found.is_file():
        raise MapError(f"{path}: image {image!r} does not exist in {path.parent}: put it there or correct the name.")
    return found


def read_grey(path: Path, rule: str = "ros", mode: str = "trinary") -> tuple[NDArray[np.uint16], int]:
    """Return the sums of a map image's channels and their number; row 0 at the top.

    Its size is checked before it is decoded.

    Parameters
    ----------
    path : pathlib.Path
        PGM or PNG, 8 bits per channel.
    rule : {"original", "ros"}
        As for :func:`occupancy_of`. "ros" takes the channels of colours, as map_server their mean; "original" their
        luma.
    mode : {"trinary", "scale"}
        Of map_server, which counts alpha as a channel in the first only.

    Returns
    -------
    sums : ndarray of shape (rows, columns), uint16
    channels : int

    Raises
    ------
    MapError
        If it is no such image, or too large.

    Notes
    -----
    image_loader.cpp of ROS 1's map_server and map_io.cpp of nav2's.
    """
    if path.stat().st_size > MAX_IMAGE_BYTES:
        raise MapError(f"{path} has {path.stat().st_size:,} bytes, expected at most {MAX_IMAGE_BYTES:,}: crop the map.")
    try:
        with warnings.catch_warnings():
            # ours is the stricter bound
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_FORMATS) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise MapError(
                        f"{path} is {width} x {height} pixels, expected at most {MAX_PIXELS:,}: crop it or halve "
                        "its resolution."
                    )
                if image.mode not in _PIXEL_MODES:
                    raise MapError(f"{path} has pixels of mode {image.mode}, expected 8-bit grey: convert it to that.")
                return _sums(image, rule, mode)
    except MapError:
        raise
    except Image.DecompressionBombError as error:
        raise MapError(
            f"{path} has far more pixels than expected, at most {MAX_PIXELS:,}: crop it or halve its resolution."
        ) from error
    except Exception as error:  # damaged images make pillow raise nearly anything, struct.error and KeyError among it
        raise_refusal(error, path)
        raise MapError(f"{path} cannot be read as an image ({error}): expected a PGM or PNG of 8-bit grey.") from error


def _sums(image: Image.Image, rule: str, mode: str) -> tuple[NDArray[np.uint16], int]:
    alpha = "A" in image.mode or "transparency" in image.info
    if rule == "original" or (image.mode in ("L", "1") and not alpha):
        return np.array(image.convert("L"), dtype=np.uint16), 1
    bands = image.convert("RGBA" if alpha else "RGB").split()
    bands = bands if mode == "trinary" else bands[:3]
    sums = np.zeros((image.height, image.width), np.uint16)
    for band in bands:
        sums += np.asarray(band)
    return sums, len(bands)


def occupancy_of(grey: NDArray[np.integer[Any]], rule: str, negate: bool, channels: int = 1) -> NDArray[np.float32]:
    """Return occupancies indexed [column, row from the bottom], (W, H) float32.

    Parameters
    ----------
    grey : ndarray of shape (H, W), integer
        Grey values from 0 to 255, or sums of them over `channels`. Row 0 at the top.
    rule : {"original", "ros"}
        ``1 - v / 254`` of the original's loader, or ``(255 - v) / 255`` of map_server.
    negate : bool
        Whether white is solid; only with "ros".
    channels : int
        Number of channels in the sums.
    """
    values = np.arange(255 * channels + 1, dtype=np.float64) / channels
    if rule == "original":
        table = 1.0 - values / 254.0
    else:
        table = values / 255.0 if negate else (255.0 - values) / 255.0
    return np.ascontiguousarray(table.astype(np.float32)[grey.T[:, ::-1]])
