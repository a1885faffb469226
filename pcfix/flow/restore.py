"""Undo a correction from the dimensions that it left in the file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.flow.points import CHUNK_POINTS
from pcfix.io.files import check_input, check_output
from pcfix.io.las.columns import SHIFTS, columns_for, is_corrected, is_marked_uncorrected, shifted
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import LasSink, check_suffix, output_evlrs, read_settings, restored_header
from pcfix.threads import threads

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    import laspy
    import numpy.typing as npt

    from pcfix.options import Dimensions

    AnyPath = str | os.PathLike[str]


def restore_file(
    input: AnyPath,
    output: AnyPath,
    *,
    overwrite: bool = False,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Give back the apparent cloud that a corrected one came from, bit for bit.

    Parameters
    ----------
    input : path
        A cloud that pcfix corrected with ``dimensions="all"``.
    output : path
        The cloud as it was: coordinates, classes, flags, point format, version.
    overwrite, jobs, progress
        See `correct_file`.

    Returns
    -------
    int
        Points written. Rows dropped by ``uncorrected="drop"`` are gone.

    Raises
    ------
    InputError
        If pcfix did not correct the file, or without the dimensions that undo it.
    """
    source_path = check_input(input)
    target = check_output(output, overwrite=overwrite, inputs=[source_path])
    check_suffix(target)
    with LasSource(source_path, jobs) as source, threads(jobs):
        content = read_settings(source.vlrs, source_path)
        names = _ours(source, content["settings"]["dimensions"])
        header = restored_header(source, content["before"], names)
        identity = content["before"]["identity"].encode("latin-1")
        offset = np.array(content["before"]["steps"])
        with LasSink(target, header, output_evlrs(source), identity, jobs) as sink:
            done = 0
            for points in source.chunks(CHUNK_POINTS):
                sink.write(_restored(points, header, offset))
                done += len(points)
                if progress is not None:
                    progress(done, len(source))
    return done


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


def _restored(
    points: laspy.ScaleAwarePointRecord,
    header: laspy.LasHeader,
    offset: npt.NDArray[np.int64],
) -> laspy.ScaleAwarePointRecord:
    moved = is_corrected(points)
    points.array["classification"][moved] = points.array["SourceClass"][moved]
    withheld = np.asarray(points["withheld"]).astype(bool)
    points["withheld"][:] = (withheld & ~is_marked_uncorrected(points)).astype(np.uint8)
    shift = np.column_stack([points.array[name] for name in SHIFTS]).astype(np.int64)
    return shifted(points, header, -shift - offset)
