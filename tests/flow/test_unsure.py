"""Points seen only by oblique images: found, withheld, restored."""

from dataclasses import fields
from functools import cache

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.io.las.columns import COLUMNS
from pcfix.io.scenes import colmap_vis
from pcfix.model import Views
from pcfix.refract.matcher import without_border
from pcfix.report.text import summary_text
from tests.utils.half_oblique import half_oblique, seen_flat, write_half_oblique
from tests.utils.nightly import mostly_nightly

SNELL = {"method": "snell", "max_angle": None, "occlusion": "off"}
WAYS = {
    "snell": SNELL,
    "consistent": {"method": "consistent", "camera_set": "all"},
    "depth maps": {"method": "consistent", "camera_set": "mvs"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("half")


@pytest.fixture(scope="module")
def needed(folder):
    return write_half_oblique(folder)


@pytest.fixture(scope="module")
def corrected(folder, needed):
    """Return a function that corrects the file, once with the same options for all tests.

    It returns the summary and the file, which is to be read only.
    """
    usual = {**SNELL, "unsure": "withhold", "uncorrected": "withhold", "dimensions": "all"}
    known = {}

    def corrected(**more):
        options = {**usual, **more}
        key = tuple(sorted(options.items(), key=str))
        if key not in known:
            out = folder / f"corrected{len(known)}.las"
            known[key] = pcfix.correct_file(folder / "cloud.las", out, **needed, **options), out
        return known[key]

    return corrected


@cache
def points_of(way, unsure):
    """Return the points corrected in a way, and what became of each; to be read only."""
    scene = half_oblique()
    return pcfix.correct_points(scene.xyz, scene.cameras, scene.water, unsure=unsure, **WAYS[way])


@pytest.mark.parametrize("way", mostly_nightly(WAYS, "snell"))
def test_found(way):
    """They are those whose ray closest to nadir is oblique, and are corrected as others."""
    scene = half_oblique()
    keep, found = points_of(way, "keep"), points_of(way, "withhold")
    cameras = without_border(scene.cameras) if way == "depth maps" else scene.cameras
    expected = found.corrected & seen_flat(scene.xyz, cameras, scene.water)
    np.testing.assert_array_equal(found.unsure, expected)
    assert 0.2 < expected.sum() / found.corrected.sum() < 0.8
    assert keep.unsure is None
    for name in {field.name for field in fields(keep)} - {"unsure"}:
        np.testing.assert_array_equal(getattr(keep, name), getattr(found, name), name)


def test_view_list(folder, corrected):
    scene = half_oblique()
    found = pcfix.correct_points(
        scene.xyz, scene.cameras, scene.water, views=scene.views, unsure="withhold", **SNELL
    )
    assert found.corrected.any() and not found.unsure.any()
    told, _ = corrected(views=folder / "fused.ply.vis")
    assert told.corrected and told.unsure == 0


def test_list_of_some(corrected, tmp_path):
    views, listed = half_oblique().views, np.arange(3000) % 2 == 0
    start = np.concatenate([[0], np.cumsum(np.where(listed, np.diff(views.start), 0))])
    camera = views.camera[np.repeat(listed, np.diff(views.start))]
    (tmp_path / "fused.ply.vis").write_bytes(colmap_vis(Views(start, camera)))
    given = ({}, {"views": tmp_path / "fused.ply.vis"})
    whole, some = (laspy.read(corrected(**more)[1]) for more in given)
    np.testing.assert_array_equal(some.Unsure, np.where(listed, 0, whole.Unsure))


def test_withheld(folder, corrected):
    told, marked = corrected()
    kept = corrected(unsure="keep")[1]
    before, keep, withhold = (laspy.read(path) for path in (folder / "cloud.las", kept, marked))
    cameras = pcfix.read_cameras(folder / "cameras.csv")
    unsure = (keep.RayCount > 0) & seen_flat(before.xyz, cameras, half_oblique().water)
    came = np.array(before.withheld) > 0
    stuck = (keep.RayCount == 0) & (keep.WaterDepth > 0)
    np.testing.assert_array_equal(keep.withheld, came | stuck)
    np.testing.assert_array_equal(withhold.withheld, came | stuck | unsure)
    np.testing.assert_array_equal(withhold.Unsure, unsure & ~came)
    for name in ("X", "Y", "Z", "classification", *(column.name for column in COLUMNS)):
        np.testing.assert_array_equal(np.array(keep[name]), np.array(withhold[name]), name)
    assert "Unsure" not in keep.point_format.dimension_names
    quiet = corrected(unsure="keep")[0]
    assert quiet.unsure is None and "unsure" not in quiet.as_dict()
    assert "Withheld" not in summary_text(quiet)
    assert told.unsure == told.as_dict()["unsure"] == unsure.sum() > (unsure & ~came).sum() > 0


@pytest.mark.parametrize("uncorrected", ["withhold", "keep"])
@pytest.mark.parametrize("max_angle", [None, 38.0])
def test_restored(folder, corrected, tmp_path, uncorrected, max_angle):
    told, out = corrected(uncorrected=uncorrected, max_angle=max_angle)
    assert told.unsure and (max_angle is None or sum(told.uncorrected.values()))
    pcfix.restore_file(out, tmp_path / "back.las")
    assert (tmp_path / "back.las").read_bytes() == (folder / "cloud.las").read_bytes()
