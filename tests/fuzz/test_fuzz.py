"""What `make fuzz` does with fresh seeds, on a fixed number of changed files that are the same at every run."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_targets import TARGETS

EXAMPLES = 8


def run_fuzz(*arguments):
    """In a process of its own: forking one that has torch's threads is not safe."""
    return subprocess.run(
        [sys.executable, str(Path(__file__).with_name("fuzz.py")), *map(str, arguments)],
        capture_output=True, text=True, env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
    )  # fmt: skip


def counts(line):
    """Examples, taken and refused of a target's line."""
    return [int(n.replace(",", "")) for n in re.findall(r"([\d,]+) (?:examples|taken|refused)", line)]


@pytest.mark.slow
def test_readers_stand_changed_files(tmp_path):
    """Also that every target's own files are taken: those that are refused end it with a finding."""
    done = run_fuzz("--examples", EXAMPLES, "--keep", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == f"seed 0, {EXAMPLES} examples for each of {len(TARGETS)} targets"
    assert lines[-1] == f"{EXAMPLES * len(TARGETS):,} examples; findings: none"
    for target in TARGETS:
        (line,) = [line for line in lines if line.startswith(f"{target.name} ")]
        examples, taken, refused = counts(line)
        assert (examples, taken + refused) == (EXAMPLES, EXAMPLES), line
        assert refused > 0, line


REFUSE = "from navrep_data.errors import ConfigError; e = ConfigError(''); e.args = ({},); raise e"
READERS = {
    "crash": "raise KeyError('x')",
    "several lines": REFUSE.format("'a' + chr(10) + 'b'"),
    "a long line": REFUSE.format("'a' * 5114"),
    "memory": "import numpy as np; kept = np.ones(600 << 20, np.uint8)",
    "memory ran out": """
from navrep_data.errors import ConfigError
try:
    kept = bytearray(3 << 30)
except MemoryError as error:
    raise ConfigError('too large') from error
""",
    "hang": "while True: pass",
    "standstill": "import signal; signal.pause()",
    "death": "import os; os.abort()",
    "outside": "(folder / '../outside.txt').write_text('x')",
}
FOUND = {
    "crash": "KeyError: 'x'", "several lines": "or several lines", "a long line": "the message has 5114 characters",
    "memory": "fuzz._Found: reading took ", "memory ran out": "memory ran out before", "hang": "the process died",
    "standstill": "the process died", "death": "the process died", "outside": "files outside the folder",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_what_counts_as_a_finding(name, tmp_path):
    """The harness itself: a reader that does what none may do to changed files only is found, its files kept."""
    # no other reader has a limit by the clock, which a machine that is busy or stopped would reach
    standstill = 0.5 if name == "standstill" else None
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import fuzz, fuzz_targets
from pathlib import Path
fuzz.HANG = 2.0
def read(folder):
    if (folder / 'a.json').read_bytes() == b'[1, 2, 3]':
        return
{chr(10).join("    " + line for line in READERS[name].splitlines())}
target = fuzz_targets.Target('made-up', lambda f: (f / 'a.json').write_text('[1, 2, 3]'), read)
report = fuzz.fuzz(target, fuzz.Much(examples=20, standstill={standstill}), 1, Path({str(tmp_path)!r}))
print(report.finding)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert FOUND[name] in done.stdout, done.stdout + done.stderr
    assert (tmp_path / "made-up-1" / "finding.txt").is_file()
    assert (tmp_path / "made-up-1" / "files" / "a.json").is_file()


SAME_FILES = """
import sys
sys.path.insert(0, {folder!r})
import fuzz, fuzz_targets
from pathlib import Path
seen = Path({seen!r})
def read(folder):
    with seen.open("ab") as file:
        file.write(b"".join(p.name.encode() + p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()))
target = fuzz_targets.Target("made-up", lambda f: (f / "a.json").write_text('{{"a": [1, 2, 3], "b": "text"}}'), read)
print(fuzz.fuzz(target, fuzz.Much(examples=30, standstill=None), {seed}).finding)
"""


@pytest.mark.slow
def test_the_number_and_the_seed_decide_what_is_read(tmp_path):
    read = {}
    for k, seed in enumerate((0, 0, 1)):
        code = SAME_FILES.format(folder=str(Path(__file__).parent), seen=str(tmp_path / str(k)), seed=seed)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.stdout.strip() == "", done.stdout + done.stderr
        read[k] = (tmp_path / str(k)).read_bytes()
    assert read[0] == read[1] != read[2]
