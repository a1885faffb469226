"""Frames of distorted lenses: the slow implementation, tiles, and cameras without lenses."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.lens.imaging import NOT_DISTORTED, frames_of, holds
from pcfix.refract.intersect import TILE
from tests.refract.test_kernels import same
from tests.utils.beyond_frames import BEYOND_FRAMES
from tests.utils.compiled import compiled
from tests.utils.nightly import mostly_nightly
from tests.utils.twins import image_slowly

holds = compiled(holds)

pytestmark = BEYOND_FRAMES

snell = partial(pcfix.correct_points, method="snell", max_angle=None)

N = 2 * TILE + 17  # fewer than tell how a list was made, which SigmaZ would have
SIZE = (4000.0, 3000.0, 2010.0, 1490.0)
LENSES = {
    "barrel": pcfix.Lens(3000.0, *SIZE, radial=(-0.28, 0.12, -0.02)),
    "pincushion": pcfix.Lens(3000.0, *SIZE, radial=(0.25, 0.3)),
    "everything": pcfix.Lens(
        3000.0, *SIZE, b1=9.0, b2=-5.0, b3=2.0, radial=(-0.1, 0.02, -0.003, 0.001, 0.0002),
        denominator=(0.02,), tangential=(2e-3, -1e-3, 0.1), thin_prism=(1e-3, 0.0, -2e-3),
        distortion_centre=(0.02, -0.03),
    ),
    "plain": pcfix.Lens(
        3000.0, *SIZE, b1=9.0, b2=-5.0, b3=2.0, radial=(-0.1, 0.02, -0.003, 0.001),
        tangential=(2e-3, -1e-3), distortion_centre=(0.02, -0.03),
    ),
    "inverse": pcfix.Lens(3000.0, *SIZE, radial=(0.15,), inverse=True),
    "fisheye": pcfix.Lens(2200.0, *SIZE, projection="equidistant", radial=(-0.02, 0.003)),
    "wide fisheye": pcfix.Lens(
        2000.0, *SIZE, projection="polynomial", shape=(0.0, 1.0, 0.01, -0.05)
    ),
    "round fisheye": pcfix.Lens(1100.0, *SIZE, projection="equisolid"),
    "folding": pcfix.Lens(3000.0, *SIZE, radial=(-0.9,)),
    "straight": pcfix.Lens(3000.0, *SIZE),
}  # fmt: skip


def block(lens, k=25, seed=7):
    """Return cameras over 100 m by 100 m; each sees part of the points, the wide ones tilted."""
    wide = lens.projection in ("polynomial", "equisolid")
    rng = np.random.default_rng(seed)
    centres = np.column_stack([rng.uniform(0, 100, (k, 2)), rng.uniform(55, 65, k)])
    turns = rng.normal(0, [90, 60, 60] if wide else [90, 12, 12], (k, 3))
    tilt = Rotation.from_euler("zyx", turns, degrees=True)
    rotations = np.diag([1.0, -1.0, -1.0]) @ tilt.as_matrix().transpose(0, 2, 1)
    return pcfix.Cameras(tuple(map(str, range(k))), centres, rotations, (lens,) * k)


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(8)
    return np.column_stack([rng.uniform(-60, 160, (N, 2)), -rng.uniform(0.1, 8, N)])


def seen_slowly(lens, direction):
    """Whether a direction is in the frame, by the slow twin."""
    if lens.projection == "perspective" and (direction[2] <= 0.0 or is_folded(lens, direction)):
        return False
    u, v = image_slowly(lens, direction)
    return 0.0 <= u <= lens.width and 0.0 <= v <= lens.height


def is_folded(lens, direction):
    """Whether r' comes to a maximum on the way out to a direction, in small steps."""
    if lens.inverse:
        return False
    r = np.linspace(0.0, np.hypot(*direction[:2]) / direction[2], 3000)
    slope = sum((2 * i + 1) * k * r ** (2 * i) for i, k in enumerate((1.0, *lens.radial)))
    return bool((slope <= 0.0).any())


@pytest.mark.parametrize("name", mostly_nightly(LENSES, "everything", "fisheye", "straight"))
def test_slow_implementation(name, points):
    lens, cameras = LENSES[name], block(LENSES[name])
    some = points if name != "inverse" else points[: 2 * TILE]  # its twin is very slow
    rays = np.einsum("kij,mkj->mki", cameras.rotations, some[:, None] - cameras.centres)
    in_frame = np.array([[seen_slowly(lens, ray) for ray in of_point] for of_point in rays])
    seen = in_frame.sum(axis=1)
    views = pcfix.Views(np.concatenate([[0], np.cumsum(seen)]), np.nonzero(in_frame)[1])
    result = snell(some, cameras, 0.0)
    assert 0 <= seen.min() < seen.max() <= len(cameras)  # the scene tests something
    assert np.array_equal(result.ray_count, np.where(seen >= 2, seen, 0))
    same(result, snell(some, cameras, 0.0, views=views))


def test_different_lenses(points):
    """Coefficients of unequal number share one table."""
    names = ["barrel", "everything", "fisheye", "wide fisheye", "straight", "barrel"]
    mixed = replace(block(LENSES["barrel"], k=6), lenses=tuple(LENSES[name] for name in names))
    frames = frames_of(mixed)
    assert frames.row.tolist() == [0, 1, 2, 3, NOT_DISTORTED, 0]
    for c, lens in enumerate(mixed.lenses):
        single = frames_of(replace(mixed, lenses=(lens,) * 6))
        for e in map(tuple, mixed.centres[c] - points[:100]):
            assert holds(frames, c, e) == holds(single, c, e)


def test_without_lens():
    east = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # looks along x, horizontally
    cameras = pcfix.Cameras(("a", "b"), np.array([[0.0, -9, 20], [0, 9, 20]]), np.stack([east] * 2))
    result = snell([[30.0, 0, -2], [-30.0, 0, -2]], cameras, 0.0)
    assert result.ray_count.tolist() == [2, 0]
    assert result.outcome.tolist() == [pcfix.Outcome.CORRECTED, pcfix.Outcome.NO_CAMERA]
    far = snell([[3000.0, 0, -2]], cameras, 0.0)  # flatter than 80 degrees
    assert far.outcome.tolist() == [pcfix.Outcome.NO_CAMERA]


def test_views_beside_frames():
    cameras = block(LENSES["barrel"], k=2)
    near, away = np.array([[100.0, 87.5, -2.0]]), np.array([[400.0, 350.0, -2.0]])
    for point in (near, away):
        assert snell(point, cameras, 0.0).outcome[0] == pcfix.Outcome.NO_CAMERA
    views = pcfix.Views(np.array([0, 2]), np.array([0, 1]))
    assert snell(near, cameras, 0.0, views=views).ray_count[0] == 2
    with pytest.warns(pcfix.PcfixWarning):
        found = snell(away, cameras, 0.0, views=views)
    assert found.outcome[0] == pcfix.Outcome.NO_CAMERA
