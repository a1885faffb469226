"""Undo a correction from the dimensions that it left in the file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from pcfix.errors import InputError
from pcfix.flow.runner import Chunk, Header, Step, file_task
from pcfix.flow.tiles import TiledRun
from pcfix.io.files import path_of
from pcfix.io.las.columns import (
    SHIFTS,
    UNSURE,
    Column,
    columns_for,
    convert,
    is_corrected,
    is_marked_uncorrected,
    move,
)
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import read_settings, record_errors, restored_header
from pcfix.io.tiles import Clouds, single, tiles_of
from pcfix.kernels import threads
from pcfix.options.declare import File, taken
from pcfix.options.shared import TileOptions
from pcfix.sums import Sums


def restore_file(
    input: Clouds,
    output: File,
    *,
    options: TileOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keywords: Any,
) -> int:
    """Give back the apparent cloud that a corrected one came from, bit for bit.

    Parameters
    ----------
    input : path
        A cloud that pcfix corrected with ``dimensions="all"``, or many and a folder for the
        output; see `pcfix.correct_file`.
    output : path
        The cloud as it was: coordinates, classes, flags, point format, version.
    options : TileOptions, optional
        Or its attributes as keywords: overwrite, jobs, scheduler.
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
    given = taken(TileOptions, options, keywords, "restore_file")
    tiles = tiles_of(input)
    if tiles is not None:
        run = TiledRun("restore", tiles, path_of(output), given, progress)
        return run.run(lambda _: Restoring(), lambda step: step.points)
    task = file_task(single(input), output, given, progress=progress)
    step = Restoring()
    with threads(given.jobs):
        task.run(step)
    return step.points


class Restoring(Sums, Step):
    """The step that takes points back."""

    added = ("points",)

    def __init__(self) -> None:
        self.points, self._offset, self._has_unsure = 0, np.zeros(3, np.int64), False

    def begin(self, first_row: int) -> None:
        """Count from nothing, wherever the next point is."""
        del first_row
        self.points = 0

    def header(self, source: LasSource) -> Header:
        """Return the header as it was before the correction."""
        content = read_settings(source.vlrs, source.path)
        with record_errors(source.path):
            names = _ours(source, content["settings"])
            self._has_unsure = UNSURE.name in names
            self.identity = content["before"]["identity"].encode("latin-1")
            self._offset = np.array(content["before"]["steps"], np.int64).reshape(3)
            return restored_header(source, content["before"], names)

    def chunk(self, points: Chunk, source: LasSource, header: Header) -> Callable[[], Chunk]:
        """Return what gives points their coordinates, classes and flags of before."""
        self.points += len(points)
        return partial(self._restored, points, header)

    def _restored(self, points: Chunk, header: Header) -> Chunk:
        moved = is_corrected(points)
        points.array["classification"][moved] = points.array["SourceClass"][moved]
        ours = is_marked_uncorrected(points)
        if self._has_unsure:
            ours |= points.array[UNSURE.name] > 0
        withheld = np.asarray(points["withheld"]).astype(bool)
        points["withheld"][:] = (withheld & ~ours).astype(np.uint8)
        shift = np.column_stack([points.array[name] for name in SHIFTS]).astype(np.int64)
        old = convert(points, header.point_format)
        old.offsets = header.offsets
        move(old, -shift - self._offset)
        return old


def _ours(source: LasSource, settings: dict[str, Any]) -> set[str]:
    """Return the dimensions that pcfix added, once all that undo its work are there."""
    dimensions = settings["dimensions"]
    unsure = settings.get("unsure", "keep")  # files of old have none
    columns = columns_for(dimensions, unsure)
    names = {column.name for column in columns}
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
    _check_types(source, columns)
    return names


def _check_types(source: LasSource, columns: tuple[Column, ...]) -> None:
    """Refuse dimensions that another program has turned into other numbers."""
    for column in columns:
        found = source.header.point_format.dimension_by_name(column.name).dtype
        known = column.dtype(wide=False), column.dtype(wide=True)
        if found not in known:
            raise InputError(
                f"{source.path}: its dimension {column.name} is {found}, not"
                f" {' or '.join(dict.fromkeys(map(str, known)))}: another program has changed it"
                " since; use the original cloud."
            )
