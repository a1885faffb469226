"""A scene of a few points in which every input of a correction can be wrong by a known amount."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.model import Cameras, FloatArray, Lens, Views
from pcfix.options.shared import BudgetOptions
from pcfix.simulate.tracing import project, triangulate
from tests.utils.bed_rays import piercing_points

LENS = Lens(3600.0, 5400.0, 3600.0, 2700.0, 1800.0)
HEIGHT_M = 60.0
INDEX = 1.34


def block(tilt_deg: float) -> Cameras:
    """Return a cross of cameras 60 m above the water that look at its middle, or nearly."""
    if tilt_deg == 0.0:
        places = [(x, y) for x in (-24.0, -8.0, 8.0, 24.0) for y in (-20.0, 0.0, 20.0)]
        rotations = [np.diag([1.0, -1.0, -1.0])] * len(places)
    else:
        back = HEIGHT_M * math.tan(math.radians(tilt_deg))
        places, rotations = [], []
        for heading in np.radians([0.0, 90.0, 180.0, 270.0]):
            for side in (-12.0, 0.0, 12.0):
                ahead = np.array([math.sin(heading), math.cos(heading)])
                right = np.array([ahead[1], -ahead[0]])
                places.append(tuple(side * right - back * ahead))
                off_nadir = math.radians(tilt_deg)
                z = np.array([*(math.sin(off_nadir) * ahead), -math.cos(off_nadir)])
                x = np.array([*right, 0.0])
                rotations.append(np.array([x, np.cross(z, x), z]))
    centres = np.array([(x, y, HEIGHT_M) for x, y in places])
    labels = tuple(map(str, range(len(centres))))
    return Cameras(labels, centres, np.array(rotations), (LENS,) * len(centres))


def views_of(points: int, cameras: Cameras) -> Views:
    """Return views in which every camera sees every point."""
    k = len(cameras)
    return Views(np.arange(points + 1) * k, np.tile(np.arange(k), points))


def apparent(
    bed: FloatArray,
    cameras: Cameras,
    sigma: BudgetOptions,
    rng: np.random.Generator,
    draws: int = 1,
) -> FloatArray:
    """Return what SfM software makes of m points on the bed, shape (draws * m, 3).

    Each draw has errors of its own, and m rows. The software uses `cameras`, and the correction
    later a level surface at 0 and `INDEX`; the light is traced with what is drawn. Waves lean about
    where the light pierces them.
    """
    m, k = len(bed), len(cameras)
    # the rays of one draw after those of the other, each with cameras of its own
    per_ray = np.repeat(np.arange(draws), m * k)
    camera = np.tile(np.tile(np.arange(k), m), draws)
    points = np.tile(np.repeat(bed, k, axis=0), (draws, 1))
    n = (INDEX + sigma.sigma_index * rng.normal(size=draws))[per_ray]
    level = ((sigma.sigma_level or 0.0) * rng.normal(size=draws))[per_ray]
    true = _misplaced(cameras, sigma, rng, draws)
    seen_by = per_ray * k + camera
    centres = true.centres[seen_by]
    up = np.outer(level, [0.0, 0.0, 1.0])
    surface = piercing_points(points - up, centres - up, 0.0, n) + up
    if sigma.sigma_waves:
        # the waves lean about where the light pierces the surface, which hardly moves by that
        waves = math.radians(sigma.sigma_waves) * rng.normal(size=(len(n), 2))
        for _ in range(3):
            surface[:, 2] = level
            surface = through_waves(points, centres, surface, waves, n)
    pixels, _ = project(surface, true, seen_by, LENS)
    pixels += sigma.sigma_image * rng.normal(size=pixels.shape)
    start = np.arange(draws * m + 1) * k
    guess = np.tile(bed * [1, 1, 0.75], (draws, 1))
    return triangulate(pixels, cameras, camera, start, LENS, guess)


def _misplaced(
    cameras: Cameras, sigma: BudgetOptions, rng: np.random.Generator, draws: int
) -> Cameras:
    """Return where the cameras really were, draw after draw."""
    count = draws * len(cameras)
    turn = Rotation.from_rotvec(math.radians(sigma.sigma_attitude) * rng.normal(size=(count, 3)))
    return Cameras(
        tuple(map(str, range(count))),
        np.tile(cameras.centres, (draws, 1)) + sigma.sigma_centre * rng.normal(size=(count, 3)),
        turn.as_matrix() @ np.tile(cameras.rotations, (draws, 1, 1)),
        cameras.lenses * draws,
    )


def through_waves(
    points: FloatArray, centres: FloatArray, about: FloatArray, slope: FloatArray, n: FloatArray
) -> FloatArray:
    """Return where light pierces planes of the given slopes (m, 2) through `about`.

    Turned so that the plane is upright, with camera and point, it is a level surface.
    """
    # the turn that makes the normal (-b, -c, 1) upright
    axis = np.column_stack([-slope[:, 1], slope[:, 0], np.zeros(len(slope))])
    steep = np.hypot(*slope.T)
    scale = np.divide(np.arctan(steep), steep, out=np.ones_like(steep), where=steep > 0.0)
    upright = Rotation.from_rotvec(axis * scale[:, None])
    found = piercing_points(upright.apply(points - about), upright.apply(centres - about), 0.0, n)
    return upright.inv().apply(found) + about
