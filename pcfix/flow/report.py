"""The report on a corrected cloud: read it once, and write its page and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcfix.errors import InputError
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.io.files import sha256, write_bytes, write_text
from pcfix.io.las.columns import SHIFTS
from pcfix.io.las.source import LasSource, coordinates
from pcfix.model import Cameras, FloatArray, WaterSurface
from pcfix.refract.tally import Summary
from pcfix.report.page import Table, render
from pcfix.report.run import NOTHING_LATER, Corrected, Later, run_report

NEEDED = (*SHIFTS, "WaterDepth", "RayCount")
SIGMA_Z = "SigmaZ"
SAMPLE_POINTS = 200_000
"""Points whose numbers go into histogram and picture, evenly spread over the file."""


def write_report(
    corrected: Path,
    out_dir: Path,
    *,
    summary: Summary,
    cameras: Cameras,
    water: WaterSurface,
    inputs: Sequence[Path],
    later: Later = NOTHING_LATER,
    overwrite: bool = False,
) -> Path:
    """Write ``report.html`` and ``figures/*.png`` about a corrected cloud.

    Parameters
    ----------
    corrected : Path
        A cloud that `correct_file` wrote with all dimensions.
    out_dir : Path
        A folder that exists.
    summary : Summary
        What `correct_file` returned.
    cameras, water
        What it was given.
    inputs : sequence of Path
        Files whose size and checksum the page lists.
    later : Later
        What other steps of a run add.
    overwrite : bool
        Replace a report that is there.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    InputError
        If the cloud lacks the dimensions.
    """
    maps, sample = _read(corrected)
    rows = [[path.name, f"{path.stat().st_size:,}", sha256(path)] for path in inputs]
    files = Table("Input files", ["file", "bytes", "SHA-256"], rows)
    report = run_report(Corrected(summary, cameras, water, maps, sample), files, later)
    figures = out_dir / "figures"
    figures.mkdir(exist_ok=True)
    for picture in report.pictures:
        write_bytes(figures / f"{picture.name}.png", picture.png(), overwrite=overwrite)
    page = out_dir / "report.html"
    write_text(page, render(report), overwrite=overwrite)
    return page


def _read(path: Path) -> tuple[Maps, FloatArray]:
    """Return the maps of a corrected cloud, and a sample of its points.

    The sample has the shape (m, 5): shift, depth and standard error of Z, zero where none is.
    """
    with LasSource(path) as source:
        missing = set(NEEDED).difference(source.header.point_format.dimension_names)
        if missing:
            raise InputError(
                f"{path}: has no dimensions {', '.join(sorted(missing))}; correct it with"
                " --dimensions all."
            )
        builder = MapsBuilder(source.header.mins[:2], source.header.maxs[:2], len(source))
        every = max(1, len(source) // SAMPLE_POINTS)
        sample = []
        for points in source.chunks():
            shift = np.column_stack([np.asarray(points[name]) for name in SHIFTS])
            rays = np.asarray(points["RayCount"]).astype(np.int64)
            moved = rays > 0
            depth = np.asarray(points["WaterDepth"])
            builder.add(coordinates(points), depth, shift, rays, moved)
            has = SIGMA_Z in points.array.dtype.names
            sigma = np.asarray(points[SIGMA_Z]) if has else np.zeros(len(depth))
            sample.append(np.column_stack([shift, depth, sigma])[moved][::every])
    return builder.maps(), np.vstack(sample)
