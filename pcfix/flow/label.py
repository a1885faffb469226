"""Labelling as a step of its own: classes for points, in arrays and in files of any size."""

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
from pcfix.io.drafts import all_or_none
from pcfix.io.files import local_path
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
"""What becomes of points, under the names of `LabelSummary`."""


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
        That they come with. Default: 0, never classified.
    water_mask : WaterMask or path, optional
        See `label_file`.
    crs : str, optional
        Of the points, for a mask from a file.
    options : LabelRules, optional
        Or its attributes as keywords: band, dead_band, connected, respect_classes and others.

    Returns
    -------
    array of uint8, shape (n,)

    Raises
    ------
    PcfixError
        If an argument is outside its rule, or the mask cannot be used.

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
            f"classes must be {len(points)} values of uint8, not {given.dtype} of shape"
            f" {given.shape}."
        )
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
    """Give the submerged points of a LAS or LAZ cloud class 40; what ``pcfix label`` runs.

    Nothing else changes, but for class 41 where a band is asked for, and points that come as 40
    or 41 and are neither, which become class 1 with ``reset``. Ground and all other classes above
    the water stay, and so do the classes 42 to 45 there, which say what others knew of the water.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4. Or many files and a folder,
        see `pcfix.correct_file`.
    options : LabelOptions, optional
        Or its attributes as keywords, as of ``pcfix label``: water, water_mask, band and others.
        With a dead band or connectivity the cloud is read twice. The result does not depend on
        the size of chunks. A point on the border of the mask is inside.
    progress : callable, optional
        See `pcfix.correct_file`.

    Returns
    -------
    LabelSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; no output is left behind.
    """
    given = taken(LabelOptions, options, keywords, "label_file")
    tiles = tiles_of(input)
    if tiles is not None:
        run = TiledRun("label", tiles, local_path(output), given, progress)
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
    """Return the step, with what it learns of the whole cloud."""
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
    """The step that labels points: of a file, and of the arrays that PDAL hands over.

    Parameters
    ----------
    name : str
        What is being labelled, for messages.
    options : LabelOptions
    view : CloudView
        Of the whole cloud.

    Raises
    ------
    PcfixError
        If the water or the mask cannot be read or do not fit.
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
        """Forget the chunks so far, wherever the next one is."""
        del first_row
        self.counts: dict[str, Any] = dict.fromkeys(COUNTS, 0)
        self.labelling.restart()

    def run(self, task: FileTask) -> None:
        """Take a file through."""
        task.run(self)

    def look_around(self, chunks: Callable[[], Iterable[Points]]) -> None:
        """Learn the surroundings of all points, where the rules need them."""
        if self.labelling.looks_around:
            self.labelling.look_around(
                lambda: parts_of(chunks(), self.water), self._view.low, self._view.high
            )

    def header(self, source: LasSource) -> Header:
        """Return the header of a labelled file, with a record of what was done."""
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
        """Refuse a cloud of which no point lies below the water, or inside the mask."""
        below = self.counts["submerged"] + self.counts["water_surface"]
        self.labelling.check(self._name, below)
        check_submerged(below, self._name, self.water)


def _labelled(points: Chunk, header: Header, classes: Classes) -> Chunk:
    new = convert(points, header.point_format)
    new.array["classification"] = classes
    return new
