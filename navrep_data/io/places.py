"""What somebody typed: a name, or the place of something."""

from __future__ import annotations

import os
import re
from pathlib import Path

from navrep_data.errors import ConfigError

HUB_SCHEME = "hf://"
"""How addresses on the Hugging Face Hub begin: ``hf://user/name``."""
REPO_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")
"""What a repository is called: user/name."""
_REVISION = re.compile(r"[A-Za-z0-9][A-Za-z0-9._/-]{0,254}")


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


def parse_repo(text: str, revision: str | None = None) -> tuple[str, str]:
    """Return repository and revision of ``[hf://]user/name[@revision]``.

    Raises
    ------
    ConfigError
        If it is no such name, or names two revisions.
    """
    repo, at, found = text.removeprefix(HUB_SCHEME).partition("@")
    if not REPO_NAME.fullmatch(repo) or ".." in repo or "--" in repo:
        raise ConfigError(f"The repository is {text!r}, expected user/name as on the Hub.")
    if at and revision is not None and found != revision:
        raise ConfigError(f"{text!r} names a revision, and another one is given ({revision!r}): leave one out.")
    chosen = found if at else "main" if revision is None else revision
    if not _REVISION.fullmatch(chosen) or ".." in chosen:
        raise ConfigError(f"The revision is {chosen!r}, expected a branch, tag or commit.")
    return repo, chosen
