"""A cloud against a reference: files in, figures out."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pcfix.compare.figures import Comparison, bins_table, figures_of
from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.compare.match import CompareSettings, match
from pcfix.compare.sections import parse_line
from pcfix.compare.vertical import DEFAULT_NEIGHBOURS
from pcfix.errors import SettingError
from pcfix.io.clouds import check_same_crs, read_cloud, read_reference
from pcfix.io.files import check_input, check_output, write_text

if TYPE_CHECKING:
    from collections.abc import Sequence
    from os import PathLike

    from pcfix.compare.sections import SectionLine
    from pcfix.model import WaterSurface

    AnyPath = str | PathLike[str]


def compare_clouds(
    cloud: AnyPath,
    reference: AnyPath,
    *,
    out_dir: AnyPath | None = None,
    submerged: bool = False,
    water: WaterSurface | float | AnyPath | None = None,
    vertical: bool = True,
    m3c2: bool = False,
    neighbours: int = DEFAULT_NEIGHBOURS,
    bin_width_m: float = 1.0,
    shore_bin_width_m: float = 10.0,
    max_gap_m: float | None = None,
    section_lines: Sequence[SectionLine | str] = (),
    sections: int = 0,
    corridor_m: float = 1.0,
    summary: AnyPath | None = None,
    overwrite: bool = False,
) -> Comparison:
    """Measure how far a cloud is from a reference; what ``pcfix compare`` runs.

    Both lie in one CRS, metres. Points that are withheld or of class 7 or 18 never count, nor do
    points of the reference of classes 9, 41, 42 and 45 (water, its surface and column).

    Parameters
    ----------
    cloud : path
        LAS or LAZ. Where `correct_file` wrote it with all its dimensions, the figures before the
        correction are given too.
    reference : path
        LAS or LAZ; CSV check points (x, y, z); or a GeoTIFF of heights. At check points the
        cloud's surface is measured, not the reference's at each point of the cloud.
    out_dir : path, optional
        Folder for ``compare.json``, ``depth_bins.csv``, ``shore_bins.csv`` and
        ``section_*.csv``; made where its parent exists.
    submerged : bool
        Compare only points of class 40 or, where `water` is given, below it.
    water : WaterSurface, float, str or path, optional
        See `pcfix.read_water`; default what the cloud itself says.
    vertical : bool
        False leaves out everything but C2C and M3C2.
    m3c2 : bool
        Also M3C2, by py4dgeo.
    neighbours, bin_width_m, shore_bin_width_m, max_gap_m, sections, corridor_m
        See `CompareSettings`.
    section_lines : sequence of SectionLine or str
        Cross-sections, as ``x1,y1,x2,y2`` in the cloud's coordinates.
    summary : path, optional
        Write the figures there too, as JSON.
    overwrite : bool
        Replace files that exist.

    Returns
    -------
    Comparison

    Raises
    ------
    PcfixError
        With one sentence on what to mend.
    """
    started = time.perf_counter()
    settings = CompareSettings(
        submerged, vertical, m3c2, neighbours, bin_width_m, shore_bin_width_m, max_gap_m,
        sections, corridor_m,
    )  # fmt: skip
    lines = [parse_line(line) if isinstance(line, str) else line for line in section_lines]
    _check_outputs(out_dir, summary, [cloud, reference], overwrite=overwrite)
    if m3c2:
        load_py4dgeo()
    given = None
    if water is not None:
        from pcfix.flow.surfaces import WaterWords, find_surface, view_of  # not quick to load

        given = find_surface(WaterWords(water), view_of(check_input(cloud))).surface
    target, whole = read_reference(reference), read_cloud(cloud, given)
    check_same_crs(whole.name, whole.crs, target.name, target.crs)
    matched = match(whole, target, settings, given=given is not None)
    result = figures_of(matched, lines, started)
    _write(result, out_dir, summary, overwrite=overwrite)
    return result


def _check_outputs(
    out_dir: AnyPath | None, summary: AnyPath | None, inputs: list[AnyPath], *, overwrite: bool
) -> None:
    """Refuse what cannot be written, before anything is computed."""
    if out_dir is not None:
        folder = Path(out_dir)
        if folder.exists() and not folder.is_dir():
            raise SettingError(f"{folder}: is a file; give a folder.")
        if not folder.parent.is_dir():
            raise SettingError(f"{folder}: the folder {folder.parent} does not exist; make it.")
        names = ["compare.json", "depth_bins.csv", "shore_bins.csv"]
        if folder.is_dir():
            for path in [*(folder / name for name in names), *folder.glob("section_*.csv")]:
                check_output(path, overwrite=overwrite, inputs=inputs)
    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=inputs)


def _write(
    result: Comparison, out_dir: AnyPath | None, summary: AnyPath | None, *, overwrite: bool
) -> None:
    text = json.dumps(result.as_dict(), indent=2, allow_nan=False) + "\n"
    if out_dir is not None:
        folder = Path(out_dir)
        folder.mkdir(exist_ok=True)
        files = {"compare.json": text}
        if result.depth_bins:
            files["depth_bins.csv"] = bins_table(result.depth_bins)
        if result.shore_bins:
            files["shore_bins.csv"] = bins_table(result.shore_bins)
        for number, section in enumerate(result.sections, start=1):
            files[f"section_{number:02d}.csv"] = section.table()
        for name, content in files.items():
            write_text(folder / name, content, overwrite=overwrite)
        for path in folder.glob("section_*.csv"):  # of an earlier comparison with more of them
            if path.name not in files:
                path.unlink()
    if summary is not None:
        write_text(summary, text, overwrite=overwrite)
