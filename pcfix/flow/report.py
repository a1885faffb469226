"""The report on a corrected cloud: read it once, and write its page and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.io.crs import crs_words
from pcfix.io.files import sha256, write_bytes, write_text
from pcfix.io.las.columns import SHIFTS
from pcfix.io.las.source import coordinates, stated_crs
from pcfix.io.tiles import Tiles, open_cloud
from pcfix.model import NOISE_CLASSES, Cameras, FloatArray, WaterSurface
from pcfix.refract.tally import Summary
from pcfix.report.first_screen import Survey
from pcfix.report.page import Report, Table, render
from pcfix.report.run import NOTHING_LATER, Corrected, Later, run_report

NEEDED = (*SHIFTS, "WaterDepth", "RayCount")
SIGMA_Z = "SigmaZ"
SAMPLE_POINTS = 200_000
"""Points whose numbers go into histogram and picture, evenly spread over the file."""
NO_SURVEY = Survey()
PAGE = "report.html"
ENDINGS = (".laz", ".las", ".tif", ".gpkg", ".csv", ".html", ".json")
RESULTS = {
    "corrected.laz": "all points, the bed where it is",
    "cleaned.laz": "the same, outliers flagged as noise",
    "depth.tif": "depth below the water",
    "bed.tif": "heights of the bed",
    "surface.tif": "heights of land and bed",
    "uncertainty.tif": "vertical uncertainty at 95 %",
    "surface_counts.tif": "points of each cell, and their spread",
    "shaded.tif": "coloured, shaded relief",
    "map.gpkg": "contours, waterline and other lines and places, for a GIS",
    "run.json": "what was asked for, and what came out",
    "compare/compare.json": "all figures of the comparison",
    "compare/depth_bins.csv": "errors by depth",
    "compare/shore_bins.csv": "errors by distance from the shore",
    "compare/dod.tif": "cloud minus reference",
    "compare/reference_dsm.tif": "heights of the reference",
    "adjusted/report.html": "the adjustment of the cameras",
}
"""By name; those that are not there are not listed."""


def write_report(
    corrected: Path | Tiles,
    out_dir: Path,
    *,
    summary: Summary,
    cameras: Cameras,
    water: WaterSurface,
    inputs: Sequence[Path],
    survey: Survey = NO_SURVEY,
    later: Later = NOTHING_LATER,
    overwrite: bool = False,
) -> Report:
    """Write ``report.html`` and ``figures/*.png`` about a corrected cloud.

    Parameters
    ----------
    corrected : Path or Tiles
        A cloud that `correct_file` wrote with all dimensions, cleaned or not.
    out_dir : Path
        A folder that exists.
    summary : Summary
        What `correct_file` returned.
    cameras, water
        What it was given.
    inputs : sequence of Path
        Files whose size and checksum the page lists.
    survey : Survey
        Name of the project and date of the images, where they are known.
    later : Later
        What other steps of a run add.
    overwrite : bool
        Replace a report that is there.

    Returns
    -------
    Report
        What the page says.

    Raises
    ------
    InputError
        If the cloud lacks the dimensions.
    """
    told = _read(corrected, later.resolution_m)
    rows = [[path.name, f"{path.stat().st_size:,}", sha256(path)] for path in inputs]
    found = Corrected(
        summary, replace(survey, crs=told.crs, heights=told.heights), cameras, water, told.maps,
        told.depth_m, told.sample,
    )  # fmt: skip
    report = run_report(
        found, Table("Input files", ["file", "bytes", "SHA-256"], rows), _beside(out_dir), later
    )
    figures = out_dir / "figures"
    figures.mkdir(exist_ok=True)
    for picture in report.pictures:
        write_bytes(figures / f"{picture.name}.png", picture.png, overwrite=overwrite)
    write_text(out_dir / PAGE, render(report), overwrite=overwrite)
    return report


def _beside(folder: Path) -> list[tuple[str, str]]:
    """Return the results that lie beside the page, and what they are."""
    found = [path for pattern in ("*", "*/*") for path in sorted(folder.glob(pattern))]
    names = [path.relative_to(folder).as_posix() for path in found if path.is_file()]
    tiled = {f"{name[:-4]}/": words for name, words in RESULTS.items() if name.endswith(".laz")}
    names = [name for name in names if not name.startswith(tuple(tiled))]
    return [(name, words) for name, words in tiled.items() if (folder / name).is_dir()] + [
        (name, RESULTS.get(name, "a cross-section" if "/section_" in name else ""))
        for name in names
        if name.endswith(ENDINGS) and not name.startswith((".", "figures/", PAGE))
    ]


class _Told(NamedTuple):
    """What a corrected cloud says."""

    maps: Maps
    sample: FloatArray
    depth_m: dict[str, float]
    crs: str
    heights: str


def _read(path: Path | Tiles, resolution_m: float | None) -> _Told:
    """Read a corrected cloud, without noise and what is withheld."""
    with open_cloud(path) as source:
        missing = set(NEEDED).difference(source.header.point_format.dimension_names)
        if missing:
            raise InputError(
                f"{path}: has no dimensions {', '.join(sorted(missing))}; correct it with"
                " --dimensions all."
            )
        builder = MapsBuilder(
            source.header.mins[:2], source.header.maxs[:2], len(source), resolution_m
        )
        every = max(1, len(source) // SAMPLE_POINTS)
        sample, low, high, total, count = [], np.inf, -np.inf, 0.0, 0
        has_sigma = SIGMA_Z in source.header.point_format.dimension_names
        for points in source.chunks():
            kept = ~np.isin(np.asarray(points["classification"]), NOISE_CLASSES)
            points = points[kept & ~np.asarray(points["withheld"]).astype(bool)]
            moved = np.asarray(points["RayCount"]) > 0
            columns = ["WaterDepth", "ShiftZ", "RayCount", *([SIGMA_Z] if has_sigma else [])]
            told = np.zeros((int(moved.sum()), 4))
            for i, name in enumerate(columns):
                told[:, i] = np.asarray(points[name])[moved]
            builder.add(coordinates(points), moved, told)
            sample.append(told[-count % every :: every, [1, 0, 3]])
            depth = told[:, 0]
            low, high = depth.min(initial=low), depth.max(initial=high)
            total, count = total + float(depth.sum()), count + len(depth)
        crs, heights = crs_words(stated_crs(source))
    depth_m = {"min": float(low), "mean": total / max(count, 1), "max": float(high)}
    return _Told(builder.maps(), np.vstack(sample), depth_m, crs, heights)
