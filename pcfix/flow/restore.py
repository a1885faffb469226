"""Undo a correction from the dimensions that it left in the file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pcfix.errors import InputError
from pcfix.flow.runner import Chunk, Header, Step, file_task
from pcfix.io.las.columns import SHIFTS, columns_for, is_corrected, is_marked_uncorrected, shifted
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import read_settings, restored_header
from pcfix.kernels import threads
from pcfix.options.correct import Dimensions
from pcfix.options.declare import File, taken
from pcfix.options.shared import JobOptions


def restore_file(
    input: File,
    output: File,
    *,
    options: JobOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keywords: Any,
) -> int:
    """Give back the apparent cloud that a corrected one came from, bit for bit.

    Parameters
    ----------
    input : path
        A cloud that pcfix corrected with ``dimensions="all"``.
    output : path
        The cloud as it was: coordinates, classes, flags, point format, version.
    options : JobOptions, optional
        Or its attributes as keywords: overwrite, jobs.
    progress : callable, optional
        See `pcfix.correct_file`.

    Returns
    -------
    int
        Points written. Rows dropped by ``uncorrected="drop"`` are gone.

    Raises
    ------
    InputError
        If pcfix did not correct the file, or without the dimensions that undo it.
    """
    given = taken(JobOptions, options, keywords, "restore_file")
    task = file_task(input, output, given, progress=progress)
    step = Restoring()
    with threads(given.jobs):
        task.run(step)
    return step.points


class Restoring(Step):
    """The step that takes points back."""

    def __init__(self) -> None:
        self.points, self._offset = 0, np.zeros(3, np.int64)

    def header(self, source: LasSource) -> Header:
        """Return the header as it was before the correction."""
        content = read_settings(source.vlrs, source.path)
        names = _ours(source, content["settings"]["dimensions"])
        self.identity = content["before"]["identity"].encode("latin-1")
        self._offset = np.array(content["before"]["steps"])
        return restored_header(source, content["before"], names)

    def chunk(self, points: Chunk, source: LasSource, header: Header) -> Chunk:
        """Return points with their coordinates, classes and flags of before."""
        self.points += len(points)
        moved = is_corrected(points)
        points.array["classification"][moved] = points.array["SourceClass"][moved]
        withheld = np.asarray(points["withheld"]).astype(bool)
        points["withheld"][:] = (withheld & ~is_marked_uncorrected(points)).astype(np.uint8)
        shift = np.column_stack([points.array[name] for name in SHIFTS]).astype(np.int64)
        return shifted(points, header, -shift - self._offset)


def _ours(source: LasSource, dimensions: Dimensions) -> set[str]:
    """Return the dimensions that pcfix added, once all that undo its work are there."""
    names = {column.name for column in columns_for(dimensions)}
    if not names.issuperset(SHIFTS):
        raise InputError(
            f"{source.path}: was written with --dimensions {dimensions}, which keeps no way back;"
            " use the original cloud."
        )
    missing = names.difference(source.header.point_format.dimension_names)
    if missing:
        raise InputError(
            f"{source.path}: has lost the dimensions {', '.join(sorted(missing))} since it was"
            " corrected; use the original cloud."
        )
    return names
