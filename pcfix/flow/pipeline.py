"""Return the PDAL pipeline that is equivalent to a call of `correct_file`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.errors import SettingError, bad_file
from pcfix.flow.planning import read_inputs
from pcfix.flow.surfaces import view_of
from pcfix.io.las.columns import UPGRADE, Column, columns_for
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import check_suffix
from pcfix.io.pdal import CLASS_FLAGS, STAGE_SOURCE, add_dimension
from pcfix.options.correct import CorrectOptions

if TYPE_CHECKING:
    import laspy


def pipeline_for(input: Path, output: Path, options: CorrectOptions) -> dict[str, Any]:
    """Return the pipeline, ready for JSON.

    The stage gets the options that differ from their defaults. PDAL replaces existing outputs. What
    `pcfix.correct_file` refuses before it reads points is refused here, too.
    """
    if options.port is not None:
        sentence = "--port has no effect in a pipeline. Use 'pcfix correct'."
        raise SettingError("option.no_use", sentence, option="port")
    check_suffix(output)
    read_inputs(options, view_of(input))
    columns = columns_for(options.dimensions)
    plain = options.plain()
    first = {name: plain[name] for name in ("cameras", "water") if name in plain}
    stage: dict[str, Any] = {
        "type": "filters.python",
        "source": STAGE_SOURCE.format("correct"),
        "module": "pcfix_stage",
        "function": "correct",
        "add_dimension": ",".join(filter(None, [add_dimension(columns), CLASS_FLAGS])),
        "pdalargs": {
            **first,
            **plain,
            "uncorrected": options.uncorrected,
            "dimensions": options.dimensions,
        },
    }
    with LasSource(input) as source:
        point_format = source.header.point_format
    if UPGRADE[point_format.id] in (9, 10):
        sentence = (
            f"has waveforms (point format {point_format.id}), which PDAL does not write. Use 'pcfix"
            " correct'."
        )
        raise bad_file(input, "cloud.waveforms", sentence, point_format=point_format.id)
    reader = {"type": "readers.las", "filename": str(input)}
    writer = {
        "type": "writers.las",
        "filename": str(output),
        "forward": "all",
        "minor_version": 4,
        "dataformat_id": UPGRADE[point_format.id],
    }
    if extra := _extra_dims(point_format, columns):
        writer["extra_dims"] = extra
    return {"pipeline": [reader, stage, writer]}


def _extra_dims(point_format: laspy.PointFormat, columns: tuple[Column, ...]) -> str:
    """Return the extra dimensions of the input, with PDAL's names and types, and of pcfix."""
    names = []
    for dimension in point_format.extra_dimensions:
        kind = "double" if dimension.is_scaled else str(dimension.dtype.base)
        if dimension.num_elements == 1:
            names.append(f"{dimension.name}={kind}")
        elif dimension.num_elements <= 3:  # PDAL does not read longer ones
            names += [f"{dimension.name}{i}={kind}" for i in range(dimension.num_elements)]
    return ",".join(filter(None, [*names, add_dimension(columns)]))
