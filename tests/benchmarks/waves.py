"""Waves: what the median over a sequence and the surfaces from it are worth, for the README.

python -m tests.benchmarks.waves [--frames 24] [--slopes 1 2 5]
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import tempfile
import warnings
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

import pcfix
from pcfix.io.water_rasters import read_water_raster
from pcfix.model import Lens, WaterPlane
from pcfix.photos.ground import Ground
from pcfix.photos.mapping import Photo, Scene, exact, resample
from pcfix.water.surface import surface_above
from tests.utils.renderer import Relief, Texture, rendered
from tests.utils.waves import Sea, frame, rays_of

DOWN = np.diag([1.0, -1.0, -1.0])
LENS = Lens(540.0, 480, 360, 240.0, 180.0)
BASE_M, INTERVAL_S, DEPTH_M = 3.0, 0.2, 2.0
PLANE = (-DEPTH_M, 0.0, 0.0)


def photo(x):
    return Photo("f00", np.array([x, 0.0, 10.0]), DOWN, LENS)


def off_px(one, other):
    flow = cv2.DISOpticalFlow_create(1).calc(one, other, None)[20:-20, 20:-20]
    return float(np.sqrt((flow**2).sum(axis=2).mean()))


def sequence(folder, camera, sea, frames, start_s=0.0):
    """Write the frames, the pose, and return what `pcfix calm` finds."""
    (folder / "frames").mkdir(parents=True)
    for number in range(frames):
        image, _ = frame(camera, sea, start_s + INTERVAL_S * number, PLANE, TEXTURE)
        cv2.imwrite(str(folder / "frames" / f"f{number:02d}.png"), image)
    x = camera.centre[0]
    (folder / "poses.csv").write_text(f"label,x,y,z,yaw,pitch,roll\nf00,{x},0,10,0,0,0\n")
    (folder / "sensor.csv").write_text("focal,sensor_x,sensor_y\n54,48,36\n")
    return pcfix.calm_frames(
        folder / "frames", folder / "calm.png", still=True, surface=True, depth=DEPTH_M,
        cameras=folder / "poses.csv", interval=INTERVAL_S,
    )  # fmt: skip


def apparent(places, cameras, sea, time_s):
    """Return where straight rays to places of the sea's surface meet, two each."""
    pairs = []
    for xy, camera in zip(places, cameras, strict=True):
        ray = np.column_stack([xy, sea.at(xy, time_s)[0]]) - camera.centre
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        pairs.append((np.broadcast_to(camera.centre, ray.shape), ray))
    return met(pairs)


def met(pairs):
    """Return the points nearest to two rays each."""
    (a, s), (b, t) = pairs
    c, w = (s * t).sum(1), b - a
    d, e = (s * w).sum(1), (t * w).sum(1)
    one, other = (d - c * e) / (1 - c**2), (c * d - e) / (1 - c**2)
    return 0.5 * (a + one[:, None] * s + b + other[:, None] * t)


def crossing(place, camera, sea, time_s):
    """Return where light from the bed crosses the sea on its way to a camera, shape (n, 2)."""
    image, seen = frame(camera, sea, time_s, PLANE, TEXTURE)
    rays = rays_of(camera).reshape(*image.shape, 3)
    found = np.full((len(place), 2), np.nan)
    flat = seen[..., :2].reshape(-1, 2)
    away, row = cKDTree(flat).query(place[:, :2])
    column, line = row % image.shape[1], row // image.shape[1]
    inside = (column > 0) & (column < image.shape[1] - 1) & (line > 0) & (line < image.shape[0] - 1)
    for i in np.flatnonzero(inside & (away < 0.05)):
        here = seen[line[i], column[i]]
        jacobian = (
            np.column_stack(
                [
                    seen[line[i], column[i] + 1, :2] - seen[line[i], column[i] - 1, :2],
                    seen[line[i] + 1, column[i], :2] - seen[line[i] - 1, column[i], :2],
                ]
            )
            / 2.0
        )
        step = np.linalg.solve(jacobian, place[i, :2] - here[:2])
        ray = rays[line[i], column[i]] / -rays[line[i], column[i], 2]
        ray += np.array([step[0], -step[1], 0.0]) / LENS.focal
        height = 0.0
        for _ in range(5):
            xy = camera.centre[:2] + (height - 10.0) / ray[2] * ray[:2]
            height = sea.at(xy[None], time_s)[0][0]
        found[i] = xy
    return found


def measured(degrees, frames, folder):
    sea, left, right = Sea(degrees), photo(0.0), photo(BASE_M)
    calm, _ = frame(left, Sea(0.0), 0.0, PLANE, TEXTURE)
    one = sequence(folder / "left", left, sea, frames)
    sequence(folder / "right", right, sea, frames)
    images = [cv2.imread(str(p), 0) for p in sorted((folder / "left" / "frames").iterdir())]
    median = cv2.imread(str(folder / "left" / "calm.png"), 0)
    x, y = np.meshgrid(np.arange(-3.6, 3.7, 0.3), np.arange(-2.7, 2.8, 0.3))
    xy = np.column_stack([x.ravel(), y.ravel()])
    at = np.column_stack([xy, np.zeros(len(xy))])
    true, slopes, high, inside = [], [], [], []
    for number in range(0, frames, 4):
        name = f"f{number:02d}.tif"
        water = read_water_raster(folder / "left" / "calm_water" / name)
        sigma = read_water_raster(folder / "left" / "calm_water" / "sigma" / name)
        height, slope = sea.at(xy, INTERVAL_S * number)
        found = surface_above(water, at)
        true.append(slope)
        slopes.append(found.slope - slope)
        high.append(found.height_m - height)
        inside.append(np.abs(high[-1]) < 1.96 * surface_above(sigma, at).height_m)
    number = frames // 2 // 4 * 4
    time, name = INTERVAL_S * number, f"f{number:02d}.tif"
    bed = np.random.default_rng(1).uniform([-1.5, -2.0], [4.0, 2.0], (800, 2))
    bed = np.column_stack([bed, np.full(800, -DEPTH_M)])
    places = [crossing(bed, camera, sea, time) for camera in (left, right)]
    both = np.isfinite(places[0] + places[1]).all(axis=1)
    points = apparent([place[both] for place in places], (left, right), sea, time)
    own = folder / "own"
    (own / "sigma").mkdir(parents=True)
    for side, part in itertools.product(("left", "right"), (".", "sigma")):
        shutil.copy(folder / side / "calm_water" / part / name, own / part / f"{side}.tif")
    centres = np.array([left.centre, right.centre])
    block = pcfix.Cameras(("left", "right"), centres, np.array([DOWN, DOWN]), (LENS, LENS))
    rmse = []
    for way in ({"camera_set": "all"}, {"water_per_image": own}):
        found = pcfix.correct_points(points, block, 0.0, method="consistent", **way)
        rmse.append(np.sqrt(np.mean((found.xyz[found.corrected, 2] + DEPTH_M) ** 2)))
    ground = Ground(np.full((80, 80), -DEPTH_M), -10.0, 10.0, 0.25)
    dry, _ = rendered(left, Relief(np.full((80, 80), -DEPTH_M), -10.0, 10.0, 0.25), TEXTURE)
    photos = []
    for water in (WaterPlane(0.0), read_water_raster(folder / "left" / "calm_water" / name)):
        made = resample(images[number][..., None], exact(left, Scene(ground, water, 1.34), 4))
        photos.append(off_px(made.image[..., 0], dry))
    deg = np.degrees(1.0)
    print(
        f"| {degrees:g} | {np.mean([off_px(i, calm) for i in images[::4]]):.2f} |"
        f" {off_px(median, calm):.2f} |"
        f" {np.std(images[4] - 1.0 * calm):.1f} | {np.std(median - 1.0 * calm):.1f} |"
        f" {np.std(true) * deg:.2f} | {np.sqrt(np.mean(np.square(slopes))) * deg:.2f} |"
        f" {100 * np.std(high):.2f} | {100 * np.mean(inside):.0f} |"
        f" {photos[0]:.2f} | {photos[1]:.2f} | {100 * rmse[0]:.1f} | {100 * rmse[1]:.1f} |",
        one.water.waves, one.water.explained, flush=True,
    )  # fmt: skip


TEXTURE = Texture(0.1, 1.5)

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--slopes", type=float, nargs="+", default=[1.0, 2.0, 5.0])
    given = parser.parse_args()
    for degrees in given.slopes:
        with tempfile.TemporaryDirectory() as scratch:
            measured(degrees, given.frames, Path(scratch))
