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

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from pcfix.model import Outcome
from pcfix.refract.backward import light_path
from pcfix.refract.frames import holds
from pcfix.refract.rays import refracted
from pcfix.refract.threads import one_caller

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray
    from pcfix.refract.bundles import Bundle
    from pcfix.refract.frames import Frames
    from pcfix.refract.result import Intersection

MAX_STEPS = 12
CLOSE_M = 1e-4
AGREE = 0.01
MAX_LOOKS = 5
CLOSE_ENOUGH_M = 0.005
LEAST_RISE_M = 0.005
_BLOCK = 64
_CORRECTED, _NO_CAMERA = int(Outcome.CORRECTED), int(Outcome.NO_CAMERA)
_ONE_CAMERA = int(Outcome.ONE_CAMERA)
_MISS, _COUNT, _OUTCOME = 3, 4, 5


def invert_depth_maps(bundle: Bundle, bed_m=None, listed=None) -> Intersection:
    """Return the true points from which dense matching would have made the apparent ones.

    Parameters
    ----------
    bundle : Bundle
        Its views are the images whose depth maps were fused: those of a list with its weights,
        or all that may have been. `bundle.learned.matcher` says how they were matched.

    Returns
    -------
    Intersection

    Notes
    -----
    The surface above each point is taken as a plane.
    """
    matcher = bundle.learned.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    weights = bundle.views.weight
    listed = bundle.views.kind == "depth-maps" if listed is None else listed
    result = np.zeros((len(bundle.xyz), 6))
    with one_caller():
        _invert(
            np.ascontiguousarray(bundle.xyz),
            np.ascontiguousarray(bundle.surface.height_m),
            bundle.normals(),
            np.ascontiguousarray(bundle.cameras.centres),
            bundle.level_offset_m,
            matcher.inner,
            matcher.focal_px,
            matcher.matched,
            matcher.averaged,
            matcher.tolerance_px2,
            bundle.views.start,
            np.asarray(bundle.views.camera, np.int64),
            np.zeros(0) if weights is None else weights.astype(np.float64),
            bundle.settings.refractive_index,
            np.zeros(0) if bed_m is None else bed_m,
            np.inf if listed else AGREE,
            result,
        )
    return bundle.result(
        result[:, :3],
        outcome=result[:, _OUTCOME].astype(np.uint8),
        ray_miss_m=result[:, _MISS],
    )


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _invert(
    xyz: FloatArray, height: FloatArray, normals: FloatArray, centres: FloatArray,
    offset: FloatArray, frames: Frames, focal_px: FloatArray, matched: IntArray,
    averaged: IntArray, tolerance: float, start: IntArray, camera: IntArray, weight: FloatArray,
    n: float, bed: FloatArray, agree: float, result: FloatArray,
) -> None:  # fmt: skip
    for block in prange((len(xyz) + _BLOCK - 1) // _BLOCK):
        share = np.zeros(len(centres))
        seen = np.zeros(len(centres), np.int8)
        touched = np.empty(len(centres), np.int64)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, len(xyz))):
            up, normal = centres - xyz[i], normals[i]
            listed = camera[start[i] : start[i + 1]]
            given = weight[start[i] : start[i + 1]] if weight.size else weight
            count = _shares(share, seen, touched, listed, given, up, frames, averaged)
            above = normal[2] * (height[i] - xyz[i, 2] + offset)
            maps = touched[:count]
            _solve(
                result[i], maps, share, up, above, normal, frames, focal_px, matched, tolerance, n,
                bed[i] - xyz[i, 2] if bed.size else np.nan, agree,
            )  # fmt: skip
            for q in range(count):
                share[touched[q]], seen[touched[q]] = 0.0, 0


@njit(cache=True, error_model="numpy", nogil=True)
def _shares(
    share: FloatArray, seen: IntArray, touched: IntArray, listed: IntArray, given: FloatArray,
    up: FloatArray, frames: Frames, averaged: IntArray,
) -> int:  # fmt: skip
    """Set what each depth map counts for in the point; return how many do.

    A fused map counts by its weight, that of the matcher or one by its squared distance, and
    shares it evenly with the maps it was averaged with before. `seen` keeps the frame test: 1 in
    frame, 2 not.
    """
    count = 0
    for k in range(listed.size):
        c = listed[k]
        w = given[k] if given.size else 1.0 / (up[c] * up[c]).sum()
        members = 1
        for a in averaged[c]:
            if a < 0:
                break
            if seen[a] == 0:
                held = holds(frames, a, up[a, 0], up[a, 1], up[a, 2])
                seen[a] = 1 if held else 2
                touched[count] = a
                count += 1
            members += seen[a] == 1
        if seen[c] == 0:
            touched[count] = c
            count += 1
        seen[c] = 1
        share[c] += w / members
        for a in averaged[c]:
            if a >= 0 and seen[a] == 1:
                share[a] += w / members
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(
    row: FloatArray, maps: IntArray, share: FloatArray, up: FloatArray, above: FloatArray,
    normal: FloatArray, frames: Frames, focal_px: FloatArray, matched: IntArray,
    tolerance: float, n: float, start: float, agree: float,
) -> None:  # fmt: skip
    """Find the height of the bed at which the fused depths give the apparent point.

    Each depth map's t is nearly linear in the height: two heights tell where it is zero, and
    how it changes. Those maps that agree with P are then fused; a last look at the solution mends
    what is not linear.
    """
    deep = -above.mean() / normal[2] * (n - 1.0)
    bed = 1.1 * deep if np.isnan(start) else start
    k = maps.size
    one, two, work = np.empty((k, 5)), np.empty((k, 5)), np.empty((matched.shape[1], 3))
    rise = min(0.1 * deep, -LEAST_RISE_M)
    for q in range(k):
        _look(
            one[q], maps[q], bed, up, above, normal, frames, focal_px, matched, tolerance, n, work
        )
        _look(
            two[q], maps[q], bed + rise, up, above, normal, frames, focal_px, matched, tolerance,
            n, work,
        )  # fmt: skip
    slope = (two[:, 0] - one[:, 0]) / rise
    for q in range(k):
        usual = 1.0 / (n * up[maps[q], 2])
        if not 0.5 < -slope[q] / usual < 2.0 and slope[q] == slope[q]:
            slope[q] = -usual  # another pair of images was the best one
    weight = share[maps]
    weight[np.isnan(slope)] = 0.0
    if np.isnan(start) and agree < np.inf:
        height = _most_supported(one[:, 0], slope, weight, agree)
    else:
        height = 0.0
    for _ in range(MAX_STEPS):
        step = _step(one[:, 0], slope, weight, height, agree)
        height += step
        if not abs(step) > CLOSE_M:
            break
    if np.isnan(height):
        row[_OUTCOME] = _NO_CAMERA if k == 0 else _ONE_CAMERA
        return
    bed, step = bed + height, 0.0
    for _ in range(MAX_LOOKS):
        bed += step
        for q in range(k):
            if weight[q] > 0.0:
                _look(
                    one[q], maps[q], bed, up, above, normal, frames, focal_px, matched,
                    tolerance, n, work,
                )  # fmt: skip
        step = _step(one[:, 0], slope, weight, 0.0, agree)
        if not abs(step) > CLOSE_ENOUGH_M:
            break
    if np.isnan(step):
        row[_OUTCOME] = _ONE_CAMERA
        return
    row[2] = bed + step
    sums = np.zeros(5)
    for q in range(k):
        w = weight[q] * _agreement(one[q, 0] + slope[q] * step, agree)
        if not w > 0.0:
            continue
        x, y = one[q, 1] + step * one[q, 3], one[q, 2] + step * one[q, 4]
        sums += np.array([w, w * x, w * y, w * (x * x + y * y), 1.0])
    if not sums[0] > 0.0:
        row[_OUTCOME] = _ONE_CAMERA
        return
    row[0], row[1] = sums[1] / sums[0], sums[2] / sums[0]
    row[_MISS] = np.sqrt(max(sums[3] / sums[0] - row[0] ** 2 - row[1] ** 2, 0.0))
    row[_COUNT], row[_OUTCOME] = sums[4], _CORRECTED


@njit(cache=True, error_model="numpy", nogil=True)
def _agreement(t: float, agree: float) -> float:
    """Return how likely a depth that is off by t, relative, is fused: the limit is a soft one.

    The software compares with one depth, not with the mean that becomes the point.
    """
    return max(0.0, min(1.0, 2.5 - 2.0 * abs(t) / agree))


@njit(cache=True, error_model="numpy", nogil=True)
def _step(
    t: FloatArray, slope: FloatArray, weight: FloatArray, height: float, agree: float
) -> float:
    """Return how far up the bed must go so that the depths that agree have a mean of zero."""
    total, change = 0.0, 0.0
    for q in range(t.size):
        if weight[q] > 0.0:
            off = t[q] + slope[q] * height
            w = weight[q] * _agreement(off, agree)
            total, change = total + w * off, change + w * slope[q]
    return -total / change


@njit(cache=True, error_model="numpy", nogil=True)
def _most_supported(t: FloatArray, slope: FloatArray, weight: FloatArray, agree: float) -> float:
    """Return the height at which most depth maps, by weight, agree with the point."""
    best, most = 0.0, -1.0
    for p in range(t.size):
        if not weight[p] > 0.0:
            continue
        height = -t[p] / slope[p]
        support = 0.0
        for q in range(t.size):
            if weight[q] > 0.0:
                support += weight[q] * _agreement(t[q] + slope[q] * height, agree)
        if support > most:
            best, most = height, support
    return best


@njit(cache=True, error_model="numpy", nogil=True)
def _look(
    out: FloatArray, c: int, bed: float, up: FloatArray, above: FloatArray, normal: FloatArray,
    frames: Frames, focal_px: FloatArray, matched: IntArray, tolerance: float, n: float,
    work: FloatArray,
) -> None:  # fmt: skip
    """Say where the depth map of image c has a bed at a height relative to the apparent point.

    Writes how far beyond P, relative to the distance from the camera, and the place on the bed.
    """
    ex, ey, ez = up[c, 0], up[c, 1], up[c, 2]
    length2 = ex * ex + ey * ey + ez * ez
    across = normal[0] * ex + normal[1] * ey + normal[2] * ez
    wet = above[c] > 0.0
    f = above[c] / across if wet else 0.0
    bend = 1.0 / n if wet else 1.0
    dx, dy, dz = refracted(ex, ey, ez, length2, normal[0], normal[1], normal[2], across, bend)
    s = (bed - f * ez) / dz
    out[1], out[2] = f * ex + s * dx, f * ey + s * dy
    out[3], out[4] = dx / dz, dy / dz
    length = np.sqrt(length2)
    t = _depth(
        c, out[1], out[2], bed, -ex / length, -ey / length, -ez / length, up, above, normal,
        frames, focal_px, matched, tolerance, n, work,
    )  # fmt: skip
    out[0] = t / length


@njit(cache=True, error_model="numpy", nogil=True)
def _depth(
    c: int, qx: float, qy: float, qz: float, ux: float, uy: float, uz: float, up: FloatArray,
    above: FloatArray, normal: FloatArray, frames: Frames, focal_px: FloatArray,
    matched: IntArray, tolerance: float, n: float, work: FloatArray,
) -> float:  # fmt: skip
    """Return how far beyond P, m along its ray u, the depth map of image c has the bed at Q.

    NaN where none of the images that it was matched with sees Q.
    """
    count = 0
    nx, ny, nz = normal[0], normal[1], normal[2]
    for j in matched[c]:
        if j < 0:
            break
        ex, ey, ez = up[j, 0], up[j, 1], up[j, 2]
        k, _, _, _, sx, sy, sz = light_path(qx, qy, qz, ex, ey, ez, nx, ny, nz, above[j], n)
        ax, ay, az = k * sx - nx, k * sy - ny, k * sz - nz
        if not (k == k and holds(frames, j, -ax, -ay, -az)):
            continue
        size = 1.0 / np.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax * size, ay * size, az * size
        along, turn = -(ex * ax + ey * ay + ez * az), ux * ax + uy * ay + uz * az
        px, py, pz = -ex - along * ax, -ey - along * ay, -ez - along * az
        gx, gy, gz = ux - turn * ax, uy - turn * ay, uz - turn * az
        scale = focal_px[j] ** 2 / (ex * ex + ey * ey + ez * ez)
        work[count, 0] = scale * (px * px + py * py + pz * pz)
        work[count, 1] = scale * (px * gx + py * gy + pz * gz)
        work[count, 2] = scale * (gx * gx + gy * gy + gz * gz)
        count += 1
    if count == 0:
        return np.nan
    if count == 1:
        return -work[0, 1] / work[0, 2]
    return _best_pairs(work[:count], tolerance)


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
