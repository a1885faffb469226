"""Points, the images that saw them, and the sizes of those: what readers of sparse models share."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, TiePoints, Views

_BEFORE_VIEWS = 7
"""Numbers of a point before its views: x, y, z, red, green, blue, count of views."""


class PointList(NamedTuple):
    """Points and views as a file lists them.

    `xyz` has a row per point; `point`, `image` and `rest` have one per view: which point, which
    image (counted from 0), and the other numbers of the view.
    """

    xyz: FloatArray
    point: IntArray
    image: IntArray
    rest: FloatArray


def numbers(path: Path, text: str) -> FloatArray:
    """Return all numbers of a text that holds nothing else but white space."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, sep=" ") if text.strip() else np.empty(0)
        except (DeprecationWarning, ValueError) as error:
            raise InputError(
                f"{path}: among the numbers is a word that is none; the file is damaged, export it"
                " again."
            ) from error


def point_list(path: Path, body: FloatArray, count: int, images: int, width: int) -> PointList:
    """Take apart a list of x y z, red green blue, n, and n views of `width` numbers.

    `count` is the number of points that the file announces, `images` that of its images, which the
    first number of a view counts from 0.
    """
    first, views = _starts(path, body, count, width)
    point = np.repeat(np.arange(count), views)
    within = np.arange(len(point)) - np.repeat(np.cumsum(views) - views, views)
    at = np.repeat(first + _BEFORE_VIEWS, views) + width * within
    image = body[at]
    bad = ~((image >= 0) & (image < images) & (image == np.floor(image)))
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(
            f"{path}: point {point[i]} was seen by image {image[i]:g}, but there are {images}"
            " images; the file is damaged, export it again."
        )
    xyz = body[first[:, None] + np.arange(3)]
    rest = body[at[:, None] + np.arange(1, width)]
    return PointList(xyz, point, image.astype(np.int64), rest)


def _starts(path: Path, body: FloatArray, count: int, width: int) -> tuple[IntArray, IntArray]:
    """Return where each point begins, and how many views it has."""
    found: list[tuple[int, int]] = []  # grows with the file, not with what that announces
    at = 0
    for i in range(count):
        n = float(body[at + _BEFORE_VIEWS - 1]) if at + _BEFORE_VIEWS <= len(body) else 0.5
        if n < 0 or not n.is_integer() or at + _BEFORE_VIEWS + width * n > len(body):
            raise InputError(
                f"{path}: is cut off or damaged at point {i} of {count}; export it again."
            )
        found.append((at, int(n)))
        at += _BEFORE_VIEWS + width * int(n)
    first, views = np.array(found, np.int64).reshape(-1, 2).T
    return first, views


def tie_points(xyz: FloatArray, point: IntArray, camera: IntArray, uv: FloatArray) -> TiePoints:
    """Gather observations (o rows, in any order) by point, without those of a camera -1."""
    kept = np.flatnonzero(camera >= 0)
    kept = kept[np.argsort(point[kept], kind="stable")]
    counts = np.bincount(point[kept], minlength=len(xyz))
    start = np.concatenate([[0], np.cumsum(counts)])
    return TiePoints(xyz, Views(start, camera[kept]), uv[kept])


def finite(ties: TiePoints) -> tuple[TiePoints, str]:
    """Return tie points without those that are not finite, and in words how many these were.

    A point without any coordinate is one that the source has not placed, and stays.
    """
    placed, unplaced = np.isfinite(ties.xyz).all(axis=1), np.isnan(ties.xyz).all(axis=1)
    kept: BoolArray = np.asarray(placed | unplaced)
    point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    seen = np.isfinite(ties.image_xy).all(axis=1)
    if kept.all() and seen.all():
        return ties, ""
    rows = np.flatnonzero(seen & kept[point])
    number = np.cumsum(kept) - 1
    left = tie_points(
        ties.xyz[kept], number[point[rows]], ties.views.camera[rows], ties.image_xy[rows]
    )
    return left, (
        f"{int((~kept).sum()):,} tie points and {int((~seen).sum()):,} image places have a number"
        " that is not finite; they are left out."
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
) -> tuple[FloatArray | None, tuple[str, ...]]:
    """Return width and height of images, from the images themselves or from their tie points.

    Where an image cannot be opened, its frame is the smallest that holds all tie points that
    images of about the same focal length have, about the middle of the frame.

    Images are looked for where the camera file lies, one folder up, and in ``images``.
    `smallest_px`, shape (k, 2), is the smallest width and height that hold the tie points of an
    image, 0 where it has none. None where nothing tells the frames; the texts are for the user.
    """
    sizes = np.array([image_size(path.parent, name) or (0, 0) for name in names], float)
    missing = sizes[:, 0] == 0
    if not missing.any():
        return sizes, ()
    if not smallest_px.any():
        return None, (
            f"{path}: tells no size of {missing.sum()} images, and the images are not beside it;"
            " every point is taken as inside their frames. Put the images beside the file.",
        )
    sizes[missing] = _bounds(focal_px, smallest_px)[missing]
    return sizes, (
        f"{path}: tells no size of {missing.sum()} images, and the images are not beside it; their"
        f" frames are estimated from the tie points, that of {names[missing.argmax()]} as"
        f" {sizes[missing][0, 0]:.0f} x {sizes[missing][0, 1]:.0f} px. Put the images beside the"
        " file.",
    )


def _bounds(focal_px: FloatArray, smallest_px: FloatArray) -> FloatArray:
    """Return for each image the bound of all images of about its focal length."""
    order = np.argsort(focal_px)
    steps = focal_px[order][1:] > _SAME_CAMERA * focal_px[order][:-1]
    bounds = np.empty_like(smallest_px)
    for members in np.split(order, np.flatnonzero(steps) + 1):
        bound = smallest_px[members].max(axis=0)
        bounds[members] = bound if bound.all() else smallest_px.max(axis=0)
    return bounds


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
