"""Gather tie points and estimate frame sizes: shared by the readers of sparse models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from pcfix.errors import NoTiePointsError, PcfixWarning
from pcfix.io.cameras.checks import damaged, note, without_lens
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, TiePoints, Views

_BEFORE_VIEWS = 7
"""Numbers of a point before its views: x, y, z, red, green, blue, count of views."""
_SAME_CAMERA = 1.1
"""Largest ratio between the focal lengths of neighbours among images of one camera."""
NO_TIE_POINTS = TiePoints(
    np.empty((0, 3)), Views(np.zeros(1, np.int64), np.empty(0, np.int64)), np.empty((0, 2))
)


def no_tie_points(path: Path, why: str) -> NoTiePointsError:
    """Return the error for a file without tie points."""
    sentence = f"{path}: has no tie points, as {why}."
    return NoTiePointsError("cameras.no_tie_points", sentence, path=path)


class Seen(NamedTuple):
    """Points, and observations of them in any order: row of the point and camera, u and v.

    The camera -1 is one without a pose, the point -1 one that is not there.
    """

    xyz: FloatArray
    point: IntArray
    camera: IntArray
    uv: FloatArray


def rows_of(wanted: IntArray, identifiers: IntArray) -> IntArray:
    """Return the first row of each of the wanted in a list of identifiers, -1 where it is none."""
    if not len(identifiers):
        return np.full(len(wanted), -1)
    order, rising = np.argsort(identifiers, kind="stable"), np.argsort(wanted)
    place = np.empty(len(wanted), np.int64)  # a search in rising order is far quicker
    place[rising] = np.searchsorted(identifiers[order], wanted[rising])
    row = order[np.minimum(place, len(order) - 1)]
    return np.where(identifiers[row] == wanted, row, -1)


def tie_points(*parts: Seen) -> TiePoints:
    """Join points and gather their observations by point, without those of a camera -1."""
    before = np.cumsum([0, *(len(part.xyz) for part in parts)])
    xyz = np.concatenate([part.xyz for part in parts])
    point = np.concatenate([part.point + n for part, n in zip(parts, before, strict=False)])
    is_there = np.concatenate([(part.camera >= 0) & (part.point >= 0) for part in parts])
    camera = np.concatenate([part.camera for part in parts])
    uv = np.concatenate([part.uv for part in parts])
    kept = np.flatnonzero(is_there)
    kept = kept[np.argsort(point[kept], kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(point[kept], minlength=len(xyz)))])
    return TiePoints(xyz, Views(start, camera[kept]), uv[kept])


def finite(path: Path, ties: TiePoints) -> tuple[TiePoints, PcfixWarning | None]:
    """Return tie points without those that are not finite, and a note on how many these were.

    A point without any coordinate is one that the source has not placed, and stays.
    """
    kept = np.asarray(np.isfinite(ties.xyz).all(axis=1) | np.isnan(ties.xyz).all(axis=1))
    seen = np.isfinite(ties.image_xy).all(axis=1)
    if kept.all() and seen.all():
        return ties, None
    point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    rows = np.flatnonzero(seen & kept[point])
    number = np.cumsum(kept) - 1
    left = Seen(ties.xyz[kept], number[point[rows]], ties.views.camera[rows], ties.image_xy[rows])
    points, observations = int((~kept).sum()), int((~seen).sum())
    sentence = f"{points:,} tie points and {observations:,} observations are not finite; ignored."
    code = "cameras.tie_points_not_finite"
    return tie_points(left), note(path, code, sentence, points=points, observations=observations)


def are_seen(tie_points: TiePoints) -> BoolArray:
    """Return which points have a position and a view."""
    seen = np.diff(tie_points.views.start) > 0
    return np.asarray(np.isfinite(tie_points.xyz).all(axis=1) & seen)


class PointList(NamedTuple):
    """Points and views as Bundler and VisualSFM list them.

    `xyz` has a row per point; `point`, `image` and `rest` have one per view: which point, which
    image (counted from 0), and the other numbers of the view.
    """

    xyz: FloatArray
    point: IntArray
    image: IntArray
    rest: FloatArray

    def seen(self, posed: IntArray, cameras: Cameras, places: FloatArray) -> TiePoints:
        """Return tie points; `places` are from the principal points, `posed` rows of the images."""
        row = np.full(max(posed.max(), self.image.max(initial=0)) + 1, -1)
        row[posed] = np.arange(len(cameras))
        camera = row[self.image]
        middle = [(lens.principal_x, lens.principal_y) for lens in cameras.lenses or ()]
        return tie_points(Seen(self.xyz, self.point, camera, np.array(middle)[camera] + places))


def point_list(path: Path, body: FloatArray, count: int, images: int, width: int) -> PointList:
    """Take apart a list of x y z, red green blue, n, and n views of `width` numbers.

    `count` is the number of points that the file announces, `images` that of its images, which the
    first number of a view counts from 0.
    """
    starts: list[tuple[int, int]] = []  # where a point begins, and its number of views
    at = 0
    for i in range(count):
        n = int(body[at + _BEFORE_VIEWS - 1]) if at + _BEFORE_VIEWS <= len(body) else -1
        if n < 0 or at + _BEFORE_VIEWS + width * n > len(body):
            raise damaged(path, f"it ends at point {i} of {count}")
        starts.append((at, n))
        at += _BEFORE_VIEWS + width * n
    first, views = np.array(starts, np.int64).reshape(-1, 2).T
    point = np.repeat(np.arange(count), views)
    within = np.arange(len(point)) - np.repeat(np.cumsum(views) - views, views)
    at_view = np.repeat(first + _BEFORE_VIEWS, views) + width * within
    image = body[at_view]
    bad = ~((image >= 0) & (image < images))
    if bad.any():
        raise damaged(path, f"point {point[np.argmax(bad)]} is in image {image[np.argmax(bad)]:g}")
    xyz = body[first[:, None] + np.arange(3)]
    rest = body[at_view[:, None] + np.arange(1, width)]
    return PointList(xyz, point, image.astype(np.int64), rest)


def frame_sizes(
    path: Path, names: Sequence[str], focal_px: FloatArray, smallest_px: FloatArray
) -> tuple[FloatArray | None, tuple[PcfixWarning, ...]]:
    """Return width and height of images, from the images themselves or from their tie points.

    Where an image cannot be opened, its frame is the smallest that holds all tie points that
    images of about the same focal length have, about the middle of the frame. `smallest_px`, shape
    (k, 2), is the width and height that hold those of an image, 0 where it has none. None where
    neither is known.
    """
    sizes = np.array([image_size(path.parent, name) or (0, 0) for name in names], float)
    missing = sizes[:, 0] == 0
    if not missing.any():
        return sizes, ()
    why = f"the size of {missing.sum()} images is unknown. Put the images beside the file"
    if not smallest_px.any():
        return None, (without_lens(path, why),)
    order = np.argsort(focal_px)
    steps = focal_px[order][1:] > _SAME_CAMERA * focal_px[order][:-1]
    bounds = np.empty_like(smallest_px)
    for members in np.split(order, np.flatnonzero(steps) + 1):  # images of about one focal length
        bound = smallest_px[members].max(axis=0)
        bounds[members] = bound if bound.all() else smallest_px.max(axis=0)
    sizes[missing] = bounds[missing]
    first = sizes[missing][0].tolist()
    sentence = f"{why}; until then they are estimated (first {first[0]:.0f} x {first[1]:.0f} px)."
    return sizes, (note(path, "cameras.frames_estimated", sentence, size_px=first),)


def image_size(folder: Path, name: str) -> tuple[int, int] | None:
    """Return width and height of an image, None when it is not there or cannot be opened.

    It is looked for in the folder, one folder up, and in ``images``.
    """
    from PIL import Image

    plain = name.replace("\\", "/")
    file = PureWindowsPath(name).name
    for place in (folder / plain, folder / file, folder.parent / plain, folder / "images" / file):
        try:
            if place.is_file():
                with Image.open(place) as image:
                    return image.size
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            continue
    return None
