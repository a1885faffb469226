"""A cloud as a comparison wants it: positions before and after, which points count, its water."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.las.columns import SHIFTS
from pcfix.io.las.provenance import is_ours
from pcfix.io.las.source import LasSource, coordinates, las_errors
from pcfix.model import (
    BATHYMETRIC_POINT,
    NOISE_CLASSES,
    BoolArray,
    FloatArray,
    WaterDimension,
    WaterPlane,
    WaterSurface,
)

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    import laspy
    from pyproj import CRS


CHUNK_POINTS = 2_000_000


@dataclass(frozen=True, eq=False)
class SurveyCloud:
    """Points that count; n of them.

    Attributes
    ----------
    name : str
        For messages.
    xyz : array, shape (n, 3)
        Metres, world frame.
    crs : CRS or None
    left_out : int
        Points withheld, or of a class that does not count.
    shift_m : array, shape (n, 3), or None
        True minus apparent, of a cloud that pcfix corrected.
    bathymetric : array of bool, shape (n,)
        Class 40.
    water_m : array, shape (n,)
        Height of the water surface above each point; NaN where the cloud does not say.
    water : WaterSurface or None
        The surface itself, where it is known away from the points too.
    """

    name: str
    xyz: FloatArray
    crs: CRS | None
    left_out: int
    shift_m: FloatArray | None
    bathymetric: BoolArray
    water_m: FloatArray
    water: WaterSurface | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, rows: BoolArray) -> SurveyCloud:
        """Return the cloud with these rows alone."""
        return replace(
            self,
            xyz=self.xyz[rows],
            shift_m=None if self.shift_m is None else self.shift_m[rows],
            bathymetric=self.bathymetric[rows],
            water_m=self.water_m[rows],
        )


def read_cloud(
    path: str | os.PathLike[str],
    water: WaterSurface | None = None,
    skip_classes: Sequence[int] = NOISE_CLASSES,
) -> SurveyCloud:
    """Read the points that count of a LAS or LAZ cloud that fits in memory.

    Parameters
    ----------
    path : path
    water : WaterSurface, optional
        Default: what a cloud that pcfix corrected says of its own.
    skip_classes : sequence of int
        Points of these classes, and withheld ones, are left out.

    Raises
    ------
    InputError
        If the file is damaged, no point counts, or it lacks the dimension that `water` names.
    """
    with LasSource(path) as source:
        crs = _crs(source)
        own = water or own_water(source)
        chunks = source.chunks(CHUNK_POINTS)
        parts = [_part(source, p, own, given=water is not None, skip=skip_classes) for p in chunks]
        count = len(source)
    xyz = np.concatenate([part.xyz for part in parts])
    if len(xyz) == 0:
        raise InputError(
            f"{path}: every point is withheld or of a class that does not count"
            f" ({', '.join(map(str, skip_classes))}); there is nothing to compare."
        )
    shifts = [part.shift_m for part in parts if part.shift_m is not None]
    water_m = np.concatenate([part.water_m for part in parts])
    exact = water is not None or not np.isfinite(water_m).any()
    return SurveyCloud(
        str(path),
        xyz,
        crs,
        count - len(xyz),
        np.concatenate(shifts) if shifts else None,
        np.concatenate([part.bathymetric for part in parts]),
        water_m,
        own if exact and not isinstance(own, WaterDimension) else None,
    )


class _Part(NamedTuple):
    """The points of a chunk that count; see `SurveyCloud`."""

    xyz: FloatArray
    shift_m: FloatArray | None
    bathymetric: BoolArray
    water_m: FloatArray


def _part(
    source: LasSource,
    points: laspy.ScaleAwarePointRecord,
    water: WaterSurface | None,
    *,
    given: bool,
    skip: Sequence[int],
) -> _Part:
    """Return the points of a chunk that count."""
    classes = np.asarray(points["classification"])
    keep = ~(np.isin(classes, skip) | np.asarray(points["withheld"]).astype(bool))
    xyz = coordinates(points)
    names = set(points.point_format.extra_dimension_names)
    shift = None
    if names.issuperset(SHIFTS):
        shift = np.column_stack([np.asarray(points[name], np.float64) for name in SHIFTS])[keep]
    heights = None
    if isinstance(water, WaterDimension):
        heights = source.dimension(points, water.name)
    if not given and "WaterDepth" in names:
        depth = np.asarray(points["WaterDepth"], np.float64)
        above = np.where(depth > 0.0, xyz[:, 2] + depth, np.nan)
    elif water is not None:
        from pcfix.water.surface import surface_above  # with its compiler, not quick to load

        above = surface_above(water, xyz, heights).height_m
    else:
        above = np.full(len(xyz), np.nan)
    return _Part(xyz[keep], shift, classes[keep] == BATHYMETRIC_POINT, above[keep])


def own_water(source: LasSource) -> WaterSurface | None:
    """Return the plane of the water surface that the cloud's own VLR names, if any."""
    ours = next((vlr for vlr in source.vlrs if is_ours(vlr)), None)
    try:
        plane = None if ours is None else json.loads(ours.record_data)["water_plane"]
        return None if plane is None else WaterPlane(*map(float, plane))
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{source.path}: pcfix's own VLR is damaged ({error}); correct the original again."
        ) from error


def _crs(source: LasSource) -> CRS | None:
    from pyproj.exceptions import CRSError

    try:
        with las_errors(source.path):
            crs: CRS | None = source.header.parse_crs()
    except CRSError as error:
        raise InputError(
            f"{source.path}: its CRS cannot be read ({error}); export it again."
        ) from error
    return crs
