"""Points and the images that saw them: what the readers of sparse models share."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.model import TiePoints, Views

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import FloatArray, IntArray

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
    """Return all numbers of a text that holds nothing else but white space.

    Raises
    ------
    InputError
        If there is a word that is not a number.
    """
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

    Parameters
    ----------
    path : Path
        For messages.
    body : array
        All numbers of the list.
    count : int
        Points that the file announces.
    images : int
        How many images there are; the first number of a view counts them from 0.
    width : int
        Numbers of a view.

    Raises
    ------
    InputError
        If the list is cut off, or a view is of no image.
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
    first, views, at = [], [], 0
    for i in range(count):
        n = float(body[at + _BEFORE_VIEWS - 1]) if at + _BEFORE_VIEWS <= len(body) else 0.5
        if n < 0 or not n.is_integer() or at + _BEFORE_VIEWS + width * n > len(body):
            raise InputError(
                f"{path}: is cut off or damaged at point {i} of {count}; export it again."
            )
        first.append(at)
        views.append(int(n))
        at += _BEFORE_VIEWS + width * int(n)
    return np.array(first, np.int64), np.array(views, np.int64)


def tie_points(xyz: FloatArray, point: IntArray, camera: IntArray, uv: FloatArray) -> TiePoints:
    """Gather observations by point; those of a camera -1 (without a pose) are left out.

    Parameters
    ----------
    xyz : array, shape (m, 3)
    point, camera : array of int, shape (o,)
        Row of `xyz` and row of the cameras, in any order.
    uv : array, shape (o, 2)
    """
    kept = np.flatnonzero(camera >= 0)
    kept = kept[np.argsort(point[kept], kind="stable")]
    counts = np.bincount(point[kept], minlength=len(xyz))
    start = np.concatenate([[0], np.cumsum(counts)])
    return TiePoints(xyz, Views(start, camera[kept]), uv[kept])
