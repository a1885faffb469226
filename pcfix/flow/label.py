"""Label submerged points, in arrays and in files of any size."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import astuple, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.flow.inputs import mask_of, paths_in
from pcfix.flow.runner import Chunk, FileTask, Header, Progress, Step, file_task
from pcfix.flow.surfaces import (
    CloudView,
    Points,
    corners,
    file_points,
    find_surface,
    parts_of,
    points_of,
    view_of,
)
from pcfix.flow.tiles import TiledRun
from pcfix.io.atomic import all_or_none
from pcfix.io.files import path_of
from pcfix.io.las.columns import convert
from pcfix.io.las.part import part_report
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import labelling_vlr, noted_header
from pcfix.io.tiles import Clouds, Tiles, single, tiles_of
from pcfix.kernels import threads
from pcfix.label.areas import WaterMask
from pcfix.label.labelling import Labelling, LabelSummary, Part, sets_class
from pcfix.model import WaterPlane, WaterSurface
from pcfix.options.correct import LabelOptions, LabelRules, StageLabelOptions
from pcfix.options.declare import File, taken
from pcfix.sums import Sums
from pcfix.version import __version__
from pcfix.water.checks import as_surface, check_submerged, check_tilt, checked_points
from pcfix.water.surface import surface_above

Classes = npt.NDArray[np.uint8]

COUNTS = ("submerged", "water_surface", "stale", "water_unknown", "points")
"""Counts of points, by the names of `LabelSummary`."""


def label_points(
    xyz: npt.ArrayLike,
    water: WaterSurface | float | npt.ArrayLike,
    *,
    classes: npt.ArrayLike | None = None,
    water_mask: WaterMask | File | None = None,
    crs: str | None = None,
    options: LabelRules | None = None,
    **keywords: Any,
) -> Classes:
    """Return the classes of points, 40 where they are submerged.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Points, metres, world frame.
    water : WaterSurface, float, or array of shape (n,)
        See `pcfix.correct_points`.
    classes : array of uint8, shape (n,), optional
        Their classes. Default: 0, never classified.
    water_mask : WaterMask or path, optional
        See `label_file`.
    crs : str, optional
        CRS of the points, for a mask from a file.
    options : LabelRules, optional
        Or its attributes as keywords: band, dead_band, connected, respect_classes and others.

    Returns
    -------
    array of uint8, shape (n,)

    Raises
    ------
    PcfixError
        If an argument breaks its rule, or the mask cannot be used.

    Examples
    --------
    >>> from pcfix.flow.label import label_points
    >>> label_points([[0, 0, 1.0], [5, 0, -1.0]], 0.0).tolist()
    [0, 40]
    """
    rules = taken(LabelRules, options, keywords, "label_points")
    points = checked_points(xyz)
    given = np.zeros(len(points), np.uint8) if classes is None else np.asarray(classes)
    if given.shape != (len(points),) or given.dtype != np.uint8:
        raise SettingError(
            "option.shape",
            f"classes are {given.dtype} of the shape {given.shape}. Give {len(points)} values of"
            " uint8.",
            option="classes", shape=given.shape,
        )  # fmt: skip
    surface, heights = as_surface(water, len(points))
    if water_mask is None or isinstance(water_mask, str | PathLike):
        water_mask = mask_of(water_mask, crs, *corners(*points[:, :2].T))
    labelling = Labelling(rules, water_mask)
    part = Part(points, surface_above(surface, points, heights), given)
    if labelling.looks_around:
        labelling.look_around(lambda: [part], *corners(*points[:, :2].T))
    return labelling.labels(part).classes


def label_file(
    input: Clouds,
    output: File,
    *,
    options: LabelOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> LabelSummary:
    """Set the submerged points of a LAS or LAZ cloud to class 40; what ``pcfix label`` runs.

    With a band, points near the surface get class 41; with ``reset``, points of class 40 or 41 that
    are neither get class 1. All other classes above the water stay, 42 to 45 too.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4. Or many files and a folder,
        see `pcfix.correct_file`.
    options : LabelOptions, optional
        Or its attributes as keywords: the options of ``pcfix label``. With a dead band or
        connectivity the cloud is read twice. A point on the border of the mask is inside.
    progress : callable, optional
        See `pcfix.correct_file`.

    Returns
    -------
    LabelSummary

    Raises
    ------
    PcfixError
        If a file, an option or the water cannot be used; no output is left behind.
    """
    given = taken(LabelOptions, options, keywords, "label_file")
    tiles = tiles_of(input)
    if tiles is not None:
        run = TiledRun("label", tiles, path_of(output), given, progress)
        return run.run(
            lambda part: _step_for(part, given),
            lambda step: _summary(step, str(tiles), str(output), run.seconds),
        )
    task = file_task(single(input), output, given, reads=paths_in(given), progress=progress)
    with threads(given.jobs), all_or_none():
        step = _step_for(task.source, given)
        task.run(step)
        result = _summary(step, str(task.source), str(task.target), task.seconds)
        result = replace(result, part=part_report(task.source))
        task.tell(result.as_dict())
    return result


def _step_for(cloud: Path | Tiles, options: LabelOptions) -> LabellingStep:
    """Return the step after it has scanned the whole cloud, if its rules need that."""
    step = LabellingStep(str(cloud), options, view_of(cloud))
    step.look_around(lambda: file_points(cloud, step.water, options.jobs))
    return step


def _summary(step: LabellingStep, input: str, output: str, seconds: float) -> LabelSummary:
    return LabelSummary(
        input=input,
        output=output,
        pcfix=__version__,
        **step.counts,
        water=str(step.water),
        settings=step.labelling.settings.as_dict(),
        labelling=step.labelling.report(),
        seconds=round(seconds, 3),
        warnings=list(step.labelling.notes),
    )


class LabellingStep(Sums, Step):
    """Label the points of a file, or the arrays of a PDAL pipeline.

    The name is for messages; the view is that of the whole cloud. Raises PcfixError if the water or
    the mask cannot be read or do not fit.
    """

    added = ("counts", "labelling")

    def __init__(self, name: str, options: StageLabelOptions, view: CloudView) -> None:
        self._name, self._view = name, view
        self.water = find_surface(options.water, options, view).surface
        check_tilt(self.water)
        mask = mask_of(options.water_mask, view.crs, view.low, view.high)
        self.labelling = Labelling(options.part(LabelRules), mask)
        self.begin(0)

    def begin(self, first_row: int) -> None:
        """Reset the counts; the result does not depend on the row of the next chunk."""
        del first_row
        self.counts: dict[str, Any] = dict.fromkeys(COUNTS, 0)
        self.labelling.restart()

    def run(self, task: FileTask) -> None:
        """Process a file."""
        task.run(self)

    def look_around(self, chunks: Callable[[], Iterable[Points]]) -> None:
        """Scan the surroundings of all points, if the rules need them."""
        if self.labelling.looks_around:
            self.labelling.look_around(
                lambda: parts_of(chunks(), self.water), self._view.low, self._view.high
            )

    def header(self, source: LasSource) -> Header:
        """Return the header of a labelled file, with the record of the labelling."""
        water, mask = self.water, self.labelling.mask
        content = {
            "pcfix": __version__,
            "settings": self.labelling.settings.as_dict(),
            "water": str(water),
            "water_plane": list(astuple(water)) if isinstance(water, WaterPlane) else None,
            "water_mask": None if mask is None else mask.name,
        }
        part = part_report(source.path)
        content |= {} if part is None else {"part": part}
        return noted_header(source, labelling_vlr(content))

    def classes(self, points: Points) -> Classes:
        """Return the classes of some points, and count them."""
        (part,) = parts_of([points], self.water)
        labels = self.labelling.labels(part)
        stale = sets_class(part.classes) & ~(labels.submerged | labels.at_surface)
        unknown = np.isnan(part.surface.height_m)
        found = labels.submerged, labels.at_surface, stale, unknown, np.ones(len(unknown), np.bool_)
        for name, rows in zip(COUNTS, found, strict=True):
            self.counts[name] += int(rows.sum())
        return labels.classes

    def chunk(self, points: Chunk, source: LasSource, header: Header) -> Callable[[], Chunk]:
        """Return what writes the labels of points of a file."""
        found = self.classes(points_of(points, source, self.water))
        return partial(_labelled, points, header, found)

    def finish(self) -> None:
        """Raise GeometryError if no point lies below the water, or inside the mask."""
        below = self.counts["submerged"] + self.counts["water_surface"]
        self.labelling.check(self._name, below)
        check_submerged(below, self._name, self.water)


def _labelled(points: Chunk, header: Header, classes: Classes) -> Chunk:
    new = convert(points, header.point_format)
    new.array["classification"] = classes
    return new
