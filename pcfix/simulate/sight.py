"""Which images show which points and are matched with each other; clouds of tracks and pairs.

A point of a cloud of *tracks* is intersected from all images that show it. *Pairs* are semi-global
matching with a median: each image is matched with its neighbours, every pair that shows a point
measures it anew in both images, and the point is the median of the intersections, axis by axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcfix.model import Cameras, FloatArray, IntArray, Views
from pcfix.simulate.optics import Optics
from pcfix.simulate.tracing import Water, project, rotations_of, triangulate

LEAST_VIEWS = 3


def starts_of(point: IntArray, count: int) -> IntArray:
    """Return where the rows of each of `count` points begin, and the end, where rows are sorted."""
    return np.concatenate([[0], np.cumsum(np.bincount(point, minlength=count))])


@dataclass(frozen=True, eq=False)
class Rig:
    """True and given poses, optics, water and noise of the images.

    `true` are the poses of the images, `given` those for the intersection. Nothing is below
    `lowest_m`.
    """

    true: Cameras
    given: Cameras
    optics: Optics
    water: Water
    lowest_m: float
    image_noise_px: float
    detection: float

    def observed(self, ideal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return ideal pixels as measured: noise is on the image, which is then undistorted.

        Dense matchers and the rays of tie points use undistorted images too.
        """
        image = self.optics.to_image(ideal)
        return self.optics.to_ideal(image + rng.normal(0.0, self.image_noise_px, image.shape))


@dataclass(frozen=True, eq=False)
class Sight:
    """The m pairs of one of n points and an image that shows it, sorted by point, then camera.

    Point i of `truth`, shape (n, 3), has the pairs from ``start[i]`` to ``start[i + 1]``; `ideal`,
    shape (m, 2), are ideal pixels without noise.
    """

    rig: Rig
    truth: FloatArray
    start: IntArray
    point: IntArray
    camera: IntArray
    ideal: FloatArray

    @property
    def paired(self) -> np.ndarray:
        """Which points have pairs, shape (n,)."""
        return np.asarray(np.diff(self.start) > 0)

    def rows(self) -> IntArray:
        """Return the row of each point and camera, shape (n, k), -1 where there is none."""
        rows = np.full((len(self.truth), len(self.rig.true)), -1)
        rows[self.point, self.camera] = np.arange(len(self.point))
        return rows

    def intersected(self, pixels: FloatArray) -> FloatArray:
        """Return where straight rays through ideal pixels, (m, 2), meet with least residuals.

        Shape (n, 3); a point without pairs stays where it is.
        """
        paired, apparent = self.paired, self.truth.copy()
        if paired.any():
            starts = np.concatenate([self.start[:-1][paired], self.start[-1:]])
            apparent[paired] = triangulate(
                pixels, self.rig.given, self.camera, starts, self.rig.optics.lens, apparent[paired]
            )
        return apparent


def see(truth: FloatArray, rig: Rig, rng: np.random.Generator) -> Sight:
    """Trace every point, shape (n, 3), into every image; those in fewer than three have no pairs.

    `rng` says what is detected.
    """
    cameras = rig.true
    across = truth[:, None, 0] - cameras.centres[:, 0], truth[:, None, 1] - cameras.centres[:, 1]
    point, camera = np.nonzero(np.hypot(*across) < _reach_m(rig))
    surface = rig.water.piercing_points(truth[point], cameras.centres[camera], camera)
    ideal, z = project(surface, cameras, camera, rig.optics.lens)
    inside = (z > 0) & rig.optics.frames(rig.optics.to_image(ideal))
    point, camera, ideal = point[inside], camera[inside], ideal[inside]
    taken = _detected(point, rig.detection, rng)
    taken &= np.bincount(point, minlength=len(truth))[point] >= LEAST_VIEWS
    point, camera, ideal = point[taken], camera[taken], ideal[taken]
    return Sight(rig, truth, starts_of(point, len(truth)), point, camera, ideal)


def _reach_m(rig: Rig) -> FloatArray:
    """Return how far from below each camera it can see anything, metres, shape (k,).

    Generous: the flattest ray of the frame's corner, prolonged as if there were no refraction.
    """
    off_nadir = np.arccos(np.clip(-rotations_of(rig.true)[:, 2, 2], -1.0, 1.0))
    flattest = np.minimum(np.arctan(rig.optics.reach) + off_nadir, np.radians(80.0))
    return np.asarray((rig.true.centres[:, 2] - rig.lowest_m) * np.tan(flattest))


def _detected(point: IntArray, probability: float, rng: np.random.Generator) -> np.ndarray:
    """Return which pairs take part: by chance, but the luckiest three of a point always."""
    if probability >= 1.0:
        return np.ones(len(point), bool)
    luck = rng.uniform(0.0, 1.0, len(point))
    order = np.lexsort((luck, point))
    first = np.searchsorted(point, point)  # the row at which each pair's point begins
    rank = np.empty(len(point), np.int64)
    rank[order] = np.arange(len(point)) - first
    return np.asarray((luck < probability) | (rank < LEAST_VIEWS))


SAMPLE = 1000
"""Points that overlap and angles are judged by."""

OPTIMAL_DEG, SPREAD_BELOW_DEG, SPREAD_ABOVE_DEG = 10.0, 4.0, 10.0

TIES = 4000
"""Tie points that OpenMVS's choice is made by; ten for each image where that is more."""

FOUND_AGAIN_DEG = 45.0
BEST_DEG, BELOW_DEG, ABOVE_DEG, LEAST_WEIGHT = 12.0, 0.38 * 12.0, 0.70 * 12.0, 0.1
FARTHER = 1.6
CELLS = 16
LEAST_COMMON, LEAST_AREA, LEAST_LEFT = 3, 0.05, 9
SCALES, ANGLES_DEG = (0.2, 3.2), (3.0, 65.0)
MOST, AVERAGED = 12, 8
LEAST_SCORE = 0.03


class Part(NamedTuple):
    """Some points of a cloud, shape (n, 3), the true points, and the images of each.

    In a cloud of pairs, point i has the rows ``pairs_start[i]`` to ``pairs_start[i + 1]`` of
    `pairs`, shape (p, 2), the lower camera first.
    """

    xyz: FloatArray
    true_xyz: FloatArray
    views: Views
    pairs: IntArray | None = None
    pairs_start: IntArray | None = None


class Partners(NamedTuple):
    """The partners that OpenMVS would select for each of k images; best first, -1 for none.

    `matched`, shape (k, c), are for the depth map, `averaged`, (k, 8), for averaging maps and
    `fused`, (k, 12), for fusion; `known`, (k,), counts images with common tie points.
    """

    matched: IntArray
    averaged: IntArray
    fused: IntArray
    known: IntArray


def neighbour_table(sight: Sight, count: int) -> IntArray:
    """Return the best neighbours of each image, shape (k, count), best first, -1 for none.

    An image scores for every common point, by a bell about an angle of 10 degrees between the rays,
    wider above: in the manner of OpenMVS.
    """
    centres = sight.rig.true.centres
    k = len(centres)
    score = np.zeros((k, k))
    for i, place in enumerate(sight.truth):
        seen = sight.camera[sight.start[i] : sight.start[i + 1]]
        ray = centres[seen] - place
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        angle = np.degrees(np.arccos(np.clip(ray @ ray.T, -1.0, 1.0)))
        spread = np.where(angle < OPTIMAL_DEG, SPREAD_BELOW_DEG, SPREAD_ABOVE_DEG)
        score[np.ix_(seen, seen)] += np.exp(-0.5 * ((angle - OPTIMAL_DEG) / spread) ** 2)
    np.fill_diagonal(score, 0.0)
    best = np.argsort(-score, axis=1, kind="stable")[:, :count]
    table = np.full((k, count), -1)
    table[:, : best.shape[1]] = np.where(np.take_along_axis(score, best, axis=1) > 0.0, best, -1)
    return table


def openmvs_partners(
    ties: FloatArray, sight: Sight, count: int, rng: np.random.Generator
) -> Partners:
    """Return the partners that OpenMVS 2.3 would choose (`Scene::SelectNeighborViews`).

    Each tie point is a feature of one image, found in others with a probability that falls with the
    angle, so nadir and oblique images have few in common. The weight of the region of interest and
    the least score are not modelled. `ties`, shape (p, 3), are the reconstructed tie points,
    `count` the partners of a depth map; `rng` selects which features are found.
    """
    cameras = sight.rig.given
    k = len(cameras)
    cell = _cells(sight)
    cell[_lost(ties, sight, cameras.centres, rng)] = -1
    axes = rotations_of(cameras)[:, 2]
    depth = np.einsum("ki,kpi->kp", axes, ties - cameras.centres[:, None])
    table, known = np.full((k, max(MOST, count)), -1), np.zeros(k, int)
    matched = np.full((k, count), -1)
    for i in range(k):
        visible = np.flatnonzero(cell[i] >= 0)
        common = cell[:, visible] >= 0
        common[i] = False
        angle = _angles_deg(cameras.centres, i, ties[visible])
        scale = depth[:, visible] / depth[i, visible]
        area = _shares_of_cells(common, cell[i, visible])
        score = (common * _weights(angle, scale)).sum(axis=1) * np.maximum(area, 0.01)
        order = np.argsort(-score, kind="stable")
        order = order[common.sum(axis=1)[order] >= LEAST_COMMON]
        good = (area >= LEAST_AREA) & _within(common, scale, SCALES)
        good &= _within(common, angle, ANGLES_DEG)
        kept = _filtered(order, good)[: table.shape[1]]
        table[i, : len(kept)], known[i] = kept, len(order)
        strong = kept[:count][score[kept[:count]] >= LEAST_SCORE * score[kept[:1]]]
        matched[i, : len(strong)] = strong
    return Partners(matched, table[:, :AVERAGED], table[:, :MOST], known)


def _cells(sight: Sight) -> IntArray:
    """Return in which cell of each image each point lies, shape (k, p), -1 where it is not."""
    optics = sight.rig.optics
    cell = np.full((len(sight.rig.true), len(sight.truth)), -1)
    share = optics.to_image(sight.ideal) / [optics.lens.width, optics.lens.height]
    column, row = np.clip((CELLS * share).astype(int), 0, CELLS - 1).T
    cell[sight.camera, sight.point] = row * CELLS + column
    return cell


def _lost(
    ties: FloatArray, sight: Sight, centres: FloatArray, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Return cameras and points where a feature is not found again."""
    count = np.diff(sight.start)
    luck = rng.uniform(0.0, 1.0, len(ties))
    home = sight.start[:-1] + (luck * count).astype(int)
    first = np.minimum(home, max(0, len(sight.camera) - 1))[sight.point]
    ray = centres[sight.camera] - ties[sight.point]
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    cosine = np.einsum("mi,mi->m", ray, ray[first])
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    gone = rng.uniform(0.0, 1.0, len(ray)) > np.exp(-((angle / FOUND_AGAIN_DEG) ** 2))
    return sight.camera[gone], sight.point[gone]


def _angles_deg(centres: FloatArray, i: int, places: FloatArray) -> FloatArray:
    """Return the angles at places between the rays to image i and to every other, (k, m)."""
    rays = centres[:, None] - places
    rays /= np.linalg.norm(rays, axis=2)[:, :, None]
    cosine = np.einsum("kmi,mi->km", rays, rays[i])
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _weights(angle_deg: FloatArray, scale: FloatArray) -> FloatArray:
    spread = np.where(angle_deg < BEST_DEG, BELOW_DEG, ABOVE_DEG)
    bell = np.exp(-0.5 * ((angle_deg - BEST_DEG) / spread) ** 2)
    coarse = np.where(scale > FARTHER, (FARTHER / scale) ** 2, np.minimum(scale, 1.0) ** 2)
    return np.asarray(np.maximum(bell, LEAST_WEIGHT) * coarse)


def _shares_of_cells(common: np.ndarray, cell: IntArray) -> FloatArray:
    """Return what share of the reference's cells holds points in common with each image, (k,)."""
    holds = np.zeros((len(cell), CELLS * CELLS))
    holds[np.arange(len(cell)), cell] = 1.0
    return np.asarray((common.astype(float) @ holds > 0.0).sum(axis=1) / CELLS**2)


def _within(common: np.ndarray, values: FloatArray, limits: tuple[float, float]) -> np.ndarray:
    mean = (common * values).sum(axis=1) / np.maximum(common.sum(axis=1), 1)
    return np.asarray((mean >= limits[0]) & (mean <= limits[1]))


def _filtered(order: IntArray, good: np.ndarray) -> IntArray:
    """Drop bad candidates from the worst up, while more than nine remain."""
    kept = list(order)
    for candidate in order[::-1]:
        if len(kept) <= LEAST_LEFT:
            break
        if not good[candidate]:
            kept.remove(candidate)
    return np.array(kept, int)


def match_pairs(sight: Sight, table: IntArray, rng: np.random.Generator) -> Part:
    """Return the medians of the pairs of each point, shape (n, 3).

    A point without a pair stays where it is and has no cameras. `table`, shape (k, c), has the
    neighbours of each camera, -1 for none; `rng` makes the noise, of two image points a pair.
    """
    one, other = pair_rows(sight, table)
    rig, truth, point = sight.rig, sight.truth, sight.point[one]
    both = np.column_stack([one, other]).ravel()
    places = triangulate(
        rig.observed(sight.ideal[both], rng),
        rig.given,
        sight.camera[both],
        np.arange(0, len(both) + 1, 2),
        rig.optics.lens,
        truth[point],
    )
    start = starts_of(point, len(truth))
    xyz, paired = truth.copy(), np.diff(start) > 0
    for axis in range(3):
        xyz[paired, axis] = _medians(places[:, axis], point, start)[paired]
    used = np.zeros(len(sight.point), bool)
    used[both] = True
    views = Views(starts_of(sight.point[used], len(truth)), sight.camera[used])
    pairs = np.column_stack([sight.camera[one], sight.camera[other]])
    return Part(xyz, truth, views, pairs, start)


def pair_rows(sight: Sight, table: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows of `sight` that are pairs, each once, sorted by point, then camera."""
    k, rows = len(table), sight.rows()
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
