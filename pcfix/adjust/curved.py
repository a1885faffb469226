r"""Light through a water surface of the second order: z = a + b x + c y + d x^2 + e x y + f y^2.

Where the light leaves the water, at P, the surface is its tangent plane, and light through a plane
is known with its derivatives (`pcfix.refract.tracing.gradients`). As anything moves, P moves along
the surface and the tangent plane turns about P with it. With w the direction of the light at the
projection centre C, H the height of C over the plane, m = (-z_x, -z_y, 1), K the 2 x 2 matrix of
second derivatives and G the 3 x 2 derivatives of w by the slopes of a plane about P:

    dw = L + G K dp,    dp = H E dw + E dC + w_xy dz / (m.w),    E = (I - w m' / (m.w))_xy

L is what dw would be if the plane did not turn, dp how P moves in plan and dz by how much the
surface itself rises at P. Put into one another these are two equations for dp.
"""

from __future__ import annotations

from pcfix.adjust.block import SHAPE
from pcfix.kernels import device
from pcfix.lens.algebra import Vector, beyond, column_of, dot, plus, scaled, vector
from pcfix.model import FloatArray
from pcfix.refract.rays import direction, lay, light_path

STEPS, CLOSE_M = 30, 1e-12
"""To where the light leaves: each step takes curvature times depth of the error of the last."""


@device
def height_of(water: FloatArray, x: float, y: float) -> Vector:
    """Return height, dz/dx and dz/dy of the water at a place."""
    d, e, f = water[SHAPE], water[SHAPE + 1], water[SHAPE + 2]
    z = water[0] + (water[1] + d * x + e * y) * x + (water[2] + f * y) * y
    return z, water[1] + 2.0 * d * x + e * y, water[2] + e * x + 2.0 * f * y


@device
def curved_plane(plane: FloatArray, water: FloatArray, q: Vector, centre: Vector) -> bool:
    """Set the plane (N, h) that touches the water where light from Q to C leaves it.

    Whether Q is below the water at all.
    """
    z, b, c = height_of(water, q[0], q[1])
    if not z > q[2]:
        return False
    lay(plane, q[0], q[1], z, b, c)
    for _ in range(STEPS):
        normal = vector(plane)
        path = light_path(q, centre, normal, plane[3], water[3])
        x, y, z_plane = beyond(centre, path[2], direction(path, normal))
        z, b_there, c_there = height_of(water, x, y)
        change = abs(z - z_plane) + abs(path[3]) * (abs(b_there - b) + abs(c_there - c))
        lay(plane, x, y, z, b_there, c_there)
        if not change > CLOSE_M:
            break
        b, c = b_there, c_there
    return True


@device
def curved_gradients(
    plane: FloatArray, water: FloatArray, centre: Vector, light: FloatArray, shape: FloatArray
) -> None:
    """Make the derivatives of light through the plane those through the water that it touches.

    `light` is as of `light_and_gradients`; filled in is `shape`, (3, 3): by d, e, f.
    """
    w = column_of(light, 0)
    up = dot(vector(plane), centre) - plane[3]
    x, y = centre[0] + up * w[0], centre[1] + up * w[1]
    m = plane[0] / plane[2], plane[1] / plane[2], 1.0
    steep = dot(m, w)
    by_height = column_of(light, 7)
    by_x = beyond(column_of(light, 8), -x, by_height)
    by_y = beyond(column_of(light, 9), -y, by_height)
    for i in range(3):
        shape[i, 0] = x * x * by_height[i] + 2.0 * x * by_x[i]
        shape[i, 1] = x * y * by_height[i] + y * by_x[i] + x * by_y[i]
        shape[i, 2] = y * y * by_height[i] + 2.0 * y * by_y[i]
    d, e, f = water[SHAPE], water[SHAPE + 1], water[SHAPE + 2]
    turn_x = plus(scaled(2.0 * d, by_x), scaled(e, by_y))
    turn_y = plus(scaled(e, by_x), scaled(2.0 * f, by_y))
    along_x = beyond((1.0, 0.0, 0.0), -w[0] / steep, m)
    along_y = beyond((0.0, 1.0, 0.0), -w[1] / steep, m)
    xx, xy = 1.0 - up * dot(along_x, turn_x), -up * dot(along_x, turn_y)
    yx, yy = -up * dot(along_y, turn_x), 1.0 - up * dot(along_y, turn_y)
    det = xx * yy - xy * yx
    for column in range(13):
        block, at = (light, column + 1) if column < 10 else (shape, column - 10)
        plain = column_of(block, at)
        rise = _rise(column, x, y) / steep
        px, py = up * dot(along_x, plain) + w[0] * rise, up * dot(along_y, plain) + w[1] * rise
        if 3 <= column < 6:
            px, py = px + along_x[column - 3], py + along_y[column - 3]
        dx, dy = (yy * px - xy * py) / det, (xx * py - yx * px) / det
        for i in range(3):
            block[i, at] += turn_x[i] * dx + turn_y[i] * dy


@device
def _rise(column: int, x: float, y: float) -> float:
    """Return by how much the water rises at a place with Q, C, a, b, c, n, d, e or f."""
    by = (1.0, x, y, 0.0, x * x, x * y, y * y)
    return 0.0 if column < 6 else by[column - 6]
