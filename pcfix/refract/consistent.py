r"""Find the true point from which SfM software would have made the apparent one.

Software that ignores water intersects straight rays: from the image points x_i of a true point Q it
computes the point P with the least squared residuals in the images,

    F(Q) = argmin_P  sum_i \|x_i(Q) - pi_i(P)\|^2

with pi_i the projection of camera i, distortion included, and x_i(Q) = pi_i(A_i) the image of the
point where the light from Q to that camera leaves the water (`pcfix.refract.rays`). P is known
and Q is unknown, so that nothing is triangulated: at the minimum the derivative is zero,

    g(Q) = sum_i J_i' (x_i(Q) - pi_i(P)) = 0,    J_i = d pi_i / d P

three equations for the three unknowns of Q. `snell` intersects the refracted rays of P in space,
with equal weights; here the residuals are those that made P.

At the solution the direction w_i of the light is that of P but for the residuals, some pixels of
thousands. P is seen in the direction -e_i, and w_i is scaled to one along the normal N, so that

    d x_i / d Q = (N.e_i) J_i d w_i / d Q

is known to about a thousandth. From `snell`'s solution each quasi-Newton step gains about three
digits, and two or three are enough; Broyden's update corrects the inverse.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel, most_between
from pcfix.lens import algebra
from pcfix.lens.algebra import Nine, Vector, beyond, dot, minus, normal_of, row_of, scaled, vector
from pcfix.lens.imaging import image_in_world, image_of
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Outcome
from pcfix.refract import batch as types
from pcfix.refract import rays as water_rays
from pcfix.refract.batch import Batch, Chosen, Intersection, Optics, optics_of
from pcfix.refract.choice import shapes_of
from pcfix.refract.rays import Path, add_line, direction, light_path, nearest_point
from pcfix.water.surface import Field, Tin, locate

MAX_STEPS = 30
CLOSE_M = 1e-7
"""Estimated distance from the solution, from the last two steps."""


# Columns of the result.
DISTANCE, RAYS, INCIDENCE, OUTCOME, FOUND = 3, 4, 5, 6, 7
COLUMNS = 8

# Columns of a ray: e, its plane (N, h), the gradients of its image by P, that image, its origin.
_PLANE, _GRADIENTS, _IMAGE, _ORIGIN, RAY_WIDTH = 3, 7, 13, 15, 18


def check_consistent(cameras: Cameras) -> None:
    """Raise SettingError if cameras have no angles or no lenses."""
    types.require_orientation(cameras, "Method consistent", "use method snell")


def consistent(batch: Batch) -> Intersection:
    """Find the true points whose images give the apparent points, by straight rays.

    The cameras need angles and lenses. Weights of the views are not used, as software triangulates
    with equal weights. Light is refracted for a camera whose water stood above the true point; for
    `snell` it is the apparent point.

    `ray_miss_m` is the distance from the refracted rays of the apparent point, as for `snell`. A
    point whose views are all one camera is `ONE_CAMERA`. Points without a solution, under waves
    that focus the light, get that of `snell`, with a warning.
    """
    check_consistent(batch.survey.cameras)
    survey, result = batch.survey, np.zeros((len(batch), COLUMNS))
    optics, shapes = optics_of(survey.cameras), shapes_of(survey)
    in_tiles(_correct, len(batch), batch.chosen(), optics, *shapes, result, points=len(batch))
    return intersection_of(result, batch.camera_used(result[:, RAYS] > 0.0))


def intersection_of(result: FloatArray, used: BoolArray) -> Intersection:
    """Return the rows of kernels as a result, and warn of points without a solution."""
    outcome = result[:, OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    types.warn_of_unsolved("method consistent found no solution", result[moved, FOUND] > 0.0)
    return Intersection(
        shift_m=result[:, :3],
        outcome=outcome,
        ray_count=result[:, RAYS].astype(np.int32),
        ray_miss_m=result[:, DISTANCE],
        sigma_z_m=np.zeros(len(result)),
        incidence_deg=result[:, INCIDENCE],
        camera_used=used,
    )


@kernel(allocates=True)
def _correct(
    span: Span, points: Chosen, optics: Optics, tin: Tin | None, fields: Field | None,
    result: FloatArray,
) -> None:  # fmt: skip
    """Correct every point on its own."""
    start = points.start
    room = room_for(most_between(span, start))
    for i in range(*span):
        cameras = points.camera[start[i] : start[i + 1]]
        correct_one(result[i], points, i, cameras, optics, tin, fields, room)


Room: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Temporary arrays of one point: its rays, their sums, g and the inverse of its derivative."""


@device(allocates=True)
def room_for(rays: int) -> Room:
    """Return temporary arrays for a point with at most `rays` rays."""
    return np.empty((rays, RAY_WIDTH)), np.empty(10), np.empty(3), np.empty((3, 3))


@device
def correct_one(
    out: FloatArray, points: Chosen, i: int, cameras: IntArray, optics: Optics,
    tin: Tin | None, fields: Field | None, room: Room,
) -> None:  # fmt: skip
    """Correct one point with some cameras and write its row."""
    rays, sums, g, inverse = room
    one = True  # or none; a list may name a camera several times
    for c in cameras:
        one = one and c == cameras[0]
    if one:
        out[OUTCOME] = types.ONE_CAMERA if cameras.size else types.NO_CAMERA
        return
    # the facet above the point, where piercing starts
    facet = -1 if tin is None else locate(tin, points.xyz[i, 0], points.xyz[i, 1])
    sums[:9], sums[9] = 0.0, 1.0
    for j in range(cameras.size):
        begin(rays[j], sums, points, i, cameras[j], tin, fields, facet)
        add_image(rays[j], optics, cameras[j])
    k = float(cameras.size)
    solved, q, _, _ = nearest_point(k, sums)
    if not solved:
        out[OUTCOME] = types.PARALLEL
        return
    found, q = _search(q, (g, inverse), rays, cameras, optics, points.n, tin, fields)
    write_row(out, q, ray_distance(k, sums, q), k, sums[9])
    out[FOUND] = 1.0 if found else 0.0


@device
def begin(
    ray: FloatArray, sums: FloatArray, points: Chosen, i: int, c: int,
    tin: Tin | None, fields: Field | None, facet: int,
) -> None:  # fmt: skip
    """Fill in the geometry of a ray, and add its refracted line to the sums of `snell`.

    Its plane is that of the water where the line from P to the camera pierces it.
    """
    x, y, z = row_of(points.xyz, i)
    # water that stood higher for this image: lower the point instead
    lowered = x, y, z - points.offset[c]
    e = minus(row_of(points.centres, c), (x, y, z))
    normal = normal_of(points.slope[i, 0], points.slope[i, 1])
    h, height, length2 = normal[2] * (points.height[i] - lowered[2]), dot(normal, e), dot(e, e)
    # a point above its water has a straight ray
    f, bend = 0.0, 1.0
    if h > 0.0:
        bend = 1.0 / points.n
        f, normal = water_rays.pierce_of(c, tin, fields, lowered, e, h, normal, facet)
        height = dot(normal, e)
        h = f * height
    d = water_rays.refracted(e, length2, normal, height, bend)
    add_line(sums, scaled(f, e), d, 1.0 / length2)
    sums[9] = min(sums[9], height * height / length2)
    ray[0], ray[1], ray[2] = e
    ray[_PLANE], ray[_PLANE + 1], ray[_PLANE + 2] = normal
    ray[_PLANE + 3] = h
    ray[_ORIGIN], ray[_ORIGIN + 1], ray[_ORIGIN + 2] = lowered


@device
def add_image(ray: FloatArray, optics: Optics, c: int) -> None:
    """Fill in the image of P and its gradients by P in the world frame."""
    # P is seen in the direction -e
    lens, down = optics.lenses[optics.row[c]], scaled(-1.0, vector(ray))
    u, v, by_u, by_v = image_in_world(lens, optics.rotations[c], down)
    for axis in range(3):
        ray[_GRADIENTS + axis], ray[_GRADIENTS + 3 + axis] = by_u[axis], by_v[axis]
    ray[_IMAGE], ray[_IMAGE + 1] = u, v


@device
def write_row(out: FloatArray, q: Vector, distance: float, k: float, cosine2: float) -> None:
    """Write the row of a point with a solution."""
    out[0], out[1], out[2] = q
    out[DISTANCE], out[RAYS], out[OUTCOME], out[FOUND] = distance, k, types.CORRECTED, 1.0
    out[INCIDENCE] = np.degrees(np.arccos(np.sqrt(min(cosine2, 1.0))))


@device
def ray_distance(k: float, s: FloatArray | Nine, q: Vector) -> float:
    """Return the rms distance of Q from the lines of the sums, Q'MQ - 2 b'Q + s over k."""
    # t t' summed over the rays, with zz from the trace
    x, y, z = q
    along = s[0] * x * x + s[3] * y * y + (k - s[0] - s[3]) * z * z
    along += 2.0 * (s[1] * x * y + s[2] * x * z + s[4] * y * z)
    rest = k * (x * x + y * y + z * z) - along
    rest += s[8] - 2.0 * (s[5] * x + s[6] * y + s[7] * z)
    return np.sqrt(max(rest, 0.0) / k)


@device
def _search(
    start: Vector, room: tuple[FloatArray, FloatArray], rays: FloatArray, cameras: IntArray,
    optics: Optics, n: float, tin: Tin | None, fields: Field | None,
) -> tuple[bool, Vector]:  # fmt: skip
    """Return whether a Q was found where g is zero, and that Q, else the start.

    After a full step s = -B g the good Broyden update of the inverse B of d g / d Q is
    B + t (s'B) / (s'(s - t)), with t = -B g of the new g.
    """
    q, s, before = start, (0.0, 0.0, 0.0), 0.0
    g, inverse = room
    inverse[:] = 0.0
    for step in range(MAX_STEPS):
        g[:] = 0.0
        for j in range(cameras.size):  # the derivative only in the first step
            slope = inverse[: 0 if step else 3]
            add_residual(g, slope, q, rays[j], cameras[j], optics, n, tin, fields)
        if step == 0 and not algebra.inverted(inverse, 0.0):
            return False, start
        # the quasi-Newton step -B g
        t = scaled(-1.0, algebra.times(inverse, vector(g)))
        if step > 0:
            # good Broyden update; the step then follows without another product
            share, along = 1.0 / (before - dot(s, t)), algebra.transposed_times(inverse, s)
            for i in range(3):
                for j in range(3):
                    inverse[i, j] += share * t[i] * along[j]
            t = scaled(share * before, t)
        q, size2 = algebra.plus(q, t), dot(t, t)
        # NaN: some camera has no image of Q
        if not size2 < np.inf:
            return False, start
        # steps shrink at least as fast as the last one did: the rest is about size^2 / before
        if size2 <= CLOSE_M * max(CLOSE_M, np.sqrt(before)):
            return True, q
        s, before = t, size2
    return False, start


@device
def add_residual(
    g: FloatArray, slope: FloatArray, q: Vector, ray: FloatArray, c: int, optics: Optics, n: float,
    tin: Tin | None, fields: Field | None,
) -> None:  # fmt: skip
    """Add the residual of one ray to g(Q), and its part of d g / d Q if `slope` has rows."""
    e, plane = vector(ray), ray[_PLANE:_GRADIENTS]
    # under waves the plane of the ray moves with Q
    if tin is not None or fields is not None:
        water_rays.settle_of(c, plane, tin, fields, ray[_ORIGIN:], q, e, n)
    normal = vector(plane)
    path = light_path(q, e, normal, plane[3], n)
    # the direction of the light in the frame of the camera
    w = algebra.times(optics.rotations[c], direction(path, normal))
    u, v = image_of(optics.lenses[optics.row[c]], *w)
    # the residual in pixels
    du, dv = u - ray[_IMAGE], v - ray[_IMAGE + 1]
    for i in range(3):
        g[i] += ray[_GRADIENTS + i] * du + ray[_GRADIENTS + 3 + i] * dv
    if len(slope):
        _add_slope(slope, ray, path, water_rays.slope_of_path(path, normal, n))


@device
def _add_slope(slope: FloatArray, ray: FloatArray, path: Path, by_q: Vector) -> None:
    """Add (N.e) J'J d w / d Q, with d w / d Q = k (I - N N') + s (grad k)'."""
    k, s, normal = path[0], path[4], vector(ray, _PLANE)
    height = dot(normal, vector(ray))
    for image in range(2):
        at = _GRADIENTS + 3 * image
        j = vector(ray, at)
        # k (I - N N') J + (J.s) grad k
        across = minus(j, scaled(dot(j, normal), normal))
        d = scaled(height, beyond(scaled(k, across), dot(j, s), by_q))
        for i in range(3):
            for axis in range(3):
                slope[i, axis] += j[i] * d[axis]
