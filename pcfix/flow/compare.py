"""Compare the files of a cloud and a reference."""

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pcfix.compare.figures import Comparison, bins_table, figures_of, parse_line
from pcfix.compare.match import Match, SurveyCloud, match
from pcfix.compare.statistics import load_py4dgeo
from pcfix.errors import SettingError
from pcfix.flow.runner import check_summary, json_text, write_summary
from pcfix.io.clouds import (
    Clouds,
    band_of,
    check_same_crs,
    cloud_of,
    inputs_of,
    read_cloud,
    read_reference,
    reference_of,
)
from pcfix.io.files import all_or_none, check_output, scratch_arrays, write_bytes, write_text
from pcfix.options.declare import taken
from pcfix.options.shared import WaterOptions
from pcfix.options.steps import CompareOptions, CompareRules

DEPTHS = "depth_bins.csv"


def compare_clouds(
    cloud: Clouds, reference: Clouds, *, options: CompareOptions | None = None, **keywords: Any
) -> Comparison:
    """Compare a cloud with a reference; what ``pcfix compare`` runs.

    Both are in one CRS, metres. Points that are withheld or of class 7 or 18 are ignored, and
    points of the reference of classes 9, 41, 42 and 45 (water, its surface and column).

    Parameters
    ----------
    cloud : path, or list of paths
        LAS or LAZ, or many as `pcfix.io.clouds.tiles_of` has them; or a GeoTIFF of heights.
        If `correct_file` wrote it with all its dimensions, the apparent points are compared too.
    reference : path, or list of paths
        LAS or LAZ, or many; CSV check points (x, y, z); or a GeoTIFF of heights. At check points
        the cloud's surface is measured, not the reference's at each point of the cloud.
    options : CompareOptions, optional
        Or its attributes as keywords: the options of ``pcfix compare``. `section` takes texts
        ``x1,y1,x2,y2`` or `pcfix.compare.figures.SectionLine`, `share` texts or pairs, `also`
        texts, pairs or a dict of paths by name.
    """
    started = time.perf_counter()
    given = taken(CompareOptions, options, keywords, "compare_clouds")
    lines = [parse_line(line) if isinstance(line, str) else line for line in given.section]
    source = band_of(cloud_of(cloud), given)
    also = {name: cloud_of(path) for name, path in given.also}
    surveyed = reference_of(reference)
    inputs = [path for one in (source, surveyed, *also.values()) for path in inputs_of(one)]
    if given.out_dir is not None:  # refuse what cannot be written before anything is computed
        folder = Path(given.out_dir)
        if folder.is_dir():
            for path in (*folder.glob("section_*.csv"), folder / "compare.json", folder / DEPTHS):
                check_output(path, overwrite=given.overwrite, inputs=inputs)
        elif folder.exists():
            sentence = f"{folder} is a file. Give a folder."
            raise SettingError("output.no_folder", sentence, path=folder)
        else:
            check_output(folder, overwrite=False)
    check_summary(given, inputs)
    if given.m3c2:
        load_py4dgeo()
    water = None
    if given.water is not None:
        from pcfix.flow.surfaces import find_surface, view_of  # slow to import

        water = find_surface(given.water, WaterOptions(), view_of(source)).surface
    outputs = [path for path in (given.out_dir, given.summary, given.plot) if path is not None]
    near = Path([*outputs, Path(tempfile.gettempdir()) / "pcfix"][0])
    with scratch_arrays(near):  # arrays of large clouds
        target = read_reference(surveyed)

        def matched_to(one: SurveyCloud) -> Match:
            check_same_crs(one.name, one.crs, target.name, target.crs)
            return match(one, target, given.part(CompareRules), given=water is not None)

        matched, others = matched_to(read_cloud(source, water)), {}
        for name, further in also.items():  # at the places of the first
            others[name] = replace(matched_to(read_cloud(further, water)), places=matched.places)
        result = figures_of(matched, lines, others)
    result.seconds = round(time.perf_counter() - started, 3)
    _write(result, given)
    return result


def _write(result: Comparison, given: CompareOptions) -> None:
    """Write the files of a comparison, and remove those of an earlier one with more sections."""
    files: dict[str, str] = {}
    folder = None if given.out_dir is None else Path(given.out_dir)
    with all_or_none(folder):
        if folder is not None:
            files = {"compare.json": json_text(result.as_dict())}
            if result.depth_bins:
                files[DEPTHS] = bins_table(result.depth_bins)
            sections = enumerate(result.sections, start=1)
            files |= {f"section_{n:02d}.csv": s.table() for n, s in sections}
            for name, content in files.items():
                write_text(folder / name, content, overwrite=given.overwrite)

        if given.plot is not None:
            from pcfix.report.comparison import c2c_figure  # matplotlib is slow to import
            from pcfix.report.page import png_of

            picture = c2c_figure(result.as_dict())
            write_bytes(given.plot, png_of(picture), overwrite=given.overwrite)
        write_summary(given, result.as_dict())
    if folder is not None:
        for path in folder.glob("section_*.csv"):
            if path.name not in files:
                path.unlink()
