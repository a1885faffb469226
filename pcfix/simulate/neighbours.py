"""Which images a matcher compares each image with: those at a good angle with much in common."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray
    from pcfix.simulate.sight import Sight

SAMPLE = 1000
"""Points that overlap and angles are judged by."""

OPTIMAL_DEG, SPREAD_BELOW_DEG, SPREAD_ABOVE_DEG = 10.0, 4.0, 10.0


def neighbour_table(truth: FloatArray, sight: Sight, centres: FloatArray, count: int) -> IntArray:
    """Return the best neighbours of each image, shape (k, count), best first, -1 for none.

    An image scores for every point that both show, the more the nearer the angle between their
    rays is to 10 degrees (a bell, wider above): the manner of OpenMVS's choice, not its formula.

    Parameters
    ----------
    truth : array, shape (n, 3)
    sight : Sight
        Of these points.
    centres : array, shape (k, 3)
    count : int
    """
    k = len(centres)
    score = np.zeros((k, k))
    for i in range(len(truth)):
        seen = sight.camera[sight.start[i] : sight.start[i + 1]]
        ray = centres[seen] - truth[i]
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        angle = np.degrees(np.arccos(np.clip(ray @ ray.T, -1.0, 1.0)))
        spread = np.where(angle < OPTIMAL_DEG, SPREAD_BELOW_DEG, SPREAD_ABOVE_DEG)
        score[np.ix_(seen, seen)] += np.exp(-0.5 * ((angle - OPTIMAL_DEG) / spread) ** 2)
    np.fill_diagonal(score, 0.0)
    best = np.argsort(-score, axis=1, kind="stable")[:, :count]
    table = np.full((k, count), -1)
    table[:, : best.shape[1]] = np.where(np.take_along_axis(score, best, axis=1) > 0.0, best, -1)
    return table
