r"""Correct a cloud taken through a housing port: choose cameras, intersect, invert.

The inversion finds the true point that straight rays would reconstruct at the apparent one.

As `pcfix.refract.tracks` at a water surface: software without a port model reconstructs from
the image points x_i of a true point Q the point P with the least squared residuals in the images,
over straight rays. There the derivative by P is zero,

    g(Q) = sum_i J_i' (x_i(Q) - pi_i(P)) = 0,    J_i = d pi_i / d P

with pi_i the projection of camera i: three equations for the three unknowns of Q. Here x_i(Q) is
the image of the direction in which the light of Q comes through the port. Newton's method uses

    d g / d Q = sum_i J_i' K_i R_i,    K_i = d x_i / d w  d w / d X

from `pcfix.port.light.through_port`. The covariance of Q is that of an adjustment of the images
through the port,

    Cov Q = H^-1 (sum_i L_i' Cov(x_i) L_i) H^-1,    L_i = K_i R_i,  H = sum_i L_i' L_i

and a column for the refractive index, whose error all rays have in common.
"""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import (
    Vector,
    cross,
    dot,
    minus,
    plus,
    row_of,
    times,
    transposed_times,
    vector,
)
from pcfix.lens.imaging import image_and_gradients, image_in_world
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Outcome, Views
from pcfix.options.correct import ScienceOptions
from pcfix.port.intersection import Rig, intersect_rays, lenses_of, port_views, rig_of, rotations_of
from pcfix.port.light import through_port
from pcfix.port.shapes import Port
from pcfix.refract.batch import Intersection, warn_of_unsolved
from pcfix.refract.intersect import check_consistent
from pcfix.refract.methods import batches, joined
from pcfix.refract.tiling import spatial_order


def correct_through_port(
    xyz: FloatArray,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    views: Views | None = None,
) -> Intersection:
    """Correct points reconstructed with straight rays under water, with their uncertainty.

    As `intersect_through_port`, with `sigma_z_m` and `covariance_m2` of
    `port_covariances`.
    """
    parts, order = [], spatial_order(xyz)
    for rows in batches(order):
        own_views = None if views is None else views.take(rows)
        found, chosen = intersect_through_port(xyz[rows], cameras, port, settings, own_views)
        covariance = port_covariances(xyz[rows] + found.shift_m, chosen, cameras, port, settings)
        covariance[found.outcome != Outcome.CORRECTED] = 0.0
        sigma_z = np.sqrt(covariance[:, 5])
        parts.append(found._replace(covariance_m2=covariance, sigma_z_m=sigma_z))
    return joined(parts, order, len(cameras))


def intersect_through_port(
    xyz: FloatArray,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    views: Views | None = None,
) -> tuple[Intersection, Views]:
    """Correct points reconstructed with straight rays under water.

    Snell's law at each face (Skarlatos & Agrafiotis 2018, eq 10), then the point nearest to all
    rays (eq 11).

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Apparent points, metres, world frame; all of them under water.
    cameras : Cameras
        Correct poses, world frame, and lenses. (If the lens absorbed the port, run `pcfix adjust`
        first.)
    port : Port
        The same for all cameras.
    settings : ScienceOptions
        The incidence angle is that in air at the inner face. With the method consistent the
        residuals of the straight rays are used, with any other they are taken as zero.
    views : Views, optional
        The cameras of each point. Without it, every camera whose frame holds the image of the true
        point (method consistent) or of the apparent one (other methods).

    Returns
    -------
    found : Intersection
        One row per input point. The ray distance is that of the rays through the apparent point.
    chosen : Views
        The cameras that were used.
    """
    chosen = port_views(xyz, cameras, port, settings, views)
    found = _intersect_chosen(xyz, chosen, cameras, port, settings)
    if views is not None or settings.method != "consistent":
        return found, chosen
    for _ in range(ROUNDS):
        seen = port_views(xyz, cameras, port, settings, shift_m=found.shift_m)
        rows = _other_rows(chosen, seen)
        if not rows.size:
            break
        part = _intersect_chosen(xyz[rows], seen.take(rows), cameras, port, settings)
        others = np.setdiff1d(np.arange(len(xyz)), rows)
        order = np.concatenate([others, rows])
        found, chosen = joined([found.take(others), part], order, len(cameras)), seen
    return found, chosen


ROUNDS = 6
"""At the border of an image a point may alternate in and out; after so many rounds it stays."""


def _intersect_chosen(
    xyz: FloatArray, chosen: Views, cameras: Cameras, port: Port, settings: ScienceOptions
) -> Intersection:
    """Intersect the rays through apparent points, shape (m, 3), of known cameras."""
    owner = np.repeat(np.arange(len(xyz)), np.diff(chosen.start))
    ray = xyz[owner] - cameras.centres[chosen.camera]
    looking = np.einsum("oij,oj->oi", rotations_of(cameras)[chosen.camera], ray)
    found = intersect_rays(xyz, looking, chosen, cameras, port, settings)
    if settings.method != "consistent":
        return found
    return consistent_through_port(xyz, chosen, cameras, port, settings, found)


def _other_rows(one: Views, other: Views) -> IntArray:
    """Return the points whose cameras differ between two lists."""
    same = np.diff(one.start) == np.diff(other.start)
    rows = np.flatnonzero(same)
    a, b = one.take(rows), other.take(rows)
    owner = np.repeat(rows, np.diff(a.start))
    same[owner[a.camera != b.camera]] = False
    return np.flatnonzero(~same)


MAX_STEPS = 30
CLOSE_M = 1e-7
"""Length of the last step; as each squares the error, the next is below a nanometre."""


def consistent_through_port(
    xyz: FloatArray,
    views: Views,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    start: Intersection,
) -> Intersection:
    """Return `start` with the shifts of the true points that lead to the apparent points.

    `start`, the solution of `snell`, is the first approximation; the rest is as for
    `intersect_through_port`. Points without a solution keep that of `snell`,
    with a warning. Raises SettingError if the cameras have no angles or no lenses.
    """
    check_consistent(cameras)
    moved = np.flatnonzero(start.outcome == Outcome.CORRECTED)
    shift, found = start.shift_m.copy(), np.zeros(len(moved), np.bool_)
    rows, rig = _rows(views), rig_of(cameras, port, settings)
    of_points = np.ascontiguousarray(xyz), *rows
    in_tiles(_search, len(moved), moved, *of_points, rig, shift, found)
    warn_of_unsolved("method consistent found no solution behind the port", found)
    return start._replace(shift_m=shift)


def port_covariances(
    true_xyz: FloatArray, views: Views, cameras: Cameras, port: Port, settings: ScienceOptions
) -> FloatArray:
    """Return the covariance of points behind a port, true_xyz, shape (m, 3), metres, world frame.

    The standard deviations of images, refractive index, projection centres and attitudes are used.

    Returns
    -------
    array, shape (m, 6)
        xx, xy, xz, yy, yz, zz in metres squared, world frame; zeros if fewer than two rays meet.
        Cameras without a lens have that of a survey drone.
    """
    result = np.zeros((len(true_xyz), 6))
    in_tiles(
        _covariances,
        len(true_xyz),
        np.ascontiguousarray(true_xyz),
        *_rows(views),
        rig_of(cameras, port, settings),
        settings.sigma_image * np.array([lens.pixel_size for lens in lenses_of(cameras)]),
        (settings.sigma_index, settings.sigma_centre, np.radians(settings.sigma_attitude)),
        result,
    )
    return result


def _rows(views: Views) -> tuple[IntArray, IntArray]:
    start = np.ascontiguousarray(views.start, np.int64)
    return start, np.ascontiguousarray(views.camera, np.int64)


@device
def _image_through(a: Vector, rig: Rig, c: int, out: FloatArray, image: FloatArray) -> None:
    """Project the point at C + a through the port of a camera.

    `image`, shape (2, 8), gets u and v, their derivatives by the point in the world frame and in
    the camera frame, and by n.
    """
    r = rig.rotations[c]
    through_port(rig.port, rig.n, *times(r, a), out)
    u, v, g = image_and_gradients(rig.lenses[rig.row[c]], out[0, 0], out[1, 0], out[2, 0])
    image[0, 0], image[1, 0] = u, v
    for axis in range(2):
        gx, gy, gz = g[3 * axis], g[3 * axis + 1], g[3 * axis + 2]
        for j in range(1, 5):
            image[axis, 3 + j] = gx * out[0, j] + gy * out[1, j] + gz * out[2, j]
        x, y, z = transposed_times(r, vector(image[axis], 4))
        image[axis, 1], image[axis, 2], image[axis, 3] = x, y, z


@kernel(allocates=True)
def _search(
    span: Span, moved: IntArray, xyz: FloatArray, start: IntArray, camera: IntArray, rig: Rig,
    shift: FloatArray, found: BoolArray,
) -> None:  # fmt: skip
    """Move each point by Newton's method to where g is zero; if that fails it keeps its shift."""
    out, image, g, slope = np.empty((3, 5)), np.empty((2, 8)), np.empty(3), np.empty((3, 3))
    for m in range(*span):
        i = moved[m]
        point, q = row_of(xyz, i), shift[i].copy()
        for _ in range(MAX_STEPS):
            g[:], slope[:] = 0.0, 0.0
            for c in camera[start[i] : start[i + 1]]:
                a = minus(point, row_of(rig.centres, c))
                u, v, ju, jv = image_in_world(rig.lenses[rig.row[c]], rig.rotations[c], a)
                _image_through(plus(a, vector(q)), rig, c, out, image)
                du, dv = image[0, 0] - u, image[1, 0] - v
                for k in range(3):
                    g[k] += ju[k] * du + jv[k] * dv
                    for j in range(3):
                        slope[k, j] += ju[k] * image[0, 1 + j] + jv[k] * image[1, 1 + j]
            if not (np.isfinite(g).all() and np.linalg.det(slope) != 0.0):
                break
            step = np.linalg.solve(slope, g)
            q -= step
            if np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) <= CLOSE_M:
                shift[i], found[m] = q, True
                break


@kernel(allocates=True)
def _covariances(
    span: Span, xyz: FloatArray, start: IntArray, camera: IntArray, rig: Rig,
    sigma_image: FloatArray, sigmas: tuple[float, float, float], result: FloatArray,
) -> None:  # fmt: skip
    """Sum H, the noise and the column of n over the rays of each point, and solve.

    `sigmas` are those of index, projection centre and attitude.
    """
    for i in range(*span):
        cameras = camera[start[i] : start[i + 1]]
        out, image, w = np.empty((3, 5)), np.empty((2, 8)), np.empty((2, 2))
        h, noise, by_n = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
        for c in cameras:
            ahead = minus(row_of(xyz, i), row_of(rig.centres, c))
            _image_through(ahead, rig, c, out, image)
            seen = times(rig.rotations[c], ahead)
            _image_noise(w, image, seen, sigma_image[c], sigmas[1], sigmas[2])
            for a in range(3):
                ju, jv = image[0, 1 + a], image[1, 1 + a]
                by_n[a] += ju * image[0, 7] + jv * image[1, 7]
                for b in range(3):
                    u, v = image[0, 1 + b], image[1, 1 + b]
                    h[a, b] += ju * u + jv * v
                    noise[a, b] += ju * (w[0, 0] * u + w[0, 1] * v) + jv * (
                        w[1, 0] * u + w[1, 1] * v
                    )
        if cameras.size < 2 or not (np.isfinite(h).all() and np.linalg.det(h) > 0.0):
            continue
        inverse = np.linalg.inv(h)
        column = sigmas[0] * (inverse @ by_n)
        full = inverse @ noise @ inverse
        at = 0
        for a in range(3):
            for b in range(a, 3):
                result[i, at] = full[a, b] + column[a] * column[b]
                at += 1


@device
def _image_noise(
    w: FloatArray, image: FloatArray, seen: Vector, sigma_image: float, sigma_centre: float,
    sigma_attitude: float,
) -> None:  # fmt: skip
    """Write the covariance of one image place: its own, and that of the errors of the pose.

    If a camera moves, the point moves the other way in its frame; if it turns about its centre with
    its port, the point X moves by X x omega.
    """
    for a in range(2):
        for b in range(2):
            g, k = vector(image[a], 4), vector(image[b], 4)
            turning = dot(cross(g, seen), cross(k, seen))
            w[a, b] = sigma_centre**2 * dot(g, k) + sigma_attitude**2 * turning
        w[a, a] += sigma_image**2
