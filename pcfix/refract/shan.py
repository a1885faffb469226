"""Shan 1994: collinearity with a scale s on the depth of every ray, by iteration."""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import BoolArray, FloatArray, Outcome
from pcfix.refract.batch import Batch, Chosen, Intersection
from pcfix.refract.literature import depth_ratio
from pcfix.refract.rays import MIN_DETERMINANT

TOLERANCE = 1e-9
"""Of tan a between two iterations; the depth then changes by less than 1e-9 of itself."""
MOST_ITERATIONS = 50


def shan(batch: Batch) -> Intersection:
    """Intersect with the collinearity equations of the s-model; X, Y and Z move.

    Returns
    -------
    Intersection
        Points whose bent rays are nearer to parallel than a tenth of a degree, or for which the
        iteration finds no depth under the water, are not corrected.

    Notes
    -----
    Shan (1994), "Relief reconstruction using two-media photogrammetry", as Skarlatos & Agrafiotis
    (2018, JMSE 6(3), 77, section 2.1.1, eqs 1-7) give it; their eq 2 lacks the root that eqs 1 and
    7 have. The image of the true point (X, Y) at
    the depth D is that of a point seen through air on the same vertical at the depth D / s, with

        s = tan a / tan b = sqrt(n^2 + (n^2 - 1) tan^2 a)        (eq 7)

    so that the collinearity equations hold with D / s for the depth (eq 3). Every image has its
    own s; two images give four equations for X, Y, D and two s. With s known they are linear.
    The iteration starts with s = 1, takes tan a from the point found, and with the s of eq 7
    solves again, until no tan a changes by more than `TOLERANCE`.

    How this differs:

    - The paper's first tan a is eq 6 with Z = 0; s = 1 is nearer, and saves an iteration.
    - The image ray is the line from the projection centre to the apparent point, as a cloud has
      no image coordinates. So the start, s = 1, is the apparent point itself.
    - Any number of rays: the equations of all are solved together in least squares, each one
      divided so that it says X or Y in metres. Two rays alone are overdetermined too (4 by 3).
    - The equations are horizontal distances at the true depth, not distances from the rays as in
      eq 11 (method snell); the two agree where the rays truly meet.
    - tan a is that of eq 6, from the point at the depth D / s, with the s of the turn before.
    - All rays vertical leave the depth open: the equations are singular.

    Exact where the straight rays meet in the apparent point: two cameras at the same incidence,
    or in one vertical plane with the point. With the image ray given, s is given, so the
    iteration only takes in that rays pass each other; a few turns do.
    """
    found = np.zeros((len(batch.xyz), 4))
    failed = np.zeros(len(batch.xyz), np.bool_)
    in_tiles(_solve_all, len(batch), batch.chosen(), found, failed, points=len(batch))
    outcome = np.where(failed, np.uint8(Outcome.PARALLEL_RAYS), batch.outcome())
    return batch.result(found[:, :3], outcome=outcome, ray_miss_m=found[:, 3])


@kernel(allocates=True)
def _solve_all(span: Span, points: Chosen, found: FloatArray, failed: BoolArray) -> None:
    """Fill in shift and distance from the rays of each point with two rays or more."""
    for i in range(*span):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        if rays.size < 2:
            continue
        e = np.empty((rays.size, 3))
        d = np.empty(rays.size)
        for j in range(rays.size):
            for axis in range(3):
                e[j, axis] = points.centres[rays[j], axis] - points.xyz[i, axis]
            depth = points.height[i] - points.xyz[i, 2]
            d[j] = max(depth + points.offset[rays[j]], 0.0)
        solved, x, y, sunk = _iterate(e, d, points.n)
        failed[i] = not solved
        if solved:
            found[i, 0], found[i, 1], found[i, 2] = x, y, -sunk
            found[i, 3] = _miss(e, d, points.n, x, y, sunk)


@device(allocates=True)
def _iterate(e: FloatArray, d: FloatArray, n: float) -> tuple[bool, float, float, float]:
    """Solve for one point; e (k, 3) leads from it to the cameras, d (k,) is its depth for each.

    Returns
    -------
    solved : bool
    x, y, sunk : float
        How far the true point is aside and below, metres.
    """
    s, tangent = np.ones(d.size), np.hypot(e[:, 0], e[:, 1]) / e[:, 2]
    x = y = sunk = 0.0
    for _ in range(MOST_ITERATIONS):
        for j in range(d.size):
            s[j] = depth_ratio(tangent[j] ** 2, n) if d[j] > 0.0 else 1.0
        solved, x, y, sunk = _intersected(e, d, s)
        if not (solved and sunk + d.min() >= 0.0):
            return False, 0.0, 0.0, 0.0
        change = 0.0
        for j in range(d.size):
            rise = e[j, 2] - d[j] + (d[j] + sunk) / s[j]
            following = np.hypot(x - e[j, 0], y - e[j, 1]) / rise
            change = max(change, abs(following - tangent[j]))
            tangent[j] = following
        if change <= TOLERANCE:
            break
    return True, x, y, sunk


@device(allocates=True)
def _intersected(e: FloatArray, d: FloatArray, s: FloatArray) -> tuple[bool, float, float, float]:
    """Solve the collinearity equations with s known.

    In plan, a camera's image ray is u = -e / e_z metres aside per metre down, and in the water
    v = u / s. It meets the vertical of the true point, x aside and `sunk` below the apparent one,
    where

        x = v sunk + r,    r = -(u - v) d

    for each of the two axes: a straight line through the places (v, r), of which `sunk` is the
    slope with its sign changed.
    """
    k = d.size
    v, r = np.empty((k, 2)), np.empty((k, 2))
    for j in range(k):
        for axis in range(2):
            u = -e[j, axis] / e[j, 2]
            v[j, axis] = u / s[j]
            r[j, axis] = -(u - v[j, axis]) * d[j]
    mean_v = np.array([v[:, 0].mean(), v[:, 1].mean()])
    mean_r = np.array([r[:, 0].mean(), r[:, 1].mean()])
    spread = product = 0.0
    for j in range(k):
        for axis in range(2):
            away = v[j, axis] - mean_v[axis]
            spread += away * away
            product += away * (r[j, axis] - mean_r[axis])
    # of two rays at a small angle alpha the spread is alpha^2 / 2
    if not spread >= 2.0 * k * MIN_DETERMINANT:
        return False, 0.0, 0.0, 0.0
    sunk = -product / spread
    return True, mean_r[0] + sunk * mean_v[0], mean_r[1] + sunk * mean_v[1], sunk


@device
def _miss(e: FloatArray, d: FloatArray, n: float, x: float, y: float, sunk: float) -> float:
    """Return the root mean square distance of the point found from the bent rays themselves."""
    squares = 0.0
    for j in range(d.size):
        u, w = -e[j, 0] / e[j, 2], -e[j, 1] / e[j, 2]
        s = depth_ratio(u * u + w * w, n) if d[j] > 0.0 else 1.0
        v0, v1 = u / s, w / s
        aside0 = x - v0 * sunk + (u - v0) * d[j]
        aside1 = y - v1 * sunk + (w - v1) * d[j]
        along = aside0 * v0 + aside1 * v1
        square = aside0 * aside0 + aside1 * aside1 - along * along / (1.0 + v0 * v0 + v1 * v1)
        squares += max(square, 0.0)
    return np.sqrt(squares / d.size)
