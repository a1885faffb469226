"""The report on a corrected cloud: read it once, draw, and write the page."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError
from pcfix.flow.points import CHUNK_POINTS
from pcfix.io.files import sha256, write_bytes, write_text
from pcfix.io.las.columns import SHIFTS
from pcfix.io.las.source import LasSource, coordinates
from pcfix.model import WaterPlane
from pcfix.report.figures import cameras_figure, histogram_figure, map_figure, tvu_figure
from pcfix.report.maps import MapsBuilder
from pcfix.report.page import Layer, Picture, Report, Table, render
from pcfix.report.text import errors_of, share
from pcfix.report.tvu import ORDERS, tvu_sentence
from pcfix.version import __version__

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pcfix.model import Cameras, FloatArray, Summary, WaterSurface
    from pcfix.report.maps import Maps

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
    more: tuple[Sequence[Picture], Sequence[Table]] = ((), ()),
    verdict: str = "",
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
    more : pair of sequences
        Pictures and tables of later steps.
    verdict : str
        A sentence that they come to.
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
    maps, sample_m = _read(corrected)
    pictures = [
        *_pictures(maps, sample_m, summary, cameras, water),
        *_uncertainty_picture(sample_m, summary),
        *more[0],
    ]
    report = Report(
        title=f"Refraction correction of {Path(summary.input).name}",
        lead=_lead(summary) + verdict,
        facts=_facts(summary),
        warnings=_warnings(summary),
        maps=maps,
        layers=[
            Layer("Depth", "m", maps.depth_m),
            Layer("Height", "m", maps.height_m),
            Layer("Shift in Z", "m", maps.shift_z_m),
            Layer("Shift in plan", "m", maps.shift_xy_m),
            Layer("Rays", "", maps.rays),
        ],
        pictures=pictures,
        tables=[*_orders(summary), *more[1]],
        provenance=[_settings(summary), _files(inputs), _versions()],
    )
    figures = out_dir / "figures"
    figures.mkdir(exist_ok=True)
    for picture in pictures:
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
        for points in source.chunks(CHUNK_POINTS):
            shift = np.column_stack([np.asarray(points[name]) for name in SHIFTS])
            rays = np.asarray(points["RayCount"]).astype(np.int64)
            moved = rays > 0
            depth = np.asarray(points["WaterDepth"])
            builder.add(coordinates(points), depth, shift, rays, moved)
            has = SIGMA_Z in points.array.dtype.names
            sigma = np.asarray(points[SIGMA_Z]) if has else np.zeros(len(depth))
            sample.append(np.column_stack([shift, depth, sigma])[moved][::every])
    return builder.maps(), np.vstack(sample)


def _lead(s: Summary) -> str:
    mean = s.shift_z_m["mean"]
    way = "higher" if mean > 0.0 else "deeper"
    land = ""
    if s.carried is not None:
        land = (
            f" First the whole cloud, land too, was taken from the cameras that made it to the"
            f" adjusted ones, which moved it by {s.carried['shift_m']['rms']:.2f} m (rms)."
        )
    return (
        f"{s.corrected:,} of {s.points:,} points lay under water and were moved to where the bed"
        f" is: {abs(mean):.2f} m {way} on average, down to a depth of"
        f" {s.depth_m['max']:.2f} m.{land}"
    )


def _facts(s: Summary) -> Table:
    shift, depth = s.shift_z_m, s.depth_m
    rows = [
        ["Cloud", Path(s.input).name],
        ["Water", f"{s.water}; refractive index {s.settings['refractive_index']:g}"],
        ["Points", f"{s.points:,}"],
        ["Under water", f"{s.submerged:,} ({share(s.submerged, s.points)} of the points)"],
        ["Corrected", f"{s.corrected:,} ({share(s.corrected, s.submerged)} of these)"],
        ["Depth", f"{depth['min']:.2f} to {depth['max']:.2f} m, mean {depth['mean']:.2f} m"],
        ["Shift in Z", f"mean {shift['mean']:.3f} m; 90 % of the points lie between"
         f" {shift['p5']:.3f} and {shift['p95']:.3f} m"],
        ["Cameras", f"{s.cameras_used} of {s.cameras} see corrected points;"
         f" {s.rays / max(s.corrected, 1):.1f} rays a point"],
    ]  # fmt: skip
    if s.uncertainty is not None:
        tvu = s.uncertainty["tvu_95_m"]
        rows.append(["Uncertainty", f"TVU at 95 % {tvu['mean']:.3f} m on average, formal;"
                     f" {tvu_sentence(s.uncertainty)}"])  # fmt: skip
    return Table("In short", [], rows)


def _uncertainty_picture(sample: FloatArray, s: Summary) -> list[Picture]:
    """Return TVU over depth, where the cloud has standard errors."""
    known = sample[:, 4] > 0.0
    if s.uncertainty is None or not known.any():
        return []
    words = (
        "Total vertical uncertainty at 95 % (1.96 standard errors of Z) over depth, and the"
        f" largest that the orders of IHO S-44 allow. It is formal: it assumes {errors_of(s)}"
        " (standard deviations), and no mismatches. S-44 asks for more than the TVU: position,"
        " features and coverage."
    )
    figure = tvu_figure(sample[known, 3], sample[known, 4])
    return [Picture("uncertainty", "Vertical uncertainty", words, figure)]


def _orders(s: Summary) -> list[Table]:
    """Return the share of the points within each order of IHO S-44."""
    if s.uncertainty is None:
        return []
    shares = s.uncertainty["s44"]
    rows = [
        [order.name, f"{order.a_m:g} m", f"{order.b:g}", f"{100.0 * shares[order.name]:.4g} %"]
        for order in ORDERS
    ]
    header = ["order", "a", "b", "points with TVU at 95 % within sqrt(a^2 + (b depth)^2)"]
    return [Table("Orders of IHO S-44, vertical, formal", header, rows)]


def _warnings(s: Summary) -> list[str]:
    warnings = list(s.warnings)
    fate = {"withhold": "flagged as withheld", "keep": "left as they were", "drop": "left out"}
    for reason, count in s.uncorrected.items():
        if count:
            warnings.append(
                f"{count:,} points under water could not be corrected ({reason}); they were not"
                f" moved and are {fate[s.settings['uncorrected']]}."
            )
    if s.water_unknown:
        warnings.append(f"{s.water_unknown:,} points have no known water surface above them.")
    return warnings


def _pictures(
    maps: Maps, sample_m: FloatArray, s: Summary, cameras: Cameras, water: WaterSurface
) -> list[Picture]:
    used = ~np.isin(np.array(cameras.labels), s.cameras_unused)
    flat = isinstance(water, WaterPlane) and water.b == water.c == 0.0
    level = water.a if isinstance(water, WaterPlane) and flat else None
    depth, shift = s.depth_m, s.shift_z_m
    return [
        Picture(
            "depth", "Depth",
            f"Map of the corrected depth over the shaded relief; {depth['min']:.2f} to"
            f" {depth['max']:.2f} m, mean {depth['mean']:.2f} m.",
            map_figure(maps, maps.depth_m, "Depth (m)", "viridis_r"),
        ),
        Picture(
            "shift", "Shift in Z",
            f"Map of how far the bed moved down; mean {shift['mean']:.2f} m, growing with depth"
            " and towards flat rays.",
            map_figure(maps, maps.shift_z_m, "True minus apparent Z (m)", "magma"),
        ),
        Picture(
            "shift_histogram", "How far the points moved",
            "Histogram of the shift in Z of the corrected points.",
            histogram_figure(
                {"shift in Z": sample_m[:, 2]}, "True minus apparent Z (m)", gaussian=False
            ),
        ),
        Picture(
            "cameras", "Cameras",
            f"Projection centres over the cloud, in plan and seen from the south;"
            f" {s.cameras_used} of {s.cameras} see corrected points.",
            cameras_figure(maps, cameras.centres, used, level),
        ),
    ]  # fmt: skip


def _settings(s: Summary) -> Table:
    rows = [[name.replace("_", " "), str(value)] for name, value in s.settings.items()]
    return Table("Settings", ["setting", "value"], rows)


def _files(paths: Iterable[Path]) -> Table:
    rows = [[path.name, f"{path.stat().st_size:,}", sha256(path)] for path in paths]
    return Table("Input files", ["file", "bytes", "SHA-256"], rows)


def _versions() -> Table:
    rows: list[list[Any]] = [["pcfix", __version__], ["Python", platform.python_version()]]
    rows += [[name, version(name)] for name in ("numpy", "scipy", "numba", "laspy", "lazrs")]
    return Table("Software", ["name", "version"], rows)
