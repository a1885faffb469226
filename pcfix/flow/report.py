"""Read a corrected cloud once, and write its report page and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.flow.adjust import FOLDER, SUMMARY
from pcfix.flow.request import RunFolder
from pcfix.flow.surfaces import view_of
from pcfix.flow.water import found_picture
from pcfix.grid.maps import MOST_CELLS, MapsBuilder
from pcfix.io.crs import crs_words
from pcfix.io.files import read_json, sha256, write_bytes, write_text
from pcfix.io.las.source import stated_crs
from pcfix.io.rasters import preview
from pcfix.io.tiles import Tiles, open_cloud
from pcfix.model import Cameras
from pcfix.report.adjustment import adjustment_sentence
from pcfix.report.comparison import evaluation
from pcfix.report.page import Report, Table, render
from pcfix.report.run import CloudMaps, run_report
from pcfix.report.summary import Summary
from pcfix.report.text import Plain

COLUMNS = ("WaterDepth", "ShiftZ", "RayCount", "SigmaZ")
SAMPLE_POINTS = 200_000
"""Points in the figure of uncertainty, evenly spread over the file."""
PAGE = "report.html"
RESULTS = {
    "corrected.laz": "all points, the bed corrected",
    "cleaned.laz": "all points, with outliers flagged as noise",
    "depth.tif": "depth below the water",
    "bed.tif": "heights of the bed",
    "surface.tif": "heights of land and bed",
    "uncertainty.tif": "vertical uncertainty at 95 %",
    "surface_counts.tif": "number of points in each cell, and their spread",
    "shaded.tif": "coloured, shaded relief",
    "map.gpkg": "contours, waterline and other layers for a GIS",
    "run.json": "options and results of the run",
    "compare/compare.json": "all figures of the comparison",
    "compare/depth_bins.csv": "errors by depth",
    "compare/shore_bins.csv": "errors by distance from the shore",
    "compare/dod.tif": "cloud minus reference",
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
    request, summary = run.request, Summary(**corrected)
    if compared:
        dod = preview(run.dod, MOST_CELLS) if request.has_surface else None
        figures = evaluation(compared["figures"], compared["sections"], dod)
        more |= {"difference": dod, "pictures": figures[0], "tables": figures[1]}
    if first["model"] is not None:
        more["verdict"] += f" {adjustment_sentence(read_json(run.folder / FOLDER / SUMMARY))}."
    if (summary.water_fit or {}).get("model") == "auto":  # the water was sought in the cloud
        more["pictures"].append(found_picture(run.inputs.surface(view_of(request.source))))
    page = write_report(
        run.folder, summary, run.cameras, read_cloud(run.cleaned_cloud, run.resolution_m), inputs,
        project=request.project or "", date=request.date or "", **more,
    )  # fmt: skip
    shown = [
        f"{tile.title}{f', {tile.tag}' if tile.tag else ''}: "
        + ", ".join(f"{name} {value}" for name, value in tile.figures)
        for tile in page.tiles
        if tile.figures
    ]
    return {"in_short": "; ".join(shown)}


def write_report(
    folder: Path, summary: Summary, cameras: Cameras, cloud: CloudMaps, inputs: Sequence[Path],
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
    report = run_report(summary, cameras, cloud, inputs=[table], files=files, **more)
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)
    for picture in report.pictures:
        write_bytes(figures / f"{picture.name}.png", picture.png, overwrite=True)
    write_text(folder / PAGE, render(report), overwrite=True)
    return report


def read_cloud(path: Path | Tiles, resolution_m: float | None = None) -> CloudMaps:
    """Return what the page shows of a cloud: maps, depths, a sample, CRS and vertical datum.

    The cloud is from `correct_file` with all dimensions, cleaned or not; `resolution_m` is that of
    the rasters.
    """
    view = view_of(path)
    builder = MapsBuilder(view.low, view.high, view.points, resolution_m)
    every = max(1, view.points // SAMPLE_POINTS)
    sample, least, most, total, count = [], np.inf, -np.inf, 0.0, 0
    for points in view.chunks(None, COLUMNS):
        good, known = points.counts(), points.dimensions or {}
        values = np.column_stack([known[name][good] for name in COLUMNS])
        moved = values[:, 2] > 0.0
        values = values[moved]
        builder.add(points.xyz[good], moved, values)
        sample.append(values[-count % every :: every, [0, 3]])
        depth = values[:, 0]
        least, most = depth.min(initial=least), depth.max(initial=most)
        total, count = total + float(depth.sum()), count + len(depth)
    depth_m = {"min": float(least), "mean": total / max(count, 1), "max": float(most)}
    with open_cloud(path) as source:
        names = crs_words(stated_crs(source))
    return CloudMaps(builder.maps(), depth_m, np.vstack(sample), *names)
