r"""The refractive collinearity: the image of a point through the water, and its derivatives.

Object point, piercing point and image (Mulsow 2024). The direction w of the light at the projection
centre comes from `pcfix.refract.rays` with its derivatives; in the camera frame it is
x = R w. A rotation changes as exp(omega) R with a small vector omega in the camera frame, for which
d x = omega x x. So an image gradient g with respect to x becomes x x g with respect to omega.

Water of the second order, z = a + b x + c y + d x^2 + e x y + f y^2, refracts at the piercing point
P as its tangent plane does. As anything changes, P moves along the surface and the tangent plane
turns with it; the derivatives are central differences.
"""

from typing import NamedTuple

import numpy as np

from pcfix.adjust.parameters import B1, B2, CX, CY, FOCAL, INDEX, K1, P1, PLANES, PORT, SHAPE
from pcfix.kernels import device
from pcfix.lens import formulas
from pcfix.lens.algebra import (
    Vector,
    beyond,
    column_of,
    cross,
    dot,
    times,
    transposed_times,
    vector,
)
from pcfix.lens.formulas import distorted, plane_and_gradients, undistorted
from pcfix.lens.imaging import image_and_gradients
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.port.housing import BY_PORT, NO_PORT, Window, through_port
from pcfix.refract.rays import direction, lay, light_and_gradients, light_path, plane_at, settle
from pcfix.water.surface import Field, Tin


class State(NamedTuple):
    """What is estimated, relative to the origin of the block."""

    centres: FloatArray  # (k, 3)
    rotations: FloatArray  # (k, 3, 3), world to camera
    lenses: FloatArray  # (l, ...), coefficients of `pcfix.lens.formulas.lens_table`
    xyz: FloatArray  # (m, 3), true points
    # (11 + 3 p,), the parameters of `WATER_NAMES`, then height and two slopes of each of p planes
    water: FloatArray
    port: Window  # the housing port with these, or none


class Given(NamedTuple):
    """What stays fixed during an adjustment."""

    # observations, sorted by point
    start: IntArray  # (m + 1,)
    camera: IntArray  # (o,)
    image_xy: FloatArray  # (o, 2)
    weight: FloatArray  # (o,), 1 / standard deviation; zero for those that do not count
    wet: BoolArray  # (m,), points that may be under water
    lens_row: IntArray  # (k,), of the lens table
    group: IntArray  # (k,), sensor of each camera
    # refracting surface
    tin: Tin | None  # a mesh or a raster, instead of the plane in `State.water`
    field: Field | None
    origin: FloatArray  # (3,), of the block
    curved: bool  # whether d, e, f count
    # unknowns that many points share, counted from the first of them
    first_lens: IntArray  # (groups + 1,), where the parameters of each sensor begin
    code: IntArray  # (first_lens[-1],), which parameters these are
    column: IntArray  # of each number of `State.water`; -1 if fixed; parallel planes share theirs
    shared: int  # how many there are
    # prior knowledge of points
    surveyed_xyz: FloatArray  # (m, 3)
    surveyed_weight: FloatArray  # (m, 3), inverse variances; zero for points that are not surveyed
    on: IntArray  # (m,): 0 water, 1, 2, ... planes, -1 none; empty if no point is on a surface
    on_weight: FloatArray  # (m,), 1 / standard deviation of the distance from the surface
    axis: IntArray  # of each surface, along which it has its height: 2 is up
    # (t, 2, 9 + g), columns to which the residuals of the first t observations are orthogonal (see
    # `pcfix.adjust.from_cloud`); t = 0 in least squares, whose own Jacobian has that role
    tests: FloatArray


POINT, SURFACE, SHARED = 6, 9, 9
# Columns of the derivatives of an image: omega and C, Q from `POINT` on, and from `SURFACE` on
# those of `pcfix.adjust.parameters.WATER_NAMES`. In a row of the equations the shared unknowns
# follow instead, from `SHARED` on.
WIDTH = SURFACE + PLANES


class Workspace(NamedTuple):
    """Arrays that one thread reuses for all points; g unknowns are shared, `most` rows in a point.

    `left` is the same array as `right` in a least squares adjustment.
    """

    # (3, 14), refracted light, its derivatives by Q, C and the first seven of `WATER_NAMES`
    light: FloatArray
    plane: FloatArray  # (4,), at which it is refracted
    ahead: FloatArray  # (3,), the direction that the lens images, camera frame
    behind_port: FloatArray  # (3, 8), that direction behind a port, with its derivatives
    moved: FloatArray  # (7,), other values of the first seven of `WATER_NAMES`
    own: FloatArray  # (2, WIDTH), derivatives of an image
    right: FloatArray  # (most, 2, 9 + g), the weighted rows of a point
    left: FloatArray  # (most, 2, 9 + g), what tests them
    r: FloatArray  # (most, 2), weighted residuals
    row: IntArray  # (most,), which observation each of them is
    v: FloatArray  # (3, 3), normal equations of the point, and
    rhs: FloatArray  # (3,), their right side


def workspace(given: Given) -> Workspace:
    """Return a new workspace."""
    most = int(np.diff(given.start).max(initial=0)) + 1  # one more for a `condition`
    scratch = [np.zeros(shape) for shape in ((3, 14), 4, 3, (3, 8), 7, (2, WIDTH))]
    right = np.zeros((most, 2, SHARED + given.shared))
    left = np.zeros_like(right) if len(given.tests) else right
    r, row, v, rhs = np.zeros((most, 2)), np.zeros(most, np.int64), np.zeros((3, 3)), np.zeros(3)
    return Workspace._make((*scratch, right, left, r, row, v, rhs))


# The water


STEPS, CLOSE_M = 30, 1e-12  # for the piercing point; each leaves curvature x depth of the error


@device
def surface_at(water: FloatArray, given: Given, x: float, y: float) -> Vector:
    """Return height, dz/dx and dz/dy of the water at x, y; NaN where there is none."""
    if given.field is not None or given.tin is not None:
        return plane_at(given.tin, given.field, x, y, given.origin)
    d, e, f = water[SHAPE], water[SHAPE + 1], water[SHAPE + 2]
    z = water[0] + (water[1] + d * x + e * y) * x + (water[2] + f * y) * y
    return z, water[1] + 2.0 * d * x + e * y, water[2] + e * x + 2.0 * f * y


@device
def _set_plane(work: Workspace, water: FloatArray, given: Given, q: Vector, centre: Vector) -> bool:
    """Set the refracting plane (N, h) for light from Q to C; return if Q is below the water."""
    plane = work.plane
    # the first plane is tangent above Q; a plane of water is that already
    z, b, c = surface_at(water, given, q[0], q[1])
    if not z > q[2]:
        return False
    lay(plane, q[0], q[1], z, b, c)
    if given.field is not None or given.tin is not None:
        settle(plane, given.tin, given.field, given.origin, q, centre, water[INDEX])
    for _ in range(STEPS if given.curved else 0):
        # refract at the tangent plane, then move the plane to where the light pierces it
        normal = vector(plane)
        path = light_path(q, centre, normal, plane[3], water[INDEX])
        x, y, z_plane = beyond(centre, path[2], direction(path, normal))
        z, b_there, c_there = surface_at(water, given, x, y)
        # by how much the light moves: height of the plane, and its slope over the path in water
        change = abs(z - z_plane) + abs(path[3]) * (abs(b_there - b) + abs(c_there - c))
        lay(plane, x, y, z, b_there, c_there)
        if not change > CLOSE_M:
            break
        b, c = b_there, c_there
    return True


# Steps of Q, C and a in metres, of b, c and n, and of d, e and f in 1/m: the piercing point is
# known to 1e-12 m, so derivatives are good to 1e-7.
DIFFERENCES = (1e-4,) * 7 + (1e-5,) * 3 + (1e-6,) * 3


@device
def _curved_gradients(
    work: Workspace, water: FloatArray, given: Given, q: Vector, centre: Vector
) -> None:
    """Replace the derivatives of the light through the tangent plane by those of curved water."""
    moved, plane, out = work.moved, work.plane, work.light
    for column in range(13):
        out[:, column + 1] = 0.0
        for sign in (1.0, -1.0):
            # Q in columns 0 to 2, C in 3 to 5, then the water; one of them moves along one axis
            step, by = sign * DIFFERENCES[column], column % 3
            axis = (1.0 if by == 0 else 0.0, 1.0 if by == 1 else 0.0, 1.0 if by == 2 else 0.0)
            q_there = beyond(q, step if column < 3 else 0.0, axis)
            c_there = beyond(centre, step if 3 <= column < 6 else 0.0, axis)
            for i in range(PORT):  # a, b, c, n, d, e, f
                moved[i] = water[i] + (step if column == 6 + i else 0.0)
            _set_plane(work, moved, given, q_there, c_there)
            normal = vector(plane)
            path = light_path(q_there, c_there, normal, plane[3], moved[INDEX])
            light = direction(path, normal)
            for i in range(3):
                out[i, column + 1] += 0.5 * light[i] / step


# Images


@device
def image_and_all_gradients(
    state: State, given: Given, p: int, c: int, work: Workspace, out: FloatArray
) -> tuple[float, float]:
    """Return the image of point p in camera c, NaN if there is none, and fill in its derivatives.

    `out`, shape (2, `WIDTH`), has the derivatives of u and v by omega, C, Q, and a, b, c, n; by
    d, e, f if the water is curved, and by the parameters of a port if there is one.
    """
    q, centre = vector(state.xyz[p]), vector(state.centres[c])
    r, water = state.rotations[c], state.water
    light, plane, ahead = work.light, work.plane, work.ahead
    # the light at the projection centre: refracted under water, straight from land to camera
    if given.wet[p] and _set_plane(work, water, given, q, centre):
        light_and_gradients(q, centre, vector(plane), plane[3], water[INDEX], light)
        if given.curved:
            _curved_gradients(work, water, given, q, centre)
    else:
        light[:] = 0.0
        for i in range(3):
            light[i, 0] = q[i] - centre[i]
            light[i, 1 + i], light[i, 4 + i] = 1.0, -1.0
    # turned into the camera frame, through a port, and imaged by the lens
    x = times(r, column_of(light, 0))
    ahead[0], ahead[1], ahead[2] = x
    behind = work.behind_port
    if state.port.kind != NO_PORT:
        through_port(state.port, water[INDEX], x, behind)
        ahead[0], ahead[1], ahead[2] = column_of(behind, 0)
    u, v, both = image_and_gradients(state.lenses[given.lens_row[c]], ahead[0], ahead[1], ahead[2])
    for row in range(2):
        g = both[3 * row], both[3 * row + 1], both[3 * row + 2]
        by_index = 0.0
        if state.port.kind != NO_PORT:
            # chain rule through the port: its own parameters first, then g by the direction before
            by_index = dot(g, column_of(behind, 4))
            out[row, SURFACE + PORT] = dot(g, column_of(behind, BY_PORT))
            for i in range(3):
                out[row, SURFACE + PORT + 1 + i] = dot(g, column_of(behind, BY_PORT + i))
            g = (
                dot(g, column_of(behind, 1)),
                dot(g, column_of(behind, 2)),
                dot(g, column_of(behind, 3)),
            )
        # g, the gradient by x: x cross g by omega; R'g by the light, then chain rule to Q, C, water
        out[row, 0], out[row, 1], out[row, 2] = cross(x, g)
        w = transposed_times(r, g)
        for i in range(3):
            out[row, POINT + i] = dot(w, column_of(light, 1 + i))
            out[row, 3 + i] = dot(w, column_of(light, 4 + i))
        for i in range(PORT):
            out[row, SURFACE + i] = dot(w, column_of(light, 7 + i))
        out[row, SURFACE + INDEX] += by_index
    return u, v


@device
def lens_gradients(c: FloatArray, ahead: FloatArray, codes: IntArray, out: FloatArray) -> None:
    """Fill in the derivatives of the image of a direction, camera frame, by lens parameters.

    c are the coefficients of the lens, codes, shape (p,), the parameters; `out` has shape (2, p).
    For a lens whose formula goes from the image to the plane (`inverse`), x' solves B(x') = x, so
    that d x' = -J^-1 d B.
    """
    # p in the plane of the projection; Brown's formula takes a, and d is the distorted p
    px, py, _ = plane_and_gradients(c, ahead[0], ahead[1], ahead[2])
    px, py = px - c[formulas.CENTRE_X], py - c[formulas.CENTRE_Y]
    inverse = c[formulas.INVERSE] != 0.0
    if inverse:
        ax, ay = undistorted(c, px, py)
        dx, dy = ax, ay
        _, _, (xx, xy, yx, yy) = distorted(c, ax, ay)
        det = xx * yy - xy * yx
    else:
        ax, ay = px, py
        dx, dy, _ = distorted(c, px, py)
    # u = cx + (f + b1) d_x + b2 d_y, v = cy + f d_y + b3 d_x, with d from the principal axis
    fx, fy, b2, b3 = c[formulas.FOCAL_X], c[formulas.FOCAL_Y], c[formulas.B2], c[formulas.B3]
    for i in range(codes.size):
        code = codes[i]
        if code == FOCAL:
            out[0, i], out[1, i] = dx + c[formulas.CENTRE_X], dy + c[formulas.CENTRE_Y]
        elif code == CX:
            out[0, i], out[1, i] = 1.0, 0.0
        elif code == CY:
            out[0, i], out[1, i] = 0.0, 1.0
        elif code == B1:
            out[0, i], out[1, i] = dx + c[formulas.CENTRE_X], 0.0
        elif code == B2:
            out[0, i], out[1, i] = dy + c[formulas.CENTRE_Y], 0.0
        else:
            bx, by = _brown_gradient(c, ax, ay, code)
            if inverse:
                bx, by = -(yy * bx - xy * by) / det, -(xx * by - yx * bx) / det
            out[0, i], out[1, i] = fx * bx + b2 * by, fy * by + b3 * bx


@device
def _brown_gradient(c: FloatArray, x: float, y: float, code: int) -> tuple[float, float]:
    """Return the derivative of Brown's formula at x, y by one of its parameters."""
    r2 = x * x + y * y
    if code >= K1:
        # radial terms are divided by a polynomial in rational models
        below, power = 1.0, 1.0
        first = formulas.TAIL + int(c[formulas.RADIALS])
        for i in range(int(c[formulas.DENOMINATORS])):
            power *= r2
            below += c[first + i] * power
        power = r2 ** (code - K1 + 1) / below
        return x * power, y * power
    more = 1.0 + (c[formulas.TANGENTIAL + 2] + c[formulas.TANGENTIAL + 3] * r2) * r2
    if code == P1:
        return (r2 + 2.0 * x * x) * more, 2.0 * x * y * more
    return 2.0 * x * y * more, (r2 + 2.0 * y * y) * more


@device
def condition(state: State, given: Given, p: int, work: Workspace, at: int) -> bool:
    """Fill a row of the workspace with the condition of a point on a surface, if it is on one.

    Membership of a surface (Mulsow 2024) is one more observation: the distance from the surface,
    along the axis nearest to its normal, is zero within a standard deviation. The second of the two
    coordinates stays zero.
    """
    if given.on.size == 0 or given.on[p] < 0:
        return False
    row, r = work.right[at], work.r[at]
    q, numbers, number, weight = state.xyz[p], state.water, given.on[p], given.on_weight[p]
    # z = a + b x + c y, where z is along the main axis of the normal, and x and y are the next two
    up = given.axis[number]
    x, y = q[(up + 1) % 3], q[(up + 2) % 3]
    first = 0 if number == 0 else PLANES + 3 * (number - 1)
    if number > 0:
        b, c = numbers[first + 1], numbers[first + 2]
        z = numbers[first] + b * x + c * y
    else:
        z, b, c = surface_at(numbers, given, x, y)
    if np.isnan(z):
        return False
    # like an image: q_z - z is measured as zero; its derivatives are (-b, -c, 1) by the point, and
    # -(1, x, y, x^2, x y, y^2) by the unknowns of the surface
    row[:], r[1] = 0.0, 0.0
    r[0] = weight * (z - q[up])
    row[0, POINT + up] = weight
    row[0, POINT + (up + 1) % 3], row[0, POINT + (up + 2) % 3] = -weight * b, -weight * c
    columns, by = given.column, (1.0, x, y)
    for i in range(3):
        if columns[first + i] >= 0:
            row[0, SHARED + columns[first + i]] -= weight * by[i]
    by = (x * x, x * y, y * y)
    for i in range(3):
        if number == 0 and columns[SHAPE + i] >= 0:
            row[0, SHARED + columns[SHAPE + i]] -= weight * by[i]
    return True
