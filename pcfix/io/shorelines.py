"""Shoreline points and water polygons from vector files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, SettingError
from pcfix.io.vectors import in_cloud_crs, load, read_vectors

if TYPE_CHECKING:
    import os

    import numpy.typing as npt
    from pyproj import CRS

    from pcfix.model import FloatArray

SPACING_M = 1.0
"""Along lines without heights, which take them from the cloud."""
MOST_POINTS = 1_000_000
FEW = 3


@dataclass(frozen=True, eq=False)
class Shoreline:
    """Points on the edge of the water.

    Attributes
    ----------
    xyz : array, shape (n, 3)
        Metres, the cloud's CRS; z is NaN where the file has no height.
    name : str
        For messages.
    notes : tuple of str
    """

    xyz: FloatArray
    name: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class WaterPolygons:
    """Where there is water.

    Attributes
    ----------
    area : shapely MultiPolygon or Polygon
        Valid, its holes are dry; the cloud's CRS.
    name : str
    notes : tuple of str
    """

    area: Any
    name: str
    notes: tuple[str, ...] = ()


def read_shoreline(
    path: str | os.PathLike[str],
    cloud_crs: str | CRS | None = None,
    *,
    layer: str | None = None,
    crs: str | None = None,
    spacing_m: float = SPACING_M,
) -> Shoreline:
    """Read shoreline points, from points, lines and rings of polygons, holes included.

    A line with heights gives its vertices, as these were measured; what lies between them was
    not, and would make the fit look better than it is. A line without heights gives a point at
    least every `spacing_m`, as each takes a height of its own from the cloud.

    Parameters
    ----------
    path, layer, crs
        See `read_vectors`.
    cloud_crs : str, CRS or None
    spacing_m : float, default 1.0

    Raises
    ------
    InputError
        See `read_vectors` and `in_cloud_crs`.
    SettingError
        If `spacing_m` is not positive.
    """
    if not spacing_m > 0.0:
        raise SettingError(f"spacing {spacing_m:g} m must be positive.")
    vectors = in_cloud_crs(read_vectors(path, layer=layer, crs=crs), cloud_crs, heights=True)
    shapely = load("shapely")
    lines, points = _lines_and_points(vectors.geometries, shapely)
    level = shapely.has_z(lines)
    check_count(vectors.name, float(shapely.length(lines[~level]).sum()) / spacing_m)
    parts = [points, lines[level], shapely.segmentize(lines[~level], spacing_m)]
    xyz = np.vstack([_vertices(part, shapely) for part in parts])
    z, notes = _known_heights(xyz[:, 2], vectors.name)
    return Shoreline(np.column_stack([xyz[:, :2], z]), vectors.name, (*vectors.notes, *notes))


def check_count(name: str, count: float) -> None:
    """Refuse a line that would give more points than anything needs.

    Raises
    ------
    InputError
    """
    if count > MOST_POINTS:
        raise InputError(
            f"{name}: would give {count:.3g} points; check its CRS and unit, or thin it out."
        )


def _lines_and_points(
    geometries: npt.NDArray[Any], shapely: Any
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the lines and rings, and the points, that geometries consist of."""
    parts = _simple(geometries, shapely)
    kind = shapely.get_type_id(parts)
    kinds = shapely.GeometryType
    rings = shapely.get_rings(parts[kind == kinds.POLYGON])
    lines = parts[(kind == kinds.LINESTRING) | (kind == kinds.LINEARRING)]
    return np.concatenate([lines, rings]), parts[kind == kinds.POINT]


def _simple(geometries: npt.NDArray[Any], shapely: Any) -> npt.NDArray[Any]:
    """Return the parts of multi-part geometries and collections, however deep."""
    while (shapely.get_type_id(geometries) > shapely.GeometryType.POLYGON).any():
        geometries = shapely.get_parts(geometries)
    return geometries


def _vertices(geometries: npt.NDArray[Any], shapely: Any) -> FloatArray:
    """Return vertices (n, 3); of a closed line the last is the first and does not count twice."""
    xyz, at = shapely.get_coordinates(geometries, include_z=True, return_index=True)
    last = np.flatnonzero(np.diff(at, append=-1) != 0)
    again = last[shapely.is_closed(geometries)[at[last]]] if len(last) else last
    return np.asarray(np.delete(xyz, again, axis=0), np.float64)


def _known_heights(z: FloatArray, name: str) -> tuple[FloatArray, tuple[str, ...]]:
    """Return heights; where all are exactly zero, as of a flat drawing, they are none."""
    known = z[np.isfinite(z)]
    if len(known) >= FEW and not known.any():
        note = f"{name}: all {len(known)} heights are exactly 0; taken as points without heights."
        return np.full_like(z, np.nan), (note,)
    return z, ()


def read_water_polygons(
    path: str | os.PathLike[str],
    cloud_crs: str | CRS | None = None,
    *,
    layer: str | None = None,
    crs: str | None = None,
) -> WaterPolygons:
    """Read the polygons inside which points may be submerged, as one area.

    Parameters
    ----------
    path, layer, crs
        See `read_vectors`.
    cloud_crs : str, CRS or None

    Raises
    ------
    InputError
        If there is no polygon with an area, or they cannot be read or brought to the cloud's CRS.
    """
    vectors = in_cloud_crs(read_vectors(path, layer=layer, crs=crs), cloud_crs, heights=False)
    shapely = load("shapely")
    parts = shapely.force_2d(_simple(vectors.geometries, shapely))
    is_polygon = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    if not is_polygon.any():
        raise InputError(
            f"{vectors.name}: holds no polygon ({vectors.kinds}); a mask needs polygons of water."
        )
    polygons, notes = _valid(parts[is_polygon], vectors.name, shapely)
    if not is_polygon.all():
        other = int((~is_polygon).sum())
        notes += (f"{vectors.name}: {other} points or lines beside the polygons are left out.",)
    area = shapely.union_all(polygons)
    if not area.area > 0.0:
        raise InputError(f"{vectors.name}: the polygons have no area.")
    return WaterPolygons(area, vectors.name, (*vectors.notes, *notes))


def _valid(
    polygons: npt.NDArray[Any], name: str, shapely: Any
) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    """Return polygons with those repaired that cross themselves: holes stay holes."""
    crossed = ~shapely.is_valid(polygons)
    if not crossed.any():
        return polygons, ()
    first = int(np.argmax(crossed))
    reason = shapely.is_valid_reason(polygons[first])
    mended = polygons.copy()
    mended[crossed] = shapely.make_valid(
        polygons[crossed], method="structure", keep_collapsed=False
    )
    area_m2 = float(shapely.area(mended[crossed]).sum())
    return mended, (
        f"{name}: {int(crossed.sum())} of {len(polygons)} polygons cross or touch themselves"
        f" ({reason}) and were repaired; they now cover {area_m2:.1f} m2.",
    )
