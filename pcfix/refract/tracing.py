"""Trace light backwards, from projection centres to object points under water.

In the refractive collinearity of Mulsow's multimedia bundle the image of a point is that of its
piercing point. Four methods find it; they agree where all of them converge:

=============  ====================================================================================
kotowski       Newton's method on Snell's law at the piercing point (Kotowski 1987)
afrt           rays traced forward: Newton's method on their offset at the height of the point
mdfrt          minimum distance forward ray tracing: Newton's method on the ray's distance
scattershot    grids of paths narrowed to the shortest optical length (Fermat)
=============  ====================================================================================

The first three look for a refracted ray that hits the point. On facets, and on the bilinear
patches of a raster, there may be none: through a crease that is a trough comes light that obeys
Fermat, but not the normal of any facet. There `trace` shrinks the grids of `scattershot` around the
end of the method to the path of least optical length nearby.

Coordinates are relative to the object point. A ray is named by its plan place (x, y) on the
surface. It pierces the surface at A and is refracted there. Where there is no surface, and where it
faces away from the camera, all is NaN. The ray is taken to cross the surface once.

All is numpy: blocks of pairs are traced at once, and the pairs that are not found yet go on.
"""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.kernels import Span, in_tiles
from pcfix.model import BoolArray, FloatArray, IntArray, WaterMesh, WaterPlane, WaterRaster
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.running import threads
from pcfix.water.surface import surface_above

Surface: TypeAlias = WaterPlane | WaterRaster | WaterMesh

METHODS = ("kotowski", "afrt", "mdfrt", "scattershot")

BLOCK = 32_768  # endpoints traced at once
CLOSE_M = 1e-9  # a step that ends a search: no finer than UTM northings allow in doubles
# In depths: a step that is taken although it seems to lead away, as it may from one patch of a
# broken surface to the next.
SHORT = 0.1
SEARCH_STEPS, HALVINGS = 60, 24  # most steps of a search, and most halvings of a step
DIFFERENCE_M = 1e-6  # between places for differences; with less, rounding is the larger error
# Of the straight line: the search starts below the camera even where a tilted water is higher above
# the point than the camera.
HIGHEST_START = 0.95
KNOTS, SHOTS = 10, 200  # to each side of the first grid of `scattershot`; most grids
BLUNT_M = 1e-7  # half the grid below which neighbouring paths are equally long by rounding
NEIGHBOUR_M = 1e-4
CREASE_M = 1e-7  # a path by which the ray misses the point by more goes through a crease
NEAR = 0.25  # in depths: how far around the end of a method the shortest path is searched


@dataclass(frozen=True, eq=False)
class Tracing:
    """Paths of n pairs of an object point and a projection centre.

    Where light goes straight the piercing point is the object point; NaN where no path was found.
    A path through a crease is the shortest nearby, but no refracted ray.
    """

    piercing_xyz: FloatArray  # (n, 3), where the light leaves the water, metres, world frame
    direction: FloatArray  # (n, 3), unit vectors from the projection centre to there
    converged: BoolArray  # (n,), whether a path was found
    on_crease: BoolArray  # (n,), whether it leaves through a crease


def trace(
    origin: npt.ArrayLike,
    target: npt.ArrayLike,
    water: Surface | float,
    *,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    method: str = "kotowski",
) -> Tracing:
    """Trace light backwards, from projection centres to object points under water.

    Parameters
    ----------
    origin : array, shape (n, 3) or (3,)
        Projection centres, metres, world frame.
    target : array, shape (n, 3) or (3,)
        The true object points, metres, world frame. A point above the water, or without water
        above it, is seen straight.
    water : WaterPlane, WaterRaster, WaterMesh or float
        The water surface, or its level in metres.
    refractive_index : float, default 1.34
        Of the water against air, at least 1.
    method : {"kotowski", "afrt", "mdfrt", "scattershot"}
        How the path is found; see `pcfix.refract.tracing`.

    Returns
    -------
    Tracing
        Where the light leaves the water, and its direction at the projection centre. Nothing is
        found for a camera that is not above the water, nor where the light would leave the water
        beyond its edge. Positions are good to about 1e-9 m, on creases 1e-6 m.

    Raises
    ------
    SettingError
        If the shapes do not fit, the method or surface is unknown or the index is below one.

    Examples
    --------
    >>> import pcfix
    >>> found = pcfix.trace([20.0, 0.0, 100.0], [0.0, 0.0, -2.0], 0.0)
    >>> found.piercing_xyz.round(3).tolist()
    [[0.292, 0.0, 0.0]]
    """
    xyz, seen_from = np.atleast_2d(target), np.atleast_2d(origin)
    fit = xyz.ndim == seen_from.ndim == 2 and xyz.shape[1] == seen_from.shape[1] == 3
    if not (fit and (len(xyz) == len(seen_from) or 1 in (len(xyz), len(seen_from)))):
        raise SettingError(
            "trace.shapes",
            f"An origin of shape {np.shape(origin)} and a target of shape {np.shape(target)} do not"
            " form pairs. Give both as (n, 3), or one of them as (3,).",
        )
    n = float(refractive_index)
    if method not in METHODS:
        raise SettingError(
            "option.choice",
            f"Method {method!r} is not known. Give one of {', '.join(METHODS)}.",
            value=method,
        )
    if not 1.0 <= n < np.inf:
        raise SettingError(
            "option.range",
            f"The refractive index {n:g} is below 1. Give that of the water, about 1.34.",
            value=n,
        )
    surface = WaterPlane(float(water)) if isinstance(water, int | float) else water
    if not isinstance(surface, Surface):
        raise SettingError(
            "trace.surface",
            f"Light cannot be traced through {surface}. Give a plane, raster or mesh.",
        )
    point, centre = (np.array(a, float).T for a in np.broadcast_arrays(xyz, seen_from))
    pairs, count = Endpoints(surface, point, centre - point, n), point.shape[1]
    pierced, on_crease = np.full((3, count), np.nan), np.zeros(count, np.bool_)

    def run(span: Span) -> None:
        with threads(1), np.errstate(all="ignore"):
            for block in range(*span):
                rows = np.arange(block * BLOCK, min((block + 1) * BLOCK, count))
                pierced[:, rows], on_crease[rows] = _path(pairs.of(rows), method)

    in_tiles(run, -(-count // BLOCK))
    return Tracing(
        piercing_xyz=(point + pierced).T,
        direction=_unit(pierced - pairs.e).T,
        converged=np.isfinite(pierced[0]),
        on_crease=on_crease,
    )


class Endpoints(NamedTuple):
    """Endpoints of an object point and a projection centre, and the surface between them."""

    surface: Surface
    point: FloatArray  # (3, m), object points, world frame, metres
    e: FloatArray  # (3, m), projection centres relative to them
    n: float

    def of(self, rows: IntArray | BoolArray) -> "Endpoints":
        """Return some of the pairs."""
        return self._replace(point=self.point[:, rows], e=self.e[:, rows])

    def pierced(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the places A of the surface, (3, m), and dz/dx and dz/dy there; NaN if none."""
        place = np.vstack([self.point[:2] + xy, self.point[2:]])
        height, slope = surface_above(self.surface, place.T)
        return np.vstack([xy, height - self.point[2]]), slope.T

    def refracted(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the places A, and the refracted rays from the camera through them.

        The ray, not of unit length and NaN where it does not go down, is that of Mulsow 2024 after
        Glassner 1989, which is eq 10 of Skarlatos & Agrafiotis 2018. The n_t that is printed with
        it, n_t / n_(t+1), is the inverse of that which the formula takes.
        """
        a, (b, c) = self.pierced(xy)
        up = 1.0 / np.sqrt(1.0 + b * b + c * c)
        normal, u = np.stack([-b * up, -c * up, up]), self.e - a
        facing, r = _dot(normal, u), 1.0 / self.n
        normal_part = r * facing - np.sqrt(_dot(u, u) * (1.0 - r * r) + r * r * facing * facing)
        t = normal_part * normal - r * u
        # light reaches only faces that look towards the camera
        return a, np.where((facing > 0.0) & (t[2] < 0.0), t, np.nan)

    def offset(self, xy: FloatArray) -> FloatArray:
        """Return by how much the refracted rays miss the points, (2, m), at their height."""
        a, t = self.refracted(xy)
        return xy - t[:2] * (a[2] / t[2])

    def length(self, xy: FloatArray) -> FloatArray:
        """Return the optical lengths of paths, metres, (m,); infinite where there is none."""
        a, slope = self.pierced(xy)
        u = self.e - a
        # the surface has to face the camera
        faces = u[2] - _dot(slope, u[:2]) > 0.0
        return np.where(faces, np.sqrt(_dot(u, u)) + self.n * np.sqrt(_dot(a, a)), np.inf)

    def residual(self, xy: FloatArray, method: str) -> FloatArray:
        r"""Return the two numbers, (2, m), that vanish where light pierces the surface at x, y.

        kotowski: with the unit vectors u from the camera to A and v from A to the point, u - n v is
        normal to the surface by Snell's law, hence to its tangents (1, 0, b) and (0, 1, c):

            g = (u_x - n v_x + b (u_z - n v_z), u_y - n v_y + c (u_z - n v_z)) = 0

        g is also the gradient of the optical length by the place of A (Fermat).

        afrt: the offset of the refracted ray t at the height of the object point P.

        mdfrt: x and y of the perpendicular from the refracted ray to P,

            d = P - A - (t.(P - A) / t.t) t

        Mulsow 2024 prints P_0 for the first P, and the last term with A - P but the same sign.
        """
        if method == "kotowski":
            a, slope = self.pierced(xy)
            g = _unit(a - self.e) + self.n * _unit(a)
            return np.asarray(g[:2] + slope * g[2])
        if method == "afrt":
            return self.offset(xy)
        a, t = self.refracted(xy)
        return np.asarray((_dot(t, a) / _dot(t, t) * t - a)[:2])


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray((a * b).sum(axis=0))


def _unit(a: FloatArray) -> FloatArray:
    return a / np.sqrt(_dot(a, a))


def _path(pairs: Endpoints, method: str) -> "Paths":
    """Return where the light of pairs pierces the surface, (3, m), and whether on a crease."""
    e, m = pairs.e, pairs.e.shape[1]
    pierced, on_crease = np.full((3, m), np.nan), np.zeros(m, np.bool_)
    level, over = (pairs.pierced(xy)[0][2] for xy in (np.zeros((2, m)), e[:2]))
    # not where the camera is under the water, or somewhere infinite
    is_above = ~(e[2] <= over) & (np.abs(e).sum(axis=0) < np.inf)
    # a point above the water is seen straight
    pierced[:, is_above & ~(level > 0.0)] = 0.0
    rows = np.flatnonzero(is_above & (level > 0.0) & (e[2] > 0.0))
    wet, level = pairs.of(rows), level[rows]
    # the straight line pierces the surface about here
    start = np.minimum(level / wet.e[2], HIGHEST_START) * wet.e[:2]
    if method == "scattershot":
        # on calm water the place is between the point and the straight line; the first grid covers
        # these and as much as the point is deep all around
        half = level + 0.5 * np.abs(start).max(axis=0)
        xy = _best_knot(wet, 0.5 * start, half, KNOTS)[0]
        xy, found = _shortest(wet, xy, 2.0 * half / KNOTS)
    else:
        xy, found = _search(wet, start, level, method)
        lost = np.flatnonzero(~found)
        if len(lost):
            near = np.where(np.isnan(wet.pierced(xy)[0][2]), start, xy)[:, lost]
            xy[:, lost], found[lost] = _shortest(wet.of(lost), near, NEAR * level[lost])
    rows, wet, xy = rows[found], wet.of(found), xy[:, found]
    pierced[:, rows] = wet.pierced(xy)[0]
    on_crease[rows] = ~(np.hypot(*wet.offset(xy)) <= CREASE_M)
    return pierced, on_crease


# Places where light pierces the surface, a column for each, and a property of each.
Paths: TypeAlias = tuple[FloatArray, BoolArray]


def _search(pairs: Endpoints, start: FloatArray, level: FloatArray, method: str) -> Paths:
    """Find where the residual of a method vanishes, from places on the straight lines.

    `level` are the heights of the water over the points. Returns places (2, m) and whether a ray
    pierces the surface there. Mulsow 2024 does not say how the residual is brought to zero. Here it
    is Newton's method with differences of neighbouring places. A step that makes the residual grow,
    or leaves the water, is halved until it is short.
    """
    # beyond the edge of the water: start above the point
    xy = np.where(np.isnan(pairs.residual(start, method)[0]), 0.0, start)
    rest, found = pairs.residual(xy, method), np.zeros(len(level), np.bool_)
    rows, some = np.arange(len(level)), pairs
    for _ in range(SEARCH_STEPS):
        place, r, depth = xy[:, rows], rest[:, rows], level[rows]
        aside = np.minimum(DIFFERENCE_M, 0.05 * depth)
        by_x = some.residual(np.stack([place[0] + aside, place[1]]), method) - r
        by_y = some.residual(np.stack([place[0], place[1] + aside]), method) - r
        inverse = np.array([[by_y[1], -by_y[0]], [-by_x[1], by_x[0]]])
        inverse *= aside / (by_x[0] * by_y[1] - by_y[0] * by_x[1])
        s = -(inverse * r).sum(axis=1)
        size, new = np.hypot(*s), some.residual(place + s, method)
        for _ in range(HALVINGS):
            is_short = (np.hypot(*s) < SHORT * depth) & ~np.isnan(new[0])
            far = np.flatnonzero(~((_dot(new, new) < _dot(r, r)) | is_short))
            if not len(far):
                break
            s[:, far] *= 0.5
            new[:, far] = some.of(far).residual(place[:, far] + s[:, far], method)
        rest[:, rows] = new
        is_active = ~np.isnan(new[0])
        xy[:, rows[is_active]] += s[:, is_active]
        found[rows] = is_active & (size <= CLOSE_M)
        is_active &= size > CLOSE_M
        rows, some = rows[is_active], some.of(is_active)
        if not len(rows):
            break
    return xy, found & (np.hypot(*pairs.offset(xy)) <= CREASE_M)


def _shortest(pairs: Endpoints, xy: FloatArray, half: FloatArray) -> Paths:
    """Return the nearest places of least optical length (Fermat), from half the size of grids on.

    Mulsow 2024 names scattershot only ("brute force"). There is no start value, no derivative, no
    law of refraction. Where a broken surface sends light along several paths the shortest is taken,
    and a path may leave through a crease.

    A grid of 5 x 5 about its best knot is halved until it is small enough; while the best knot is
    on the rim it moves and keeps its size. A length changes with the square of the distance and is
    too blunt in the end: a ray nearby is searched by its distance from the point. Without one the
    path goes through a crease, known to about 1e-6 m along it.
    """
    xy, half = xy.copy(), half.copy()
    for _ in range(SHOTS):
        rows = np.flatnonzero(half > BLUNT_M)
        if not len(rows):
            break
        xy[:, rows], on_rim = _best_knot(pairs.of(rows), xy[:, rows], half[rows], 2)
        half[rows] *= np.where(on_rim, 1.0, 0.5)
    near, is_ray = _search(pairs, xy, np.full(len(half), NEIGHBOUR_M), "mdfrt")
    is_ray &= np.hypot(*(near - xy)) <= NEIGHBOUR_M
    # at an edge of the water the shortest path means nothing
    around = [np.array([[i], [j]]) * NEIGHBOUR_M for i, j in product((-1.0, 1.0), repeat=2)]
    inside = np.all([~np.isnan(pairs.pierced(xy + corner)[0][2]) for corner in around], axis=0)
    return np.where(is_ray, near, xy), is_ray | inside


def _best_knot(pairs: Endpoints, xy: FloatArray, half: FloatArray, knots: int) -> Paths:
    """Return the places of the shortest paths on grids about x, y, and whether they are on the rim.

    The grids have `knots` knots to each side of their middle, within `half`.
    """
    best, place, on_rim = pairs.length(xy), xy, np.zeros(len(half), np.bool_)
    for knot in product(range(-knots, knots + 1), repeat=2):
        there = xy + np.array(knot)[:, None] * (half / knots)
        length = pairs.length(there)
        is_shorter = length < best
        best, place = np.where(is_shorter, length, best), np.where(is_shorter, there, place)
        on_rim = np.where(is_shorter, max(map(abs, knot)) == knots, on_rim)
    return place, on_rim
