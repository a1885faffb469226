"""The derivatives of the light's direction, against differences of a bisection on Snell's law."""

import numpy as np
import pytest

from pcfix.refract.rays import COLUMNS, direction, light_and_gradients, light_path
from tests.utils.compiled import compiled
from tests.utils.tracing_twin import through_plane

light_and_gradients = compiled(light_and_gradients)
direction = compiled(direction)
light_path = compiled(light_path)

STEPS = np.array([3e-3] * 6 + [3e-3, 1e-4, 1e-4, 1e-3])
"""Of Q and C (m), level (m), slopes and n: rounding and what the differences leave out are both
below 1e-9 of a derivative."""


def plane_of(a: float, b: float, c: float) -> tuple[tuple[float, float, float], float]:
    up = 1.0 / np.sqrt(1.0 + b * b + c * c)
    return (-b * up, -c * up, up), a * up


def truth(p: np.ndarray) -> np.ndarray:
    """Return w: the way to the piercing point, -1 long along the normal."""
    q, centre, (a, b, c), n = p[:3], p[3:6], p[6:9], p[9]
    normal, h = plane_of(a, b, c)
    way = through_plane(q, centre, (a, b, c), n) - centre
    return way / (np.dot(normal, centre) - h)


def difference(p: np.ndarray, i: int) -> np.ndarray:
    """Return the derivative of the truth by the i-th of its unknowns, to the fourth order."""
    step = np.zeros(10)
    step[i] = STEPS[i]
    near, far = truth(p + step) - truth(p - step), truth(p + 2 * step) - truth(p - 2 * step)
    return (8.0 * near - far) / (12.0 * STEPS[i])


def scene(seed: int, z_low: float, z_high: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([
        *rng.normal(0.0, 3.0, 2), rng.uniform(z_low, z_high),
        *rng.normal(0.0, 40.0, 2), rng.uniform(25.0, 80.0),
        rng.uniform(-0.5, 0.5), *rng.normal(0.0, 0.1, 2), rng.uniform(1.2, 1.5),
    ])  # fmt: skip


def filled(p: np.ndarray) -> np.ndarray:
    out = np.full((3, COLUMNS), -7.0)
    normal, h = plane_of(*p[6:9])
    light_and_gradients(tuple(p[:3]), tuple(p[3:6]), normal, h, p[9], out)
    return out


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize(("z_low", "z_high"), [(-12.0, -3.0), (3.0, 6.0)])
def test_derivatives(seed, z_low, z_high):
    p = scene(seed, z_low, z_high)
    out = filled(p)
    # two ways to the same number, in doubles
    np.testing.assert_allclose(out[:, 0], truth(p), rtol=0.0, atol=1e-12)
    for i in range(10):
        expected = difference(p, i)
        # relative to the vector; without derivative (n above water) against zero
        allowed = 1e-7 * max(np.abs(expected).max(), 1e-4)
        np.testing.assert_allclose(out[:, 1 + i], expected, rtol=0.0, atol=allowed)
    assert (out[:, 11] == 0.0).all()


def test_straight_below():
    p = np.array([1.0, 2.0, -5.0, 1.0, 2.0, 40.0, 0.3, 0.0, 0.0, 1.34])
    out = filled(p)
    for i in range(10):
        expected = difference(p, i)
        # 1e-8 per metre of 1 / 45 m: what the differences leave out, at right angles to nothing
        np.testing.assert_allclose(out[:, 1 + i], expected, rtol=0.0, atol=1e-8)


def test_continuous_at_water():
    above, below = scene(3, -5.0, -4.0), scene(3, -5.0, -4.0)
    level = above[6] + above[7] * above[0] + above[8] * above[1]
    above[2], below[2] = level + 1e-9, level - 1e-9
    # over 2 nm the direction of a camera 25 m away moves by 1e-10
    np.testing.assert_allclose(filled(above)[:, 0], filled(below)[:, 0], rtol=0.0, atol=1e-9)


def test_as_light_path():
    p = scene(5, -9.0, -4.0)
    normal, h = plane_of(*p[6:9])
    way = direction(light_path(tuple(p[:3]), tuple(p[3:6]), normal, h, p[9]), normal)
    # the same arithmetic
    np.testing.assert_allclose(filled(p)[:, 0], way, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("camera_z", [-1.0, 0.0])
def test_camera_in_water(camera_z):
    p = np.array([0.0, 0.0, -5.0, 3.0, 0.0, camera_z, 0.0, 0.0, 0.0, 1.34])
    assert np.isnan(filled(p)).all()
