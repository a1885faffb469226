"""Send each point's rays through the surface and re-intersect them.

Two kernels do the same sum. `_all_in_frame` takes every camera whose frame holds the point; its
inner loop runs over the points of a tile, so that the processor works on several points at
once. `_chosen` takes a list of cameras per point (view lists, or the steepest few) or bends the
rays at a mesh or raster, and goes point by point. Both add the same terms in the order of the
cameras, so that they agree to the bit wherever both apply.

Each camera may have had its own water level, the surface shifted along the vertical. The point is
lowered by the shift instead, where only its distance from the surface counts. A camera whose own
water lay below the apparent point saw it through air; its ray goes straight on. Or it has a raster
of its own, see `Survey.own_water`.
"""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot, minus, row_of, scaled
from pcfix.lens.frames import NOT_DISTORTED, Frames, Pyramid, frames_of, in_frame, may_hold, pyramid
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract.batch import CORRECTED, NO_CAMERA, ONE_CAMERA, PARALLEL, Batch, Intersection
from pcfix.refract.choice import Rig, Rule, rig_of, rule_of, shapes_of
from pcfix.refract.rays import add_line, line_terms, nearest_point, pierce_of, refracted
from pcfix.refract.sensitivity import Budget, room_of
from pcfix.refract.tiling import (
    TILE,
    Points,
    cameras_around,
    corners_of,
    gather,
    mark_camera,
    points_of,
    tiles_of,
)
from pcfix.refract.uncertainty import (
    add_errors,
    budget_of,
    finish_tile,
    level_sigma_of,
    with_errors,
)
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
    survey, views = batch.survey, batch.rays
    result, used = np.zeros((len(batch), 8)), np.zeros(len(survey.cameras), np.bool_)
    in_tiles(
        _chosen, tiles_of(batch), points_of(batch), rig_of(survey), rule_of(survey),
        *shapes_of(survey),
        (np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64)), result, used,
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
        rule_of(survey), budget_of(survey), level_sigma_of(batch), (result, used, covariance),
        points=len(batch),
    )  # fmt: skip
    found = _as_intersection(result, used)
    return with_errors(found, covariance if len(covariance) == len(batch) else None)


def _as_intersection(result: FloatArray, used: BoolArray) -> Intersection:
    return Intersection(
        shift_m=result[:, :3],
        outcome=result[:, _OUTCOME].astype(np.uint8),
        ray_count=result[:, _COUNT].astype(np.int32),
        ray_miss_m=result[:, _MISS],
        sigma_z_m=result[:, _SIGMA_Z],
        incidence_deg=result[:, _INCIDENCE],
        camera_used=used,
    )


# Rows of the result, one line of cache per point, as they are written in scattered order.
_MISS, _SIGMA_Z, _INCIDENCE, _COUNT, _OUTCOME = 3, 4, 5, 6, 7


@device
def _solve(row: FloatArray, k: float, sums: FloatArray) -> None:
    """Solve one point and write its row; a point without a solution keeps a shift of zero."""
    if k < 2.0:
        row[_OUTCOME] = ONE_CAMERA if k == 1.0 else NO_CAMERA
        return
    solved, q, miss, sigma_z = nearest_point(k, sums)
    if not solved:
        row[_OUTCOME] = PARALLEL
        return
    row[0], row[1], row[2] = q
    row[_MISS], row[_SIGMA_Z] = miss, sigma_z
    row[_INCIDENCE] = np.degrees(np.arccos(np.sqrt(min(sums[10], 1.0))))
    row[_COUNT], row[_OUTCOME] = k, CORRECTED


@device
def _solve_tile(result: FloatArray, rows: IntArray, sums: FloatArray) -> None:
    """Solve the points of a tile: where references are counted, two to each of its points."""
    for j in range(rows.size):
        _solve(result[rows[j]], sums[9 * TILE + j], sums[j::TILE])


@device
def add_camera(
    sums: FloatArray, tile: FloatArray, marks: FloatArray, g: Pyramid | None, rig: Rig, c: int,
    rule: Rule,
) -> int:  # fmt: skip
    """Add one camera's rays to the sums of a tile; return how many it gave.

    The frame is a pyramid, tested as the rays are added, or it was tested before and left marks.
    The marks are then those of the rays that count.
    `sums` and `tile` hold runs of `TILE` numbers in one array each: with one base address and
    fixed distances the compiler sees that the runs cannot overlap, and vectorises.
    """
    centre, offset = row_of(rig.centres, c), rig.offset[c]
    least_cosine2, r = rule.least_cosine2, rule.bend
    rays = 0
    for j in range(marks.size):
        z = tile[2 * TILE + j]
        e = minus(centre, (tile[j], tile[TILE + j], z))
        normal = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        height = dot(normal, e)
        h = normal[2] * (tile[3 * TILE + j] - (z - offset))
        length2 = dot(e, e)
        steep = (height > h) & (height * height >= least_cosine2 * length2)
        held = marks[j] > 0.0 if g is None else in_frame(g, e)
        use = held & steep
        marks[j] = 1.0 if use else 0.0
        # one division for two; a ray that is not used adds zeros
        q = 1.0 / (length2 * height)
        f = h * length2 * q if use and h > 0.0 else 0.0
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
    """Every camera whose frame holds the point; the surface above it is a plane."""
    centres = rig.centres
    result, used, covariance = found
    low, high = corners_of(points.order[span[0] * TILE : span[1] * TILE], points.xyz)
    around = cameras_around(frames, centres, low, high)
    for t in range(*span):
        rows = points.order[t * TILE : (t + 1) * TILE]
        tile, sums = np.empty(7 * TILE), np.zeros(11 * TILE)
        low, high = gather(tile, rows, points)
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
            # marks of a pyramid are for the errors alone: a pass of its own takes 40 % longer
            if frames.row[c] == NOT_DISTORTED and not len(covariance):
                g = pyramid(frames.planes[c])
                rays = add_camera(sums, tile, marks[seeing], g, rig, c, rule)
            elif mark_camera(marks[seeing], tile, frames, c, centres[c], low, high):
                rays = add_camera(sums, tile, marks[seeing], None, rig, c, rule)
            else:
                rays = 0
            if rays:
                used[c] = True  # threads may write it at once: always the same value
                near[seeing] = c
                seeing += 1
        _solve_tile(result, rows, sums)
        if len(covariance):
            room = room_of(tile, result, rows)
            for k in range(seeing):
                add_errors(room, tile, marks[k], rig, near[k], rule, budget)
            finish_tile(covariance, rows, room, tile, level_sigma, budget)


@kernel(allocates=True)
def _chosen(
    span: Span, points: Points, rig: Rig, rule: Rule, tin: Tin | None, fields: Field | None,
    views: tuple[IntArray, IntArray], result: FloatArray, used: BoolArray,
) -> None:  # fmt: skip
    """Chosen cameras per point, and rays that may bend at a mesh or raster."""
    start, camera = views
    for t in range(*span):
        rows = points.order[t * TILE : (t + 1) * TILE]
        tile = np.empty(7 * TILE)
        gather(tile, rows, points)
        for j in range(rows.size):
            i = rows[j]
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
    """Intersect the rays of one point with its own cameras."""
    x, y, z = tile[j], tile[TILE + j], tile[2 * TILE + j]
    upward = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
    sums, least = np.zeros(11), 1.0
    for c in cameras:
        e = minus(row_of(rig.centres, c), (x, y, z))
        length2, lowered = dot(e, e), (x, y, z - rig.offset[c])
        h = upward[2] * (tile[3 * TILE + j] - lowered[2])
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
