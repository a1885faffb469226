"""A whole run from Python, and its results as rasters, lines and tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.errors import SettingError, bad_file
from pcfix.flow.maps import BED, DEPTH, SHADED, UNCERTAINTY, contours_layer
from pcfix.flow.report import PAGE
from pcfix.flow.request import SURFACE, Request, read_record
from pcfix.flow.run import RECORD, run_all
from pcfix.flow.runner import Bar, no_bar
from pcfix.io import rasters, vectors
from pcfix.io.styles import limits_of
from pcfix.libraries import analysis_library
from pcfix.options.declare import File, options_of, taken
from pcfix.options.survey import RunOptions
from pcfix.report.comparison import signed_statistics
from pcfix.report.page import Tile, overview, run_html
from pcfix.report.summary import Summary

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from pandas import DataFrame
    from xarray import DataArray

Plain = dict[str, Any]

_WHY = {
    UNCERTAINTY: "the points have no standard errors",
    "map.gpkg": "lines need pyogrio; run: pip install 'pcfix[analysis]', then run again",
}


@dataclass(frozen=True)
class RunResults:
    """The results of a run in its folder; a notebook shows its tiles and a map.

    Rasters and lines are in the CRS of the cloud, metres. They need the extra ``analysis``, and are
    read from the files each time they are asked for.

    Attributes
    ----------
    folder : Path
    """

    folder: Path

    @cached_property
    def _steps(self) -> dict[str, Plain]:
        """The result of each step, from ``run.json``."""
        steps = read_record(self._file(RECORD))["steps"]
        if "report" not in steps:
            sentence = "the run did not finish. Run it again; it resumes."
            raise bad_file(self.folder, "run.unfinished", sentence)
        return {name: step["result"] for name, step in steps.items()}

    @property
    def report(self) -> Path:
        """The page for clients."""
        return self.folder / PAGE

    @property
    def summary(self) -> Summary:
        """The figures of the correction."""
        return Summary(**self._steps["correct"])

    @property
    def compared(self) -> Plain:
        """All figures of the comparison with the reference; empty where there was none."""
        return dict(self._steps.get("compare", {}).get("figures", {}))

    @property
    def depth(self) -> DataArray:
        """Depth of the bed, shape (y, x), metres below the water, positive down; NaN on land."""
        return rasters.open_array(self._file(DEPTH))

    @property
    def bed(self) -> DataArray:
        """Heights of the bed, shape (y, x), metres; NaN on land."""
        return rasters.open_array(self._file(BED))

    @property
    def surface(self) -> DataArray:
        """Heights of land and bed, shape (y, x), metres."""
        return rasters.open_array(self._file(SURFACE))

    @property
    def uncertainty(self) -> DataArray:
        """Vertical uncertainty of the bed at 95 %, shape (y, x), metres, predicted."""
        return rasters.open_array(self._file(UNCERTAINTY))

    def contours(self, interval: float | None = None) -> GeoDataFrame:
        """Return lines of equal depth, ``depth_m``.

        Parameters
        ----------
        interval : float, optional
            Metres. Default that of ``map.gpkg``, no finer than the depth is known.
        """
        if interval is None:
            return self.layer("depth_contours")
        if not interval > 0.0:
            raise SettingError(
                "option.range", f"interval {interval:g} must be above 0.",
                option="interval", value=interval, above=0,
            )  # fmt: skip
        return vectors.frame_of(contours_layer(self.folder, interval), self.depth.rio.crs)

    @property
    def waterline(self) -> GeoDataFrame:
        """Where the water meets the corrected cloud, with its standard error in plan, metres."""
        return self.layer("waterline")

    def layer(self, name: str) -> GeoDataFrame:
        """Return a layer of ``map.gpkg``: waterline, corrected_area, cross_sections, cameras ..."""
        return vectors.read_frame(self._file("map.gpkg"), name)

    @property
    def tables(self) -> dict[str, DataFrame]:
        """Tables of the comparison by name, metres; empty where there was no reference.

        ``statistics`` of the errors before and after; ``depth_bins`` and ``shore_bins``, errors by
        depth and by distance from the shore; ``section_01`` and so on, heights along a line.
        """
        if not self.compared:
            return {}
        files = sorted((self.folder / "compare").glob("*.csv"))
        rows = [{"of": name, **figures} for name, _, figures in signed_statistics(self.compared)]
        pandas = analysis_library("pandas")
        statistics = pandas.json_normalize(rows).set_index("of")
        return {"statistics": statistics, **{one.stem: pandas.read_csv(one) for one in files}}

    def _repr_html_(self) -> str:
        """Return the HTML that a notebook shows."""
        first = self._steps["report"]
        colours, bounds = rasters.picture(self._file(SHADED))
        deepest = limits_of(rasters.preview(self._file(DEPTH))[0], "depth")[1]
        tiles = [Tile(**one) for one in first["tiles"]]
        return run_html(first["title"], tiles, first["place"], overview(colours, bounds, deepest))

    def _file(self, name: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            why = f": {_WHY[name]}" if name in _WHY else ""
            raise bad_file(path, "run.no_file", f"the run has not written it{why}.")
        return path


def run(
    input: File | Iterable[File],
    out_dir: File,
    *,
    options: RunOptions | None = None,
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
    **keywords: Any,
) -> RunResults:
    """Adjust, correct, clean, grid, compare and report; what ``pcfix run`` runs.

    Parameters
    ----------
    input : path, or list of paths
        LAS or LAZ cloud, of one file or many; see `pcfix.correct_file`.
    out_dir : path
        Folder for all results, made where its parent exists. Called again with the same options it
        resumes, and a finished run is opened at once.
    options : RunOptions, optional
        Or its attributes as keywords, as of ``pcfix run``: cameras, water, reference, resolution,
        overwrite and so on. Cameras and water are files or text, as ``run.json`` keeps them.
    say : callable, optional
        Called with a line on each step, as ``print``.
    bar : callable, optional
        Shows the progress of a step; see `pcfix.flow.runner.Bar`.

    Returns
    -------
    RunResults

    Raises
    ------
    PcfixError
        With one sentence on what to do; the steps before it stay done.

    Examples
    --------
    >>> import pcfix
    >>> result = pcfix.run("cloud.laz", "out", cameras="cameras.csv", water=0.37)  # doctest: +SKIP
    >>> float(result.depth.max())  # doctest: +SKIP
    12.25
    """
    given, values = taken(RunOptions, options, keywords, "run"), {}
    for one in options_of(RunOptions):
        value = getattr(given, one.name)
        if one.type is Any and value is not None:
            if not isinstance(value, str | os.PathLike | Real):
                raise SettingError(
                    "option.type",
                    f"run: {one.name} is a {type(value).__name__}. Give a file or text, which"
                    " run.json can keep, or use correct_file.",
                    option=one.name,
                )
            value = str(value)
        values[one.name] = value
    cloud = str(input) if isinstance(input, str | os.PathLike) else tuple(map(str, input))
    run_all(Request(input=cloud, **values), Path(out_dir), say=say, bar=bar)
    return RunResults(Path(out_dir))


def open_run(folder: File) -> RunResults:
    """Open the results of a finished run.

    Parameters
    ----------
    folder : path
        The OUT_DIR of ``pcfix run``.

    Returns
    -------
    RunResults

    Raises
    ------
    InputError
        If the folder holds no run, or an unfinished one.
    """
    found = RunResults(Path(folder))
    _ = found.summary
    return found
