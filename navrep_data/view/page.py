"""The page itself: template, style and script from the package's files, data as inert blocks, a strict policy.

Nothing that comes from a dataset is ever markup or code: texts travel in one JSON block in which ``<``, ``>`` and ``&``
are escaped, arrays in base64, and the script puts texts on the page as text nodes only. The content security policy
allows the page's own script and style by hash, and neither network nor injected markup.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from navrep_data.errors import DatasetNotFoundError, FolderInUseError
from navrep_data.io import atomic_write_bytes

MARK = "<!doctype html>\n<!-- made by navrep-data view -->\n"
"""What our pages begin with; other files are not overwritten."""
DEFAULT_MAX_BYTES = 6_000_000
MIN_MAX_BYTES = 100_000
"""A page without any data has about 60 kB."""
_SHARED = ("inflate.js", "core.js", "draw.js", "player.js")
_SCRIPTS = {
    "dataset": (*_SHARED, "sensors.js", "world.js", "dataset.js"),
    "results": (*_SHARED, "results.js"),
}
_LONGEST_TEXT = 300


@dataclass(frozen=True)
class Page:
    """A finished page.

    Attributes
    ----------
    html : bytes
        The whole file.
    notes : tuple of str
        What was left out, and why; the page says so too.
    """

    html: bytes
    notes: tuple[str, ...] = ()

    def write(self, path: Path | str) -> Path:
        """Write the page whole, or leave what was there.

        Parameters
        ----------
        path : path-like
            The file; an earlier page is replaced.

        Raises
        ------
        FolderInUseError
            If `path` is something else than a page of ours.
        DatasetNotFoundError
            If its folder does not exist.
        """
        target = Path(path)
        if target.exists() and not _is_ours(target):
            raise FolderInUseError(f"{target} exists and is not a page of ours; choose another file with --out.")
        if not target.parent.is_dir():
            raise DatasetNotFoundError(f"There is no folder {target.parent}; make it, or choose another --out.")
        atomic_write_bytes(target, self.html)
        return target


def _is_ours(path: Path) -> bool:
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(len(MARK)) == MARK.encode()


def clip(text: object, longest: int = _LONGEST_TEXT) -> str:
    """Return a text from outside, cut to a length that a page can show."""
    whole = str(text)
    return whole if len(whole) <= longest else whole[: longest - 1] + "…"


def json_block(value: Any) -> str:
    """Return JSON that cannot end a script element or begin another one: no ``<``, ``>`` or ``&`` in it."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _asset(name: str) -> str:
    return (files("navrep_data.view") / "assets" / name).read_text(encoding="utf-8")


def _source(text: str) -> str:
    """Return the policy's name for an inline script or style."""
    return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"


def assemble(kind: str, meta: dict[str, Any], blobs: Sequence[str]) -> bytes:
    """Return the page.

    Parameters
    ----------
    kind : {"dataset", "results"}
        Which template.
    meta : dict
        Plain JSON values that the page's script reads.
    blobs : sequence of str
        Base64 streams; `meta` refers to them by position.
    """
    # The policy's hash is of exactly what stands between the tags.
    style = "\n" + _asset("view.css")
    script = "\n(() => {\n'use strict';\n" + "\n".join(_asset(name) for name in _SCRIPTS[kind]) + "\n})();\n"
    policy = (
        f"default-src 'none'; script-src {_source(script)}; style-src {_source(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'; require-trusted-types-for 'script'; trusted-types 'none'"
    )
    data = [f'<script type="application/json" id="meta">{json_block(meta)}</script>']
    data += [f'<script type="text/plain" id="blob-{k}">{blob}</script>' for k, blob in enumerate(blobs)]
    body = _asset(f"{kind}.html")
    # One pass over fixed marks of our own template: values are never searched for marks.
    head, middle = _asset("head.html").split("<!--policy-->")
    return "".join(
        [MARK, head, f'<meta http-equiv="Content-Security-Policy" content="{policy}">', middle,
         f"<style>{style}</style>\n</head>\n<body>\n", body, "\n", *(f"{d}\n" for d in data),
         f"<script>{script}</script>\n</body>\n</html>\n"]
    ).encode()  # fmt: skip
