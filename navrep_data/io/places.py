"""What somebody typed: a name, or the place of something."""

from __future__ import annotations

import os
from pathlib import Path

HUB_SCHEME = "hf://"
"""How addresses on the Hugging Face Hub begin: ``hf://user/name``."""


def is_path(name: str | os.PathLike[str]) -> bool:
    """Return whether something is named by its place: ``./folder``, ``hf://user/name``, ``FILE.safetensors``, a path.

    A bare word is always a name, so that no folder that happens to lie here changes what a command does.
    """
    if not isinstance(name, str):
        return True
    return "/" in name or os.sep in name or name in (".", "..") or name.startswith("~") or name.endswith(".safetensors")


def here_hint(name: str) -> str:
    """Return a sentence on a file or folder that an unknown name may mean, empty where there is none."""
    bare = name and not is_path(name)
    return f" There is a ./{name} here: to name that, write ./{name}." if bare and Path(name).exists() else ""
