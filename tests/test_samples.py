"""The scripts in samples/ run, the first before the others, as a reader would run them."""

import os
import subprocess
import sys
from functools import cache

import pytest

from tests.utils.real_pdal import IS_THERE, PROGRAM, ROOT

SCRIPTS = sorted((ROOT / "samples").glob("0*.py"))
PRINTED = {
    "01": "14,736 of 20,000", "02": "uncorrected  bias +1.8", "03": "depth.png: 12.",
    "04": "14,736 of 20,000 points corrected,", "05": "14,736 of 20,000", "06": "201 stations",
    "08": "7,021 of 9,539 cells",
}  # fmt: skip
WRITTEN = {
    "03": ["depth.tif", "depth.qml", "depth.png"], "06": ["section.png"],
    "08": ["corrected.tif", "dsm_depth.tif", "dsm_uncertainty.tif"],
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("samples")


@pytest.fixture(scope="module")
def run(folder):
    """Return a function that runs a script, each one once, in one folder."""
    environment = {
        **os.environ, "MPLBACKEND": "agg", "PATH": f"{PROGRAM.parent}:{os.environ['PATH']}"
    }  # fmt: skip

    @cache
    def call(script):
        return subprocess.run(
            [sys.executable, str(script)], cwd=folder, capture_output=True, text=True,
            check=False, env=environment,
        )  # fmt: skip

    return call


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_script(script, folder, run):
    if "pdal" in script.stem and not IS_THERE:
        pytest.skip("no PDAL in this environment")
    if "Run 01_correct.py first" in script.read_text():
        run(SCRIPTS[0])
    done = run(script)
    assert (done.returncode, done.stderr) == (0, "")
    number = script.stem[:2]
    assert PRINTED[number] in done.stdout
    for name in WRITTEN.get(number, []):
        assert (folder / name).stat().st_size > 1000
