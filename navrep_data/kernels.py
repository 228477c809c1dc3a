"""The decorator of all compiled kernels: the only file of the package that uses numba's own.

numba caches each compiled function by the time stamp of its own file. A function that calls kernels of other files
is therefore not compiled again when those change, and the stale machine code goes on with old array layouts: seen here
as memory corruption after an edit, and bound to happen to anybody who updates a checkout. So the cache folder carries a
fingerprint of all kernel sources, of what they import, and of the compiler switches that numba's own key leaves out.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba import njit, types

from navrep_data.io import cache_dir

_USES_KERNELS = re.compile(rb"^@kernel\b", re.MULTILINE)
_IMPORT = re.compile(
    rb"^\s*(?:from\s+(navrep_data[\w.]*)\s+import\s+(\([^)]*\)|[^\n(]*)|import\s+(navrep_data[\w.]*))", re.MULTILINE
)


def _module(package: Path, name: str) -> Path | None:
    stem = package.joinpath(*name.split(".")[1:])
    return next((path for path in (stem.with_suffix(".py"), stem / "__init__.py") if path.is_file()), None)


def _imported(source: bytes, package: Path) -> Iterator[Path]:
    """Yield the files of `package` that a module imports: a name's own where it is a module, else where it is from."""
    for match in _IMPORT.finditer(source):
        base = (match[1] or match[3]).decode()
        names = [f"{base}.{word.decode()}" for word in re.findall(rb"\w+", match[2] or b"")]
        for path in [_module(package, name) or _module(package, base) for name in names or [base]]:
            if path is not None:
                yield path


def kernel_sources(package: Path) -> dict[Path, bytes]:
    """Return the files of `package` that decide what compiled kernels do, with their text.

    These are the modules with kernels, whatever they import (constants are compiled in), and this one.
    """
    sources = {path: path.read_bytes() for path in package.rglob("*.py")}
    this = package / Path(__file__).name
    found = {path for path, source in sources.items() if _USES_KERNELS.search(source)} | {this}
    todo = found - {this}  # what the decorator itself imports is in no kernel
    while todo:
        new = {path for source in todo for path in _imported(sources[source], package)} - found
        found |= new
        todo = new
    return {path: sources[path] for path in sorted(found)}


@cache
def _cache_folder() -> str:
    digest = hashlib.sha256()
    package = Path(__file__).parent
    for path, source in kernel_sources(package).items():
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + source)
    config: Any = numba.config  # untyped: its switches are set dynamically
    switches = (numba.__version__, llvmlite.__version__, config.BOUNDSCHECK, config.OPT, config.DEBUG_JIT)
    digest.update(repr(switches).encode())
    base = Path(config.CACHE_DIR) if config.CACHE_DIR else cache_dir() / "kernels"
    return str(base / f"navrep-data-{digest.hexdigest()[:16]}")


def kernel_cache_folder() -> Path:
    """Return the folder that compiled kernels are kept in (not created)."""
    return Path(_cache_folder())


def kernel(function: Callable[..., Any] | None = None, *, inline: bool = False) -> Any:
    """Compile `function` on first use, with numpy's error model, and keep it in a cache folder of its own.

    Kernels let go of the interpreter's lock, so that batches of worlds step side by side in threads.

    Where the folder cannot be written the kernel is compiled in every process anew.

    Parameters
    ----------
    function : callable, optional
        Plain function on arrays and numbers; without it a decorator is returned: ``@kernel(inline=True)``.
    inline : bool
        Whether the compiler must build the function into each of its callers.

    Notes
    -----
    A kernel has two sides, so that a first run compiles for half as long. The one that Python calls has a wrapper that
    takes arrays apart, which is mostly more code than the kernel. The one that other kernels call has none, and is
    compiled once for all numbers: numba would compile it for each constant that it is called with. ``prepare`` of what
    is returned compiles that second side alone, for arguments of these types, without a call.
    """
    if function is None:
        return lambda function: kernel(function, inline=inline)
    config: Any = numba.config
    if config.DISABLE_JIT:
        return function
    options = {"nogil": True, "error_model": "numpy", "forceinline": inline, "no_cfunc_wrapper": True}
    outer = _compiled(function, "from-python", options)
    inner = _compiled(function, "from-kernels", {**options, "no_cpython_wrapper": True})

    def get_call_template(args: Iterable[Any], kws: Mapping[str, Any]) -> Any:
        unliteral: Any = types.unliteral
        return inner.get_call_template([unliteral(a) for a in args], {k: unliteral(a) for k, a in kws.items()})

    # what numba asks a function for that a kernel calls
    outer.get_call_template, outer.get_overload = get_call_template, inner.get_overload
    typeof: Any = numba.typeof
    outer.prepare = lambda arguments: inner.compile(tuple(map(typeof, arguments)))
    return outer


def is_missing(compiled: Any) -> bool:
    """Return whether a kernel that Python calls is not in the cache folder, and would be kept there.

    It is not looked for which types of arguments it was compiled.
    """
    folder = getattr(getattr(compiled, "stats", None), "cache_path", None)  # None: plain Python, or no cache
    return folder is not None and not any(Path(folder).glob(f"*.{compiled.__name__}-*.nbi"))


def _compiled(function: Callable[..., Any], side: str, options: Mapping[str, Any]) -> Any:
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(kernel_cache_folder() / side)
    try:
        return njit(function, cache=True, **options)
    except (OSError, RuntimeError):
        return njit(function, **options)
    finally:
        config.CACHE_DIR = before
