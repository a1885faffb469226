"""The rasters that a run writes for a GIS: surface, bed, depth, uncertainty, shaded relief."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.flow.dsm import grid_dsm
from pcfix.flow.runner import Progress
from pcfix.flow.sorted_points import BLOCK_CELLS, point_spacing_m
from pcfix.grid.colours import relief_colours
from pcfix.grid.lattice import Lattice, Window, round_resolution
from pcfix.grid.model import hillshade
from pcfix.io import rasters
from pcfix.io.atomic import scratch_folder, temporary_output
from pcfix.io.styles import limits_of
from pcfix.io.tiles import Tiles, open_cloud
from pcfix.model import Cameras, FloatArray
from pcfix.options.steps import DsmOptions, DsmRules

SURFACE, BED, DEPTH, UNCERTAINTY = "surface.tif", "bed.tif", "depth.tif", "uncertainty.tif"
COUNTS, SHADED = "surface_counts.tif", "shaded.tif"
HOLE_CELLS = 3.0
"""Width of holes that are filled: of cells with random points, one in twenty is empty."""
SUN_DEG = 315.0, 45.0


def raster_files(folder: Path, *, errors: bool) -> list[Path]:
    """Return the files of `write_rasters`; `errors` is whether the cloud has standard errors."""
    maps = [SURFACE, BED, DEPTH, *([UNCERTAINTY] if errors else [])]
    files = [folder / name for name in (*maps, COUNTS, SHADED)]
    return [*files, *((folder / name).with_suffix(".qml") for name in maps)]


def write_rasters(
    cloud: Path | Tiles, folder: Path, *, resolution: float | None, cameras: Cameras, errors: bool,
    progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Write all rasters of a corrected cloud as cloud optimised GeoTIFF, with styles for QGIS.

    By default the cells have 2 to 4 points, and are no smaller than a pixel on the ground. Returns
    the facts for ``run.json``.
    """
    gsd_m = _gsd_m(cloud, cameras)
    spacing_m = point_spacing_m(cloud, DsmRules())
    cell_m = resolution or round_resolution(spacing_m, gsd_m or 0.0)
    plain = DsmOptions(resolution=cell_m, cog=True, style=True, overwrite=True)
    filled = replace(plain, fill=HOLE_CELLS * cell_m)
    asked = {
        SURFACE: replace(filled, counts=folder / COUNTS),
        BED: replace(filled, surface="bed"),
        DEPTH: replace(filled, what="depth"),
        **({UNCERTAINTY: replace(plain, what="uncertainty")} if errors else {}),
    }
    made = {}
    for number, (name, options) in enumerate(asked.items()):

        def tell(done: int, total: int, number: int = number) -> None:
            if progress is not None:
                progress(number * total + done, len(asked) * total)

        made[name] = grid_dsm(cloud, folder / name, options=options, progress=tell)
    _write_shaded(folder)
    density = (cell_m / spacing_m) ** 2 if spacing_m else None
    return {
        "resolution_m": cell_m,
        "points_per_cell": density,
        "gsd_m": gsd_m,
        **{Path(name).stem: summary.as_dict() for name, summary in made.items()},
    }


def resolution_sentence(made: dict[str, Any], *, given: bool) -> str:
    """Return the size of the cells of the rasters, and its reason."""
    density, gsd_m = made["points_per_cell"], made["gsd_m"]
    parts = [] if density is None else [f"{density:.1f} points each"]
    parts += [] if gsd_m is None else [f"GSD {gsd_m:.2g} m"]
    more = f" ({', '.join(parts)})" if parts else ""
    return f", cells of {made['resolution_m']:g} m{', as given' if given else ''}{more}"


def _gsd_m(cloud: Path | Tiles, cameras: Cameras) -> float | None:
    """Return the size of a pixel on the ground at nadir, median; None without lenses."""
    if not cameras.lenses:
        return None
    with open_cloud(cloud) as source:
        middle = float(source.header.mins[2] + source.header.maxs[2]) / 2.0
    focal = np.array([lens.focal_px for lens in cameras.lenses])
    return float(np.median((cameras.centres[:, 2] - middle) / focal))


def _write_shaded(folder: Path) -> None:
    """Write the picture: the bed in the colours of its depth, the land grey."""
    target = folder / SHADED
    high = limits_of(rasters.preview(folder / DEPTH)[0], "depth")[1]
    with ExitStack() as stack:
        draft = stack.enter_context(temporary_output(target))
        plain = stack.enter_context(scratch_folder(target)) / SHADED
        surface = stack.enter_context(rasters.open_raster(folder / SURFACE))
        depth = stack.enter_context(rasters.open_raster(folder / DEPTH))
        lattice = rasters.lattice_of(surface)
        bands = dict.fromkeys(("red", "green", "blue", "alpha"), "")
        plan = None if depth.crs is None else depth.crs.to_wkt()
        with rasters.new_raster(plain, lattice, plan, bands, dtype="uint8", nodata=None) as out:
            for window, height, deep in _parts(surface, depth, lattice):
                light = hillshade(height, lattice.resolution_m, *SUN_DEG)
                colours = relief_colours(light, deep, high, flat=np.sin(np.radians(SUN_DEG[1])))
                for number, band in enumerate(colours, start=1):
                    rasters.write_part(out, band, window, number)
        rasters.copy_as_cog(plain, draft)


def _parts(
    surface: Any, depth: Any, lattice: Lattice
) -> Iterator[tuple[Window, FloatArray, FloatArray]]:
    """Yield windows with their heights, one cell wider all around, and their depths.

    Holes of the surface are filled between land and bed, so some cells are under water that have
    no depth: that of the water beside them.
    """
    from scipy.ndimage import minimum_filter

    below, edge = rasters.lattice_of(depth), int(HOLE_CELLS)
    row, column = below.first_row - lattice.first_row, below.first_column - lattice.first_column
    for window in lattice.windows(BLOCK_CELLS):
        wide = window.grown(edge)
        height = rasters.read_within(surface, wide, lattice.window)
        deep = rasters.read_within(depth, wide.moved(-row, -column), below.window)
        level = minimum_filter(np.nan_to_num(height + deep, nan=np.inf), 2 * edge + 1)
        is_wet = np.isnan(deep) & (height < level) & np.isfinite(level)
        deep = np.where(is_wet, level - height, deep)
        yield window, height[edge - 1 : 1 - edge, edge - 1 : 1 - edge], deep[edge:-edge, edge:-edge]
