"""Cameras through the doors: what `pcfix cameras` says, and options that place and choose them."""

import json
import re
import struct
import warnings
from dataclasses import replace

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer

import pcfix
from pcfix.flow.checks import _sensors, check_cameras
from pcfix.flow.inputs import Inputs
from pcfix.flow.old_cameras import told_apart
from pcfix.io.cameras.colmap.writing import write_colmap
from pcfix.lens.imaging import project
from pcfix.model import Cameras, Lens
from pcfix.report.cameras import cameras_text
from tests.io.cameras import test_colmap as colmap
from tests.utils.program import run_pcfix
from tests.utils.shared import ROOT, needs

SCENE = ROOT / "samples" / "scene"
CLOUD, CAMERAS, SENSOR = SCENE / "cloud.laz", SCENE / "cameras.csv", SCENE / "sensor.csv"
RENDERED, rendered = needs("rendered_a")
SOROLLA, sorolla = needs("cameras", "metashape", "uclm_sorolla")


def table(path, change=lambda xyz: xyz, crs=None):
    """Write the scene's cameras with other coordinates, and return the path."""
    lines = CAMERAS.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    moved = change(np.array([[float(v) for v in row[1:4]] for row in rows]))
    text = [f"# crs: {crs}"] if crs else []
    text.append(lines[0])
    text += [
        ",".join([row[0], *(repr(float(v)) for v in xyz), *row[4:]])
        for row, xyz in zip(rows, moved, strict=True)
    ]
    path.write_text("\n".join(text) + "\n")
    return path


def words(*arguments):
    done = run_pcfix(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_block_that_fits_is_said_to_fit(tmp_path):
    said = words(
        "cameras", CAMERAS, "--cloud", CLOUD, "--water", "0.37",
        "--plot", tmp_path / "block.png", "--summary", tmp_path / "s.json",
    )  # fmt: skip
    assert "40 with a pose" in said
    assert (tmp_path / "block.png").read_bytes().startswith(b"\x89PNG")
    found = json.loads((tmp_path / "s.json").read_text())
    assert found["fit"]["fits"]
    assert found["fit"]["seen_by"]["3 or more"] == 1.0
    # the scene is flown 80 m above the water, tilted by a few degrees (pcfix.simulate.block)
    assert found["height_above_water_m"][1] == pytest.approx(80.0, abs=1.0)
    assert found["tilt_deg"][1] < 6.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: p[:, [1, 0, 2]], "swapped"),
        (lambda p: p / 0.3048, "feet"),
        (lambda p: p - [410_000.0, 4_650_000.0, 0.0], "--cameras-offset"),
        (lambda p: p - [0.0, 0.0, 100.0], "above the ellipsoid"),
        (lambda p: p + np.array([5e3, 0.0, 0.0]), "5004 m from the cloud in plan"),
    ],
)
def test_what_is_likely_wrong_is_said(tmp_path, change, said):
    path = table(tmp_path / "cameras.csv", change)
    report = check_cameras(path, cloud=CLOUD, sensor=SENSOR)
    assert not report.fit.fits
    assert re.search(said, report.fit.verdict), report.fit.verdict
    assert report.fit.verdict in cameras_text(report)


def test_wrong_angles_are_noticed(tmp_path):
    lines = CAMERAS.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    text = [lines[0], *(",".join([*r[:4], r[4], "60", r[6]]) for r in rows)]
    (tmp_path / "cameras.csv").write_text("\n".join(text) + "\n")
    report = check_cameras(tmp_path / "cameras.csv", cloud=CLOUD, sensor=SENSOR)
    assert "angles" in report.fit.verdict
    assert report.tilt_deg[0] > 50.0


def test_geocentric_cameras_without_a_map_have_no_height_over_the_water(tmp_path):
    """Their third number is a distance from the equator's plane, not a height."""
    to_earth = Transformer.from_crs("EPSG:32633", "EPSG:4978", always_xy=True)

    def geocentric(xyz):
        return np.column_stack(to_earth.transform(*xyz.T))

    path = table(tmp_path / "cameras.csv", geocentric, "EPSG:4978")
    report = check_cameras(path, sensor=SENSOR, water=0.37)
    said = cameras_text(report)
    assert report.problem
    assert report.height_above_water_m is None
    assert "Above water" not in said
    assert "GSD" not in said


@sorolla
def test_heights_off_by_the_geoid_are_no_fit(tmp_path):
    """The real block is above the ellipsoid, 51.5 m above the GNSS that it states in the geoid's.

    Frames hold the points all the same, as cameras that are too high see more.
    """
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [725_000.0, 4_369_000.0, 0.0]
    header.add_crs(CRS("EPSG:25830+5782"))
    cloud = laspy.LasData(header)
    x, y = (side.ravel() for side in np.mgrid[725_440:725_525:3, 4_369_105:4_369_170:3])
    cloud.x, cloud.y, cloud.z = x, y, np.full(len(x), 84.0)
    cloud.write(tmp_path / "cloud.las")
    with pytest.warns(pcfix.PcfixWarning, match="51.5 m above the heights that their GNSS states"):
        report = check_cameras(
            SOROLLA / "markers.xml", cloud=tmp_path / "cloud.las", cameras_crs="EPSG:25830"
        )
    assert not report.fit.fits
    assert "51.5 m above" in report.fit.verdict


def test_cameras_below_the_water_have_no_gsd():
    report = check_cameras(CAMERAS, sensor=SENSOR, water=1000.0)
    assert report.height_above_water_m[2] < 0.0
    assert "GSD" not in cameras_text(report)


LENS = Lens(3650.0, 5472.0, 3648.0, 2736.0, 1824.0, radial=(-0.02,), sensor="S")


def sensors_of(lenses):
    """Return the sensors of images that have these lenses."""
    k = len(lenses)
    cameras = Cameras(
        tuple(f"{i}.jpg" for i in range(k)), np.zeros((k, 3)), np.tile(np.eye(3), (k, 1, 1)), lenses
    )
    return _sensors(cameras, np.full(k, 80.0))


@pytest.mark.parametrize("names", [("S",), ("1 OPENCV", "2 OPENCV", "3 OPENCV")])
def test_lenses_that_differ_are_one_line_that_says_so(names):
    """A calibration for each image, as 177 of a block: one sensor, or one of each image."""
    lenses = tuple(
        replace(LENS, focal=3650.0 + i, sensor=names[i % len(names)]) for i in range(177)
    )
    sensors = sensors_of(lenses)
    assert len(sensors) == len(names)
    assert sum(sensor.lenses for sensor in sensors) == 177
    if len(names) == 1:
        assert (sensors[0].focal, sensors[0].focal_most) == (3650.0, 3826.0)


def test_sensors_of_each_image_come_together():
    lenses = tuple(
        replace(LENS, width=5472.0 + i, focal=3650.0 + i, sensor=f"{i} PINHOLE") for i in range(20)
    )
    sensors = sensors_of(lenses)
    assert [sensor.images for sensor in sensors] == [20]
    assert (sensors[0].frames, sensors[0].width) == (20, 5472.0)


def test_lenses_that_are_few_have_a_line_each():
    lenses = (LENS,) * 5 + (replace(LENS, focal=3700.0, sensor="T"),) * 5
    sensors = sensors_of(lenses)
    assert [(sensor.images, sensor.lenses, sensor.focal) for sensor in sensors] == [
        (5, 1, 3650.0),
        (5, 1, 3700.0),
    ]


@pytest.mark.parametrize(("k1", "folds"), [(-0.02, False), (-0.8, True)])
def test_a_lens_that_folds_within_the_frame_is_said(k1, folds):
    """x (1 + k1 x^2) turns at x^2 = -1 / (3 k1): for -0.8 at 0.65 of an angle that ends at 0.90."""
    sensors = sensors_of((replace(LENS, radial=(k1,)),) * 3)
    assert (sensors[0].folded > 0.0) == folds


def test_lenses_that_were_not_calibrated_are_said_beside_others_that_were():
    """As of the images of a rig that have no tie points."""
    nominal = replace(LENS, radial=(), sensor="NIR")
    sensors = sensors_of((LENS,) * 8 + (nominal,) * 8)
    assert [sensor.nominal for sensor in sensors] == [False, True]
    alone = sensors_of((nominal,) * 8)  # as undistorted photographs are
    assert not alone[0].nominal


SNELL = {"water": 0.37, "method": "snell", "max_angle": None}


def corrected(tmp_path, name, **options):
    path = tmp_path / name
    summary = pcfix.correct_file(CLOUD, path, **{**SNELL, "sensor": SENSOR, **options})
    return laspy.read(path), summary


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return corrected(tmp_path_factory.mktemp("plain"), "plain.las", cameras=CAMERAS)


def same(one, other, steps=0):
    """Whether coordinates differ by at most so many steps of the file."""
    return all(np.abs(one[axis].astype(np.int64) - other[axis]).max() <= steps for axis in "XYZ")


def test_cameras_in_another_zone_are_brought_over(tmp_path, plain):
    east = Transformer.from_crs("EPSG:32633", "EPSG:32634", always_xy=True)

    def moved(xyz):
        x, y = east.transform(xyz[:, 0], xyz[:, 1])
        return np.column_stack([x, y, xyz[:, 2]])

    # without angles: yaw counts from grid north, which differs by the convergence
    def bare(path, **more):
        lines = table(path, **more).read_text().splitlines()
        path.write_text("\n".join(",".join(line.split(",")[:4]) for line in lines) + "\n")
        return path

    here = {"max_angle": 40.0, "sensor": None}
    expected, _ = corrected(tmp_path, "a.las", cameras=bare(tmp_path / "a.csv"), **here)
    other = bare(tmp_path / "b.csv", change=moved)
    found, _ = corrected(tmp_path, "b.las", cameras=other, cameras_crs="EPSG:32634", **here)
    assert same(found, expected, steps=1)  # PROJ there and back is good to a micrometre
    with pytest.raises(pcfix.GeometryError):
        corrected(tmp_path, "c.las", cameras=other, **here)


def test_cameras_shifted_to_the_origin_take_an_offset(tmp_path, plain):
    shift = np.array([410_000.0, 4_650_000.0, 0.0])
    path = table(tmp_path / "cameras.csv", lambda xyz: xyz - shift)
    found, _ = corrected(tmp_path, "o.las", cameras=path, cameras_offset=tuple(shift))
    assert same(found, plain[0], steps=1)


@pytest.mark.parametrize("text", ["1,2", "a,b,c", "1,2,inf", ""])
def test_an_offset_is_three_numbers(tmp_path, text):
    done = run_pcfix(
        "correct", CLOUD, tmp_path / "o.las", "--cameras", CAMERAS, "--water", "0.37",
        "--cameras-offset", text,
    )  # fmt: skip
    assert done.returncode == 1
    assert "three numbers X,Y,Z" in done.stderr


def test_the_sensor_of_a_table_is_not_for_the_adjusted_model(tmp_path):
    """Which has its own lens, and would refuse another."""
    read = pcfix.read_cameras(CAMERAS, SENSOR)
    lens = replace(LENS, radial=())
    write_colmap(tmp_path / "model", replace(read, lenses=(lens,) * len(read)))
    model = Inputs(cameras=tmp_path / "model", adjusted_from=CAMERAS, sensor=SENSOR, water=0.37)
    old, new = told_apart(model)
    assert (old.sensor, new.sensor) == (SENSOR, None)
    old, new = told_apart(replace(model, cameras=CAMERAS))
    assert (old.sensor, new.sensor) == (SENSOR, SENSOR)


def in_frame(xyz, cameras):
    """Return which cameras (columns) hold which points, by projection."""
    held = []
    for rotation, centre, lens in zip(
        cameras.rotations, cameras.centres, cameras.lenses, strict=True
    ):
        u, v = project(lens, (xyz - centre) @ rotation.T).T
        held.append((u >= 0) & (u <= lens.width) & (v >= 0) & (v <= lens.height))
    return np.array(held).T


def test_a_list_of_all_in_frame_gives_what_no_list_gives(tmp_path, plain):
    cameras, xyz = pcfix.read_cameras(CAMERAS), laspy.read(CLOUD).xyz
    parts = [struct.pack("<Q", len(xyz))]
    for row in in_frame(xyz, cameras):
        names = np.flatnonzero(row)
        parts.append(struct.pack(f"<I{len(names)}I", len(names), *names))
    (tmp_path / "cloud.vis").write_bytes(b"".join(parts))
    found, summary = corrected(tmp_path, "v.las", cameras=CAMERAS, views=tmp_path / "cloud.vis")
    assert same(found, plain[0])
    assert summary.views["by_row"] == len(xyz)
    assert summary.views["share_seen"] == 1.0


@rendered
def test_views_of_a_real_cloud_change_the_rays(tmp_path):
    offset = [float(word) for word in (RENDERED / "offset.txt").read_text().splitlines()[1].split()]
    with pytest.warns(pcfix.PcfixWarning, match="dense.ply: has 83,334 points"):
        summary = pcfix.correct_file(
        RENDERED / "cloud.las", tmp_path / "c.las", cameras=RENDERED / "colmap", **SNELL,
        cameras_offset=tuple(offset), views=RENDERED / "dense.vis",
    )  # fmt: skip
    assert summary.corrected == summary.submerged
    assert summary.rays / summary.corrected == pytest.approx(5.5, abs=0.1)  # of the list's README


def test_tie_points_that_are_cut_short_are_said(tmp_path):
    """And a model without any is not worth a word."""
    model = colmap.folder(tmp_path / "sparse")
    inputs, path = Inputs(cameras=model, water=0.0), model / "points3D.txt"
    ties = inputs.tie_points(None)
    assert ties is not None
    path.write_text(f"# Number of points: {len(ties.xyz) + 1}\n{path.read_text()}")
    with pytest.warns(pcfix.PcfixWarning, match="is cut short: .* Its tie points are left out"):
        assert inputs.tie_points(None) is None
    path.unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert inputs.tie_points(None) is None
