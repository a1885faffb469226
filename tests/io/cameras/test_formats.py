"""The table of formats: what the documentation says is what is read."""

import re
from pathlib import Path

import pytest

import pcfix
from pcfix.io.cameras import FORMATS

README = Path(pcfix.__file__).parent / "io" / "cameras" / "README.md"
PART = re.compile(r"<!-- formats: .*? -->\n(.*?)<!-- end of formats -->", re.DOTALL)


def test_the_table_of_the_readme_is_that_of_the_formats():
    lines = ["| software | what to give |", "|---|---|"]
    lines += [f"| {each.software} | {each.give} |" for each in FORMATS if each.give]
    table = "\n".join(lines) + "\n"
    found = PART.search(README.read_text())
    assert found is not None
    assert found[1] == table, f"put this into {README}:\n{table}"


def test_what_is_known_but_not_read_comes_last():
    assert [bool(each.give) for each in FORMATS] == [True] * (len(FORMATS) - 1) + [False]


def test_nothing_is_of_several_formats_by_accident(tmp_path):
    (tmp_path / "a.txt").write_text("no cameras at all\n")
    with pytest.raises(pcfix.InputError, match="is not a camera file that pcfix knows"):
        pcfix.read_cameras(tmp_path / "a.txt")
