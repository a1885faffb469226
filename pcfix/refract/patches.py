"""Measure how well reconstruction types explain patches of neighbouring points.

**Discontinuities between image footprints.** The same apparent points are corrected for two
reconstruction types. Where the images that see a point change, the two corrections differ by a
discontinuity. The bed of the right one is smooth there; that of the wrong one has the discontinuity
by which the two differ.

With r_a and r_b the residuals of the two beds from a quadratic surface over a patch of neighbours,
and d = r_a - r_b, the share of d that is in r_a is

    beta = sum(w r_a d) / sum(w d d),

near 0 if a is right and near 1 if b is. The weights are one over the square of the scatter of the
apparent patch. Noise of the points is in r_a and r_b by the factors by which either makes depths
larger; that part of d is subtracted first.

**Likelihood.** A reconstruction type says where the true point of an apparent one may be: at one
place or, where one of several images or groups of images reconstructed it, at candidates k with
probabilities p_k. With the bed of a patch of neighbours as a quadratic surface, the apparent point
has the density

    sum_k p_k t(r_k / sigma) / sigma,    r_k = (z_k - bed) / g_k,

where g_k is the true by the apparent depth, so that sigma is the noise of apparent heights for all
types, and t is Student's distribution of 7 degrees of freedom. A wrong type leaves discontinuities
where the images change, or predicts another scatter of neighbours than they have.

The bed is fitted to three quarters of a patch and predicts the others, in turn: a type with many
candidates gains nothing by fitting noise.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Batch, stacked
from pcfix.running import current

# To detect the type, and to test one that the user set: the standard error of the evidence is
# mostly that of the models, which more patches do not lower.
PATCHES, TEST_PATCHES = 750, 500
FEWEST_POINTS = 400
PATCH_POINTS = (32, 16)  # of a patch, or of sparse clouds
FEWEST_WITHOUT_LIST = 2000  # fewer are tie points, and their patches overlap

# In flying heights: so wide that image borders cross many patches. In wider ones relief hides the
# discontinuities.
PATCH_WIDTH, WIDEST_PATCH = 0.04, 0.055

# Share of the points, nearest to where the nearest image changes, that the patches of dense clouds
# lie around: only there the maps of nearest images leave discontinuities.
BORDER_SHARE = 0.08

GRID_SHARE = 0.9  # share of neighbours whole steps apart from which a cloud is a grid
SMOOTH_GSD = 0.02  # least scatter of neighbours: image noise leaves ten times that
SQUARE_PATCHES, MOST_IN_SQUARES = 5.0, 1_000_000  # width of a square in patches; points in squares
_MIX = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0xD6E8FEB86659FD93)  # odd numbers of a hash
_TERMS = 6  # coefficients of a quadratic surface


def patches_of(
    batch: Batch, *, at_borders: bool, most: int = PATCHES
) -> tuple[IntArray, IntArray] | None:
    """Return patches of neighbours; None where there are too few points, or too sparse ones.

    Returns the m rows of the batch that are in a patch, and the places of the points of each patch
    among these, shape (p, 32) or (p, 16). With `at_borders` the patches of dense clouds lie where
    the nearest image changes.
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


FOLDS = 4
STARTS = (0.0, 0.75, -0.75, 1.5, -1.5)  # first beds, above that through the mean, by its spread
# Noise of the steps to the bed, by sigma: wide at first, so that no candidate is excluded.
WIDER = (3.0, 2.0, 1.4, 1.0, 1.0)
AGAIN = WIDER[-2:]  # the same from a bed that was found with another sigma
FREEDOM, DENSITY = 7.0, 0.385  # degrees of freedom of t, for a whole number as power, and t(0)
SIGMA_GSD, SIGMAS_GSD = 0.8, (0.05, 30.0)  # first noise, and its range
OUTLIER_GSD = 0.01  # density of points that are mismatches, per ground pixel
MOST_A_POINT = 0.25  # difference of two log likelihoods a point at most: no patch decides alone
# Standard error of the mean difference, per point, as no model is exact: of simulated and rendered
# clouds of every type.
MODEL_ERROR = 0.0125


class Candidates(NamedTuple):
    """Where the true points of m apparent ones may be; NaN and 0 where there are fewer."""

    height_m: FloatArray  # (m, k)
    prior: FloatArray  # (m, k), relative probabilities


def log_likelihood(
    terms: FloatArray, apparent_m: FloatArray, level_m: FloatArray, candidates: Candidates,
    gsd_m: float,
) -> FloatArray:  # fmt: skip
    """Return the log likelihood of each of p patches of n points, per point, shape (p,).

    `terms`, shape (p, n, 6), is a basis of quadratic surfaces, the first of them constant;
    `apparent_m` and `level_m`, shape (p, n), are the heights of the points and of the water, and
    the candidates have the shape (p, n, k).
    """
    known = np.isfinite(candidates.height_m)
    height = np.where(known, candidates.height_m, 0.0).astype(np.float64)
    prior = np.where(known, candidates.prior, 0.0)
    prior /= np.maximum(prior.sum(axis=2, keepdims=True), 1e-12)
    depth = np.maximum(level_m - apparent_m, 0.05)
    gain = np.clip((level_m[..., None] - height) / depth[..., None], 1.0, 4.0)
    # of the candidates of each patch about their means: how far apart beds may be
    mean = (prior * height).sum(axis=2, keepdims=True)
    spread = np.sqrt((prior * (height - mean) ** 2).sum(axis=2).mean(axis=1))
    rest, sigma = np.empty_like(height), SIGMA_GSD * gsd_m
    beds = np.full((len(terms), FOLDS, terms.shape[2]), np.nan)

    def log_density(log_sigma: float) -> FloatArray:
        sigma = np.exp(log_sigma)
        near = 1.0 + (rest / sigma) ** 2 / FREEDOM
        near *= near  # twice, as powers of numpy are slow
        near *= near
        t = DENSITY / sigma * (prior / near).sum(axis=2)
        return np.asarray(np.log(t + OUTLIER_GSD / gsd_m))

    def misfit(log_sigma: float) -> float:
        return -float(log_density(log_sigma).sum())

    bounds = np.log(np.multiply(SIGMAS_GSD, gsd_m)).tolist()
    for _ in range(2):
        in_tiles(_predict, len(terms), terms, height, gain, prior, spread, sigma, beds, rest)
        found = minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": 0.02})
        sigma = float(np.exp(found.x))
    return np.asarray(log_density(found.x).mean(axis=1))


def standard_errors(of: FloatArray, other: FloatArray, model_error: float = MODEL_ERROR) -> float:
    """Return by how many standard errors one type is more likely than another.

    From their log likelihoods of the same patches, per point.
    """
    gain = np.clip(of - other, -MOST_A_POINT, MOST_A_POINT)
    return float(gain.mean() / np.hypot(gain.std() / np.sqrt(len(gain)), model_error))


@kernel(allocates=True)
def _predict(
    span: Span, terms: FloatArray, height: FloatArray, gain: FloatArray, prior: FloatArray,
    spread: FloatArray, sigma: float, beds: FloatArray, rest: FloatArray,
) -> None:  # fmt: skip
    """Set the residuals of all candidates from the bed of the other points of their patch.

    `beds`, shape (p, FOLDS, 6), are NaN at first, later where the search begins.
    """
    n, k = height.shape[1:]
    bed, best, normal = np.zeros(6), np.zeros(6), np.empty((6, 7))
    for p in range(*span):
        for fold in range(FOLDS):
            most, best[:] = -np.inf, beds[p, fold]
            if not np.isnan(best[0]):
                for wider in AGAIN:
                    _step(terms[p], height[p], gain[p], prior[p], fold, wider * sigma, normal, best)
            else:
                for start in range(len(STARTS) if k > 1 else 1):
                    bed[:] = 0.0
                    # through the mean candidates, with the largest noise that there can be
                    _step(terms[p], height[p], gain[p], prior[p], fold, 1e6, normal, bed)
                    bed[0] += STARTS[start] * spread[p] / terms[p, 0, 0]
                    likelihood = 0.0
                    for wider in WIDER:
                        likelihood = _step(
                            terms[p], height[p], gain[p], prior[p], fold, wider * sigma, normal, bed
                        )
                    if likelihood > most:
                        most = likelihood
                        best[:] = bed
            beds[p, fold] = best
            # the best bed predicts the points that it was not fitted to
            for i in range(fold, n, FOLDS):
                for c in range(k):
                    rest[p, i, c] = (height[p, i, c] - _height(terms[p, i], best)) / gain[p, i, c]


@device
def _height(terms: FloatArray, bed: FloatArray) -> float:
    """Return the height of a bed at a point."""
    total = 0.0
    for a in range(6):
        total += terms[a] * bed[a]
    return total


# sums over candidates in any order are vectorised: three times as fast, equal to 1e-13
@device(fastmath={"reassoc", "contract", "arcp", "nsz"})
def _step(
    terms: FloatArray, height: FloatArray, gain: FloatArray, prior: FloatArray, fold: int,
    sigma: float, normal: FloatArray, bed: FloatArray,
) -> float:  # fmt: skip
    """Fit the bed to the points of the other folds, weighted by the probability of each candidate.

    A step of expectation maximisation. Returns the log likelihood of the bed before it.
    """
    normal[:] = 0.0
    likelihood = 0.0
    for i in range(len(height)):
        if i % FOLDS == fold:
            continue
        at, total, weight, sum_height = _height(terms[i], bed), 0.0, 0.0, 0.0
        for c in range(height.shape[1]):
            r = (height[i, c] - at) / gain[i, c] / sigma
            near = 1.0 / (1.0 + r * r / FREEDOM)
            # probability of the candidate; the weight of a point in t falls with its residual
            likely = prior[i, c] * near * near * near * near
            total += likely
            w = likely * near / (gain[i, c] * gain[i, c])
            weight += w
            sum_height += w * height[i, c]
        if not total > 0.0:
            continue
        likelihood += np.log(total)
        # normal equations of the surface, with the mean candidate as the height of the point
        for a in range(6):
            for b in range(a, 6):
                normal[a, b] += weight / total * terms[i, a] * terms[i, b]
            normal[a, 6] += sum_height / total * terms[i, a]
    _solve(normal, bed)
    return likelihood


@device
def _solve(normal: FloatArray, bed: FloatArray) -> None:
    """Solve six normal equations, of which the upper triangle and the right side are given."""
    for a in range(6):
        normal[a, a] *= 1.0 + 1e-9
        for b in range(a):
            normal[a, b] = normal[b, a]
    for a in range(6):
        pivot = normal[a, a] + 1e-12
        for b in range(a + 1, 6):
            factor = normal[b, a] / pivot
            for c in range(a, 7):
                normal[b, c] -= factor * normal[a, c]
    for a in range(5, -1, -1):
        value = normal[a, 6]
        for b in range(a + 1, 6):
            value -= normal[a, b] * bed[b]
        bed[a] = value / (normal[a, a] + 1e-12)
