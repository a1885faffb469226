"""Label submerged points, in arrays and in files of any size."""

import warnings
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.flow.inputs import labelling_of, paths_in
from pcfix.flow.runner import Chunk, FileTask, FileWork, Progress, run_command
from pcfix.flow.surfaces import CloudView, Points, find_surface, parts_of, points_of, view_of
from pcfix.io.clouds import Clouds
from pcfix.io.las.columns import convert
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import output_header
from pcfix.model import WaterPlane, WaterSurface
from pcfix.options.correct import LabelOptions
from pcfix.options.declare import File, taken
from pcfix.points.labelling import Classes, LabelCounts, Labelling
from pcfix.sums import Figures
from pcfix.version import __version__
from pcfix.water.checks import check_submerged, check_tilt


def label_file(
    input: Clouds,
    output: File,
    *,
    options: LabelOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Figures:
    """Set the submerged points of a LAS or LAZ cloud to class 40; what ``pcfix label`` runs.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4. Or many files and a folder,
        see `pcfix.correct_file`. Of a GeoTIFF of heights the classes of its cells are a GeoTIFF
        too, with 255 for nodata.
    options, progress
        See `pcfix.correct_file`. With connectivity the cloud is read twice.
    """
    given = taken(LabelOptions, options, keywords, "label_file")
    return run_command(
        "label", input, output, given, work=_labelling, finish=_finish, reads=paths_in(given),
        plan=lambda task: plan_labelling(given, view_of(task.source, given.jobs)),
        progress=progress,
    )  # fmt: skip


@dataclass(frozen=True)
class LabelPlan:
    """What all points of a cloud have in common: its water, and the rules of the labelling."""

    name: str
    water: WaterSurface
    labelling: Labelling


def plan_labelling(options: LabelOptions, view: CloudView) -> LabelPlan:
    """Read water and mask, and scan the surroundings of all points if the rules need them."""
    water = find_surface(options.water, options, view).surface
    check_tilt(water)
    labelling = labelling_of(options, view).scanned(
        parts_of(view.chunks(water), water), view.low, view.high
    )
    return LabelPlan(view.name, water, labelling)


def label_chunk(plan: LabelPlan, points: Points) -> tuple[Classes, LabelCounts]:
    """Return the classes of some points, and their counts."""
    (part,) = parts_of([points], plan.water)
    return plan.labelling.labels(part)


def check(plan: LabelPlan, counts: LabelCounts) -> None:
    """Raise GeometryError if no point is below the water, or inside the mask."""
    plan.labelling.check(plan.name, counts)
    check_submerged(counts.submerged, plan.name, plan.water)


def _labelling(plan: LabelPlan, source: LasSource) -> FileWork:
    """Return the labelling of one file: its header with a record of it, and each chunk."""
    water, mask = plan.water, plan.labelling.mask
    content = {
        "pcfix": __version__,
        "settings": plan.labelling.settings.as_dict(),
        "water": str(water),
        "water_plane": list(astuple(water)) if isinstance(water, WaterPlane) else None,
        "water_mask": None if mask is None else mask.name,
    }
    header = output_header(source, "labelling", content)

    def apply(points: Chunk, classes: Classes) -> Chunk:
        new = convert(points, header.point_format)
        new.array["classification"] = classes
        return new

    return FileWork(
        header, lambda points, row: label_chunk(plan, points_of(points, source, water)), apply
    )


DEEP_M = 10.0  # clouds that are deeper everywhere hardly come from images through the surface


def _finish(plan: LabelPlan, task: FileTask, counts: LabelCounts) -> Figures:
    """Check the counts of a cloud, and return the summary."""
    check(plan, counts)
    notes = list[PcfixWarning]()
    if DEEP_M < counts.least_m < np.inf:
        sentence = f"{plan.name}: every point is more than {counts.least_m:.0f} m below the water"
        sentence += f" ({plan.water}). Check the height of the water and its vertical datum."
        notes.append(PcfixWarning("water.above_cloud", sentence, depth_m=counts.least_m))
        warnings.warn(notes[-1], stacklevel=2)
    return Figures(
        input=str(task.source),
        output=str(task.target),
        pcfix=__version__,
        **counts.of_classes(),
        water=str(plan.water),
        settings=plan.labelling.settings.as_dict(),
        labelling=plan.labelling.report(counts),
        seconds=task.seconds,
        warnings=notes,
    )
