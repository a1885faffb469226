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
from pcfix.io.las.source import coordinates, stated_crs
from pcfix.io.rasters import preview
from pcfix.io.tiles import Tiles, open_cloud
from pcfix.model import NOISE_CLASSES
from pcfix.report.adjustment import adjustment_tables
from pcfix.report.comparison import evaluation
from pcfix.report.page import Picture, Report, Table, render
from pcfix.report.run import RunResults, in_short, run_report
from pcfix.report.summary import Summary
from pcfix.report.text import uncertainty_sentence

Plain = dict[str, Any]
COLUMNS = ("WaterDepth", "ShiftZ", "RayCount", "SigmaZ")
SAMPLE_POINTS = 200_000
"""Points in histogram and uncertainty figure, evenly spread over the file."""
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
    """Write the page of a run, and return what it says in short."""
    pictures, tables, dod, verdict = list[Picture](), list[Table](), None, ""
    if first["why"]:
        how = "not adjusted:" if first["model"] is None else "adjusted first, as"
        verdict = f" The cameras were {how} {first['why']}."
    request, summary = run.request, Summary(**corrected)
    if compared:
        dod = preview(run.dod, MOST_CELLS) if request.has_surface else None
        pictures, tables = evaluation(compared["figures"], compared["sections"], dod)
    if first["model"] is not None:
        figures = read_json(run.folder / FOLDER / SUMMARY)
        tables += adjustment_tables(figures, f"{FOLDER}/report.html")
    if (summary.water_fit or {}).get("model") == "auto":  # the water was sought in the cloud
        pictures.append(found_picture(run.inputs.surface(view_of(request.source))))
    results = RunResults(
        summary, run.cameras, **read_cloud(run.cleaned_cloud, run.resolution_m),
        project=request.project or "", date=request.date or "",
        pictures=pictures, tables=tables, verdict=verdict, compared=compared.get("figures", {}),
        difference=dod,
    )  # fmt: skip
    page = write_report(results, inputs, run.folder)
    return {
        "in_short": in_short(page.tiles),
        "uncertainty": uncertainty_sentence(summary, compared.get("figures", {}).get("tvu")),
    }


def write_report(run: RunResults, inputs: Sequence[Path], out_dir: Path) -> Report:
    """Write ``report.html`` and ``figures/*.png`` of a run, into an existing folder.

    The page lists size and checksum of the files `inputs`.
    """
    rows = [[path.name, f"{path.stat().st_size:,}", sha256(path)] for path in inputs]
    table = Table("Input files", ["file", "bytes", "SHA-256"], rows)
    files = []
    for name, words in RESULTS.items():
        tiles = out_dir / name.removesuffix(".laz")
        if (out_dir / name).is_file():
            files.append((name, words))
        elif tiles.is_dir():  # of many files
            files.append((f"{tiles.name}/", words))
    sections = sorted(out_dir.glob("compare/section_*.csv"))
    files += [(f"compare/{one.name}", "a cross-section") for one in sections]
    report = run_report(run, table, files)
    figures = out_dir / "figures"
    figures.mkdir(exist_ok=True)
    for picture in report.pictures:
        write_bytes(figures / f"{picture.name}.png", picture.png, overwrite=True)
    write_text(out_dir / PAGE, render(report), overwrite=True)
    return report


def read_cloud(path: Path | Tiles, resolution_m: float | None = None) -> Plain:
    """Return maps, depths, a sample, CRS and vertical datum of a cloud, without noise.

    The cloud is from `correct_file` with all dimensions, cleaned or not. The names are those of
    `RunResults`; `resolution_m` is that of the rasters.
    """
    with open_cloud(path) as source:
        builder = MapsBuilder(
            source.header.mins[:2], source.header.maxs[:2], len(source), resolution_m
        )
        every = max(1, len(source) // SAMPLE_POINTS)
        sample, low, high, total, count = [], np.inf, -np.inf, 0.0, 0
        for points in source.chunks():
            good = ~np.isin(np.asarray(points["classification"]), NOISE_CLASSES)
            points = points[good & ~np.asarray(points["withheld"]).astype(bool)]
            moved = np.asarray(points["RayCount"]) > 0
            values = np.column_stack([np.asarray(points[name])[moved] for name in COLUMNS])
            builder.add(coordinates(points), moved, values)
            sample.append(values[-count % every :: every, [0, 3]])
            depth = values[:, 0]
            low, high = depth.min(initial=low), depth.max(initial=high)
            total, count = total + float(depth.sum()), count + len(depth)
        crs, heights = crs_words(stated_crs(source))
    depth_m = {"min": float(low), "mean": total / max(count, 1), "max": float(high)}
    return {
        "maps": builder.maps(), "depth_m": depth_m, "sample": np.vstack(sample), "crs": crs,
        "heights": heights,
    }  # fmt: skip
