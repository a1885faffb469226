"""The vector layers of ``map.gpkg``, which a run writes for a GIS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import shapely

from pcfix.compare.sections import SectionLine, lines_downslope
from pcfix.errors import GeometryError
from pcfix.flow.rasters import BED, DEPTH, UNCERTAINTY
from pcfix.flow.shore import shoreline_layer
from pcfix.flow.surfaces import points_of, view_of
from pcfix.grid.contours import contours, depth_interval
from pcfix.grid.shoreline import NearWater
from pcfix.io import rasters
from pcfix.io.geopackage import Layer, write_layers
from pcfix.io.styles import Symbol, vector_style
from pcfix.io.tables import read_check_depths
from pcfix.io.tiles import Tiles, open_cloud
from pcfix.model import BATHYMETRIC_POINT, NOISE_CLASSES, Cameras, FloatArray, WaterSurface
from pcfix.options.correct import LEVEL_M
from pcfix.options.declare import File
from pcfix.water.surface import surface_above

MOST_CELLS = 4_000_000
"""Of the rasters for contours and outline."""
SECTIONS = 3
DARK, RED, GREY = (8, 48, 107), (203, 24, 29), (120, 120, 120)
ORANGE, GREEN = (253, 141, 60), (35, 139, 69)


def write_map(
    path: Path,
    cloud: Path | Tiles,
    folder: Path,
    *,
    water: WaterSurface,
    sigma_level_m: float | None,
    cameras: Cameras,
    unused: Sequence[str],
    sections: Sequence[Mapping[str, float]],
    check_points: FloatArray,
    check_depths: File | None,
) -> dict[str, int]:
    """Write all layers of a run in a folder; return how many features each has.

    `sigma_level_m` is the standard error of the water level, None where unknown; `sections` are the
    lines of the comparison; `check_points`, shape (n, 4), are x, y, reference height, and cloud
    minus reference.
    """
    shapes = rasters.outlines(folder / DEPTH, MOST_CELLS)
    area = shapely.area(np.array(shapes, object)) if shapes else np.zeros(0)
    style = vector_style({"area": Symbol("fill", DARK, 0.5)})
    layers = [
        Layer("corrected_area", "Polygon", shapes, {"area_m2": area}, style),
        contours_layer(folder),
        _waterline(cloud, water, LEVEL_M if sigma_level_m is None else sigma_level_m),
        _sections(sections, folder),
        _cameras(cameras, unused),
        *_checks(folder, check_points, check_depths),
    ]
    write_layers(path, layers, view_of(cloud).crs, overwrite=True)
    return {one.name: len(one.geometries) for one in layers}


def contours_layer(folder: Path, interval: float | None = None) -> Layer:
    """Return the depth contours; the default interval follows from the uncertainty."""
    depth, bounds = rasters.preview(folder / DEPTH, MOST_CELLS)
    if interval is None:
        path = folder / UNCERTAINTY
        sigma = rasters.preview(path)[0] if path.exists() else np.zeros(0)
        interval = depth_interval(depth, sigma)
    found = contours(depth, interval)
    lines = [shapely.linestrings(rasters.centres(one.place, depth, bounds)) for one in found]
    level = np.array([one.level for one in found])
    values = {"depth_m": level, "interval_m": np.full(len(found), interval)}
    style = vector_style({"line": Symbol("line", DARK, 0.25)}, label='"depth_m"')
    return Layer("depth_contours", "LineString", lines, values, style)


def _waterline(cloud: Path | Tiles, water: WaterSurface, sigma_m: float) -> Layer:
    """Return where the water meets the corrected cloud."""
    near = NearWater()
    with open_cloud(cloud) as source:
        for chunk in source.chunks():
            points = points_of(chunk, source, water)
            above = points.xyz[:, 2] - surface_above(water, points.xyz, points.heights).height_m
            bed = points.classes == BATHYMETRIC_POINT
            above[bed] = -source.dimension(chunk, "WaterDepth")[bed]
            above[np.isin(points.classes, NOISE_CLASSES) | (chunk["withheld"] == 1)] = np.nan
            near += NearWater.of(points.xyz, above, source.dimension(chunk, "SigmaZ"))
    lines = near.lines(lambda xy: np.full(len(xy), sigma_m))
    style = vector_style({"line": Symbol("line", RED, 0.5)})
    return shoreline_layer("waterline", lines, style)


def _sections(sections: Sequence[Mapping[str, float]], folder: Path) -> Layer:
    """Return the cross-sections of the comparison, else lines down the slope of the bed."""
    lines = [SectionLine(s["x1"], s["y1"], s["x2"], s["y2"]) for s in sections]
    if not lines:
        bed, bounds = rasters.preview(folder / BED)
        row, column = np.nonzero(np.isfinite(bed))
        xy = rasters.centres(np.column_stack([column, row]), bed, bounds)
        try:
            lines = list(lines_downslope(np.column_stack([xy, bed[row, column]]), SECTIONS))
        except GeometryError:  # the bed is a line in plan
            lines = []
    names = np.array([f"Cross-section {n}" for n, _ in enumerate(lines, start=1)], object)
    values = {"name": names, "length_m": np.array([one.length_m for one in lines])}
    ends = [shapely.linestrings([(one.x1, one.y1), (one.x2, one.y2)]) for one in lines]
    style = vector_style({"line": Symbol("line", GREY, 0.4)}, label='"name"')
    return Layer("cross_sections", "LineString", ends, values, style)


def _cameras(cameras: Cameras, unused: Sequence[str]) -> Layer:
    """Return the projection centres, and whether each was used."""
    use = np.where(np.isin(cameras.labels, unused), "not used", "used").astype(object)
    symbols = {"used": Symbol("marker", GREEN, 2.0), "not used": Symbol("marker", GREY, 1.6)}
    values = {"label": np.array(cameras.labels, object), "use": use}
    points = list(shapely.points(cameras.centres))
    return Layer("cameras", "Point Z", points, values, vector_style(symbols, "use"))


def _checks(folder: Path, points: FloatArray, depths: File | None) -> list[Layer]:
    """Return surveyed points with the differences of the cloud, or of the map of depths."""
    symbol = {"point": Symbol("marker", ORANGE, 2.2, "diamond")}
    style = vector_style(symbol, label="""format_number("residual_m", 2)""")
    layers = []
    if len(points):
        values = {"z_m": points[:, 2], "residual_m": points[:, 3]}
        places = list(shapely.points(points[:, :3]))
        layers.append(Layer("check_points", "Point Z", places, values, style))
    if depths is not None:
        checks = read_check_depths(Path(depths))
        raster = BED if checks.are_heights else DEPTH
        more = rasters.values_at(folder / raster, checks.xy) - checks.value_m
        values = {"measured_m": checks.value_m, "residual_m": more}
        places = list(shapely.points(checks.xy))
        layers.append(Layer("check_depths", "Point", places, values, style))
    return layers
