"""Gather tie points and estimate frame sizes: shared by the readers of sparse models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from pcfix.errors import NoTiePointsError, PcfixWarning
from pcfix.io.cameras.checks import damaged, without_lens
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, TiePoints, Views

_BEFORE_VIEWS = 7
"""Numbers of a point before its views: x, y, z, red, green, blue, count of views."""


def no_tie_points(path: Path, why: str) -> NoTiePointsError:
    """Return the error for a file without tie points."""
    sentence = f"{path}: has no tie points, as {why}."
    return NoTiePointsError("cameras.no_tie_points", sentence, path=path)


class PointList(NamedTuple):
    """Points and views as a file lists them.

    `xyz` has a row per point; `point`, `image` and `rest` have one per view: which point, which
    image (counted from 0), and the other numbers of the view.
    """

    xyz: FloatArray
    point: IntArray
    image: IntArray
    rest: FloatArray


def numbers(text: str) -> FloatArray:
    """Return all numbers of a text that holds nothing else but white space."""
    return np.array(text.split(), np.float64)


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


def tie_points(xyz: FloatArray, point: IntArray, camera: IntArray, uv: FloatArray) -> TiePoints:
    """Gather observations (o rows, in any order) by point, without those of a camera -1."""
    kept = np.flatnonzero(camera >= 0)
    kept = kept[np.argsort(point[kept], kind="stable")]
    counts = np.bincount(point[kept], minlength=len(xyz))
    start = np.concatenate([[0], np.cumsum(counts)])
    return TiePoints(xyz, Views(start, camera[kept]), uv[kept])


def finite(path: Path, ties: TiePoints) -> tuple[TiePoints, PcfixWarning | None]:
    """Return tie points without those that are not finite, and a note on how many these were.

    A point without any coordinate is one that the source has not placed, and stays.
    """
    placed, unplaced = np.isfinite(ties.xyz).all(axis=1), np.isnan(ties.xyz).all(axis=1)
    kept: BoolArray = np.asarray(placed | unplaced)
    point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    seen = np.isfinite(ties.image_xy).all(axis=1)
    if kept.all() and seen.all():
        return ties, None
    rows = np.flatnonzero(seen & kept[point])
    number = np.cumsum(kept) - 1
    left = tie_points(
        ties.xyz[kept], number[point[rows]], ties.views.camera[rows], ties.image_xy[rows]
    )
    points, observations = int((~kept).sum()), int((~seen).sum())
    return left, PcfixWarning(
        "cameras.tie_points_not_finite",
        f"{path}: {points:,} tie points and {observations:,} observations have a number that is not"
        " finite. They are left out.",
        points=points,
        observations=observations,
    )


def from_principal_point(
    points: PointList, posed: IntArray, cameras: Cameras, places: FloatArray
) -> TiePoints:
    """Gather views by point; `places` are from the principal points, `posed` rows of the images."""
    row = np.full(max(posed.max(), points.image.max(initial=0)) + 1, -1)
    row[posed] = np.arange(len(cameras))
    camera = row[points.image]
    lenses = cameras.lenses or ()
    middle = np.array([[lens.principal_x, lens.principal_y] for lens in lenses])
    return tie_points(points.xyz, points.point, camera, middle[camera] + places)


NO_TIE_POINTS = TiePoints(
    np.empty((0, 3)), Views(np.zeros(1, np.int64), np.empty(0, np.int64)), np.empty((0, 2))
)


def are_seen(tie_points: TiePoints) -> BoolArray:
    """Return which points have a position and a view."""
    seen = np.diff(tie_points.views.start) > 0
    return np.asarray(np.isfinite(tie_points.xyz).all(axis=1) & seen)


_SAME_CAMERA = 1.1
"""Largest ratio between the focal lengths of neighbours among images of one camera."""


def frame_sizes(
    path: Path, names: Sequence[str], focal_px: FloatArray, smallest_px: FloatArray
) -> tuple[FloatArray | None, tuple[PcfixWarning, ...]]:
    """Return width and height of images, from the images themselves or from their tie points.

    Where an image cannot be opened, its frame is the smallest that holds all tie points that
    images of about the same focal length have, about the middle of the frame.

    Images are looked for where the camera file lies, one folder up, and in ``images``.
    `smallest_px`, shape (k, 2), is the smallest width and height that hold the tie points of an
    image, 0 where it has none. None where nothing tells the frames.
    """
    sizes = np.array([image_size(path.parent, name) or (0, 0) for name in names], float)
    missing = sizes[:, 0] == 0
    if not missing.any():
        return sizes, ()
    why = f"the size of {missing.sum()} images is not in the file, nor are the images beside it"
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
    note = PcfixWarning(
        "cameras.frames_estimated",
        f"{path}: {why}. Their frames are estimated from the tie points, the first as"
        f" {first[0]:.0f} x {first[1]:.0f} px; put the images beside the file.",
        images=int(missing.sum()),
        size_px=first,
    )
    return sizes, (note,)


def image_size(folder: Path, name: str) -> tuple[int, int] | None:
    """Return width and height of an image, None when it is not there or cannot be opened."""
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
