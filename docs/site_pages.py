"""How pages of the repository become pages of the site: each text has one source and reads well in both places.

A line ``→ [title](../FILE.md)`` or ``→ [title](../README.md#section)`` is a link in the repository's web view; on the
site the file or section stands in its place. Links follow: what points to a file or section that some page shows goes
to that page. Tables of contents come from `NAVIGATION`.
"""

import ast
import os
import re
from functools import cache
from pathlib import Path, PurePosixPath

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

# page -> pages below it; those without a source are left out
NAVIGATION = {
    "index": ["tour", "guide", "reference", "api/index"],
    "guide": [
        "datasets",
        "tools",
        "environments",
        "policies",
        "zoo",
        "benchmark",
        "experiments",
        "training",
        "robot",
        "scale",
        "examples",
    ],
    "reference": ["differences", "format", "promises", "measurements", "security", "changelog", "contributing"],
    "api/index": [
        f"api/{name}"
        for name in (
            "generate",
            "datasets",
            "shards",
            "sim",
            "policies",
            "envs",
            "observations",
            "models",
            "zoo",
            "evaluate",
            "train",
            "view",
            "doctor",
            "schema",
            "errors",
            "io",
            "testing",
        )
    ],
}
EXAMPLES_PAGE = "examples"

_SHOWN = re.compile(r"^→ \[[^\]]*\]\(([^)#]+)(?:#([^)]+))?\)$", re.M)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|!?\[[^\]]*\]\([^)]*\))*)\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```.*?^```", re.M | re.S)
_HEADING = re.compile(r"^(#+) (.+)$", re.M)


def source_of(page: str) -> Path | None:
    """Return the file that a page is made from, if there is one."""
    return next((path for suffix in (".md", ".rst") if (path := DOCS / f"{page}{suffix}").is_file()), None)


def pages_below(page: str) -> list[str]:
    """Return the pages in a page's table of contents."""
    return [below for below in NAVIGATION[page] if source_of(below)]


def slug(heading: str) -> str:
    """Return the anchor that a heading has in the web view and on the site."""
    return re.sub(r"[^\w\- ]", "", heading.lower().replace("`", "")).replace(" ", "-")


def section(text: str, anchor: str) -> str:
    """Return what stands below a heading, without the heading: all of a section, the introduction of a title."""
    # fenced code may hold lines that look like headings
    headings = list(_HEADING.finditer(_FENCE.sub(lambda m: " " * len(m.group()), text)))
    for i, found in enumerate(headings):
        if slug(found.group(2)) == anchor:
            level = len(found.group(1))
            end = next((m.start() for m in headings[i + 1 :] if len(m.group(1)) <= max(level, 2)), len(text))
            return text[found.end() : end].strip("\n")
    raise ValueError(f"There is no section #{anchor}; there are {[slug(m.group(2)) for m in headings]}.")


@cache
def homes() -> dict[tuple[str, str], str]:
    """Return, for each (file, section) that some page shows, that page. Paths are relative to the repository."""
    found = {}
    for page in sorted(DOCS.glob("*.md")):
        for target, anchor in _SHOWN.findall(page.read_text()):
            found[_in_repository(target, DOCS), anchor or ""] = page.stem
    return found


def _in_repository(target: str, folder: Path) -> str:
    return Path(os.path.normpath(folder / target)).relative_to(ROOT).as_posix()


def _relative(docname: str, page: str) -> str:
    return os.path.relpath(page, PurePosixPath(docname).parent)


def site_link(docname: str, path: str, anchor: str) -> str | None:
    """Return where a link to a repository file goes on the site, as seen from a page; None: nowhere."""
    shown = homes()
    for key, below in (((path, anchor), ""), ((path, ""), anchor)):
        if key in shown:
            return _relative(docname, f"{shown[key]}.md") + (f"#{below}" if below else "")
    if path.startswith("examples/") and path.endswith(".py"):
        return _relative(docname, f"{EXAMPLES_PAGE}.md") + f"#{slug(PurePosixPath(path).name)}"
    if path == "README.md":
        return _relative(docname, "index.md")
    if path.startswith("docs/"):
        return _relative(docname, path.removeprefix("docs/")) + (f"#{anchor}" if anchor else "")
    return None


def adapt_links(docname: str, text: str, folder: Path) -> str:
    """Return text whose relative links, written in a file of `folder`, work from a page of the site."""

    def replace(match: re.Match[str]) -> str:
        image, label, target = match.groups()
        if re.match(r"[a-z]+:", target):
            return match.group()
        path, _, anchor = target.partition("#")
        if not path and folder == DOCS:
            return match.group()
        place = _in_repository(path, folder) if path else "README.md"
        if not (ROOT / place).exists():
            raise ValueError(f"{docname}: the link {target} leads nowhere.")
        link = site_link(docname, place, anchor)
        if link is None:  # not part of the site: the file's name is what a reader can look for
            return f"{label} (`{place}`)" if place not in label else label
        if place.endswith(".html"):
            return f'<a href="{link}">{label}</a>'
        return f"{image}[{label}]({link})"

    parts, end = [], 0
    for fence in _FENCE.finditer(text):
        parts += [_LINK.sub(replace, text[end : fence.start()]), fence.group()]
        end = fence.end()
    return "".join([*parts, _LINK.sub(replace, text[end:])])


def _show(docname: str, match: re.Match[str]) -> str:
    path = _in_repository(match.group(1), DOCS)
    text = (ROOT / path).read_text()
    if match.group(2):
        text = section(text, match.group(2))
    else:
        text = re.sub(r"\A# .*\n", "", text)  # the page has a title of its own
    return adapt_links(docname, text, (ROOT / path).parent)


def _examples() -> str:
    parts = []
    for script in sorted((ROOT / "examples").glob("*.py")):
        first = (ast.get_docstring(ast.parse(script.read_text())) or "").splitlines()[0]
        parts.append(f"## {script.name}\n\n{first}\n\n```{{literalinclude}} ../examples/{script.name}\n```\n")
    return "\n".join(parts)


def _short_title(page: str) -> str:
    source = source_of(page)
    assert source is not None
    return source.read_text().splitlines()[0].removeprefix("# ").split(":")[0]


def adapt_page(docname: str, text: str) -> str:
    """Return a page's source as the site shows it."""
    if not docname.startswith("api/"):
        parts, end = [], 0
        for shown in _SHOWN.finditer(text):
            parts += [adapt_links(docname, text[end : shown.start()], DOCS), _show(docname, shown)]
            end = shown.end()
        text = "".join([*parts, adapt_links(docname, text[end:], DOCS)])
    if docname == EXAMPLES_PAGE:
        text += "\n" + _examples()
    if docname in NAVIGATION:
        entries = [f"{_short_title(page)} <{_relative(docname, page)}>" for page in pages_below(docname)]
        text += "\n\n```{toctree}\n:hidden:\n\n" + "\n".join(entries) + "\n```\n"
    return text
