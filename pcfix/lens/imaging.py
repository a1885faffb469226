"""Project a direction in the camera frame to the image, and back; test what is in the frame.

Projection, distortion and interior orientation are joined by the chain rule. NaN stands where a
direction has no image, or a place in the image no direction.

The frame of a central projection without distortion is a pyramid with its tip in the projection
centre: a point is in the frame if it is on the inner side of its four planes. A distorted frame has
curved sides, and the point has to be projected, except for tiles outside a pyramid around the
frame, which is found by unprojecting the border of the image densely.
"""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, dot, minus, row_of, scaled, times, transposed_times, vector
from pcfix.lens.formulas import (
    B2,
    B3,
    CENTRE_X,
    CENTRE_Y,
    DISC,
    FOCAL_X,
    FOCAL_Y,
    HEIGHT,
    INVERSE,
    PLAIN,
    PRINCIPAL_X,
    PRINCIPAL_Y,
    TAIL,
    TANGENTIAL,
    WIDTH,
    Gradients,
    angle,
    coefficients,
    distorted,
    lens_table,
    plane_and_gradients,
    undistorted,
)
from pcfix.model import Cameras, FloatArray, IntArray, Lens, Views


def project(lens: Lens, directions: FloatArray) -> FloatArray:
    """Return the image coordinates of directions, shape (n, 3), camera frame, any length.

    Shape (n, 2), in the unit of the lens, also outside the frame; NaN where the lens has no image,
    as behind a perspective camera or beyond the fold of the distortion.
    """
    rows = np.ascontiguousarray(directions, np.float64).reshape(-1, 3)
    return _project(coefficients(lens), rows)


def unproject(lens: Lens, image_xy: FloatArray) -> FloatArray:
    """Return the directions of image coordinates, shape (n, 2), in the unit of the lens.

    Unit vectors in the camera frame, shape (n, 3); NaN outside the image of the lens.
    """
    rows = np.ascontiguousarray(image_xy, np.float64).reshape(-1, 2)
    return _unproject(coefficients(lens), rows)


def straight_images(xyz: FloatArray, camera: IntArray, cameras: Cameras) -> FloatArray:
    """Return the image coordinates of points by straight rays, shape (o, 2); see `project`.

    Each point, shape (o, 3), world frame, has one camera: a row of `cameras`, which have rotations
    and lenses.
    """
    lenses, rotations = cameras.lenses or (), np.asarray(cameras.rotations)
    image_xy = np.full((len(xyz), 2), np.nan)
    order = np.argsort(camera, kind="stable")
    ends = np.searchsorted(camera[order], np.arange(len(lenses) + 1))
    for k in np.flatnonzero(np.diff(ends)):
        rows = order[ends[k] : ends[k + 1]]
        image_xy[rows] = project(lenses[k], (xyz[rows] - cameras.centres[k]) @ rotations[k].T)
    return image_xy


@device
def image_of(c: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Return u, v of one direction: projection, distortion, interior orientation."""
    return image_and_gradients(c, x, y, z)[:2]


@device
def direction_of(c: FloatArray, u: float, v: float) -> tuple[float, float, float]:
    """Return the unit direction of one place in the image: `image_of` backwards."""
    cx, cy = c[CENTRE_X], c[CENTRE_Y]
    u, v = u - c[PRINCIPAL_X], v - c[PRINCIPAL_Y]
    det = c[FOCAL_X] * c[FOCAL_Y] - c[B2] * c[B3]
    dx = (c[FOCAL_Y] * u - c[B2] * v) / det - cx
    dy = (c[FOCAL_X] * v - c[B3] * u) / det - cy
    if c[INVERSE] != 0.0:
        px, py, _ = distorted(c, dx, dy)
    else:
        px, py = undistorted(c, dx, dy)
    px, py = px + cx, py + cy
    rho = np.sqrt(px * px + py * py)
    theta = angle(c, rho)
    scale = np.sin(theta) / rho if rho > 0.0 else 1.0
    return scale * px, scale * py, np.cos(theta)


@kernel(allocates=True)
def _project(c: FloatArray, directions: FloatArray) -> FloatArray:
    image = np.empty((len(directions), 2))
    for i in range(len(directions)):
        image[i, 0], image[i, 1] = image_of(c, *row_of(directions, i))
    return image


@kernel(allocates=True)
def _unproject(c: FloatArray, image: FloatArray) -> FloatArray:
    directions = np.empty((len(image), 3))
    for i in range(len(image)):
        ray = direction_of(c, image[i, 0], image[i, 1])
        directions[i, 0], directions[i, 1], directions[i, 2] = ray
    return directions


@device
def image_and_gradients(
    c: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, Gradients]:
    """Return u, v of a direction (x, y, z), camera frame, and their derivatives by it."""
    px, py, (ax, ay, az, bx, by, bz) = plane_and_gradients(c, x, y, z)
    px, py = px - c[CENTRE_X], py - c[CENTRE_Y]
    if c[INVERSE] != 0.0:
        dx, dy = undistorted(c, px, py)
        _, _, (xx, xy, yx, yy) = distorted(c, dx, dy)
        det = xx * yy - xy * yx
        xx, xy, yx, yy = yy / det, -xy / det, -yx / det, xx / det
    else:
        dx, dy, (xx, xy, yx, yy) = distorted(c, px, py)
    dx, dy = dx + c[CENTRE_X], dy + c[CENTRE_Y]
    fx, fy, b2, b3 = c[FOCAL_X], c[FOCAL_Y], c[B2], c[B3]
    ua, ub = fx * xx + b2 * yx, fx * xy + b2 * yy
    va, vb = fy * yx + b3 * xx, fy * yy + b3 * xy
    return (
        c[PRINCIPAL_X] + fx * dx + b2 * dy,
        c[PRINCIPAL_Y] + fy * dy + b3 * dx,
        (
            ua * ax + ub * bx, ua * ay + ub * by, ua * az + ub * bz,
            va * ax + vb * bx, va * ay + vb * by, va * az + vb * bz,
        ),
    )  # fmt: skip


# k1 to k4, p1, p2, the centre of distortion, the squared disc, and the interior orientation.
Plain: TypeAlias = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float,
    float, float,
]  # fmt: skip


@device
def plain_lens(c: FloatArray) -> Plain:
    """Return the common lens (`PLAIN`) as numbers, which stay in registers."""
    return (
        *vector(c, TAIL), c[TAIL + 3],
        c[TANGENTIAL], c[TANGENTIAL + 1], c[CENTRE_X], c[CENTRE_Y],
        c[DISC] * c[DISC],
        c[FOCAL_X], c[B2], c[B3], c[FOCAL_Y],
        c[PRINCIPAL_X], c[PRINCIPAL_Y],
    )  # fmt: skip


@device(inline="always")
def plain_image(c: Plain, w: Vector) -> tuple[float, float, Gradients]:
    """Do as `image_and_gradients` for the common lens, without branches: loops vectorise."""
    k1, k2, k3, k4, p1, p2, centre_x, centre_y, disc2, fx, b2, b3, fy, u0, v0 = c
    inv = 1.0 / w[2]
    flat_x, flat_y = w[0] * inv, w[1] * inv
    x, y = flat_x - centre_x, flat_y - centre_y
    r2 = x * x + y * y
    # Brown: radial factor g and its derivative by r^2, then tangential terms
    g = 1.0 + (((k4 * r2 + k3) * r2 + k2) * r2 + k1) * r2
    twice = 2.0 * (((4.0 * k4 * r2 + 3.0 * k3) * r2 + 2.0 * k2) * r2 + k1)
    dx = g * x + (p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y) + centre_x
    dy = g * y + (p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y) + centre_y
    xx = g + twice * x * x + 6.0 * p1 * x + 2.0 * p2 * y
    xy = twice * x * y + 2.0 * (p1 * y + p2 * x)
    yy = g + twice * y * y + 6.0 * p2 * y + 2.0 * p1 * x
    # behind the camera and beyond the fold of the distortion there is no image
    seen = (w[2] > 0.0) & (r2 <= disc2)
    u = u0 + fx * dx + b2 * dy if seen else np.nan
    v = v0 + fy * dy + b3 * dx if seen else np.nan
    ua, ub, va, vb = fx * xx + b2 * xy, fx * xy + b2 * yy, fy * xy + b3 * xx, fy * yy + b3 * xy
    return u, v, (
        inv * ua, inv * ub, -inv * (ua * flat_x + ub * flat_y),
        inv * va, inv * vb, -inv * (va * flat_x + vb * flat_y),
    )  # fmt: skip


@device(inline="always")
def image_and_slopes(
    lens: FloatArray, plain: Plain | None, r: FloatArray, direction: Vector
) -> tuple[float, float, Vector, Vector]:
    """Return u, v of a direction in the world frame, and the gradients of u and v there.

    The camera has the rotation r. The numbers of the common lens are used if there are any.
    """
    if plain is None:
        u, v, g = image_and_gradients(lens, *times(r, direction))
    else:
        u, v, g = plain_image(plain, times(r, direction))
    return u, v, transposed_times(r, g[:3]), transposed_times(r, g[3:])


# Frames


@lru_cache(maxsize=8192)
def frame_shape(lens: Lens) -> tuple[FloatArray, bool]:
    """Return the pyramid of `Frames`, camera frame, and whether the frame is distorted."""
    brown = (*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism)
    if lens.projection == "perspective" and not any(brown):  # straight lines stay straight
        corners = unproject(lens, _border(lens, 1))
        return np.cross(corners[:-1], corners[1:]), False
    border = unproject(lens, _border(lens, BORDER))
    if not (border[:, 2] > STEEPEST).all():
        return np.zeros((4, 3)), True
    flat = border[:, :2] / border[:, 2:]
    # a curve deviates less from its points than the largest distance between neighbours
    step = np.sqrt((np.diff(flat, axis=0) ** 2).sum(axis=1).max())
    (left, top), (right, bottom) = flat.min(axis=0) - step, flat.max(axis=0) + step
    return np.array([
        (1.0, 0.0, -left), (-1.0, 0.0, right), (0.0, 1.0, -top), (0.0, -1.0, bottom),
    ]), True  # fmt: skip


BORDER = 400  # points along each side of a frame, which is nearly straight between neighbours

# A pyramid with flatter sides would be too wide to exclude anything; that of zeros holds all.
STEEPEST = np.cos(np.radians(80.0))


def _border(lens: Lens, count: int) -> FloatArray:
    """Return points around the image, `count` a side, the first one again at the end."""
    w, h, way = lens.width, lens.height, np.linspace(0.0, 4.0, 4 * count + 1)  # in sides
    x = np.interp(way, range(5), (0.0, w, w, 0.0, 0.0))
    y = np.interp(way, range(5), (0.0, 0.0, h, h, 0.0))
    return np.column_stack([x, y])


NOT_DISTORTED = -1


class Frames(NamedTuple):
    """The frames of k cameras; directions are in the world frame."""

    planes: FloatArray  # (k, 4, 3), inward normals of the pyramid that is, or encloses, the frame
    row: IntArray  # (k,), lens of each camera; `NOT_DISTORTED` if the pyramid is the frame
    lenses: FloatArray  # (l, ...), coefficients, one row per lens
    rotations: FloatArray  # (k, 3, 3), world to camera


def no_frames(k: int) -> Frames:
    """Return frames of k cameras that hold every point: planes of zeros do."""
    return Frames(
        planes=np.zeros((k, 4, 3)),
        row=np.full(k, NOT_DISTORTED),
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
    # a camera's planes are those of its lens, turned into the world
    planes, is_distorted = (np.array(one)[row] for one in zip(*shapes, strict=True))
    return Frames(
        planes=np.ascontiguousarray(planes @ rotations),
        row=np.where(is_distorted, row, NOT_DISTORTED),
        lenses=lenses,
        rotations=rotations,
    )


# A view list may name a camera whose frame misses the point by at most this times its longer side.
#
# An apparent point is some pixels from its image. Much farther outside the distortion is
# extrapolated, and the search of a true point may fail: of 40,000 points of simulated scenes 47
# were up to 41 m off, all of them imaged more than eight lengths outside.
MARGIN = 1.0


def listed_frames_of(cameras: Cameras) -> Frames:
    """Return the widened frames for points of a view list.

    Those of cameras without lenses or angles hold everything: no method projects into them.
    """
    if cameras.rotations is None or cameras.lenses is None:
        return no_frames(len(cameras))
    return frames_of(narrower(cameras, -MARGIN))


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


Pyramid: TypeAlias = tuple[Vector, Vector, Vector, Vector]


@device
def _pyramid(g: FloatArray) -> Pyramid:
    """Return the planes of one camera, shape (4, 3), as numbers, which stay in registers."""
    return row_of(g, 0), row_of(g, 1), row_of(g, 2), row_of(g, 3)


@device
def _in_pyramid(g: Pyramid, e: Vector) -> bool:
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
    if not _in_pyramid(_pyramid(frames.planes[c]), e):
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
    around, row = _pyramid(frames.planes[c]), frames.row[c]
    if row == NOT_DISTORTED:
        for j in range(marks.size):
            e = centre[0] - points[j], centre[1] - points[run + j], centre[2] - points[2 * run + j]
            marks[j] = 1.0 if _in_pyramid(around, e) else 0.0
        return True
    lens, r, count = frames.lenses[row], frames.rotations[c], 0
    plain = plain_lens(lens)
    # only one of the two loops runs; with the choice inside, the first would not be vectorised
    for j in range(marks.size if lens[PLAIN] != 0.0 else 0):
        ray = points[j] - centre[0], points[run + j] - centre[1], points[2 * run + j] - centre[2]
        u, v, _ = plain_image(plain, times(r, ray))
        inside = (u >= 0.0) & (u <= lens[WIDTH]) & (v >= 0.0) & (v <= lens[HEIGHT])
        marks[j] = 1.0 if inside else 0.0
        count += 1 if inside else 0
    for j in range(marks.size if lens[PLAIN] == 0.0 else 0):
        e = centre[0] - points[j], centre[1] - points[run + j], centre[2] - points[2 * run + j]
        inside = _in_pyramid(around, e) and _images(lens, r, e)
        marks[j] = 1.0 if inside else 0.0
        count += 1 if inside else 0
    return count > 0


@device
def may_hold(frames: Frames, c: int, centre: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether the frame of camera c may hold a point of an upright box; never wrongly False."""
    for p in range(4):
        # the corner of the box farthest inside this plane; if it is outside, all are
        reach, inward = 0.0, row_of(frames.planes[c], p)
        for axis in range(3):
            corner = high[axis] if inward[axis] > 0.0 else low[axis]
            reach += inward[axis] * (corner - centre[axis])
        if reach < 0.0:
            return False
    return True


def count_visible_cameras(
    xyz: FloatArray, cameras: Cameras, views: Views | None = None
) -> IntArray:
    """Return how many cameras have each point, (n, 3), in their frame; occlusion is ignored.

    Only those of the view lists count, if there are any, in frames as of `listed_frames_of`.
    """
    counts, none = np.zeros(len(xyz), np.int64), np.zeros(0, np.int64)
    start = none if views is None else np.asarray(views.start, np.int64)
    camera = none if views is None else np.asarray(views.camera, np.int64)
    frames = frames_of(cameras) if views is None else listed_frames_of(cameras)
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
