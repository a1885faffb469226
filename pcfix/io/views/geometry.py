"""Whether the cameras of a list can have seen its points.

A depth map holds only what its image shows, so that nearly every listed camera must have the
apparent point in its frame. With the image numbers misread by one, a quarter of the cameras of an
ordinary block look elsewhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.lens.imaging import project

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.io.views.lists import ViewList
    from pcfix.model import Cameras, FloatArray, IntArray

LEAST_SHARE = 0.95
"""Of listed cameras whose frame holds the point: 1.00 on a real dense cloud, 0.75 with the image
numbers misread by one, 0.4 with any order."""

MARGIN = 0.02
"""Of the frame's sides: other lens models or adjustments move an edge by less."""

SAMPLE_POINTS = 20_000

_ENOUGH = 1000
"""Entries with which the order of the images is settled; with fewer, later chunks may differ."""


def fitted(views: ViewList, cameras: Cameras, xyz: FloatArray, rows: IntArray) -> ViewList:
    """Return the list with the one order of images with which its cameras see the points.

    Parameters
    ----------
    views : ViewList
    cameras : Cameras
    xyz : array, shape (m, 3)
        Apparent points, frame of the cameras.
    rows : array of int64, shape (m,)
        Their rows of the list.

    Raises
    ------
    InputError
        If they do not with any.
    """
    if cameras.rotations is None or cameras.lenses is None:
        return replace(views, orders=views.orders[:1])
    step = max(1, len(rows) // SAMPLE_POINTS)
    point, image = _entries(views, rows[::step])
    shares = [
        share_seen(cameras, order.camera[image], xyz[::step][point]) for order in views.orders
    ]
    known = [(share, i) for i, share in enumerate(shares) if share is not None]
    if not known:
        return views
    share, best = max(known, key=lambda pair: pair[0])
    if share < LEAST_SHARE:
        raise InputError(
            f"{views.raw.path}: only {100 * share:.0f} % of the listed cameras have their point in"
            " the frame, so the list counts other images or its coordinates are in another frame;"
            " put the sparse model of the dense workspace beside it, give the cameras it was made"
            " with, or the offset of its coordinates (--cameras-offset)."
        )
    others = () if len(image) >= _ENOUGH else views.orders[:best] + views.orders[best + 1 :]
    return replace(views, orders=(views.orders[best], *others), share_seen=share)


def _entries(views: ViewList, rows: IntArray) -> tuple[IntArray, npt.NDArray[np.int32]]:
    """Return, for every entry of some rows, its place among the rows and its image."""
    start = views.raw.start
    counts = start[rows + 1] - start[rows]
    first = np.cumsum(counts) - counts
    where = np.repeat(start[rows] - first, counts) + np.arange(counts.sum())
    return np.repeat(np.arange(len(rows)), counts), views.raw.image[where]


def share_seen(cameras: Cameras, camera: npt.NDArray[np.int32], xyz: FloatArray) -> float | None:
    """Return the share of cameras whose frame holds their point, None without any.

    Parameters
    ----------
    cameras : Cameras
        With rotations and lenses.
    camera : array of int, shape (m,)
        Rows of `cameras`; negative ones do not count.
    xyz : array, shape (m, 3)
        The point of each, world frame.
    """
    order = np.argsort(camera, kind="stable")
    ends = np.searchsorted(camera[order], np.arange(len(cameras) + 1))
    seen = sum(
        _seen(cameras, i, xyz[order[ends[i] : ends[i + 1]]])
        for i in range(len(cameras))
        if ends[i] < ends[i + 1]
    )
    entries = int(ends[-1] - ends[0])
    return seen / entries if entries else None


def _seen(cameras: Cameras, i: int, xyz: FloatArray) -> int:
    """Return how many of the points one camera's frame holds."""
    if cameras.rotations is None or cameras.lenses is None:
        return 0
    lens = cameras.lenses[i]
    u, v = project(lens, (xyz - cameras.centres[i]) @ cameras.rotations[i].T).T
    wide, high = MARGIN * lens.width, MARGIN * lens.height
    inside = (u >= -wide) & (u <= lens.width + wide) & (v >= -high) & (v <= lens.height + high)
    return int(np.count_nonzero(inside))
