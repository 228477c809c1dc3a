"""Opening files that may come from anywhere: sizes are known before anything is read."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import BinaryIO

from navrep_data.errors import CheckpointError
from navrep_data.io import raise_refusal
from navrep_data.io.npz import PLAIN_METHODS

HEADROOM = 1 << 16
"""Bytes allowed beside the numbers themselves."""
MAX_MEMBERS = 1000
"""Members that a zip may have; the released ones have three, or one per tensor."""


def opened(path: Path) -> BinaryIO:
    """Open a file for reading; says how to get it where it is missing."""
    try:
        return open(path, "rb")
    except FileNotFoundError as error:
        raise CheckpointError(f"There is no file {path}; fetch it with: navrep-data models fetch NAME") from error


def check_size(path: Path, limit: int, what: str) -> None:
    """Raise CheckpointError for a file of more than `limit` bytes."""
    with opened(path) as handle:
        size = handle.seek(0, io.SEEK_END)
    if size > limit:
        raise CheckpointError(f"{path} has {size:,} bytes, expected at most {limit:,} for {what}; it is not read.")


def zip_members(path: Path, limit: int) -> dict[str, zipfile.ZipInfo]:
    """Return the members of a zip by name, whose sizes unpacked sum up to `limit` at most."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
    except Exception as error:  # damaged archives raise a dozen kinds, struct.error among them
        raise_refusal(error, path)
        raise CheckpointError(f"{path} is no zip file ({error}); pickles are never read, so expected a zip.") from error
    total = sum(info.file_size for info in infos)
    members = {info.filename: info for info in infos}
    if len(infos) > MAX_MEMBERS or len(members) != len(infos) or total > limit:
        raise CheckpointError(
            f"{path} unpacks to {len(infos)} members of {total:,} bytes, expected at most {MAX_MEMBERS} of {limit:,}, "
            "each name once; it is not read."
        )
    return members


def read_member(path: Path, info: zipfile.ZipInfo) -> bytes:
    """Return what a member of a zip unpacks to, never more than it claims."""
    try:
        if info.compress_type not in PLAIN_METHODS:
            raise ValueError(f"packed by method {info.compress_type}, expected stored or deflated")
        with zipfile.ZipFile(path) as archive, archive.open(info) as member:
            return member.read(info.file_size)
    except Exception as error:  # zlib.error among them
        raise_refusal(error, path)
        raise CheckpointError(f"{path}: {info.filename!r} cannot be unpacked ({error}).") from error
