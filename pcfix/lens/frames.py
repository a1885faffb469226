"""Test whether points, or whole tiles of points, lie in the frames of cameras.

The frame of a central projection without distortion is a pyramid with its tip in the projection
centre: a point is in the frame if it is on the inner side of its four planes.

A distorted frame has curved sides, and the point has to be projected, except for tiles outside a
pyramid and a cone around the frame.

The border of the image is unprojected densely. If all of it has directions, what it encloses is
the frame, as a lens is used only where it is one to one.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, dot, minus, row_of, scaled, times
from pcfix.lens.formulas import DISC, HEIGHT, LARGEST_ANGLE, PLAIN, WIDTH, angle
from pcfix.lens.imaging import (
    coefficients,
    image_of,
    lens_table,
    plain_image,
    plain_lens,
    unproject,
)
from pcfix.model import Cameras, FloatArray, IntArray, Lens, Views


@lru_cache(maxsize=8192)
def frame_shape(lens: Lens) -> tuple[FloatArray, float]:
    """Return the pyramid of `Frames`, camera frame, and the widest angle of a distorted frame."""
    brown = (*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism)
    if lens.projection == "perspective" and not any(brown):  # straight lines stay straight
        corners = unproject(lens, _border(lens, 1))
        return np.cross(corners[:-1], corners[1:]), np.nan
    border = unproject(lens, _border(lens, BORDER))
    return _planes_around(border), _widest_angle(lens, border)


BORDER = 400
"""Points along each side of a frame, which is nearly straight between neighbours."""

STEEPEST = np.cos(np.radians(80.0))
"""A pyramid with flatter sides would be too wide to exclude anything."""


def _border(lens: Lens, count: int) -> FloatArray:
    """Return points around the image, `count` a side, the first one again at the end."""
    w, h = lens.width, lens.height
    corners = np.array([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h), (0.0, 0.0)])
    share = np.linspace(0.0, 1.0, count, endpoint=False)[:, None]
    sides = [(1.0 - share) * corners[i] + share * corners[i + 1] for i in range(4)]
    return np.vstack([*sides, corners[:1]])


def _widest_step(points: FloatArray) -> float:
    """Return the largest distance between neighbours: a curve deviates less from its points."""
    return float(np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=1).max()))


def _planes_around(border: FloatArray) -> FloatArray:
    """Return a pyramid around the directions of the border, shape (4, 3)."""
    if not (border[:, 2] > STEEPEST).all():
        return np.zeros((4, 3))
    flat = border[:, :2] / border[:, 2:]
    step = _widest_step(flat)
    (left, top), (right, bottom) = flat.min(axis=0) - step, flat.max(axis=0) + step
    return np.array([
        (1.0, 0.0, -left), (-1.0, 0.0, right), (0.0, 1.0, -top), (0.0, -1.0, bottom),
    ])  # fmt: skip


def _widest_angle(lens: Lens, border: FloatArray) -> float:
    """Return an angle from the axis that no direction in the frame exceeds, radians."""
    if np.isfinite(border).all():
        widest = float(np.arccos(np.clip(border[:, 2].min(), -1.0, 1.0)))
        return widest + 2.0 * _widest_step(border)
    c = coefficients(lens)
    widest = float(angle(c, c[DISC] + np.hypot(*lens.distortion_centre)))
    if lens.inverse or np.isnan(widest):
        widest = float(c[LARGEST_ANGLE])
    return widest + 1e-6


Pyramid: TypeAlias = tuple[Vector, Vector, Vector, Vector]

NOT_DISTORTED = -1


class Frames(NamedTuple):
    """The frames of k cameras; directions are in the world frame."""

    planes: FloatArray  # (k, 4, 3), inward normals of the pyramid that is, or encloses, the frame
    row: IntArray  # (k,), lens of each camera; `NOT_DISTORTED` if the pyramid is the frame
    cone: FloatArray  # (k, 4), an axis, and the largest angle (rad) of the frame from it
    lenses: FloatArray  # (l, ...), coefficients, one row per lens
    rotations: FloatArray  # (k, 3, 3), world to camera


def no_frames(k: int) -> Frames:
    """Return frames of k cameras that hold every point: planes of zeros do."""
    return Frames(
        planes=np.zeros((k, 4, 3)),
        row=np.full(k, NOT_DISTORTED),
        cone=np.zeros((k, 4)),
        lenses=np.zeros((1, 1)),
        rotations=np.zeros((k, 3, 3)),
    )


def frames_of(cameras: Cameras) -> Frames:
    """Return the frames of cameras.

    Without lenses a frame is everything in front of the camera, without angles everything.
    """
    if cameras.rotations is None:
        return no_frames(len(cameras))
    rotations = np.ascontiguousarray(cameras.rotations, np.float64)
    if cameras.lenses is None:
        front = np.repeat(rotations[:, 2:3], 4, axis=1)
        return no_frames(len(cameras))._replace(planes=front)
    row, lenses = lens_table(cameras.lenses)
    shapes = [frame_shape(lens) for lens in dict.fromkeys(cameras.lenses)]
    planes, widest = (np.array(one)[row] for one in zip(*shapes, strict=True))
    return Frames(
        planes=np.ascontiguousarray(planes @ rotations),
        row=np.where(np.isnan(widest), NOT_DISTORTED, row),
        cone=np.column_stack([rotations[:, 2], widest]),
        lenses=lenses,
        rotations=rotations,
    )


BESIDE = 1.0
"""A view list may name a camera whose frame misses the point by at most this times its longer side.

An apparent point is some pixels from its image. Much farther outside the distortion is
extrapolated, and the search of a true point may fail: of 40,000 points of simulated scenes 47 were
up to 41 m off, all of them imaged more than eight lengths outside.
"""


def listed_frames_of(cameras: Cameras) -> Frames:
    """Return the widened frames for points of a view list.

    Those of cameras without lenses or angles hold everything: no method projects into them.
    """
    if cameras.rotations is None or cameras.lenses is None:
        return no_frames(len(cameras))
    return frames_of(narrower(cameras, -BESIDE))


def narrower(cameras: Cameras, share: float) -> Cameras:
    """Return cameras with frames narrower on each side by a share of their longer side."""
    lenses = cameras.lenses or ()
    narrow = {one: with_border(one, share * max(one.width, one.height)) for one in set(lenses)}
    return replace(cameras, lenses=tuple(narrow[one] for one in lenses))


def with_border(lens: Lens, border: float) -> Lens:
    """Return a lens whose frame is narrower by a border on each side, in its unit."""
    return replace(
        lens,
        width=lens.width - 2.0 * border,
        height=lens.height - 2.0 * border,
        principal_x=lens.principal_x - border,
        principal_y=lens.principal_y - border,
    )


@device
def pyramid(g: FloatArray) -> Pyramid:
    """Return the planes of one camera, shape (4, 3), as numbers, which stay in registers."""
    return row_of(g, 0), row_of(g, 1), row_of(g, 2), row_of(g, 3)


@device
def in_frame(g: Pyramid, e: Vector) -> bool:
    """Whether the point at C - e is on the inner side of all four planes."""
    return (
        (dot(g[0], e) <= 0.0)
        & (dot(g[1], e) <= 0.0)
        & (dot(g[2], e) <= 0.0)
        & (dot(g[3], e) <= 0.0)
    )


@device
def _images(lens: FloatArray, r: FloatArray, e: Vector) -> bool:
    """Whether the point at C - e is in the frame of a lens with rotation r."""
    u, v = image_of(lens, *scaled(-1.0, times(r, e)))
    return (u >= 0.0) & (u <= lens[WIDTH]) & (v >= 0.0) & (v <= lens[HEIGHT])


@device
def holds(frames: Frames, c: int, e: Vector) -> bool:
    """Whether the frame of camera c holds the point at C - e, distortion included."""
    if not in_frame(pyramid(frames.planes[c]), e):
        return False
    row = frames.row[c]
    return row == NOT_DISTORTED or _images(frames.lenses[row], frames.rotations[c], e)


@device
def mark(
    marks: FloatArray, points: FloatArray, run: int, frames: Frames, c: int,
    centre: FloatArray | Vector,
) -> bool:  # fmt: skip
    """Set to 1 the marks of points in the frame of camera c, to 0 those of others.

    The points are runs of `run` x, y and z. It is `holds` for many of them; returns whether the
    frame may hold any.
    """
    around, row = pyramid(frames.planes[c]), frames.row[c]
    if row == NOT_DISTORTED:
        for j in range(marks.size):
            e = centre[0] - points[j], centre[1] - points[run + j], centre[2] - points[2 * run + j]
            marks[j] = 1.0 if in_frame(around, e) else 0.0
        return True
    lens, r, count = frames.lenses[row], frames.rotations[c], 0
    plain = plain_lens(lens)
    # only one of the two loops runs; with the choice inside, the first would not be vectorised
    for j in range(marks.size if lens[PLAIN] != 0.0 else 0):
        way = points[j] - centre[0], points[run + j] - centre[1], points[2 * run + j] - centre[2]
        u, v, _ = plain_image(plain, times(r, way))
        inside = (u >= 0.0) & (u <= lens[WIDTH]) & (v >= 0.0) & (v <= lens[HEIGHT])
        marks[j] = 1.0 if inside else 0.0
        count += 1 if inside else 0
    for j in range(marks.size if lens[PLAIN] == 0.0 else 0):
        e = centre[0] - points[j], centre[1] - points[run + j], centre[2] - points[2 * run + j]
        inside = in_frame(around, e) and _images(lens, r, e)
        marks[j] = 1.0 if inside else 0.0
        count += 1 if inside else 0
    return count > 0


@device
def may_hold(frames: Frames, c: int, centre: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether the frame of camera c may hold a point of an upright box; never wrongly False."""
    for p in range(4):
        reach, inward = 0.0, row_of(frames.planes[c], p)
        for axis in range(3):
            corner = high[axis] if inward[axis] > 0.0 else low[axis]
            reach += inward[axis] * (corner - centre[axis])
        if reach < 0.0:
            return False
    # a distorted frame is narrower than its pyramid; the camera sees the ball around the box
    # within the angle `turn` about its middle
    if frames.row[c] == NOT_DISTORTED:
        return True
    e = (
        centre[0] - 0.5 * (low[0] + high[0]),
        centre[1] - 0.5 * (low[1] + high[1]),
        centre[2] - 0.5 * (low[2] + high[2]),
    )
    far2 = dot(e, e)
    size2 = (high[0] - low[0]) ** 2 + (high[1] - low[1]) ** 2 + (high[2] - low[2]) ** 2
    if not 0.25 * size2 < far2:
        return True
    turn = np.arcsin(np.sqrt(0.25 * size2 / far2)) + 1e-6
    along = -dot(row_of(frames.cone, c), e) / np.sqrt(far2)
    return bool(np.arccos(max(-1.0, min(1.0, along))) <= frames.cone[c, 3] + turn)


BORDER_POINTS = 8
"""Points on each side of a footprint, enough to show the curve of a distorted frame."""


def cameras_in_sight(xyz: FloatArray, cameras: Cameras) -> IntArray:
    """Return how many cameras have each point, (n, 3), in their frame; occlusion is ignored."""
    none = np.zeros(0, np.int64)
    return _count_held(xyz, cameras, frames_of(cameras), none, none)


def beside_frames(xyz: FloatArray, views: Views, cameras: Cameras) -> IntArray:
    """Return the number of cameras in the view list of each point, (n, 3), that cannot image it."""
    start, camera = np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64)
    held = _count_held(xyz, cameras, listed_frames_of(cameras), start, camera)
    return np.asarray(np.diff(start) - held)


def _count_held(
    xyz: FloatArray, cameras: Cameras, frames: Frames, start: IntArray, camera: IntArray
) -> IntArray:
    """Return how many cameras, of the lists if there are any, hold each point."""
    counts = np.zeros(len(xyz), np.int64)
    points = np.ascontiguousarray(xyz)
    in_tiles(_count, len(xyz), points, start, camera, cameras.centres, frames, counts)
    return counts


@kernel
def _count(
    span: Span, xyz: FloatArray, start: IntArray, camera: IntArray, centres: FloatArray,
    frames: Frames, counts: IntArray,
) -> None:  # fmt: skip
    for i in range(*span):
        first, last = (start[i], start[i + 1]) if start.size else (0, len(centres))
        for at in range(first, last):
            c = camera[at] if start.size else at
            counts[i] += holds(frames, c, minus(row_of(centres, c), row_of(xyz, i)))


def footprint(cameras: Cameras, row: int, height_m: float) -> FloatArray:
    """Return the border of a frame on a level (world Z), shape (p, 2); NaN above the horizon."""
    if cameras.rotations is None or cameras.lenses is None:
        return np.zeros((0, 2))
    lens = cameras.lenses[row]
    rays = unproject(lens, _border(lens, BORDER_POINTS)[:-1]) @ cameras.rotations[row]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (height_m - cameras.centres[row, 2]) / rays[:, 2]
    reach = np.where(reach > 0.0, reach, np.nan)
    return np.asarray(cameras.centres[row, :2] + reach[:, None] * rays[:, :2])
