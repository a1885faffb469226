"""A block under water that is bent: exact images through z = a + b x + c y + d x^2 + e x y + f y^2.

The light takes the least optical path (Fermat): Newton's method on its two derivatives by the place
where it passes the surface. Nothing here is shared with the adjustment, which goes by the
tangent plane and Snell's law.
"""

from dataclasses import replace

import numpy as np

from pcfix.model import FloatArray
from pcfix.simulate.tracing import project
from tests.utils.tie_points import TieScene

STEP_M, NEWTON_STEPS, CONVERGED = 1e-3, 40, 1e-13
LEAST_DEPTH_M = 1e-7


def height(numbers: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of the six numbers a, ..., f at places."""
    a, b, c, d, e, f = numbers
    return a + b * x + c * y + d * x * x + e * x * y + f * y * y


def piercing_points(q: FloatArray, centre: FloatArray, numbers: FloatArray, n: float) -> FloatArray:
    """Return where light from points q, shape (o, 3), passes the water; dry points themselves."""
    wet = height(numbers, q[:, 0], q[:, 1]) > q[:, 2] + LEAST_DEPTH_M
    q_wet, c_wet, (_, b, c, d, e, f) = q[wet], centre[wet], numbers

    def slope(xy: FloatArray) -> FloatArray:
        """Return the derivatives of the optical path by x and y."""
        x, y = xy.T
        p = np.column_stack([x, y, height(numbers, x, y)])
        pull = (p - c_wet) / np.linalg.norm(p - c_wet, axis=1)[:, None]
        pull += n * (p - q_wet) / np.linalg.norm(p - q_wet, axis=1)[:, None]
        by_x, by_y = b + 2.0 * d * x + e * y, c + e * x + 2.0 * f * y
        return np.column_stack([pull[:, 0] + by_x * pull[:, 2], pull[:, 1] + by_y * pull[:, 2]])

    xy = q_wet[:, :2].copy()
    for _ in range(NEWTON_STEPS):
        columns = [
            (slope(xy + STEP_M * direction) - slope(xy - STEP_M * direction)) / (2.0 * STEP_M)
            for direction in np.eye(2)
        ]
        step = np.linalg.solve(np.stack(columns, axis=2), slope(xy)[:, :, None])[:, :, 0]
        xy -= step
        if np.abs(slope(xy)).max(initial=0.0) < CONVERGED:
            break
    surface = q.copy()
    surface[wet] = np.column_stack([xy, height(numbers, *xy.T)])
    return surface


def under_curved_water(data: TieScene, shape: FloatArray, seed: int = 9) -> TieScene:
    """Return a scene whose water is bent by d, e, f about the middle of its cameras."""
    origin = np.round(data.true_cameras.centres.mean(axis=0))
    plane, lens = data.water, data.true_cameras.lenses[0]
    level = plane.a + plane.b * origin[0] + plane.c * origin[1] - origin[2]
    numbers = np.array([level, plane.b, plane.c, *shape])
    cameras = replace(data.true_cameras, centres=data.true_cameras.centres - origin)

    def images(xyz: FloatArray, camera) -> FloatArray:
        centre = cameras.centres[camera]
        through = piercing_points(xyz - origin, centre, numbers, data.refractive_index)
        return project(through, cameras, camera, lens)[0]

    owner = np.repeat(np.arange(len(data.truth)), np.diff(data.views.start))
    control = data.control
    curved = replace(
        data,
        exact_xy=images(data.truth[owner], data.views.camera),
        control_exact_xy=images(data.control_truth[control.point], control.camera),
        is_wet=data.truth[:, 2] < origin[2] + height(numbers, *(data.truth - origin)[:, :2].T),
    )
    return curved.measured(np.random.default_rng(seed))
