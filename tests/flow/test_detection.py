"""Uncertainty if the method or list is wrong, and large or gridded clouds."""

from dataclasses import replace
from functools import cache

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

import pcfix
from pcfix.flow import planning
from pcfix.options.correct import ScienceOptions
from pcfix.refract import patches
from pcfix.refract.batch import Batch, Survey
from pcfix.refract.learning import learn_of_sample
from pcfix.refract.patches import grid_m
from pcfix.refract.reconstructions import IN_FRAME, hint_of
from pcfix.water.surface import surface_above
from tests.io.test_views import write_ply, write_vis
from tests.utils.clouds import write_las
from tests.utils.matchers import matched_scene
from tests.utils.nightly import mostly_nightly

BLOCK = {"seed": 1, "lidar_per_m2": 0.0}
OBLIQUE = {**BLOCK, "bed": "shore", "obliques_deg": 35.0, "detection": 0.5}


@cache
def scene_of(cloud="tracks", points=12_000, **settings):
    return matched_scene(points, cloud=cloud, **{**BLOCK, **settings})


def covered(scene, found):
    made = np.diff(scene.views.start) > 1
    deep = scene.depth_m(scene.true_xyz) > 0.2
    wet = made & deep & (scene.depth_m(scene.apparent_xyz) > 0.0)
    rows = np.flatnonzero(wet & found.corrected)
    error = found.xyz[rows, 2] - scene.true_xyz[rows, 2]
    return float(np.mean(np.abs(error) <= 1.96 * found.sigma_z_m[rows]))


OFF = (
    ("tracks", {"method": "snell", "max_angle": None}),
    ("tracks", {"method": "murase", "max_angle": None}),
    ("tracks", {"method": "consistent", "camera_set": "mvs"}),
    ("depth-maps", {"method": "snell", "max_angle": None}),
    ("depth-maps", {"method": "consistent", "camera_set": "all"}),
)


@pytest.mark.parametrize(("cloud", "told"), mostly_nightly(OFF, OFF[0]), ids=str)
def test_coverage_of_a_wrong_method(cloud, told):
    scene = scene_of(cloud, points=8000, **OBLIQUE) if cloud == "tracks" else scene_of(cloud)
    points = (scene.apparent_xyz, scene.cameras, scene.water)
    assert covered(scene, pcfix.correct_points(*points, **told)) >= 0.90


def test_coverage_of_a_wrong_list():
    scene = scene_of("pairs", points=8000)
    as_tracks = replace(scene.views, kind="tracks")
    found = pcfix.correct_points(scene.apparent_xyz, scene.cameras, scene.water, views=as_tracks)
    assert covered(scene, found) >= 0.90


@pytest.mark.parametrize("cloud", mostly_nightly(("depth-maps", "tracks"), "tracks"))
def test_large_cloud(cloud, tmp_path, monkeypatch):
    """As if it were hundreds of times as large: few of its points are looked at."""
    scene = scene_of(cloud, points=16_000)
    path = write_las(tmp_path / "large.las", scene.apparent_xyz, crs=None)
    for name in ("FEWEST_BED_POINTS", "MOST_BED_POINTS"):
        monkeypatch.setattr(planning, name, 1200)
    monkeypatch.setattr(patches, "MOST_IN_SQUARES", 10_000)
    given = {"cameras": scene.cameras, "water": scene.water, "overwrite": True}
    made = pcfix.correct_file(path, tmp_path / "out.las", **given).reconstruction
    assert made["sure"]
    assert made["type"] == IN_FRAME[["tracks", "depth-maps"].index(cloud)].words
    monkeypatch.setattr(planning, "Squares", lambda width_m: None)
    assert "sure" not in pcfix.correct_file(path, tmp_path / "out.las", **given).reconstruction


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Agisoft Metashape 2.1.0", "single depth maps"),
        ("PDAL 2.8 (OpenMVS)", "depth maps"),
        ("MicMac", "stereo pairs"),
    ],
)
def test_software(name, words):
    assert words in hint_of(name).words
    assert hint_of("Pix4D") is None


def gridded(scene, step_m):
    """Return one point in each cell of a grid, at the cell's middle."""
    xyz = scene.apparent_xyz.copy()
    xyz[:, :2] = np.floor(xyz[:, :2] / step_m) * step_m + step_m / 2.0
    return xyz[np.unique(xyz[:, :2], axis=0, return_index=True)[1]]


def told(xyz, scene):
    above = surface_above(scene.water, xyz)
    batch = Batch(xyz, above, Survey(scene.water, scene.cameras, ScienceOptions()))
    return learn_of_sample(batch)[1]


def test_grid():
    scene = scene_of()
    assert grid_m(scene.apparent_xyz) is None
    assert grid_m(np.round(scene.apparent_xyz, 3)) is None
    xyz = gridded(scene, 0.5)
    assert grid_m(xyz) == pytest.approx(0.5, abs=1e-3)
    (verdict,) = told(xyz, scene)
    assert "grid of 0.5 m" in " ".join(map(str, verdict.warnings()))


def test_mesh():
    scene = scene_of(bed="flat")
    xyz = scene.apparent_xyz.copy()
    xyz[:, 2] = np.median(xyz[:, 2]) + 0.01 * (xyz[:, 0] - xyz[:, 0].mean())
    for points, is_mesh in ((scene.apparent_xyz, False), (xyz, True)):
        (verdict,) = told(points, scene)
        assert any("mesh or a filtered cloud" in one for one in verdict.remarks) is is_mesh


@pytest.mark.filterwarnings("ignore::pcfix.PcfixWarning")
def test_list_of_half(tmp_path):
    scene = scene_of(points=6000)
    rows = np.arange(0, len(scene.apparent_xyz), 2)
    images = [
        scene.views.camera[scene.views.start[i] : scene.views.start[i + 1]].tolist() for i in rows
    ]
    write_vis(tmp_path / "fused.ply.vis", images)
    write_ply(tmp_path / "fused.ply", scene.apparent_xyz[rows], position="double")
    path = write_las(tmp_path / "cloud.las", scene.apparent_xyz, crs=None)
    given = {"cameras": scene.cameras, "water": scene.water}
    out = {}
    for name, views in (("half", tmp_path / "fused.ply.vis"), ("none", None)):
        summary = pcfix.correct_file(path, tmp_path / f"{name}.las", views=views, **given)
        out[name] = laspy.read(tmp_path / f"{name}.las")
        assert summary.corrected > 0.95 * summary.submerged
        messages = " ".join(one["message"] for one in summary.warnings)
        assert ("Points missing in the view list" in messages) == (name == "half")
    # within a twentieth of the spacing a point gets its neighbour's list
    near_m = cKDTree(scene.apparent_xyz[rows]).query(scene.apparent_xyz)[0]
    unlisted = near_m > 0.1
    np.testing.assert_array_equal(out["half"].xyz[unlisted], out["none"].xyz[unlisted])
