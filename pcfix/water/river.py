"""Fit a water surface along a river: level across the flow, a height profile along it.

The order of the points along the river is that of their shortest paths through a network from the
two ends, as in Isomap (Tenenbaum et al. 2000, Science 290: 2319-2323). The axis is a principal
curve (Hastie & Stuetzle 1989, J. Am. Stat. Assoc. 84: 502-516): smoothed over about the width of
the river, with the points projected onto it, several times.

The profile is robust, smooth, and falling: linear B-splines with a penalty on bends (P-splines:
Eilers & Marx 1996, Statistical Science 11: 89-121). The penalty grows with the size of a bend
instead of its square (trend filtering: Kim et al. 2009, SIAM Review 51: 339-360), so that pools,
riffles and weirs keep their edges; its weight comes from cross-validation. Rises have a penalty of
their own (Bollaerts et al. 2006, Statistics in Medicine 25: 1189-1206).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import FloatArray, WaterRaster
from pcfix.water.fit import (
    LEAST_SCALE_M,
    TO_SIGMA,
    TUKEY,
    ShoreFit,
    shared,
    tukey_weight,
    usable_rows,
)

FEWEST = 10
MOST_CELLS = 200_000
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class RiverFit(ShoreFit):
    """A water surface along a river, and its accuracy."""

    axis: FloatArray  # (a, 2), vertices of the line along the river, downstream
    station_m: FloatArray  # (m,), evenly spaced along it, from the first point to the last
    height_m: FloatArray  # (m,), of the water there
    sigma_height_m: FloatArray  # (m,), standard errors of these heights

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """Return the standard error (m) of the height at places (m, 2)."""
        station = locate(self.axis, xy)[0]
        return np.interp(station, self.station_m, self.sigma_height_m)


def fit_river(
    xyz: FloatArray, bounds: Bounds, *, name: str = "river", counts: FloatArray | None = None
) -> RiverFit:
    """Fit the water surface along a river to shoreline points, some of which may be wrong.

    The points, shape (n, 3), world frame, are of both banks or one; those that are not finite are
    ignored. `bounds` are least x, least y, greatest x, greatest y of the cloud, which the raster of
    that name covers; `counts` are as of `pcfix.water.fit.fit_water`. The height at a place is that
    of the nearest place on the axis, constant upstream of the first point and downstream of the
    last.
    """
    known = usable_rows(xyz)
    used = xyz[known]
    if len(known) < FEWEST or not np.ptp(used[:, :2], axis=0).any():
        raise GeometryError(
            "water.too_few_points",
            f"A surface along a river needs at least {FEWEST} shoreline points with heights, at"
            f" different places, and there are {len(known)}. Fit a plane or a level.",
            points=len(known), least=FEWEST,
        )  # fmt: skip
    axis, width_m = flow_axis(used[:, :2])
    station, _ = locate(axis, used[:, :2])
    upper = station <= np.median(station)
    if np.median(used[upper, 2]) < np.median(used[~upper, 2]):
        axis = axis[::-1].copy()  # downstream
        station, _ = locate(axis, used[:, :2])
    order = np.lexsort((used[:, 2], station))
    known, station, z = known[order], station[order], used[order, 2]
    worth = np.ones(len(known)) if counts is None else np.asarray(counts, np.float64)[known]
    nodes, height, sigma_height, weight_of, sigma = _fit_profile(station, z, worth)
    upper_m, lower_m = height[[0, -1]].tolist()
    note = (
        f"Beyond the outermost points the surface is constant: {upper_m:.2f} m upstream and"
        f" {lower_m:.2f} m downstream."
    )
    residual, weight = np.full(len(xyz), np.nan), np.zeros(len(xyz))
    residual[known], weight[known] = z - np.interp(station, nodes, height), weight_of
    return RiverFit(
        surface=_raster(axis, nodes, height, bounds, name),
        points=xyz,
        notes=(note,),
        residual_m=residual,
        weight=weight,
        sigma_m=sigma,
        axis=axis,
        station_m=nodes,
        height_m=height,
        sigma_height_m=sigma_height,
        figures={
            "model": "river",
            "length_m": float(np.ptp(nodes)),
            "width_m": width_m,
            "upper_level_m": upper_m,
            "drop_m": upper_m - lower_m,
            "sigma_level_m": float(sigma_height.mean()),
        },
    )


def _raster(
    axis: FloatArray, nodes: FloatArray, height_m: FloatArray, bounds: Bounds, name: str
) -> WaterRaster:
    """Return the surface over the bounds, whose corners are centres of cells.

    It is constant beyond the ends of the nodes along the axis, shape (m,), which have the heights.
    Cross-sections would intersect on the inside of a bend; a raster does not fold.
    """
    left, bottom, right, top = bounds
    if not (np.isfinite(bounds).all() and right > left and top > bottom):
        text = f"The bounds {bounds} of the water surface have no area. Check the cloud."
        raise GeometryError("cloud.no_extent", text, bounds=bounds)
    size = float(np.sqrt((right - left) * (top - bottom) / MOST_CELLS))
    cell = max(size, float(nodes[1] - nodes[0]) / 2.0)
    columns, rows = (int(np.ceil(side / cell)) + 1 for side in (right - left, top - bottom))
    x, y = left + cell * np.arange(columns), bottom + cell * np.arange(rows)[::-1]
    xy = np.column_stack([np.tile(x, rows), np.repeat(y, columns)])
    height = np.interp(locate(axis, xy)[0], nodes, height_m)
    return WaterRaster(
        height.reshape(rows, columns), left - cell / 2.0, y[0] + cell / 2.0, (cell, cell), name
    )


REACH = 2.0  # longest edge of the network, relative to the longest that keeps it connected
_ROUNDS, _NODES = 10, 300


def locate(line_xy: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance along a line of places (n, 2), and their distance from it, m."""
    import shapely

    line, places = shapely.linestrings(line_xy), shapely.points(xy)
    return shapely.line_locate_point(line, places), shapely.distance(line, places)


def flow_axis(xy: FloatArray) -> tuple[FloatArray, float]:
    """Return the axis of a river, and its width, from points (n, 2) on its banks, metres.

    The width is twice the rms distance of the points from the axis, (a, 2).
    """
    origin = xy.mean(axis=0)
    places = xy - origin
    net = np.unique(places, axis=0)
    nodes = _smoothed(net, *_stations(net))
    for _ in range(_ROUNDS):
        station, away = locate(nodes, places)
        gap = float(np.quantile(np.diff(np.sort(station)), 0.9))  # one in ten is wider
        bandwidth = max(2.0 * float(np.sqrt(np.mean(away**2))), gap, 1e-3)
        nodes = _smoothed(places, station, bandwidth)
    _, away = locate(nodes, places)
    # longer at both ends, so that the outermost points have feet on the line
    outward = nodes[[0, -1]] - nodes[[1, -2]]
    outward /= np.maximum(np.hypot(*outward.T), 1e-9)[:, None]
    first, last = nodes[[0, -1]] + 2.0 * bandwidth * outward
    width = 2.0 * float(np.sqrt(np.mean(away**2)))
    return np.vstack([first, nodes, last]) + origin, width


def _stations(xy: FloatArray) -> tuple[FloatArray, float]:
    """Return the distance of each place along the river, and the bandwidth of smoothing, m."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
    from scipy.spatial import Delaunay

    corners = Delaunay(xy, qhull_options="QJ").simplices  # joggled: they may be on one line
    pairs = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    # scipy 1.11 needs indices of 32 bits
    edges = np.unique(np.sort(pairs, axis=1), axis=0).T.astype(np.int32)
    length, shape = np.hypot(*(xy[edges[0]] - xy[edges[1]]).T), (len(xy), len(xy))
    tree = minimum_spanning_tree(csr_array((length, edges), shape=shape))
    reach = REACH * float(tree.data.max())
    near = length <= reach
    net = csr_array((length[near], edges[:, near]), shape=shape)
    # the place farthest from any one is an end of the river, and the farthest from that the other
    start = np.argmax(dijkstra(net, directed=False, indices=np.array([0])), axis=1)
    from_start = dijkstra(net, directed=False, indices=start)[0]
    end = np.array([np.argmax(from_start)])
    from_end = dijkstra(net, directed=False, indices=end)[0]
    # both banks agree: half of the way from one end plus what is left to the other
    return (from_start + from_start[end] - from_end) / 2.0, reach


def _smoothed(xy: FloatArray, station: FloatArray, bandwidth: float) -> FloatArray:
    """Return a line by local linear regression of places on their stations."""
    low, high = float(station.min()), float(station.max())
    count = int(np.clip((high - low) / bandwidth * 4.0, 8, _NODES))
    at = np.linspace(low, high, count)
    from_node = station[None] - at[:, None]
    weight = np.exp(-0.5 * (from_node / bandwidth) ** 2)
    s0, s1, s2 = (np.sum(weight * from_node**k, axis=1) for k in range(3))
    # weights of the intercept of a line through the neighbours; where they are at one station, of
    # their mean
    local = weight * (s2[:, None] - s1[:, None] * from_node)
    size = s0 * s2 - s1**2
    flat = size <= 1e-9 * s0**2 * bandwidth**2
    local[flat], size[flat] = weight[flat], s0[flat]
    return np.asarray(local @ xy / size[:, None])


FOLDS = 5
PENALTIES = tuple(10.0 ** np.arange(-4.0, 3.5, 0.5))
MOST_NODES, NODES_A_POINT = 400, 2
STIFF_PENALTY = 1e3  # penalty on rises, and on bends near the ends
END_POINTS = 7  # outermost points on one straight piece, so that a single one cannot bend it
_TURNS, _CURVATURE_M, _HUBER_M = 12, 1e-3, 0.02
_LEAST = 1e-12  # keeps the equations solvable without points


def _fit_profile(
    station: FloatArray, z: FloatArray, worth: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Fit the height of the water, shape (n,), which falls with the station, downstream.

    The stations are sorted. Each point is `worth` a number of independent observations; see
    `shared`. Cross-validation chooses the penalty.

    Returns nodes along the river, evenly spaced from the first point to the last, heights there and
    their standard errors, all (m,), the weights of the points, (n,), and the standard deviation of
    one accepted point.
    """
    from scipy.interpolate import BSpline
    from scipy.linalg import solveh_banded

    count = int(np.clip(NODES_A_POINT * len(z), 20, MOST_NODES))
    nodes = np.linspace(station[0], station[-1], count)
    splines: Any = BSpline.design_matrix(station, np.pad(nodes, 1, "edge"), 1)  # linear ones
    # each fold is predicted from the others; its errors count up to a limit, for the outliers
    fold = np.arange(len(z)) % FOLDS
    missed = np.empty((len(PENALTIES), len(z)))
    for row, penalty in enumerate(PENALTIES):
        for k in range(FOLDS):
            rest, out = fold != k, fold == k
            height = _solve(splines[rest], station[rest], z[rest], nodes, penalty)[0]
            missed[row, out] = np.abs(z[out] - np.interp(station[out], nodes, height))
    limit = TUKEY * max(TO_SIGMA * float(np.median(missed, axis=1).min()), LEAST_SCALE_M)
    best = PENALTIES[int(np.argmin((np.minimum(missed, limit) ** 2).mean(axis=1)))]
    height, weight, band = _solve(splines, station, z, nodes, best)
    # the covariance of the heights over the variance of a point; its trace on the points counts the
    # unknowns that they determine
    inverse = solveh_banded(band, np.eye(len(nodes)), lower=True)
    variance = splines.multiply(splines @ inverse).sum(axis=1)
    residual, accepted = z - np.interp(station, nodes, height), weight > 0.0
    spare = accepted.sum() - float((weight * np.asarray(variance).ravel()).sum())
    sigma = float(np.sqrt((residual[accepted] ** 2).sum() / max(spare, 1.0)))
    sigma_height = sigma * np.sqrt(np.diag(inverse) * shared(weight, worth, 0.0))
    return nodes, height, sigma_height, weight, sigma


def _solve(
    splines: Any, station: FloatArray, z: FloatArray, nodes: FloatArray, penalty: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return heights, the points' weights, and the lower band of the normal equations.

    The splines are those of the nodes at the stations, a sparse matrix, shape (n, nodes).
    Iteratively reweighted least squares: bends weigh 1 / |bend|, rises 1 or 0, points first by
    Huber, then by Tukey with the scale of the Huber solution.
    """
    from scipy.linalg import solveh_banded

    squares, products = splines.power(2).T, splines[:, :-1].multiply(splines[:, 1:]).T
    before = np.searchsorted(station, nodes[1:-1])
    stiff = np.minimum(before, len(z) - before) < END_POINTS
    weight: FloatArray = np.ones(len(z))
    curve_weight: FloatArray = np.ones(len(nodes) - 2)
    rise: FloatArray = np.zeros(len(nodes) - 1)
    limit, band = np.inf, np.zeros((3, len(nodes)))
    for turn in range(2 * _TURNS):
        penalties = np.where(stiff, STIFF_PENALTY, penalty * curve_weight)
        # the squares of second differences (1, -2, 1) and of first ones (-1, 1)
        band[0] = squares @ weight + np.convolve(penalties, [1.0, 4.0, 1.0]) + _LEAST
        band[0] += np.convolve(STIFF_PENALTY * rise, [1.0, 1.0])
        band[1, :-1] = products @ weight - np.convolve(penalties, [2.0, 2.0]) - STIFF_PENALTY * rise
        band[2, :-2] = penalties
        height = solveh_banded(band, splines.T @ (weight * z), lower=True)
        curve_weight = 1.0 / np.maximum(np.abs(np.diff(height, 2)), _CURVATURE_M)
        rise = np.where(np.diff(height) > 0.0, 1.0, 0.0)
        residual = np.abs(z - np.interp(station, nodes, height))
        if turn < _TURNS:
            weight = np.minimum(_HUBER_M / np.maximum(residual, 1e-9), 1.0)
            limit = TUKEY * max(TO_SIGMA * float(np.median(residual)), LEAST_SCALE_M)
        else:
            weight = tukey_weight(residual / limit)
    return height, weight, band
