"""Correct a LAS or LAZ cloud, or arrays, for refraction: two doors to one calculation.

The story of ``pcfix correct``, in the order of this file:

1. Read the inputs, and make a plan for the whole cloud: `read_inputs` and `plan_correction`.
2. Correct chunk by chunk by the plan, and write each: `_correcting`. Chunks leave statistics.
3. Check by the statistics of all points that cloud, water and cameras belong together, before the
   output appears: `_check_inputs` and `_check_outcomes`, then `_check_fit`, which only warns.
4. Summarize: `finish`.

Arrays take the same steps in `correct_points`, without files and summary.
"""

import warnings
from itertools import compress
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, PcfixWarning, SettingError, coded
from pcfix.flow.correction import CloudTally, Plan, correct_chunk
from pcfix.flow.inputs import Inputs, paths_in, read_blocks
from pcfix.flow.planning import plan_correction, plan_of, read_inputs
from pcfix.flow.plausibility import CloudSample, Plausible, likely_mistake, plausible
from pcfix.flow.poses import diagnose_in_passing, quick_ties
from pcfix.flow.raster import check_heights
from pcfix.flow.runner import Chunk, FileTask, FileWork, Progress, run_command
from pcfix.flow.surfaces import CloudView, Points, corners, points_of, view_of
from pcfix.io.clouds import Clouds
from pcfix.io.las import columns
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import output_header
from pcfix.io.rasters import is_raster
from pcfix.lens.imaging import count_visible_cameras
from pcfix.model import (
    BATHYMETRIC_POINT,
    Cameras,
    Correction,
    FloatArray,
    Outcome,
    TiePoints,
    Views,
    WaterDimension,
    WaterSurface,
)
from pcfix.options.correct import CorrectOptions, PointsOptions, RefractionOptions, ScienceOptions
from pcfix.options.declare import File, taken
from pcfix.options.shared import LandRules
from pcfix.points.labelling import Labelling
from pcfix.refract.regression import DepthRegression
from pcfix.refract.tally import Tally
from pcfix.report.text import Summary
from pcfix.version import __version__
from pcfix.water.auto import WaterProposal
from pcfix.water.checks import as_surface, check_submerged, checked_points, refuse_under_water
from pcfix.water.index import with_index
from pcfix.water.surface import FoundSurface


def correct_file(
    input: Clouds,
    output: File,
    *,
    options: CorrectOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Summary:
    """Correct a LAS or LAZ cloud, of one file or many, or a DSM; what ``pcfix correct`` runs.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, point format 6, 7 or 8 (9
        or 10 for inputs with waveforms). For many files (a list of paths; see
        `pcfix.io.clouds.tiles_of`) the output is a folder, and every point is corrected as in one
        file of all points. A GeoTIFF of heights is corrected as the cloud of the centres of its
        cells; an output that ends in ``.tif`` has the same grid, see `pcfix.flow.raster`.
    options : CorrectOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: ``cameras`` (a path or
        `pcfix.Cameras`), ``water`` (what `pcfix.read_water` takes, a `pcfix.WaterSurface`,
        shoreline points in a vector file, or ``auto``) and many more. Every command takes its
        options so.
    progress : callable, optional
        Called with (points done, points in all) after each chunk, or each of many files.

    Raises
    ------
    PcfixError
        With one sentence on what to change. No output is left behind. Every command raises it.
    """
    given = taken(CorrectOptions, options, keywords, "correct_file")

    def plan(task: FileTask) -> Plan:
        """Return the plan for a file, or for many as one cloud."""
        planned = plan_correction(read_inputs(given, view_of(task.source, given.jobs)))
        check_heights(task.source, planned.found.surface)
        return planned

    return run_command(
        "correct", input, output, given, plan=plan, work=_correcting, finish=finish,
        reads=paths_in(given), progress=progress,
    )  # fmt: skip


def _correcting(plan: Plan, source: LasSource) -> FileWork:
    """Return the correction of one file: its header, and each chunk."""
    written = columns.columns_for(plan.options.dimensions)
    if is_raster(source.path):
        written = (*columns.COLUMNS, columns.OUTCOME)
    header = output_header(source, "settings", plan.provenance(), written)

    def compute(points: Chunk, row: int) -> tuple[Correction, CloudTally]:
        return correct_chunk(plan, points_of(points, source, plan.found.surface), row)

    def apply(points: Chunk, correction: Correction) -> Chunk:
        """Move points, and write their new dimensions, classes and flags."""
        new = columns.convert(points, header.point_format)
        # whole steps of the file's own scale, so that 'pcfix restore' gets back every bit
        classes = np.array(new["classification"])
        withheld = np.asarray(new["withheld"]).astype(bool)
        changes = columns.changes_of(written, correction, classes, withheld, new.scales)
        columns.move(new, changes.steps, source.path)
        columns.fill(new, changes)
        new.array["classification"][correction.corrected] = BATHYMETRIC_POINT
        new["withheld"][:] = (withheld | changes.flagged).astype(np.uint8)
        return new

    return FileWork(header, compute, apply)


def finish(plan: Plan, task: FileTask, tally: CloudTally) -> Summary:
    """Refuse a result in which cloud, water and cameras do not fit, else summarize it.

    Warns of what is uncertain.
    """
    view_notes = [] if tally.views is None else tally.views.notes()
    for note in view_notes:
        warnings.warn(note, stacklevel=2)
    water_notes = _check_inputs(plan, tally)
    _check_outcomes(plan, tally.figures)
    fit, poses, absorbed = None, None, None
    if plan.inputs.port is None:  # neither has a model of a port
        # straight rays do not fit the tie points of cameras that were adjusted with refraction
        is_straight = len(plan.cameras) and plan.inputs.adjusted_from is None
        ties = quick_ties(plan.inputs, plan.view.crs) if is_straight else None
        fit = _check_fit(plan, tally, ties)
        poses, absorbed = diagnose_in_passing(plan, ties)
    notes = [
        *plan.input_notes,
        *view_notes,
        *([] if fit is None else fit.problems),
        *plan.notes,
        *coded("water.extent", water_notes),
        *([] if absorbed is None else [absorbed]),
    ]
    figures, reconstruction = tally.figures, plan.reconstruction
    found, survey = figures.as_dict(), plan.survey
    if plan.inputs.port is not None:  # no depths, and no orders by depth
        water, uncertainty = f"all around, seen through a {plan.inputs.port}", None
        found["depth_m"] = {}
    else:
        water, uncertainty = str(plan.found.surface), figures.uncertainty(reconstruction)
        if (moved := survey.level_offset_m) is not None:
            water += f", {moved.min():+.3f} to {moved.max():+.3f} m at the times of the images"
        if uncertainty is not None and survey.learned.poses is not None:
            uncertainty["poses_m"] = round(survey.learned.poses.middle_m, 4)
    because = "" if reconstruction is None else reconstruction["because"]
    unused = list(compress(plan.cameras.labels, ~figures.camera_used))
    return Summary(
        input=str(task.source),
        output=str(task.target),
        pcfix=__version__,
        **found,
        water=water,
        uncertainty=uncertainty,
        cameras=len(plan.cameras),
        cameras_used=len(plan.cameras) - len(unused),
        cameras_unused=unused,  # labels of those without corrected points
        seconds=task.seconds,
        views=None if tally.views is None else vars(tally.views),
        warnings=[one.as_dict() for one in notes],
        labelling=plan.labelling.report(tally.labels),
        settings={**plan.options.part(ScienceOptions).as_dict(), **plan.settings},
        water_fit=plan.found.as_dict(),
        transfer=None if tally.transfer is None else tally.transfer.as_dict(),
        reconstruction=reconstruction,  # its type, and why
        # other notes on the cloud, also in `warnings`
        notes=[one for one in map(str, plan.notes) if one not in because],
        poses=poses,  # whether they have absorbed the refraction
        fit=None if fit is None else fit.as_dict(),
    )


def _check_inputs(plan: Plan, tally: CloudTally) -> list[str]:
    """Refuse a water, mask or original model of another place; return notes on the water's extent.

    From the general to the particular: a mask elsewhere would also leave points without cameras.
    """
    name, water = plan.view.name, plan.found.surface
    if tally.transfer is not None:
        tally.transfer.check(name)
    plan.labelling.check(name, tally.labels)
    if tally.water is None:  # a port
        if tally.figures.submerged == 0:
            words = f"{name}: no point is left to correct. Check the mask."
            raise GeometryError("cloud.none_submerged", words)
        return []
    check_submerged(tally.water.submerged, name, water, tally.water.heights())
    if isinstance(water, WaterDimension):
        refuse_under_water(plan.cameras, tally.figures.lowest_water_m, str(water))
    return tally.water.check_reach(name, water, deep=plan.options.deep)


def _check_outcomes(plan: Plan, figures: Tally) -> None:
    """Refuse a cloud of which no submerged point can be corrected."""
    name, limit, submerged = plan.view.name, plan.survey.limit_deg, figures.submerged
    flat = int(figures.outcomes[Outcome.FLAT_RAYS])
    if figures.corrected or not submerged:
        return
    if figures.outcomes[Outcome.NO_CAMERA] + flat < submerged:
        reasons = {why: n for why, n in figures.uncorrected().items() if n}
        listed = "; ".join(f"{n:,}: {why}" for why, n in reasons.items())
        raise GeometryError(
            "cameras.none_corrected",
            f"{name}: none of {submerged:,} submerged points can be corrected ({listed})."
            " Check that cameras and cloud belong together.",
            reasons=reasons,
        )
    if flat:
        raise GeometryError(
            "cameras.max_angle",
            f"{name}: no submerged point has two rays within {limit or 90.0:g} deg of the surface"
            f" normal; {flat:,} points have rays at larger angles. Increase --max-angle.",
            submerged=submerged,
            flat=flat,
        )
    middle, centres = (figures.low + figures.high) / 2.0, plan.cameras.centres
    distance_m = np.hypot(*(centres - middle)[:, :2].T).min()
    within = f" within {limit:g} degrees" if limit else ""
    mistake = likely_mistake(centres, figures.low, figures.high) or ""
    raise GeometryError(
        "cameras.no_overlap",
        f"{name}: no image shows a submerged point{within}; the nearest is {distance_m:,.1f} m in"
        f" plan from the middle of the {submerged:,} submerged points. Check that cameras and cloud"
        f" have the same CRS, and that pitch 0 is straight down. {mistake}".strip(),
        submerged=submerged,
        flat=0,
    )


def _check_fit(plan: Plan, tally: CloudTally, ties: TiePoints | None = None) -> Plausible:
    """Test cameras, cloud and water against each other; warn of what does not fit."""
    sample, given = tally.sample or CloudSample(), plan.inputs.cameras
    found = plausible(
        plan.cameras, sample.rows[:, :3], ties, water_m=sample.water_m,
        file="" if isinstance(given, Cameras) else given or "", listed=plan.kind is not None,
    )  # fmt: skip
    if not isinstance(plan.found, WaterProposal):  # else it is the shoreline of the cloud
        found = found._replace(problems=[*sample.level_notes(), *found.problems])
    for warning in found.problems:
        warnings.warn(warning, stacklevel=3)
    return found


def correct_points(
    xyz: npt.ArrayLike,
    cameras: Cameras | None,
    water: WaterSurface | float | npt.ArrayLike,
    *,
    options: RefractionOptions | None = None,
    views: Views | None = None,
    level_offset_m: npt.ArrayLike | None = None,
    adjusted_from: Cameras | None = None,
    regression: DepthRegression | None = None,
    **keywords: Any,
) -> Correction:
    """Correct apparent points for refraction at the water surface.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Apparent points, metres, world frame: the whole cloud, else set ``occlusion="off"``. Points
        above the water surface are returned bit for bit.
    cameras : Cameras or None
        Poses in the same frame; see `pcfix.read_cameras`. The methods factor and regression need
        none.
    water : WaterSurface, float, or array of shape (n,)
        The water surface (see `pcfix.read_water`), its level in metres, or its height above
        each point, NaN for land and where it is unknown.
    options : RefractionOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: index, method, max_angle (degrees
        from the surface normal), camera_set, matcher, depth_factor, sigma_image and the other
        standard deviations. With water_per_image, `water` still decides which points are submerged,
        and how deep.
    views : Views, optional
        The view list: the images that contributed to each point, as rows of `adjusted_from` if it
        is given, else of `cameras`. Default: as the option `camera_set` says.
    level_offset_m : array, shape (k,), optional
        Height of the water above `water` when each image was taken; see
        `pcfix.io.water.level_offsets`. Each ray is refracted at its own surface; `water` decides
        which points are submerged, and how deep. Default: zero.
    adjusted_from : Cameras, optional
        The original cameras, in the same frame, if `cameras` are the same images (matched by their
        labels) after an adjustment. All points are first transferred to the adjusted cameras; see
        `pcfix.adjust.transfer`.
    regression : DepthRegression, optional
        For the method regression; see `pcfix.refract.regression`.

    Returns
    -------
    Correction
        One row per input point, in the same order.

    Raises
    ------
    SettingError
        If an argument is outside its range, or a coordinate is not finite.
    GeometryError
        If a camera is below the water.

    Examples
    --------
    Two cameras 100 m above a bed that looks 2 m deep:

    >>> import numpy as np, pcfix
    >>> cameras = pcfix.Cameras(("a", "b"), np.array([[-20.0, 0, 100], [20.0, 0, 100]]))
    >>> result = pcfix.correct_points([[0.0, 0.0, -2.0]], cameras, 0.0)
    >>> result.xyz.round(3).tolist()
    [[0.0, 0.0, -2.703]]
    """
    given = taken(PointsOptions, options, keywords, "correct_points")
    xyz = checked_points(xyz)
    surface, heights = as_surface(water, len(xyz))
    asked = with_index(
        CorrectOptions(
            cameras=cameras or None, water=surface, adjusted_from=adjusted_from, **vars(given)
        )
    )
    if not cameras:
        asked.check_no_cameras()
        if views is not None or level_offset_m is not None:
            raise SettingError(
                "option.needs",
                "views and level_offset_m have no effect without cameras. Give both, or neither.",
                needs="cameras",
            )
    points = Points(xyz, heights, np.zeros(len(xyz), np.uint8), views=views)
    view = CloudView(
        "xyz", None, *corners(*xyz[:, :2].T), len(xyz), lambda water=None: iter([points])
    )
    blocks = read_blocks(asked.part(Inputs), view)
    if level_offset_m is not None:
        offset, k = np.ascontiguousarray(level_offset_m, dtype=np.float64), len(blocks.cameras)
        if offset.shape != (k,) or not np.isfinite(offset).all():
            sentence = f"level_offset_m must be {k} finite numbers, one per camera."
            raise SettingError("array.shape", sentence, shape=offset.shape)
        blocks = blocks._replace(level_offset_m=offset)
    if views is not None and cameras:
        _check_views(views, xyz, adjusted_from or cameras)
        blocks = blocks._replace(views=views)
    found, labelling = FoundSurface(surface), Labelling(LandRules())
    plan = plan_correction(plan_of(asked, view, blocks, found, labelling, regression))
    correction, tally = correct_chunk(plan, points, 0, covariances=True)
    if tally.water is not None:
        tally.water.check_reach("xyz", surface, deep=given.deep)
    _check_fit(plan, tally)
    for note in plan.input_notes:
        warnings.warn(note, stacklevel=2)
    return correction


def _check_views(views: Views, points: FloatArray, cameras: Cameras) -> None:
    """Refuse views that are no table of these points, and warn of points outside their images."""
    n, start, camera = len(points), views.start, views.camera
    is_table = len(start) == n + 1 and start[0] == 0 and start[-1] == len(camera)
    if not is_table or (np.diff(start) < 0).any():
        raise SettingError(
            "views.table",
            f"views must have {n + 1} starts that do not decrease, from 0 to the number of"
            " entries.",
        )
    if len(camera) and not 0 <= camera.min() <= camera.max() < len(cameras):
        raise SettingError(
            "views.camera", f"views name camera {camera.max()}, but there are {len(cameras)}."
        )
    counts = np.diff(views.start) - count_visible_cameras(points, cameras, views)
    if counts.any():
        entries, outside = int(counts.sum()), int(np.count_nonzero(counts))
        sentence = f"views: {entries:,} entries of {outside:,} points are ignored: their cameras"
        note = PcfixWarning("views.outside", f"{sentence} face elsewhere.", entries=entries)
        warnings.warn(note, stacklevel=3)
