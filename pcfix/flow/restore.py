"""Undo a correction with the extra dimensions that it wrote."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pcfix.errors import bad_file
from pcfix.flow.runner import Chunk, FileWork, run_command
from pcfix.io.clouds import Clouds
from pcfix.io.las.columns import SHIFTS, columns_for, convert, move
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import read_settings, record_errors, restored_header
from pcfix.io.rasters import is_raster
from pcfix.options.declare import File, taken
from pcfix.options.shared import TileOptions


def restore_file(
    input: Clouds,
    output: File,
    *,
    options: TileOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keywords: Any,
) -> int:
    """Undo a correction exactly: write the apparent cloud, bit for bit.

    Parameters
    ----------
    input : path
        A cloud that pcfix corrected with ``dimensions="all"``, or many and a folder for the
        output; see `pcfix.correct_file`.
    output : path
        The apparent cloud with its coordinates, classes, flags, point format and version.
    options, progress
        See `pcfix.correct_file`.

    Returns
    -------
    int
        Number of points written.

    Raises
    ------
    InputError
        If pcfix did not correct the file, or the dimensions for undoing it are missing.
    """
    given = taken(TileOptions, options, keywords, "restore_file")
    if is_raster(input):
        sentence = "is a raster, whose cells were interpolated: nothing can restore it. Use the"
        raise bad_file(input, "raster.no_restore", f"{sentence} input of its correction.")
    return run_command(
        "restore", input, output, given, plan=lambda task: None, work=_restoring,
        finish=lambda plan, task, points: int(points), progress=progress,
    )  # fmt: skip


def _restoring(plan: None, source: LasSource) -> FileWork:
    """Return how to restore one file: its original header, and a function for each chunk."""
    content = read_settings(source.vlrs, source.path)
    with record_errors(source.path):
        names, before = _ours(source, content["settings"]), content["before"]
        identity = before["identity"].encode("latin-1")
        header = restored_header(source, before, names)

    def apply(points: Chunk, result: None) -> Chunk:
        """Restore coordinates, classes and flags of points."""
        moved = np.asarray(points.array["RayCount"] > 0)
        points.array["classification"][moved] = points.array["SourceClass"][moved]
        # points that pcfix withheld: submerged, but not corrected
        ours = np.asarray(~moved & (points.array["WaterDepth"] > 0))
        withheld = np.asarray(points["withheld"]).astype(bool)
        points["withheld"][:] = (withheld & ~ours).astype(np.uint8)
        shift = np.array([points.array[name] for name in SHIFTS], np.int64)
        old = convert(points, header.point_format)
        move(old, -shift, source.path)
        return old

    return FileWork(header, lambda points, row: (None, len(points)), apply, identity)


def _ours(source: LasSource, settings: dict[str, Any]) -> set[str]:
    """Return the dimensions that pcfix added; InputError if any is missing or has changed."""
    written, header = settings["dimensions"], source.header.point_format
    columns = columns_for(written)
    names, wrong = {column.name for column in columns}, ""
    missing = names.difference(header.dimension_names)
    if not names.issuperset(SHIFTS):
        wrong = f"was written with --dimensions {written}, which cannot be undone"
    elif missing:
        wrong = f"has lost the dimensions {', '.join(sorted(missing))} since it was corrected"
    else:
        for column in columns:  # another program may have changed a type
            found = header.dimension_by_name(column.name).dtype
            if str(found) != column.dtype:
                wrong = f"has a dimension {column.name} of type {found}, not {column.dtype}"
    if wrong:
        raise bad_file(source.path, "cloud.cannot_restore", f"{wrong}. Use the original cloud.")
    return names
