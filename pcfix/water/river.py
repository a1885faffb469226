"""A water surface along a river: level across the flow, its height a profile along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import BoolArray, FloatArray, WaterMesh
from pcfix.water.flow_axis import Axis, flow_axis, given_axis
from pcfix.water.profile import Profile, fit_profile

if TYPE_CHECKING:
    from pcfix.model import IntArray

FEWEST = 10
MOST_CELLS = 200_000
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class RiverFit:
    """A water surface along a river, and how well the points fix it.

    Attributes
    ----------
    surface : WaterMesh
        Over the bounds that were asked for.
    axis : Axis
        Downstream.
    profile : Profile
        Height along the axis; its station is the axis's.
    residual_m : array, shape (n,)
        Point minus surface; NaN of points without a height.
    accepted : array of bool, shape (n,)
    weight : array, shape (n,)
        0 to 1.
    sigma_m : float
        Standard deviation of one accepted point.
    notes : tuple of str
    """

    surface: WaterMesh
    axis: Axis
    profile: Profile
    residual_m: FloatArray
    accepted: BoolArray
    weight: FloatArray
    sigma_m: float
    notes: tuple[str, ...]

    @property
    def drop_m(self) -> float:
        """From the first point to the last."""
        return float(self.profile.height_m[0] - self.profile.height_m[-1])

    @property
    def length_m(self) -> float:
        """Along the axis, from the first point to the last."""
        return float(np.ptp(self.profile.station_m))

    def height_at(self, xy: FloatArray) -> FloatArray:
        """Return the height (m) of the surface at places (m, 2)."""
        return self.profile.height_at(self.axis.locate(xy)[0])

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """Return the standard error (m) of that height."""
        return self.profile.sigma_at(self.axis.locate(xy)[0])

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            "model": "river",
            "length_m": self.length_m,
            "width_m": self.axis.width_m,
            "upper_level_m": float(self.profile.height_m[0]),
            "drop_m": self.drop_m,
            "sigma_level_m": float(self.profile.sigma_height_m.mean()),
            "falls": self.profile.falls,
            "sigma_point_m": self.sigma_m,
            "points": len(self.accepted),
            "accepted": int(self.accepted.sum()),
            "without_height": int(np.isnan(self.residual_m).sum()),
            "notes": list(self.notes),
        }


def fit_river(
    xyz: FloatArray, bounds: Bounds, *, centreline: FloatArray | None = None, name: str = "river"
) -> RiverFit:
    """Fit the water surface along a river to shoreline points, of which some may be wrong.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame, of both banks or one; rows that are not finite are left out.
    bounds : tuple of 4 float
        Least x, least y, greatest x, greatest y of the cloud: what the mesh has to cover.
    centreline : array, shape (m, 2) or (m, 3), optional
        A line along the river, in either direction. Default: found from the points.
    name : str
        Of the mesh.

    Returns
    -------
    RiverFit

    Raises
    ------
    GeometryError
        If there are fewer than `FEWEST` points with heights, they are at one place, or the
        bounds are empty.

    Notes
    -----
    The height of a place is that of the nearest place on the axis. Upstream of the first point
    and downstream of the last it stays as it is there.
    """
    points = np.asarray(xyz, np.float64)
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(known) < FEWEST:
        raise GeometryError(
            f"A surface along a river needs at least {FEWEST} shoreline points with heights, and"
            f" there are {len(known)}; fit a plane or a level."
        )
    known = known[np.lexsort(points[known].T)]
    used = points[known]
    axis = flow_axis(used[:, :2]) if centreline is None else given_axis(centreline)
    axis = _downstream(axis, used)
    profile = fit_profile(axis.locate(used[:, :2])[0], used[:, 2])
    surface = _mesh(axis, profile, bounds, name)
    return _result(surface, axis, profile, len(points), known)


def _downstream(axis: Axis, xyz: FloatArray) -> Axis:
    """Return the axis in the direction in which the points fall, by the medians of its halves."""
    station, _ = axis.locate(xyz[:, :2])
    upper = station <= np.median(station)
    if upper.all() or np.median(xyz[upper, 2]) >= np.median(xyz[~upper, 2]):
        return axis
    return axis.reversed()


def _result(
    surface: WaterMesh, axis: Axis, profile: Profile, count: int, known: IntArray
) -> RiverFit:
    """Return the fit with one row per input point."""
    residual, weight = np.full(count, np.nan), np.zeros(count)
    residual[known], weight[known] = profile.residual_m, profile.weight
    notes = [
        f"Beyond the outermost points the surface stays at {profile.height_m[0]:.2f} m upstream"
        f" and {profile.height_m[-1]:.2f} m downstream."
    ]
    if not profile.falls:
        notes.append(
            "The points do not fall all along the river, so the surface was not held to it; check"
            " the direction of the line along the river, and the points."
        )
    if count > len(known):
        notes.append(f"{count - len(known)} points have no height and are left out.")
    return RiverFit(
        surface, axis, profile, residual, weight > 0.0, weight, profile.sigma_m, tuple(notes)
    )


def _mesh(axis: Axis, profile: Profile, bounds: Bounds, name: str) -> WaterMesh:
    """Return the surface over the bounds as a grid of triangles.

    Sections across the flow would cross one another on the inside of a bend; a grid does not fold.
    """
    left, bottom, right, top = bounds
    if not (np.isfinite(bounds).all() and right > left and top > bottom):
        raise GeometryError(f"The bounds {bounds} of the water surface hold no area.")
    size = float(np.sqrt((right - left) * (top - bottom) / MOST_CELLS))
    cell = max(size, float(profile.station_m[1] - profile.station_m[0]) / 2.0)
    columns, rows = (int(np.ceil(side / cell)) + 1 for side in (right - left, top - bottom))
    x, y = np.linspace(left, right, columns), np.linspace(bottom, top, rows)
    xy = np.column_stack([np.tile(x, rows), np.repeat(y, columns)])
    vertices = np.column_stack([xy, profile.height_at(axis.locate(xy)[0])])
    return WaterMesh(vertices, _grid_triangles(columns, rows), name)


def _grid_triangles(columns: int, rows: int) -> IntArray:
    """Return two triangles for each cell of a grid, counter-clockwise from above."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    one = np.column_stack([corner, corner + 1, corner + columns])
    other = np.column_stack([corner + 1, corner + columns + 1, corner + columns])
    return np.vstack([one, other]).astype(np.int64)
