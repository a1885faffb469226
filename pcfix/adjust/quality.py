"""Whether some observations are better than others as a whole: on land, of obliques, of a sensor.

Each side of the water and each kind of image has its own variance of unit weight: its weighted
squares over its share of the redundancy, of which each point takes three. Where an F-test says that
they differ, and by enough to matter, each group counts by its own (Foerstner 1979, one step).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import fdtri

from pcfix.adjust.normal import residuals
from pcfix.adjust.problem import Problem, Solution, water_of
from pcfix.model import BoolArray, IntArray
from pcfix.water.surface import surface_above

SURE = 0.99
"""Probability at which groups of equal quality would not differ by so much."""

LEAST_POINTS = 30
"""Points of a group; as residuals of one point hang together, these are its degrees of freedom."""

LEAST_RATIO = 1.2
"""Of standard deviations, below which other weights would win a fiftieth of a standard error."""

OBLIQUE_DEG = 15.0
"""Off the vertical; cameras that look straight down lean by a few degrees."""

LEAST_GAP = 0.2
"""Of the flying height, that parts two flights."""


def weighed(problem: Problem, now: Solution, ties: BoolArray) -> tuple[Problem, list[str]]:
    """Return the problem with its groups of observations weighed, and a sentence if they differ.

    Parameters
    ----------
    ties : array of bool, shape (o,)
        Observations of tie points; others keep their weights.
    """
    seen, owner, parts = problem.seen, problem.block.owner, []
    used = ties & (seen.weight > 0.0)
    r = residuals(now.state, seen, problem.surface)
    used &= np.isfinite(r).all(axis=1)
    square = np.where(used[:, None], r, 0.0)
    square = (square * square).sum(axis=1)
    redundancy = 2.0 - 3.0 / np.maximum(np.bincount(owner, used)[owner], 2.0)
    for names, group in _groups(problem, now):
        rows = [used & (group == i) for i in range(len(names))]
        points = np.array([len(np.unique(owner[row])) for row in rows])
        if len(names) < 2 or points.min() < LEAST_POINTS:
            continue
        free = np.array([redundancy[row].sum() for row in rows])
        each = [(square[row] * seen.weight[row] ** 2).sum() for row in rows] / free
        worst, best = int(np.argmax(each)), int(np.argmin(each))
        ratio = each[worst] / each[best]
        if ratio < max(fdtri(points[worst], points[best], SURE), LEAST_RATIO**2):
            continue
        weight = seen.weight.copy()
        for row, variance in zip(rows, each, strict=True):
            weight[row] /= np.sqrt(variance)
        seen = seen._replace(weight=weight)
        px = np.sqrt([square[row].sum() for row in rows] / free)
        parts += [f"{by:.2f} px {name}" for name, by in zip(names, px, strict=True)]
    if not parts:
        return problem, []
    words = f"{', '.join(parts[:-1])} and {parts[-1]}"
    note = f"the noise of tie points differs: {words}; each counts by its own."
    return replace(problem, seen=seen), [note]


def _groups(problem: Problem, now: Solution) -> Iterator[tuple[list[str], IntArray]]:
    """Yield what parts the observations: names, and which of them each observation is."""
    block, seen, state = problem.block, problem.seen, now.state
    water = water_of(problem, state)
    if water is not None:
        xyz = state.xyz + problem.origin
        wet = block.wet & (surface_above(water, xyz).height_m > xyz[:, 2])
        yield ["on land", "under water"], wet[block.owner].astype(np.int64)
    sensors = int(seen.group.max()) + 1
    yield [f"of sensor {i}" for i in range(1, sensors + 1)], seen.group[seen.camera]
    flat = -state.rotations[:, 2, 2] < np.cos(np.radians(OBLIQUE_DEG))
    yield ["of images straight down", "of obliques"], flat[seen.camera].astype(np.int64)
    height = state.centres[:, 2] - np.median(state.xyz[:, 2])
    order = np.sort(height)
    gap = np.diff(order, prepend=order[:1])
    if gap.max() > LEAST_GAP * np.median(height):
        high = height >= order[int(np.argmax(gap))]
        yield ["of the lower flight", "of the higher flight"], high[seen.camera].astype(np.int64)
