"""Simulate dense matchers: which images they match, and their clouds.

*Pairs* are semi-global matching with a median: each image is matched with its neighbours, every
pair that shows a point measures it independently, and the point is the median of the
intersections, axis by axis. *Depth maps* are in `tests.utils.matchers.depth_maps`.
"""

from typing import NamedTuple

import numpy as np

from pcfix.model import FloatArray, IntArray
from pcfix.simulate.scene import Visible, starts
from pcfix.simulate.tracing import triangulate

SAMPLE = 1000  # points that overlap and angles are judged by

OPTIMAL_DEG, SPREAD_BELOW_DEG, SPREAD_ABOVE_DEG = 10.0, 4.0, 10.0

TIES = 4000  # tie points that OpenMVS's choice is made by; ten for each image where that is more

FOUND_AGAIN_DEG = 45.0
BEST_DEG, BELOW_DEG, ABOVE_DEG, LEAST_WEIGHT = 12.0, 0.38 * 12.0, 0.70 * 12.0, 0.1
FARTHER = 1.6
CELLS = 16
LEAST_COMMON, LEAST_AREA, LEAST_LEFT = 3, 0.05, 9
SCALES, ANGLES_DEG = (0.2, 3.2), (3.0, 65.0)
MOST, AVERAGED = 12, 8
LEAST_SCORE = 0.03


class Partners(NamedTuple):
    """The partners that OpenMVS would select for each of k images; best first, -1 for none.

    `matched`, shape (k, c), are for the depth map, `averaged`, (k, 8), for averaging maps and
    `fused`, (k, 12), for fusion; `known`, (k,), counts images with common tie points.
    """

    matched: IntArray
    averaged: IntArray
    fused: IntArray
    known: IntArray


def neighbour_table(imaged: Visible, count: int) -> IntArray:
    """Return the best neighbours of each image, shape (k, count), best first, -1 for none.

    An image scores for every common point, by a bell about an angle of 10 degrees between the rays,
    wider above: in the manner of OpenMVS.
    """
    centres = imaged.site.true.centres
    k = len(centres)
    score = np.zeros((k, k))
    for i, place in enumerate(imaged.truth):
        seen = imaged.camera[imaged.start[i] : imaged.start[i + 1]]
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
    ties: FloatArray, imaged: Visible, count: int, rng: np.random.Generator
) -> Partners:
    """Return the partners that OpenMVS 2.3 would choose (`Scene::SelectNeighborViews`).

    Each tie point is a feature of one image, found in others with a probability that falls with the
    angle, so nadir and oblique images have few in common. The weight of the region of interest and
    the least score are not modelled. `ties`, shape (p, 3), are the reconstructed tie points,
    `count` the partners of a depth map; `rng` selects which features are found.
    """
    cameras, optics = imaged.site.given, imaged.site.optics
    k = len(cameras)
    # the cell of each image in which each tie point is found, shape (k, p), -1 for none
    cell = np.full((k, len(ties)), -1)
    share = optics.to_image(imaged.ideal) / [optics.lens.width, optics.lens.height]
    column, row = np.clip((CELLS * share).astype(int), 0, CELLS - 1).T
    cell[imaged.camera, imaged.point] = row * CELLS + column
    cell[_lost(ties, imaged, cameras.centres, rng)] = -1
    axes = cameras.rotations[:, 2]
    depth = np.einsum("ki,kpi->kp", axes, ties - cameras.centres[:, None])
    table, known = np.full((k, max(MOST, count)), -1), np.zeros(k, int)
    matched = np.full((k, count), -1)
    for i in range(k):
        visible = np.flatnonzero(cell[i] >= 0)
        common = cell[:, visible] >= 0
        common[i] = False
        counts = common.sum(axis=1)
        rays = cameras.centres[:, None] - ties[visible]
        rays /= np.linalg.norm(rays, axis=2)[:, :, None]
        cosine = np.einsum("kmi,mi->km", rays, rays[i])
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        spread = np.where(angle < BEST_DEG, BELOW_DEG, ABOVE_DEG)
        bell = np.exp(-0.5 * ((angle - BEST_DEG) / spread) ** 2)
        scale = depth[:, visible] / depth[i, visible]
        coarse = np.where(scale > FARTHER, (FARTHER / scale) ** 2, np.minimum(scale, 1.0) ** 2)
        weight = np.maximum(bell, LEAST_WEIGHT) * coarse
        # the share of the reference's cells that holds points in common with each image
        holds = np.zeros((len(visible), CELLS * CELLS))
        holds[np.arange(len(visible)), cell[i, visible]] = 1.0
        area = (common.astype(float) @ holds > 0.0).sum(axis=1) / CELLS**2
        score = (common * weight).sum(axis=1) * np.maximum(area, 0.01)
        good = area >= LEAST_AREA
        for values, (low, high) in ((scale, SCALES), (angle, ANGLES_DEG)):
            mean = (common * values).sum(axis=1) / np.maximum(counts, 1)
            good &= (mean >= low) & (mean <= high)
        order = np.argsort(-score, kind="stable")
        order = order[counts[order] >= LEAST_COMMON]
        retained = list(order)
        for candidate in order[::-1]:  # bad ones go, from the worst up, while more than nine remain
            if len(retained) > LEAST_LEFT and not good[candidate]:
                retained.remove(candidate)
        retained = retained[: table.shape[1]]
        table[i, : len(retained)], known[i] = retained, len(order)
        strong = [one for one in retained[:count] if score[one] >= LEAST_SCORE * score[retained[0]]]
        matched[i, : len(strong)] = strong
    return Partners(matched, table[:, :AVERAGED], table[:, :MOST], known)


def _lost(
    ties: FloatArray, imaged: Visible, centres: FloatArray, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Return cameras and points where a feature is not found again."""
    luck = rng.uniform(0.0, 1.0, len(ties))
    home = imaged.start[:-1] + (luck * np.diff(imaged.start)).astype(int)
    first = np.minimum(home, max(0, len(imaged.camera) - 1))[imaged.point]
    ray = centres[imaged.camera] - ties[imaged.point]
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    cosine = np.einsum("mi,mi->m", ray, ray[first])
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    gone = rng.uniform(0.0, 1.0, len(ray)) > np.exp(-((angle / FOUND_AGAIN_DEG) ** 2))
    return imaged.camera[gone], imaged.point[gone]


def rows_of(imaged: Visible) -> IntArray:
    """Return the row of each point and camera, shape (n, k), -1 where there is none."""
    rows = np.full((len(imaged.truth), len(imaged.site.true)), -1)
    rows[imaged.point, imaged.camera] = np.arange(len(imaged.point))
    return rows


def match_pairs(
    imaged: Visible, table: IntArray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Return the medians of the pairs of each point, the true points, and the images in pairs.

    A point without a pair stays where it is and has no cameras. `table`, shape (k, c), has the
    neighbours of each camera, -1 for none; `rng` makes the noise, of two image points a pair.
    """
    # the rows that are pairs, each once, sorted by point, then camera
    k, rows = len(table), rows_of(imaged)
    match = np.zeros((k, k + 1), bool)
    match[np.arange(k)[:, None], table] = True  # the column k, or -1, is for "none"
    match = match[:, :k]
    first, second = np.nonzero(np.triu(match | match.T, 1))
    owner, pair = np.nonzero((rows[:, first] >= 0) & (rows[:, second] >= 0))
    one, other = rows[owner, first[pair]], rows[owner, second[pair]]
    site, truth, point = imaged.site, imaged.truth, imaged.point[one]
    both = np.column_stack([one, other]).ravel()
    places = triangulate(
        site.observed(imaged.ideal[both], rng),
        site.given,
        imaged.camera[both],
        np.arange(0, len(both) + 1, 2),
        site.optics.lens,
        truth[point],
    )
    start = starts(np.bincount(point, minlength=len(truth)))
    xyz, paired = truth.copy(), np.diff(start) > 0
    low, high = (start[:-1] + (np.diff(start) + i) // 2 for i in (-1, 0))
    for axis in range(3):
        ordered = places[np.lexsort((places[:, axis], point)), axis]
        xyz[paired, axis] = (ordered[low[paired]] + ordered[high[paired]]) / 2.0
    used = np.zeros(len(imaged.point), bool)
    used[both] = True
    count = np.bincount(imaged.point[used], minlength=len(truth))
    return xyz, truth, imaged.camera[used], count
