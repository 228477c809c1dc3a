"""The decorator of all compiled kernels.

numba caches each compiled function by the time stamp of its own file. A function that calls kernels of other files
is therefore not compiled again when those change, and the stale machine code goes on with old array layouts: seen here
as memory corruption after an edit, and bound to happen to anybody who updates a checkout. So the cache folder carries a
fingerprint of all kernel sources and of the compiler switches that numba's own key leaves out.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba import njit

from navrep_data.io import cache_dir


@cache
def _cache_folder() -> str:
    digest = hashlib.sha256()
    package = Path(__file__).parent
    # kernels, and the constants that they compile in
    sources = [path for path in package.rglob("_*.py") if not path.name.startswith("__")]
    for path in sorted([*sources, package / "schema.py"]):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    config: Any = numba.config  # untyped: its switches are set dynamically
    digest.update(repr((numba.__version__, config.BOUNDSCHECK, config.OPT, config.DEBUG_JIT)).encode())
    base = Path(config.CACHE_DIR) if config.CACHE_DIR else cache_dir() / "kernels"
    return str(base / f"navrep-data-{digest.hexdigest()[:16]}")


def kernel_cache_folder() -> Path:
    """Return the folder that compiled kernels are kept in (not created)."""
    return Path(_cache_folder())


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` on first use, with numpy's error model, and keep it in a cache folder of its own.

    Kernels let go of the interpreter's lock, so that batches of worlds step side by side in threads.

    Where the folder cannot be written the kernel is compiled in every process anew.
    """
    config: Any = numba.config
    if config.DISABLE_JIT:
        return function
    before = config.CACHE_DIR
    config.CACHE_DIR = _cache_folder()
    try:
        return njit(function, cache=True, nogil=True, error_model="numpy")
    except (OSError, RuntimeError):
        return njit(function, nogil=True, error_model="numpy")
    finally:
        config.CACHE_DIR = before
