"""Messages: one line, of bounded length, whatever text from outside they quote; nothing else of them changes."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from navrep_data import errors
from navrep_data.doctor.installation import Finding
from navrep_data.errors import (
    LONGEST_MESSAGE,
    ConfigError,
    NavrepDataError,
    PolicyError,
    check_whole,
    one_line,
    real_number,
)
from navrep_data.shards._fields import Fields
from navrep_data.shards.verify import Problem

CLASSES = [c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, NavrepDataError)]
ORDINARY = "Unknown model 'a  b\u3000\u00e9'. Did you mean 'ab'? List all: navrep-data models"


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_what_every_error_shows(kind):
    assert str(kind(ORDINARY)) == ORDINARY
    long = kind(f"/data/x.zip: {'a' * 5114!r} cannot be unpacked: get it again.")
    assert len(str(long)) == LONGEST_MESSAGE
    assert str(long).startswith("/data/x.zip: 'aaa")
    assert str(long).endswith("aaa' cannot be unpacked: get it again.")
    assert str(pickle.loads(pickle.dumps(long))) == str(long)  # noqa: S301
    assert str(kind("a file\n  of two\r\n\tlines\u2028or more\n")) == "a file of two lines or more"


def test_text_that_steers_a_terminal_or_cannot_be_written():
    assert one_line("red \x1b[31m, bell \x07, byte \udcff, \x9b1m") == r"red \x1b[31m, bell \x07, byte \udcff, \x9b1m"
    one_line("\udcff" * 100_000).encode()
    assert len(one_line("\x1b" * 100_000)) == LONGEST_MESSAGE
    assert one_line("a" * LONGEST_MESSAGE) == "a" * LONGEST_MESSAGE
    assert len(one_line("a" * 50_000_000)) == LONGEST_MESSAGE


def test_findings_of_reports_are_lines_too():
    for finding in (Problem("data/x.h5", "a\nb" * 4000), Finding("python", "problem", "a\nb" * 4000)):
        assert len(finding.what) == LONGEST_MESSAGE
        assert "\n" not in finding.what


def test_a_value_of_any_size_leaves_the_advice(tmp_path):
    fields = Fields({"length": ["x" * 400] * 50}, tmp_path / "manifest.json")
    with pytest.raises(errors.CorruptDataError) as refused:
        fields.count("length")
    said = str(refused.value)
    assert said.startswith(f"{tmp_path / 'manifest.json'}: field 'length' is ['xxx")
    assert said.endswith("; get the file again.")
    assert len(said) == LONGEST_MESSAGE


CUT = re.compile(
    r"""(str|repr)\([^()]*(\([^()]*\)[^()]*)*\)\[:(?!12\])\d+\]"""  # the start of a text; [:12] is a hash's
    r"""|" "\.join\([^\n]*\.split\(\)\)|' '\.join\([^\n]*\.split\(\)\)"""
    r"""|\{[\w.]+\[:\d+\]!r\}"""
)


def test_no_other_place_cuts_texts():
    package = Path(errors.__file__).parent
    found = [
        f"{path.relative_to(package)}:{k}: {line.strip()}"
        for path in sorted(package.rglob("*.py"))
        for k, line in enumerate(path.read_text().splitlines(), 1)
        if CUT.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("value", [3, np.int64(3), np.uint8(3), np.array(3), torch.tensor(3)])
def test_whole_numbers_of_any_library_are_plain_ones(value):
    found = check_whole("n", value, 1, 4)
    assert (found, type(found)) == (3, int)


@pytest.mark.parametrize("value", [0, 5, 3.0, True, "3", None, np.array([3]), np.bool_(True), float("nan")])
def test_what_is_no_whole_number_in_range_is_refused(value):
    with pytest.raises(ConfigError, match=r"^n is .*, expected a whole number from 1 to 4"):
        check_whole("n", value, 1, 4)
    with pytest.raises(PolicyError, match="of at least 6"):
        check_whole("n", value, 6, error=PolicyError)


def test_real_numbers_are_plain_ones():
    for value, wanted in ((2, 2), (2.5, 2.5), (np.float32(2.5), 2.5), (np.int64(2), 2), (np.float64(0.5), 0.5)):
        found = real_number(value)
        assert found == wanted
        assert type(found) is type(wanted) or isinstance(value, float)
    assert [real_number(v) for v in (True, "2", None, float("nan"), np.float32("nan"), [2])] == [None] * 6
