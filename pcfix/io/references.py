"""What a cloud is measured against: another cloud, check points, or a grid of heights."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.clouds import read_cloud
from pcfix.io.crs import is_same, parts
from pcfix.io.files import check_input
from pcfix.io.tables import read_table
from pcfix.model import (
    NOISE_CLASSES,
    FloatArray,
)

if TYPE_CHECKING:
    import os
    from pathlib import Path

    from pyproj import CRS

WATER_CLASSES = (9, 41, 42, 45)
"""ASPRS classes of water and of its surface and column: not the bed."""
KINDS = "a cloud (.las, .laz), check points (.csv, .txt) or a grid (.tif, .tiff)"


@dataclass(frozen=True, eq=False)
class Reference:
    """Heights that are taken as true.

    Attributes
    ----------
    name : str
        For messages.
    xyz : array, shape (m, 3)
        Metres, world frame.
    crs : CRS or None
    left_out : int
        Points withheld, of noise, or of water; cells without data.
    sparse : bool
        Whether these are single check points, not a sampled surface.
    """

    name: str
    xyz: FloatArray
    crs: CRS | None
    left_out: int = 0
    sparse: bool = False


def read_reference(path: str | os.PathLike[str]) -> Reference:
    """Read a reference; the end of its name says what it is.

    Parameters
    ----------
    path : path
        ``.las``, ``.laz``: all points but those withheld and those of noise or water; ``.csv``,
        ``.txt``: columns x, y, z; ``.tif``, ``.tiff``: the centres of all cells with data.

    Raises
    ------
    InputError
        If it is none of these, damaged or empty.
    """
    source = check_input(path)
    suffix = source.suffix.lower()
    if suffix in (".las", ".laz"):
        cloud = read_cloud(source, skip_classes=NOISE_CLASSES + WATER_CLASSES)
        return Reference(cloud.name, cloud.xyz, cloud.crs, cloud.left_out)
    if suffix in (".csv", ".txt"):
        table = read_table(source, ("x", "y", "z"))
        xyz = np.column_stack([table.numbers(name) for name in "xyz"])
        return Reference(str(source), xyz, None, sparse=True)
    if suffix in (".tif", ".tiff"):
        return _read_grid(source)
    raise InputError(f"{source}: is not a reference that pcfix reads; give {KINDS}.")


def _read_grid(path: Path) -> Reference:
    """Read the first band of a GeoTIFF as points."""
    import rasterio
    from pyproj import CRS

    try:
        with rasterio.open(path) as grid:
            band = grid.read(1, masked=True)
            transform, wkt = grid.transform, grid.crs.to_wkt() if grid.crs else None
            scale, offset = grid.scales[0], grid.offsets[0]
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{path}: is not a readable GeoTIFF ({error}).") from error
    if transform.is_identity:
        raise InputError(f"{path}: does not say where it lies; give a georeferenced GeoTIFF.")
    height = band.astype(np.float64).filled(np.nan) * scale + offset
    row, column = np.nonzero(np.isfinite(height))
    if len(row) == 0:
        raise InputError(f"{path}: no cell holds a height.")
    t, u, v = transform, column + 0.5, row + 0.5
    x, y = t.a * u + t.b * v + t.c, t.d * u + t.e * v + t.f
    xyz = np.column_stack([x, y, height[row, column]])
    crs = CRS.from_wkt(wkt) if wkt else None
    return Reference(str(path), xyz, crs, height.size - len(xyz))


def check_same_crs(cloud: str, crs: CRS | None, reference: str, other: CRS | None) -> None:
    """Refuse to compare what does not lie in one CRS; warn where one has none.

    Nothing is transformed here: heights moved silently between datums would look like errors of
    the cloud.

    Raises
    ------
    InputError
        If the CRS differ in plan or in height, or are in degrees.
    """
    for name, one in ((cloud, crs), (reference, other)):
        if one is not None and one.is_geographic:
            raise InputError(
                f"{name}: is in degrees ({one.name}); bring it to a projected CRS in metres first."
            )
    if crs is None or other is None:
        if (crs is None) != (other is None):
            bare, full = (cloud, other) if crs is None else (reference, crs)
            warnings.warn(
                f"{bare} names no CRS; taken to be in {full.name if full else ''}.",
                PcfixWarning,
                stacklevel=3,
            )
        return
    plan, height = parts(crs)
    other_plan, other_height = parts(other)
    if not is_same(plan, other_plan):
        raise InputError(
            f"{cloud} is in {plan.name}, {reference} in {other_plan.name}; bring the reference to"
            " the CRS of the cloud first, heights included (PDAL's filters.reprojection or"
            " gdalwarp), and check its vertical datum."
        )
    if height is not None and other_height is not None and not is_same(height, other_height):
        raise InputError(
            f"{cloud} has heights in {height.name}, {reference} in {other_height.name}; bring the"
            " reference to the heights of the cloud first."
        )
