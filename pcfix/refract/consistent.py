r"""Find the true point from which SfM software would have made the apparent one.

Software that knows nothing of water makes of the image points x_i of a true point Q the point P
with the least squared residuals in the images, over straight rays:

    F(Q) = argmin_P  sum_i \|x_i(Q) - pi_i(P)\|^2

with pi_i the projection of camera i, distortion included, and x_i(Q) = pi_i(A_i) the image of the
point where the light from Q to that camera leaves the water (`pcfix.refract.rays`). P is known
and Q is looked for, so that nothing need be triangulated: at the least the derivative is zero,

    g(Q) = sum_i J_i' (x_i(Q) - pi_i(P)) = 0,    J_i = d pi_i / d P

three equations for the three unknowns of Q. In `snell` the refracted rays of P are met in space,
with equal weight; here the residuals are those that made P.

At the solution the light w_i comes from where P is seen, but for the residuals, some pixels of
thousands. P is seen in the direction -e_i, and w_i is scaled to one along the normal N, so that

    d x_i / d Q = (N.e_i) J_i d w_i / d Q

is known to about a thousandth. From `snell`'s solution each quasi-Newton step gains about three
digits, and two or three do; Broyden's update of the inverse mends what is missing.
"""

from __future__ import annotations

import warnings

import numpy as np
from numba import njit, prange

from pcfix.errors import PcfixWarning, SettingError
from pcfix.lens.imaging import image_and_gradients, image_of, lens_table
from pcfix.model import Cameras, FloatArray, IntArray, Outcome, WaterMesh, WaterRaster
from pcfix.refract.batch import Batch, Intersection
from pcfix.refract.rays import (
    light_path,
    line_terms,
    nearest_point,
    pierce_mesh,
    pierce_raster,
    refracted,
    settle,
    slope_of_path,
)
from pcfix.threads import one_caller
from pcfix.water.surface import Field, Tin, build_field, build_tin, locate

MAX_STEPS = 30
CLOSE_M = 1e-7
"""What is left of the way to the solution, judged from the last two steps."""

_BLOCK = 64
_NO_CAMERA, _ONE_CAMERA = int(Outcome.NO_CAMERA), int(Outcome.ONE_CAMERA)
_PARALLEL, _CORRECTED = int(Outcome.PARALLEL_RAYS), int(Outcome.CORRECTED)

# Columns of the result.
_MISS, _SIGMA_Z, _COSINE2, _OUTCOME, _FOUND = 3, 4, 5, 6, 7

# Columns of a ray: e, its plane (N, h), the gradients of its image by P, that image, its origin.
_PLANE, _GRADIENTS, _IMAGE, _ORIGIN, _WIDTH = 3, 7, 13, 15, 18


def check_consistent(cameras: Cameras) -> None:
    """Check that the method consistent can be done with cameras.

    Raises
    ------
    SettingError
        If they have no angles or no lenses.
    """
    missing = [
        name
        for name, value in (("angles", cameras.rotations), ("lenses", cameras.lenses))
        if value is None
    ]
    if missing:
        raise SettingError(
            f"method consistent goes through the images, and the cameras have no"
            f" {' and no '.join(missing)}: give cameras with interior and exterior orientation,"
            " or use --method snell."
        )


def consistent(batch: Batch) -> Intersection:
    """Correct points so that straight rays to the true ones' images meet in the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its cameras need angles and lenses. Weights of its views are not used: software
        triangulates with all residuals alike.

    Returns
    -------
    Intersection
        `ray_miss_m` is the distance from the refracted rays of the apparent point, as of `snell`;
        `sigma_z_m` is the scatter of these. A point whose views are all one camera is `ONE_CAMERA`.
        Light bends for a camera whose water stood above the true point; `snell` asks the
        apparent one.

    Raises
    ------
    SettingError
        If the cameras have no angles or no lenses.

    Warns
    -----
    PcfixWarning
        Of points for which no true point was found; they get the solution of `snell`. That
        happens under waves that focus the light.
    """
    check_consistent(batch.survey.cameras)
    result = _solved(batch)
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    lost = int((moved & (result[:, _FOUND] == 0.0)).sum())
    if lost:
        warnings.warn(
            f"method consistent found no solution for {lost:,} of {int(moved.sum()):,} points;"
            " they have that of snell.",
            PcfixWarning,
            stacklevel=2,
        )
    angle = np.degrees(np.arccos(np.sqrt(np.minimum(result[:, _COSINE2], 1.0))))
    return Intersection(
        shift_m=result[:, :3],
        outcome=outcome,
        ray_count=np.where(moved, batch.counts, 0).astype(np.int32),
        ray_miss_m=result[:, _MISS],
        sigma_z_m=result[:, _SIGMA_Z],
        incidence_deg=np.where(moved, angle, 0.0),
        camera_used=batch.camera_used(moved),
    )


def _solved(batch: Batch) -> FloatArray:
    """Return the rows of the kernel, one per point."""
    cameras, water = batch.survey.cameras, batch.survey.water
    row, table = lens_table(cameras.lenses or ())
    result = np.zeros((len(batch.xyz), 8))
    with one_caller():
        _correct(
            np.ascontiguousarray(batch.xyz),
            np.ascontiguousarray(batch.surface.height_m),
            np.ascontiguousarray(batch.surface.slope),
            np.ascontiguousarray(batch.rays.start, np.int64),
            np.ascontiguousarray(batch.rays.camera, np.int64),
            np.ascontiguousarray(cameras.centres),
            np.ascontiguousarray(cameras.rotations, np.float64),
            np.ascontiguousarray(batch.survey.offset_m, np.float64),
            row,
            table,
            batch.survey.settings.refractive_index,
            build_tin(water) if isinstance(water, WaterMesh) else None,
            build_field(water) if isinstance(water, WaterRaster) else None,
            result,
        )
    return result


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _correct(
    xyz: FloatArray, surface: FloatArray, slope: FloatArray, start: IntArray, camera: IntArray,
    centres: FloatArray, rotations: FloatArray, offset: FloatArray,
    row: IntArray, lenses: FloatArray, n: float, tin: Tin | None, field: Field | None,
    result: FloatArray,
) -> None:  # fmt: skip
    """Correct every point on its own; a block of them shares the memory for their rays."""
    for block in prange((len(xyz) + _BLOCK - 1) // _BLOCK):
        first, last = block * _BLOCK, min((block + 1) * _BLOCK, len(xyz))
        most = 0
        for i in range(first, last):
            most = max(most, start[i + 1] - start[i])
        rays, sums = np.empty((most, _WIDTH)), np.empty(10)
        for i in range(first, last):
            mine = camera[start[i] : start[i + 1]]
            out = result[i]
            if not _two_cameras(mine):
                out[_OUTCOME] = _ONE_CAMERA if mine.size else _NO_CAMERA
                continue
            facet = -1 if tin is None else locate(tin, xyz[i, 0], xyz[i, 1])
            sums[:9], sums[9] = 0.0, 1.0
            for j in range(mine.size):
                c = mine[j]
                _begin(
                    rays[j], sums, xyz[i], surface[i], slope[i], centres[c], rotations[c],
                    offset[c], lenses[row[c]], n, tin, field, facet,
                )  # fmt: skip
            _solve(out, rays, sums, mine, rotations, row, lenses, n, tin, field)


@njit(cache=True, error_model="numpy", nogil=True)
def _two_cameras(mine: IntArray) -> bool:
    """Whether a list names two different cameras."""
    return mine.size > 0 and mine.min() != mine.max()


@njit(cache=True, error_model="numpy", nogil=True)
def _begin(
    ray: FloatArray, sums: FloatArray, point: FloatArray, surface: float, slope: FloatArray,
    centre: FloatArray, rotation: FloatArray, offset: float, lens: FloatArray, n: float,
    tin: Tin | None, field: Field | None, facet: int,
) -> None:  # fmt: skip
    """Fill the columns of a ray, and add its refracted line to the sums of `snell`.

    The ray's plane is that of the water where the line from P to the camera pierces it.
    """
    px, py, lowered = point[0], point[1], point[2] - offset
    ex, ey, ez = centre[0] - px, centre[1] - py, centre[2] - point[2]
    nz = 1.0 / np.sqrt(1.0 + slope[0] * slope[0] + slope[1] * slope[1])
    nx, ny, h = -slope[0] * nz, -slope[1] * nz, nz * (surface - lowered)
    height, length2 = nx * ex + ny * ey + nz * ez, ex * ex + ey * ey + ez * ez
    f, bend = 0.0, 1.0
    if h > 0.0:
        f, bend = h / height, 1.0 / n
        if tin is not None:
            f, nx, ny, nz = pierce_mesh(tin, px, py, lowered, ex, ey, ez, facet)
        if field is not None:
            f, nx, ny, nz = pierce_raster(field, px, py, lowered, ex, ey, ez, h, nx, ny, nz)
        height = nx * ex + ny * ey + nz * ez
        h = f * height
    dx, dy, dz = refracted(ex, ey, ez, length2, nx, ny, nz, height, bend)
    terms = line_terms(f * ex, f * ey, f * ez, dx, dy, dz, 1.0 / length2)
    for i in range(9):
        sums[i] += terms[i]
    sums[9] = min(sums[9], height * height / length2)
    ray[0], ray[1], ray[2] = ex, ey, ez
    ray[_PLANE], ray[_PLANE + 1], ray[_PLANE + 2], ray[_PLANE + 3] = nx, ny, nz, h
    ray[_ORIGIN], ray[_ORIGIN + 1], ray[_ORIGIN + 2] = px, py, lowered
    _add_image(ray, rotation, lens)


@njit(cache=True, error_model="numpy", nogil=True)
def _add_image(ray: FloatArray, r: FloatArray, lens: FloatArray) -> None:
    """Fill in where the camera images P, and how that moves with P in the world frame."""
    dx, dy, dz = -ray[0], -ray[1], -ray[2]
    u, v, (ux, uy, uz, vx, vy, vz) = image_and_gradients(
        lens,
        r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz,
        r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz,
        r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz,
    )
    for axis in range(3):
        ray[_GRADIENTS + axis] = ux * r[0, axis] + uy * r[1, axis] + uz * r[2, axis]
        ray[_GRADIENTS + 3 + axis] = vx * r[0, axis] + vy * r[1, axis] + vz * r[2, axis]
    ray[_IMAGE], ray[_IMAGE + 1] = u, v


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(
    out: FloatArray, rays: FloatArray, sums: FloatArray, mine: IntArray, rotations: FloatArray,
    row: IntArray, lenses: FloatArray, n: float, tin: Tin | None, field: Field | None,
) -> None:  # fmt: skip
    """Solve one point and write its row."""
    k, s = float(mine.size), sums
    solved, qx, qy, qz, _, sigma_z = nearest_point(
        k, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8]
    )
    if not solved:
        out[_OUTCOME] = _PARALLEL
        return
    q, g, inverse = np.array([qx, qy, qz]), np.empty(3), np.zeros((3, 3))
    found = _search(q, g, inverse, rays, mine, rotations, row, lenses, n, tin, field)
    if not found:
        q[0], q[1], q[2] = qx, qy, qz
    out[0], out[1], out[2] = q[0], q[1], q[2]
    out[_MISS], out[_SIGMA_Z] = _miss(k, s, q), sigma_z
    out[_COSINE2], out[_OUTCOME], out[_FOUND] = s[9], _CORRECTED, 1.0 if found else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _miss(k: float, s: FloatArray, q: FloatArray) -> float:
    """Return the rms distance of Q from the lines of the sums, Q'MQ - 2 b'Q + s over k."""
    x, y, z = q[0], q[1], q[2]
    along = s[0] * x * x + s[3] * y * y + (k - s[0] - s[3]) * z * z
    along += 2.0 * (s[1] * x * y + s[2] * x * z + s[4] * y * z)
    rest = k * (x * x + y * y + z * z) - along
    rest += s[8] - 2.0 * (s[5] * x + s[6] * y + s[7] * z)
    return np.sqrt(max(rest, 0.0) / k)


@njit(cache=True, error_model="numpy", nogil=True)
def _search(
    q: FloatArray, g: FloatArray, inverse: FloatArray, rays: FloatArray, mine: IntArray,
    rotations: FloatArray, row: IntArray, lenses: FloatArray, n: float,
    tin: Tin | None, field: Field | None,
) -> bool:  # fmt: skip
    """Move Q to where g is zero; whether it was reached.

    After a full step s = -B g the good Broyden update of the inverse B of d g / d Q is
    B + t (s'B) / (s'(s - t)), with t = -B g of the new g.
    """
    sx, sy, sz, before = 0.0, 0.0, 0.0, 0.0
    for step in range(MAX_STEPS):
        _gradient(g, inverse, step == 0, q, rays, mine, rotations, row, lenses, n, tin, field)
        if step == 0 and not _inverted(inverse):
            return False
        tx, ty, tz = _times(inverse, g)
        if step > 0:
            share = 1.0 / (before - (sx * tx + sy * ty + sz * tz))
            for i in range(3):
                along = sx * inverse[0, i] + sy * inverse[1, i] + sz * inverse[2, i]
                inverse[0, i] += share * tx * along
                inverse[1, i] += share * ty * along
                inverse[2, i] += share * tz * along
            tx, ty, tz = share * before * tx, share * before * ty, share * before * tz
        q[0], q[1], q[2] = q[0] + tx, q[1] + ty, q[2] + tz
        size2 = tx * tx + ty * ty + tz * tz
        if not size2 < np.inf:
            return False
        # the steps shrink at least as fast as the last did: what is left is about size^2 / before
        if size2 <= CLOSE_M * max(CLOSE_M, np.sqrt(before)):
            return True
        sx, sy, sz, before = tx, ty, tz, size2
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def _times(inverse: FloatArray, g: FloatArray) -> tuple[float, float, float]:
    """Return -B g."""
    return (
        -(inverse[0, 0] * g[0] + inverse[0, 1] * g[1] + inverse[0, 2] * g[2]),
        -(inverse[1, 0] * g[0] + inverse[1, 1] * g[1] + inverse[1, 2] * g[2]),
        -(inverse[2, 0] * g[0] + inverse[2, 1] * g[1] + inverse[2, 2] * g[2]),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _gradient(
    g: FloatArray, slope: FloatArray, with_slope: bool, q: FloatArray,
    rays: FloatArray, mine: IntArray, rotations: FloatArray, row: IntArray, lenses: FloatArray,
    n: float, tin: Tin | None, field: Field | None,
) -> None:  # fmt: skip
    """Sum up g(Q), and d g / d Q where it is wanted."""
    qx, qy, qz = q[0], q[1], q[2]
    g[:] = 0.0
    for j in range(mine.size):
        ray, r, lens = rays[j], rotations[mine[j]], lenses[row[mine[j]]]
        ex, ey, ez = ray[0], ray[1], ray[2]
        plane = ray[_PLANE:_GRADIENTS]
        if tin is not None or field is not None:
            settle(plane, tin, field, ray[_ORIGIN:], qx, qy, qz, ex, ey, ez, n)
        nx, ny, nz = plane[0], plane[1], plane[2]
        path = light_path(qx, qy, qz, ex, ey, ez, nx, ny, nz, plane[3], n)
        k, sx, sy, sz = path[0], path[4], path[5], path[6]
        wx, wy, wz = k * sx - nx, k * sy - ny, k * sz - nz
        u, v = image_of(
            lens,
            r[0, 0] * wx + r[0, 1] * wy + r[0, 2] * wz,
            r[1, 0] * wx + r[1, 1] * wy + r[1, 2] * wz,
            r[2, 0] * wx + r[2, 1] * wy + r[2, 2] * wz,
        )
        du, dv = u - ray[_IMAGE], v - ray[_IMAGE + 1]
        for i in range(3):
            g[i] += ray[_GRADIENTS + i] * du + ray[_GRADIENTS + 3 + i] * dv
        if with_slope:
            height = nx * ex + ny * ey + nz * ez
            _add_slope(slope, ray, height, k, sx, sy, sz, *slope_of_path(path, nx, ny, nz, n))


@njit(cache=True, error_model="numpy", nogil=True)
def _add_slope(
    slope: FloatArray, ray: FloatArray, height: float, k: float,
    sx: float, sy: float, sz: float, kx: float, ky: float, kz: float,
) -> None:  # fmt: skip
    """Add (N.e) J'J d w / d Q, with d w / d Q = k (I - N N') + s (grad k)'."""
    nx, ny, nz = ray[_PLANE], ray[_PLANE + 1], ray[_PLANE + 2]
    for image in range(2):
        at = _GRADIENTS + 3 * image
        jx, jy, jz = ray[at], ray[at + 1], ray[at + 2]
        along, aside = jx * nx + jy * ny + jz * nz, jx * sx + jy * sy + jz * sz
        dx = height * (k * (jx - along * nx) + aside * kx)
        dy = height * (k * (jy - along * ny) + aside * ky)
        dz = height * (k * (jz - along * nz) + aside * kz)
        for i in range(3):
            slope[i, 0] += ray[at + i] * dx
            slope[i, 1] += ray[at + i] * dy
            slope[i, 2] += ray[at + i] * dz


@njit(cache=True, error_model="numpy", nogil=True)
def _inverted(m: FloatArray) -> bool:
    """Replace a matrix of 3 x 3 by its inverse; whether it has one."""
    a, b, c = m[0, 0], m[0, 1], m[0, 2]
    d, e, f = m[1, 0], m[1, 1], m[1, 2]
    g, h, i = m[2, 0], m[2, 1], m[2, 2]
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if not (det != 0.0 and abs(det) < np.inf):
        return False
    m[0, 0], m[0, 1], m[0, 2] = (e * i - f * h) / det, (c * h - b * i) / det, (b * f - c * e) / det
    m[1, 0], m[1, 1], m[1, 2] = (f * g - d * i) / det, (a * i - c * g) / det, (c * d - a * f) / det
    m[2, 0], m[2, 1], m[2, 2] = (d * h - e * g) / det, (b * g - a * h) / det, (a * e - b * d) / det
    return True
