"""The folder of a run: its inputs, and the rasters, layers and page that it gets besides clouds."""

import hashlib
import json
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pcfix.errors import silently
from pcfix.flow.adjust import FOLDER, SUMMARY
from pcfix.flow.dsm import BLOCK_CELLS, grid_dsm, point_spacing_m
from pcfix.flow.inputs import Inputs, paths_in, read_blocks
from pcfix.flow.raster import raster_writer
from pcfix.flow.runner import HOW, Progress
from pcfix.flow.surfaces import Points, file_points, view_of
from pcfix.grid.lattice import Lattice, Window, round_resolution
from pcfix.grid.maps import contours, depth_interval, hillshade, relief_colours, waterlines
from pcfix.io import rasters
from pcfix.io.clouds import (
    CloudFiles,
    Tiles,
    band_of,
    cloud_of,
    inputs_of,
    is_cloud,
    open_cloud,
    own_water,
    reference_of,
    tiles_from,
)
from pcfix.io.crs import crs_words
from pcfix.io.files import (
    belonging,
    check_input,
    file_state,
    files_in,
    read_json,
    sha256,
    write_bytes,
    write_text,
)
from pcfix.io.las.source import stated_crs
from pcfix.io.rasters import RasterBand, RasterSource
from pcfix.io.tables import read_check_depths
from pcfix.io.vectors import Layer, write_layers
from pcfix.model import BATHYMETRIC_POINT, Cameras, FloatArray, WaterSurface
from pcfix.options.correct import LEVEL_M, RunOptions
from pcfix.options.declare import options_of
from pcfix.options.steps import DistanceOptions, DsmOptions
from pcfix.report.adjustment import adjustment_sentence
from pcfix.report.comparison import evaluation
from pcfix.report.page import Symbol, Table, limits_of, render, vector_style
from pcfix.report.run import RunMaps, run_report
from pcfix.report.text import Plain, Summary
from pcfix.version import __version__
from pcfix.water.surface import surface_above

RECORD, SURFACE = "run.json", "surface.tif"
# The steps in order; each depends on those before it.
STEPS = ("adjust", "correct", "clean", "dsm", "compare", "map", "report")
# The first step that depends on an option, for options that do not affect all steps.
LATER = {
    **{one.name: "compare" for one in options_of(DistanceOptions)},
    "reference": "compare", "resolution": "dsm", "project": "report", "date": "report",
}  # fmt: skip
BED, DEPTH, UNCERTAINTY = "bed.tif", "depth.tif", "uncertainty.tif"
COUNTS, SHADED, CORRECTED = "surface_counts.tif", "shaded.tif", "corrected.tif"
DIFFERENCE, PAGE = "compare/dod.tif", "report.html"
# The results of a run by name; only existing ones are listed.
RESULTS = {
    "corrected.laz": "all points, the bed corrected",
    "cleaned.laz": "all points, with outliers flagged as noise",
    DEPTH: "depth below the water",
    BED: "heights of the bed",
    SURFACE: "heights of land and bed",
    UNCERTAINTY: "vertical uncertainty at 95 %",
    COUNTS: "number of points in each cell, and their spread",
    SHADED: "coloured, shaded relief",
    "map.gpkg": "contours, waterline and other layers for a GIS",
    "run.json": "options and results of the run",
    "compare/compare.json": "all figures of the comparison",
    "compare/depth_bins.csv": "errors by depth",
    DIFFERENCE: "cloud minus reference",
    "compare/reference_dsm.tif": "heights of the reference",
    "adjusted/report.html": "the adjustment of the cameras",
}


@dataclass(frozen=True)
class RunFolder:
    """A run: its folder, its cloud (for many files see `tiles_of`), and its options."""

    folder: Path
    input: str | tuple[str, ...]
    options: RunOptions

    @cached_property
    def source(self) -> CloudFiles:
        """The cloud, in one file or many, or the cells of a raster."""
        return band_of(cloud_of(self.input), self.options)

    @cached_property
    def reference(self) -> Path | Tiles:
        """The reference, in one file or many."""
        return reference_of(self.options.reference or "")

    @property
    def has_surface(self) -> bool:
        """Whether the reference is a surface, not check points."""
        suffix = Path(str(self.options.reference)).suffix.lower()
        return is_cloud(self.reference) or suffix in (".tif", ".tiff")

    def with_adjusted(self, model: str | None) -> "RunFolder":
        """Return the run for the next steps, with the adjusted cameras if there are any."""
        if model is None:
            return self
        options = replace(
            self.options, cameras=str(self.folder / FOLDER / model),
            adjusted_from=self.options.cameras, adjust="no", gcps=None, gnss=None, lens=None,
        )  # fmt: skip
        return replace(self, options=options)

    @cached_property
    def files(self) -> dict[str, list[Path]]:
        """The input files by the first step that reads them; each exists."""
        water = Path(self.options.water)
        first = [check_input(one) for one in inputs_of(self.source)]
        first += [one for path in self._named for one in files_in(path)]
        first += [water] if water.is_file() else []
        compared = [] if self.options.reference is None else [self.reference]
        compared += [cloud_of(path) for _, path in self.options.also]
        later = [check_input(path) for cloud in compared for path in inputs_of(cloud)]
        return {"adjust": first, "compare": later}

    @property
    def _named(self) -> list[Path]:
        """The files of the first step, except cloud and water."""
        return paths_in(self.options, but=("water", "reference"))

    def settings(self) -> dict[str, Any]:
        """Return plain values of all that the results depend on, besides the files."""
        values = {name: one for name, one in self.options.as_dict().items() if name not in HOW}
        return {"input": self.input, **values, "pcfix": __version__}

    def keys(self) -> dict[str, str]:
        """Return a hash for each step, of its options, its input files and the step before it."""
        settings, results = self.settings(), self.folder.resolve()
        # files that are read with a named one, such as sensor.csv, may appear later
        more = {one for path in self._named for one in belonging(path)}
        more = {one for one in more if results not in one.resolve().parents}
        files = {**self.files, "adjust": [*self.files["adjust"], *sorted(more)]}
        keys, key = dict[str, str](), ""
        for step in STEPS:
            options = sorted(one for one in settings.items() if LATER.get(one[0], "adjust") == step)
            states = [file_state(one) for one in files.get(step, [])]
            text = json.dumps([key, options, states])
            key = keys[step] = hashlib.sha256(text.encode()).hexdigest()
        return keys

    # Results

    def cloud_files(self, name: str) -> list[Path]:
        """Return the files of a cloud of the run: one, or as many as the input has."""
        path, tiles = self.path_of(name), self.source
        return [path / one.name for one in tiles.paths] if isinstance(tiles, Tiles) else [path]

    def path_of(self, name: str) -> Path:
        """Return the path of the cloud corrected or cleaned, a folder for many files."""
        return self.folder / (name if isinstance(self.source, Tiles) else f"{name}.laz")

    def cloud(self, name: str) -> Path | Tiles:
        """Return the cloud corrected or cleaned, which must exist."""
        path, files = self.path_of(name), self.cloud_files(name)
        with silently():  # this and other warnings were shown when the cloud was corrected
            return tiles_from(str(path), files) if isinstance(self.source, Tiles) else path

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras in the CRS of the cloud."""
        inputs = replace(self.options, views=None).part(Inputs)
        with silently():
            return read_blocks(inputs, view_of(self.cloud("corrected"))).cameras

    @cached_property
    def water(self) -> WaterSurface:
        """The water surface: as recorded in the corrected cloud, else as requested."""
        cloud = self.cloud("corrected")
        with silently(), open_cloud(cloud) as source:
            return own_water(source) or self.options.part(Inputs).surface(view_of(cloud)).surface


# The rasters

HOLE_CELLS = 3.0  # width of filled holes: of cells with random points, one in twenty is empty


def raster_files(run: RunFolder, errors: bool) -> list[Path]:
    """Return the files of `write_rasters`; `errors` is whether the cloud has standard errors."""
    maps = [SURFACE, BED, DEPTH, *([UNCERTAINTY] if errors else [])]
    cells = [CORRECTED] if isinstance(run.source, RasterBand) else []
    files = [run.folder / name for name in (*maps, COUNTS, SHADED, *cells)]
    return [*files, *((run.folder / name).with_suffix(".qml") for name in maps)]


def write_rasters(run: RunFolder, errors: bool, progress: Progress | None = None) -> Plain:
    """Write all rasters of a corrected cloud as cloud optimised GeoTIFF, with styles for QGIS.

    By default the cells have 2 to 4 points, or those of a raster are as large as its own. This is
    also written on its own grid. Returns the side of the cells for ``run.json``.
    """
    folder, cloud, cell_m = run.folder, run.cloud("cleaned"), run.options.resolution
    source = run.source
    if isinstance(source, RasterBand) and isinstance(cloud, Path):
        cells = RasterSource(source)
        cell_m = cell_m or cells.cell_m
        with (
            cells, open_cloud(cloud) as corrected,
            raster_writer(cells, corrected.header, {"height": folder / CORRECTED}) as append,
        ):  # fmt: skip
            for points in corrected.chunks():
                append(points)
    if cell_m is None:
        cell_m = round_resolution(point_spacing_m(cloud, folder / SURFACE))
    plain = DsmOptions(resolution=cell_m, style=True, overwrite=True)
    filled = replace(plain, fill=HOLE_CELLS * cell_m)
    asked = {
        SURFACE: replace(filled, counts=folder / COUNTS),
        BED: replace(filled, surface="bed"),
        DEPTH: replace(filled, what="depth"),
        **({UNCERTAINTY: replace(plain, what="uncertainty")} if errors else {}),
    }
    for number, (name, options) in enumerate(asked.items()):

        def report(done: int, total: int, number: int = number) -> None:
            if progress is not None:
                progress(number * total + done, len(asked) * total)

        grid_dsm(cloud, folder / name, options=options, progress=report)
    _write_shaded(folder)
    return {"resolution_m": cell_m}


def _write_shaded(folder: Path) -> None:
    """Write the picture: the bed in the colours of its depth, the land grey.

    Some filled holes of the surface are under water and have no depth: it follows from the water
    around them.
    """
    from scipy.ndimage import minimum_filter

    target, edge = folder / SHADED, int(HOLE_CELLS)
    high = limits_of(rasters.preview(folder / DEPTH)[0], "depth")[1]
    one, other = (rasters.open_raster(folder / name) for name in (SURFACE, DEPTH))
    with one as surface, other as depth:
        lattice, below = rasters.lattice_of(surface), rasters.lattice_of(depth)
        down, right = lattice.first_row - below.first_row, lattice.first_column - below.first_column
        bands = dict.fromkeys(("red", "green", "blue", "alpha"), "")
        plan = None if depth.crs is None else depth.crs.to_wkt()
        with rasters.new_raster(target, lattice, plan, bands, dtype="uint8", nodata=None) as out:
            for window in lattice.window.parts(BLOCK_CELLS):
                wide = window.grown(edge)
                height = rasters.read_masked(surface, window=rasters.slices(wide), boundless=True)
                moved = rasters.slices(Window(*np.add(wide, (down, down, right, right)).tolist()))
                deep = rasters.read_masked(depth, window=moved, boundless=True)
                level = minimum_filter(np.nan_to_num(height + deep, nan=np.inf), 2 * edge + 1)
                is_wet = np.isnan(deep) & (height < level) & np.isfinite(level)
                deep = np.where(is_wet, level - height, deep)[edge:-edge, edge:-edge]
                around = height[edge - 1 : 1 - edge, edge - 1 : 1 - edge]
                light = hillshade(around, lattice.resolution_m)
                rasters.write_bands(out, relief_colours(light, deep, high), window)


# The layers

MOST_CELLS = 4_000_000  # of the rasters for contours and outline
DARK, RED, GREY = (8, 48, 107), (203, 24, 29), (120, 120, 120)
ORANGE, GREEN = (253, 141, 60), (35, 139, 69)


def write_map(path: Path, run: RunFolder, corrected: Plain, compared: Plain) -> None:
    """Write all layers of a run to a file.

    `corrected` and `compared` are the results of these steps. The height of the water has one
    standard error for all places.
    """
    folder, cloud, options = run.folder, run.cloud("cleaned"), run.options
    shapes = rasters.outlines(folder / DEPTH, MOST_CELLS)
    area = shapely.area(np.array(shapes, object)) if shapes else np.zeros(0)
    style = vector_style({"area": Symbol("fill", DARK, 0.5)})
    layers = [Layer("corrected_area", "Polygon", shapes, {"area_m2": area}, style)]
    # the depth contours, no finer than the depth is known
    depth, transform = rasters.preview(folder / DEPTH, MOST_CELLS)
    path_of_errors = folder / UNCERTAINTY
    errors = rasters.preview(path_of_errors)[0] if path_of_errors.exists() else np.zeros(0)
    interval = depth_interval(depth, errors)
    found = contours(depth, interval)
    places = [rasters.place_of(transform, *(place.T + 0.5)) for _, place in found]
    lines = [shapely.linestrings(*xy) for xy in places]
    level = np.array([level for level, _ in found])
    values = {"depth_m": level, "interval_m": np.full(len(found), interval)}
    style = vector_style({"line": Symbol("line", DARK, 0.25)}, label='"depth_m"')
    layers.append(Layer("depth_contours", "LineString", lines, values, style))
    known = options.sigma_level, (corrected["water_fit"] or {}).get("sigma_level_m"), LEVEL_M
    sigma_m = next(one for one in known if one is not None)
    layers.append(waterline(cloud, run.water, sigma_m))
    if sections := compared.get("figures", {}).get("sections", []):
        ends = [[(one["x1"], one["y1"]), (one["x2"], one["y2"])] for one in sections]
        lines = list(shapely.linestrings(ends))
        names = np.array([f"Cross-section {n}" for n, _ in enumerate(lines, start=1)], object)
        values = {"name": names, "length_m": shapely.length(lines)}
        style = vector_style({"line": Symbol("line", GREY, 0.4)}, label='"name"')
        layers.append(Layer("cross_sections", "LineString", lines, values, style))
    # the projection centres
    labels = np.array(run.cameras.labels, object)
    use = np.where(np.isin(labels, corrected["cameras_unused"]), "not used", "used")
    values = {"label": labels, "use": use.astype(object)}
    symbols = {"used": Symbol("marker", GREEN, 2.0), "not used": Symbol("marker", GREY, 1.6)}
    centres = list(shapely.points(run.cameras.centres))
    layers.append(Layer("cameras", "Point Z", centres, values, vector_style(symbols, "use")))
    # surveyed points with the differences of the cloud, or of the map of depths
    symbol = {"point": Symbol("marker", ORANGE, 2.2, "diamond")}
    style = vector_style(symbol, label="""format_number("residual_m", 2)""")
    # x, y, reference height, and cloud minus reference
    points = np.array(compared.get("check_points", [])).reshape(-1, 4)
    if len(points):
        values = {"z_m": points[:, 2], "residual_m": points[:, 3]}
        surveyed = list(shapely.points(points[:, :3]))
        layers.append(Layer("check_points", "Point Z", surveyed, values, style))
    if options.check_depths is not None:
        checks = read_check_depths(Path(options.check_depths))
        raster = BED if checks.are_heights else DEPTH
        more = rasters.values_at(folder / raster, checks.xy) - checks.value_m
        values = {"measured_m": checks.value_m, "residual_m": more}
        surveyed = list(shapely.points(checks.xy))
        layers.append(Layer("check_depths", "Point", surveyed, values, style))
    write_layers(path, layers, view_of(cloud).crs, overwrite=True)


def waterline(cloud: Path | Tiles, water: WaterSurface, sigma_m: float) -> Layer:
    """Return where the water meets the corrected cloud, with the standard error across the line.

    `sigma_m` is that of the height of the water.
    """

    def columns(points: Points) -> FloatArray:
        """Return x, y, z, height above the water, and standard error of points."""
        known = points.dimensions or {}
        above = points.xyz[:, 2] - surface_above(water, points.xyz, points.heights).height_m
        bed = points.classes == BATHYMETRIC_POINT
        above[bed] = -known["WaterDepth"][bed]
        above[~points.counts()] = np.nan
        return np.column_stack([points.xyz, above, known["SigmaZ"]])

    chunks = file_points(cloud, water, ("WaterDepth", "SigmaZ"))
    lines = waterlines(map(columns, chunks), sigma_m)
    values = {
        figure: np.array([getattr(one, figure) for one in lines], np.float64)
        for figure in ("level_m", "sigma_m", "length_m")
    }
    geometries = [shapely.linestrings(one.xy) for one in lines]
    style = vector_style({"line": Symbol("line", RED, 0.5)})
    return Layer("waterline", "LineString", geometries, values, style)


# The report page

MOST_PAGE_CELLS = 300_000  # of the map on the page, so that this stays below 4 MB


def report_run(
    run: RunFolder, inputs: list[Path], first: Plain, corrected: Plain, compared: Plain
) -> Plain:
    """Write ``report.html`` and ``figures/*.png`` of a run, and return its main figures.

    The page lists size and checksum of the files `inputs`. `first`, `corrected` and `compared` are
    the results of these steps.
    """
    folder, options, summary = run.folder, run.options, Summary(**corrected)
    names = [SURFACE, DEPTH, *([] if summary.uncertainty is None else [UNCERTAINTY])]
    names += [DIFFERENCE] if compared and run.has_surface else []
    # the rasters in cells of theirs, or of several where there are many
    with rasters.open_raster(folder / SURFACE) as surface:
        fine = rasters.lattice_of(surface)
    k = max(1, math.ceil(math.sqrt(fine.width * fine.height / MOST_PAGE_CELLS)))
    column, row = fine.first_column // k, fine.first_row // k
    width = (fine.first_column + fine.width - 1) // k - column + 1
    height = (fine.first_row + fine.height - 1) // k - row + 1
    lattice = Lattice(k * fine.resolution_m, column, row, width, height)
    values = {name: rasters.read_onto(folder / name, lattice) for name in names}
    with open_cloud(run.cloud("cleaned")) as source:
        crs, heights = crs_words(stated_crs(source))
    unknown = np.full((height, width), np.nan)
    maps = RunMaps(
        lattice, values[SURFACE], values[DEPTH], values.get(UNCERTAINTY, unknown),
        values.get(DIFFERENCE), crs, heights,
    )  # fmt: skip
    more: Plain = {"verdict": "", "compared": compared.get("figures", {})}
    if compared:
        more["pictures"], more["tables"] = evaluation(
            compared["figures"], compared["sections"], maps.lattice, maps.difference_m
        )
    if first["why"]:
        how = "not adjusted:" if first["model"] is None else "adjusted first, as"
        more["verdict"] = f" The cameras were {how} {first['why']}."
    if first["model"] is not None:
        more["verdict"] += f" {adjustment_sentence(read_json(folder / FOLDER / SUMMARY))}."
    rows = [[path.name, f"{path.stat().st_size:,}", sha256(path)] for path in inputs]
    files = []
    for name, words in RESULTS.items():
        tiles = folder / name.removesuffix(".laz")
        if (folder / name).is_file():
            files.append((name, words))
        elif tiles.is_dir():  # of many files
            files.append((f"{tiles.name}/", words))
    sections = sorted(folder.glob("compare/section_*.csv"))
    files += [(f"compare/{one.name}", "a cross-section") for one in sections]
    page = run_report(
        summary, run.cameras, maps, project=options.project or "", date=options.date or "",
        inputs=[Table("Input files", ["file", "bytes", "SHA-256"], rows)], files=files, **more,
    )  # fmt: skip
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    for picture in page.pictures:
        write_bytes(figures / f"{picture.name}.png", picture.png, overwrite=True)
    write_text(folder / PAGE, render(page), overwrite=True)
    shown = (
        f"{', '.join(filter(None, [tile.title, tile.tag]))}: "
        + ", ".join(f"{name} {value}" for name, value in tile.figures)
        for tile in page.tiles
        if tile.figures
    )
    return {"in_short": "; ".join(shown)}
