"""Errors of a corrected bed by the errors of an adjustment: a sample is corrected with each member.

The images do not change: the cameras of each member intersect the images of the points again,
whether the cloud is of the original or of the adjusted cameras.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.transfer import CloudTransfer
from pcfix.errors import PcfixWarning, bad_file
from pcfix.flow.surfaces import Points
from pcfix.io.files import find_members
from pcfix.model import NOISE_CLASSES, Cameras, FloatArray, Outcome
from pcfix.options.declare import File
from pcfix.refract.batch import Batch, OriginalModel, PoseErrors, Survey
from pcfix.refract.methods import correct
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from pcfix.adjust.precision import Members

SAMPLE_POINTS, BED_POINTS = 20_000, 1000
"""Points that are sampled from the cloud, and points under water that are corrected with each
member; a thousand is enough, as the errors are smooth."""


def members_of(path: File | Cameras, cameras: Cameras) -> Members | None:
    """Return the members of the adjustment in the folder of its cameras, if there are any.

    Raises InputError if they are damaged, or of other cameras.
    """
    found = None if isinstance(path, Cameras) else find_members(path)
    if found is None:
        return None
    where, members = found
    aligned = members.aligned(cameras)
    if aligned is None:
        sentence = "belongs to other cameras, so SigmaZ does not include errors of the poses. Use"
        sentence += " the cameras that the adjustment wrote, or remove the file."
        raise bad_file(where, "cameras.poses", sentence)
    return aligned


def pose_errors(
    sample: Points, survey: Survey, members: Members, transfer: CloudTransfer | None
) -> PoseErrors | None:
    """Return the errors of the bed by those of the poses; None if no point is corrected.

    The sample are apparent points, with their views if there is a view list. The members are of
    the adjustment of the survey's cameras, in their order, and `transfer` has the original cameras,
    if those of the survey were adjusted since.
    """
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
    return pose_errors_of(step.xyz[rows[known], :2], variance_m2[known]) if known.any() else None


POINTS_A_CELL, FEWEST = 12, 4


def pose_errors_of(xy: FloatArray, variance_m2: FloatArray) -> PoseErrors:
    """Return the errors over a bed from variances at n places of it, shapes (n, 2) and (n,).

    A cell has the median of its points: a few of them jump, as a camera comes into their reach or
    leaves it. One of too few points has that of the nearest which has enough.
    """
    from scipy.ndimage import distance_transform_edt
    from scipy.stats import binned_statistic_2d

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
    sample: Points, survey: Survey, members: Members, transfer: CloudTransfer
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


def _survey_of(survey: Survey, members: Members, member: int) -> Survey:
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
