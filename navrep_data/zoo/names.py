"""Names of checkpoints: ``{architecture}_{lidar}_{features}.{tag}``, and what a shorter name stands for.

Notes
-----
A tag is ``released`` (the authors' run that we recommend), a day such as ``20201004`` (a given run of theirs), or
``v1`` (trained by this project). What an untagged name means is fixed below; it never depends on what is cached or
reachable, and changing a line of it is a change of format (CHANGELOG).
"""

from __future__ import annotations

RELEASED = "released"
OWN = "v1"

UNTAGGED_ARE_OURS = frozenset(
    f"{kind}_{lidar}{features}"
    for kind in ("modular", "joint", "transformer")
    for lidar in ("rings", "1d")
    for features in ("", "_z")
) | {"e2e_1d"}
"""Variants whose untagged name is ``.v1``, which the package holds; that of all others is ``.released``."""

RELEASED_RULE = (
    "Of the runs of a variant, the one that was started last, runs that their own file name calls partial excepted. "
    "Why: the authors published one V, M or W file per architecture, and the last run is the one most likely trained "
    "on that very file. No score was looked at, so scores of `.released` are not picked from several."
)
"""How the run behind ``.released`` was chosen."""

WILDCARDS = "*?["


SHIPPED_BYTES = 45_000_000
"""The weights in the package take at most this much."""


def split_name(name: str) -> tuple[str, str | None]:
    """Return variant and tag of a name; the tag is None where the name has none.

    Examples
    --------
    >>> split_name("e2e_1d.20201026")
    ('e2e_1d', '20201026')
    >>> split_name("e2e_rings")
    ('e2e_rings', None)
    """
    variant, dot, tag = name.partition(".")
    return variant, tag if dot else None


def default_tag(variant: str) -> str:
    """Return the tag that an untagged `variant` stands for."""
    return OWN if variant in UNTAGGED_ARE_OURS else RELEASED


def alias_line(alias: str, full: str) -> str:
    """Return the line that tells whose weights an untagged name loaded.

    Parameters
    ----------
    alias : str
        What the user typed, without tag.
    full : str
        Full name of the checkpoint.
    """
    if split_name(full)[1] == OWN:
        whose = f"trained by navrep-data, NOT the NavRep authors' weights (those: {alias}.{RELEASED})"
    else:
        whose = f"the NavRep authors' weights ({alias}.{RELEASED})"
    return f"{alias} -> {full}: {whose}"
