"""Images that were each taken through water of their own: a sea that moves between them."""

import numpy as np
import pytest

import pcfix
from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.io.water_rasters import write_water_raster
from pcfix.model import WaterRaster
from tests.utils.waves import Sea, bed_seen

PLACE = np.array([512_000.0, 4_987_000.0, 0.0])
BED = (-2.0, 0.05, -0.03)
HIGH_M, HALF_M, CELL_M = 10.0, 12.0, 0.1
SEA, SECONDS = Sea(2.0), 1.7


def centres():
    x, y = np.meshgrid([-4.0, 0.0, 4.0], [-3.0, 3.0])
    return np.column_stack([x.ravel(), y.ravel(), np.full(6, HIGH_M)])


def block(suffix=".JPG"):
    return pcfix.Cameras(tuple(f"DCIM/DJI_{i}{suffix}" for i in range(6)), centres() + PLACE)


def true_bed():
    xy = np.random.default_rng(2).uniform([-4.0, -3.0], [4.0, 3.0], (400, 2))
    return np.column_stack([xy, BED[0] + xy @ BED[1:]])


def apparent(bed, times):
    """Return where straight rays of the images of bed points meet, by least squares."""
    system, right = np.zeros((len(bed), 3, 3)), np.zeros((len(bed), 3))
    for centre, time in zip(centres(), times, strict=True):
        down = (bed - centre) / (centre[2] - bed[:, 2])[:, None]
        for _ in range(60):  # of the slopes of the ray, until it comes to the point
            ray = down / np.linalg.norm(down, axis=1)[:, None]
            off = bed_seen(ray, centre, SEA, time, BED) - bed
            down[:, :2] -= off[:, :2] / HIGH_M
        assert np.abs(off).max() < 1e-9
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        system += across
        right += across @ centre
    return np.linalg.solve(system, right[..., None])[..., 0]


def raster_of(heights):
    """Return a raster of a function of places, from `PLACE`."""
    at = np.arange(-HALF_M + CELL_M / 2, HALF_M, CELL_M)
    x, y = np.meshgrid(at, at[::-1])
    values = heights(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
    return WaterRaster(values, PLACE[0] - HALF_M, PLACE[1] + HALF_M, (CELL_M, CELL_M))


def write(folder, heights, sigma=None):
    """Write a raster of each image, and its standard error."""
    (folder / "sigma").mkdir(parents=True)
    for number, one in enumerate(heights):
        write_water_raster(folder / f"DJI_{number}.tif", raster_of(one), None)
        if sigma is not None:
            error = raster_of(lambda xy: np.full(len(xy), sigma))
            write_water_raster(folder / "sigma" / f"DJI_{number}.tif", error, None)
    return folder


def sea_at(time):
    return lambda xy: SEA.at(xy, time)[0]


def rmse(found, bed):
    return float(np.sqrt(np.mean((found.xyz - PLACE - bed)[:, 2] ** 2)))


def test_a_bed_under_waves_comes_home(tmp_path):
    """Against the sea that bent the light, six images 1.7 s apart."""
    bed, times = true_bed(), SECONDS * np.arange(6)
    points = apparent(bed, times) + PLACE
    folder = write(tmp_path / "water", [sea_at(time) for time in times], 0.002)
    flat = rmse(pcfix.correct_points(points, block(), 0.0, index=1.34, method="snell"), bed)
    found = pcfix.correct_points(points, block(), 0.0, index=1.34, water_per_image=folder)
    own = rmse(found, bed)
    print(flat, own)
    assert (found.ray_count == 6).all()
    assert own < 0.2 * flat
