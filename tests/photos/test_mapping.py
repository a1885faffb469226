"""Photographs against a rendering of the same ground without water."""

import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need the extra 'photos'")

from pcfix.lens.rotations import from_yaw_pitch_roll
from pcfix.model import Lens, WaterPlane
from pcfix.photos.mapping import Ground, Photo, Scene, exact, nodes_of, paper, resample
from tests.utils.renderer import Relief, Texture, rendered

LENS = Lens(600.0, 480, 360, 243.0, 178.0)
LEVEL_M = 0.3
GSD_M = 60.0 / 600.0


def relief(cell_m=0.2):
    """Return a beach that falls away to 8 m of water, with boulders and a ledge."""
    x = -45.0 + cell_m * (np.arange(int(90 / cell_m)) + 0.5)
    y = 45.0 - cell_m * (np.arange(int(90 / cell_m)) + 0.5)
    x, y = np.meshgrid(x, y)
    height = 2.0 - 0.12 * (x + 30.0) - 1.2 * (1.0 + np.tanh((x - 8.0) / 1.5))
    height += 0.5 * np.exp(-((x - 3.0) ** 2 + (y - 6.0) ** 2) / 3.0)
    return Relief(height + 0.15 * np.sin(x / 3.0) * np.cos(y / 2.5), -45.0, 45.0, cell_m)


def photo(x=0.0, tilt=(4.0, 3.0)):
    rotation = from_yaw_pitch_roll(np.array([35.0]), np.array([tilt[0]]), np.array([tilt[1]]))[0]
    return Photo("P", np.array([x, 0.0, 60.0]), rotation, LENS)


@pytest.fixture(scope="module")
def scene():
    ground = relief()
    return Scene(Ground(*ground), WaterPlane(LEVEL_M), 1.34)


@pytest.fixture(scope="module")
def views():
    """Return the image with water and its places on the ground, then those without."""
    texture = Texture(5.0 * GSD_M, 1.5)
    wet, dry = (rendered(photo(), relief(), texture, level) for level in (LEVEL_M, None))
    return *wet, *dry


def displacement_px(one, other, every=6):
    """Return how far places of an image lie from where another has them (Lucas and Kanade)."""
    import cv2

    rows, columns = one.shape
    u, v = np.meshgrid(np.arange(20, columns - 20, every), np.arange(20, rows - 20, every))
    at = np.column_stack([u.ravel(), v.ravel()]).astype(np.float32)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, at, None, winSize=(21, 21), maxLevel=2, minEigThreshold=3e-3
    )
    return (moved - at)[found.ravel() == 1]


def test_exact(scene, views):
    wet, _, dry, place = views
    image, touched, _ = resample(wet[..., None], exact(photo(), scene, 4))
    lost = touched & (image[..., 0] == 0)
    before = np.hypot(*displacement_px(wet, dry).T)
    after = np.hypot(*displacement_px(np.where(lost, dry, image[..., 0]), dry).T)
    assert np.quantile(before, 0.95) > 3.0  # px: there is something to undo
    # px: 0.03 is what OpenCV's bicubic kernel moves ramps by; windows over hidden places go astray
    assert np.quantile(after, 0.5) < 0.04
    assert np.quantile(after, 0.95) < 0.1
    land = place[..., 2] > LEVEL_M + 0.1
    assert land.mean() > 0.1
    assert (image[..., 0] == wet)[land & ~touched].all()
    assert touched[land].mean() < 0.05


@pytest.mark.parametrize("step_px", [1, 4, 8])
def test_exact_places(scene, views, step_px):
    _, seen, _, straight = views
    mapped = resample(seen[..., :2].astype(np.float32), exact(photo(), scene, step_px))[0]
    known = (np.abs(mapped).max(axis=2) > 0.0)[10:-10, 10:-10]
    off = np.hypot(*(mapped - straight[..., :2])[10:-10, 10:-10][known].T) / GSD_M
    # px: the kernel again; 1 % is ground behind an edge
    assert np.quantile(off, [0.5, 0.99]).max() < 0.1
    assert known.mean() > 0.9


def test_paper_limit():
    """Near nadir a round makes h0 + (n - 1) h of a depth h; the steps have the ratio n - 1."""
    n, true, height = 1.34, 3.0, 60.0
    level = photo(tilt=(0.0, 0.0))
    apparent = true / n
    depth, steps = apparent, []
    for _ in range(4):
        flat = Ground(np.full((90, 90), LEVEL_M - depth), -45.0, 45.0, 1.0)
        shifts = paper(level, Scene(flat, WaterPlane(LEVEL_M), n), 8)
        nodes, _ = nodes_of(LENS, 8)
        radial = nodes - [LENS.principal_x, LENS.principal_y]
        inner = np.hypot(*radial.T) < 60.0
        inner &= np.hypot(*radial.T) > 20.0
        # without water the bed's points lie nearer to the middle: where they come from, over where
        # they go to, is how the scale and so the distance of the bed changes
        moved = shifts.shift_px.reshape(-1, 2)[inner]
        scale = np.median(
            ((radial[inner] + moved) * radial[inner]).sum(1) / (radial[inner] ** 2).sum(1)
        )
        new = scale * (height - LEVEL_M + apparent) - (height - LEVEL_M)
        steps.append(new - depth)
        depth = new
    ratios = np.array(steps[1:]) / np.array(steps[:-1])
    assert ratios == pytest.approx(n - 1.0, abs=0.04)  # 0.30 to 0.35 in Figs 15 and 17
    assert depth == pytest.approx(apparent / (2.0 - n), rel=0.02)
    assert depth > 1.1 * true
