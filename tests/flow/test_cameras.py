"""Inspect cameras with `pcfix cameras`, and options that place and choose them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pyproj import Transformer

import pcfix
from pcfix.flow.cameras import check_cameras, sensors_of
from pcfix.flow.inputs import Inputs, both_models
from pcfix.io.cameras.colmap import write_colmap
from pcfix.model import Cameras, Lens
from tests.utils.clouds import write_las
from tests.utils.program import run_pcfix
from tests.utils.shared import SCENE, needs

CLOUD, CAMERAS, SENSOR = SCENE / "cloud.laz", SCENE / "cameras.csv", SCENE / "sensor.csv"
SOROLLA, sorolla = needs("cameras", "metashape", "uclm_sorolla")


def test_good_block(tmp_path):
    done = run_pcfix(
        "cameras", CAMERAS, "--cloud", CLOUD, "--water", "0.37",
        "--summary", tmp_path / "s.json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "s.json").read_text())
    assert found["fit"]["fits"]
    assert found["fit"]["seen_by"]["3 or more"] == 1.0
    # the scene is flown 80 m above the water, tilted by a few degrees (pcfix.simulate.scene)
    assert found["height_above_water_m"][1] == pytest.approx(80.0, abs=1.0)
    assert found["tilt_deg"][1] < 6.0


def test_wrong_angles(tmp_path):
    lines = CAMERAS.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    text = [lines[0], *(",".join([*r[:4], r[4], "60", r[6]]) for r in rows)]
    (tmp_path / "cameras.csv").write_text("\n".join(text) + "\n")
    report = check_cameras(tmp_path / "cameras.csv", cloud=CLOUD, sensor=SENSOR)
    assert "angles" in report.figures["fit"]["verdict"]
    assert report.figures["tilt_deg"][0] > 50.0


def test_heights_above_the_water(tmp_path):
    """Geocentric cameras have none; cameras below the water have no GSD."""
    to_earth = Transformer.from_crs("EPSG:32633", "EPSG:4978", always_xy=True)

    lines = ["# crs: EPSG:4978", *CAMERAS.read_text().splitlines()]
    for i, row in enumerate(line.split(",") for line in lines[2:]):
        xyz = to_earth.transform(*map(float, row[1:4]))
        lines[2 + i] = ",".join([row[0], *map(repr, xyz), *row[4:]])
    path = tmp_path / "cameras.csv"
    path.write_text("\n".join(lines))
    report = check_cameras(path, sensor=SENSOR, water=0.37)
    assert report.figures["problem"]
    assert report.figures["height_above_water_m"] is None
    assert [sensor["gsd_m"] for sensor in report.figures["sensors"]] == [None]
    below = check_cameras(CAMERAS, sensor=SENSOR, water=1000.0)
    assert below.figures["height_above_water_m"][2] < 0.0
    assert [sensor["gsd_m"] for sensor in below.figures["sensors"]] == [None]


@sorolla
def test_heights_off_by_the_geoid(tmp_path):
    """The real block has ellipsoidal heights, 51.5 m above its GNSS, which is above the geoid.

    The points are in the frames all the same, as cameras that are too high see more.
    """
    x, y = (side.ravel() for side in np.mgrid[725_440:725_525:3, 4_369_105:4_369_170:3])
    xyz = np.column_stack([x, y, np.full(len(x), 84.0)])
    write_las(tmp_path / "cloud.las", xyz, crs="EPSG:25830+5782")
    report = check_cameras(
        SOROLLA / "markers.xml", cloud=tmp_path / "cloud.las", cameras_crs="EPSG:25830"
    )
    assert not report.figures["fit"]["fits"]
    assert "51.5 m above" in report.figures["fit"]["verdict"]


LENS = Lens(3650.0, 5472.0, 3648.0, 2736.0, 1824.0, radial=(-0.02,), sensor="S")
SERIES = [replace(LENS, focal=3650.0 + i) for i in range(177)]


@pytest.mark.parametrize(
    ("lenses", "images", "different"),
    [
        (SERIES, [177], [177]),  # a calibration for each image
        ([replace(one, sensor=f"{i % 3}") for i, one in enumerate(SERIES)], [59] * 3, [59] * 3),
        ([LENS] * 5 + [replace(LENS, focal=3700.0, sensor="T")] * 5, [5, 5], [1, 1]),
    ],
)  # fmt: skip
def test_groups_of_lenses(lenses, images, different):
    k = len(lenses)
    labels, rotations = tuple(f"{i}.jpg" for i in range(k)), np.tile(np.eye(3), (k, 1, 1))
    cameras = Cameras(labels, np.zeros((k, 3)), rotations, tuple(lenses))
    sensors = sensors_of(cameras, np.full(k, 80.0))
    assert [sensor["images"] for sensor in sensors] == images
    assert [sensor["lenses"] for sensor in sensors] == different
    most = [max(one.focal for one in lenses if sensor["name"] == one.sensor)
            for sensor in sensors]  # fmt: skip
    assert [sensor["focal_most"] for sensor in sensors] == most


def test_sensor_of_the_original_cameras(tmp_path):
    """Which has its own lens, and would refuse another."""
    read = pcfix.read_cameras(CAMERAS, SENSOR)
    lens = replace(LENS, radial=())
    write_colmap(tmp_path / "model", replace(read, lenses=(lens,) * len(read)))
    model = Inputs(cameras=tmp_path / "model", adjusted_from=CAMERAS, sensor=SENSOR, water=0.37)
    old, new = both_models(model)
    assert (old.sensor, new.sensor) == (SENSOR, None)
    old, new = both_models(replace(model, cameras=CAMERAS))
    assert (old.sensor, new.sensor) == (SENSOR, SENSOR)
