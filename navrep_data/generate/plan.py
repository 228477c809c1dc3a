"""What a run will do, decided and checked before anything is simulated or written."""

from __future__ import annotations

import platform
import shutil
import sys
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from navrep_data._version import __version__
from navrep_data.errors import (
    ConfigError,
    DatasetMismatchError,
    DiskSpaceError,
    FolderInUseError,
    FolderNotWritableError,
    check_whole,
)
from navrep_data.generate.inputs import check_unchanged, inputs_of, origins_of
from navrep_data.generate.parts import PARTS, Part
from navrep_data.generate.policy import DatasetPolicy
from navrep_data.generate.storage import STAGING
from navrep_data.generate.worker import DatasetSpec, ShardTask, all_shards
from navrep_data.io import PART_SUFFIX
from navrep_data.io._files import MAX_JSON_BYTES
from navrep_data.schema import COLUMNS, MAX_LABELLED, UINT16_RANGE_LIMIT
from navrep_data.shards import LOCK_FILE, MANIFEST_FILE, MAX_SHARD_BYTES, Manifest, estimate_bytes
from navrep_data.sim import RolloutSettings, SimConfig
from navrep_data.sim.config import complete as complete_config
from navrep_data.sim.rollout import check_rings

DEFAULT_SHARD_ROWS = 20_000
MAX_SEQUENCES = 2**31 - 1
MAX_LENGTH = 100_000
# An estimate of compressed size is good to a few per cent; ask for a little more.
DISK_MARGIN = 1.1
# What a manifest lists: names, hashes and statistics per shard, a hash per sequence (measured: 6.1 kB and 72 bytes).
_MANIFEST_SHARD_BYTES = 6_500
_MANIFEST_SEQUENCE_BYTES = 75
_GENERATED_COLUMNS = tuple(name for name in COLUMNS if not name.startswith(("leading_", "source_")))


@dataclass(frozen=True)
class Request:
    """What the user asked for, checked field by field."""

    spec: DatasetSpec
    n: int
    shard_size: int
    command: str
    part: Part | None = None

    @property
    def home(self) -> Path:
        """The folder of the manifest: the dataset's own, but for parts."""
        return self.spec.root if self.part is None else self.spec.root / self.part.folder

    @cached_property
    def shards(self) -> list[ShardTask]:
        """The shards that are asked for: all, but for parts."""
        everything = all_shards(self.n, self.shard_size)
        return everything if self.part is None else self.part.share(everything)

    @property
    def sequences(self) -> int:
        """Number of sequences in these shards."""
        return self.n if self.part is None else sum(task.stop - task.first for task in self.shards)

    @property
    def rows(self) -> int:
        """Rows of the finished dataset, or part."""
        return self.sequences * self.spec.settings.length

    @property
    def bytes(self) -> int:
        """Estimated bytes of the finished dataset, or part."""
        return int(self.rows * bytes_per_row(self.spec))


def largest_shard(spec: DatasetSpec) -> int:
    """Return how many sequences a shard may have: it is built in memory."""
    return max(1, int(MAX_SHARD_BYTES / (bytes_per_row(spec) * spec.settings.length)))


def bytes_per_row(spec: DatasetSpec) -> float:
    """Return the estimated compressed size of a row of this dataset [bytes]."""
    rows = 1_000_000
    estimate = estimate_bytes(
        spec.columns, rows, n_rays=spec.config.sensor.n_rays, scan_dtype=spec.settings.scan_dtype,
        max_humans=spec.config.max_others,
    )  # fmt: skip
    return estimate / rows


def check_settings(
    config: SimConfig, length: int, scan_dtype: str | None, rings: bool, humans: bool, labels: bool = False
) -> RolloutSettings:
    """Return the settings of the rows; chooses float32 scans by itself where millimetres do not fit 16 bits."""
    far = config.sensor.range_max > UINT16_RANGE_LIMIT
    if scan_dtype not in (None, "uint16", "float32"):
        raise ConfigError(f"--scan-dtype is {scan_dtype!r}, expected uint16 (millimetres) or float32 (metres).")
    if far and scan_dtype == "uint16":
        raise ConfigError(
            f"--scan-dtype uint16 holds ranges up to {UINT16_RANGE_LIMIT:g} m, but range_max is "
            f"{config.sensor.range_max:g} m; use float32."
        )
    check_rings(config, rings)
    if labels and config.max_humans > MAX_LABELLED:
        raise ConfigError(
            f"--labels with up to {config.max_humans} humans: a label has 8 bits, expected at most {MAX_LABELLED}."
        )
    chosen = scan_dtype or ("float32" if far else "uint16")
    return RolloutSettings(
        check_whole("--length", length, 1, MAX_LENGTH), chosen, rings, humans and config.max_others > 0, labels,
        contact=config.on_collision == "damage",
    )  # fmt: skip


def make_request(
    root: Path, config: SimConfig, settings: RolloutSettings, policy: DatasetPolicy, seed: int, n: int,
    shard_size: int | None, storage: str | None = None, part: Part | None = None,
) -> Request:  # fmt: skip
    """Return the checked request; chooses the shard size where none is given."""
    n = check_whole("--n", n, 1, MAX_SEQUENCES)
    chosen = {"rings": settings.rings, "scan_label": settings.labels, "contact": settings.contact,
              "humans": settings.humans}  # fmt: skip
    columns = tuple(name for name in _GENERATED_COLUMNS if chosen.get(name, True))
    spec = DatasetSpec(root, config, settings, policy, seed, columns, storage, inputs_of(config, policy))
    largest = largest_shard(spec)
    if shard_size is None:
        shard_size = min(largest, max(policy.batch, DEFAULT_SHARD_ROWS // settings.length, 1))
    shard_size = check_whole("--shard-size", shard_size, 1, MAX_SEQUENCES)
    if shard_size > largest:
        raise ConfigError(
            f"--shard-size is {shard_size}, expected at most {largest} sequences of {settings.length} rows: a shard is "
            f"built in memory and may take {MAX_SHARD_BYTES >> 20} MiB."
        )
    return Request(spec, n, shard_size, "", part)


def check_manifest(request: Request) -> None:
    """Refuse what would end, after days perhaps, in a manifest that is too large to be read.

    Raises
    ------
    ConfigError
        Naming a shard size that will do.
    """
    hashes = request.n * _MANIFEST_SEQUENCE_BYTES
    if hashes - (-request.n // request.shard_size) * _MANIFEST_SHARD_BYTES <= MAX_JSON_BYTES:
        return
    room = (MAX_JSON_BYTES - hashes) // _MANIFEST_SHARD_BYTES
    enough = -(-request.n // room) if room > 0 else request.n
    todo = f"give --shard-size {enough} or more"
    if enough > largest_shard(request.spec):
        todo = "make several datasets, or longer sequences"
    raise ConfigError(
        f"{request.n:,} sequences in shards of {request.shard_size} would need a manifest larger than "
        f"{MAX_JSON_BYTES >> 20} MiB, the most that is read: {todo}."
    )


def versions() -> dict[str, str]:
    """Return the versions that the bytes of a dataset depend on; no time, host or speed."""
    import llvmlite.binding as llvm

    names = ("numpy", "numba", "llvmlite", "h5py", "deflate")
    return {
        "navrep_data": __version__,
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        **{name: version(name) for name in names},
        "machine": platform.machine(),
        "cpu": str(llvm.get_host_cpu_name()),
    }


def new_manifest(request: Request) -> Manifest:
    """Return the manifest of a dataset without shards."""
    spec = request.spec
    return Manifest(
        env=spec.config.env,
        physics=spec.config.physics,
        seed=spec.seed,
        length=spec.settings.length,
        planned=request.n,
        shard_size=request.shard_size,
        scan_dtype=spec.settings.scan_dtype,
        columns=spec.columns,
        max_humans=spec.config.max_others if spec.settings.humans else 0,
        sensor=spec.config.sensor,
        config=spec.config.to_dict(),
        policy=spec.policy.to_dict(),
        inputs=dict(spec.inputs),
        origins=origins_of(spec.config),
        versions=versions(),
        command=request.command,
    )


def check_folder(root: Path, part: Part | None = None) -> None:
    """Make sure that `root` is a folder of ours, empty, or can be made.

    For a part of a job array, its own folder is made as well.

    Raises
    ------
    FolderInUseError
        If it holds anything that is not a dataset.
    FolderNotWritableError
        If it cannot be made.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        others = {p.name for p in root.iterdir()}
        if part is not None and (PARTS in others or not others - {LOCK_FILE}):
            (root / part.folder).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise FolderInUseError(f"{root} is or lies under a file, expected a folder; choose another --out.") from None
    except OSError as error:
        raise FolderNotWritableError(
            f"Cannot make the folder {root}: {error.strerror}; choose another --out."
        ) from error
    if (root / MANIFEST_FILE).exists():
        return
    if PARTS in others:
        if part is None:
            raise FolderInUseError(
                f"{root} holds parts of a job array; expected --shard-range to go on with them. Once all are there: "
                f"navrep-data merge-manifest {root}"
            )
        return
    own = {LOCK_FILE, STAGING}
    other = sorted(name for name in others if name not in own and not name.endswith(PART_SUFFIX))
    if other:
        raise FolderInUseError(
            f"{root} holds something else ({', '.join(other[:3])}{', ...' if len(other) > 3 else ''}) and no "
            "manifest.json; expected an empty or new folder, or a dataset to go on with. Choose another --out."
        )


def check_same(old: Manifest, request: Request, explicit_shard_size: bool) -> None:
    """Make sure that an existing dataset was made with the settings of this request, all but n and on the same maps.

    Raises
    ------
    DatasetMismatchError
        Naming the first field that differs.
    """
    if old.source:
        raise DatasetMismatchError(
            f"{request.spec.root} was made out of other datasets ({old.command}), so generate cannot go on with it; "
            "choose another --out."
        )
    new = new_manifest(request)
    pairs: list[tuple[str, Any, Any]] = [
        ("env", old.env, new.env),
        ("physics", old.physics, new.physics),
        ("seed", old.seed, new.seed),
        ("length", old.length, new.length),
        ("scan_dtype", old.scan_dtype, new.scan_dtype),
        ("policy", old.policy.get("name"), new.policy.get("name")),
        ("policy_batch", old.policy.get("batch"), new.policy.get("batch")),
        ("split_rule", old.split_rule, new.split_rule),
        ("columns", ", ".join(old.columns), ", ".join(new.columns)),
    ]
    # fields at their defaults are left out of stored configs, and older versions did not know all of them
    before, after = complete_config(old.config), complete_config(new.config)
    pairs += [(key, before.get(key), value) for key, value in after.items() if key != "maps"]
    if explicit_shard_size:
        pairs.append(("shard_size", old.shard_size, new.shard_size))
    for field, seen, asked in pairs:
        if seen != asked:
            raise DatasetMismatchError(
                f"{request.spec.root} was made with {field}={seen}, asked for {field}={asked}; "
                "repeat the old setting to go on with it, or choose another --out."
            )
    check_unchanged(request.spec.root, old, request.spec.config, request.spec.inputs)
    if request.n < old.planned:
        raise DatasetMismatchError(
            f"{request.spec.root} was made with n={old.planned}, asked for n={request.n}; a dataset only grows: "
            "give the same --n or a larger one, or choose another --out."
        )


def check_space(request: Request, done_rows: int) -> None:
    """Make sure that what is still to be written fits the disk.

    Raises
    ------
    DiskSpaceError
        Naming both sizes.
    """
    if request.spec.storage is not None:
        return  # nobody can tell how much room is behind a URL
    needed = int((request.rows - done_rows) * bytes_per_row(request.spec) * DISK_MARGIN)
    free = shutil.disk_usage(request.spec.root).free
    if needed > free:
        raise DiskSpaceError(
            f"{request.spec.root} has {free / 1e9:.2f} GB free, about {needed / 1e9:.2f} GB are needed for "
            f"{request.sequences} sequences; free some space, choose another --out or a smaller --n."
        )
