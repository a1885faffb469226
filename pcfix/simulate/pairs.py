"""A cloud of stereo pairs, as semi-global matching and fusion by the median make it.

Each image is matched with its neighbours. Every pair that shows a point measures it in both images
anew, two straight rays give a place (least residuals in the images), and the point is the median
of these places in x, y and z one by one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.model import Views
from pcfix.simulate.tracing import triangulate

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray
    from pcfix.simulate.sight import Rig, Sight


class PairCloud(NamedTuple):
    """Points, shape (n, 3), their cameras, and their pairs.

    Point i has the pairs ``pairs[start[i]:start[i + 1]]``, shape (p, 2), the lower camera first.
    """

    xyz: FloatArray
    views: Views
    start: IntArray
    pairs: IntArray


def match_pairs(
    truth: FloatArray, sight: Sight, rig: Rig, table: IntArray, rng: np.random.Generator
) -> PairCloud:
    """Return the medians of the pairs of each point.

    A point without a pair stays where it is and has no cameras.

    Parameters
    ----------
    truth : array, shape (n, 3)
    sight : Sight
    rig : Rig
    table : array, shape (k, c)
        Neighbours of each camera, -1 for none.
    rng : Generator
        Of the noise, two image points for each pair.
    """
    one, other = pair_rows(sight, table)
    point = sight.point[one]
    both = np.column_stack([one, other]).ravel()
    places = triangulate(
        rig.observed(sight.ideal[both], rng),
        rig.given,
        sight.camera[both],
        np.arange(0, len(both) + 1, 2),
        rig.optics.lens,
        truth[point],
    )
    start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(truth)))])
    xyz, made = truth.copy(), np.diff(start) > 0
    for axis in range(3):
        xyz[made, axis] = _medians(places[:, axis], point, start)[made]
    used = np.zeros(len(sight.point), bool)
    used[both] = True
    count = np.bincount(sight.point[used], minlength=len(truth))
    views = Views(np.concatenate([[0], np.cumsum(count)]), sight.camera[used])
    return PairCloud(xyz, views, start, np.column_stack([sight.camera[one], sight.camera[other]]))


def pair_rows(sight: Sight, table: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows of `sight` that are pairs, each once, sorted by point, then camera."""
    k, rows = len(table), sight.rows(len(table))
    match = np.zeros((k, k + 1), bool)
    match[np.arange(k)[:, None], table] = True  # the column k, or -1, is for "none"
    match = match[:, :k]
    first, second = np.nonzero(np.triu(match | match.T, 1))
    both = (rows[:, first] >= 0) & (rows[:, second] >= 0)
    point, pair = np.nonzero(both)
    return rows[point, first[pair]], rows[point, second[pair]]


def _medians(values: FloatArray, point: IntArray, start: IntArray) -> FloatArray:
    """Return the median of each point's values, shape (n,); any number where it has none."""
    ordered = np.concatenate([values[np.lexsort((values, point))], [0.0]])
    count = np.diff(start)
    low, high = start[:-1] + (count - 1) // 2, start[:-1] + count // 2
    return np.asarray((ordered[low] + ordered[high]) / 2.0)
