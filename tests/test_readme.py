"""The README's code blocks, run in order as a reader would, in a folder of their own."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"
# What sets up a machine is run by .ci/run and the Makefile itself, not from inside the tests.
SETUP = ("pip ", "make ")


def blocks():
    return re.findall(r"^```(bash|python)\n(.*?)^```", README.read_text(), re.M | re.S)


def test_there_are_blocks_of_both_kinds():
    kinds = [kind for kind, _ in blocks()]
    assert kinds.count("python") >= 3
    assert kinds.count("bash") >= 3


@pytest.fixture
def hub():
    """The Hub that the README's commands talk to: ours, on the loopback (see tests/hub/hub_server.py)."""
    sys.path.insert(0, str(README.parent / "tests" / "hub"))
    try:
        import hub_server
    finally:
        sys.path.pop(0)
    with hub_server.serving() as running:
        yield {"HF_ENDPOINT": running.url, "HF_TOKEN": hub_server.TOKEN, "HF_HUB_DISABLE_XET": "1"}


@pytest.mark.slow
def test_code_blocks_run(tmp_path, hub):
    env = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    env |= {
        **hub,
        "HF_HOME": str(tmp_path / "hf"),
        "NAVREP_DATA_HOME": env.get("NAVREP_DATA_HOME", str(tmp_path / "home")),
    }
    shared = README.parent.parent / "shared" / "released"
    if shared.is_dir():
        env["NAVREP_RELEASED_DIR"] = str(shared)
    ran = 0
    for kind, code in blocks():
        if "zoo.load" in code and not shared.is_dir():
            continue  # needs ../shared/released: the authors' files are not part of the repository
        if kind == "python":
            commands = [[sys.executable, "-W", "error", "-c", code]]
        else:
            lines = [line.split("#")[0].strip() for line in code.replace("\\\n", " ").splitlines()]
            commands = [shlex.split(line) for line in lines if line and not line.startswith(SETUP)]
        for command in commands:
            done = subprocess.run(
                command, cwd=tmp_path, env=env, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=600
            )
            assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
            ran += 1
    assert ran >= 6


def test_paths_named_in_the_readme_exist():
    root = README.parent
    for target in re.findall(r"\]\(([^)#]+)\)", README.read_text()):
        if not target.startswith("http"):
            assert (root / target).exists(), target
    for folder in re.findall(r"pytest (?:-m \"[^\"]*\" )?((?:tests/[^\s`]+ ?)+)`", README.read_text()):
        for path in folder.split():
            assert (root / path).exists(), path
