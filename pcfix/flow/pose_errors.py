"""Errors of a corrected bed by the errors of an adjustment: a sample is corrected with each member.

The images do not change: the cameras of each member intersect the images of the points again,
whether the original or the adjusted cameras made the cloud.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.adjust.transfer import CloudTransfer
from pcfix.errors import InputError, PcfixWarning
from pcfix.flow.surfaces import Points, joined_points
from pcfix.io.members import find_members
from pcfix.model import NOISE_CLASSES, Cameras, FloatArray, IntArray, Outcome, Views
from pcfix.options.declare import File
from pcfix.refract.batch import Batch, OriginalModel, Survey
from pcfix.refract.methods import correct
from pcfix.refract.pose_errors import PoseErrors, pose_errors_of
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from pcfix.adjust.precision import Members
    from pcfix.io.views import ViewMatch

SAMPLE_POINTS, BED_POINTS = 20_000, 1000
"""Of the cloud, and of its points under water; a thousand is enough, as the errors are smooth."""


def members_of(path: File | Cameras, cameras: Cameras) -> tuple[Members | None, str]:
    """Return the members of the adjustment in the folder of its cameras, and a note if unusable."""
    if isinstance(path, Cameras):
        return None, ""
    try:
        found = find_members(path)
    except InputError as error:
        return None, str(error)
    if found is None:
        return None, ""
    where, members = found
    aligned = members.aligned(cameras)
    if aligned is None:
        return None, (
            f"{where}: belongs to other cameras, so SigmaZ does not include errors of the poses."
            " Use the cameras that the adjustment wrote, or remove the file."
        )
    return aligned, ""


class Sample(NamedTuple):
    """Apparent points, and their view list."""

    points: Points
    listed: Views | None

    def take(self, rows: IntArray) -> Sample:
        """Return some of the points."""
        listed = None if self.listed is None else self.listed.take(rows)
        return Sample(self.points.take(rows), listed)


def sample_of(chunks: Iterable[Points], match: ViewMatch | None, step: int) -> Sample:
    """Return every `step`-th point of a cloud, without noise, and without weights of its views."""
    row, points, views = 0, list[Points](), list[Views]()
    for one in chunks:
        rows = np.arange(-row % step, len(one.xyz), step)
        rows = rows[~np.isin(one.classes[rows], NOISE_CLASSES)]
        points.append(one.take(rows))
        if match is not None:
            views.append(match.views_of(one.xyz, row)[0].take(rows))
        row += len(one.xyz)
    if not views:
        return Sample(joined_points(points), None)
    counts = [np.diff(one.start) for one in views]
    start = np.cumsum(np.concatenate([[0], *counts]))
    listed = Views(start, np.concatenate([one.camera for one in views]), kind=views[0].kind)
    return Sample(joined_points(points), listed)


def pose_errors(
    sample: Sample, survey: Survey, members: Members, transfer: CloudTransfer | None
) -> PoseErrors | None:
    """Return the errors of the bed by those of the poses; None if no point is corrected.

    Parameters
    ----------
    sample : Sample
    survey : Survey
        With everything that was estimated.
    members : Members
        Of the adjustment of the survey's cameras, in their order.
    transfer : CloudTransfer or None
        The original cameras, if those of the survey were adjusted since.
    """
    k = len(survey.cameras)
    transfer = transfer or CloudTransfer(survey.cameras, survey.cameras, np.arange(k), ())
    step = transfer.step(sample.points.xyz, sample.listed)
    above = surface_above(survey.water, step.xyz, sample.points.heights)
    wet = np.flatnonzero(is_submerged(step.xyz[:, 2], above) & step.moved)
    wet = wet[:: 1 + len(wet) // BED_POINTS]
    variance_m2 = variances(sample.take(wet), survey, members, transfer)
    known = np.flatnonzero(np.isfinite(variance_m2))
    if not len(known):
        return None
    return pose_errors_of(step.xyz[wet[known], :2], variance_m2[known])


def variances(
    sample: Sample, survey: Survey, members: Members, transfer: CloudTransfer
) -> FloatArray:
    """Return the variance of the heights of a sample by the poses, shape (n,); NaN if unknown."""
    with warnings.catch_warnings():  # the correction shows them
        warnings.simplefilter("ignore", PcfixWarning)
        nominal = _heights(sample, survey, transfer)
        off = [
            _heights(sample, _survey_of(survey, members, member), transfer) - nominal
            for member in range(len(members))
        ]
    return np.asarray(np.square(off).mean(axis=0))


def _survey_of(survey: Survey, members: Members, member: int) -> Survey:
    """Return a survey with cameras and water of a member."""
    cameras = members.cameras(member, survey.cameras)
    water = members.surface(member, survey.water, survey.cameras)
    index = survey.settings.refractive_index + float(members.water[member, 3])

    def moved(one: Survey) -> Survey:
        settings = replace(one.settings, index=index)
        return replace(one, cameras=cameras, water=water, settings=settings)

    return replace(moved(survey), parts={key: moved(one) for key, one in survey.parts.items()})


def _heights(sample: Sample, survey: Survey, transfer: CloudTransfer) -> FloatArray:
    """Return the corrected heights of a sample, shape (n,), NaN for uncorrected points."""
    xyz, heights, sources = sample.points.xyz, sample.points.heights, sample.points.sources
    step = replace(transfer, adjusted=survey.cameras).step(xyz, sample.listed)
    above = surface_above(survey.water, step.xyz, heights)
    found = correct(
        Batch(
            step.xyz,
            above,
            survey,
            step.views,
            OriginalModel(xyz, transfer.original),
            source=sources,
        )
    )
    known = step.moved & (found.outcome == Outcome.CORRECTED)
    return np.where(known, step.xyz[:, 2] + found.shift_m[:, 2], np.nan)


def with_poses(survey: Survey, poses: PoseErrors | None) -> Survey:
    """Return a survey with the errors of its poses, in all its parts."""
    parts = {key: with_poses(one, poses) for key, one in survey.parts.items()}
    return replace(survey, learned=survey.learned._replace(poses=poses), parts=parts)
