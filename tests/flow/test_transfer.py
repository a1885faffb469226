"""A cloud of the original cameras, corrected with adjusted ones, through every door."""

from dataclasses import replace
from functools import partial

import laspy
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.flow.inputs import Inputs, both_models
from pcfix.model import Cameras, Outcome, Views
from pcfix.report.text import text_of
from tests.flow.test_adjust_shared import errors_gsd
from tests.utils.beyond_frames import BEYOND_FRAMES
from tests.utils.clouds import (
    EAST_M,
    NORTH_M,
    SCALES,
    SIDE_M,
    WATER_M,
    cameras_csv,
    framed_block,
    read_raw,
    write_cloud,
)
from tests.utils.codes import refused
from tests.utils.nightly import mostly_nightly
from tests.utils.shared import needs

pytestmark = BEYOND_FRAMES

FREE, free = needs("rendered_a_free")
TRUE, true = needs("rendered_a")

MIDDLE = np.array([EAST_M + SIDE_M / 2, NORTH_M + SIDE_M / 2, WATER_M])
TURN = Rotation.from_rotvec([0.004, -0.003, 0.05]).as_matrix()


def similar(xyz):
    """Return points turned, stretched and shifted by about two metres."""
    return MIDDLE + 1.002 * (xyz - MIDDLE) @ TURN.T + [0.9, -0.6, -1.5]


def adjusted(old):
    return replace(old, centres=similar(old.centres), rotations=old.rotations @ TURN.T)


@pytest.fixture
def old():
    return framed_block()


@pytest.fixture
def cloud(tmp_path):
    return write_cloud(tmp_path / "cloud.las", 7)


SNELL = {"method": "snell", "max_angle": None}
snell = partial(pcfix.correct_points, **SNELL)


def correct(cloud, **more):
    output = cloud.with_name("out.las")
    summary = pcfix.correct_file(cloud, output, water=WATER_M, overwrite=True, **SNELL, **more)
    return summary, laspy.read(cloud), laspy.read(output)


def shift_of(las):
    return np.column_stack([np.array(las.points.array[f"Shift{a}"]) for a in "XYZ"]).astype(int)


def test_same_cameras(cloud, old):
    summary, _, transferred = correct(cloud, cameras=old, adjusted_from=old)
    _, before, plain = correct(cloud, cameras=old)
    # the last step of the intersection may be 1e-6 m: a thousandth of one of the file's
    assert np.abs(shift_of(transferred) - shift_of(plain)).max() <= 1
    land = np.array(before.z) > WATER_M + 0.01
    assert land.sum() > 900
    assert not shift_of(transferred)[land].any()
    assert summary.transfer["shift_m"]["rms"] == 0.0
    seen = summary.transfer["not_transferred"]
    assert summary.transfer["points"] + seen + sum(summary.uncorrected.values()) == len(before)


def test_land_and_bed(cloud, old):
    new = adjusted(old)
    summary, before, after = correct(cloud, cameras=new, adjusted_from=old)
    apparent = np.array(before.xyz)
    expected = snell(similar(apparent), new, WATER_M)
    stuck = np.array(after.RayCount) == 0
    land = expected.outcome == Outcome.LAND
    # what is under water is decided where the points are taken to
    sank = land != (apparent[:, 2] > WATER_M)
    assert sank.sum() > 30
    went = np.array(after.xyz) - expected.xyz
    transferred = (land & shift_of(after).any(axis=1)) | ~stuck
    assert transferred.sum() > 500  # of 2000: the frames leave gaps
    # half a step of the file
    assert (np.abs(went[transferred]) <= 0.5 * np.array(SCALES) + 2e-6).all()
    assert (np.array(after.classification)[~stuck] == 40).all()
    assert np.array_equal(
        np.array(after.classification)[land], np.array(before.classification)[land]
    )
    assert not np.array(after.RayCount)[land].any()
    assert not np.array(after.SourceClass)[land & transferred].any()
    assert summary.transfer["land"] == (land & transferred).sum()
    distance = np.linalg.norm(similar(apparent) - apparent, axis=1)[transferred]
    assert summary.transfer["points"] == transferred.sum()
    assert summary.transfer["shift_m"]["rms"] == pytest.approx(
        np.sqrt((distance**2).mean()), abs=1e-4
    )
    assert f"({summary.transfer['land']:,} on land)" in text_of("correct", summary)


def test_unseen_points(cloud, old):
    summary, before, after = correct(cloud, cameras=adjusted(old), adjusted_from=old)
    result = snell(before.xyz, adjusted(old), WATER_M, adjusted_from=old)
    behind = result.outcome == Outcome.NOT_TRANSFERRED
    assert summary.transfer["not_transferred"] == behind.sum() > 10
    assert not shift_of(after)[behind].any()
    assert np.array(after.withheld)[behind].all()
    assert np.array_equal(
        np.array(after.classification)[behind], np.array(before.classification)[behind]
    )


@pytest.mark.parametrize("number", [1, 7])
def test_restored(tmp_path, old, number):
    cloud = write_cloud(tmp_path / "cloud.las", number)
    correct(cloud, cameras=adjusted(old), adjusted_from=old)
    pcfix.restore_file(tmp_path / "out.las", tmp_path / "back.las")
    before, back = read_raw(cloud), read_raw(tmp_path / "back.las")
    assert np.array_equal(before.points, back.points)


def test_views(old):
    """They come in another order there, and under whole paths; one was not adjusted."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform((EAST_M, NORTH_M, 5.0), (EAST_M + SIDE_M, NORTH_M + SIDE_M, 11.0), (200, 3))
    rays = xyz[:, None] - old.centres
    along = np.einsum("ikj,kj->ik", rays, old.rotations[:, 2]) / np.linalg.norm(rays, axis=2)
    listed = np.argsort(-along, axis=1)[:, :4]  # cameras that look elsewhere would not count
    views = Views(np.arange(0, 801, 4), listed.ravel())
    new = adjusted(old)
    straight = pcfix.correct_points(similar(xyz), new, WATER_M, views=views, method="snell")
    order = rng.permutation(9)
    shuffled = Cameras(
        (*(f"C:\\flight\\{old.labels[i]}.JPG" for i in order), "another"),
        np.vstack([old.centres[order], MIDDLE[None] + np.array([0.0, 0.0, 75.0])]),
        np.concatenate([old.rotations[order], old.rotations[:1]]),
        (*(old.lenses[i] for i in order), old.lenses[0]),
    )
    place = np.argsort(order)
    theirs = Views(views.start, place[views.camera])
    found = snell(xyz, new, WATER_M, adjusted_from=shuffled, views=theirs)
    corrected = straight.corrected
    assert np.array_equal(found.corrected, corrected)
    assert corrected.sum() > 150
    assert np.abs(found.xyz - straight.xyz)[corrected].max() < 1e-5  # m; carried to 1e-6
    assert np.array_equal(found.ray_count, straight.ray_count)
    # an image that was not adjusted leaves the lists
    fewer = replace(
        new, labels=new.labels[1:], centres=new.centres[1:], rotations=new.rotations[1:],
        lenses=new.lenses[1:],
    )  # fmt: skip
    found = snell(xyz, fewer, WATER_M, adjusted_from=shuffled, views=theirs)
    has = (listed == 0).any(axis=1) & found.corrected & corrected
    assert np.array_equal(found.ray_count[has], straight.ray_count[has] - 1)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"labels": tuple("abcdefghi")}, "adjusted_from.no_image"),
        ({"rotations": None, "lenses": None}, "cameras.no_angles"),
        ({"lenses": None}, "cameras.no_lens"),
        ({"centres": 40.0}, "adjusted_from.too_far"),
        (
            {"labels": ("a/c0.jpg", "b/c0.jpg", *(f"c{i}" for i in range(2, 9)))},
            "adjusted_from.ambiguous",
        ),
        ({"lenses": 9.5}, "adjusted_from.shape"),
    ],
)
def test_other_block(cloud, old, change, code):
    if "centres" in change:
        change = {"centres": old.centres + np.array([change["centres"], 0.0, 0.0])}
    if change.get("lenses"):
        change = {"lenses": tuple(replace(lens, height=9.5) for lens in old.lenses)}
    with refused(code):
        correct(cloud, cameras=old, adjusted_from=replace(old, **change))
    assert not cloud.with_name("out.las").exists()


@pytest.mark.parametrize("local", ["old", "new", "both", "neither"])
@pytest.mark.parametrize("is_stated", [False, True])
def test_offset(tmp_path, old, local, is_stated):
    offset = np.array([EAST_M, NORTH_M, 0.0])
    (tmp_path / "sensor.csv").write_text("focal,sensor_x,sensor_y\n24,24,9.6\n")
    for name, moved in (("old", 0.0), ("new", 0.5)):
        away = offset if local in (name, "both") else 0.0
        table = cameras_csv(
            tmp_path / f"{name}.csv", replace(old, centres=old.centres - away + moved), angles=True
        )
        if is_stated and local not in (name, "both"):
            table.write_text("# CoordinateSystem: EPSG:32633\n" + table.read_text())
    inputs = Inputs(
        cameras=tmp_path / "new.csv", water=WATER_M, adjusted_from=tmp_path / "old.csv",
        cameras_offset=tuple(offset),
    )  # fmt: skip
    before, after = both_models(inputs)
    if local == "neither":  # then it is of both, as it is of one file that says its CRS
        assert before.cameras_offset == after.cameras_offset == tuple(offset)
        return
    assert (before.cameras_offset is not None) == (local in ("old", "both"))
    assert (after.cameras_offset is not None) == (local in ("new", "both"))


@free
@true
@pytest.mark.parametrize("views", mostly_nightly([None, "dense.vis"], "dense.vis"))
def test_rendered_block(tmp_path, views):
    """With true poses; without the transfer land is 19 GSD (of 5 cm) too low, the bed 27 off."""
    summary = pcfix.correct_file(
        FREE / "cloud.las", tmp_path / "out.las", cameras=TRUE / "colmap", water=0.37,
        adjusted_from=FREE / "sparse", cameras_offset=tuple(np.loadtxt(FREE / "offset.txt")),
        views=None if views is None else FREE / views,
    )  # fmt: skip
    las = laspy.read(tmp_path / "out.las")
    bed, land = errors_gsd(las)
    assert summary.transfer["points"] == summary.points
    # the noise of the matcher: with the true cameras from the start it leaves as much
    assert np.sqrt((land**2).mean()) < 0.7
    assert np.sqrt((bed**2).mean()) < 0.95
    assert summary.transfer["shift_m"]["mean_z"] > 1.0
    pcfix.restore_file(tmp_path / "out.las", tmp_path / "back.las")
    assert (tmp_path / "back.las").read_bytes() == (FREE / "cloud.las").read_bytes()


OBLIQUE, oblique = needs("rendered_c")
OBLIQUE_FREE, oblique_free = needs("rendered_c_free")


@oblique
@oblique_free
@pytest.mark.nightly
def test_fused_maps_without_list(tmp_path):
    """In the original model depths change with the bed in another way than with true poses."""
    pcfix.correct_file(
        OBLIQUE_FREE / "cloud.las", tmp_path / "out.las", cameras=OBLIQUE / "colmap", water=0.37,
        adjusted_from=OBLIQUE_FREE / "sparse", method="consistent",
        cameras_offset=tuple(np.loadtxt(OBLIQUE_FREE / "offset.txt")),
    )  # fmt: skip
    bed, land = errors_gsd(laspy.read(tmp_path / "out.las"), OBLIQUE)
    # GSD: 1.27 and 1.12; with the change of true poses the wrong maps are chosen: 1.59 and 1.59
    assert np.sqrt((bed**2).mean()) < 1.35
    assert np.sqrt((land**2).mean()) < 1.2
