"""The README and docs/: code blocks run as a reader would run them, commands parse, links lead somewhere."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path

import pytest
import typer
from recorded import AUTHORS
from warm_process import WarmProcess, shared

import navrep_data
from navrep_data.cli.main import app
from navrep_data.testing import tiny_dataset

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = [README, *sorted(DOCS.glob("*.md"))]
TEXTS = [
    *PAGES,
    *(ROOT / name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")),
    DOCS / "api" / "index.md",
]
# What sets up a machine is run by .ci/run and the Makefile itself, not from inside the tests.
SETUP = ("pip ", "make ")
# These pages make their own data; the others find a small data/soadrl.
FROM_SCRATCH = ("README", "tour")


def blocks(page, kinds=("bash", "python")):
    fenced = re.findall(r"^```([^\n]*)\n(.*?)^```$", page.read_text(), re.M | re.S)
    return [(kind, code) for kind, code in fenced if kind in kinds]


def lines(code):
    """Return the commands of a block, comments and continuations removed."""
    stripped = (line.split("#")[0].strip() for line in code.replace("\\\n", " ").splitlines())
    return [line for line in stripped if line]


def site_pages():
    spec = importlib.util.spec_from_file_location("site_pages", DOCS / "site_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_there_are_blocks_of_both_kinds():
    kinds = [kind for kind, _ in blocks(README)]
    assert kinds.count("python") >= 3
    assert kinds.count("bash") >= 3
    assert {page.stem for page in PAGES if blocks(page)} >= {"README", "tour", "datasets", "robot"}


@pytest.fixture(scope="session")
def hub():
    """The Hub that the pages' commands talk to: ours, on the loopback (see tests/hub/hub_server.py)."""
    sys.path.insert(0, str(ROOT / "tests" / "hub"))
    try:
        import hub_server
    finally:
        sys.path.pop(0)
    with hub_server.serving() as running:
        yield {"HF_ENDPOINT": running.url, "HF_TOKEN": hub_server.TOKEN, "HF_HUB_DISABLE_XET": "1"}


@pytest.fixture(scope="session")
def warm(hub, tmp_path_factory):
    """What runs the commands of all pages."""
    env = {**hub, "HF_HOME": str(tmp_path_factory.mktemp("hf"))}
    if AUTHORS.is_dir():
        env["NAVREP_RELEASED_DIR"] = str(AUTHORS)
    with WarmProcess(env) as process:
        yield process


def run_blocks(found, folder, warm):
    """Run what blocks say, one after the other; return how many commands that were."""
    ran = 0
    for kind, code in found:
        named = re.match(r"# (\w+\.py)\n", code)
        if named:  # a file to save, for the commands that follow
            (folder / named.group(1)).write_text(code)
            continue
        if kind == "python":
            commands = [["-c", code]]
        else:
            commands = [shlex.split(line) for line in lines(code) if not line.startswith(SETUP)]
            assert all(command[0] == "navrep-data" for command in commands), commands
            commands = [command[1:] for command in commands]
        for command in commands:
            done = warm.run(command, folder)
            assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
            ran += 1
    return ran


def with_weights(page):
    """Return the blocks that need the authors' weights; nothing else on a page needs what they make."""
    return [block for block in blocks(page) if ".released" in block[1]]


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=lambda page: page.stem)
def test_code_blocks_run(page, tmp_path, warm):
    if page.stem not in FROM_SCRATCH:
        tiny_dataset(tmp_path / "data" / "soadrl", n=12, length=200)
    others = with_weights(page)
    assert run_blocks([block for block in blocks(page) if block not in others], tmp_path, warm) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if with_weights(page)], ids=lambda page: page.stem)
def test_code_blocks_with_the_authors_weights_run(page, released, tmp_path, warm):
    assert run_blocks(with_weights(page), tmp_path, warm) >= 1


@pytest.mark.slow
def test_a_warm_process_says_what_failed(tmp_path):
    warm = shared()
    refused = warm.run(["info", "nowhere"], tmp_path)
    assert (refused.returncode, refused.stdout, len(refused.stderr.splitlines())) == (2, "", 1)
    wrong = warm.run(["-c", "import os, warnings; print(os.getcwd()); warnings.warn('no')"], tmp_path)
    assert (wrong.returncode, wrong.stdout) == (1, f"{tmp_path}\n")
    assert "UserWarning: no" in wrong.stderr
    assert warm.run(["-c", "import os; os.kill(os.getpid(), 9)"], tmp_path).returncode == -9


def commands_named():
    """Return every complete command of ours in any block that is not Python, those that take hours too."""
    found = []
    for page in TEXTS:
        for _, code in blocks(page, ("bash", "")):
            # brackets, bars, dots and capitals are the notation of a synopsis, not a command
            whole = (line for line in lines(code) if not re.search(r"[\[|]|\.\.\.|\b[A-Z]{3,}\b", line))
            found += [(page.stem, line) for line in whole if line.startswith("navrep-data ")]
    return found


def parse(command, name, args, parent=None):
    """Parse as the command line does, down to the last verb, and run nothing."""
    context = command.make_context(name, list(args), parent=parent)
    rest = [*context._protected_args, *context.args]
    if hasattr(command, "resolve_command") and rest:
        verb, found, after = command.resolve_command(context, rest)
        return parse(found, verb, after, context)
    return context


@pytest.mark.slow
def test_commands_parse():
    commands = commands_named()
    assert len(commands) >= 25
    for page, line in commands:
        try:
            context = parse(typer.main.get_command(app), "navrep-data", shlex.split(line)[1:])
        except Exception as error:
            pytest.fail(f"{page}: {line}: {error}")
        assert context.parent is not None, line


def test_a_wrong_flag_does_not_parse():
    with pytest.raises(Exception, match="No such option"):
        parse(typer.main.get_command(app), "navrep-data", ["generate", "--sed", "0"])


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    pages = site_pages()
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        there = page.parent / path if path else page
        assert there.exists(), target
        if anchor:
            pages.section(there.read_text(), anchor)  # raises where there is no such heading


def test_tests_named_in_the_readme_exist():
    for folder in re.findall(r"pytest (?:-m \"[^\"]*\" )?((?:tests/[^\s`]+ ?)+)`", README.read_text()):
        for path in folder.split():
            assert (ROOT / path).exists(), path


def test_every_page_and_every_public_module_is_on_the_site():
    pages = site_pages()
    reached = {"index", *(below for page in pages.NAVIGATION for below in pages.pages_below(page))}
    assert {page.stem for page in DOCS.glob("*.md")} <= reached
    modules = {name for name in navrep_data.__all__ if not name.startswith("__")}
    assert {f"api/{name}" for name in modules} <= reached


def test_a_section_of_the_readme_is_shown_in_its_place():
    pages = site_pages()
    shown = pages.adapt_page("datasets", (DOCS / "datasets.md").read_text())
    assert "→" not in shown
    assert "navrep-data generate --env soadrl --n 20" in shown
    assert "![The page: world, scan, rings, curves and the timeline of episodes](images/view.png)" in shown
    assert '<a href="view.html">An example</a>' in shown
    assert "[SECURITY.md](security.md)" in shown
    assert "[docs/training.md](training.md)" in shown


def test_links_to_what_pages_show_go_to_those_pages():
    pages = site_pages()
    text = "[a](../CHANGELOG.md) [b](../README.md#share-it-the-hugging-face-hub) [c](../examples/own_map.py) [d](#here)"
    adapted = pages.adapt_links("zoo", text, DOCS)
    assert adapted == "[a](changelog.md) [b](datasets.md) [c](examples.md#own_mappy) [d](#here)"
    assert pages.adapt_links("zoo", "[lock](../constraints.txt)", DOCS) == "lock (`constraints.txt`)"
    with pytest.raises(ValueError, match="leads nowhere"):
        pages.adapt_links("zoo", "[x](../nothing.md)", DOCS)
