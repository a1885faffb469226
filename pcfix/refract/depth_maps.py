r"""Where dense matching puts a point under water, and how to undo exactly that.

A dense cloud is not triangulated from tracks. For one image after the other the matcher finds how
deep each pixel lies along its own ray, so that the images it is compared with agree best: a depth
map. Then each depth is averaged with those of neighbouring maps that see the same place, and the
maps are fused: a point is the weighted mean of the depths of several images, each along its own
ray. Under water these depths differ, as each depends on where the compared images stand.

The model, for an apparent point P, a bed at the height z, level around P, and one image i:

1. The ray from the projection centre i through P bends into the water and meets the bed in Q_i.
2. From Q_i the light goes back to the images j that i was matched with; each sees Q_i in the
   direction a_ij.
3. The depth map has P + t u_i on the ray u_i, where the two images that agree best agree: for
   each pair of j the t with the least squared distances in the images, and of these the mean with
   the weights exp(-squares / `Matcher.tolerance_px2`). PatchMatch scores a depth by its two best
   images; which these are changes from pixel to pixel.

The fused point is P where sum_i W_i t_i u_i = 0 along the vertical: one equation for z. The true
point is the mean of the Q_i with the same weights.

A level bed will do: a slope of it moves the Q_i and the directions a_ij nearly alike.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

from pcfix.lens.frames import Frames, holds
from pcfix.model import FloatArray, IntArray, Outcome
from pcfix.refract.batch import Batch, Images, Intersection, as_made, as_now, images_of
from pcfix.refract.matcher import Matcher
from pcfix.refract.rays import light_path, refracted
from pcfix.threads import one_caller

MAX_LOOKS = 5
CLOSE_M = 0.002
"""Between two looks; what is left is mended in a straight line."""

LEAST_RISE_M = 0.005
AVERAGED_WITHIN = 0.012
"""Depths of neighbouring maps that differ by less, relative, are averaged before the fusion."""

_ROUNDS = 4
_BLOCK = 64
_CORRECTED, _NO_CAMERA = int(Outcome.CORRECTED), int(Outcome.NO_CAMERA)
_ONE_CAMERA = int(Outcome.ONE_CAMERA)
_MISS, AMBIGUITY, OUTCOME, _COUNT = 3, 4, 5, 6
COLUMNS = 7
"""Of what the kernels write: the shift, and these."""


def invert_depth_maps(batch: Batch) -> Intersection:
    """Return the true points from which dense matching would have made the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its views are the images whose depth maps were fused, with their weights;
        `batch.survey.learned.matcher` says how they were matched.

    Returns
    -------
    Intersection

    Notes
    -----
    The surface above each point is taken as a plane.
    """
    weights = batch.rays.weight
    result = np.zeros((len(batch.xyz), COLUMNS))
    with one_caller():
        _invert(
            *arrays_of(batch),
            np.zeros(0) if weights is None else weights.astype(np.float64),
            result,
        )
    return intersection_of(batch, result)


class Sight(NamedTuple):
    """What the k images have of one apparent point, for kernels.

    Attributes
    ----------
    up : array, shape (k, 3)
        From the point to the projection centres, metres, world frame.
    made : array, shape (k, 3)
        The same as the matcher had them, and the point; `up` itself where it is not corrected with
        other cameras.
    above : array, shape (k,)
        Height of the water of each image over the point, along the normal, metres.
    normal : array, shape (3,)
        Of the water, upward.
    n : float
        Refractive index.
    """

    up: FloatArray
    made: FloatArray
    above: FloatArray
    normal: FloatArray
    n: float


@njit(cache=True, error_model="numpy", nogil=True)
def sight_of(
    point: FloatArray, made_point: FloatArray, centres: FloatArray, height: float,
    normal: FloatArray, offset: FloatArray, images: Images, n: float,
) -> Sight:  # fmt: skip
    """Return what the images have of a point, shape (3,), with the water above it."""
    up = centres - point
    made = images.centres - made_point if len(images.centres) else up
    above = normal[2] * (height - point[2] + offset)
    return Sight(up, made, above, normal, n)


def arrays_of(batch: Batch) -> tuple[Any, ...]:
    """Return what the kernels take of a batch."""
    matcher = batch.survey.learned.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    made_xyz = batch.xyz if batch.made_with is None else batch.made_with.xyz
    return (
        np.ascontiguousarray(batch.xyz),
        np.ascontiguousarray(made_xyz),
        np.ascontiguousarray(batch.surface.height_m),
        batch.normals(),
        np.ascontiguousarray(batch.survey.cameras.centres),
        batch.survey.offset_m,
        images_of(batch.made_with, batch.survey.cameras),
        *matcher,
        batch.rays.start,
        np.asarray(batch.rays.camera, np.int64),
        batch.survey.settings.refractive_index,
    )


def intersection_of(batch: Batch, result: FloatArray) -> Intersection:
    """Return the rows that the kernels wrote as a result; its `sigma_z_m` is the ambiguity.

    The rays are those of the depth maps that count, averaged ones included.
    """
    found = batch.result(
        result[:, :3],
        outcome=result[:, OUTCOME].astype(np.uint8),
        ray_miss_m=result[:, _MISS],
    )
    moved = found.outcome == _CORRECTED
    return found._replace(
        sigma_z_m=np.where(moved, result[:, AMBIGUITY], 0.0),
        ray_count=np.where(moved, result[:, _COUNT], 0).astype(np.int32),
    )


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _invert(
    xyz: FloatArray, made_xyz: FloatArray, height: FloatArray, normals: FloatArray,
    centres: FloatArray, offset: FloatArray, images: Images, matched: IntArray,
    averaged: IntArray, fused: IntArray, focal_px: FloatArray, inner: Frames, tolerance: float,
    start: IntArray, camera: IntArray, n: float,
    weight: FloatArray, result: FloatArray,
) -> None:  # fmt: skip
    for block in prange((len(xyz) + _BLOCK - 1) // _BLOCK):
        matcher = Matcher(matched, averaged, fused, focal_px, inner, tolerance)
        place = np.full(len(centres), ABSENT)
        found = np.empty(len(centres), np.int64)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, len(xyz))):
            sight = sight_of(xyz[i], made_xyz[i], centres, height[i], normals[i], offset, images, n)
            listed = camera[start[i] : start[i + 1]]
            given = weight[start[i] : start[i + 1]] if weight.size else weight
            maps = found[: _with_neighbours(found, place, listed, sight.made, matcher)]
            bed, t, slope = lines(maps, sight, images, matcher)
            counts, step = np.zeros(maps.size), 0.0
            for _ in range(_ROUNDS):
                _share(counts, place, listed, given, sight.made, t + slope * step, matcher)
                step = balance(t, slope, counts)
            settle_bed(result[i], maps, counts, t, slope, bed, sight, images, matcher)
            place[maps] = ABSENT
            for c in listed:
                for a in matcher.averaged[c]:
                    if a >= 0:
                        place[a] = ABSENT


ABSENT, _OUTSIDE = -1, -2


@njit(cache=True, error_model="numpy", nogil=True)
def _with_neighbours(
    found: IntArray, place: IntArray, listed: IntArray, made: FloatArray, matcher: Matcher
) -> int:
    """Gather the listed images and those in frame that their depths were averaged with.

    Returns how many they are. `place` says where each image is among them.
    """
    count = 0
    for c in listed:
        if place[c] < 0:
            place[c], found[count] = count, c
            count += 1
        for a in matcher.averaged[c]:
            if a < 0:
                break
            if place[a] == ABSENT:
                place[a] = _OUTSIDE
                if holds(matcher.inner, a, made[a, 0], made[a, 1], made[a, 2]):
                    place[a], found[count] = count, a
                    count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _share(
    counts: FloatArray, place: IntArray, listed: IntArray, given: FloatArray, made: FloatArray,
    now: FloatArray, matcher: Matcher,
) -> None:  # fmt: skip
    """Set what each depth map counts for in the point, with their depths as they are now.

    A fused map counts by its weight, that of the matcher or one by its squared distance, and
    shares it evenly with the maps it was averaged with before.
    """
    counts[:] = 0.0
    for k in range(listed.size):
        c = listed[k]
        w = given[k] if given.size else 1.0 / (made[c] * made[c]).sum()
        own, members = place[c], 1.0
        for a in matcher.averaged[c]:
            members += averages(own, a, now, place)
        counts[own] += w / members
        for a in matcher.averaged[c]:
            if averages(own, a, now, place):
                counts[place[a]] += w / members


@njit(cache=True, error_model="numpy", nogil=True)
def averages(own: int, a: int, now: FloatArray, place: IntArray) -> bool:
    """Whether a depth is averaged with that of image a: both show the place, nearly alike."""
    if a < 0 or place[a] < 0:
        return False
    return bool(abs(now[place[a]] - now[own]) < AVERAGED_WITHIN)


@njit(cache=True, error_model="numpy", nogil=True)
def lines(
    maps: IntArray, sight: Sight, images: Images, matcher: Matcher
) -> tuple[float, FloatArray, FloatArray]:
    """Return how the depth of each map changes with the height of the bed, nearly in a line.

    Returns
    -------
    bed : float
        A likely height of the bed, relative to the apparent point, metres.
    t, slope : array, shape (maps,)
        How far beyond the apparent point the map has that bed, relative to the distance from the
        camera, and the change of it with the height, 1/m. NaN where it has none.
    """
    deep = -sight.above.mean() / sight.normal[2] * (sight.n - 1.0)
    bed, rise = 1.1 * deep, min(0.1 * deep, -LEAST_RISE_M)
    t, slope = np.empty(maps.size), np.empty(maps.size)
    out, work = np.empty(5), np.empty((matcher.matched.shape[1], 3))
    for q in range(maps.size):
        _look(out, maps[q], bed, sight, images, matcher, work)
        t[q] = out[0]
        _look(out, maps[q], bed + rise, sight, images, matcher, work)
        slope[q] = (out[0] - t[q]) / rise
        usual = 1.0 / (sight.n * sight.made[maps[q], 2])
        if slope[q] == slope[q] and not 0.5 < -slope[q] / usual < 2.0:
            slope[q] = -usual  # another pair of images was the best one there
    return bed, t, slope


@njit(cache=True, error_model="numpy", nogil=True)
def balance(t: FloatArray, slope: FloatArray, weight: FloatArray) -> float:
    """Return how far up the bed must go so that the weighted mean of the depths is zero."""
    total, change = 0.0, 0.0
    for q in range(t.size):
        if weight[q] > 0.0 and slope[q] == slope[q]:
            total, change = total + weight[q] * t[q], change + weight[q] * slope[q]
    return -total / change


@njit(cache=True, error_model="numpy", nogil=True)
def settle_bed(
    row: FloatArray, maps: IntArray, weight: FloatArray, t: FloatArray, slope: FloatArray,
    bed: float, sight: Sight, images: Images, matcher: Matcher,
) -> None:  # fmt: skip
    """Find the height of the bed at which the fused depths give the apparent point, and write it.

    From where the lines say, and looked at again until they need not be mended.
    """
    row[OUTCOME] = _NO_CAMERA if maps.size == 0 else _ONE_CAMERA
    step = balance(t, slope, weight)
    looks, work = np.empty((maps.size, 5)), np.empty((matcher.matched.shape[1], 3))
    for _ in range(MAX_LOOKS):
        if not np.isfinite(step):
            return
        bed += step
        for q in range(maps.size):
            if weight[q] > 0.0:
                _look(looks[q], maps[q], bed, sight, images, matcher, work)
            else:
                looks[q, 0] = 0.0
        step = balance(looks[:, 0], slope, weight)
        if abs(step) < CLOSE_M:
            break
    total, x, y, squares, count = 0.0, 0.0, 0.0, 0.0, 0.0
    for q in range(maps.size):
        if weight[q] > 0.0 and slope[q] == slope[q]:
            w, px = weight[q], looks[q, 1] + step * looks[q, 3]
            py = looks[q, 2] + step * looks[q, 4]
            total, x, y = total + w, x + w * px, y + w * py
            squares, count = squares + w * (px * px + py * py), count + 1.0
    if not (np.isfinite(step) and np.isfinite(squares)):
        return
    row[0], row[1], row[2] = x / total, y / total, bed + step
    row[_MISS] = np.sqrt(max(squares / total - row[0] ** 2 - row[1] ** 2, 0.0))
    row[OUTCOME], row[_COUNT] = _CORRECTED, count


@njit(cache=True, error_model="numpy", nogil=True)
def _look(
    out: FloatArray, c: int, bed: float, sight: Sight, images: Images, matcher: Matcher,
    work: FloatArray,
) -> None:  # fmt: skip
    """Say where the depth map of image c has a bed at a height relative to the apparent point.

    Writes how far beyond P, relative to the distance from the camera, the place on the bed, and how
    that moves with the height.
    """
    normal = sight.normal
    ax, ay, az, ex, ey, ez, above = _ray(c, sight, images)
    length2 = ex * ex + ey * ey + ez * ez
    across = normal[0] * ex + normal[1] * ey + normal[2] * ez
    wet = sight.above[c] > 0.0
    f = above / across if wet else 0.0
    bend = 1.0 / sight.n if wet else 1.0
    dx, dy, dz = refracted(ex, ey, ez, length2, normal[0], normal[1], normal[2], across, bend)
    ax, ay, az = ax + f * ex, ay + f * ey, az + f * ez
    s = (bed - az) / dz
    out[1], out[2] = ax + s * dx, ay + s * dy
    out[3], out[4] = dx / dz, dy / dz
    mx, my, mz = sight.made[c, 0], sight.made[c, 1], sight.made[c, 2]
    length = np.sqrt(mx * mx + my * my + mz * mz)
    t = _depth(
        c, out[1], out[2], bed, -mx / length, -my / length, -mz / length, sight, images, matcher,
        work,
    )  # fmt: skip
    out[0] = t / length


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _ray(
    c: int, sight: Sight, images: Images
) -> tuple[float, float, float, float, float, float, float]:
    """Return the ray on which image c shows the point.

    Where it passes the point, relative to it, the way from there to the projection centre, and how
    high the water is over there.
    """
    up, made, normal = sight.up, sight.made, sight.normal
    if len(images.centres) == 0:
        return 0.0, 0.0, 0.0, up[c, 0], up[c, 1], up[c, 2], sight.above[c]
    dx, dy, dz = as_now(images, c, -made[c, 0], -made[c, 1], -made[c, 2])
    along = (up[c, 0] * dx + up[c, 1] * dy + up[c, 2] * dz) / (dx * dx + dy * dy + dz * dz)
    ex, ey, ez = along * dx, along * dy, along * dz
    ax, ay, az = up[c, 0] - ex, up[c, 1] - ey, up[c, 2] - ez
    above = sight.above[c] - (normal[0] * ax + normal[1] * ay + normal[2] * az)
    return ax, ay, az, ex, ey, ez, above


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _depth(
    c: int, qx: float, qy: float, qz: float, ux: float, uy: float, uz: float, sight: Sight,
    images: Images, matcher: Matcher, work: FloatArray,
) -> float:  # fmt: skip
    """Return how far beyond P, m along its ray u, the depth map of image c has the bed at Q.

    NaN where none of the images that it was matched with sees Q. The light goes as it does; where
    it seems to come from, and P and u, are as the matcher had them.
    """
    count = 0
    nx, ny, nz = sight.normal[0], sight.normal[1], sight.normal[2]
    for j in matcher.matched[c]:
        if j < 0:
            break
        ex, ey, ez = sight.up[j, 0], sight.up[j, 1], sight.up[j, 2]
        k, _, _, _, sx, sy, sz = light_path(
            qx, qy, qz, ex, ey, ez, nx, ny, nz, sight.above[j], sight.n
        )
        ax, ay, az = as_made(images, j, k * sx - nx, k * sy - ny, k * sz - nz)
        if not (k == k and holds(matcher.inner, j, -ax, -ay, -az)):
            continue
        size = 1.0 / np.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax * size, ay * size, az * size
        ex, ey, ez = sight.made[j, 0], sight.made[j, 1], sight.made[j, 2]
        along, turn = -(ex * ax + ey * ay + ez * az), ux * ax + uy * ay + uz * az
        px, py, pz = -ex - along * ax, -ey - along * ay, -ez - along * az
        gx, gy, gz = ux - turn * ax, uy - turn * ay, uz - turn * az
        scale = matcher.focal_px[j] ** 2 / (ex * ex + ey * ey + ez * ez)
        work[count, 0] = scale * (px * px + py * py + pz * pz)
        work[count, 1] = scale * (px * gx + py * gy + pz * gz)
        work[count, 2] = scale * (gx * gx + gy * gy + gz * gz)
        count += 1
    if count == 0:
        return np.nan
    if count == 1:
        return -work[0, 1] / work[0, 2]
    return _best_pairs(work[:count], matcher.tolerance_px2)


@njit(cache=True, error_model="numpy", nogil=True)
def _best_pairs(work: FloatArray, tolerance: float) -> float:
    """Return the depth at which two images agree best: a mean over the pairs, the best most.

    Rows of `work`: the squared residual at t = 0, half its derivative, its curvature.
    """
    least, total, sum_t = np.inf, 0.0, 0.0
    for p in range(len(work)):
        for q in range(p + 1, len(work)):
            half, curved = work[p, 1] + work[q, 1], work[p, 2] + work[q, 2]
            cost = work[p, 0] + work[q, 0] - half * half / curved
            if cost < least:
                shrink = np.exp((cost - least) / tolerance) if total > 0.0 else 0.0
                total, sum_t, least = total * shrink, sum_t * shrink, cost
            w = np.exp((least - cost) / tolerance)
            total += w
            sum_t -= w * half / curved
    return sum_t / total
