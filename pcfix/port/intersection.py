"""Forward intersection through a housing port, for a cloud taken under water.

The lens gives the direction of an image place; the port refracts that ray at its faces; behind the
outer face it goes straight through the water. The rays of several images meet at the true point.
There is no water surface between camera and point, and the direction of up does not matter.

A dense cloud has no image places, but its points stand for them: software without a port model puts
the point P where straight lines from the projection centres meet best. So the line from a centre C
to P has the direction of the image place, except for the residual of that adjustment. Through a
flat port that residual is large, a hundred pixels and more if many images of a camera calibrated in
air see a point. The method `consistent` (`pcfix.port.methods`) uses it, `snell` does not.

Which images contributed to P matters as much. Without a view list it is a set of images whose
frames hold the image of the true point that they lead to. There may be several such sets; then the
point may be wrong.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, minus, plus, row_of, scaled, times, transposed_times
from pcfix.lens.frames import Frames, frames_of, holds, no_frames
from pcfix.lens.imaging import lens_table
from pcfix.model import NOMINAL_WIDTH_PX, Cameras, FloatArray, IntArray, Lens, Outcome, Views
from pcfix.options.correct import ScienceOptions
from pcfix.port.light import coefficients, cosine_at_port, light_through, ray_through
from pcfix.port.shapes import Port
from pcfix.refract.batch import CORRECTED, NO_CAMERA, ONE_CAMERA, PARALLEL, Intersection
from pcfix.refract.choice import ANY_NUMBER, NOMINAL_FOCAL_PX
from pcfix.refract.rays import NO_LINE, nearest_point, plus_line
from pcfix.refract.tiling import TILE, corners_of, near_cameras, spatial_order

_MISS, _COSINE, _OUTCOME = 3, 4, 5
"""Columns of the result after the shift."""


class Rig(NamedTuple):
    """The k cameras and the port before each of them, for kernels."""

    centres: FloatArray  # (k, 3), metres, world frame
    rotations: FloatArray  # (k, 3, 3), world to camera
    row: IntArray  # lens of each camera, see `pcfix.lens.imaging.lens_table`
    lenses: FloatArray
    port: FloatArray  # see `pcfix.port.light.coefficients`
    n: float  # refractive index of the water


def lenses_of(cameras: Cameras) -> tuple[Lens, ...]:
    """Return the lenses of cameras, or those of a survey drone."""
    nominal = Lens(NOMINAL_FOCAL_PX, NOMINAL_WIDTH_PX, NOMINAL_WIDTH_PX, 0.0, 0.0)
    return cameras.lenses or (nominal,) * len(cameras)


def rig_of(cameras: Cameras, port: Port, settings: ScienceOptions) -> Rig:
    """Return the cameras and their port for kernels."""
    return Rig(
        np.ascontiguousarray(cameras.centres),
        np.ascontiguousarray(rotations_of(cameras)),
        *lens_table(lenses_of(cameras)),
        coefficients(port),
        settings.refractive_index,
    )


def intersect_rays(
    near: FloatArray,
    directions: FloatArray,
    views: Views,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
) -> Intersection:
    """Intersect rays behind the port: forward intersection from places in the images.

    Parameters
    ----------
    near : array, shape (m, 3)
        A place near each point, metres, world frame, as its apparent one; origin of its shift.
    directions : array, shape (o, 3)
        Directions of the image places, one row per entry of ``views.camera``, camera frame, any
        length; see `pcfix.lens.imaging.unproject`.
    views : Views
        The cameras of each point.
    cameras, port, settings
        See `pcfix.port.methods.intersect_through_port`.

    Returns
    -------
    Intersection
        One row per point. A ray that does not meet the port is ignored.
    """
    result = np.zeros((len(near), 6))
    in_tiles(
        _intersect,
        len(near),
        np.ascontiguousarray(near, np.float64),
        np.ascontiguousarray(directions, np.float64),
        np.ascontiguousarray(views.start, np.int64),
        np.ascontiguousarray(views.camera, np.int64),
        rig_of(cameras, port, settings),
        result,
    )
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    counts = np.diff(views.start)
    used = np.zeros(len(cameras), np.bool_)
    used[views.camera[np.repeat(moved, counts)]] = True
    angle = np.degrees(np.arccos(np.clip(result[:, _COSINE], 0.0, 1.0)))
    return Intersection(
        shift_m=result[:, :3],
        outcome=outcome,
        ray_count=np.where(moved, counts, 0).astype(np.int32),
        ray_miss_m=result[:, _MISS],
        sigma_z_m=np.zeros(len(near)),
        incidence_deg=np.where(moved, angle, 0.0),
        camera_used=used,
    )


def port_views(
    xyz: FloatArray,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    views: Views | None = None,
    shift_m: FloatArray | None = None,
) -> Views:
    """Return the cameras whose rays are used for each point, in the order of the cameras or views.

    The parameters are those of `pcfix.port.methods.intersect_through_port`. With `shift_m`, shape
    (m, 3), to the true points and without `views`, the images of these through the port must be in
    the frame, instead of those of the apparent points along straight lines.
    """
    limit, start, camera = settings.limit_deg, np.zeros(0, np.int64), np.zeros(0, np.int64)
    if views is not None:
        start, camera = np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64)
    common = (
        spatial_order(xyz),
        np.ascontiguousarray(xyz if shift_m is None else xyz + shift_m),
        np.zeros(0) if shift_m is None else np.abs(shift_m).max(axis=1),
        rig_of(cameras, port, settings),
        frames_of(cameras) if views is None else no_frames(len(cameras)),
        (start, camera),
        (
            0.0 if limit is None else float(np.cos(np.radians(limit))),
            settings.max_cameras or ANY_NUMBER,
        ),
    )
    tiles, count = (len(xyz) + TILE - 1) // TILE, np.zeros(len(xyz) + 1, np.int64)
    in_tiles(_choose, tiles, *common, (count, np.zeros(0, np.int64)))
    found = np.cumsum(count)
    chosen = np.empty(found[-1], np.int64)
    in_tiles(_choose, tiles, *common, (found, chosen))
    return Views(found, chosen)


def rotations_of(cameras: Cameras) -> FloatArray:
    """Return the rotations of cameras, shape (k, 3, 3); SettingError ``cameras.no_angles``."""
    if cameras.rotations is None:
        raise SettingError(
            "cameras.no_angles",
            "A port is fixed to the camera, and the cameras have no angles. Give a camera file with"
            " angles.",
        )
    return np.asarray(cameras.rotations, np.float64)


@kernel(allocates=True)
def _choose(
    span: Span, order: IntArray, xyz: FloatArray, shift: FloatArray, rig: Rig, frames: Frames,
    views: tuple[IntArray, IntArray], limits: tuple[float, int], found: tuple[IntArray, IntArray],
) -> None:  # fmt: skip
    """Write the cameras of point i from ``chosen[start[i]]``, or count them in ``start[i + 1]``.

    They are counted if `chosen` is empty. Views and shifts are empty if there are none.
    """
    start, chosen = found
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        near = rows[:0]
        if not views[0].size:
            low, high = corners_of(rows, xyz)
            # the straight line to a true point may miss a frame that its refracted light reaches,
            # by at most the shift
            wide = shift[rows].max() if shift.size else 0.0
            near = near_cameras(
                np.arange(len(rig.centres)), frames, rig.centres, low - wide, high + wide
            )
        for i in rows:
            candidates = near
            if views[0].size:
                candidates = views[1][views[0][i] : views[0][i + 1]]
            kept = _usable(candidates, row_of(xyz, i), rig, frames, limits, shift.size > 0)
            if chosen.size:
                chosen[start[i] : start[i] + kept.size] = kept
            else:
                start[i + 1] = kept.size


@device(allocates=True)
def _usable(
    candidates: IntArray, point: Vector, rig: Rig, frames: Frames, limits: tuple[float, int],
    through: bool,
) -> IntArray:  # fmt: skip
    """Return the cameras that give a ray, in their order: at most `most`, the steepest.

    The point is imaged along a straight line, or `through` the port.
    """
    least_cosine, most = limits
    kept, cosine = np.empty(candidates.size, np.int64), np.empty(candidates.size)
    k = 0
    for c in candidates:
        r, x = rig.rotations[c], minus(point, row_of(rig.centres, c))
        w = times(r, x)
        if through:
            w = light_through(rig.port, rig.n, *w)
            x = transposed_times(r, w)
        steep = cosine_at_port(rig.port, *w)
        if steep > 0.0 and steep >= least_cosine and holds(frames, c, scaled(-1.0, x)):
            kept[k], cosine[k] = c, steep
            k += 1
    if k <= most:
        return kept[:k]
    ranked = np.argsort(-cosine[:k], kind="mergesort")[:most]
    ranked.sort()
    return kept[ranked]


@kernel
def _intersect(
    span: Span, near: FloatArray, directions: FloatArray, start: IntArray, camera: IntArray,
    rig: Rig, result: FloatArray,
) -> None:  # fmt: skip
    """Intersect the rays of each point; the place near it is the origin."""
    for i in range(*span):
        sums, least, k, row = NO_LINE, 1.0, 0, result[i]
        for o in range(start[i], start[i + 1]):
            r, d = rig.rotations[camera[o]], row_of(directions, o)
            ray = ray_through(rig.port, rig.n, *d)
            if np.isnan(ray[0] + ray[3]):
                continue
            away = minus(row_of(rig.centres, camera[o]), row_of(near, i))
            a, t = plus(transposed_times(r, ray[:3]), away), transposed_times(r, ray[3:])
            k, sums = k + 1, plus_line(sums, a, t, 1.0)
            least = min(least, cosine_at_port(rig.port, *d))
        solved, q, distance = nearest_point(float(k), sums)
        if k < 2:
            row[_OUTCOME] = ONE_CAMERA if k == 1 else NO_CAMERA
        elif not solved:
            row[_OUTCOME] = PARALLEL
        else:
            row[0], row[1], row[2] = q
            row[_MISS], row[_COSINE], row[_OUTCOME] = distance, least, CORRECTED
