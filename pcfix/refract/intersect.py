"""Intersect the refracted rays of each point (method ``snell``).

Two kernels form the same sums. `_all_in_frame` takes every camera whose frame holds the point; its
inner loop runs over the points of a tile and is vectorised. `_chosen` takes a list of cameras per
point (view lists, or the steepest few), or a mesh or raster, point by point. Both add the same
terms in the order of the cameras, so that they agree to the bit wherever both apply.

Each camera may have its own water level, the surface shifted along the vertical. The point is
lowered by the shift instead, where only its distance from the surface counts. A camera whose water
lay below the apparent point saw it through air; its ray goes straight. Or it has a raster of its
own, see `Survey.own_water`.
"""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot, minus, row_of, scaled
from pcfix.lens.frames import NOT_DISTORTED, Frames, Pyramid, frames_of, in_frame, may_hold, pyramid
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract import tiling, uncertainty
from pcfix.refract.batch import CORRECTED, NO_CAMERA, ONE_CAMERA, PARALLEL, Batch, Intersection
from pcfix.refract.choice import Rig, Rule, rig_of, rule_of, shapes_of
from pcfix.refract.rays import add_line, line_terms, nearest_point, pierce_of, refracted
from pcfix.refract.sensitivity import Budget, room_of
from pcfix.refract.tiling import TILE, Points, points_of, tiles_of
from pcfix.water.surface import Field, Tin, locate


def intersect(batch: Batch) -> Intersection:
    """Re-intersect the refracted rays of points with chosen cameras.

    Returns
    -------
    Intersection
        `sigma_z_m` is that of the scatter of the rays.

    Notes
    -----
    Skarlatos & Agrafiotis 2018, eqs 10 and 11, for any number of rays with equal weight.
    """
    survey = batch.survey
    result, used = np.zeros((len(batch), 8)), np.zeros(len(survey.cameras), np.bool_)
    in_tiles(
        _chosen, tiles_of(batch), points_of(batch), rig_of(survey), rule_of(survey),
        *shapes_of(survey),
        batch.listed, result, used,
        points=len(batch),
    )  # fmt: skip
    return _as_intersection(result, used)


def intersect_in_frame(batch: Batch) -> Intersection:
    """Re-intersect the refracted rays of every camera whose frame holds a point.

    The surface is a plane above each point. The covariances are computed in the same pass, where
    the settings ask for them, so that the frames are looked at once.

    Notes
    -----
    The frame test is for the apparent point, as that is where the SfM software projected it.
    """
    survey = batch.survey
    result, used = np.zeros((len(batch), 8)), np.zeros(len(survey.cameras), np.bool_)
    covariance = np.zeros((len(batch) if survey.settings.dimensions == "all" else 0, 6))
    in_tiles(
        _all_in_frame, tiles_of(batch), points_of(batch), rig_of(survey), frames_of(survey.cameras),
        rule_of(survey), uncertainty.budget_of(survey), uncertainty.level_sigma_of(batch),
        (result, used, covariance), points=len(batch),
    )  # fmt: skip
    found = _as_intersection(result, used)
    return uncertainty.with_errors(found, covariance if len(covariance) == len(batch) else None)


def _as_intersection(result: FloatArray, used: BoolArray) -> Intersection:
    return Intersection(
        shift_m=result[:, :3],
        outcome=result[:, _OUTCOME].astype(np.uint8),
        ray_count=result[:, _COUNT].astype(np.int32),
        ray_miss_m=result[:, _DISTANCE],
        sigma_z_m=result[:, _SIGMA_Z],
        incidence_deg=result[:, _INCIDENCE],
        camera_used=used,
    )


# Columns of the result: a row is one cache line, as points are written in scattered order.
_DISTANCE, _SIGMA_Z, _INCIDENCE, _COUNT, _OUTCOME = 3, 4, 5, 6, 7


@device
def _solve(row: FloatArray, k: float, sums: FloatArray) -> None:
    """Solve one point and write its row; a point without a solution keeps a shift of zero."""
    if k < 2.0:
        row[_OUTCOME] = ONE_CAMERA if k == 1.0 else NO_CAMERA
        return
    solved, q, distance, sigma_z = nearest_point(k, sums)
    if not solved:
        row[_OUTCOME] = PARALLEL
        return
    row[0], row[1], row[2] = q
    row[_DISTANCE], row[_SIGMA_Z] = distance, sigma_z
    row[_INCIDENCE] = np.degrees(np.arccos(np.sqrt(min(sums[10], 1.0))))
    row[_COUNT], row[_OUTCOME] = k, CORRECTED


@device
def add_camera(
    sums: FloatArray, tile: FloatArray, marks: FloatArray, g: Pyramid | None, rig: Rig, c: int,
    rule: Rule,
) -> int:  # fmt: skip
    """Add one camera's rays to the sums of a tile; return how many.

    The frame is the pyramid `g`, or its test left marks. Afterwards the marks are those of the rays
    that count.
    """
    centre, offset = row_of(rig.centres, c), rig.offset[c]
    least_cosine2, r = rule.least_cosine2, rule.bend
    rays = 0
    for j in range(marks.size):
        z = tile[2 * TILE + j]
        # from the point to the centre; N, H = N.e; h, the height of the water over P
        e = minus(centre, (tile[j], tile[TILE + j], z))
        normal = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        height = dot(normal, e)
        h = normal[2] * (tile[3 * TILE + j] - (z - offset))
        length2 = dot(e, e)
        steep = (height > h) & (height * height >= least_cosine2 * length2)
        held = marks[j] > 0.0 if g is None else in_frame(g, e)
        use = held & steep
        marks[j] = 1.0 if use else 0.0
        # one division for two; a ray that is not used adds zeros, as a branch would not vectorise
        q = 1.0 / (length2 * height)
        f = h * length2 * q if use and h > 0.0 else 0.0
        # 1 / L^2
        inv = height * q if use else 0.0
        bend = r if h > 0.0 else 1.0
        d = refracted(e, length2, normal, height, bend)
        xx, xy, xz, yy, yz, bx, by, bz, s = line_terms(scaled(f, e), d, inv)
        sums[j] += xx
        sums[TILE + j] += xy
        sums[2 * TILE + j] += xz
        sums[3 * TILE + j] += yy
        sums[4 * TILE + j] += yz
        sums[5 * TILE + j] += bx
        sums[6 * TILE + j] += by
        sums[7 * TILE + j] += bz
        sums[8 * TILE + j] += s
        sums[9 * TILE + j] += 1.0 if use else 0.0
        cosine2 = height * height * inv
        sums[10 * TILE + j] = min(sums[10 * TILE + j], cosine2 if use else 1.0)
        rays += 1 if use else 0
    return rays


@kernel(allocates=True)
def _all_in_frame(
    span: Span, points: Points, rig: Rig, frames: Frames, rule: Rule, budget: Budget,
    level_sigma: FloatArray, found: tuple[FloatArray, BoolArray, FloatArray],
) -> None:  # fmt: skip
    """Take every camera whose frame holds the point, under a plane."""
    centres = rig.centres
    result, used, covariance = found
    low, high = tiling.corners_of(points.order[span[0] * TILE : span[1] * TILE], points.xyz)
    around = tiling.cameras_around(frames, centres, low, high)
    for t in range(*span):
        # a tile of neighbours, its sums, and the cameras near it
        rows = points.order[t * TILE : (t + 1) * TILE]
        tile, sums = np.empty(7 * TILE), np.zeros(11 * TILE)
        low, high = tiling.gather(tile, rows, points)
        sums[10 * TILE :] = 1.0
        near = np.empty(len(around), np.int64)
        count = 0
        for c in around:
            if may_hold(frames.planes[c], centres[c], low, high):
                near[count] = c
                count += 1
        marks = np.empty((count, rows.size))
        seeing = 0
        for k in range(count):
            c = near[k]
            # the marks of a pyramid serve only the errors: a pass for them takes 40 % longer
            if frames.row[c] == NOT_DISTORTED and not len(covariance):
                g = pyramid(frames.planes[c])
                rays = add_camera(sums, tile, marks[seeing], g, rig, c, rule)
            elif tiling.mark_camera(marks[seeing], tile, frames, c, centres[c], low, high):
                rays = add_camera(sums, tile, marks[seeing], None, rig, c, rule)
            else:
                rays = 0
            if rays:
                used[c] = True  # threads may write it at once: always the same value
                near[seeing] = c
                seeing += 1
        of_point = np.empty(11)
        for j in range(rows.size):
            for at in range(11):
                of_point[at] = sums[at * TILE + j]
            _solve(result[rows[j]], of_point[9], of_point)
        if len(covariance):
            room = room_of(tile, result, rows)
            for k in range(seeing):
                uncertainty.add_errors(room, tile, marks[k], rig, near[k], rule, budget)
            uncertainty.finish_tile(covariance, rows, room, tile, level_sigma, budget)


@kernel(allocates=True)
def _chosen(
    span: Span, points: Points, rig: Rig, rule: Rule, tin: Tin | None, fields: Field | None,
    views: tuple[IntArray, IntArray], result: FloatArray, used: BoolArray,
) -> None:  # fmt: skip
    """Take the chosen cameras of each point, under any surface."""
    start, camera = views
    for t in range(*span):
        rows = points.order[t * TILE : (t + 1) * TILE]
        tile = np.empty(7 * TILE)
        tiling.gather(tile, rows, points)
        for j in range(rows.size):
            i = rows[j]
            # the facet above the point, where piercing starts
            facet = -1 if tin is None else locate(tin, tile[j], tile[TILE + j])
            cameras = camera[start[i] : start[i + 1]]
            for c in cameras:
                used[c] = True  # threads may write it at once: always the same value
            _intersect_one(result[i], cameras, tile, j, rig, rule.bend, tin, fields, facet)


@device(allocates=True)
def _intersect_one(
    row: FloatArray, cameras: IntArray, tile: FloatArray, j: int, rig: Rig, r: float,
    tin: Tin | None, fields: Field | None, facet: int,
) -> None:  # fmt: skip
    """Intersect the rays of point j of a tile with its cameras."""
    x, y, z = tile[j], tile[TILE + j], tile[2 * TILE + j]
    upward = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
    sums, least = np.zeros(11), 1.0
    for c in cameras:
        e = minus(row_of(rig.centres, c), (x, y, z))
        length2, lowered = dot(e, e), (x, y, z - rig.offset[c])
        h = upward[2] * (tile[3 * TILE + j] - lowered[2])
        # a point above its water has a straight ray
        f, bend, normal = 0.0, 1.0, upward
        if h > 0.0:
            bend = r
            f, normal = pierce_of(c, tin, fields, lowered, e, h, upward, facet)
        height = dot(normal, e)
        q = 1.0 / (length2 * height)
        if h > 0.0 and tin is None and fields is None:
            f = h * length2 * q  # as in `add_camera`
        inv = height * q
        add_line(sums, scaled(f, e), refracted(e, length2, normal, height, bend), inv)
        least = min(least, height * height * inv)
    sums[10] = least
    _solve(row, float(cameras.size), sums)
