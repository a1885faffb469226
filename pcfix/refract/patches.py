"""Measure the discontinuities between image footprints that a correction leaves in a bed.

The same apparent points are corrected for two reconstruction types. Where the images that see a
point change, the two corrections differ by a discontinuity. The bed of the right one is smooth
there; that of the wrong one has the discontinuity by which the two differ.

With r_a and r_b the residuals of the two beds from a quadratic surface over a patch of neighbours,
and d = r_a - r_b, the share of d that is in r_a is

    beta = sum(w r_a d) / sum(w d d),

near 0 if a is right and near 1 if b is. The weights are one over the square of the scatter of the
apparent patch. Noise of the points is in r_a and r_b by the factors by which either makes depths
larger; that part of d is subtracted first.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Batch, stacked
from pcfix.running import current

PATCHES, TEST_PATCHES = 750, 500
"""To detect the type, and to test one that the user set: the standard error of the evidence is
mostly that of the models, which more patches do not lower."""
FEWEST_POINTS = 400
PATCH_POINTS = (32, 16)
"""Of a patch, or of sparse clouds."""
FEWEST_WITHOUT_LIST = 2000
"""Fewer are tie points, and their patches overlap."""

PATCH_WIDTH, WIDEST_PATCH = 0.04, 0.055
"""In flying heights: so wide that image borders cross many patches. In wider ones relief hides the
discontinuities."""

BORDER_SHARE = 0.08
"""Share of the points, nearest to where the nearest image changes, that the patches of dense clouds
lie around: only there the maps of nearest images leave discontinuities."""

GRID_SHARE = 0.9
"""Share of neighbours whole steps apart from which a cloud is a grid."""

SMOOTH_GSD = 0.02
"""Least scatter of neighbours: image noise leaves ten times that."""

SQUARE_PATCHES, MOST_IN_SQUARES = 5.0, 1_000_000
"""Width of a square, in patches; most points in squares."""

_MIX = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0xD6E8FEB86659FD93)
"""Odd numbers of a hash."""

_TERMS = 6  # coefficients of a quadratic surface

Patches: TypeAlias = tuple[IntArray, IntArray]
"""Groups of neighbours: the m rows of a batch that are in one, and their places among these rows,
shape (p, 32) or (p, 16), patch by patch."""


def patches_of(batch: Batch, *, at_borders: bool, most: int = PATCHES) -> Patches | None:
    """Return patches of neighbours; None where there are too few points, or too sparse ones.

    With `at_borders` those of dense clouds lie where the nearest image changes.
    """
    from scipy.spatial import cKDTree

    usable, fewest, largest = np.arange(len(batch)), FEWEST_WITHOUT_LIST, PATCH_POINTS[0]
    if batch.views is not None:
        usable = np.flatnonzero(np.diff(batch.views.start) >= 2)
        fewest, largest = FEWEST_POINTS, PATCH_POINTS[-1]
    if len(usable) < fewest:
        return None
    width_m = PATCH_WIDTH * flying_height_m(batch)
    # the area of the points, in squares as wide as a patch: of their rectangle or, if it has gaps,
    # of the squares that hold points; by axis, because numpy is slow along the short one
    x, y = (batch.xyz[usable, axis] for axis in (0, 1))
    extent = np.maximum([np.ptp(x), np.ptp(y)], width_m)
    column, row = (np.floor((one - one.min()) / width_m).astype(np.int64) for one in (x, y))
    squares = len(np.unique(column * (int(row.max()) + 1) + row))
    covered = min(float(extent.prod()) / width_m**2, squares)
    for points in (n for n in PATCH_POINTS if n <= largest):
        # so dense that the points of a patch spread over its width
        some = usable[:: max(1, int(len(usable) / max(FEWEST_POINTS, points * covered)))]
        xy = batch.xyz[some, :2]
        close = np.arange(len(xy))
        if at_borders and points == PATCH_POINTS[0]:
            border_m = _border_distance_m(xy, batch.survey.cameras.centres[:, :2])
            close = np.sort(np.argsort(border_m)[: max(most, int(BORDER_SHARE * len(xy)))])
        seeds = np.unique(close[np.linspace(0, len(close) - 1, most).astype(int)])
        tree = cKDTree(xy, balanced_tree=False, compact_nodes=False)
        patch = some[tree.query(xy[seeds], k=points)[1]]
        across = np.ptp(batch.xyz[patch, :2], axis=1).prod(axis=1)
        is_wide = math.sqrt(np.median(across)) * PATCH_WIDTH > WIDEST_PATCH * width_m
        if batch.views is not None or not is_wide:
            rows, place = np.unique(patch, return_inverse=True)
            return rows, place.reshape(patch.shape)
    return None


def _border_distance_m(xy: FloatArray, centres: FloatArray) -> FloatArray:
    """Return how far points are, in plan, from where the nearest image changes, metres."""
    from scipy.spatial import cKDTree

    if len(centres) < 2:
        return np.zeros(len(xy))
    tree, workers = cKDTree(centres), current().threads
    distance, near = map(np.asarray, tree.query(xy, k=2, workers=workers))
    base = np.linalg.norm(centres[near[:, 0]] - centres[near[:, 1]], axis=1)
    # of the bisector of the two centres: (d2^2 - d1^2) / 2 b
    return np.asarray(np.diff(distance**2)[:, 0] / (2.0 * np.maximum(base, 1e-9)))


class Squares:
    """Points of a large cloud with their neighbours: those of some squares for patches of a width.

    A square is taken by a hash of its place, and their share is halved while the points are too
    many, so that chunks and tiles of other sizes lead to the same points.
    """

    def __init__(self, width_m: float) -> None:
        self._width_m = SQUARE_PATCHES * width_m
        self._share = 1.0
        self._taken = list[tuple[Batch, FloatArray]]()

    def add(self, batch: Batch) -> None:
        """Add the points within the squares."""
        x, y = np.floor(batch.xyz[:, :2].T / self._width_m).astype(np.int64).view(np.uint64)
        mixed = (x * np.uint64(_MIX[0])) ^ (y * np.uint64(_MIX[1]))
        mixed = (mixed ^ (mixed >> np.uint64(32))) * np.uint64(_MIX[2])
        # a number from 0 to 1 for each square
        self._taken.append(self._inside(batch, np.asarray((mixed >> np.uint64(11)) / 2.0**53)))
        while sum(len(one) for one, _ in self._taken) > MOST_IN_SQUARES:
            self._share /= 2.0
            self._taken = [self._inside(*one) for one in self._taken]

    def _inside(self, batch: Batch, rank: FloatArray) -> tuple[Batch, FloatArray]:
        rows = np.flatnonzero(rank < self._share)
        return batch.take(rows), rank[rows]

    def all(self) -> Batch:
        """Return the points."""
        return stacked([batch for batch, _ in self._taken])


def others_around(batch: Batch, rows: IntArray) -> Batch:
    """Return other points around some, as near as there are."""
    from scipy.spatial import cKDTree

    others = np.setdiff1d(np.arange(len(batch)), rows, assume_unique=True)
    if batch.views is not None or len(others) < PATCH_POINTS[-1]:
        return batch.take(rows)
    tree = cKDTree(batch.xyz[others, :2], balanced_tree=False, compact_nodes=False)
    near = tree.query(batch.xyz[rows[::4], :2], k=PATCH_POINTS[-1])[1]
    return batch.take(others[np.unique(near)])


def flying_height_m(batch: Batch) -> float:
    """Return the height of the cameras above the water, in the median."""
    return float(np.median(batch.survey.cameras.centres[:, 2]) - batch.surface.height_m.mean())


def gsd_m(batch: Batch) -> float:
    """Return the ground size of a pixel straight below, metres."""
    lenses = batch.survey.cameras.lenses or ()
    return flying_height_m(batch) / float(np.median([lens.focal_px for lens in lenses]))


def shares(part: Batch, place: IntArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return beta of each correction a against each b, and its standard error, shapes (h, h).

    `part` are the m points of the patches, and `z`, shape (h, m), their corrected heights.
    """
    h = len(z)
    beta, sigma = np.full((2, h, h), np.nan)
    smooth = smooth_surfaces(part.xyz[place])
    level, apparent = part.surface.height_m[place], part.xyz[place, 2]
    noise = _rest(smooth, apparent)
    spread = np.sqrt((noise**2).mean(axis=1))
    weight = 1.0 / np.maximum(spread, max(float(np.median(spread)), 1e-6)) ** 2
    depth = np.maximum((level - apparent).mean(axis=1), 1e-6)
    rest = [_rest(smooth, one[place]) for one in z]
    gain = [(level - one[place]).mean(axis=1) / depth for one in z]
    for a in range(h):
        for b in range(h):
            if a == b:
                continue
            d = rest[a] - rest[b] - (gain[a] - gain[b])[:, None] * noise
            inner, square = weight * (rest[a] * d).sum(axis=1), weight * (d * d).sum(axis=1)
            total = max(float(square.sum()), 1e-12)
            beta[a, b] = inner.sum() / total
            sigma[a, b] = np.sqrt(((inner - beta[a, b] * square) ** 2).sum()) / total
    return beta, sigma


def scatter_m(part: Batch, place: IntArray, z: FloatArray) -> float:
    """Return the scatter of neighbours about a smooth surface, standard deviation, metres."""
    rest = _rest(smooth_surfaces(part.xyz[place]), z[place])
    return math.sqrt(float(np.nanmedian((rest**2).sum(axis=1) / (place.shape[1] - _TERMS))))


def smooth_surfaces(patch: FloatArray) -> FloatArray:
    """Return an orthonormal basis of quadratic surfaces over patches, (p, k, 3), as (p, k, 6)."""
    across = patch[..., :2] - patch[..., :2].mean(axis=1, keepdims=True)
    x, y = np.moveaxis(across / (np.abs(across).max(axis=(1, 2), keepdims=True) + 1e-9), -1, 0)
    columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    return np.asarray(np.linalg.qr(columns)[0])


def _rest(smooth: FloatArray, z: FloatArray) -> FloatArray:
    """Return what is left of heights, (p, k), without the nearest smooth surface."""
    return z - np.einsum("pki,pi->pk", smooth, np.einsum("pki,pk->pi", smooth, z))


def grid_m(xyz: FloatArray) -> float | None:
    """Return the step of the grid that points, shape (m, 3), lie on; None if they lie on none.

    Where coordinates are rounded as coarsely as the points are dense, that is no grid.
    """
    steps = []
    for axis in (0, 1):
        values = np.unique(np.round(xyz[:, axis], 4))
        if len(values) < 10 or len(values) > len(xyz) / 4:
            return None
        gap = np.diff(values)
        step = float(np.median(gap))
        is_integer = np.abs(gap / step - np.rint(gap / step)) < 0.02
        if not is_integer.mean() > GRID_SHARE:
            return None
        steps.append(step)
    return float(np.mean(steps))
