"""How deep a cloud says the water is at given places, from the points around each of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.water.surface import is_submerged

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray
    from pcfix.water.surface import SurfaceAbove

NEIGHBOURS, LEAST_NEIGHBOURS = 16, 3
MOST_PLACES = 1000
"""That the distance between neighbours is taken at."""
REACH = 4.0
"""In distances between neighbours. On a grid that is 50 points; of points strewn at random, where
the nearest neighbour is closer than on a grid, 10."""


class ApparentDepths:
    """The nearest submerged points of some places, gathered from a cloud chunk by chunk.

    The memory is that of `NEIGHBOURS` points a place.

    Parameters
    ----------
    places : array, shape (p, 2)
        Metres, world frame.

    Attributes
    ----------
    distance_m : array, shape (p, NEIGHBOURS)
        In plan, rising; infinite where there are fewer points so far.
    """

    def __init__(self, places: FloatArray) -> None:
        self._places = places
        shape = (len(places), NEIGHBOURS)
        self.distance_m = np.full(shape, np.inf)
        self._depth_m, self._level_m = np.full(shape, np.nan), np.full(shape, np.nan)
        self._xy = np.full((*shape, 2), np.nan)

    def add(self, xyz: FloatArray, surface: SurfaceAbove) -> None:
        """Look through n more points.

        Parameters
        ----------
        xyz : array, shape (n, 3)
            Metres, world frame.
        surface : SurfaceAbove
            The water above each of them.
        """
        from scipy.spatial import cKDTree

        rows = np.flatnonzero(is_submerged(xyz[:, 2], surface))
        if not (len(rows) and len(self._places)):
            return
        xy = xyz[rows, :2]
        tree = cKDTree(xy, balanced_tree=False, compact_nodes=False)  # built faster, asked little
        distance, near = tree.query(self._places, k=range(1, NEIGHBOURS + 1))
        near = rows[np.where(np.isfinite(distance), near, 0)]
        aside = self._places[:, None, :] - xyz[near, :2]
        # the height of the water over the place itself, where the surface is tilted
        level = surface.height_m[near] + np.einsum("pka,pka->pk", surface.slope[near], aside)
        depth = surface.height_m[near] - xyz[near, 2]
        self._keep_nearest(np.asarray(distance), depth, level, xyz[near, :2])

    def _keep_nearest(
        self, distance: FloatArray, depth: FloatArray, level: FloatArray, xy: FloatArray
    ) -> None:
        distance = np.hstack([self.distance_m, distance])
        depth, level = np.hstack([self._depth_m, depth]), np.hstack([self._level_m, level])
        xy = np.hstack([self._xy, xy])
        order = np.lexsort((depth, distance), axis=-1)[:, :NEIGHBOURS]
        self.distance_m = np.take_along_axis(distance, order, axis=1)
        self._depth_m = np.take_along_axis(depth, order, axis=1)
        self._level_m = np.take_along_axis(level, order, axis=1)
        self._xy = np.take_along_axis(xy, order[:, :, None], axis=1)

    @property
    def spacing_m(self) -> float:
        """Distance of a point from its nearest neighbour; 0 if no place has two points.

        The median over the points that were found, so that it is the cloud's also where places
        lie outside the cloud.
        """
        some = slice(None, None, -(-len(self._xy) // MOST_PLACES) or 1)
        found, xy = np.isfinite(self.distance_m[some]), self._xy[some]
        away = xy[:, :, None, :] - xy[:, None, :, :]
        apart = np.hypot(away[..., 0], away[..., 1])
        apart[~(found[:, :, None] & found[:, None, :]) | (apart == 0.0)] = np.inf
        nearest = apart.min(axis=2)
        known = nearest[np.isfinite(nearest)]
        return float(np.median(known)) if len(known) else 0.0

    def medians(self, radius_m: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return what the points within a radius say of each place.

        Parameters
        ----------
        radius_m : float

        Returns
        -------
        depth_m : array, shape (p,)
            Median apparent depth of the nearest submerged points, at most `NEIGHBOURS`.
        level_m : array, shape (p,)
            Height of the water over the place.
        covered : array of bool, shape (p,)
            Whether there are `LEAST_NEIGHBOURS` points. Where not, the others are NaN.
        """
        near = self.distance_m <= radius_m
        covered = near.sum(axis=1) >= LEAST_NEIGHBOURS
        depth, level = np.full(len(near), np.nan), np.full(len(near), np.nan)
        for place in np.flatnonzero(covered):
            depth[place] = np.median(self._depth_m[place, near[place]])
            level[place] = np.median(self._level_m[place, near[place]])
        return depth, level, covered
