r"""One observation: where the lens images a point through the water, and how that moves.

The refractive collinearity (Mulsow 2024): object point, piercing point, image. The light's
direction w at the projection centre comes from `pcfix.refract.tracing.gradients` with its
derivatives; in the camera frame it is x = R w. The rotation moves as exp(omega) R with a small
vector omega in the camera frame, for which d x = omega x x, so that a gradient g of the image by x
is (x x g) by omega.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from pcfix.adjust.block import B1, B2, CX, CY, FOCAL, K1, P1, Seen, State, Surface
from pcfix.lens import formulas as places
from pcfix.lens.formulas import distorted, jacobian, undistorted
from pcfix.lens.imaging import image_and_gradients, image_of, in_plane
from pcfix.model import FloatArray
from pcfix.port.light import through_port
from pcfix.refract.rays import light_path, plane_at, settle
from pcfix.refract.tracing.gradients import light_and_gradients

POSE, POINT, WATER, WIDTH = 0, 6, 9, 13
"""Columns of the gradients: omega and C, Q, and a, b, c, n."""


class Scratch(NamedTuple):
    """Room for one observation, made once a thread.

    light, plane : shapes (3, 12) and (4,), the light with its derivatives and where it is bent.
    ahead : shape (3,), filled with the direction that the lens images, camera frame.
    """

    light: FloatArray
    plane: FloatArray
    ahead: FloatArray


@njit(cache=True, error_model="numpy", nogil=True)
def scratch() -> Scratch:
    """Return new room."""
    return Scratch(np.empty((3, 12)), np.empty(4), np.empty(3))


_CENTRE_X, _CENTRE_Y, _INVERSE = places.CENTRE_X, places.CENTRE_Y, places.INVERSE
_FOCAL_X, _FOCAL_Y, _B2, _B3 = places.FOCAL_X, places.FOCAL_Y, places.B2, places.B3
_RADIALS, _DENOMINATORS, _TAIL = places.RADIALS, places.DENOMINATORS, places.TAIL
_TANGENTIAL, _IN_TURN = places.TANGENTIAL, places.IN_TURN
_PRINCIPAL_X, _PRINCIPAL_Y = places.PRINCIPAL_X, places.PRINCIPAL_Y


@njit(cache=True, error_model="numpy", nogil=True)
def water_plane(
    plane: FloatArray, water: FloatArray, surface: Surface, q: FloatArray, centre: FloatArray
) -> bool:
    """Set the plane (N, h) at which light from Q to C leaves the water; whether Q is below it."""
    if surface.field is None and surface.tin is None:
        up = 1.0 / np.sqrt(1.0 + water[1] * water[1] + water[2] * water[2])
        plane[0], plane[1], plane[2] = -water[1] * up, -water[2] * up, up
        plane[3] = up * water[0]
        return bool(water[0] + water[1] * q[0] + water[2] * q[1] > q[2])
    origin = surface.origin.copy()
    origin[2] -= water[0]
    z, b, c = plane_at(surface.tin, surface.field, q[0], q[1], origin)
    if not z > q[2]:
        return False
    up = 1.0 / np.sqrt(1.0 + b * b + c * c)
    plane[0], plane[1], plane[2] = -b * up, -c * up, up
    plane[3] = up * (z - b * q[0] - c * q[1])
    settle(
        plane, surface.tin, surface.field, origin,
        q[0], q[1], q[2], centre[0], centre[1], centre[2], water[3],
    )  # fmt: skip
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def image(
    state: State, seen: Seen, surface: Surface, p: int, c: int, room: Scratch
) -> tuple[float, float]:
    """Return where camera c images point p; NaN where it does not."""
    q, centre, r, water = state.xyz[p], state.centres[c], state.rotations[c], state.water
    light, plane = room.light, room.plane
    dx, dy, dz = q[0] - centre[0], q[1] - centre[1], q[2] - centre[2]
    refracted = surface.port.size == 0 and seen.wet[p] and surface.there
    if refracted:
        refracted = water_plane(plane, water, surface, q, centre)
    if refracted:
        nx, ny, nz = plane[0], plane[1], plane[2]
        k, _, _, _, sx, sy, sz = light_path(
            q[0], q[1], q[2], centre[0], centre[1], centre[2], nx, ny, nz, plane[3], water[3]
        )
        dx, dy, dz = k * sx - nx, k * sy - ny, k * sz - nz
    x = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
    y = r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz
    z = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
    if surface.port.size:
        through_port(surface.port, water[3], x, y, z, light)
        x, y, z = light[0, 0], light[1, 0], light[2, 0]
    return image_of(state.lenses[seen.lens_row[c]], x, y, z)


@njit(cache=True, error_model="numpy", nogil=True)
def image_and_all_gradients(
    state: State, seen: Seen, surface: Surface, p: int, c: int, room: Scratch, out: FloatArray
) -> tuple[float, float]:
    """Return where camera c images point p, and fill in how that moves.

    `out`, shape (2, 13), has the derivatives of u and v: by omega, C, Q, and a, b, c, n.
    """
    q, centre, r, water = state.xyz[p], state.centres[c], state.rotations[c], state.water
    light, plane, ahead = room.light, room.plane, room.ahead
    refracted = surface.port.size == 0 and seen.wet[p] and surface.there
    if refracted:
        refracted = water_plane(plane, water, surface, q, centre)
    if refracted:
        light_and_gradients(
            q[0], q[1], q[2], centre[0], centre[1], centre[2],
            plane[0], plane[1], plane[2], plane[3], water[3], light,
        )  # fmt: skip
    else:
        light[:] = 0.0
        for i in range(3):
            light[i, 0] = q[i] - centre[i]
            light[i, 1 + i], light[i, 4 + i] = 1.0, -1.0
    x, y, z = _turned(r, light[0, 0], light[1, 0], light[2, 0])
    ahead[0], ahead[1], ahead[2] = x, y, z
    by_n_port = np.zeros(3)
    if surface.port.size:
        bent = np.empty((3, 5))
        through_port(surface.port, water[3], x, y, z, bent)
        ahead[:] = bent[:, 0]
        by_n_port[:] = bent[:, 4]
    u, v, g = image_and_gradients(state.lenses[seen.lens_row[c]], ahead[0], ahead[1], ahead[2])
    for row in range(2):
        gx, gy, gz = g[3 * row], g[3 * row + 1], g[3 * row + 2]
        along_n = 0.0
        if surface.port.size:
            along_n = gx * by_n_port[0] + gy * by_n_port[1] + gz * by_n_port[2]
            gx, gy, gz = (
                gx * bent[0, 1] + gy * bent[1, 1] + gz * bent[2, 1],
                gx * bent[0, 2] + gy * bent[1, 2] + gz * bent[2, 2],
                gx * bent[0, 3] + gy * bent[1, 3] + gz * bent[2, 3],
            )
        out[row, 0], out[row, 1], out[row, 2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
        wx, wy, wz = (
            gx * r[0, 0] + gy * r[1, 0] + gz * r[2, 0],
            gx * r[0, 1] + gy * r[1, 1] + gz * r[2, 1],
            gx * r[0, 2] + gy * r[1, 2] + gz * r[2, 2],
        )
        for i in range(3):
            out[row, POINT + i] = wx * light[0, 1 + i] + wy * light[1, 1 + i] + wz * light[2, 1 + i]
            out[row, 3 + i] = wx * light[0, 4 + i] + wy * light[1, 4 + i] + wz * light[2, 4 + i]
        for i in range(4):
            out[row, WATER + i] = wx * light[0, 7 + i] + wy * light[1, 7 + i] + wz * light[2, 7 + i]
        out[row, WATER + 3] += along_n
    return u, v


@njit(cache=True, error_model="numpy", nogil=True)
def _turned(r: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def lens_gradients(c: FloatArray, ahead: FloatArray, codes: FloatArray, out: FloatArray) -> None:
    """Fill in how the image of a direction moves with parameters of the lens.

    Parameters
    ----------
    c : array
        Coefficients of the lens.
    ahead : array, shape (3,)
        The direction, camera frame.
    codes : array of int, shape (p,)
        See `pcfix.adjust.block`.
    out : array, shape (2, p)

    Notes
    -----
    Of a lens whose formula goes from the image to the plane (`inverse`), x' solves B(x') = x, so
    that d x' = -J^-1 d B.
    """
    px, py = in_plane(c, ahead[0], ahead[1], ahead[2])
    px, py = px - c[_CENTRE_X], py - c[_CENTRE_Y]
    inverse = c[_INVERSE] != 0.0
    if inverse:
        ax, ay = undistorted(c, px, py)
        dx, dy = ax, ay
        xx, xy, yx, yy = jacobian(c, ax, ay)
        det = xx * yy - xy * yx
    else:
        ax, ay = px, py
        dx, dy = distorted(c, px, py)
    fx, fy, b2, b3 = c[_FOCAL_X], c[_FOCAL_Y], c[_B2], c[_B3]
    for i in range(codes.size):
        code = codes[i]
        if code == FOCAL:
            out[0, i], out[1, i] = dx + c[_CENTRE_X], dy + c[_CENTRE_Y]
        elif code == CX:
            out[0, i], out[1, i] = 1.0, 0.0
        elif code == CY:
            out[0, i], out[1, i] = 0.0, 1.0
        elif code == B1:
            out[0, i], out[1, i] = dx + c[_CENTRE_X], 0.0
        elif code == B2:
            out[0, i], out[1, i] = dy + c[_CENTRE_Y], 0.0
        else:
            bx, by = _brown_gradient(c, ax, ay, code)
            if inverse:
                bx, by = -(yy * bx - xy * by) / det, -(xx * by - yx * bx) / det
            out[0, i], out[1, i] = fx * bx + b2 * by, fy * by + b3 * bx


@njit(cache=True, error_model="numpy", nogil=True)
def _brown_gradient(c: FloatArray, x: float, y: float, code: int) -> tuple[float, float]:
    """Return the derivative of Brown's formula at a place by one of its parameters."""
    r2 = x * x + y * y
    if code >= K1:
        below, power = 1.0, 1.0
        first = _TAIL + int(c[_RADIALS])
        for i in range(int(c[_DENOMINATORS])):
            power *= r2
            below += c[first + i] * power
        power = r2 ** (code - K1 + 1) / below
        return x * power, y * power
    more = 1.0 + (c[_TANGENTIAL + 2] + c[_TANGENTIAL + 3] * r2) * r2
    if code == P1:
        return (r2 + 2.0 * x * x) * more, 2.0 * x * y * more
    return 2.0 * x * y * more, (r2 + 2.0 * y * y) * more
