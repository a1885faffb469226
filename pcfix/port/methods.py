r"""Correct a cloud taken through a housing port: choose cameras, intersect, invert.

The lens gives the direction of an image place; the port refracts that ray at its faces; behind the
outer face it goes straight through the water. The rays of several images meet at the true point.
There is no water surface between camera and point, and the direction of up does not matter.

A dense cloud has no image places, but its points stand for them: software without a port model puts
the point P where straight lines from the projection centres meet best. So the line from a centre C
to P has the direction of the image place, except for the residual of that adjustment. Through a
flat port it is large, a hundred pixels and more if many images of a camera calibrated in air see a
point. So the intersection of the refracted rays is only the start, as in `pcfix.refract.tracks`:
the software reconstructs from the image points x_i of a true point Q the point P with the least
squared residuals in the images, over straight rays. There the derivative by P is zero,

    g(Q) = sum_i J_i' (x_i(Q) - pi_i(P)) = 0,    J_i = d pi_i / d P

with pi_i the projection of camera i: three equations for the three unknowns of Q. Here x_i(Q) is
the image of the direction in which the light of Q comes through the port. Newton's method uses

    d g / d Q = sum_i J_i' L_i,    L_i = d x_i / d Q

from `pcfix.port.housing.through_port`. The covariance of Q is that of an adjustment of the images
through the port,

    Cov Q = H^-1 (sum_i L_i' Cov(x_i) L_i) H^-1,    H = sum_i L_i' L_i

and a column for the refractive index, whose error all rays have in common.

Which images contributed to P matters as much. Without a view list it is a set of images whose
frames hold the image of the true point that they lead to. There may be several such sets; then the
point may be wrong.
"""

from typing import NamedTuple, TypeAlias

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import (
    NO_SQUARES,
    Vector,
    beyond,
    cofactors,
    column_of,
    cross,
    dot,
    minus,
    plus,
    plus_square,
    product,
    row_of,
    scaled,
    times,
    transposed_times,
    vector,
)
from pcfix.lens.formulas import lens_table
from pcfix.lens.imaging import (
    Frames,
    frames_of,
    holds,
    image_and_gradients,
    image_and_slopes,
    no_frames,
)
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Views
from pcfix.options.correct import ScienceOptions
from pcfix.port.housing import (
    Port,
    Window,
    cosine_at_port,
    light_through,
    ray_through,
    through_port,
    window_of,
)
from pcfix.refract.batch import (
    CORRECTED,
    NO_CAMERA,
    ONE_CAMERA,
    PARALLEL,
    Intersection,
    require_orientation,
    warn_of_unsolved,
)
from pcfix.refract.rays import line_terms, nearest_point
from pcfix.refract.tiling import TILE, are_same, corners_of, near_cameras, spatial_order

MAX_STEPS = 30
CLOSE_M = 1e-7  # length of the last step; as each squares the error, the next is below a nanometre
ROUNDS = 6  # a point at the border of an image may alternate in and out; then it stays


class Rig(NamedTuple):
    """The k cameras and the port before each of them, for kernels."""

    centres: FloatArray  # (k, 3), metres, world frame
    rotations: FloatArray  # (k, 3, 3), world to camera
    row: IntArray  # lens of each camera, see `pcfix.lens.formulas.lens_table`
    lenses: FloatArray
    frames: Frames
    window: Window
    n: float  # refractive index of the water
    least_cosine: float  # of the incidence angle in air


class Sigmas(NamedTuple):
    """Standard deviations: of an image place of each camera in the unit of its lens, and others."""

    image: FloatArray
    refractive_index: float
    centre_m: float
    attitude: float  # radians


def correct_through_port(
    xyz: FloatArray,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    views: Views | None = None,
) -> Intersection:
    """Correct points reconstructed with straight rays under water, with their uncertainty.

    Snell's law at each face (Skarlatos & Agrafiotis 2018, eq 10), then the point nearest to all
    rays (eq 11), and from there the point that has the images of the apparent one.

    The apparent points, shape (m, 3), world frame, are all under water. Poses are correct, and all
    cameras have the same port; a lens that absorbed it needs `pcfix adjust` first. Without view
    lists a point has every camera whose frame holds the image of the true point. The incidence
    angle is that in air at the inner face.

    The ray distance is that of the rays through the apparent point; a ray that does not meet the
    port is ignored. Points without a solution get the intersection of these rays, with a warning.
    Covariances are zero if fewer than two rays meet. Raises SettingError without angles or lenses.
    """
    require_orientation(cameras, "A port")
    lenses, none, limit = cameras.lenses or (), np.zeros(0, np.int64), settings.limit_deg
    lists, frames = (none, none), frames_of(cameras)
    if views is not None:
        lists = np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64)
        frames = no_frames(len(cameras))
    rig = Rig(
        np.ascontiguousarray(cameras.centres),
        np.ascontiguousarray(cameras.rotations, np.float64),
        *lens_table(lenses),
        frames,
        window_of(port),
        settings.refractive_index,
        0.0 if limit is None else float(np.cos(np.radians(limit))),
    )
    sigmas = Sigmas(
        settings.sigma_image * np.array([lens.pixel_size for lens in lenses]),
        settings.sigma_index,
        settings.sigma_centre,
        float(np.radians(settings.sigma_attitude)),
    )
    m = len(xyz)
    covariance, converged = np.zeros((m, 6)), np.zeros(m, np.bool_)
    found = Intersection(
        shift_m=np.zeros((m, 3)),
        outcome=np.zeros(m, np.uint8),
        ray_count=np.zeros(m, np.int32),
        ray_miss_m=np.zeros(m),
        sigma_z_m=np.zeros(m),
        incidence_deg=np.zeros(m),
        camera_used=np.zeros(len(cameras), np.bool_),
        covariance_m2=covariance,
    )
    in_tiles(
        _correct, -(-m // TILE), spatial_order(xyz), np.ascontiguousarray(xyz), lists, rig, sigmas,
        found, covariance, converged,
    )  # fmt: skip
    moved = found.outcome == CORRECTED
    warn_of_unsolved("no solution was found behind the port", converged[moved])
    return found


@kernel(allocates=True)
def _correct(
    span: Span, order: IntArray, xyz: FloatArray, lists: tuple[IntArray, IntArray], rig: Rig,
    sigmas: Sigmas, found: Intersection, covariance: FloatArray, converged: BoolArray,
) -> None:  # fmt: skip
    """Correct the points of each tile, by the cameras of their lists or, if empty, in the frame."""
    (start, camera), shifts = lists, found.shift_m
    every = np.arange(len(rig.centres))
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        low, high = corners_of(rows, xyz)
        # cameras that may image a point within `wide` metres of the tile
        wide, near = 0.0, near_cameras(every, rig.frames, rig.centres, low, high)
        for i in rows:
            point = row_of(xyz, i)
            some = camera[start[i] : start[i + 1]] if start.size else near
            chosen = _usable(some, point, rig, False)
            solution = _solve(point, chosen, rig)
            # without a list: the cameras that image the true point, which depends on them
            for _ in range(0 if start.size else ROUNDS):
                shift = solution[1]
                # the straight line to a true point may miss a frame that its refracted light
                # reaches, by at most the shift
                reach = max(abs(shift[0]), abs(shift[1]), abs(shift[2]))
                if reach > wide:
                    wide = 2.0 * reach
                    near = near_cameras(every, rig.frames, rig.centres, low - wide, high + wide)
                imaging = _usable(near, plus(point, shift), rig, True)
                if are_same(imaging, chosen):
                    break
                chosen = imaging
                solution = _solve(point, chosen, rig)
            found.outcome[i], shift, distance, cosine, converged[i] = solution
            if found.outcome[i] == CORRECTED:
                shifts[i, 0], shifts[i, 1], shifts[i, 2] = shift
                _set_covariance(covariance[i], plus(point, shift), chosen, rig, sigmas)
                found.ray_count[i], found.ray_miss_m[i] = chosen.size, distance
                found.sigma_z_m[i] = np.sqrt(covariance[i, 5])
                found.incidence_deg[i] = np.degrees(np.arccos(cosine))
                for c in chosen:
                    found.camera_used[c] = True


@device(allocates=True)
def _usable(candidates: IntArray, point: Vector, rig: Rig, through: bool) -> IntArray:
    """Return the cameras that give a ray, in their order.

    The point is imaged along a straight line, or `through` the port.
    """
    usable, k = np.empty(candidates.size, np.int64), 0
    for c in candidates:
        r, x = rig.rotations[c], minus(point, row_of(rig.centres, c))
        w = times(r, x)
        if through:
            w = light_through(rig.window, rig.n, w)
            x = transposed_times(r, w)
        steep = cosine_at_port(rig.window, w)
        if steep > 0.0 and steep >= rig.least_cosine and holds(rig.frames, c, scaled(-1.0, x)):
            usable[k] = c
            k += 1
    return usable[:k]


@device(allocates=True)
def _solve(point: Vector, chosen: IntArray, rig: Rig) -> tuple[int, Vector, float, float, bool]:
    """Intersect the rays of a point, and search the true point from there.

    Returns outcome, shift, rms distance of the rays (m), least cosine at the port, and success.
    """
    sums, least, k = np.zeros(9), 1.0, 0
    for c in chosen:
        r, away = rig.rotations[c], minus(row_of(rig.centres, c), point)
        d = times(r, scaled(-1.0, away))
        leaves, t = ray_through(rig.window, rig.n, d)
        if np.isnan(leaves[0] + t[0]):
            continue
        # where the ray leaves the port, from the apparent point
        a = plus(transposed_times(r, leaves), away)
        k, terms = k + 1, line_terms(a, transposed_times(r, t), 1.0)
        for i in range(9):
            sums[i] += terms[i]
        least = min(least, cosine_at_port(rig.window, d))
    if k < 2:
        return ONE_CAMERA if k == 1 else NO_CAMERA, (0.0, 0.0, 0.0), 0.0, least, False
    nine = (*vector(sums), *vector(sums, 3), *vector(sums, 6))
    solved, q, distance = nearest_point(float(k), nine)
    if not solved:
        return PARALLEL, (0.0, 0.0, 0.0), 0.0, least, False
    shift, converged = _search(q, point, chosen, rig)
    return CORRECTED, shift, distance, least, converged


# u and v, their gradients by the point in the world frame, and their derivatives by n.
Projected: TypeAlias = tuple[float, float, Vector, Vector, float, float]


@device
def _image_through(a: Vector, rig: Rig, c: int, out: FloatArray) -> Projected:
    """Project the point at C + a through the port of a camera; `out`, shape (3, 5), is for this."""
    r = rig.rotations[c]
    through_port(rig.window, rig.n, times(r, a), out)
    u, v, g = image_and_gradients(rig.lenses[rig.row[c]], *column_of(out, 0))
    x, y, z, by_n = column_of(out, 1), column_of(out, 2), column_of(out, 3), column_of(out, 4)
    gu, gv = g[:3], g[3:]
    by_u = transposed_times(r, (dot(gu, x), dot(gu, y), dot(gu, z)))
    by_v = transposed_times(r, (dot(gv, x), dot(gv, y), dot(gv, z)))
    return u, v, by_u, by_v, dot(gu, by_n), dot(gv, by_n)


@device(allocates=True)
def _search(start: Vector, point: Vector, chosen: IntArray, rig: Rig) -> tuple[Vector, bool]:
    """Return the shift where g is zero, by Newton's method, and True; else the start and False."""
    out, g, slope = np.empty((3, 5)), np.empty(3), np.empty((3, 3))
    q = start
    for _ in range(MAX_STEPS):
        g[:], slope[:] = 0.0, 0.0
        for c in chosen:
            a = minus(point, row_of(rig.centres, c))
            u, v, ju, jv = image_and_slopes(rig.lenses[rig.row[c]], None, rig.rotations[c], a)
            # the image of the true point minus that of the apparent one is the residual of g
            u_true, v_true, lu, lv, _, _ = _image_through(plus(a, q), rig, c, out)
            for k in range(3):
                g[k] += ju[k] * (u_true - u) + jv[k] * (v_true - v)
                for j in range(3):
                    slope[k, j] += ju[k] * lu[j] + jv[k] * lv[j]
        if not (np.isfinite(g).all() and np.linalg.det(slope) != 0.0):
            break
        step = vector(np.asarray(np.linalg.solve(slope, g)))
        q = minus(q, step)
        if dot(step, step) <= CLOSE_M * CLOSE_M:
            return q, True
    return start, False


@device(allocates=True)
def _set_covariance(
    out: FloatArray, point: Vector, chosen: IntArray, rig: Rig, sigmas: Sigmas
) -> None:
    """Write xx, xy, xz, yy, yz, zz of a true point; zeros stay where its rays do not meet.

    If a camera moves, the point moves the other way; if it turns about its centre with its port,
    the point at C + a moves by a x omega, and its image by (L x a).omega.
    """
    light, h, noise, by_n = np.empty((3, 5)), NO_SQUARES, NO_SQUARES, (0.0, 0.0, 0.0)
    for c in chosen:
        a = minus(point, row_of(rig.centres, c))
        _, _, u, v, u_by_n, v_by_n = _image_through(a, rig, c, light)
        h = plus_square(plus_square(h, u), v)
        by_n = beyond(beyond(by_n, u_by_n, u), v_by_n, v)
        # each independent error adds the square of what it does to L' x
        noise = plus_square(noise, scaled(sigmas.image[c], u))
        noise = plus_square(noise, scaled(sigmas.image[c], v))
        u_turned, v_turned = cross(u, a), cross(v, a)
        for axis in range(3):
            moved = beyond(scaled(u[axis], u), v[axis], v)
            turned = beyond(scaled(u_turned[axis], u), v_turned[axis], v)
            noise = plus_square(noise, scaled(sigmas.centre_m, moved))
            noise = plus_square(noise, scaled(sigmas.attitude, turned))
    # the error of the refractive index is common to all images
    noise = plus_square(noise, scaled(sigmas.refractive_index, by_n))
    # H^-1 N H^-1, with the cofactors over the determinant for H^-1
    det, (xx, xy, xz, yy, yz, zz) = cofactors(h)
    if det > 0.0:
        x, y, z = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
        by_x, by_y, by_z = product(noise, x), product(noise, y), product(noise, z)
        out[0], out[1], out[2] = dot(x, by_x), dot(x, by_y), dot(x, by_z)
        out[3], out[4], out[5] = dot(y, by_y), dot(y, by_z), dot(z, by_z)
        out /= det * det
