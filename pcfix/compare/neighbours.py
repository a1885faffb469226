"""Nearest neighbours, quickly: points that lie together in space lie together in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pcfix.model import FloatArray, IntArray

CHUNK_POINTS = 200_000
POINTS_ACROSS = 8
"""Width of the strips of `strip_order`, in mean distances between points."""
MAX_STRIPS = 30_000
"""So that the number of a cell fits 32 bits."""


def mean_spacing_m(xy: FloatArray) -> float:
    """Return the side of the square that each point has to itself in the cloud's bounding box.

    Parameters
    ----------
    xy : array, shape (n, 2)
        Metres, world frame.
    """
    extent = np.array([np.ptp(xy[:, 0]), np.ptp(xy[:, 1])])
    if extent.min() <= 0.0:
        return float(extent.max() / len(xy))
    return float(np.sqrt(extent.prod() / len(xy)))


def strip_order(xy: FloatArray) -> IntArray:
    """Return the row numbers of points in the order of a walk along narrow strips.

    A tree is built and asked several times faster in this order than in a random one, as each
    point finds in the processor's cache what its predecessor needed.

    Parameters
    ----------
    xy : array, shape (n, 2) or (n, 3)
        Metres, world frame; only the plan position counts.
    """
    longest = max(np.ptp(xy[:, 0]), np.ptp(xy[:, 1]))
    width = max(mean_spacing_m(xy[:, :2]) * POINTS_ACROSS, longest / MAX_STRIPS, 1e-9)
    column = ((xy[:, 0] - xy[:, 0].min()) / width).astype(np.int32)
    row = ((xy[:, 1] - xy[:, 1].min()) / width).astype(np.int32)
    backwards = row % 2 == 1
    column[backwards] = column.max() - column[backwards]
    return np.argsort(row * (column.max() + 1) + column, kind="stable")


class Neighbours:
    """The nearest of m points to any place.

    Parameters
    ----------
    points : array, shape (m, d)
        Metres; d is 2 (in plan) or 3 (in space).

    Attributes
    ----------
    row : array, shape (m,)
        Row in `points` of each number that `find` returns.
    """

    def __init__(self, points: FloatArray) -> None:
        from scipy.spatial import cKDTree  # not quick to load, and C2C seldom needs it

        self.origin = np.floor(points.mean(axis=0))
        self.row = strip_order(points)
        self._tree = cKDTree(points[self.row] - self.origin, balanced_tree=False)

    def find(
        self, places: FloatArray, count: int = 1
    ) -> Iterator[tuple[IntArray, FloatArray, IntArray]]:
        """Yield row numbers of places, and distance and number of their nearest points.

        Parameters
        ----------
        places : array, shape (n, d)
            Metres, the frame of the points.
        count : int
            How many neighbours; at most m.

        Yields
        ------
        rows : array, shape (c,)
            Of `places`.
        distance_m : array, shape (c, count)
            Nearest first.
        number : array, shape (c, count)
            Into `row`.
        """
        order = strip_order(places)
        for start in range(0, len(order), CHUNK_POINTS):
            rows = order[start : start + CHUNK_POINTS]
            found = self._tree.query(
                places[rows] - self.origin, k=np.arange(1, count + 1), workers=-1
            )
            yield rows, np.asarray(found[0]), np.asarray(found[1], np.int64)

    def nearest(self, places: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return distance (m) to the nearest point, and its row, both of shape (n,)."""
        distance, row = np.empty(len(places)), np.empty(len(places), np.int64)
        for rows, far, number in self.find(places):
            distance[rows], row[rows] = far[:, 0], self.row[number[:, 0]]
        return distance, row
