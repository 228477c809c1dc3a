"""Files: cache folder, atomic writes, hashing, bounded reading, checked downloads."""

from navrep_data.io._files import (
    PART_SUFFIX,
    atomic_write_bytes,
    atomic_write_json,
    cache_dir,
    fsync_dir,
    json_bytes,
    raise_refusal,
    read_json,
    reading,
    safe_join,
    sha256_bytes,
    sha256_file,
    translate_os_error,
)
from navrep_data.io.download import FileId, download, git_blob_sha1, is_offline, switched_off
from navrep_data.io.folders import new_folder
from navrep_data.io.interrupts import without_interrupts
from navrep_data.io.places import HUB_SCHEME, REPO_NAME, here_hint, is_path, parse_repo

__all__ = [
    "HUB_SCHEME",
    "PART_SUFFIX",
    "REPO_NAME",
    "FileId",
    "atomic_write_bytes",
    "atomic_write_json",
    "cache_dir",
    "download",
    "fsync_dir",
    "git_blob_sha1",
    "here_hint",
    "is_offline",
    "is_path",
    "json_bytes",
    "new_folder",
    "parse_repo",
    "raise_refusal",
    "read_json",
    "reading",
    "safe_join",
    "sha256_bytes",
    "sha256_file",
    "switched_off",
    "translate_os_error",
    "without_interrupts",
]
