"""Choose the cameras of each point: all whose frames contain it, or those of a view list."""

import numpy as np
import numpy.typing as npt

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot, minus, row_of, scaled
from pcfix.lens.imaging import Frames, frames_of, holds, listed_frames_of, mark, narrower
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    IntArray,
    Views,
    WaterMesh,
    WaterPlane,
    WaterRaster,
)
from pcfix.options.correct import ScienceOptions
from pcfix.refract import tiling
from pcfix.refract.batch import Batch, Chosen, Rig, Survey
from pcfix.refract.rays import light_near, pierce
from pcfix.refract.tiling import TILE, three
from pcfix.water.surface import Field, SurfaceAbove, Tin, build_fields, build_tin

# Cameras without a lens have no frame to leave; nobody matches images as flat as this, and a block
# in another CRS is recognised by it.
MAX_ANGLE_WITHOUT_FRAMES_DEG = 80.0

# Largest distance of the image of a true point from that of its apparent point, by the longer side
# of the frame: the residuals of refraction, which straight rays cannot fit.
REACH = 0.03


def least_cosine2_of(survey: Survey) -> float:
    """Return the squared cosine of the largest incidence angle of a ray."""
    limit = survey.limit_deg
    if limit is None and survey.cameras.lenses is None:
        limit = MAX_ANGLE_WITHOUT_FRAMES_DEG
    return 0.0 if limit is None else float(np.cos(np.radians(limit)) ** 2)


def shapes_of(survey: Survey) -> tuple[Tin | None, Field | None]:
    """Return a mesh, or the rasters of the images, for kernels; neither for a plane."""
    water, k = survey.water, len(survey.cameras)
    if survey.own_water is not None:
        return None, survey.own_water
    return (
        build_tin(water) if isinstance(water, WaterMesh) else None,
        build_fields({}, k, water) if isinstance(water, WaterRaster) else None,
    )


def chosen_views(batch: Batch, shift_m: FloatArray | None = None) -> Views:
    """Return the cameras whose rays each point gets, as a list.

    Those of the list of the batch, in its order and with its weights, that can have imaged the
    point (`pcfix.lens.imaging.MARGIN`); or, without a list, all whose frames contain the point.
    With `shift_m`, shape (m, 3), the frames hold the image of the true point instead, which is the
    apparent one plus the shift.
    """
    survey, views = batch.survey, batch.views
    if not len(survey.cameras):
        return Views(np.zeros(len(batch) + 1, np.int64), np.zeros(0, np.int64))
    order, points = tiling.spatial_order(batch.xyz), batch.chosen()
    frames = frames_of(survey.cameras) if views is None else listed_frames_of(survey.cameras)
    wide = frames if shift_m is None else frames_of(narrower(survey.cameras, -REACH))
    shift = np.zeros((0, 3)) if shift_m is None else shift_m
    tiles = tiling.tiles_of(batch)
    first, count = np.zeros(tiles + 1, np.int64), np.zeros(len(batch) + 1, np.int64)
    if views is None:
        in_tiles(_make_room, tiles, order, points, wide, first)
        begin = np.empty(len(batch), np.int64)
        place = np.empty(np.cumsum(first, out=first)[-1], np.int32)
    else:
        begin = np.asarray(views.start[:-1], np.int64).copy()
        place = np.empty(len(views.camera), np.int32)
    in_tiles(
        _choose_all, tiles, order, points, frames, wide, shift, least_cosine2_of(survey),
        *shapes_of(survey), (first, begin, count, place),
    )  # fmt: skip
    start = np.cumsum(count)
    # tiles left gaps between the entries of their points
    chosen = place[np.repeat(begin - start[:-1], count[1:]) + np.arange(start[-1])].astype(np.int64)
    if views is None:
        return Views(start, chosen)
    weight = None if views.weight is None else views.weight[chosen]
    return Views(start, np.asarray(views.camera)[chosen], weight, views.kind)


def views_in_frame(xyz: FloatArray, cameras: Cameras) -> Views:
    """Return the cameras whose frame holds each point, shape (m, 3), above the water or below."""
    xyz = np.ascontiguousarray(xyz)
    at_themselves = SurfaceAbove(xyz[:, 2].copy(), np.zeros((len(xyz), 2)))
    survey = Survey(WaterPlane(0.0), cameras, ScienceOptions())
    return chosen_views(Batch(xyz, at_themselves, survey))


def near_borders(batch: Batch, shift_m: FloatArray) -> IntArray:
    """Return the points that are imaged in other frames than their apparent points.

    The true points are the apparent ones plus `shift_m`, shape (m, 3).
    """
    survey, found = batch.survey, np.zeros(len(batch), np.bool_)
    frames = (frames_of(narrower(survey.cameras, share)) for share in (0.0, -REACH, REACH))
    in_tiles(
        _find_near_borders, tiling.tiles_of(batch), tiling.spatial_order(batch.xyz), batch.chosen(),
        *frames, shift_m, found, points=len(batch),
    )  # fmt: skip
    return np.flatnonzero(found)


@kernel(allocates=True)
def _make_room(
    span: Span, order: IntArray, points: Chosen, frames: Frames, first: IntArray
) -> None:
    """Set how many entries each tile may get at most, one place on."""
    centres = points.rig.centres
    low, high = tiling.corners_of(order[span[0] * TILE : span[1] * TILE], points.xyz)
    around = tiling.near_cameras(np.arange(len(centres)), frames, centres, low, high)
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        low, high = tiling.corners_of(rows, points.xyz)
        first[t + 1] = rows.size * tiling.near_cameras(around, frames, centres, low, high).size


@kernel(allocates=True)
def _choose_all(
    span: Span, order: IntArray, points: Chosen, frames: Frames, wide: Frames, shift: FloatArray,
    least_cosine2: float, tin: Tin | None, fields: Field | None,
    found: tuple[IntArray, IntArray, IntArray, npt.NDArray[np.int32]],
) -> None:  # fmt: skip
    """Choose the cameras of each point, a tile at a time.

    With shifts the frames hold the images of the true points; the frames `wide` then decide which
    cameras are near a tile. Fills in where the entries of point i begin, how many they are (at
    i + 1), and the entries. An entry is the number of a camera or, with view lists, that of one of
    their entries.
    """
    first, begin, count, place = found
    start, camera, rig = points.start, points.camera, points.rig
    low, high = tiling.corners_of(order[span[0] * TILE : span[1] * TILE], points.xyz)
    some = camera[:0] if start.size else np.arange(len(rig.centres))
    around = tiling.near_cameras(some, wide, rig.centres, low, high)
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        tile, room = np.empty(7 * TILE), np.empty(6 * TILE)
        low, high = tiling.gather(tile, rows, points)
        # without lists `around` has the cameras; the frame test is vectorised over the points
        near = tiling.near_cameras(around, wide, rig.centres, low, high)
        marks, seeing = np.empty((near.size, rows.size)), 0
        if len(shift):
            tiling.gather_three(room, rows, shift)
        for c in near:
            if len(shift):
                is_near = _mark_images(marks[seeing], tile, room, rig, frames, c, points.n)
            else:
                is_near = mark(marks[seeing], tile, TILE, frames, c, rig.centres[c])
            if is_near:
                near[seeing] = c
                seeing += 1
        near = near[:seeing]
        free = first[t]  # the tile has its own stretch of entries
        for j in range(rows.size):
            i = rows[j]
            if start.size:  # the entries of a point stay where they are in the list
                candidates = camera[start[i] : start[i + 1]]
                selected = _choose(
                    candidates, None, tile, j, rig, frames, least_cosine2, tin, fields
                )
                for k in range(selected.size):
                    place[begin[i] + k] = start[i] + selected[k]
            else:
                begin[i] = free
                selected = _choose(near, marks, tile, j, rig, frames, least_cosine2, tin, fields)
                for k in range(selected.size):
                    place[free + k] = near[selected[k]]
                free += selected.size
            count[i + 1] = selected.size


@kernel(allocates=True)
def _find_near_borders(
    span: Span, order: IntArray, points: Chosen, frames: Frames, wide: Frames, inner: Frames,
    shift: FloatArray, found: BoolArray,
) -> None:  # fmt: skip
    """Set which points have an image in other frames than their apparent points."""
    rig = points.rig
    low, high = tiling.corners_of(order[span[0] * TILE : span[1] * TILE], points.xyz)
    around = tiling.near_cameras(np.arange(len(rig.centres)), wide, rig.centres, low, high)
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        tile, room, marks = np.empty(7 * TILE), np.empty(6 * TILE), np.empty((2, rows.size))
        low, high = tiling.gather(tile, rows, points)
        tiling.gather_three(room, rows, shift)
        for c in tiling.near_cameras(around, wide, rig.centres, low, high):
            # most frames hold a tile with all its images: only their borders cost time
            if _encloses(inner, c, rig.centres[c], low, high):
                continue
            mark(marks[0], tile, TILE, frames, c, rig.centres[c])
            _mark_images(marks[1], tile, room, rig, frames, c, points.n)
            for j in range(rows.size):
                if marks[0, j] != marks[1, j]:
                    found[rows[j]] = True


@device
def _encloses(
    frames: Frames, c: int, centre: FloatArray, low: FloatArray, high: FloatArray
) -> bool:
    """Whether the frame of camera c holds all corners of an upright box."""
    for corner in range(8):
        x = high[0] if corner & 1 else low[0]
        y = high[1] if corner & 2 else low[1]
        z = high[2] if corner & 4 else low[2]
        if not holds(frames, c, (centre[0] - x, centre[1] - y, centre[2] - z)):
            return False
    return True


@device
def _mark_images(
    marks: FloatArray, tile: FloatArray, room: FloatArray, rig: Rig, frames: Frames, c: int,
    n: float,
) -> bool:  # fmt: skip
    """Do as `mark` for the images of the true points of a tile, whose shifts are in the room.

    Camera c sees the light of a true point in the direction w = k s - N. So the point at C + w, of
    which there is room for a tile after the shifts, has the same image.
    """
    centre, offset, seen = row_of(rig.centres, c), rig.offset[c], room[3 * TILE :]
    for j in range(marks.size):
        p, normal = three(tile, j), three(tile, 4 * TILE + j)
        e = minus(centre, p)
        # water that stood higher for this image: the point is lowered instead
        h = normal[2] * (tile[3 * TILE + j] - (p[2] - offset))
        k, _, _, _, s = light_near(three(room, j), e, normal, h, n)
        w = minus(scaled(k, s), normal)
        # a camera below the water sees the apparent point
        refracts = dot(normal, e) > h
        seen[j] = centre[0] + (w[0] if refracts else -e[0])
        seen[TILE + j] = centre[1] + (w[1] if refracts else -e[1])
        seen[2 * TILE + j] = centre[2] + (w[2] if refracts else -e[2])
    return mark(marks, seen, TILE, frames, c, rig.centres[c])


@device(allocates=True)
def _choose(
    candidates: IntArray, marks: FloatArray | None, tile: FloatArray, j: int, rig: Rig,
    frames: Frames, least_cosine2: float, tin: Tin | None, fields: Field | None,
) -> npt.NDArray[np.int32]:  # fmt: skip
    """Return the candidates that give a ray to point j of the tile, by their places, in order.

    Their frames were tested before if there are marks. On a mesh or raster the incidence angle is
    that at the piercing point.
    """
    chosen, is_limited = np.empty(candidates.size, np.int32), least_cosine2 > 0.0
    (x, y, z), upward = three(tile, j), three(tile, 4 * TILE + j)
    k = 0
    for at in range(candidates.size):
        c = candidates[at]
        # water that stood higher for this image: the point is lowered instead
        e, lowered = minus(row_of(rig.centres, c), (x, y, z)), (x, y, z - rig.offset[c])
        inside = holds(frames, c, e) if marks is None else marks[at, j] > 0.0
        h = upward[2] * (tile[3 * TILE + j] - lowered[2])
        height, length2 = dot(upward, e), dot(e, e)
        if not (inside and height > h):  # in the frame, and the camera above the water
            continue
        if h > 0.0 and is_limited and (tin is not None or fields is not None):
            _, normal = pierce(c, tin, fields, lowered, e, h, upward)
            height = max(dot(normal, e), 0.0)
        if height * height >= least_cosine2 * length2:
            chosen[k] = at
            k += 1
    return chosen[:k]
