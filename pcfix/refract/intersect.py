"""Intersect the refracted rays of each point (``snell``), or search its tracks (``consistent``).

With the refracted ray t_i that leaves the water at A_i, the true point Q is nearest to all rays
(Skarlatos & Agrafiotis 2018, eq 11, for any number of rays with equal weights):

    Q = argmin sum |(I - t_i t_i') (Q - A_i)|^2 = (sum M_i)^-1 sum M_i A_i,    M_i = I - t_i t_i'

Points are processed a tile of neighbours at a time and camera by camera, so that the inner loop
runs over the points of the tile and is vectorised. The cameras are those whose frames hold the
points, or those of a list per point (view lists, or the steepest few); both add the same terms in
the order of the cameras.

Each camera may have its own water level, the surface shifted along the vertical. The point is
lowered by the shift instead, where only its distance from the surface counts. A camera whose water
lay below the apparent point saw it through air; its ray goes straight. Or it has a raster of its
own, see `Survey.own_water`.
"""

from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot, minus, row_of, scaled, vector
from pcfix.lens.imaging import Frames, frames_of, mark, no_frames
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
    Optics,
    optics_of,
    warn_of_unsolved,
)
from pcfix.refract.choice import least_cosine2_of, shapes_of
from pcfix.refract.rays import line_terms, nearest_point, pierce, ray_distance, refracted
from pcfix.refract.tiling import TILE, add_three, nine, put, spatial_order, three, tiles_of
from pcfix.refract.tracks import FOUND, LOST, POINT_RUNS, RAY_RUNS, SEARCHED, STATE, Q, search_tile
from pcfix.refract.uncertainty import Budget, room_of
from pcfix.water.surface import Field, Tin

# Columns of the result: a row is one cache line, as points are written in scattered order.
_DISTANCE, _INCIDENCE, _COUNT, _OUTCOME, _FOUND, _WIDTH = 3, 4, 5, 6, 7, 8


class RayInputs(NamedTuple):
    """All points and cameras, which rays count, and the water if it is no plane, for kernels."""

    points: Chosen
    frames: Frames
    least_cosine2: float  # of the incidence angle
    tin: Tin | None
    fields: Field | None


def intersect(batch: Batch) -> Intersection:
    """Re-intersect the refracted rays of points (``snell``).

    The cameras are those of the views or, without these, all whose frames hold the apparent point,
    as that is where the SfM software projected it. The covariances, where the settings ask for
    them, are computed in the same pass.
    """
    return _intersected(batch, None)


def consistent(batch: Batch) -> Intersection:
    """Find the true points whose images give the apparent points, by straight rays.

    Cameras and covariances are as of `intersect`; see `pcfix.refract.tracks`. Weights of the views
    are not used, as software triangulates with equal weights. Light is refracted for a camera whose
    water stood above the true point; for ``snell`` it is the apparent point.

    `ray_miss_m` is the distance from the refracted rays of the apparent point, as for ``snell``.
    Points without a solution, under waves that focus the light, get that of ``snell``, with a
    warning.
    """
    return _intersected(batch, optics_of(batch.survey.cameras))


def _intersected(batch: Batch, optics: Optics | None) -> Intersection:
    survey, views = batch.survey, batch.views
    result, used = np.zeros((len(batch), _WIDTH)), np.zeros(len(survey.cameras), np.bool_)
    least, frames = least_cosine2_of(survey), frames_of(survey.cameras)
    if views is not None:  # the rays are chosen
        least, frames = 0.0, no_frames(len(survey.cameras))
    covariance = np.zeros((len(batch) if survey.settings.dimensions == "all" else 0, 6))
    errors = uncertainty.budget_of(survey), uncertainty.level_sigma_of(batch)
    given = RayInputs(batch.chosen(), frames, least, *shapes_of(survey))
    in_tiles(
        _intersect, tiles_of(batch), spatial_order(batch.xyz), given, optics, *errors,
        (result, used, covariance), points=len(batch),
    )  # fmt: skip
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == CORRECTED
    warn_of_unsolved("method consistent found no solution", result[moved, _FOUND] > 0.0)
    return Intersection(
        shift_m=result[:, :3],
        outcome=outcome,
        ray_count=result[:, _COUNT].astype(np.int32),
        ray_miss_m=result[:, _DISTANCE],
        sigma_z_m=np.zeros(len(batch)),
        incidence_deg=result[:, _INCIDENCE],
        camera_used=used,
        covariance_m2=covariance if survey.settings.dimensions == "all" else None,
    )


@kernel(allocates=True)
def _intersect(
    span: Span, order: IntArray, given: RayInputs, optics: Optics | None, budget: Budget,
    level_sigma: FloatArray, found: tuple[FloatArray, BoolArray, FloatArray],
) -> None:  # fmt: skip
    """Intersect the rays of the points of each tile, of listed cameras or of those in frame."""
    points, frames, centres = given.points, given.frames, given.points.rig.centres
    start, camera = points.start, points.camera
    result, used, covariance = found
    if optics is not None:  # of all cameras; the system provides what is used
        rays, search = np.empty((len(centres), RAY_RUNS * TILE)), np.empty(POINT_RUNS * TILE)
    low, high = tiling.corners_of(order[span[0] * TILE : span[1] * TILE], points.xyz)
    some = camera[:0] if start.size else np.arange(len(centres))
    around = tiling.near_cameras(some, frames, centres, low, high)
    for t in range(*span):
        # a tile of neighbours, its sums, and the cameras near it
        rows = order[t * TILE : (t + 1) * TILE]
        tile, sums = np.empty(7 * TILE), np.zeros(11 * TILE)
        low, high = tiling.gather(tile, rows, points)
        # the least squared cosine of the incidence angles
        sums[10 * TILE :] = 1.0
        if start.size:
            near, marks = tiling.marks_of_lists(start, camera, rows, len(centres))
        else:
            near = tiling.near_cameras(around, frames, centres, low, high)
            marks = np.empty((near.size, rows.size))
        seeing = _add_cameras(sums, tile, marks, near, start.size > 0, given)
        _solve(result, used, rows, sums, marks[:seeing], near)
        if optics is not None:
            # tracks: search from the intersection, where there is one
            for j in range(rows.size):
                row = result[rows[j]]
                search[STATE * TILE + j] = SEARCHED if row[_OUTCOME] == CORRECTED else LOST
                put(search, Q * TILE + j, vector(row))
            search_tile(
                search, rays, tile, marks[:seeing], near[:seeing], points, optics,
                given.tin, given.fields,
            )  # fmt: skip
            for j in range(rows.size):
                row = result[rows[j]]
                # without a solution the intersection stays
                row[_FOUND] = 1.0 if search[STATE * TILE + j] == FOUND else 0.0
                if row[_FOUND] > 0.0:
                    row[0], row[1], row[2] = three(search, Q * TILE + j)
                    row[_DISTANCE] = ray_distance(sums[9 * TILE + j], nine(sums, j), vector(row))
        if len(covariance):
            room = room_of(tile, result, rows)
            uncertainty.add_errors(room, tile, marks[:seeing], near, points, budget)
            uncertainty.finish_tile(covariance, rows, room, tile, level_sigma, budget)


# A kernel that makes arrays counts references: two locked operations for each row of an array that
# it passes to a function. So the loops over cameras and points are functions that make no arrays.


@device
def _add_cameras(
    sums: FloatArray, tile: FloatArray, marks: FloatArray, near: IntArray, listed: bool,
    given: RayInputs,
) -> int:  # fmt: skip
    """Add the rays of the cameras `near` a tile.

    The cameras that give a ray, and their marks, are moved to the front; returns how many they are.
    """
    points, least, seeing = given.points, given.least_cosine2, 0
    for k in range(near.size):
        # the row of a camera that gives no ray is used again by the next one
        c, on, some = near[k], marks[seeing], True
        if listed:
            for j in range(on.size):
                on[j] = marks[k, j]
        else:
            some = mark(on, tile, TILE, given.frames, c, points.rig.centres[c])
        if some and add_camera(sums, tile, on, points, c, least, given.tin, given.fields):
            near[seeing] = c
            seeing += 1
    return seeing


@device
def add_camera(
    sums: FloatArray, tile: FloatArray, marks: FloatArray, points: Chosen, c: int,
    least_cosine2: float, tin: Tin | None, fields: Field | None,
) -> int:  # fmt: skip
    """Add one camera's rays to the sums of a tile; return how many.

    The marks say how often each ray counts; afterwards they are zero for those that do not. The
    sums are those of `line_terms`, the number of rays, and the least squared cosine of the
    incidence angles.
    """
    centre, offset = row_of(points.rig.centres, c), points.rig.offset[c]
    r, rays = 1.0 / points.n, 0
    for j in range(marks.size):
        x, y, z = three(tile, j)
        # from the point to the centre; N, H = N.e; h, the height of the water over P
        e = minus(centre, (x, y, z))
        normal = three(tile, 4 * TILE + j)
        height = dot(normal, e)
        h = normal[2] * (tile[3 * TILE + j] - (z - offset))
        length2 = dot(e, e)
        steep = (height > h) & (height * height >= least_cosine2 * length2)
        use = (marks[j] > 0.0) & steep
        times = marks[j] if use else 0.0
        marks[j] = times
        # one division for two; a ray that is not used adds zeros, as a branch would not vectorise
        q = 1.0 / (length2 * height)
        f = h * length2 * q if use and h > 0.0 else 0.0
        if (tin is not None or fields is not None) and use and h > 0.0:
            f, normal = pierce(c, tin, fields, (x, y, z - offset), e, h, normal)
            height = dot(normal, e)
            q = 1.0 / (length2 * height)
        # 1 / L^2
        inv = height * q if use else 0.0
        ratio = r if h > 0.0 else 1.0
        d = refracted(e, length2, normal, height, ratio)
        terms = line_terms(scaled(f, e), d, inv)
        add_three(sums, j, times, terms[0:3])
        add_three(sums, 3 * TILE + j, times, terms[3:6])
        add_three(sums, 6 * TILE + j, times, terms[6:9])
        sums[9 * TILE + j] += times
        cosine2 = height * height * inv
        sums[10 * TILE + j] = min(sums[10 * TILE + j], cosine2 if use else 1.0)
        rays += 1 if use else 0
    return rays


@device
def _solve(
    result: FloatArray, used: BoolArray, rows: IntArray, sums: FloatArray, marks: FloatArray,
    near: IntArray,
) -> None:  # fmt: skip
    """Solve the points of a tile and write their rows; without a solution the shift stays zero.

    Sets which cameras are used; `marks` has a row for each of those `near`.
    """
    for j in range(rows.size):
        row, k = result[rows[j]], sums[9 * TILE + j]
        if k < 2.0:
            row[_OUTCOME] = ONE_CAMERA if k == 1.0 else NO_CAMERA
            continue
        solved, q, distance = nearest_point(k, nine(sums, j))
        if not solved:
            most = 0.0  # a list may name a camera several times, as its marks say
            for times in marks[:, j]:
                most = max(most, times)
            row[_OUTCOME] = ONE_CAMERA if most == k else PARALLEL
            continue
        row[0], row[1], row[2] = q
        row[_DISTANCE], row[_FOUND] = distance, 1.0
        row[_INCIDENCE] = np.degrees(np.arccos(np.sqrt(min(sums[10 * TILE + j], 1.0))))
        row[_COUNT], row[_OUTCOME] = k, CORRECTED
    for k in range(len(marks)):
        if not used[near[k]]:  # threads may write it at once: always the same value
            for j in range(rows.size):
                if marks[k, j] > 0.0 and result[rows[j], _OUTCOME] == CORRECTED:
                    used[near[k]] = True
