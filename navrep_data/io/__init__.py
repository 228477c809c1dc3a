"""Files: cache folder, atomic writes, hashing, bounded reading."""

from navrep_data.io._files import (
    PART_SUFFIX,
    atomic_write_bytes,
    atomic_write_json,
    cache_dir,
    fsync_dir,
    json_bytes,
    read_json,
    safe_join,
    sha256_bytes,
    sha256_file,
    translate_os_error,
)

__all__ = [
    "PART_SUFFIX",
    "atomic_write_bytes",
    "atomic_write_json",
    "cache_dir",
    "fsync_dir",
    "json_bytes",
    "read_json",
    "safe_join",
    "sha256_bytes",
    "sha256_file",
    "translate_os_error",
]
