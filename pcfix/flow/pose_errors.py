"""What the errors of an adjustment do to a corrected bed: a sample corrected with its members.

What stays is what the images showed: each member's cameras intersect the image places of the
points anew, whether the cloud came from cameras before the adjustment or from the adjusted ones.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.adjust.carry import Carrying, Pair
from pcfix.errors import InputError, PcfixWarning
from pcfix.flow.old_cameras import ListedViews
from pcfix.flow.surfaces import Points
from pcfix.io.members import find_members
from pcfix.model import NOISE_CLASSES, Cameras, FloatArray, IntArray, Outcome, Views
from pcfix.options.declare import File
from pcfix.refract.batch import Batch, OriginalModel, Survey
from pcfix.refract.methods import correct
from pcfix.refract.pose_errors import PoseErrors, pose_errors_of
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from pcfix.adjust.members import Members

SAMPLE_POINTS, BED_POINTS = 20_000, 1000
"""Of the cloud, and at most about so many of those under water: the errors are smooth."""


class Adjustment(NamedTuple):
    """The members of an adjustment, and the row in them of each camera."""

    members: Members
    row: IntArray


def adjustment_of(path: File | Cameras, cameras: Cameras) -> tuple[Adjustment | None, str]:
    """Return the adjustment that cameras came from, where it stands beside them, and a note."""
    if isinstance(path, Cameras):
        return None, ""
    try:
        found = find_members(path)
    except InputError as error:
        return None, str(error)
    if found is None:
        return None, ""
    where, members = found
    row = members.rows_of(cameras)
    if row is None:
        return None, (
            f"{where}: is of other cameras than these, so SigmaZ goes without the errors of an"
            " adjustment; take the cameras that the adjustment wrote, or take the file away."
        )
    return Adjustment(members, row), ""


class Sample(NamedTuple):
    """Points as they came, and their views as they were listed."""

    points: Points
    listed: Views | None

    def take(self, rows: IntArray) -> Sample:
        """Return some of the points."""
        listed = None if self.listed is None else self.listed.take(rows)
        return Sample(self.points.take(rows), listed)


def sample_of(chunks: Iterable[Points], views: ListedViews, step: int) -> Sample:
    """Return every so manieth point of a cloud, without noise."""
    listed, row, parts = views.all_anew(), 0, list[Sample]()
    for points in chunks:
        seen = listed(points.xyz, row)
        rows = np.arange(-row % step, len(points.xyz), step)
        rows = rows[~np.isin(points.classes[rows], NOISE_CLASSES)]
        parts.append(Sample(points, seen).take(rows))
        row += len(points.xyz)
    return _joined(parts)


def _joined(parts: list[Sample]) -> Sample:
    """Return samples that follow each other as one; the weights of views do not count here."""
    points, listed = [part.points for part in parts], [part.listed for part in parts]
    heights = [one.heights for one in points if one.heights is not None]
    sources = [one.sources for one in points if one.sources is not None]
    known = [one for one in listed if one is not None]
    counts = [np.diff(one.start) for one in known]
    return Sample(
        Points(
            np.vstack([one.xyz for one in points]),
            np.concatenate(heights) if heights else None,
            np.concatenate([one.classes for one in points]),
            np.concatenate(sources) if sources else None,
        ),
        Views(
            np.cumsum(np.concatenate([[0], *counts])),
            np.concatenate([one.camera for one in known]),
            kind=known[0].kind,
        )
        if known
        else None,
    )


def pose_errors(
    sample: Sample, survey: Survey, adjustment: Adjustment, pair: Pair | None
) -> PoseErrors | None:
    """Return what the errors of the poses come to; None where nothing of the sample is corrected.

    Parameters
    ----------
    sample : Sample
    survey : Survey
        With all that was learned.
    adjustment : Adjustment
    pair : Pair or None
        The cameras that the cloud was made with, where these are not those of the survey.
    """
    made = pair or Pair(survey.cameras, survey.cameras, np.arange(len(survey.cameras)), ())
    step = Carrying(made).step(sample.points.xyz, sample.listed)
    above = surface_above(survey.water, step.xyz, sample.points.heights)
    wet = np.flatnonzero(is_submerged(step.xyz[:, 2], above) & step.carried)
    wet = wet[:: 1 + len(wet) // BED_POINTS]
    variance_m2 = variances(sample.take(wet), survey, adjustment, made)
    known = np.flatnonzero(np.isfinite(variance_m2))
    if not len(known):
        return None
    return pose_errors_of(step.xyz[wet[known], :2], variance_m2[known])


def variances(sample: Sample, survey: Survey, adjustment: Adjustment, made: Pair) -> FloatArray:
    """Return the variance of the heights of a sample by the poses, shape (n,); NaN if unknown."""
    members, row = adjustment
    with warnings.catch_warnings():  # the correction itself says it
        warnings.simplefilter("ignore", PcfixWarning)
        nominal = _heights(sample, survey, made)
        others = (_survey_of(survey, members, i, row) for i in range(len(members)))
        off = [_heights(sample, one, made) - nominal for one in others]
    return np.asarray(np.square(off).mean(axis=0))


def _survey_of(survey: Survey, members: Members, member: int, row: IntArray) -> Survey:
    """Return a survey with cameras and water of a member."""
    cameras = members.cameras(member, survey.cameras, row)
    water = members.surface(member, survey.water, survey.cameras)
    index = survey.settings.refractive_index + float(members.water[member, 3])

    def moved(one: Survey) -> Survey:
        settings = replace(one.settings, index=index)
        return replace(one, cameras=cameras, water=water, settings=settings)

    return replace(moved(survey), parts={key: moved(one) for key, one in survey.parts.items()})


def _heights(sample: Sample, survey: Survey, made: Pair) -> FloatArray:
    """Return the true heights of a sample, shape (n,), NaN where it cannot be told."""
    (xyz, heights, _, sources, _), listed = sample
    step = Carrying(replace(made, new=survey.cameras)).step(xyz, listed)
    above = surface_above(survey.water, step.xyz, heights)
    found = correct(
        Batch(step.xyz, above, survey, step.views, OriginalModel(xyz, made.old), source=sources)
    )
    known = step.carried & (found.outcome == Outcome.CORRECTED)
    return np.where(known, step.xyz[:, 2] + found.shift_m[:, 2], np.nan)


def with_poses(survey: Survey, poses: PoseErrors | None) -> Survey:
    """Return a survey that knows of the errors of its poses, in all its parts."""
    parts = {key: with_poses(one, poses) for key, one in survey.parts.items()}
    return replace(survey, learned=survey.learned._replace(poses=poses), parts=parts)
