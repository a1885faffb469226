"""One stereo pair for each point, for methods that were made for two images.

Their papers had two images; a cloud of today has many, and does not say which two. Here each point
gets, of the cameras that were chosen for it, the pair

- whose ratio of base to height is nearest to the range `BASE_TO_HEIGHT`: below it the depth is
  weak, above it images no longer match well; and
- among those within the range (or equally far from it) the pair whose more slanting ray is the
  steepest, which lies on both sides of the point where there is such a pair. There the two rays
  have nearly the same incidence, for which the methods are exact.

The point was made by more images than these, or by others, so that the pair has another incidence
than the rays that set the apparent depth. With nine nadir images over a point (32 m apart, 80 m up)
that costs some 5 % of the depth at worst.

With the cameras at the plan distances e_1 and e_2 (vectors) and heights z_1 and z_2 from the
point, the ratio is |e_1 / z_1 - e_2 / z_2|: base by height where both are equally high.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from pcfix.model import Views
from pcfix.threads import one_caller

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray
    from pcfix.refract.bundles import Bundle

BASE_TO_HEIGHT = (0.3, 0.6)
"""From an overlap of about 80 % to one of 60 % with the usual lenses, both common in surveys."""


def in_pairs(bundle: Bundle) -> Bundle:
    """Return the bundle with the best pair of each point instead of all its rays.

    Points with one ray keep it and those with none have none, so that the bundle still says what
    becomes of them.
    """
    start = np.concatenate([[0], np.cumsum(np.minimum(bundle.counts, 2))]).astype(np.int64)
    camera = np.empty(start[-1], np.int64)
    with one_caller():
        _choose_pairs(
            np.ascontiguousarray(bundle.xyz),
            np.ascontiguousarray(bundle.cameras.centres),
            np.asarray(bundle.views.start, np.int64),
            np.asarray(bundle.views.camera, np.int64),
            *BASE_TO_HEIGHT,
            start,
            camera,
        )
    return bundle._replace(views=Views(start, camera))


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _choose_pairs(
    xyz: FloatArray, centres: FloatArray, start: IntArray, camera: IntArray, least: float,
    most: float, pair_start: IntArray, pair: IntArray,
) -> None:  # fmt: skip
    """Fill in ``pair[pair_start[i] : pair_start[i + 1]]`` for every point."""
    for i in prange(len(xyz)):
        rays = camera[start[i] : start[i + 1]]
        place = pair_start[i]
        if rays.size == 1:
            pair[place] = rays[0]
        if rays.size > 1:
            first, second = _best_pair(xyz[i], centres, rays, least, most)
            pair[place], pair[place + 1] = rays[first], rays[second]


@njit(cache=True, error_model="numpy", nogil=True)
def _best_pair(
    point: FloatArray, centres: FloatArray, rays: IntArray, least: float, most: float
) -> tuple[int, int]:
    """Return the places of the best pair in the list of at least two rays; of equals the first."""
    k = rays.size
    u, v = np.empty(k), np.empty(k)
    for j in range(k):
        ez = centres[rays[j], 2] - point[2]
        u[j] = (centres[rays[j], 0] - point[0]) / ez
        v[j] = (centres[rays[j], 1] - point[1]) / ez
    best_gap, best_slant, first, second = np.inf, np.inf, 0, 1
    for a in range(k):
        slant_a = u[a] * u[a] + v[a] * v[a]
        for b in range(a + 1, k):
            ratio = np.hypot(u[a] - u[b], v[a] - v[b])
            gap = max(least - ratio, ratio - most, 0.0)
            if gap > best_gap:
                continue
            slant = max(slant_a, u[b] * u[b] + v[b] * v[b])
            if gap < best_gap or slant < best_slant:
                best_gap, best_slant, first, second = gap, slant, a, b
    return first, second
