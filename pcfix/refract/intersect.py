"""Intersect the refracted rays of each point (method ``snell``).

Points are processed a tile of neighbours at a time and camera by camera, so that the inner loop
runs over the points of the tile and is vectorised. The cameras are those whose frames hold the
points, or those of a list per point (view lists, or the steepest few); both add the same terms in
the order of the cameras.

Each camera may have its own water level, the surface shifted along the vertical. The point is
lowered by the shift instead, where only its distance from the surface counts. A camera whose water
lay below the apparent point saw it through air; its ray goes straight. Or it has a raster of its
own, see `Survey.own_water`.
"""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot, minus, row_of, scaled
from pcfix.lens.frames import (
    NOT_DISTORTED,
    Frames,
    Pyramid,
    frames_of,
    in_frame,
    may_hold,
    no_frames,
    pyramid,
)
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract import tiling, uncertainty
from pcfix.refract.batch import (
    CORRECTED,
    NO_CAMERA,
    ONE_CAMERA,
    PARALLEL,
    Batch,
    Chosen,
    Intersection,
)
from pcfix.refract.choice import Rig, Rule, rig_of, rule_of, shapes_of
from pcfix.refract.rays import line_terms, nearest_point, pierce_of, refracted
from pcfix.refract.tiling import TILE, spatial_order, tiles_of
from pcfix.refract.uncertainty import Budget, room_of
from pcfix.water.surface import Field, Tin, locate

# Columns of the result: a row is one cache line, as points are written in scattered order.
_DISTANCE, _INCIDENCE, _COUNT, _OUTCOME, _WIDTH = 3, 4, 5, 6, 8


def intersect(batch: Batch) -> Intersection:
    """Re-intersect the refracted rays of points.

    The cameras are those of the views or, without these, all whose frames hold the apparent point,
    as that is where the SfM software projected it. The covariances, where the settings ask for
    them, are computed in the same pass.

    Notes
    -----
    Skarlatos & Agrafiotis 2018, eqs 10 and 11, for any number of rays with equal weight.
    """
    survey, views = batch.survey, batch.views
    result, used = np.zeros((len(batch), _WIDTH)), np.zeros(len(survey.cameras), np.bool_)
    rule, frames = rule_of(survey), frames_of(survey.cameras)
    if views is not None:  # the rays are chosen
        rule, frames = rule._replace(least_cosine2=0.0), no_frames(len(survey.cameras))
    covariance = np.zeros((len(batch) if survey.settings.dimensions == "all" else 0, 6))
    errors = uncertainty.budget_of(survey), uncertainty.level_sigma_of(batch)
    in_tiles(
        _intersect, tiles_of(batch), spatial_order(batch.xyz), batch.chosen(), rig_of(survey),
        frames, rule, *shapes_of(survey), *errors, (result, used, covariance), points=len(batch),
    )  # fmt: skip
    found = Intersection(
        shift_m=result[:, :3],
        outcome=result[:, _OUTCOME].astype(np.uint8),
        ray_count=result[:, _COUNT].astype(np.int32),
        ray_miss_m=result[:, _DISTANCE],
        sigma_z_m=np.zeros(len(batch)),
        incidence_deg=result[:, _INCIDENCE],
        camera_used=used,
    )
    return uncertainty.with_errors(found, covariance if len(covariance) == len(batch) else None)


@kernel(allocates=True)
def _intersect(
    span: Span, order: IntArray, points: Chosen, rig: Rig, frames: Frames, rule: Rule,
    tin: Tin | None, fields: Field | None, budget: Budget, level_sigma: FloatArray,
    found: tuple[FloatArray, BoolArray, FloatArray],
) -> None:  # fmt: skip
    """Intersect the rays of the points of each tile, of listed cameras or of those in frame."""
    centres, start, camera = rig.centres, points.start, points.camera
    result, used, covariance = found
    low, high = tiling.corners_of(order[span[0] * TILE : span[1] * TILE], points.xyz)
    around = camera[:0] if start.size else tiling.cameras_around(frames, centres, low, high)
    facet = np.full(TILE, -1)
    for t in range(*span):
        # a tile of neighbours, its sums, and the cameras near it
        rows = order[t * TILE : (t + 1) * TILE]
        tile, sums = np.empty(7 * TILE), np.zeros(11 * TILE)
        low, high = tiling.gather(tile, rows, points)
        sums[10 * TILE :] = 1.0
        if tin is not None:  # the facet above each point, where piercing starts
            for j in range(rows.size):
                facet[j] = locate(tin, tile[j], tile[TILE + j])
        if start.size:
            near, marks = tiling.marks_of_lists(start, camera, rows, len(centres))
        else:
            near = around[_may_hold(frames, around, centres, low, high)]
            marks = np.empty((near.size, rows.size))
        seeing = 0
        for k in range(near.size):
            c = near[k]
            if start.size:
                marks[seeing] = marks[k]
                rays = add_camera(sums, tile, marks[seeing], None, rig, c, rule, tin, fields, facet)
            # the marks of a pyramid serve only the errors: a pass for them takes 40 % longer
            elif frames.row[c] == NOT_DISTORTED and not len(covariance):
                g = pyramid(frames.planes[c])
                rays = add_camera(sums, tile, marks[seeing], g, rig, c, rule, tin, fields, facet)
            elif tiling.mark_camera(marks[seeing], tile, frames, c, centres[c], low, high):
                rays = add_camera(sums, tile, marks[seeing], None, rig, c, rule, tin, fields, facet)
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


@device(allocates=True)
def _may_hold(
    frames: Frames, around: IntArray, centres: FloatArray, low: FloatArray, high: FloatArray
) -> BoolArray:
    """Return which cameras may hold a point of a box by their pyramids."""
    near = np.empty(around.size, np.bool_)
    for k in range(around.size):
        near[k] = may_hold(frames.planes[around[k]], centres[around[k]], low, high)
    return near


@device
def add_camera(
    sums: FloatArray, tile: FloatArray, marks: FloatArray, g: Pyramid | None, rig: Rig, c: int,
    rule: Rule, tin: Tin | None, fields: Field | None, facet: IntArray,
) -> int:  # fmt: skip
    """Add one camera's rays to the sums of a tile; return how many.

    The frame is the pyramid `g`, or the marks say how often each ray counts. Afterwards the marks
    are those of the rays that count. The sums are those of `line_terms`, the number of rays, and
    the least squared cosine of the incidence angles.
    """
    centre, offset = row_of(rig.centres, c), rig.offset[c]
    least_cosine2, r = rule.least_cosine2, rule.bend
    rays = 0
    for j in range(marks.size):
        x, y, z = tile[j], tile[TILE + j], tile[2 * TILE + j]
        # from the point to the centre; N, H = N.e; h, the height of the water over P
        e = minus(centre, (x, y, z))
        normal = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        height = dot(normal, e)
        h = normal[2] * (tile[3 * TILE + j] - (z - offset))
        length2 = dot(e, e)
        steep = (height > h) & (height * height >= least_cosine2 * length2)
        held = marks[j] > 0.0 if g is None else in_frame(g, e)
        use = held & steep
        times = marks[j] if g is None else 1.0
        times = times if use else 0.0
        marks[j] = times
        # one division for two; a ray that is not used adds zeros, as a branch would not vectorise
        q = 1.0 / (length2 * height)
        f = h * length2 * q if use and h > 0.0 else 0.0
        if (tin is not None or fields is not None) and use and h > 0.0:
            f, normal = pierce_of(c, tin, fields, (x, y, z - offset), e, h, normal, facet[j])
            height = dot(normal, e)
            q = 1.0 / (length2 * height)
        # 1 / L^2
        inv = height * q if use else 0.0
        bend = r if h > 0.0 else 1.0
        d = refracted(e, length2, normal, height, bend)
        xx, xy, xz, yy, yz, bx, by, bz, s = line_terms(scaled(f, e), d, inv)
        sums[j] += times * xx
        sums[TILE + j] += times * xy
        sums[2 * TILE + j] += times * xz
        sums[3 * TILE + j] += times * yy
        sums[4 * TILE + j] += times * yz
        sums[5 * TILE + j] += times * bx
        sums[6 * TILE + j] += times * by
        sums[7 * TILE + j] += times * bz
        sums[8 * TILE + j] += times * s
        sums[9 * TILE + j] += times
        cosine2 = height * height * inv
        sums[10 * TILE + j] = min(sums[10 * TILE + j], cosine2 if use else 1.0)
        rays += 1 if use else 0
    return rays


@device
def _solve(row: FloatArray, k: float, sums: FloatArray) -> None:
    """Solve one point and write its row; a point without a solution keeps a shift of zero."""
    if k < 2.0:
        row[_OUTCOME] = ONE_CAMERA if k == 1.0 else NO_CAMERA
        return
    solved, q, distance, _ = nearest_point(k, sums)
    if not solved:
        row[_OUTCOME] = PARALLEL
        return
    row[0], row[1], row[2] = q
    row[_DISTANCE] = distance
    row[_INCIDENCE] = np.degrees(np.arccos(np.sqrt(min(sums[10], 1.0))))
    row[_COUNT], row[_OUTCOME] = k, CORRECTED
