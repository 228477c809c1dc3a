"""A minute of what `make fuzz` does for ten."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_targets import TARGETS, Target

SECONDS = 60


@pytest.mark.slow
def test_readers_stand_a_minute_of_fuzzing(tmp_path):
    """In a process of its own: forking one that has torch's threads is not safe."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("fuzz.py")), "--seconds", str(SECONDS), "--keep", str(tmp_path)],
        capture_output=True, text=True, timeout=540, env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1].endswith("examples; findings: none")
    for target in TARGETS:
        (line,) = [line for line in lines if line.startswith(f"{target.name} ")]
        assert int(line.split()[1].replace(",", "")) > 0, line


READERS = {
    "crash": "raise KeyError('x')",
    "several lines": "from navrep_data.errors import ConfigError; raise ConfigError('a' + chr(10) + 'b')",
    "memory": "import numpy as np; kept = np.ones(600 << 20, np.uint8)",
    "memory ran out": """
from navrep_data.errors import ConfigError
try:
    kept = bytearray(3 << 30)
except MemoryError as error:
    raise ConfigError('too large') from error
""",
    "hang": "while True: pass",
    "standstill": "import time; time.sleep(60)",
    "death": "import os; os.abort()",
    "outside": "(folder / '../outside.txt').write_text('x')",
}
FOUND = {
    "crash": "KeyError: 'x'", "several lines": "or several lines", "memory": "fuzz._Found: reading took ",
    "memory ran out": "memory ran out before", "hang": "the process died", "standstill": "the process died",
    "death": "the process died", "outside": "files outside the folder",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_what_counts_as_a_finding(name, tmp_path):
    """The harness itself: a reader that does what none may do to changed files only is found, its files kept."""
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import fuzz, fuzz_targets
from pathlib import Path
fuzz.HANG, fuzz.STANDSTILL = 2.0, 6.0
def read(folder):
    if (folder / 'a.json').read_bytes() == b'[1, 2, 3]':
        return
{chr(10).join("    " + line for line in READERS[name].splitlines())}
target = fuzz_targets.Target('made-up', lambda f: (f / 'a.json').write_text('[1, 2, 3]'), read)
report = fuzz.fuzz(target, 3.0, 1, Path({str(tmp_path)!r}))
print(report.finding)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert FOUND[name] in done.stdout, done.stdout + done.stderr
    assert (tmp_path / "made-up-1" / "finding.txt").is_file()
    assert (tmp_path / "made-up-1" / "files" / "a.json").is_file()


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
@pytest.mark.slow
def test_valid_files_are_read(target: Target, tmp_path):
    """What is fuzzed starts from files that are taken, and from other files with every kind of change."""
    target.make(tmp_path)
    target.read(tmp_path)
