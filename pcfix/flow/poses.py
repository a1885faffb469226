"""Poses of a correction: refraction that they absorbed, and the errors that they add to the bed.

The errors of the bed are those of a sample that is corrected with each member of an adjustment. The
images do not change: the cameras of each member intersect the images of the points again, whether
the cloud is of the original or of the adjusted cameras.
"""

import shlex
import warnings
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.diagnosis import EXPORT, MOST_STATED_M, Diagnosis, diagnosed, neighbours_sign
from pcfix.adjust.transfer import CloudTransfer
from pcfix.errors import InputError, PcfixError, PcfixWarning
from pcfix.flow.inputs import Inputs
from pcfix.flow.surfaces import CloudView, Points
from pcfix.io.ground_control import gnss_in_frame_of, read_ground_control
from pcfix.model import (
    NOISE_CLASSES,
    Cameras,
    FloatArray,
    GnssPositions,
    Outcome,
    TiePoints,
    WaterSurface,
)
from pcfix.options.declare import File, OptionSet, options_of
from pcfix.options.shared import (
    DEFAULT_REFRACTIVE_INDEX,
    CameraFileOptions,
    MaskOption,
    ViewOptions,
    WaterOptions,
)
from pcfix.refract.batch import Batch, OriginalModel, PoseErrors, Survey
from pcfix.refract.methods import correct
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from pcfix.adjust.precision import Members
    from pcfix.flow.correction import Plan

LEAST_POSITIONS = 3  # GNSS positions that determine position, orientation and scale of a block
QUICK_BYTES = 25_000_000  # size of a model that is read in a second or two, even if nobody asked


def diagnose_inputs(
    inputs: Inputs, cameras: Cameras, view: CloudView, water: WaterSurface, index: float, *,
    gcps: Any = None, reference: Any = None, in_passing: bool = False,
) -> Diagnosis:  # fmt: skip
    """Look for signs in a cloud, its cameras with their tie points, and surveys, if given."""
    control = None if gcps is None else read_ground_control(gcps, cameras)
    return diagnosed(
        cameras, water, index, view, ties=inputs.tie_points(view.crs), control=control,
        gnss=_gnss_of(cameras, str(inputs.cameras)), reference=reference, in_passing=in_passing,
    )  # fmt: skip


def _gnss_of(cameras: Cameras, name: str) -> GnssPositions | None:
    """Return the GNSS positions in the frame of the cameras; None if they cannot be compared."""
    try:
        return None if cameras.gnss is None else gnss_in_frame_of(cameras, name)[0]
    except InputError:
        return None


def diagnose_in_passing(
    plan: "Plan", ties: TiePoints | None
) -> tuple[dict[str, Any], PcfixWarning | None]:
    """Check the poses with what a correction has read anyway; warn if they absorbed refraction.

    The ties are `quick_ties`. Returns for the summary whether the poses absorbed it (None if
    unknown), that as a line, and the signs; and the warning.
    """
    inputs, cameras, n = plan.inputs, plan.cameras, plan.options.refractive_index

    def poses(words: str, absorbed: bool | None = None, signs: Any = ()) -> dict[str, Any]:
        return {"absorbed": absorbed, "words": words, "signs": list(signs)}

    if not len(cameras):
        return poses("not applicable: no cameras were given"), None
    if inputs.adjusted_from is not None:
        return poses("adjusted with refraction (--adjusted-from)", absorbed=False), None
    name = "cameras" if isinstance(inputs.cameras, Cameras) else str(inputs.cameras)
    neighbours = None
    for verdict in plan.verdicts:  # the last one that was compared with straight rays counts
        if verdict.straight is not None:
            neighbours = neighbours_sign(*verdict.straight, is_fused=verdict.is_fused)
    try:
        found = diagnosed(
            cameras, plan.found.surface, n, plan.view, ties=ties, gnss=_gnss_of(cameras, name),
            neighbours=neighbours, in_passing=True,
        )  # fmt: skip
    except (PcfixError, OSError) as error:  # this check stops no correction
        return poses(f"not checked for absorbed refraction: {error}"), None
    signs = found.as_dict()["signs"]
    if found.decided_by is None:
        words = "not checked for absorbed refraction: no tie points or GNSS positions of the file"
        return poses(f"{words} show it quickly; {EXPORT}", None, signs), None
    have = "have" if found.absorbed else "have not"
    words = f"{have} absorbed the refraction, as {found.decided_by.name} show"
    if not found.absorbed:
        return poses(words, found.absorbed, signs), None
    command = adjust_words(
        inputs, plan.view.name, has_datum=has_datum(cameras, name),
        index=None if n == DEFAULT_REFRACTIVE_INDEX else n,
    )  # fmt: skip
    likely = {} if found.likely_error_m is None else {"likely_error_m": found.likely_error_m}
    warning = PcfixWarning("poses.absorbed", found.sentence(command), command=command, **likely)
    warnings.warn(warning, stacklevel=3)
    return poses(f"{words}; see the warning", found.absorbed, signs), warning


def quick_ties(inputs: Inputs, crs: Any) -> TiePoints | None:
    """Return the tie points of the camera file if they are read within a second or two."""
    if isinstance(inputs.cameras, Cameras) or inputs.cameras is None:
        return None
    path = Path(inputs.cameras)
    folder = path.with_suffix(".files") if path.suffix == ".psx" else path
    try:
        files = [one for one in folder.rglob("*") if one.is_file()] if folder.is_dir() else [path]
        is_quick = sum(one.stat().st_size for one in files) <= QUICK_BYTES
        return inputs.tie_points(crs) if is_quick else None
    except (PcfixError, OSError):  # this check stops no correction
        return None


def has_datum(cameras: Cameras, name: str) -> bool:
    """Return whether the camera file has GNSS positions that are good enough as a datum."""
    found = _gnss_of(cameras, name)
    known = np.zeros(0) if found is None else np.isfinite(found.xyz).all(axis=1)
    if found is None or known.sum() < LEAST_POSITIONS:
        return False
    off = (cameras.centres - found.xyz)[known]
    spread = 1.4826 * np.median(np.abs(off - np.median(off, axis=0)))
    stated = found.sigma_m[known]
    return bool(np.median(np.where(np.isfinite(stated), stated, spread)) <= MOST_STATED_M)


# Commands that pcfix recommends; a file that was not given has a name in capitals


def adjust_words(
    inputs: Inputs, cloud: str, *, has_datum: bool, **more: File | float | None
) -> str:
    """Return the command that corrects the poses.

    Without a datum it asks for GNSS positions; `more` are options of an adjustment only.
    """
    model = "MODEL" if isinstance(inputs.cameras, Cameras) else str(inputs.cameras)
    words = ["pcfix", "adjust", model, "OUT", "--water", water_word(inputs.water), "--cloud", cloud]
    words += flags_of(inputs)
    if not (has_datum or more.get("gcps") or more.get("gnss")):
        more["gnss"] = "GNSS.csv"
    for name, value in more.items():
        words += [] if value is None else [f"--{name}", str(value)]
    return shlex.join(words)


def water_word(given: Any) -> str:
    """Return the given water, or SPEC if an adjustment cannot use it."""
    known = isinstance(given, str | PathLike | float | int)
    return f"{given}" if known and not str(given).startswith("dim:") else "SPEC"


def flags_of(given: OptionSet) -> list[str]:
    """Return the options that `pcfix correct` and `pcfix adjust` have in common, as given."""
    words = []
    for kind in (WaterOptions, CameraFileOptions, ViewOptions, MaskOption):
        for one in options_of(kind):
            value = getattr(given, one.name, one.default)
            if isinstance(value, tuple):  # numbers
                value = ",".join(f"{number:.15g}" for number in value)
            words += [] if value == one.default else [one.flag, str(value)]
    return words


# Errors of the bed by those of adjusted poses


# Points that are sampled from the cloud, and points under water that are corrected with each
# member; a thousand is enough, as the errors are smooth.
SAMPLE_POINTS, BED_POINTS = 20_000, 1000
POINTS_A_CELL, FEWEST = 12, 4  # of the bed, on average, and at least


def pose_errors(
    sample: Points, survey: Survey, members: "Members", transfer: CloudTransfer | None
) -> PoseErrors | None:
    """Return the errors of the bed by those of the poses; None if no point is corrected.

    The sample are apparent points, with their views if there is a view list. The members are of
    the adjustment of the survey's cameras, in their order, and `transfer` has the original cameras,
    if those of the survey were adjusted since.
    """
    from scipy.ndimage import distance_transform_edt
    from scipy.stats import binned_statistic_2d

    if transfer is None:
        cameras = survey.cameras
        transfer = CloudTransfer(cameras, cameras, np.arange(len(cameras)))
    step = transfer.step(sample.xyz, sample.views)
    above = surface_above(survey.water, step.xyz, sample.heights)
    wet = is_submerged(step.xyz[:, 2], above) & step.moved & ~np.isin(sample.classes, NOISE_CLASSES)
    rows = np.flatnonzero(wet)
    rows = rows[:: 1 + len(rows) // BED_POINTS]
    variance_m2 = variances(sample.take(rows), survey, members, transfer)
    known = np.isfinite(variance_m2)
    if not known.any():
        return None
    # Over the bed, a cell has the median of its points: a few of them jump, as a camera comes into
    # their reach or leaves it. One of too few points has that of the nearest which has enough.
    xy, variance_m2 = step.xyz[rows[known], :2], variance_m2[known]
    low = xy.min(axis=0)
    size = np.maximum(np.ptp(xy, axis=0), 1e-3)
    cell_m = float(np.sqrt(size.prod() * POINTS_A_CELL / len(xy)))
    shape = np.ceil(size / cell_m).astype(int)
    place = np.minimum(((xy - low) / cell_m).astype(int), shape - 1)
    bins: Any = [np.arange(count + 1) for count in shape]
    x, y = place.T
    variance = binned_statistic_2d(x, y, variance_m2, "median", bins).statistic
    count = binned_statistic_2d(x, y, variance_m2, "count", bins).statistic
    variance[count < min(FEWEST, count.max())] = np.nan
    unknown = np.isnan(variance)
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    variance = variance[tuple(nearest)]
    middle_m = float(np.sqrt(np.average(variance[place[:, 0], place[:, 1]])))
    return PoseErrors(low, cell_m, np.sqrt(variance), middle_m)


def variances(
    sample: Points, survey: Survey, members: "Members", transfer: CloudTransfer
) -> FloatArray:
    """Return the variance of the heights of a sample by the poses, shape (n,); NaN if unknown."""

    def heights(survey: Survey) -> FloatArray:
        """Return the corrected heights with the cameras of a survey, NaN for uncorrected points."""
        step = replace(transfer, adjusted=survey.cameras).step(sample.xyz, sample.views)
        above = surface_above(survey.water, step.xyz, sample.heights)
        original = OriginalModel(sample.xyz, transfer.original)
        found = correct(Batch(step.xyz, above, survey, step.views, original))
        known = step.moved & (found.outcome == Outcome.CORRECTED)
        return np.where(known, step.xyz[:, 2] + found.shift_m[:, 2], np.nan)

    with warnings.catch_warnings(action="ignore", category=PcfixWarning):  # shown by the correction
        nominal = heights(survey)
        off = [heights(_survey_of(survey, members, i)) - nominal for i in range(len(members))]
    return np.asarray(np.square(off).mean(axis=0))


def _survey_of(survey: Survey, members: "Members", member: int) -> Survey:
    """Return a survey with cameras and water of a member, for points without a view list too."""
    bare = survey.unlisted
    index = survey.settings.refractive_index + float(members.water[member, 3])
    return replace(
        survey,
        cameras=members.cameras(member, survey.cameras),
        water=members.surface(member, survey.water, survey.cameras),
        settings=replace(survey.settings, index=index),
        unlisted=None if bare is None else _survey_of(bare, members, member),
    )


def with_poses(survey: Survey, poses: PoseErrors | None) -> Survey:
    """Return a survey with the errors of its poses, for points without a view list too."""
    bare = None if survey.unlisted is None else with_poses(survey.unlisted, poses)
    return replace(survey, learned=survey.learned._replace(poses=poses), unlisted=bare)
