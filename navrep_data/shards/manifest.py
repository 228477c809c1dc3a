"""The manifest: which shards a dataset has, with hashes, settings, splits and statistics.

``manifest.json`` is the last thing written, so whatever it lists is in place. It may come from anywhere:
reading checks every field and every file name.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, CorruptDataError, DatasetNotFoundError
from navrep_data.io import atomic_write_bytes, json_bytes, read_json
from navrep_data.schema import FORMAT_NAME, FORMAT_VERSION, SensorContract
from navrep_data.shards._fields import SHA256, Fields
from navrep_data.shards._layout import SCAN_DTYPES, column_order
from navrep_data.shards.entries import (
    EXTRA_NAME,
    INDEX_FILE,
    SHARD_NAMES,
    SPLIT_RULE,
    SPLITS,
    FileEntry,
    Ranges,
    ShardEntry,
    check_version,
    count_of,
    numbers_of,
    split_of,
    worlds_file,
)
from navrep_data.shards.source import parse_datasets, parse_sources
from navrep_data.shards.statistics import check_statistics, merge_statistics

MANIFEST_FILE = "manifest.json"
CARD_FILE = "README.md"
PARTIAL_FIELDS = ("manifest_sha256", "shards", "sequences", "rows")
"""What the manifest of a copy with some of the shards says of the whole: its hash, and how much it has."""
# beyond it float64 is infinite
_MAX_NUMBER = 1e300
_HASH = re.compile(r"[0-9a-f]{32,64}")
_LICENSE = re.compile(r"[a-z0-9][a-z0-9.+-]{0,63}")


@dataclass(frozen=True)
class Manifest:
    """Everything about a dataset but its rows.

    Attributes
    ----------
    env, physics : str
        Environment and physics that made it.
    seed : int
        Dataset seed.
    length : int
        Rows of a sequence (imports: of the longest).
    planned : int
        Sequences asked for.
    shard_size : int
        Sequences per shard.
    scan_dtype : {"uint16", "float32"}
        How scans are stored.
    columns : tuple of str
        Columns, in the schema's order.
    max_humans : int
        Slots of the humans column.
    sensor : SensorContract
        What a scan means.
    config, policy, versions : dict
        Whole configuration, the policy that drove, and versions of what computed it: JSON values.
    inputs : dict of str to str
        SHA-256 of what it was made from beside its settings: ``map:NAME`` of each map's content, ``policy`` of a Python
        policy's file or weights.
    origins : dict of str to (float, float)
        Where coordinates begin: (x, y) [m] in the frame of a map's file (``map:NAME``), or in that of a recording's
        odometry (``recording``); what is not listed begins at (0, 0) there.
    shards : tuple of ShardEntry
        By split, in order of their sequences; gaps only while not complete.
    split_rule : str
        The rule by which sequences got their split, in words.
    complete : bool
        Whether all planned sequences are there.
    statistics : dict
        Merged over shards.
    command : str
        Command line that makes the same dataset, for the card.
    card_sha256 : str or None
        Hash of README.md; None while not complete.
    license : str or None
        Licence identifier of the Hub, once published.
    extras : tuple of FileEntry
        What a published dataset has besides: pictures for its card, an index of its episodes.
    partial : dict or None
        In a copy that holds some shards only: what the whole has: hash of its manifest, shards, sequences, rows.
    source : tuple of dict
        Records of the datasets that this one was made out of, if it was: see ``navrep_data/shards/source.py``.
    format_version : int
        Version of the format.
    """

    env: str
    physics: str
    seed: int
    length: int
    planned: int
    shard_size: int
    scan_dtype: str
    columns: tuple[str, ...]
    max_humans: int
    sensor: SensorContract
    config: dict[str, Any] = field(repr=False)
    policy: dict[str, Any] = field(repr=False)
    versions: dict[str, Any] = field(repr=False)
    inputs: dict[str, str] = field(default_factory=dict, repr=False)
    origins: dict[str, tuple[float, float]] = field(default_factory=dict, repr=False)
    shards: tuple[ShardEntry, ...] = field(default=(), repr=False)
    split_rule: str = SPLIT_RULE
    complete: bool = False
    statistics: dict[str, Any] = field(default_factory=dict, repr=False)
    command: str = ""
    card_sha256: str | None = None
    license: str | None = None
    extras: tuple[FileEntry, ...] = ()
    partial: dict[str, Any] | None = None
    source: tuple[dict[str, Any], ...] = field(default=(), repr=False)
    format_version: int = FORMAT_VERSION

    @property
    def rows(self) -> int:
        """Rows in the listed shards."""
        return sum(shard.rows for shard in self.shards)

    @property
    def sequences(self) -> int:
        """Sequences in the listed shards."""
        return sum(shard.count for shard in self.shards)

    @property
    def splits(self) -> dict[str, Ranges]:
        """Numbers of the sequences of each split, as ranges [start, stop)."""
        return {name: tuple(r for s in self.shards if s.split == name for r in s.sequences) for name in SPLITS}

    @property
    def bytes(self) -> int:
        """Bytes of the listed shards and their worlds."""
        return sum(s.bytes + (s.worlds.bytes if s.worlds else 0) for s in self.shards)

    def with_shards(self, shards: Iterable[ShardEntry], *, complete: bool) -> Manifest:
        """Return a manifest that lists `shards`, with statistics merged in their order.

        Parameters
        ----------
        shards : iterable of ShardEntry
            In any order.
        complete : bool
            Whether these are all planned sequences.
        """
        ordered = tuple(sorted(shards, key=lambda shard: shard.order))
        manifest = replace(
            self,
            shards=ordered,
            complete=complete,
            statistics=merge_statistics(shard.statistics for shard in ordered),
            card_sha256=None,
            extras=(),  # they were made from other shards
            partial=None,
        )
        problem = _check_shards(manifest)
        if problem:
            raise ConfigError(f"These shards are not a dataset: {problem}.")
        return manifest

    def split_of(self, sequence: int) -> str | None:
        """Return the name of the split that holds `sequence`, or None."""
        return next((s.split for s in self.shards if s.position(sequence) is not None), None)

    def place_of(self, sequence: int) -> tuple[int, int] | None:
        """Return the position of the shard that holds `sequence`, and its position there; None if it is not here."""
        for k, shard in enumerate(self.shards):
            at = shard.position(sequence)
            if at is not None:
                return k, at
        return None

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values; the last one, ``manifest_sha256``, is the hash over all before it."""
        values: dict[str, Any] = {
            "format": FORMAT_NAME,
            "format_version": self.format_version,
            "env": self.env,
            "physics": self.physics,
            "seed": self.seed,
            "length": self.length,
            "sequences": self.sequences,
            "rows": self.rows,
            "complete": self.complete,
            "planned": self.planned,
            "shard_size": self.shard_size,
            "scan_dtype": self.scan_dtype,
            "columns": list(self.columns),
            "max_humans": self.max_humans,
            "sensor": self.sensor.to_dict(),
            "config": self.config,
            "policy": self.policy,
            "inputs": self.inputs,
            "origins": {name: list(place) for name, place in self.origins.items()},
            "versions": self.versions,
            "command": self.command,
            "statistics": self.statistics,
            "split_rule": self.split_rule,
            "shards": [_entry_dict(shard) for shard in self.shards],
        }
        # absent where they do not apply, so that what generate writes has never heard of them
        if self.license is not None:
            values["license"] = self.license
        if self.extras:
            values["extras"] = [asdict(entry) for entry in self.extras]
        if self.partial is not None:
            values["partial"] = self.partial
        if self.source:
            values["source"] = list(self.source)
        values["card_sha256"] = self.card_sha256
        values["manifest_sha256"] = _hash(values)
        return values

    @classmethod
    def read(cls, root: Path | str) -> Manifest:
        """Read and check the manifest of a dataset.

        Parameters
        ----------
        root : path-like
            Dataset folder.

        Raises
        ------
        DatasetNotFoundError
            If there is no folder or no manifest in it.
        FileAccessError
            If it is not readable.
        SchemaVersionError
            If it is of another format version than this one reads.
        CorruptDataError
            If a field has another type or value than the format asks for, or names a file outside the folder.
        """
        root = Path(root)
        path = root / MANIFEST_FILE
        if not path.is_file():
            seen = "has no manifest.json" if root.is_dir() else "is not a folder"
            raise DatasetNotFoundError(
                f"No dataset in {root}: it {seen}. Expected a folder written by `navrep-data generate --out {root}`."
            )
        return cls.from_dict(read_json(path), root)

    @classmethod
    def from_dict(cls, values: Any, root: Path) -> Manifest:
        """Return the manifest given by parsed JSON; `root` serves for messages and to check file names.

        Raises
        ------
        SchemaVersionError, CorruptDataError
            As in :meth:`read`.
        """
        fields = Fields(values, root / MANIFEST_FILE)
        if fields.get("format", str) != FORMAT_NAME:
            fields.bad("format", f"{FORMAT_NAME!r}")
        version = fields.count("format_version")
        check_version(str(root), version)
        try:
            manifest = _parse(fields, root)
            digest = _hash(values)
        except RecursionError:
            raise CorruptDataError(f"{root / MANIFEST_FILE} is nested too deeply; get it again.") from None
        problem = _check_shards(manifest)
        if not problem and (manifest.rows, manifest.sequences) != (
            fields.count("rows"),
            fields.count("sequences"),
        ):
            problem = "fields 'rows' and 'sequences' are not the sums over shards"
        if not problem and values.get("manifest_sha256") != digest:
            problem = "field 'manifest_sha256' does not match the other fields"
        if problem:
            raise CorruptDataError(
                f"{root / MANIFEST_FILE}: {problem}. The file was changed or damaged; get it again, "
                "or run the generate command again."
            )
        return manifest

    def save(self, root: Path | str, card: str | None = None) -> Manifest:
        """Write ``manifest.json`` (and before it ``README.md``, if given), each atomically.

        Parameters
        ----------
        root : path-like
            Dataset folder.
        card : str, optional
            Dataset card, of a complete dataset: see :func:`navrep_data.shards.dataset_card`.

        Returns
        -------
        Manifest
            As written, with the card's hash.
        """
        root = Path(root)
        manifest = replace(self, card_sha256=None)
        if card is not None:
            data = card.encode()
            manifest = replace(self, card_sha256=hashlib.sha256(data).hexdigest())
            atomic_write_bytes(root / CARD_FILE, data)
        atomic_write_bytes(root / MANIFEST_FILE, json_bytes(manifest.to_dict()))
        return manifest


def _hash(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json_bytes({k: v for k, v in values.items() if k != "manifest_sha256"})).hexdigest()


def _entry_dict(shard: ShardEntry) -> dict[str, Any]:
    values = asdict(shard)
    values["sequences"] = [list(r) for r in shard.sequences]
    values["sequence_hashes"] = list(shard.sequence_hashes)
    if shard.source:
        values["source"] = [list(one) for one in shard.source]
    else:
        del values["source"]
    return values


def _parse(fields: Fields, root: Path) -> Manifest:
    """Return the manifest behind checked fields; consistency between them is checked elsewhere."""
    scan_dtype = fields.get("scan_dtype", str)
    if scan_dtype not in SCAN_DTYPES:
        fields.bad("scan_dtype", " or ".join(SCAN_DTYPES))
    columns = fields.strings("columns")
    try:
        if column_order(columns) != columns:
            fields.bad("columns", "the columns in the schema's order")
    except ConfigError as error:
        raise CorruptDataError(f"{fields.path}: field 'columns': {error}") from None
    length, max_humans = fields.count("length"), fields.count("max_humans")
    if not 1 <= length < 1 << 31:
        fields.bad("length", "at least 1")
    if max_humans >= 1 << 16 or (max_humans < 1 and "humans" in columns):
        fields.bad("max_humans", "1 to 65535")
    if fields.count("shard_size") < 1:
        fields.bad("shard_size", "at least 1")
    card = fields.values.get("card_sha256")
    source = parse_datasets(fields)
    return Manifest(
        env=fields.get("env", str),
        physics=fields.get("physics", str),
        seed=fields.count("seed"),
        length=length,
        planned=fields.count("planned"),
        shard_size=fields.count("shard_size"),
        scan_dtype=scan_dtype,
        columns=columns,
        max_humans=max_humans,
        sensor=_parse_sensor(fields),
        config=fields.get("config", dict),
        policy=fields.get("policy", dict),
        versions=fields.get("versions", dict),
        inputs=_parse_inputs(fields),
        origins=_parse_origins(fields),
        shards=tuple(
            _parse_shard(fields, k, root, columns, len(source)) for k in range(len(fields.get("shards", list)))
        ),
        split_rule=fields.get("split_rule", str),
        complete=fields.get("complete", bool),
        statistics=_parse_statistics(fields, columns, may_be_empty=True),
        command=fields.get("command", str),
        card_sha256=None if card is None else fields.sha256("card_sha256"),
        **_parse_publication(fields, root),
        source=source,
        format_version=fields.count("format_version"),
    )


def _parse_inputs(fields: Fields) -> dict[str, str]:
    values: dict[str, str] = fields.get("inputs", dict)
    if not all(isinstance(digest, str) and _HASH.fullmatch(digest) for digest in values.values()):
        fields.bad("inputs", "hashes of 32 to 64 hex digits by name")
    return values


def _parse_origins(fields: Fields) -> dict[str, tuple[float, float]]:
    values = fields.get("origins", dict)
    for place in values.values():
        if not (isinstance(place, list) and len(place) == 2 and all(map(_is_number, place))):
            fields.bad("origins", "x and y by name")
    return {name: (float(x), float(y)) for name, (x, y) in values.items()}


def _parse_publication(fields: Fields, root: Path) -> dict[str, Any]:
    """Return the fields that only published datasets and partial copies of them have."""
    license, partial = fields.values.get("license"), fields.values.get("partial")
    if license is not None and check_license(license):
        fields.bad("license", "a licence identifier such as cc-by-4.0")
    extras = fields.get("extras", list) if "extras" in fields.values else []
    if partial is not None:
        whole = Fields(partial, fields.path, "partial.")
        partial = {"manifest_sha256": whole.sha256("manifest_sha256")}
        partial |= {name: whole.count(name) for name in PARTIAL_FIELDS[1:]}
    return {
        "license": license,
        "extras": tuple(_parse_extra(Fields(v, fields.path, f"extras[{k}]."), root) for k, v in enumerate(extras)),
        "partial": partial,
    }


def _parse_extra(fields: Fields, root: Path) -> FileEntry:
    entry = fields.file(root)
    if not EXTRA_NAME.fullmatch(entry.file):
        fields.bad("file", f"{INDEX_FILE}, or a .png or .gif in media")
    return entry


def check_license(license: Any) -> str:
    """Return what is wrong with a licence identifier, or an empty string."""
    if isinstance(license, str) and _LICENSE.fullmatch(license):
        return ""
    return f"the licence is {str(license)!r}, expected an identifier such as cc-by-4.0, cc0-1.0, mit or other"


def _parse_sensor(fields: Fields) -> SensorContract:
    values = fields.get("sensor", dict)
    names = SensorContract().to_dict()
    if set(values) != set(names) or not all(map(_is_number, values.values())):
        fields.bad("sensor", f"numbers named {', '.join(names)}")
    if not isinstance(values["n_rays"], int) or not 1 <= values["n_rays"] <= 1 << 20 or values["range_max"] <= 0:
        fields.bad("sensor", "n_rays of 1 or more and range_max above 0")
    return SensorContract(**values)


def _is_number(value: Any) -> bool:
    """Return whether a value is a number that float64 can hold."""
    return type(value) in (int, float) and abs(value) < _MAX_NUMBER


def _parse_statistics(fields: Fields, columns: Sequence[str], may_be_empty: bool = False) -> dict[str, Any]:
    values: dict[str, Any] = fields.get("statistics", dict)
    problem = "" if not values and may_be_empty else check_statistics(values, columns)
    if problem:
        raise CorruptDataError(f"{fields.path}: field '{fields.prefix}statistics' {problem}; get the file again.")
    return values


def _parse_shard(parent: Fields, index: int, root: Path, columns: Sequence[str], datasets: int) -> ShardEntry:
    prefix = f"shards[{index}]."
    fields = Fields(parent.values["shards"][index], parent.path, prefix)
    file = fields.file(root)
    split = fields.get("split", str)
    if split not in SPLITS:
        fields.bad("split", " or ".join(SPLITS))
    if not SHARD_NAMES[split].fullmatch(file.file):
        fields.bad("file", f"data/{split}-, a number and .h5, as files of split {split} are called")
    worlds = None
    if fields.values.get("worlds") is not None:
        beside = Fields(fields.values["worlds"], parent.path, prefix + "worlds.")
        worlds = beside.file(root)
        expected = worlds_file(file.file)
        if worlds.file != expected:
            beside.bad("file", f"{expected}, beside {file.file}")
    sequences = fields.ranges("sequences")
    count = count_of(sequences)
    hashes = fields.strings("sequence_hashes")
    if len(hashes) != count or not all(SHA256.fullmatch(h) for h in hashes):
        fields.bad("sequence_hashes", f"{count} hashes of 64 hex digits, one for each number in `sequences`")
    return ShardEntry(
        file=file.file,
        sha256=file.sha256,
        bytes=file.bytes,
        rows=fields.count("rows"),
        split=split,
        sequences=sequences,
        worlds=worlds,
        statistics=_parse_statistics(fields, columns),
        sequence_hashes=hashes,
        source=parse_sources(fields, datasets, count),
    )


def _check_shards(manifest: Manifest) -> str:
    """Return what is wrong with the list of shards, or an empty string."""
    if list(manifest.shards) != sorted(manifest.shards, key=lambda shard: shard.order):
        return "its shards are not in the order of their splits and sequences"
    for shard in manifest.shards:
        if not shard.count <= shard.rows <= shard.count * manifest.length:
            return f"{shard.file} has {shard.rows} rows for {shard.count} sequences of at most {manifest.length}"
        if manifest.split_rule == SPLIT_RULE:
            odd = next((k for k in numbers_of(shard.sequences) if split_of(k) != shard.split), None)
            if odd is not None:
                return f"{shard.file} of split {shard.split} holds sequence {odd}, which is of split {split_of(odd)}"
    held = sorted((start, stop, shard.file) for shard in manifest.shards for start, stop in shard.sequences)
    for one, other in itertools.pairwise(held):
        if other[0] < one[1]:
            return f"{other[2]} holds sequence {other[0]}, which {one[2]} holds too"
    files = [s.file for s in manifest.shards] + [s.worlds.file for s in manifest.shards if s.worlds]
    files += [CARD_FILE, MANIFEST_FILE, *(entry.file for entry in manifest.extras)]
    if len(set(files)) != len(files):
        return "a file is listed twice"
    if not manifest.complete:
        return ""
    if manifest.partial is not None:
        return "it is marked both complete and partial"
    for stop, (start, _, _) in zip([0, *(h[1] for h in held)], [*held, (manifest.planned, 0, "")], strict=True):
        if start != stop:
            return f"it is marked complete, but does not hold the sequences {stop} to {start - 1}"
    return ""
