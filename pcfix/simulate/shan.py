"""How fast Shan's iteration for two images through water finds the depth.

Shan (1994), "Relief reconstruction using two-media photogrammetry", as Skarlatos & Agrafiotis
(2018, JMSE 6(3) 77, section 2.1.1) give it: the true point A and its image do not fit the
collinearity equations, but the point on the vertical through A does that lies 1/s as deep, where

    s = tan a / tan b = sqrt(n^2 + (n^2 - 1) tan^2 a),

a the angle in air, b that in water. Each image has its own s, so a pair gives 4 equations for X,
Y, depth and two s; with s known they are linear. The iteration starts with s = 1, the point that
software makes that knows nothing of water, takes tan a from the point found, and solves again.

The paper's text leaves open which point tan a is taken from; here it is the one at the depth
divided by s, which lies on the image ray. It stops when tan a no longer changes.
This is an independent plain version, for tables of convergence; nothing is shared with the
correction.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.options import DEFAULT_REFRACTIVE_INDEX
from pcfix.simulate.tracing import piercing_points

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.simulate.refraction_effect import StereoPair

TOLERANCE = 1e-9
"""Of tan a, between two iterations."""
_MOST_ITERATIONS = 50


class Iteration(NamedTuple):
    """Residuals of the depth, estimate minus truth, over the model after one iteration."""

    number: int
    mean_m: float
    max_m: float
    """The largest, with its sign."""
    change: float
    """The largest change of tan a since the iteration before; NaN for the first two."""


def shan_iterations(
    pair: StereoPair,
    true_depth_m: float,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    nodes: int = 21,
    tolerance: float = TOLERANCE,
) -> list[Iteration]:
    """Return the residuals of every iteration over a level bed of known depth.

    The images have no noise and are traced through the water from the true bed, `nodes` along
    the model and as many across it.
    """
    bed = _bed(pair.model_m, true_depth_m, nodes)
    slopes = np.stack([_slopes(bed, c, refractive_index) for c in pair.centres], axis=1)
    s, tangent, table = np.ones(slopes.shape[:2]), None, []
    for number in range(_MOST_ITERATIONS):
        point = _intersected(slopes, s, pair.centres)
        following = _tangents(point, s, pair.centres)
        change = np.nan if tangent is None else float(np.abs(following - tangent).max())
        residual = point[:, 2] - true_depth_m
        worst = residual[np.abs(residual).argmax()]
        table.append(Iteration(number, float(residual.mean()), float(worst), change))
        if change < tolerance:
            break
        tangent = following
        s = np.sqrt(refractive_index**2 + (refractive_index**2 - 1.0) * tangent**2)
    return table


def _bed(model_m: tuple[float, float], depth_m: float, nodes: int) -> FloatArray:
    """Return the nodes of a level bed, shape (nodes squared, 3); a single one is in the centre."""
    share = (np.arange(nodes) - (nodes - 1) / 2.0) / max(nodes - 1, 1)
    x, y = (side.ravel() for side in np.meshgrid(model_m[0] * share, model_m[1] * share))
    return np.column_stack([x, y, np.full(len(x), -depth_m)])


def _slopes(bed: FloatArray, centre: FloatArray, n: float) -> FloatArray:
    """Return what an image measures: metres in x and y per metre down, shape (m, 2)."""
    surface = piercing_points(bed, np.broadcast_to(centre, bed.shape), 0.0, n)
    return np.asarray((surface - centre)[:, :2] / centre[2])


def _intersected(slopes: FloatArray, s: FloatArray, centres: FloatArray) -> FloatArray:
    """Solve X - u D / s = X_s + u H and its like in y for X, Y and depth D, shape (m, 3)."""
    system = np.zeros((len(slopes), 4, 3))
    right = np.empty((len(slopes), 4))
    for image, centre in enumerate(centres):
        for axis in range(2):
            row, u = 2 * image + axis, slopes[:, image, axis]
            system[:, row, axis] = 1.0
            system[:, row, 2] = -u / s[:, image]
            right[:, row] = centre[axis] + u * centre[2]
    turned = system.transpose(0, 2, 1)
    return np.asarray(np.linalg.solve(turned @ system, turned @ right[:, :, None])[:, :, 0])


def _tangents(point: FloatArray, s: FloatArray, centres: FloatArray) -> FloatArray:
    """Return tan a of each image, shape (m, 2)."""
    away = np.hypot(
        point[:, None, 0] - centres[None, :, 0], point[:, None, 1] - centres[None, :, 1]
    )
    return np.asarray(away / (centres[None, :, 2] + point[:, None, 2] / s))
