"""A LAS or LAZ cloud to a raster of heights, with bounded memory.

The points go once through, into files for squares of the plan; then the raster is made window by
window. Whatever decides on a cell is read with its window, so the raster does not depend on where
chunks, squares and windows end.
"""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from pcfix.flow.sorted_points import BLOCK_CELLS, SortedPoints, inside
from pcfix.grid.heights import (
    cell_numbers,
    cell_uncertainty,
    fill_holes,
    inverse_distance,
    margin_cells,
    triangulated,
)
from pcfix.grid.model import NO_LIGHT, DsmSettings, DsmSummary, Method, SurfaceChoice, hillshade
from pcfix.io.files import check_input, check_output, replaced_when_whole, write_text
from pcfix.io.las.source import LasSource, metric_crs
from pcfix.io.rasters import (
    add_overviews,
    check_cog,
    check_tif,
    copy_as_cog,
    new_raster,
    open_raster,
    read_heights,
    write_part,
)
from pcfix.version import __version__

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    import numpy.typing as npt
    from rasterio.io import DatasetReader, DatasetWriter

    from pcfix.grid.lattice import Window
    from pcfix.model import FloatArray, IntArray

    AnyPath = str | os.PathLike[str]
    Progress = Callable[[int, int], None]

BLOCK_POINTS = 2_000_000
TIN_BLOCK_POINTS = 400_000
"""Windows are halved until they have no more points than this."""
TIN_REACH_SPACINGS = 5.0
TIN_REACH_CELLS = 3.0
"""Circles around triangles may be as wide as the larger of the two, or as --fill."""

BANDS = {"height": "metre", "count": "", "spread": "metre"}
HEIGHT, COUNT, SPREAD, UNCERTAINTY = 1, 2, 3, 4
WITH_SIGMA = {**BANDS, "uncertainty": "metre"}
"""Of clouds that have standard errors of Z."""


def grid_dsm(
    input: AnyPath,
    output: AnyPath,
    *,
    resolution_m: float,
    method: Method = "mean",
    surface: SurfaceChoice = "all",
    fill_m: float | None = None,
    hillshade: AnyPath | None = None,
    azimuth_deg: float = 315.0,
    altitude_deg: float = 45.0,
    cog: bool = False,
    summary: AnyPath | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> DsmSummary:
    """Grid a cloud to a GeoTIFF of heights; what ``pcfix dsm`` runs.

    The file has three bands of float32: height (m), count (points in the cell) and spread
    (population standard deviation of their heights, m). A cell without a height holds -9999, the
    nodata value, and count 0. A cell with a height and count 0 has no points of its own: its
    height was interpolated, and its spread is nodata.

    A cloud with the dimension ``SigmaZ``, as `pcfix.correct_file` writes it, gives a fourth band,
    uncertainty: the standard uncertainty of the height (m), the root mean square of the ``SigmaZ``
    of the cell's corrected points; see `pcfix.grid.heights.cell_uncertainty`. Nodata without any.

    Parameters
    ----------
    input : path
        LAS or LAZ, in metres.
    output : path
        The name ends in ``.tif`` or ``.tiff``.
    resolution_m : float
        Side of a cell. The bounds of the raster are multiples of it; a point on an edge belongs
        to the cell east or north of it.
    method : {"mean", "median", "min", "max", "idw", "tin"}
        The first four are of the points in the cell. "idw" weights points around the centre of
        cells that have some with 1 / distance squared; "tin" takes the height at the centre from
        Delaunay's triangles.
    surface : {"all", "bed"}
        All points but noise (classes 7 and 18), or only the bed (class 40). Withheld points are
        never used.
    fill_m : float, optional
        Fill holes up to this wide. With "tin" it is the width of the widest circle without a
        point that is bridged, by default five times the spacing of the points and at least three
        cells.
    hillshade : path, optional
        Write a GeoTIFF of uint8 there: 1 dark to 255 bright, nodata 0.
    azimuth_deg, altitude_deg : float
        Where the sun of the hillshade stands: clockwise from north, and above the horizon.
    cog : bool
        Write cloud optimised GeoTIFF, the hillshade too.
    summary : path, optional
        Write the summary there, as JSON.
    overwrite : bool
        Replace outputs that exist.
    progress : callable, optional
        Called with (points done, points in all), reading and gridding counting half each.

    Returns
    -------
    DsmSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; no output is left behind.

    Warns
    -----
    PcfixWarning
        If the cells are so small that most would have no point.
    """
    started = time.perf_counter()
    settings = DsmSettings(resolution_m, method, surface, fill_m, azimuth_deg, altitude_deg)
    source = check_input(input)
    target = check_tif(output, overwrite=overwrite, inputs=[source])
    shade, inputs = None, [source, target]
    if hillshade is not None:
        shade = check_tif(hillshade, overwrite=overwrite, inputs=inputs)
        inputs.append(shade)
    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=inputs)
    if cog:
        check_cog()
    run = _Run(source, settings, progress)
    with ExitStack() as stack:
        draft = stack.enter_context(replaced_when_whole(target))
        shade_draft = stack.enter_context(replaced_when_whole(shade)) if shade else None
        folder = TemporaryDirectory(dir=target.parent, prefix=".pcfix-dsm-")
        run.write(draft, shade_draft, Path(stack.enter_context(folder)), cog=cog)
    result = run.summary(target, shade, time.perf_counter() - started)
    if summary is not None:
        write_text(summary, json.dumps(result.as_dict(), indent=2) + "\n", overwrite=overwrite)
    return result


@dataclass
class _Tally:
    """Cells so far."""

    cells: int = 0
    filled: int = 0
    known: int = 0
    with_sigma: int = 0
    sigma_sum_m: float = 0.0
    sigma_max_m: float = 0.0

    def add(self, uncertainty_m: FloatArray) -> None:
        """Add the uncertainties of some cells, NaN where there are none."""
        sigma = uncertainty_m[~np.isnan(uncertainty_m)]
        self.with_sigma += sigma.size
        self.sigma_sum_m += float(sigma.sum())
        self.sigma_max_m = max(self.sigma_max_m, float(sigma.max(initial=0.0)))

    def uncertainty_m(self) -> dict[str, float] | None:
        """Return mean and largest; None where no cell has one."""
        if not self.with_sigma:
            return None
        mean = self.sigma_sum_m / self.with_sigma
        return {"mean": round(mean, 4), "max": round(self.sigma_max_m, 4)}


@dataclass
class _Run:
    """One cloud on its way into a raster."""

    source: Path
    settings: DsmSettings
    progress: Progress | None
    tally: _Tally = field(default_factory=_Tally)

    def write(self, draft: Path, shade: Path | None, folder: Path, *, cog: bool) -> None:
        """Write the raster, and its hillshade if a path is given."""
        with LasSource(self.source) as source:
            self.crs, self.points = metric_crs(source), len(source)
            self.sorted = SortedPoints(source, self.settings, folder, self.report_reading)
        self.near, self.lattice = self.sorted.near, self.sorted.lattice
        plain = folder / "dsm.tif" if cog else draft
        tags = {"PCFIX": json.dumps({"pcfix": __version__, **asdict(self.settings)})}
        bands = WITH_SIGMA if self.sorted.has_sigma else BANDS
        with new_raster(plain, self.lattice, self.crs, bands, tags=tags) as dsm:
            if self.settings.fill_m is None or self.settings.method == "tin":
                self.grid(dsm, dsm)
            else:
                self.grid_and_fill(dsm, folder / "unfilled.tif")
        if shade is not None:
            self.shade(plain, shade, folder, cog=cog)
        _finish(plain, draft, cog=cog)

    def grid(self, heights: DatasetWriter, dsm: DatasetWriter) -> None:
        """Write heights to one raster, the other bands to another (or the same)."""
        done, lattice = 0, self.lattice
        limit = TIN_BLOCK_POINTS if self.settings.method == "tin" else BLOCK_POINTS
        for window in self.sorted.windows(limit):
            height, count, spread, uncertainty = self.block(window)
            write_part(heights, height, window, HEIGHT)
            write_part(dsm, count, window, COUNT)
            write_part(dsm, spread, window, SPREAD)
            if uncertainty is not None:
                write_part(dsm, uncertainty, window, UNCERTAINTY)
                self.tally.add(uncertainty)
            known = ~np.isnan(height)
            self.tally.cells += int((count > 0).sum())
            self.tally.filled += int((known & (count == 0)).sum())
            self.tally.known += int(known.sum())
            done += window.height * window.width
            self.report(0.5 + 0.5 * done / (lattice.height * lattice.width))

    def block(self, window: Window) -> tuple[FloatArray, IntArray, FloatArray, FloatArray | None]:
        """Return height, count, spread and, where it is known, uncertainty of a window."""
        method, size = self.settings.method, self.settings.resolution_m
        margin = {"idw": 1, "tin": int(np.ceil(self.reach_m / size)) + 1}.get(method, 0)
        xyz, cell = self.sorted.points_in(window.grown(margin))
        inner = inside(cell, window)
        code = (cell[inner, 1] - window.row) * window.width + cell[inner, 0] - window.column
        numbers = cell_numbers(code, xyz[inner, 2], window.height * window.width)
        shape = window.height, window.width
        if method == "idw":
            height = inverse_distance(self.lattice.positions(xyz), cell, xyz[:, 2], window)
        elif method == "tin":
            position, z, spacing = self.lattice.positions(xyz), xyz[:, 2], self.near.spacing_m
            height = triangulated(position, z, window, self.reach_m / size, spacing / size)
        else:
            height = getattr(numbers, method).reshape(shape)
        uncertainty = None
        if self.sorted.has_sigma:
            uncertainty = cell_uncertainty(code, xyz[inner, 3], numbers.points.size).reshape(shape)
        return height, numbers.points.reshape(shape), numbers.spread.reshape(shape), uncertainty

    @property
    def reach_m(self) -> float:
        """Width of the widest circle around a triangle of the TIN."""
        spacings = TIN_REACH_SPACINGS * self.near.spacing_m
        cells = TIN_REACH_CELLS * self.settings.resolution_m
        return max(spacings, cells, self.settings.fill_m or 0.0)

    def grid_and_fill(self, dsm: DatasetWriter, unfilled: Path) -> None:
        """Write heights to a raster of their own, and from there, with holes filled, to the DSM."""
        with new_raster(unfilled, self.lattice, None, {"height": "metre"}) as heights:
            self.grid(heights, dsm)
        widest = (self.settings.fill_m or 0.0) / self.settings.resolution_m
        with open_raster(unfilled) as heights:
            for window in self.lattice.windows(BLOCK_CELLS):
                around = window.grown(margin_cells(widest)).clipped(self.lattice.window)
                height = fill_holes(read_heights(heights, around), window, around, widest)
                write_part(dsm, height, window, HEIGHT)
                self.tally.filled += int((~np.isnan(height)).sum())
        self.tally.filled -= self.tally.known
        self.tally.known += self.tally.filled

    def shade(self, dsm: Path, target: Path, folder: Path, *, cog: bool) -> None:
        """Write the hillshade of a DSM."""
        plain = folder / "hillshade.tif" if cog else target
        band = {"hillshade": ""}
        with (
            open_raster(dsm) as heights,
            new_raster(plain, self.lattice, self.crs, band, dtype="uint8", nodata=NO_LIGHT) as out,
        ):
            for window in self.lattice.windows(BLOCK_CELLS):
                write_part(out, self.light(heights, window), window, 1)
        _finish(plain, target, cog=cog)

    def light(self, heights: DatasetReader, window: Window) -> npt.NDArray[np.uint8]:
        """Return the hillshade of a window."""
        wide = window.grown(1)
        around = wide.clipped(self.lattice.window)
        height = np.full((wide.height, wide.width), np.nan)
        height[around.within(wide)] = read_heights(heights, around)
        s = self.settings
        return hillshade(height, s.resolution_m, s.azimuth_deg, s.altitude_deg)

    def report_reading(self, done: int, total: int) -> None:
        """Tell how far reading is, the first half."""
        self.report(0.5 * done / total)

    def report(self, share: float) -> None:
        """Tell how much is done, in points."""
        if self.progress is not None:
            self.progress(round(share * self.points), self.points)

    def summary(self, target: Path, shade: Path | None, seconds: float) -> DsmSummary:
        """Return the numbers of the run."""
        settings, lattice, tally = self.settings, self.lattice, self.tally
        return DsmSummary(
            input=str(self.source),
            output=str(target),
            hillshade=None if shade is None else str(shade),
            pcfix=__version__,
            crs=None if self.crs is None else self.crs.name,
            width=lattice.width,
            height=lattice.height,
            bounds_m=lattice.bounds_m,
            points=self.points,
            points_used=self.near.points,
            cells=tally.cells,
            filled=tally.filled,
            empty=lattice.width * lattice.height - tally.known,
            points_per_cell=self.near.points / tally.cells,
            spacing_m=self.near.spacing_m,
            hole_m=self.reach_m if settings.method == "tin" else settings.fill_m,
            settings=asdict(settings),
            seconds=round(seconds, 3),
            uncertainty_m=tally.uncertainty_m(),
        )


def _finish(plain: Path, target: Path, *, cog: bool) -> None:
    """Add overviews; a cloud optimised file is a copy, which brings its own."""
    if cog:
        copy_as_cog(plain, target)
    else:
        add_overviews(plain)
