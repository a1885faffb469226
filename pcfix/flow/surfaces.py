"""The water surface of a cloud: read, fitted to shoreline points, or found in it."""

import warnings
from collections.abc import Iterable, Iterator
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.runner import read_ahead
from pcfix.io.clouds import CloudFiles, open_cloud
from pcfix.io.clouds import CloudView as CloudView
from pcfix.io.clouds import Points as Points
from pcfix.io.clouds import points_of as points_of
from pcfix.io.las.source import metric_crs, stated_crs
from pcfix.io.vectors import SHORE_RADIUS_M, is_vector_file, read_shoreline
from pcfix.io.water import rasters_of_images, read_water, read_water_raster
from pcfix.model import (
    NOISE_CLASSES,
    Cameras,
    FloatArray,
    IntArray,
    Views,
    WaterDimension,
    WaterMesh,
    WaterRaster,
    WaterSurface,
)
from pcfix.options.declare import File
from pcfix.options.shared import WaterOptions
from pcfix.points.labelling import Part
from pcfix.water.surface import Field, FoundSurface, build_fields, surface_above

if TYPE_CHECKING:
    from pcfix.io.views import ViewMatch

SAMPLE_POINTS = 2_000_000  # points of a cloud that are searched for water, evenly spread


def corners(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the south-west and north-east corner of points, shapes (2,); NaN without points."""
    if not len(x):
        return np.full(2, np.nan), np.full(2, np.nan)
    return np.array([x.min(), y.min()]), np.array([x.max(), y.max()])


def view_of(cloud: CloudFiles, jobs: int | None = None, *, in_metres: bool = True) -> CloudView:
    """Return the view of a LAS or LAZ file, or of many as one cloud.

    Raises InputError if it is not `in_metres`, which does not matter to some steps.
    """
    with open_cloud(cloud, jobs) as source:
        return CloudView(
            str(cloud),
            metric_crs(source) if in_metres else stated_crs(source),
            np.array(source.header.mins[:2]),
            np.array(source.header.maxs[:2]),
            len(source),
            partial(file_points, cloud, jobs=jobs),
            str(source.header.generating_software or ""),
            float(max(source.header.scales)),
            frozenset(source.header.point_format.dimension_names),
        )


def file_points(
    cloud: CloudFiles, water: WaterSurface | None = None, names: Iterable[str] = (),
    jobs: int | None = None,
) -> Iterator[Points]:  # fmt: skip
    """Yield all points of a LAS or LAZ file, or of many, chunk by chunk; see `LasSource`."""
    with open_cloud(cloud, jobs) as source:
        yield from read_ahead(points_of(one, source, water, names) for one in source.chunks())


def sample_of(
    view: CloudView, rows: IntArray | int, water: WaterSurface | None = None,
    match: "ViewMatch | None" = None,
) -> Points:  # fmt: skip
    """Return some points of a cloud, with their views if there is a view list.

    `rows` are theirs, ascending, or about how many there are, evenly spread.
    """
    if isinstance(rows, int):
        rows = np.arange(0, view.points, max(1, view.points // rows))
    first, parts = 0, list[Points]()
    for one in view.chunks(water):
        low, high = np.searchsorted(rows, (first, first + len(one.xyz)))
        if match is not None:
            match = match if first else match.with_image_order(one.xyz)
            one = one._replace(views=match.views_of(one.xyz, first)[0])
        parts.append(one.take(rows[low:high] - first))
        first += len(one.xyz)
        if high == len(rows):
            break
    if len(parts) == 1:
        return parts[0]
    joined: list[Any] = [
        None if any(v is None for v in one) else np.concatenate(one)
        for one in zip(*(part[:-2] for part in parts), strict=True)
    ]
    views, lists = None, [part.views for part in parts if part.views is not None]
    if lists:
        start = np.cumsum(np.concatenate([[0], *(np.diff(one.start) for one in lists)]))
        views = Views(start, np.concatenate([one.camera for one in lists]), kind=lists[0].kind)
    return Points(*joined)._replace(views=views)


def parts_of(chunks: Iterable[Points], water: WaterSurface) -> Iterable[Part]:
    """Return chunks with the water above them."""
    return (
        Part(one.xyz, surface_above(water, one.xyz, one.heights), one.classes) for one in chunks
    )


def find_surface(
    water: WaterSurface | float | File, options: WaterOptions, view: CloudView | None
) -> FoundSurface:
    """Read, fit or find the water surface of a cloud; some kinds need no cloud.

    The water is what `pcfix.read_water` takes, a vector file of shoreline points or lines, to which
    a surface is fitted (see `pcfix.water.fit.fit_water` and `pcfix.water.river.fit_river`), or
    ``auto``: the surface is found in the cloud.
    """
    if not isinstance(water, str | PathLike | float | int):
        return FoundSurface(water)
    if str(water).strip().lower() == "auto":
        from pcfix.water.auto import find_water

        if view is None:
            text = "The water surface 'auto' is found in a cloud. Give the cloud too."
            raise SettingError("cloud.missing", text)
        some = sample_of(view, SAMPLE_POINTS)
        some = some.take(np.flatnonzero(~np.isin(some.classes, NOISE_CLASSES)))
        return find_water(some.xyz, some.rgb)
    if isinstance(water, str | PathLike) and is_vector_file(water):
        return _fitted(options, water, view)
    found = read_water(water, None if view is None else view.crs)
    if view is not None and isinstance(found, WaterMesh):
        _check_near(str(water), found.vertices, view, 0.0)
    elif view is not None and isinstance(found, WaterRaster):
        sides = np.multiply(found.height_m.shape[::-1], found.cell_m) * [1.0, -1.0]
        corner = np.array([found.left_m, found.top_m])
        _check_near(str(water), np.array([corner, corner + sides]), view, 0.0)
    return FoundSurface(found)


FAR_M = 1000.0  # largest distance of a shoreline from the cloud, unless the cloud itself is larger


def _check_near(name: str, xyz: FloatArray, view: CloudView, most_m: float) -> None:
    """Raise InputError if the vertices of a water surface are too far from the cloud in plan."""
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    away_m = float(np.maximum(low - view.high, view.low - high).max())
    if away_m > most_m:
        raise InputError(
            "water.no_overlap",
            f"{name}: does not overlap the cloud in plan; they are {away_m / 1e3:,.2f} km apart."
            " Check its CRS and the order of its axes.",
            path=name, away_m=away_m,
        )  # fmt: skip


MOST_OFFSET_M = 2.0  # median difference of the water of images and the common one, above tides


def own_water_of(
    folder: File | None,
    cameras: Cameras,
    water: WaterSurface,
    view: CloudView,
    level_offset_m: FloatArray | None = None,
) -> Field | None:
    """Return the separate water surfaces of images.

    The folder has rasters named after the images. `water` is that of the other images, and
    `level_offset_m`, shape (k,), how much higher the water stood at each image.
    """
    if folder is None:
        return None
    if isinstance(water, WaterMesh):
        raise SettingError(
            "option.exclusive",
            "water-per-image does not work with a mesh as the water of the other images. Give a"
            " level, a plane or a raster.",
            options=["water_per_image", "water"],
        )
    west, south, east, north = view.bounds
    offset = np.zeros(len(cameras)) if level_offset_m is None else level_offset_m
    heights, overlaps, differs_m = dict[int, WaterRaster](), False, list[float]()
    with warnings.catch_warnings():  # those of the first raster are enough
        for image, path in rasters_of_images(folder, cameras.labels).items():
            heights[image] = raster = read_water_raster(path, view.crs)
            warnings.simplefilter("ignore", PcfixWarning)
            # the rasters must overlap the cloud, and have the vertical datum of the common water
            rows, columns = np.nonzero(np.isfinite(raster.height_m))
            x = raster.left_m + (columns + 0.5) * raster.cell_m[0]
            y = raster.top_m - (rows + 0.5) * raster.cell_m[1]
            overlaps |= bool(((x >= west) & (x <= east) & (y >= south) & (y <= north)).any())
            if not isinstance(water, WaterDimension):
                common = surface_above(water, np.column_stack([x, y, x])).height_m + offset[image]
                off = raster.height_m[rows, columns] - common
                if np.isfinite(off).any():
                    differs_m.append(float(np.nanmedian(off)))
    if np.isfinite(west) and not overlaps:
        text = f"{folder}: none of its rasters overlaps the cloud. Check their CRS."
        raise InputError("water.no_overlap", text, path=folder)
    off_m = float(np.median(differs_m)) if differs_m else 0.0
    if abs(off_m) > MOST_OFFSET_M:
        raise InputError(
            "water.datum",
            f"{folder}: its water differs by {off_m:+.2f} m from --water ({water}). Give both the"
            " same vertical datum, and 'pcfix calm' the --level of the calm water.",
            path=folder, difference_m=off_m,
        )  # fmt: skip
    return build_fields(heights, len(cameras), water if isinstance(water, WaterRaster) else None)


def _fitted(options: WaterOptions, path: File, view: CloudView | None) -> FoundSurface:
    """Return the surface fitted to shoreline points; those without a height get the cloud's."""
    from pcfix.water.fit import fit_water, heights_from_cloud
    from pcfix.water.river import fit_river

    shore = read_shoreline(path, None if view is None else view.crs, crs=options.water_crs)
    if view is not None:
        _check_near(shore.name, shore.xyz, view, max(FAR_M, *(view.high - view.low)))
    xyz = shore.xyz.copy()
    lacking = np.isnan(xyz[:, 2])
    if lacking.any():
        if view is None:
            text = f"{shore.name} has points without a height. Give the cloud too."
            raise InputError("cloud.missing", text, path=shore.name)
        chunks = (one.xyz for one in view.chunks())
        xyz[lacking, 2] = heights_from_cloud(xyz[lacking, :2], chunks, SHORE_RADIUS_M)
        words = (
            f"{shore.name}: {int(lacking.sum()):,} points have no height and get that of the cloud"
            f" within {SHORE_RADIUS_M:g} m; {int(np.isnan(xyz[:, 2]).sum()):,} have none and are"
            " ignored."
        )
        warnings.warn(PcfixWarning("water.points", words), stacklevel=2)
    if options.water_model != "river":
        return fit_water(xyz, model=options.water_model, counts=shore.counts)
    low, high = (view.low, view.high) if view is not None else corners(*xyz[:, :2].T)
    return fit_river(xyz, (*low.tolist(), *high.tolist()), name=shore.name, counts=shore.counts)
