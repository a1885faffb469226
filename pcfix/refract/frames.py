"""Which cameras have a point in their frame, and which can have one of a whole tile.

The frame of a central projection without distortion is a pyramid with its tip in the
projection centre. Four planes bound it; a point is in the frame when it is on the inner side of
all four.

A distorted frame has curved sides. It gets two pyramids: one around it, outside of which there
is nothing of the frame, and one within it, inside of which there is nothing else. Only between
them the point is projected. A frame too wide for a pyramid gets a cone around it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numba import njit

from pcfix.refract.lens import coefficients, image_of, project, unproject
from pcfix.refract.places import (
    B2,
    B3,
    CENTRE_X,
    CENTRE_Y,
    DISC,
    FOCAL_X,
    FOCAL_Y,
    HEIGHT,
    LARGEST_ANGLE,
    PLAIN,
    PRINCIPAL_X,
    PRINCIPAL_Y,
    TAIL,
    TANGENTIAL,
    WIDTH,
)
from pcfix.refract.projections import angle

if TYPE_CHECKING:
    from pcfix.model import Cameras, FloatArray, IntArray, Lens

Plane: TypeAlias = tuple[float, float, float]
Pyramid: TypeAlias = tuple[Plane, Plane, Plane, Plane]

EVERYWHERE = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""A pyramid that holds every point."""

NOT_DISTORTED = -1


class Frames(NamedTuple):
    """The frames of k cameras; directions are in the world frame.

    `outer` and `inner`, shape (k, 4, 3), are the inward normals of the pyramids around and
    within each frame. `row` is the lens of each camera in the table of `coefficients`, or
    `NOT_DISTORTED`: then `outer` is the frame itself. `cone`, shape (k, 4), is an axis and the
    angle (rad) from it that nothing of the frame exceeds. An outer pyramid of zeros holds
    everything, an inner one nothing.
    """

    outer: FloatArray
    inner: FloatArray
    cone: FloatArray
    row: IntArray
    lenses: FloatArray
    rotations: FloatArray


class _Shape(NamedTuple):
    """The frame of one lens, camera frame; see `Frames`."""

    outer: FloatArray
    inner: FloatArray
    widest: float
    distorted: bool


def no_frames(k: int) -> Frames:
    """Return frames of k cameras that hold every point."""
    nothing = np.zeros((k, 4, 3))
    row = np.full(k, NOT_DISTORTED)
    return Frames(nothing, nothing, np.zeros((k, 4)), row, np.zeros((1, 1)), np.zeros((k, 3, 3)))


def frames_of(cameras: Cameras) -> Frames:
    """Return the frames of cameras.

    Without lenses a frame is everything in front of the camera, without angles everything.
    """
    k = len(cameras)
    if cameras.rotations is None:
        return no_frames(k)
    rotations = np.ascontiguousarray(cameras.rotations, np.float64)
    if cameras.lenses is None:
        front = np.repeat(rotations[:, 2:3], 4, axis=1)
        return no_frames(k)._replace(outer=front, rotations=rotations)
    rows: dict[Lens, int] = {}
    row = np.array([rows.setdefault(lens, len(rows)) for lens in cameras.lenses])
    shapes = [_shape(lens) for lens in rows]
    return Frames(
        outer=np.ascontiguousarray(np.array([s.outer for s in shapes])[row] @ rotations),
        inner=np.ascontiguousarray(np.array([s.inner for s in shapes])[row] @ rotations),
        cone=np.column_stack([rotations[:, 2], np.array([s.widest for s in shapes])[row]]),
        row=np.where(np.array([s.distorted for s in shapes])[row], row, NOT_DISTORTED),
        lenses=_table(list(rows)),
        rotations=rotations,
    )


def _table(lenses: list[Lens]) -> FloatArray:
    """Return the coefficients of lenses, one row each, padded with zeros."""
    rows = [coefficients(lens) for lens in lenses]
    table = np.zeros((len(rows), max(map(len, rows))))
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table


@lru_cache(maxsize=8192)
def _shape(lens: Lens) -> _Shape:
    """Return the pyramids of a lens and the largest angle of its frame from the axis."""
    if _is_a_pyramid(lens):
        return _Shape(_frame_planes(lens), np.zeros((4, 3)), np.pi, distorted=False)
    border = unproject(lens, _border(np.zeros(2), np.array([lens.width, lens.height])))
    flat = _in_tangent_plane(border)
    outer = np.zeros((4, 3))
    if np.isfinite(flat).all():
        outer = _box_planes(*_box_around(flat))
    return _Shape(outer, _inner_planes(lens, flat), _widest_angle(lens, border), distorted=True)


def _is_a_pyramid(lens: Lens) -> bool:
    """Whether straight lines stay straight."""
    brown = (*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism)
    return lens.projection == "perspective" and not any(brown)


def _frame_planes(lens: Lens) -> FloatArray:
    """Return the inward normals of the frame of a lens without distortion, shape (4, 3)."""
    width, height = lens.width - lens.principal_x, lens.height - lens.principal_y
    return np.array([
        (lens.focal + lens.b1, lens.b2, lens.principal_x),
        (-(lens.focal + lens.b1), -lens.b2, width),
        (lens.b3, lens.focal, lens.principal_y),
        (-lens.b3, -lens.focal, height),
    ])  # fmt: skip


BORDER = 400
"""Points along each side of a frame; between neighbours it is taken to be nearly straight."""

STEEPEST = np.cos(np.radians(80.0))
"""A pyramid with flatter sides would be too long to be of use."""


def _border(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return points around a rectangle: top, right, bottom, left, and the first one again."""
    (left, top), (right, bottom) = low, high
    corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)])
    share = np.linspace(0.0, 1.0, BORDER, endpoint=False)[:, None]
    sides = [(1.0 - share) * corners[i] + share * corners[i + 1] for i in range(4)]
    return np.vstack([*sides, corners[:1]])


def _in_tangent_plane(directions: FloatArray) -> FloatArray:
    """Return X / Z and Y / Z, NaN for directions that are too flat."""
    z = np.where(directions[:, 2:] > STEEPEST, directions[:, 2:], np.nan)
    return np.asarray(directions[:, :2] / z)


def _widest_step(points: FloatArray) -> float:
    """Return the largest distance between neighbours; a curve strays less from its points."""
    return float(np.hypot(*np.diff(points, axis=0).T).max())


def _box_around(flat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest corner of a box around a curve and what it encloses."""
    step = _widest_step(flat)
    return flat.min(axis=0) - step, flat.max(axis=0) + step


def _box_planes(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the inward normals of the pyramid through a box in the tangent plane."""
    (left, top), (right, bottom) = low, high
    return np.array([(1.0, 0.0, -left), (-1.0, 0.0, right), (0.0, 1.0, -top), (0.0, -1.0, bottom)])


def _inner_planes(lens: Lens, flat: FloatArray) -> FloatArray:
    """Return a pyramid within the frame, zeros where none is found.

    Its box touches the sides of the frame from within, and then shrinks towards the middle
    until the image of its border lies inside the frame: then that of its inside does as well.
    """
    low, high = _box_within(flat)
    size = np.array([lens.width, lens.height])
    middle = _in_tangent_plane(unproject(lens, size[None] / 2.0))[0]
    for scale in 0.98 ** np.arange(1, 100):
        left, right = middle + scale * (low - middle), middle + scale * (high - middle)
        border = _border(left, right)
        image = project(lens, np.column_stack([border, np.ones(len(border))]))
        step = _widest_step(image)
        if (left < right).all() and (image >= step).all() and (image <= size - step).all():
            return _box_planes(left, right)
    return np.zeros((4, 3))


def _box_within(flat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest corner of a box that the sides of a frame leave free."""
    top, right, bottom, left = (flat[i * BORDER : (i + 1) * BORDER + 1] for i in range(4))
    far = np.sqrt(0.5 / STEEPEST**2 - 0.5)  # such that the corners of a box are not too flat
    low = np.fmax(-far, [np.fmax.reduce(left[:, 0]), np.fmax.reduce(top[:, 1])])
    high = np.fmin(far, [np.fmin.reduce(right[:, 0]), np.fmin.reduce(bottom[:, 1])])
    return low, high


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


@njit(cache=True, error_model="numpy", nogil=True)
def pyramid(g: FloatArray) -> Pyramid:
    """Return the planes of one camera, shape (4, 3), as twelve numbers.

    As numbers they stay in registers; as an array they would be read again for every point.
    """
    return (
        (g[0, 0], g[0, 1], g[0, 2]),
        (g[1, 0], g[1, 1], g[1, 2]),
        (g[2, 0], g[2, 1], g[2, 2]),
        (g[3, 0], g[3, 1], g[3, 2]),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def in_frame(g: Pyramid, ex: float, ey: float, ez: float) -> bool:
    """Whether the point at C - e is on the inner side of all four planes."""
    return (
        (g[0][0] * ex + g[0][1] * ey + g[0][2] * ez <= 0.0)
        & (g[1][0] * ex + g[1][1] * ey + g[1][2] * ez <= 0.0)
        & (g[2][0] * ex + g[2][1] * ey + g[2][2] * ez <= 0.0)
        & (g[3][0] * ex + g[3][1] * ey + g[3][2] * ez <= 0.0)
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _well_inside(g: Pyramid, ex: float, ey: float, ez: float) -> bool:
    """Whether the point at C - e is inside and on none of the planes."""
    return (
        (g[0][0] * ex + g[0][1] * ey + g[0][2] * ez < 0.0)
        & (g[1][0] * ex + g[1][1] * ey + g[1][2] * ez < 0.0)
        & (g[2][0] * ex + g[2][1] * ey + g[2][2] * ez < 0.0)
        & (g[3][0] * ex + g[3][1] * ey + g[3][2] * ez < 0.0)
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _images(lens: FloatArray, r: FloatArray, ex: float, ey: float, ez: float) -> bool:
    """Whether a lens with rotation r images the point at C - e in its frame."""
    u, v = image_of(
        lens,
        -(r[0, 0] * ex + r[0, 1] * ey + r[0, 2] * ez),
        -(r[1, 0] * ex + r[1, 1] * ey + r[1, 2] * ez),
        -(r[2, 0] * ex + r[2, 1] * ey + r[2, 2] * ez),
    )
    return (u >= 0.0) & (u <= lens[WIDTH]) & (v >= 0.0) & (v <= lens[HEIGHT])


@njit(cache=True, error_model="numpy", nogil=True)
def holds(frames: Frames, c: int, ex: float, ey: float, ez: float) -> bool:
    """Whether the frame of camera c holds the point at C - e, distortion included."""
    if not in_frame(pyramid(frames.outer[c]), ex, ey, ez):
        return False
    if frames.row[c] == NOT_DISTORTED or _well_inside(pyramid(frames.inner[c]), ex, ey, ez):
        return True
    return _images(frames.lenses[frames.row[c]], frames.rotations[c], ex, ey, ez)


@njit(cache=True, error_model="numpy", nogil=True)
def mark(
    marks: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray,
    centre: FloatArray, frames: Frames, c: int,
) -> int:  # fmt: skip
    """Set to 1 the marks of points in the distorted frame of camera c, to 0 those of others.

    Returns how many are in it. It does to many points what `holds` does to one.
    """
    lens = frames.lenses[frames.row[c]]
    if lens[PLAIN] != 0.0:
        return _mark_plain(marks, x, y, z, centre, frames.rotations[c], lens)
    outer, inner = pyramid(frames.outer[c]), pyramid(frames.inner[c])
    return _mark_any(marks, x, y, z, centre, outer, inner, frames.rotations[c], lens)


@njit(cache=True, error_model="numpy", nogil=True)
def _mark_any(
    marks: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray, centre: FloatArray,
    outer: Pyramid, inner: Pyramid, r: FloatArray, lens: FloatArray,
) -> int:  # fmt: skip
    """Any lens: the pyramids decide where they can."""
    count = 0
    for j in range(marks.size):
        ex, ey, ez = centre[0] - x[j], centre[1] - y[j], centre[2] - z[j]
        inside = in_frame(outer, ex, ey, ez)
        if inside and not _well_inside(inner, ex, ey, ez):
            inside = _images(lens, r, ex, ey, ez)
        marks[j] = 1.0 if inside else 0.0
        count += 1 if inside else 0
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _mark_plain(
    marks: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray, centre: FloatArray,
    r: FloatArray, c: FloatArray,
) -> int:  # fmt: skip
    """The common lens: `image_of` written out without branches, for several points at once."""
    cx, cy, cz = centre[0], centre[1], centre[2]
    xx, xy, xz, yx, yy, yz = r[0, 0], r[0, 1], r[0, 2], r[1, 0], r[1, 1], r[1, 2]
    zx, zy, zz = r[2, 0], r[2, 1], r[2, 2]
    k1, k2, k3, k4 = c[TAIL], c[TAIL + 1], c[TAIL + 2], c[TAIL + 3]
    p1, p2, px, py = c[TANGENTIAL], c[TANGENTIAL + 1], c[CENTRE_X], c[CENTRE_Y]
    disc2 = c[DISC] * c[DISC]
    fx, b2, b3, fy = c[FOCAL_X], c[B2], c[B3], c[FOCAL_Y]
    u0, v0, width, height = c[PRINCIPAL_X], c[PRINCIPAL_Y], c[WIDTH], c[HEIGHT]
    count = 0
    for j in range(marks.size):
        ex, ey, ez = cx - x[j], cy - y[j], cz - z[j]
        front = -(zx * ex + zy * ey + zz * ez)
        a = -(xx * ex + xy * ey + xz * ez) / front - px
        b = -(yx * ex + yy * ey + yz * ez) / front - py
        r2 = a * a + b * b
        g = 1.0 + (((k4 * r2 + k3) * r2 + k2) * r2 + k1) * r2
        da = g * a + (p1 * (r2 + 2.0 * a * a) + 2.0 * p2 * a * b) + px
        db = g * b + (p2 * (r2 + 2.0 * b * b) + 2.0 * p1 * a * b) + py
        u = u0 + fx * da + b2 * db
        v = v0 + fy * db + b3 * da
        inside = (u >= 0.0) & (u <= width) & (v >= 0.0) & (v <= height)
        inside &= (front > 0.0) & (r2 <= disc2)
        marks[j] = 1.0 if inside else 0.0
        count += 1 if inside else 0
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def may_hold(g: FloatArray, centre: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether a pyramid can hold any point of an upright box; never wrongly False."""
    for p in range(4):
        reach = 0.0
        for axis in range(3):
            corner = high[axis] if g[p, axis] > 0.0 else low[axis]
            reach += g[p, axis] * (corner - centre[axis])
        if reach < 0.0:
            return False
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def may_reach(cone: FloatArray, centre: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether a cone can hold any point of the ball around a box; never wrongly False."""
    far2, ball2, along = 0.0, 0.0, 0.0
    for axis in range(3):
        middle = 0.5 * (low[axis] + high[axis]) - centre[axis]
        far2 += middle * middle
        ball2 += 0.25 * (high[axis] - low[axis]) ** 2
        along += middle * cone[axis]
    if ball2 >= far2:
        return True
    off_axis = np.arccos(max(-1.0, min(1.0, along / np.sqrt(far2))))
    return off_axis <= cone[3] + np.arcsin(np.sqrt(ball2 / far2)) + 1e-6


@njit(cache=True, error_model="numpy", nogil=True)
def surely_holds(g: FloatArray, centre: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether a pyramid holds all of an upright box; one of zeros never does."""
    for p in range(4):
        reach = 0.0
        for axis in range(3):
            corner = low[axis] if g[p, axis] > 0.0 else high[axis]
            reach += g[p, axis] * (corner - centre[axis])
        if not reach > 0.0:
            return False
    return True
