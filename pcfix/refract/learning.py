"""What is learned of a block and the whole cloud before the first point is corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import BoolArray, Cameras, TiePoints, ViewKind
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Learned, Survey
from pcfix.refract.choice import spatial_order
from pcfix.refract.consistent import check_consistent
from pcfix.refract.fusion import likely_beds
from pcfix.refract.hypotheses import (
    ALIKE,
    BARE,
    IN_FRAME,
    LIMITS,
    Hint,
    Hypothesis,
    Verdict,
    hypotheses_of,
    told_by,
)
from pcfix.refract.matcher import Bed, bed_of, matcher_of, matcher_of_ties, places_for
from pcfix.refract.methods import batches, with_rays
from pcfix.refract.regression import DepthRegression
from pcfix.refract.top_surface import occluder_of, wants_occlusion
from pcfix.refract.weighing import weigh
from pcfix.water.surface import is_submerged


def check_method(settings: ScienceOptions, cameras: Cameras) -> None:
    """Refuse a method that these cameras are not enough for."""
    if settings.camera_set == "mvs" and (cameras.lenses is None or cameras.rotations is None):
        raise SettingError(
            "camera-set mvs needs the angles and the lens of each image: give --sensor, or a"
            " camera file that has them, or use --camera-set all."
        )
    if settings.method == "consistent":
        check_consistent(cameras)


def resolved(settings: ScienceOptions, cameras: Cameras, views: ViewKind | None) -> ScienceOptions:
    """Return options without ``auto`` where no points are needed to tell what it stands for."""
    if settings.method != "auto":
        return settings
    if cameras.lenses is None or cameras.rotations is None:
        return BARE.settings(settings)
    return settings if views is None else replace(settings, method="consistent")


def wants_sample(settings: ScienceOptions, cameras: Cameras, views: ViewKind | None) -> bool:
    """Return whether points of the whole cloud tell something of the correction."""
    return wants_matcher(settings, cameras, views) or _wants_limit(settings, views)


def _wants_limit(settings: ScienceOptions, views: ViewKind | None) -> bool:
    """Whether the largest incidence angle is to be told by the cloud."""
    return views is None and settings.max_angle == "auto" and settings.method in ALIKE


def _wants_comparison(settings: ScienceOptions, cameras: Cameras) -> bool:
    """Whether SigmaZ shall have how far the method is from the way that fits the cloud best."""
    told = settings.dimensions == "all" and settings.method != "regression"
    return told and cameras.lenses is not None and cameras.rotations is not None


def wants_matcher(settings: ScienceOptions, cameras: Cameras, views: ViewKind | None) -> bool:
    """Return whether the images' partners must be known, with views of a kind or without any."""
    compared = _wants_comparison(settings, cameras)
    if views is None:
        return settings.models_matcher or settings.method == "auto" or compared
    dense = views in ("depth-maps", "pair-images")
    return compared or (dense and settings.method == "consistent")


def learn_of_points(batch: Batch, regression: DepthRegression | None) -> Batch:
    """Return a batch, whose points, land too, are the whole cloud, with what is learned of it.

    Raises
    ------
    SettingError
        If the method lacks something that it cannot do without.
    """
    cameras, views = batch.survey.cameras, batch.views
    kind = None if views is None else views.kind
    settings = resolved(batch.survey.settings, cameras, kind)
    check_method(settings, cameras)
    if settings.method == "regression" and regression is None:
        raise SettingError("method regression needs a regression; fit one of check depths first.")
    occluder = None
    if settings.occlusion == "on" or (settings.occlusion == "auto" and views is None):
        occluder = occluder_of(batch.xyz) if wants_occlusion(cameras, settings) else None
    learned = Learned(regression=regression, occluder=occluder)
    batch = replace(batch, survey=replace(batch.survey, settings=settings, learned=learned))
    if not wants_sample(settings, cameras, kind):
        return batch
    survey, _ = learn_of_sample(batch, len(batch))
    return replace(batch, survey=survey)


def learn_of_sample(
    batch: Batch, points: int, ties: TiePoints | None = None, hint: Hint | None = None
) -> tuple[Survey, tuple[Verdict, ...]]:
    """Learn what ``auto`` stands for, how the images were matched, and the bed, as needed.

    Parameters
    ----------
    batch : Batch
        Points of the whole cloud, evenly spread, land too; the kind of their lists is what is said.
    points : int
        How many the cloud has.
    ties : TiePoints, optional
        Of the block that made the points; else the points tell what the images have in common.
    hint : Hint, optional
        What files say of how the cloud was made.

    Returns
    -------
    survey : Survey
        Without ``auto``.
    verdicts : tuple of Verdict
        Why, as far as something was to be told, and could be.
    """
    survey, step = batch.survey, points / max(len(batch), 1)
    kind = None if batch.views is None else batch.views.kind
    if wants_matcher(survey.settings, survey.cameras, kind):
        survey = _with_matcher(batch, ties)
    rows = np.flatnonzero(is_submerged(batch.xyz[:, 2], batch.surface))
    sample = replace(batch.take(rows), survey=survey)
    if batch.views is not None:
        verdict = weigh_lists(sample, is_open=False)
        return as_told(survey, verdict), () if verdict is None else (verdict,)
    survey, verdicts = _weighed(sample, step, hint)
    settings, learned = survey.settings, survey.learned
    if not settings.models_matcher:
        learned = learned._replace(matcher=None)
    elif settings.method == "consistent" and settings.matcher == "depth-maps" and len(rows):
        learned = learned._replace(bed=_learn_bed(replace(sample, survey=survey)))
    return replace(survey, learned=learned), verdicts


def _weighed(sample: Batch, step: float, hint: Hint | None) -> tuple[Survey, tuple[Verdict, ...]]:
    """Return the survey without ``auto``, and with the doubt of submerged points without lists."""
    survey = sample.survey
    hypotheses = hypotheses_of(sample)
    if survey.settings.method == "auto" and len(hypotheses) > 1:
        verdict = weigh(sample, hypotheses, step, hint=hint)
        survey = as_told(survey, verdict, hypotheses[0])
        return survey, () if verdict is None else (verdict,)
    if survey.settings.method == "auto":
        survey = as_told(survey, None, hypotheses[0])
    verdicts = list[Verdict | None]()
    if _wants_limit(survey.settings, None):
        verdicts.append(weigh(replace(sample, survey=survey), LIMITS, step))
        survey = as_told(survey, verdicts[0], LIMITS[0])
    if _wants_comparison(survey.settings, survey.cameras):
        told = told_by(replace(sample, survey=survey))
        verdicts.append(weigh(sample, IN_FRAME, step, told=told))
        survey = as_told(survey, verdicts[-1])
    return survey, tuple(one for one in verdicts if one is not None)


def as_told(survey: Survey, verdict: Verdict | None, else_as: Hypothesis | None = None) -> Survey:
    """Return a survey with the options, and the doubt, of what the cloud was taken for."""
    if verdict is None:
        given = survey.settings
        return survey if else_as is None else replace(survey, settings=else_as.settings(given))
    learned = survey.learned._replace(doubt=verdict.doubt)
    return replace(survey, settings=verdict.chosen.settings(survey.settings), learned=learned)


def _with_matcher(batch: Batch, ties: TiePoints | None) -> Survey:
    """Return the survey with how the images were matched."""
    survey = batch.survey
    places, matched = batch.made_with or (batch.xyz, survey.cameras)
    if ties is not None:
        matcher = matcher_of_ties(matched, ties)
    else:
        step = max(1, len(batch) // places_for(matched))
        matcher = matcher_of(matched, np.ascontiguousarray(places[::step]))
    return replace(survey, learned=survey.learned._replace(matcher=matcher))


def _learn_bed(batch: Batch) -> Bed | None:
    """Return the bed that fused points of a whole cloud have in common, of a sample of them.

    None where no image sees a point.
    """
    order = spatial_order(batch.xyz)
    likely = [likely_beds(with_rays(batch.take(rows))) for rows in batches(order)]
    most = max(part.shape[1] for part in likely)
    table = np.full((len(batch), most), np.nan, np.float32)
    done = 0
    for part in likely:
        table[done : done + len(part), : part.shape[1]] = part
        done += len(part)
    return bed_of(batch.xyz[order], table) if np.isfinite(table).any() else None


FLAT_DEG = 35.0
"""Rays beyond this are those by which methods differ most; see `hypotheses.LIMITS`."""


def seen_flat(batch: Batch) -> BoolArray:
    """Return which points have rays, and those beyond `FLAT_DEG` from the normal alone."""
    with_views = with_rays(batch)
    return (with_views.counts > 0) & (with_views.steepest_deg() > FLAT_DEG)


def weigh_lists(batch: Batch, *, is_open: bool) -> Verdict | None:
    """Tell what the lists of submerged points list, or what the given way leaves open.

    None where there are too few points, or nothing is to be told.
    """
    settings = batch.survey.settings
    if is_open and settings.method == "consistent":
        return weigh(batch, hypotheses_of(batch), 1.0)
    if not _wants_comparison(settings, batch.survey.cameras):
        return None
    return weigh(batch, hypotheses_of(batch), 1.0, told=told_by(batch))
