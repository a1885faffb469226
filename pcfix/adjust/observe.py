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

from pcfix.adjust.block import (
    B1,
    B2,
    CX,
    CY,
    FOCAL,
    K1,
    P1,
    PLANES,
    PORT,
    SHAPE,
    Seen,
    State,
    Surface,
)  # fmt: skip
from pcfix.adjust.curved import curved_gradients, curved_plane
from pcfix.kernels import device, kernel
from pcfix.lens import formulas as places
from pcfix.lens.algebra import (
    column_of,
    cross,
    dot,
    minus,
    normal_of,
    times,
    transposed_times,
    vector,
)
from pcfix.lens.formulas import distorted, jacobian, undistorted
from pcfix.lens.imaging import image_and_gradients, image_of, in_plane
from pcfix.model import FloatArray, IntArray
from pcfix.port.light import BY_PORT, FLAT, KIND, SIZE, X, through_port
from pcfix.refract.rays import direction, lay, light_path, plane_at, settle
from pcfix.refract.tracing.gradients import light_and_gradients

POSE, POINT, WATER = 0, 6, 9
WIDTH = WATER + PLANES
"""Columns of the gradients: omega and C, Q, and the numbers of `pcfix.adjust.block.WATER_NAMES`."""


class Scratch(NamedTuple):
    """Room for one observation, made once a thread.

    light, plane : shapes (3, 12) and (4,), the light with its derivatives and where it is bent.
    ahead : shape (3,), filled with the direction that the lens images, camera frame.
    bent : shape (3, 8), that direction behind a port, with its derivatives.
    origin : shape (3,), the block's origin, from the level of the water.
    by_shape : shape (3, 3), the derivatives of the light by d, e, f.
    port : shape (7,), the port as it is now.
    """

    light: FloatArray
    plane: FloatArray
    ahead: FloatArray
    bent: FloatArray
    origin: FloatArray
    by_shape: FloatArray
    port: FloatArray


@kernel(allocates=True)
def scratch() -> Scratch:
    """Return new room."""
    return Scratch(
        np.empty((3, 12)), np.empty(4), np.empty(3), np.empty((3, 8)), np.empty(3),
        np.empty((3, 3)), np.empty(7),
    )  # fmt: skip


_CENTRE_X, _CENTRE_Y, _INVERSE = places.CENTRE_X, places.CENTRE_Y, places.INVERSE
_FOCAL_X, _FOCAL_Y, _B2, _B3 = places.FOCAL_X, places.FOCAL_Y, places.B2, places.B3
_RADIALS, _DENOMINATORS, _TAIL = places.RADIALS, places.DENOMINATORS, places.TAIL
_TANGENTIAL, _IN_TURN = places.TANGENTIAL, places.IN_TURN
_PRINCIPAL_X, _PRINCIPAL_Y = places.PRINCIPAL_X, places.PRINCIPAL_Y


@device
def water_plane(
    room: Scratch, water: FloatArray, surface: Surface, q: FloatArray, centre: FloatArray
) -> bool:
    """Set the room's plane (N, h), where light from Q to C leaves the water; is Q below it."""
    plane, origin = room.plane, room.origin
    if surface.field is None and surface.tin is None:
        if surface.curved:
            return curved_plane(plane, water, vector(q), vector(centre))
        plane[0], plane[1], plane[2] = normal_of(water[1], water[2])
        plane[3] = plane[2] * water[0]
        return bool(water[0] + water[1] * q[0] + water[2] * q[1] > q[2])
    origin[0], origin[1], origin[2] = vector(surface.origin)
    origin[2] -= water[0]
    z, b, c = plane_at(surface.tin, surface.field, q[0], q[1], origin)
    if not z > q[2]:
        return False
    lay(plane, q[0], q[1], z, b, c)
    settle(plane, surface.tin, surface.field, origin, vector(q), vector(centre), water[3])
    return True


@device
def set_port(port: FloatArray, water: FloatArray, surface: Surface) -> None:
    """Set the port, with the distance or the centre that is estimated."""
    for i in range(port.size):
        port[i] = surface.port[i]
    if port[KIND] == FLAT:
        port[SIZE] = water[PORT]
    else:
        for i in range(3):
            port[X + i] = water[PORT + 1 + i]


@device
def image(
    state: State, seen: Seen, surface: Surface, p: int, c: int, room: Scratch
) -> tuple[float, float]:
    """Return where camera c images point p; NaN where it does not."""
    q, centre, r, water = state.xyz[p], state.centres[c], state.rotations[c], state.water
    light, plane = room.light, room.plane
    w = minus(vector(q), vector(centre))
    refracted = surface.port.size == 0 and seen.wet[p] and surface.there
    if refracted:
        refracted = water_plane(room, water, surface, q, centre)
    if refracted:
        normal = vector(plane)
        path = light_path(vector(q), vector(centre), normal, plane[3], water[3])
        w = direction(path, normal)
    x = times(r, w)
    if surface.port.size:
        set_port(room.port, water, surface)
        through_port(room.port, water[3], *x, light)
        x = column_of(light, 0)
    return image_of(state.lenses[seen.lens_row[c]], *x)


@device
def image_and_all_gradients(
    state: State, seen: Seen, surface: Surface, p: int, c: int, room: Scratch, out: FloatArray
) -> tuple[float, float]:
    """Return where camera c images point p, and fill in how that moves.

    `out`, shape (2, `WIDTH`), has the derivatives of u and v: by omega, C, Q, and a, b, c, n; by
    d, e, f where the water is curved, and by the numbers of a port where there is one.
    """
    q, centre, r, water = state.xyz[p], state.centres[c], state.rotations[c], state.water
    light, plane, ahead = room.light, room.plane, room.ahead
    refracted = surface.port.size == 0 and seen.wet[p] and surface.there
    if refracted:
        refracted = water_plane(room, water, surface, q, centre)
    if refracted:
        light_and_gradients(vector(q), vector(centre), vector(plane), plane[3], water[3], light)
        if surface.curved:
            curved_gradients(plane, water, vector(centre), light, room.by_shape)
    else:
        light[:], room.by_shape[:] = 0.0, 0.0
        for i in range(3):
            light[i, 0] = q[i] - centre[i]
            light[i, 1 + i], light[i, 4 + i] = 1.0, -1.0
    x = times(r, column_of(light, 0))
    ahead[0], ahead[1], ahead[2] = x
    bent = room.bent
    if surface.port.size:
        set_port(room.port, water, surface)
        through_port(room.port, water[3], *x, bent)
        ahead[0], ahead[1], ahead[2] = column_of(bent, 0)
    u, v, both = image_and_gradients(state.lenses[seen.lens_row[c]], ahead[0], ahead[1], ahead[2])
    for row in range(2):
        g = both[3 * row], both[3 * row + 1], both[3 * row + 2]
        along_n = 0.0
        if surface.port.size:
            along_n = dot(g, column_of(bent, 4))
            out[row, WATER + PORT] = dot(g, column_of(bent, BY_PORT))
            for i in range(3):
                out[row, WATER + PORT + 1 + i] = dot(g, column_of(bent, BY_PORT + i))
            g = dot(g, column_of(bent, 1)), dot(g, column_of(bent, 2)), dot(g, column_of(bent, 3))
        out[row, 0], out[row, 1], out[row, 2] = cross(x, g)
        w = transposed_times(r, g)
        for i in range(3):
            out[row, POINT + i] = dot(w, column_of(light, 1 + i))
            out[row, 3 + i] = dot(w, column_of(light, 4 + i))
        for i in range(4):
            out[row, WATER + i] = dot(w, column_of(light, 7 + i))
        out[row, WATER + 3] += along_n
        if surface.curved:
            for i in range(3):
                out[row, WATER + SHAPE + i] = dot(w, column_of(room.by_shape, i))
    return u, v


@device
def lens_gradients(c: FloatArray, ahead: FloatArray, codes: IntArray, out: FloatArray) -> None:
    """Fill in how the image of a direction, camera frame, moves with parameters of the lens.

    The coefficients c are those of the lens, the codes, shape (p,), of `pcfix.adjust.block`; `out`
    has shape (2, p).

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


@device
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
