"""Clouds larger than memory: PDAL does not stream filters.python, and the recipe that cuts them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import laspy
import numpy as np

import pcfix
from tests.utils.real_pdal import ROOT, needs_pdal, pdal, python

if TYPE_CHECKING:
    from pathlib import Path

SCENE, RECIPES = ROOT / "samples" / "scene", ROOT / "pipelines"
RUN = "import runpy, sys; sys.argv.pop(0); runpy.run_path(sys.argv[0])"
STREAMABLE = """
import sys, pdal
for stage in pdal.Pipeline(open(sys.argv[1]).read()).stages:
    print(stage.type, stage.streamable)
"""


@needs_pdal
def test_pdal_does_not_stream_the_stage(tmp_path: Path) -> None:
    """Neither its C++ (PythonFilter has `run` of a whole view alone) nor either door."""
    out = f"--writers.las.filename={tmp_path / 'out.las'}"
    done = pdal("pipeline", "--stream", "pipelines/correct.json", out, folder=ROOT)
    assert done.returncode != 0
    assert "Couldn't run pipeline in requested execution mode" in done.stderr
    said = python(STREAMABLE, RECIPES / "correct.json", folder=ROOT).stdout.splitlines()
    assert said == ["readers.las True", "filters.python False", "writers.las True"]


@needs_pdal
def test_tiles_come_out_as_the_whole(tmp_path: Path) -> None:
    script, cloud = RECIPES / "correct_large.py", SCENE / "cloud.laz"
    side_m = 100.0492  # the first tile ends at x = 410201.72: a strip of dry land
    done = python(RUN, script, cloud, "out.las", side_m, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    land, last = done.stdout.splitlines()
    assert "left as it is: pcfix: the pipeline's cloud: no point lies below the water" in land
    assert last == "20,000 of 20,000 points in 3 tiles"
    assert [path.name for path in tmp_path.iterdir()] == ["out.las"]
    pcfix.correct_file(
        cloud, tmp_path / "whole.las", cameras=SCENE / "cameras.csv", water=0.37, method="snell",
        max_angle=40, occlusion="off",
    )  # fmt: skip
    whole, tiles = laspy.read(tmp_path / "whole.las"), laspy.read(tmp_path / "out.las")
    np.testing.assert_array_equal(tiles.header.scales, whole.header.scales)
    orders = [np.lexsort((las.X, las.Y, las.Z)) for las in (whole, tiles)]
    for name in set(whole.point_format.dimension_names) - {"scan_angle", "SigmaZ"}:
        expected, found = (
            np.array(las[name], float)[order]
            for las, order in zip((whole, tiles), orders, strict=True)
        )
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-6, err_msg=name)
    moved = np.array(tiles.RayCount) > 0
    assert (np.array(tiles.SigmaZ)[moved] > 0.0).all()
