"""The water surface fitted, as raster and mesh, and found; from Python and the command line."""

import json

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.flow.water import check_water
from pcfix.water.surface import surface_above
from tests.utils.codes import refused
from tests.utils.program import run_pcfix
from tests.utils.shared import SCENE

CLOUD, CAMERAS = SCENE / "cloud.laz", SCENE / "cameras.csv"
LEVEL_M = 0.37
CRS = "EPSG:32633"


def height_at(water, xy):
    return water.a + xy @ [water.b, water.c]


@pytest.fixture(scope="module")
def thin(tmp_path_factory):
    """Return every fifth point of the sample scene as a file, in its order."""
    las = laspy.read(CLOUD)
    las.points = las.points[np.arange(0, len(las), 5)]
    path = tmp_path_factory.mktemp("thin") / "cloud.las"
    las.write(path)
    return path


def write_points(path, xyz, names="x,y,z"):
    rows = "\n".join(",".join(f"{v:.4f}" for v in row) for row in xyz)
    path.write_text(f"{names}\n{rows}\n")
    return path


def test_tilted_river(tmp_path):
    scene = pcfix.simulate_scene(3000, seed=11, tilt_percent=0.5)
    low, high = scene.apparent_xyz[:, :2].min(axis=0), scene.apparent_xyz[:, :2].max(axis=0)
    # points on two banks, of which a fifth is decimetres off
    rng = np.random.default_rng(5)
    x = rng.uniform(low[0], high[0], 30)
    y = np.where(rng.random(30) < 0.5, low[1], high[1])
    xy = np.column_stack([x, y + rng.uniform(-1.0, 1.0, 30)])
    z = height_at(scene.water, xy) + rng.normal(0.0, 0.01, 30)
    wrong = rng.permutation(30)[:6]
    z[wrong] += rng.choice([-1.0, 1.0], 6) * rng.uniform(0.3, 2.0, 6)
    points = np.column_stack([xy, z])
    fit = check_water(write_points(tmp_path / "shore.csv", points))[0]
    corners = low + np.array([[x, y] for x in (0, 1) for y in (0, 1)]) * (high - low)
    places = np.column_stack([corners, corners[:, :1]])
    miss = surface_above(fit.surface, places).height_m - height_at(scene.water, corners)
    # noise of 1 cm on 24 good points: standard error 4 mm at a corner, so that 2 cm are 4 of them
    assert np.abs(miss).max() < 0.02
    assert set(np.flatnonzero(~fit.accepted)) == set(wrong)
    assert fit.as_dict()["tilt_percent"] == pytest.approx(0.5, abs=0.03)
    deep = scene.true_xyz[:, 2] < height_at(scene.water, scene.true_xyz[:, :2]) - 0.2
    rmse = []
    for water in (fit.surface, float(np.mean(points[:, 2]))):
        found = pcfix.correct_points(scene.apparent_xyz, scene.cameras, water, views=scene.views)
        rmse.append(np.sqrt(np.mean((found.xyz - scene.true_xyz)[deep, 2] ** 2)) / scene.gsd_m)
    assert rmse[0] < 1.0
    assert rmse[1] > 2.0  # what ignoring the tilt costs


def invoke(*arguments):
    done = run_pcfix(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_shoreline_points(thin, tmp_path):
    low, high = laspy.read(CLOUD).header.mins, laspy.read(CLOUD).header.maxs
    rng = np.random.default_rng(3)
    xy = rng.uniform(low[:2], high[:2], (20, 2))
    path = write_points(tmp_path / "shore.csv", np.column_stack([xy, np.full(20, LEVEL_M)]))
    water = ["--water", path, "--water-crs", CRS]
    # a fit has a standard error of the level, a number does not
    known = ["--sigma-level", 0.02]
    invoke("correct", thin, tmp_path / "a.las", "--cameras", CAMERAS, *water, *known)
    pcfix.correct_file(thin, tmp_path / "b.las", cameras=CAMERAS, water=LEVEL_M, sigma_level=0.02)
    one, other = (laspy.read(tmp_path / name).points.array for name in ("a.las", "b.las"))
    np.testing.assert_array_equal(one, other)
    invoke("label", thin, tmp_path / "c.las", *water)
    classes = np.asarray(laspy.read(tmp_path / "c.las").classification)
    np.testing.assert_array_equal(classes == 40, one["classification"] == 40)
    summary = tmp_path / "w.json"
    invoke("water", path, "--water-crs", CRS, "--cloud", CLOUD, "--summary", summary)
    found = json.loads(summary.read_text())
    assert found["fit"]["level_m"] == pytest.approx(LEVEL_M, abs=1e-6)
    assert [point["residual_m"] for point in found["points"]] == pytest.approx([0.0] * 20, abs=1e-6)
    assert found["share_below"] == pytest.approx(0.7368, abs=0.001)  # 14,736 of 20,000 points


def test_auto(tmp_path):
    summary = tmp_path / "auto.json"
    invoke("water", "auto", "--cloud", CLOUD, "--summary", summary)
    found = json.loads(summary.read_text())["fit"]
    assert abs(found["level_m"] - LEVEL_M) < 3.0 * found["sigma_level_m"]
    with pytest.raises(pcfix.SettingError):
        check_water("auto")


def test_salinity(thin, tmp_path):
    words = ["correct", thin, tmp_path / "o.las", "--cameras", CAMERAS, "--water", "0.37"]
    done = run_pcfix(*words, "--index", "1.34", "--salinity", "35")
    assert done.returncode == 1
    said = invoke(*words, "--salinity", "0", "--temperature", "20", "--wavelength", "0.5893")
    assert "1.333" in said


def test_tide(thin, tmp_path):
    labels = pcfix.read_cameras(CAMERAS).labels
    times = [f"2026-06-01T10:{i:02d}:00Z" for i in range(len(labels))]
    rows = "\n".join(f"{label},{time}" for label, time in zip(labels, times, strict=True))
    (tmp_path / "times.csv").write_text(f"label,time\n{rows}\n")
    options = {"cameras": CAMERAS, "water": LEVEL_M, "image_times": tmp_path / "times.csv"}

    def corrected(name, low_m, high_m):
        (tmp_path / "tide.csv").write_text(
            f"time,level_m\n2026-06-01T10:00:00Z,{low_m}\n2026-06-01T10:39:00Z,{high_m}\n"
        )
        summary = pcfix.correct_file(thin, tmp_path / name, **options, tide=tmp_path / "tide.csv")
        return laspy.read(tmp_path / name), summary

    still, _ = corrected("still.las", 1.0, 1.0)
    pcfix.correct_file(thin, tmp_path / "plain.las", cameras=CAMERAS, water=LEVEL_M)
    plain = laspy.read(tmp_path / "plain.las")
    np.testing.assert_array_equal(still.points.array, plain.points.array)
    moving, summary = corrected("moving.las", 0.0, 0.4)
    assert "-0.200 to +0.200 m" in summary.water
    assert np.abs(moving.z - plain.z).max() > 0.01
    with refused("option.needs", option="image_times", needs="tide"):
        pcfix.correct_file(thin, tmp_path / "no.las", **options)
