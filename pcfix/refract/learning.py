"""Estimate everything that a correction needs to know about the block and the whole cloud."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import Cameras, TiePoints, ViewKind
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import ALIKE, FLAT_DEG, Batch, Survey, require_orientation
from pcfix.refract.methods import bed_around, on_land
from pcfix.refract.reconstructions import (
    IN_FRAME,
    LIMITS,
    Hint,
    Verdict,
    reconstructions_of,
    type_given,
    weigh,
)
from pcfix.water.surface import is_submerged

if TYPE_CHECKING:
    from pcfix.refract.literature import StereoFactor


def resolved(
    settings: ScienceOptions, cameras: Cameras, views: ViewKind | None, *, own_water: bool = False
) -> ScienceOptions:
    """Replace the method ``auto`` if that needs no points, and check that the cameras suffice.

    With `own_water` single images have their own water surfaces, which few methods allow. Raises
    SettingError if the method needs an orientation that the cameras lack.
    """
    bare, method = cameras.lenses is None or cameras.rotations is None, settings.method
    if own_water:
        dense = settings.camera_set == "mvs" or views not in (None, "tracks")
        if method == "auto":
            method = "snell" if bare or dense else "consistent"
        if method not in ("snell", "consistent") or (method == "consistent" and dense):
            raise SettingError(
                "method.own_water",
                f"Method {method} needs one water surface for all images"
                f"{' if the cloud is dense' if dense else ''}. Use method snell, or omit"
                " water-per-image.",
                method=method,
            )
        camera_set = "all" if settings.camera_set == "auto" else settings.camera_set
        settings = replace(settings, method=method, camera_set=camera_set)
    elif method == "auto" and bare:
        # tracks, as dense matchers cannot be modelled
        settings = replace(settings, method="snell", camera_set="all", depth_factor=None)
    elif method == "auto" and views is not None:
        settings = replace(settings, method="consistent")
    if settings.camera_set == "mvs":
        require_orientation(cameras, "camera-set mvs")
    if settings.method == "consistent":
        require_orientation(cameras, "Method consistent", "use method snell")
    if settings.depth_factor == "auto":
        require_orientation(cameras, "depth-factor auto")
    return settings


def wants_sample(survey: Survey, views: ViewKind | None) -> bool:
    """Return whether a sample of the whole cloud is needed, with a kind of view list or none."""
    settings = survey.settings
    if settings.depth_factor == "auto" or _wants_comparison(survey):
        return True
    if views is None:
        return _wants_matcher(survey) or _wants_limit(settings)
    return views in ("depth-maps", "pairs") and settings.method == "consistent"


def with_factor(batch: Batch) -> "tuple[Batch, StereoFactor | None]":
    """Replace the depth factor ``auto`` by a number; return the batch and the factor found."""
    survey = batch.survey
    if survey.settings.depth_factor != "auto":
        return batch, None
    from pcfix.refract.literature import stereo_factor

    known = batch.surface.height_m[np.isfinite(batch.surface.height_m)]
    found = None
    if len(known):  # else no point is submerged, which is an error elsewhere
        n = survey.settings.refractive_index
        found = stereo_factor(survey.cameras, float(np.median(known)), n)
    settings = replace(survey.settings, depth_factor=None if found is None else found.factor)
    return replace(batch, survey=replace(survey, settings=settings)), found


# Largest share of the discontinuities that a limit may leave. On simulated tracks with obliques,
# where a limit doubles the errors, it leaves 0.28; where it more than halves them, on a rendered
# block with obliques, 0.15 to 0.2; on a real river, whose depths it makes plausible, 0.02 to 0.12.
STRONG = 0.25


def _wants_limit(settings: ScienceOptions) -> bool:
    """Whether the largest incidence angle is to be estimated from the cloud."""
    return settings.max_angle == "auto" and settings.method in ALIKE


def _wants_comparison(survey: Survey) -> bool:
    """Whether SigmaZ includes the difference to the reconstruction that fits the cloud best.

    That needs one water surface.
    """
    settings, cameras = survey.settings, survey.cameras
    wanted = settings.dimensions == "all" and settings.method != "regression"
    oriented = cameras.lenses is not None and cameras.rotations is not None
    return wanted and oriented and survey.own_water is None


def _wants_matcher(survey: Survey) -> bool:
    """Whether the partners of the images are needed, without a view list."""
    settings = survey.settings
    return settings.models_matcher or settings.method == "auto" or _wants_comparison(survey)


def learn_of_sample(
    batch: Batch, ties: TiePoints | None = None, hint: Hint | None = None, near: Batch | None = None
) -> tuple[Survey, tuple[Verdict, ...]]:
    """Resolve ``auto`` and estimate the partners of the images and the bed, as needed.

    The batch are points of the whole cloud, evenly spread, with land and without view lists.
    `ties` are tie points of the original model; by default the points show which images overlap.
    `hint` is the type that the software is known for, `near` are submerged points with their
    neighbours for the detection of the type, if those of the batch are too far apart. Returns the
    survey without ``auto`` and the verdicts.
    """
    survey = batch.survey
    if _wants_matcher(survey):
        survey = with_matcher(batch, ties)
    sample = replace(submerged_of(batch), survey=survey)
    of_type = sample if near is None else replace(near, survey=survey)
    survey, verdicts = _weighed(of_type, hint)
    settings, learned = survey.settings, survey.learned
    if batch.original_model is not None:
        # land has the reconstruction type of the cloud, also where a formula corrects the bed
        land = on_land(survey)
        for one in verdicts:
            if one.is_given and one.is_against:
                land = replace(land, settings=one.runner_up.settings(land.settings))
        if not land.settings.models_matcher:
            land = replace(land, learned=land.learned._replace(matcher=None))
        learned = learned._replace(land=land)
    if not settings.models_matcher:
        learned = learned._replace(matcher=None)
    elif settings.chooses_maps and len(sample):
        learned = learned._replace(bed=bed_around(replace(sample, survey=survey)))
    return replace(survey, learned=learned), verdicts


def submerged_of(batch: Batch) -> Batch:
    """Return the submerged points of a batch."""
    return batch.take(np.flatnonzero(is_submerged(batch.xyz[:, 2], batch.surface)))


def _weighed(sample: Batch, hint: Hint | None) -> tuple[Survey, tuple[Verdict, ...]]:
    """Resolve ``auto`` and set the model uncertainty, for submerged points without lists."""
    survey, verdicts = sample.survey, list[Verdict | None]()
    if survey.settings.method == "auto":
        types = reconstructions_of(sample)
        verdicts.append(weigh(sample, types, hint=hint))
        # without evidence the first type is assumed
        survey = replace(survey, settings=types[0].settings(survey.settings))
        survey = with_verdict(survey, verdicts[0])
        if len(types) > 1:
            return survey, tuple(filter(None, verdicts))
    if _wants_limit(survey.settings):
        # which rays were used in the reconstruction does not depend on the formula: test by snell
        sample = replace(sample, survey=survey)
        limit = weigh(sample, LIMITS)
        most = 0.0 if limit is None else min(STRONG, 0.5 - 2.0 * limit.sigma)
        if limit is not None and limit.chosen == LIMITS[1] and limit.share <= most:
            survey = replace(survey, learned=survey.learned._replace(limit_deg=FLAT_DEG))
            verdicts.append(limit)
        elif survey.settings.dimensions == "all" and not _wants_comparison(survey):
            # no reconstruction types are compared: the uncertainty is that of the rays
            free = weigh(sample, LIMITS, given=LIMITS[0])
            if free is not None:
                learned = survey.learned._replace(model_uncertainty=free.model_uncertainty)
                survey = replace(survey, learned=learned)
    if _wants_comparison(survey):
        sample = replace(sample, survey=survey)
        verdicts.append(weigh(sample, IN_FRAME, given=type_given(sample)))
        survey = with_verdict(survey, verdicts[-1])
    return survey, tuple(filter(None, verdicts))


def with_verdict(survey: Survey, verdict: Verdict | None) -> Survey:
    """Return a survey with the options and the model uncertainty of a verdict."""
    if verdict is None:
        return survey
    learned = survey.learned._replace(model_uncertainty=verdict.model_uncertainty)
    return replace(survey, settings=verdict.chosen.settings(survey.settings), learned=learned)


LEAST_PLACES, PLACES_AN_IMAGE = 4000, 10  # that show which images overlap


def with_matcher(batch: Batch, ties: TiePoints | None) -> Survey:
    """Return the survey with the predicted partners of the images."""
    from pcfix.refract.matcher import matcher_of, matcher_of_ties

    survey = batch.survey
    places, matched = batch.original_model or (batch.xyz, survey.cameras)
    if ties is not None:
        matcher = matcher_of_ties(matched, ties)
    else:
        enough = max(LEAST_PLACES, PLACES_AN_IMAGE * len(matched))
        step = max(1, len(batch) // enough)
        matcher = matcher_of(matched, np.ascontiguousarray(places[::step]))
    return replace(survey, learned=survey.learned._replace(matcher=matcher))


def weigh_lists(batch: Batch, *, is_open: bool) -> Verdict | None:
    """Decide what the view lists of submerged points contain, or test the type set by the user.

    None if there are too few points, or nothing is to be decided.
    """
    detects = is_open and batch.survey.settings.method == "consistent"
    if not (detects or _wants_comparison(batch.survey)):
        return None
    given = None if detects else type_given(batch)
    return weigh(batch, reconstructions_of(batch), given=given)
