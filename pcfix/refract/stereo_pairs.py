r"""Find the true point that stereo pairs would have placed, by the median, at the apparent one.

Matchers of the semi-global kind (MicMac, SURE and their like) match two images at a time. Each pair
that shows a point intersects its two straight rays, and the point of the cloud is the median of
these places. Under water every pair is off in its own way, more so the more obliquely it looks.

The model, for an apparent point P and its pairs (a, b), all of which show one true point Q:

1. The light from Q leaves the water towards the camera c, which sees it in the direction w_c
   (`pcfix.refract.rays`).
2. The two straight rays of a pair give the place with the least squared residuals in the two
   images,

       X_ab(Q) = argmin_X  sum_{c = a, b} \|G_c (X - C_c)\|^2

   with G_c the derivative of the image of camera c by position, 2 x 3, px/m, on the ray w_c at the
   distance of X. G_c w_c = 0, so that a residual off the ray is one in the image.
3. The matcher's point is the median of the X_ab in x, y and z one by one.

Q is looked for, where that median is P: three equations for three unknowns. The median of smooth
functions is continuous, with kinks where it goes over from one pair to another. Broyden's method
starts at `snell`'s solution with the derivative diag(1, 1, 1/n), as if all light came from straight
above, and is taken back to half of such a step wherever it does not come nearer.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pcfix.errors import PcfixWarning
from pcfix.lens.formulas import CODES, KIND
from pcfix.lens.imaging import image_and_gradients, lens_table
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome, Views
from pcfix.refract.batch import Batch, Images, Intersection, as_made, images_of
from pcfix.refract.consistent import check_consistent
from pcfix.refract.rays import MIN_DETERMINANT, light_path, line_terms, nearest_point, refracted
from pcfix.threads import one_caller

MAX_STEPS = 40
CLOSE_M = 1e-6
"""How far from P the median may be; Q is then off by two or three times as much."""

_BLOCK = 64
_PERSPECTIVE = CODES["perspective"]
_NO_CAMERA, _ONE_CAMERA = int(Outcome.NO_CAMERA), int(Outcome.ONE_CAMERA)
_PARALLEL, _CORRECTED = int(Outcome.PARALLEL_RAYS), int(Outcome.CORRECTED)

# Columns of the result.
_MISS, _OUTCOME, _FOUND, _WIDTH = 3, 4, 5, 6

# Columns of a ray: e, the height of its water over P, e as the matcher had it, how its scale
# changes (g of `_meet`), and of the image of Q G'G (xx, xy, xz, yy, yz, zz), G'G e, |G e|^2.
_ABOVE, _MADE, _BY_PLACE, _SQUARE, _RIGHT, _RAY_WIDTH = 3, 4, 7, 10, 16, 20


class _Images(NamedTuple):
    """Those of the matcher: rotations, shape (k, 3, 3), the lens of each as a row of `lenses`.

    `both` has them as they were and as they are now; n.
    """

    rotations: FloatArray
    row: IntArray
    lenses: FloatArray
    both: Images
    refractive_index: float


def invert_pairs(batch: Batch, pairs: Views | None = None) -> Intersection:
    """Return the true points from which the median of stereo pairs would be the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its cameras need angles and lenses. Its views are pairs, or the cameras that may be in one.
    pairs : Views, optional
        Of the kind pairs; one is left out where either camera is not among the batch's views.
        Without them the pairs are those of the images that the matcher learned matched, each
        pair once.

    Returns
    -------
    Intersection
        `ray_count` and `incidence_deg` are of the cameras that are in a pair; `ray_miss_m` is the
        distance from their refracted rays through the apparent point, as of `snell`. A point with
        cameras but without a pair is `ONE_CAMERA`, one with narrow pairs only `PARALLEL_RAYS`.

    Raises
    ------
    SettingError
        If the cameras have no angles or no lenses.

    Warns
    -----
    PcfixWarning
        Of points for which no true point was found; they get the solution of `snell`.

    Notes
    -----
    The surface above each point is taken as a plane.
    """
    check_consistent(batch.survey.cameras)
    if batch.rays.kind == "pairs":
        pairs, batch = batch.rays, replace(batch, views=cameras_of_pairs(batch.rays))
    used = np.zeros(len(batch.rays.camera), np.bool_)
    result = _inverted(batch, pairs, used)
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    lost = int((moved & (result[:, _FOUND] == 0.0)).sum())
    if lost:
        warnings.warn(
            f"stereo pairs: no solution for {lost:,} of {int(moved.sum()):,} points; they have that"
            " of snell.",
            PcfixWarning,
            stacklevel=2,
        )
    count = np.concatenate([[0], np.cumsum(used)])
    in_pairs = Views(count[batch.rays.start], np.asarray(batch.rays.camera)[used])
    return replace(batch, views=in_pairs).result(
        result[:, :3], outcome=outcome, ray_miss_m=result[:, _MISS]
    )


def cameras_of_pairs(pairs: Views) -> Views:
    """Return the cameras in each point's pairs, each once, in the order of the list."""
    start = np.zeros(len(pairs.start), np.int64)
    camera = np.asarray(pairs.camera, np.int64)
    distinct = np.empty(len(camera), np.int64)
    _distinct(np.asarray(pairs.start, np.int64), camera, start, distinct)
    return Views(start, distinct[: start[-1]])


@njit(cache=True, error_model="numpy", nogil=True)
def _distinct(start: IntArray, camera: IntArray, first: IntArray, distinct: IntArray) -> None:
    owner = np.full(camera.max() + 1 if camera.size else 0, -1)
    count = 0
    for i in range(len(start) - 1):
        for c in camera[start[i] : start[i + 1]]:
            if owner[c] != i:
                owner[c], distinct[count] = i, c
                count += 1
        first[i + 1] = count


def _inverted(batch: Batch, pairs: Views | None, used: BoolArray) -> FloatArray:
    """Return the rows of the kernel, one per point; mark the entries of the views in a pair."""
    cameras, matcher = batch.survey.cameras, batch.survey.learned.matcher
    if pairs is None and matcher is None:
        raise ValueError("pairs or a model of the matcher are needed")
    made_xyz, made = batch.made_with or (batch.xyz, cameras)
    row, table = lens_table(made.lenses or ())
    rotations = np.ascontiguousarray(made.rotations, np.float64)
    listed = None if pairs is None else (pairs.start, np.asarray(pairs.camera, np.int64))
    result = np.zeros((len(batch.xyz), _WIDTH))
    with one_caller():
        _invert(
            np.ascontiguousarray(batch.xyz),
            np.ascontiguousarray(made_xyz),
            np.ascontiguousarray(batch.surface.height_m),
            batch.normals(),
            np.ascontiguousarray(cameras.centres),
            np.ascontiguousarray(batch.survey.offset_m, np.float64),
            rotations,
            row,
            table,
            images_of(batch.made_with, cameras),
            batch.survey.settings.refractive_index,
            np.asarray(batch.rays.start, np.int64),
            np.asarray(batch.rays.camera, np.int64),
            listed,
            np.zeros((0, 0), np.int64) if matcher is None else matcher.matched,
            used,
            result,
        )
    return result


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _invert(
    xyz: FloatArray, made_xyz: FloatArray, height: FloatArray, normals: FloatArray,
    centres: FloatArray, offset: FloatArray, rotations: FloatArray, row: IntArray,
    lenses: FloatArray, both: Images, n: float, start: IntArray, camera: IntArray,
    listed: tuple[IntArray, IntArray] | None, matched: IntArray, used: BoolArray,
    result: FloatArray,
) -> None:  # fmt: skip
    """Correct every point on its own; a block of them shares the memory for rays and pairs."""
    for block in prange((len(xyz) + _BLOCK - 1) // _BLOCK):
        images = _Images(rotations, row, lenses, both, n)
        first, last = block * _BLOCK, min((block + 1) * _BLOCK, len(xyz))
        most, most_pairs = 0, 0
        for i in range(first, last):
            mine = start[i + 1] - start[i]
            most = max(most, mine)
            room = mine * matched.shape[1]
            if listed is not None:
                room = (listed[0][i + 1] - listed[0][i]) // 2
            most_pairs = max(most_pairs, room)
        rays, place = np.empty((most, _RAY_WIDTH)), np.full(len(centres), -1)
        pairs, places = np.empty((most_pairs, 2), np.int64), np.empty((3, most_pairs))
        for i in range(first, last):
            mine, flags = camera[start[i] : start[i + 1]], used[start[i] : start[i + 1]]
            for j in range(mine.size):
                place[mine[j]] = j
                rays[j, :3] = centres[mine[j]] - xyz[i]
                rays[j, _MADE:_BY_PLACE] = rays[j, :3]
                if len(images.both.centres):
                    rays[j, _MADE:_BY_PLACE] = images.both.centres[mine[j]] - made_xyz[i]
                _scale(rays[j], images, mine[j])
                rays[j, _ABOVE] = normals[i, 2] * (height[i] - xyz[i, 2] + offset[mine[j]])
            if listed is not None:
                entries = listed[1][listed[0][i] : listed[0][i + 1]]
                count = _listed_pairs(pairs, entries, place)
            else:
                count = _matched_pairs(pairs, mine, matched, place)
            for c in mine:
                place[c] = -1
            wide = _wide_pairs(pairs[:count], rays, normals[i])
            if wide == 0:
                few = _ONE_CAMERA if mine.size else _NO_CAMERA
                result[i, _OUTCOME] = _PARALLEL if count else few
                continue
            for p in range(wide):
                flags[pairs[p, 0]], flags[pairs[p, 1]] = True, True
            _solve(result[i], rays, mine, flags, pairs[:wide], places[:, :wide], normals[i], images)


@njit(cache=True, error_model="numpy", nogil=True)
def _scale(ray: FloatArray, images: _Images, c: int) -> None:
    """Write how the distance that the scale of an image goes by changes, in terms of P's.

    In perspective that is the distance along the axis, in other projections that from the centre.
    """
    axis, made, ahead, size2 = images.rotations[c, 2], ray[_MADE:], 0.0, 0.0
    for i in range(3):
        ahead, size2 = ahead - axis[i] * made[i], size2 + made[i] * made[i]
    flat = images.lenses[images.row[c], KIND] == _PERSPECTIVE and ahead > 0.0
    for i in range(3):
        ray[_BY_PLACE + i] = axis[i] / ahead if flat else -made[i] / size2


@njit(cache=True, error_model="numpy", nogil=True)
def _listed_pairs(pairs: IntArray, entries: IntArray, place: IntArray) -> int:
    """Write the pairs of a list whose cameras both have a place; return how many."""
    count = 0
    for p in range(entries.size // 2):
        a, b = place[entries[2 * p]], place[entries[2 * p + 1]]
        if a >= 0 and b >= 0 and a != b:
            pairs[count, 0], pairs[count, 1] = a, b
            count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _matched_pairs(pairs: IntArray, mine: IntArray, matched: IntArray, place: IntArray) -> int:
    """Write the pairs of cameras of which either was matched with the other; return how many."""
    count = 0
    for a in range(mine.size):
        for partner in matched[mine[a]]:
            if partner < 0:
                break
            b = place[partner]
            if b < 0 or (b < a and (matched[partner] == mine[a]).any()):
                continue
            pairs[count, 0], pairs[count, 1] = a, b
            count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _wide_pairs(pairs: IntArray, rays: FloatArray, normal: FloatArray) -> int:
    """Bring the pairs with a base to the front, as seen from P; return how many there are.

    The limit is that of `pcfix.refract.rays.nearest_point` for two rays. Cameras below the water
    or the point have no ray.
    """
    count = 0
    for p in range(len(pairs)):
        a, b = rays[pairs[p, 0]], rays[pairs[p, 1]]
        ax, ay, az, bx, by, bz = a[0], a[1], a[2], b[0], b[1], b[2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        lengths2 = (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz)
        over_a = normal[0] * ax + normal[1] * ay + normal[2] * az
        over_b = normal[0] * bx + normal[1] * by + normal[2] * bz
        above = over_a > max(a[_ABOVE], 0.0) and over_b > max(b[_ABOVE], 0.0)
        if above and x * x + y * y + z * z >= 4.0 * MIN_DETERMINANT * lengths2:
            pairs[count, 0], pairs[count, 1] = pairs[p, 0], pairs[p, 1]
            count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(
    out: FloatArray, rays: FloatArray, mine: IntArray, used: BoolArray, pairs: IntArray,
    places: FloatArray, normal: FloatArray, images: _Images,
) -> None:  # fmt: skip
    """Solve one point and write its row."""
    start = np.empty(3)
    if not _snell(start, rays, used, normal, images.refractive_index):
        out[_OUTCOME] = _PARALLEL
        return
    q = start.copy()
    found = _search(q, rays, mine, used, pairs, places, normal, images)
    out[:3] = q if found else start
    out[_MISS] = _miss(out[:3], rays, used, normal, images.refractive_index)
    out[_OUTCOME], out[_FOUND] = _CORRECTED, 1.0 if found else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _line(
    ray: FloatArray, normal: FloatArray, n: float
) -> tuple[float, float, float, float, float, float, float]:
    """Return where the ray through P enters the water, its direction, length L, and L squared."""
    ex, ey, ez = ray[0], ray[1], ray[2]
    nx, ny, nz = normal[0], normal[1], normal[2]
    length2 = ex * ex + ey * ey + ez * ez
    across = nx * ex + ny * ey + nz * ez
    wet = ray[_ABOVE] > 0.0
    f, bend = (ray[_ABOVE] / across, 1.0 / n) if wet else (0.0, 1.0)
    dx, dy, dz = refracted(ex, ey, ez, length2, nx, ny, nz, across, bend)
    return f * ex, f * ey, f * ez, dx, dy, dz, length2


@njit(cache=True, error_model="numpy", nogil=True)
def _snell(
    q: FloatArray, rays: FloatArray, used: BoolArray, normal: FloatArray, n: float
) -> bool:  # fmt: skip
    """Write the point nearest to the refracted rays; whether there is one."""
    k, sums = 0.0, np.zeros(9)
    for j in range(used.size):
        if used[j]:
            x, y, z, dx, dy, dz, length2 = _line(rays[j], normal, n)
            terms = line_terms(x, y, z, dx, dy, dz, 1.0 / length2)
            k += 1.0
            for i in range(9):
                sums[i] += terms[i]
    s = sums
    solved, q[0], q[1], q[2], _, _ = nearest_point(
        k, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8]
    )
    return solved


@njit(cache=True, error_model="numpy", nogil=True)
def _miss(
    q: FloatArray, rays: FloatArray, used: BoolArray, normal: FloatArray, n: float
) -> float:  # fmt: skip
    """Return the rms distance of Q from the refracted rays through P."""
    k, total = 0.0, 0.0
    for j in range(used.size):
        if used[j]:
            x, y, z, dx, dy, dz, length2 = _line(rays[j], normal, n)
            x, y, z = q[0] - x, q[1] - y, q[2] - z
            along = x * dx + y * dy + z * dz
            total += max(x * x + y * y + z * z - along * along / length2, 0.0)
            k += 1.0
    return np.sqrt(total / k)


@njit(cache=True, error_model="numpy", nogil=True)
def _search(
    q: FloatArray, rays: FloatArray, mine: IntArray, used: BoolArray, pairs: IntArray,
    places: FloatArray, normal: FloatArray, images: _Images,
) -> bool:  # fmt: skip
    """Move Q to where the median F of the pairs' places is P, the origin; whether it was reached.

    From the nearest Q so far goes a step s = -B F. Where F comes nearer, by y, the good Broyden
    update is B + (s - B y) s'B / (s'B y); where it does not, B starts anew, with half the step.
    """
    best, share, step, change = np.inf, 1.0, np.empty(3), np.empty(3)
    nearest, at_nearest, f, inverse = q.copy(), np.zeros(3), np.empty(3), np.empty((3, 3))
    _begin(inverse, share, images.refractive_index)
    for _ in range(MAX_STEPS):
        _median_of_pairs(f, q, rays, mine, used, pairs, places, normal, images)
        size = np.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
        if size <= CLOSE_M:
            return True
        if size < best:
            if best < np.inf:
                for i in range(3):
                    step[i], change[i] = q[i] - nearest[i], f[i] - at_nearest[i]
                _update(inverse, step, change)
            best, nearest[:], at_nearest[:] = size, q, f
        elif best < np.inf:
            share *= 0.5
            _begin(inverse, share, images.refractive_index)
        else:
            return False
        for i in range(3):
            q[i] = nearest[i]
            for j in range(3):
                q[i] -= inverse[i, j] * at_nearest[j]
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def _begin(inverse: FloatArray, share: float, n: float) -> None:
    """Set B to a share of what it is where all light comes from straight above."""
    inverse[:] = 0.0
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = share, share, share * n


@njit(cache=True, error_model="numpy", nogil=True)
def _update(inverse: FloatArray, step: FloatArray, change: FloatArray) -> None:
    """Bring B to where it takes the last change of F for the last step (Broyden)."""
    guess, left = np.zeros(3), np.zeros(3)
    for i in range(3):
        for j in range(3):
            guess[i] += inverse[i, j] * change[j]
            left[j] += step[i] * inverse[i, j]
    scale = left[0] * change[0] + left[1] * change[1] + left[2] * change[2]
    if scale == 0.0:
        return
    for i in range(3):
        for j in range(3):
            inverse[i, j] += (step[i] - guess[i]) * left[j] / scale


@njit(cache=True, error_model="numpy", nogil=True)
def _median_of_pairs(
    f: FloatArray, q: FloatArray, rays: FloatArray, mine: IntArray, used: BoolArray,
    pairs: IntArray, places: FloatArray, normal: FloatArray, images: _Images,
) -> None:  # fmt: skip
    """Write where the pairs would have placed Q; NaN where some camera has no image of it."""
    for j in range(used.size):
        if used[j]:
            _see(rays[j], q, mine[j], normal, images)
    for p in range(len(pairs)):
        _meet(places[:, p], rays[pairs[p, 0]], rays[pairs[p, 1]])
    for axis in range(3):
        f[axis] = np.nan if np.isnan(places[axis]).any() else np.median(places[axis])


@njit(cache=True, error_model="numpy", nogil=True)
def _see(ray: FloatArray, q: FloatArray, c: int, normal: FloatArray, images: _Images) -> None:
    """Write what the image of Q says about places: G'G, G'G e and |G e|^2.

    w, as the matcher had it, is scaled to be as far away as P, so that G is that of there.
    """
    ex, ey, ez = ray[0], ray[1], ray[2]
    nx, ny, nz = normal[0], normal[1], normal[2]
    k, _, _, _, sx, sy, sz = light_path(
        q[0], q[1], q[2], ex, ey, ez, nx, ny, nz, ray[_ABOVE], images.refractive_index
    )
    wx, wy, wz = as_made(images.both, c, k * sx - nx, k * sy - ny, k * sz - nz)
    ex, ey, ez = ray[_MADE], ray[_MADE + 1], ray[_MADE + 2]
    at = _BY_PLACE
    far = 1.0 / (wx * ray[at] + wy * ray[at + 1] + wz * ray[at + 2])
    wx, wy, wz = far * wx, far * wy, far * wz
    r, lens = images.rotations[c], images.lenses[images.row[c]]
    _, _, (ux, uy, uz, vx, vy, vz) = image_and_gradients(
        lens,
        r[0, 0] * wx + r[0, 1] * wy + r[0, 2] * wz,
        r[1, 0] * wx + r[1, 1] * wy + r[1, 2] * wz,
        r[2, 0] * wx + r[2, 1] * wy + r[2, 2] * wz,
    )
    ray[_SQUARE:] = 0.0
    for gx, gy, gz in ((ux, uy, uz), (vx, vy, vz)):
        x = gx * r[0, 0] + gy * r[1, 0] + gz * r[2, 0]
        y = gx * r[0, 1] + gy * r[1, 1] + gz * r[2, 1]
        z = gx * r[0, 2] + gy * r[1, 2] + gz * r[2, 2]
        off = x * ex + y * ey + z * ez
        terms = (x * x, x * y, x * z, y * y, y * z, z * z, off * x, off * y, off * z, off * off)
        for i in range(10):
            ray[_SQUARE + i] += terms[i]


@njit(cache=True, error_model="numpy", nogil=True)
def _meet(place: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Write where two straight rays have the least squared residuals in their images.

    At X the residual of a camera is G (X - e) / t, t = 1 + g.X how far away X is in terms of P. The
    first round takes t as one. The second has it, and that it changes with X: at the least

        sum_c G'G (X - e) / t^2 - r^2 / t^3 g = 0,    r^2 = |G (X - e)|^2

    which tells in narrow pairs of rays that miss each other.
    """
    _solve_two(place, a, b, 1.0, 1.0, 0.0, 0.0)
    t, r2 = _residual(place, a)
    t_b, r2_b = _residual(place, b)
    _solve_two(place, a, b, 1.0 / (t * t), 1.0 / (t_b * t_b), r2 / t**3, r2_b / t_b**3)


@njit(cache=True, error_model="numpy", nogil=True)
def _residual(place: FloatArray, ray: FloatArray) -> tuple[float, float]:
    """Return t and r^2 of a place."""
    x, y, z, s = place[0], place[1], place[2], ray[_SQUARE:]
    t = 1.0 + x * ray[_BY_PLACE] + y * ray[_BY_PLACE + 1] + z * ray[_BY_PLACE + 2]
    twice = x * (s[1] * y + s[2] * z) + s[4] * y * z - (s[6] * x + s[7] * y + s[8] * z)
    return t, s[0] * x * x + s[3] * y * y + s[5] * z * z + 2.0 * twice + s[9]


@njit(cache=True, error_model="numpy", nogil=True)
def _solve_two(
    place: FloatArray, a: FloatArray, b: FloatArray, of_a: float, of_b: float,
    g_a: float, g_b: float,
) -> None:  # fmt: skip
    """Solve the normal equations of two rays by cofactors."""
    at = _SQUARE
    xx, xy = of_a * a[at] + of_b * b[at], of_a * a[at + 1] + of_b * b[at + 1]
    xz, yy = of_a * a[at + 2] + of_b * b[at + 2], of_a * a[at + 3] + of_b * b[at + 3]
    yz, zz = of_a * a[at + 4] + of_b * b[at + 4], of_a * a[at + 5] + of_b * b[at + 5]
    at, by = _RIGHT, _BY_PLACE
    x = of_a * a[at] + of_b * b[at] + g_a * a[by] + g_b * b[by]
    y = of_a * a[at + 1] + of_b * b[at + 1] + g_a * a[by + 1] + g_b * b[by + 1]
    z = of_a * a[at + 2] + of_b * b[at + 2] + g_a * a[by + 2] + g_b * b[by + 2]
    c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c11, c12, c22 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    det = xx * c00 + xy * c01 + xz * c02
    place[0] = (c00 * x + c01 * y + c02 * z) / det
    place[1] = (c01 * x + c11 * y + c12 * z) / det
    place[2] = (c02 * x + c12 * y + c22 * z) / det
