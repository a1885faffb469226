"""The scripts in samples/ run, one after another, as a reader would run them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.utils.real_pdal import IS_THERE, PROGRAM, ROOT

SCRIPTS = sorted((ROOT / "samples").glob("0*.py"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("samples")


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_script(script, folder):
    if "pdal" in script.stem and not IS_THERE:
        pytest.skip("no PDAL in this environment")
    environment = {
        **os.environ, "MPLBACKEND": "agg", "PATH": f"{PROGRAM.parent}:{os.environ['PATH']}"
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, str(script)], cwd=folder, capture_output=True, text=True, check=False,
        env=environment,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    said = {
        "01": "14,736 of 20,000", "02": "as it came   bias +1.8", "03": "depth.png: 12.",
        "04": "cloud.laz: 14,736 of", "05": "14,736 of 20,000", "06": "201 stations",
    }  # fmt: skip
    assert said[script.stem[:2]] in done.stdout
    for name in {"03": ["bed.tif", "depth.png"], "06": ["section.png"]}.get(script.stem[:2], []):
        assert (folder / name).stat().st_size > 1000
