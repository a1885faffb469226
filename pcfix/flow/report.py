"""Write the report page of a run and its figures, from the rasters and results of its steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.flow.adjust import FOLDER, SUMMARY
from pcfix.flow.maps import DEPTH, UNCERTAINTY
from pcfix.flow.run_folder import SURFACE, RunFolder
from pcfix.grid.lattice import Lattice
from pcfix.io.crs import crs_words
from pcfix.io.files import read_json, sha256, write_bytes, write_text
from pcfix.io.las.source import stated_crs
from pcfix.io.rasters import lattice_of, open_raster, read_onto
from pcfix.io.tiles import open_cloud
from pcfix.model import Cameras
from pcfix.report.adjustment import adjustment_sentence
from pcfix.report.comparison import evaluation
from pcfix.report.page import Report, Table, extent_of, render
from pcfix.report.run import RunMaps, run_report
from pcfix.report.text import Plain, Summary

DIFFERENCE = "compare/dod.tif"
MOST_CELLS = 300_000
"""Of a map, so that the page stays below 4 MB."""
PAGE = "report.html"
RESULTS = {
    "corrected.laz": "all points, the bed corrected",
    "cleaned.laz": "all points, with outliers flagged as noise",
    DEPTH: "depth below the water",
    "bed.tif": "heights of the bed",
    SURFACE: "heights of land and bed",
    UNCERTAINTY: "vertical uncertainty at 95 %",
    "surface_counts.tif": "number of points in each cell, and their spread",
    "shaded.tif": "coloured, shaded relief",
    "map.gpkg": "contours, waterline and other layers for a GIS",
    "run.json": "options and results of the run",
    "compare/compare.json": "all figures of the comparison",
    "compare/depth_bins.csv": "errors by depth",
    DIFFERENCE: "cloud minus reference",
    "compare/reference_dsm.tif": "heights of the reference",
    "adjusted/report.html": "the adjustment of the cameras",
}
"""The results of a run by name; only existing ones are listed."""


def report_run(
    run: RunFolder, inputs: list[Path], first: Plain, corrected: Plain, compared: Plain
) -> Plain:
    """Write the page of a run, and return what it says in short.

    `first`, `corrected` and `compared` are the results of these steps.
    """
    more: Plain = {"pictures": [], "tables": [], "compared": compared.get("figures", {})}
    if first["why"]:
        how = "not adjusted:" if first["model"] is None else "adjusted first, as"
        more["verdict"] = f" The cameras were {how} {first['why']}."
    options, summary = run.options, Summary(**corrected)
    rasters = [SURFACE, DEPTH, *([] if summary.uncertainty is None else [UNCERTAINTY])]
    rasters += [DIFFERENCE] if compared and run.has_surface else []
    with open_cloud(run.cloud("cleaned")) as source:
        maps = read_maps(run.folder, rasters, *crs_words(stated_crs(source)))
    if compared:
        figures = evaluation(
            compared["figures"], compared["sections"], maps.difference_m, extent_of(maps.lattice)
        )
        more |= {"pictures": figures[0], "tables": figures[1]}
    if first["model"] is not None:
        more["verdict"] += f" {adjustment_sentence(read_json(run.folder / FOLDER / SUMMARY))}."
    page = write_report(
        run.folder, summary, run.cameras, maps, inputs,
        project=options.project or "", date=options.date or "", **more,
    )  # fmt: skip
    shown = (
        f"{tile.title} {tile.tag}: " + ", ".join(f"{name} {value}" for name, value in tile.figures)
        for tile in page.tiles
        if tile.figures
    )
    return {"in_short": "; ".join(shown)}


def write_report(
    folder: Path, summary: Summary, cameras: Cameras, maps: RunMaps, inputs: Sequence[Path],
    **more: Any,
) -> Report:  # fmt: skip
    """Write ``report.html`` and ``figures/*.png`` of a run, into its folder.

    The page lists size and checksum of the files `inputs`; `more` goes to `run_report`.
    """
    rows = [[path.name, f"{path.stat().st_size:,}", sha256(path)] for path in inputs]
    table = Table("Input files", ["file", "bytes", "SHA-256"], rows)
    files = []
    for name, words in RESULTS.items():
        tiles = folder / name.removesuffix(".laz")
        if (folder / name).is_file():
            files.append((name, words))
        elif tiles.is_dir():  # of many files
            files.append((f"{tiles.name}/", words))
    sections = sorted(folder.glob("compare/section_*.csv"))
    files += [(f"compare/{one.name}", "a cross-section") for one in sections]
    report = run_report(summary, cameras, maps, inputs=[table], files=files, **more)
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    for picture in report.pictures:
        write_bytes(figures / f"{picture.name}.png", picture.png, overwrite=True)
    write_text(folder / PAGE, render(report), overwrite=True)
    return report


def read_maps(folder: Path, names: Sequence[str], crs: str = "", heights: str = "") -> RunMaps:
    """Read rasters of a run by name, in cells of theirs, or of several where there are many.

    `crs` and `heights` name the CRS of the cloud and its vertical datum.
    """
    with open_raster(folder / SURFACE) as source:
        fine = lattice_of(source)
    k = max(1, math.ceil(math.sqrt(fine.width * fine.height / MOST_CELLS)))
    column, row = fine.first_column // k, fine.first_row // k
    width = (fine.first_column + fine.width - 1) // k - column + 1
    height = (fine.first_row + fine.height - 1) // k - row + 1
    lattice = Lattice(k * fine.resolution_m, column, row, width, height)
    values = {name: read_onto(folder / name, lattice) for name in names}
    uncertainty_m = values.get(UNCERTAINTY, np.full((height, width), np.nan))
    return RunMaps(
        lattice, values[SURFACE], values[DEPTH], uncertainty_m, values.get(DIFFERENCE), crs, heights
    )
