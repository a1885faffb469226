"""The tests for noise, each of which sets its bit of `Reason` in the rows that fail it.

They are independent of each other: each looks at all used points, whatever another found.
"""

from collections.abc import Iterator, Mapping
from enum import IntFlag
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import bad_file
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.options.steps import LEAST_NEIGHBOURS, CleanRules
from pcfix.points.neighbours import PIECE_ROWS, SLACK, Neighbours, make_tiles
from pcfix.running import current, row_numbers, subset
from pcfix.water.surface import SurfaceAbove, is_submerged

ReasonArray = npt.NDArray[np.uint8]


class Reason(IntFlag):
    """Why a point is noise; one point may have several reasons, one bit each."""

    STATISTICAL = 1
    RADIUS = 2
    FEW_RAYS = 4
    RAY_MISS = 8
    INCIDENCE = 16
    BELOW_BED = 32
    FLOATING = 64


# The tests of weak intersections: a dimension of a corrected cloud, the reason, and the name of the
# threshold and on which side of it a point is noise.
WEAK = {
    "RayCount": (Reason.FEW_RAYS, "min_rays", np.less),
    "RayMiss": (Reason.RAY_MISS, "max_ray_miss", np.greater),
    "Incidence": (Reason.INCIDENCE, "max_incidence", np.greater),
}


class Cloud(NamedTuple):
    """What the tests need of n points."""

    xyz: FloatArray  # (n, 3), metres, world frame
    used: BoolArray  # (n,), the points to test; the others are not neighbours of any
    submerged: BoolArray  # (n,), those of them to test against the bed
    reasons: ReasonArray  # (n,), bits of `Reason`, set by the tests

    def add(
        self, rows: slice, xyz: FloatArray, used: BoolArray, above: SurfaceAbove | None,
        rays: Mapping[str, FloatArray], rules: CleanRules,
    ) -> None:  # fmt: skip
        """Set some rows, and flag the weak intersections among their corrected points.

        `above` is the water; without it the points with rays are submerged. `rays` are the
        dimensions of `WEAK` by name, as far as they are known. Points without rays, which were not
        corrected, have no weak intersection.
        """
        self.xyz[rows], self.used[rows] = xyz, used
        if "RayCount" in rays:
            corrected = used & (rays["RayCount"] > 0)
            self.submerged[rows] = corrected
            for name, (reason, limit, is_beyond) in WEAK.items():
                value = getattr(rules, limit)
                if value is not None and name in rays:
                    self.reasons[rows][corrected & is_beyond(rays[name], value)] |= np.uint8(reason)
        if above is not None:
            self.submerged[rows] = used & is_submerged(xyz[:, 2], above)


def flag_neighbours(name: str, cloud: Cloud, rules: CleanRules) -> dict[str, float]:
    """Run the tests that look at neighbours: see `flag_sparse` and `flag_off_bed`.

    Each reports the number of points of each piece that it has done; see `pcfix.running.Run`.
    """
    on_bed = rules.below_or_floating and cloud.submerged.any()
    what = "points that are neither withheld nor noise"
    remedy = "Use fewer neighbours, or skip the cleaning."
    _require(name, cloud.used, max(LEAST_NEIGHBOURS, rules.nearest), what, remedy)
    if on_bed:
        remedy = "Use fewer bed-neighbours, or switch off the tests below and floating."
        _require(name, cloud.submerged, rules.bed_neighbours, "submerged points", remedy)
    distances = flag_sparse(cloud, rules) if rules.nearest else {}
    if on_bed:
        flag_off_bed(cloud, rules)
    return distances


def _require(name: str, rows: BoolArray, least: int, what: str, remedy: str) -> None:
    """Raise InputError if there are no more points than neighbours are needed."""
    count = int(rows.sum())
    if count <= least:
        sentence = f"has {count:,} {what}, too few for a neighbourhood of {least}. {remedy}"
        raise bad_file(name, "cloud.too_few_points", sentence, points=count, least=least + 1)


def flag_sparse(cloud: Cloud, rules: CleanRules) -> dict[str, float]:
    """Flag statistical and radius outliers: `Reason.STATISTICAL` and `RADIUS`.

    More than ``rules.nearest`` points are used. Returns mean, standard deviation and limit of the
    mean distances to the neighbours, metres; empty without the statistical test.

    Both tests find what open3d's ``remove_statistical_outlier`` and ``remove_radius_outlier``
    find, except in clouds where enough points coincide that the mean distance is zero, or where it
    is the same for all points. There open3d takes all points for outliers, and pcfix none.
    """
    mean_m = np.zeros(len(cloud.xyz)) if rules.statistical else None
    for near, rows, xyz in _pieces(cloud.xyz, cloud.used, 3):
        distance, _ = near.nearest(xyz, rules.nearest)
        if mean_m is not None:
            mean_m[rows] = distance[:, : rules.neighbours].mean(axis=1)
        if rules.radius is not None:
            lonely = distance[:, rules.radius_neighbours] * SLACK >= rules.radius
            cloud.reasons[rows[lonely]] |= np.uint8(Reason.RADIUS)
    if mean_m is None:
        return {}
    known = mean_m[cloud.used]  # in the order of the file
    mean, sd = float(known.mean()), float(known.std(ddof=1))
    limit = mean + (rules.deviations or 0.0) * sd
    cloud.reasons[cloud.used & (mean_m > limit * SLACK)] |= np.uint8(Reason.STATISTICAL)
    return {"mean": mean, "sd": sd, "limit": limit}


def flag_off_bed(cloud: Cloud, rules: CleanRules) -> None:
    """Flag submerged points below the bed (`Reason.BELOW_BED`) and above it (`FLOATING`).

    The bed at a point is the middle half, by height, of the submerged points nearest to it in plan;
    see `CleanRules`. At least ``rules.bed_neighbours`` points are submerged.
    """
    for near, rows, xyz in _pieces(cloud.xyz, cloud.submerged, 2):
        heights = near.tiles.xyz[:, 2][near.nearest(xyz, rules.bed_neighbours)[1]]
        lower, upper = np.percentile(heights, (25, 75), axis=1)
        fence, z = rules.fences * (upper - lower), xyz[:, 2]
        below = Reason.BELOW_BED, rules.below, lower - z
        above = Reason.FLOATING, rules.floating, z - upper
        for reason, least_m, off_m in below, above:
            if least_m is not None:
                off = rows[off_m > np.maximum(fence, least_m)]
                cloud.reasons[off] |= np.uint8(reason)


def _pieces(
    xyz: FloatArray, used: BoolArray, axes: int
) -> Iterator[tuple[Neighbours, IntArray, FloatArray]]:
    """Yield the search, and rows and coordinates of the used points, piece by piece."""
    tiles, row = make_tiles(subset(used, xyz)), subset(used, row_numbers(len(xyz)))
    near = Neighbours(tiles, axes)
    for piece in tiles.pieces(PIECE_ROWS):
        yield near, row[tiles.row[piece]], tiles.xyz[piece]
        current().report(piece.stop - piece.start)
