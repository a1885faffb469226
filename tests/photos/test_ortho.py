"""The orthophoto of a rendered ground under water against its texture."""

import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need the extra 'photos'")

import cv2
import rasterio

import pcfix
from pcfix.model import WaterPlane
from pcfix.photos.mapping import Ground, Photo, Scene
from pcfix.photos.ortho import Picture, mosaic, picture_of, seen_at
from tests.photos.test_mapping import GSD_M, LEVEL_M, displacement_px, photo, relief
from tests.utils.rasters import write_raster
from tests.utils.renderer import Texture, rendered

TEXTURE = Texture(5.0 * GSD_M, 1.5)
PHOTOS = (photo(-9.0), photo(9.0, tilt=(-3.0, 2.0)))
HALF_M = 12.0


@pytest.fixture(scope="module")
def pictures():
    return [rendered(one, relief(), TEXTURE, LEVEL_M)[0] for one in PHOTOS]


@pytest.fixture(scope="module")
def scene():
    return Scene(Ground(*relief()), WaterPlane(LEVEL_M), 1.34)


def cells(scene):
    side = np.arange(-HALF_M, HALF_M, GSD_M) + 0.5 * GSD_M
    x, y = (one.ravel() for one in np.meshgrid(side, side[::-1]))
    return np.column_stack([x, y, scene.ground.heights_at(np.column_stack([x, y]))]), len(side)


def test_bed_in_place(scene, pictures):
    xyz, side = cells(scene)
    colour, covered = mosaic(xyz, PHOTOS, scene, lambda k: picture_of(pictures[k][..., None]))
    truth = np.rint(255.0 * TEXTURE(xyz[:, :2])).astype(np.uint8).reshape(side, side)
    made = np.clip(np.rint(colour), 0, 255).astype(np.uint8).reshape(side, side)
    hidden = cv2.dilate((~covered).astype(np.uint8).reshape(side, side), np.ones((25, 25)))
    made = np.where(hidden > 0, truth, made)
    off = np.hypot(*displacement_px(made, truth).T)
    straight, _ = mosaic(
        xyz, PHOTOS, Scene(scene.ground, WaterPlane(-1e5), 1.34),
        lambda k: picture_of(pictures[k][..., None]),
    )  # fmt: skip
    without = np.clip(np.rint(straight), 0, 255).astype(np.uint8).reshape(side, side)
    uncorrected = np.hypot(*displacement_px(np.where(hidden > 0, truth, without), truth).T)
    assert covered.mean() > 0.97
    # px: photographs sampled without a filter, and resampled
    assert np.quantile(off, [0.5, 0.95]) == pytest.approx([0.0, 0.0], abs=0.2)
    assert np.quantile(uncorrected, 0.95) > 1.0  # there is something to trace


def test_seam(scene):
    xyz, _ = cells(scene)
    flat = [np.full((360, 480, 1), grey, np.uint8) for grey in (50, 150)]
    colour, covered = mosaic(xyz, PHOTOS, scene, lambda k: Picture(flat[k]))
    west = covered & (xyz[:, 0] < -2.0)
    east = covered & (xyz[:, 0] > 2.0)
    mixed = covered & (colour[:, 0] > 60.0) & (colour[:, 0] < 140.0)
    assert np.median(colour[west]) == 50.0
    assert np.median(colour[east]) == 150.0
    assert (colour[west] == 50.0).mean() > 0.95  # the rest is behind boulder and ledge
    assert 0.0 < mixed.mean() < 0.1
    assert np.abs(xyz[mixed, 0]).max() < 4.0


def test_occluded():
    height = np.zeros((60, 60))
    height[:, 30] = 8.0
    ground = Ground(height, -30.0, 30.0, 1.0)
    scene = Scene(ground, WaterPlane(2.0), 1.34)
    at = np.array([[-12.0, 0.0, 0.0], [2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    nadir = Photo("P", np.array([-12.0, 0.0, 40.0]), np.diag([1.0, -1.0, -1.0]), photo().lens)
    _, seen = seen_at(nadir, at, scene)
    assert seen.tolist() == [True, False, True]


@pytest.fixture
def block(tmp_path, pictures):
    """A folder of photographs, their cameras, and a DSM in EPSG:32636."""
    folder = tmp_path / "images"
    folder.mkdir()
    for k, grey in enumerate(pictures):
        colour = np.dstack([grey, grey // 2, 255 - grey])  # blue, green, red in OpenCV
        cv2.imwrite(str(folder / f"P{k}.png"), colour)
    shift = np.array([500_000.0, 3_800_000.0, 0.0])
    cameras = pcfix.Cameras(
        ("P0", "P1"), np.array([one.centre for one in PHOTOS]) + shift,
        np.array([one.rotation for one in PHOTOS]), tuple(one.lens for one in PHOTOS),
    )  # fmt: skip
    place = 499_955.0, 3_800_045.0, 0.2
    write_raster(tmp_path / "dsm.tif", relief().height_m, *place, crs="EPSG:32636")
    return folder, {"cameras": cameras, "dsm": tmp_path / "dsm.tif", "water": LEVEL_M}


def test_file(tmp_path, block):
    folder, how = block
    done = pcfix.ortho_photo(folder, tmp_path / "ortho.tif", **how, resolution=0.2)
    with rasterio.open(tmp_path / "ortho.tif") as raster:
        assert raster.crs.to_epsg() == 32636
        assert [one.name for one in raster.colorinterp] == ["red", "green", "blue", "alpha"]
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        red, _, blue, alpha = raster.read()
        assert (raster.width, raster.height) == (450, 450) == (done.width, done.height)
    assert set(np.unique(alpha)) == {0, 255}
    assert (alpha > 0).mean() == pytest.approx(done.covered_share, abs=0.01)
    assert not red[alpha == 0].any()
    assert np.corrcoef(red[alpha > 0], blue[alpha > 0])[0, 1] < -0.99
