"""What is learned of a block and the whole cloud before the first point is corrected."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import BoolArray, Cameras, TiePoints, ViewKind
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import UNLISTED, Batch, Learned, Survey
from pcfix.refract.consistent import check_consistent
from pcfix.refract.fusion import likely_beds
from pcfix.refract.matcher import Bed, bed_of, matcher_of, matcher_of_ties, places_for
from pcfix.refract.methods import batches, on_land, with_rays
from pcfix.refract.occlusion import occluder_of, wants_occlusion
from pcfix.refract.patches import FEWEST_WITHOUT_LIST
from pcfix.refract.reconstructions import (
    ALIKE,
    BARE,
    IN_FRAME,
    LIMITS,
    Hint,
    Reconstruction,
    Verdict,
    reconstructions_of,
    told_by,
)
from pcfix.refract.regression import DepthRegression
from pcfix.refract.stereo_factor import StereoFactor, check_stereo, stereo_factor
from pcfix.refract.tiling import spatial_order
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
    if settings.depth_factor == "auto":
        check_stereo(cameras)


def resolved(settings: ScienceOptions, cameras: Cameras, views: ViewKind | None) -> ScienceOptions:
    """Return options without ``auto`` where no points are needed to tell what it stands for."""
    if settings.method != "auto":
        return settings
    if cameras.lenses is None or cameras.rotations is None:
        return BARE.settings(settings)
    return settings if views is None else replace(settings, method="consistent")


def for_own_water(
    settings: ScienceOptions, cameras: Cameras, views: ViewKind | None
) -> ScienceOptions:
    """Return options without ``auto`` where images have water of their own.

    Raises
    ------
    SettingError
        If the method takes the water to be one for all images.
    """
    bare = cameras.lenses is None or cameras.rotations is None
    dense = settings.camera_set == "mvs" or views not in (None, "tracks")
    method = settings.method
    if method == "auto":
        method = "snell" if bare or dense else "consistent"
    if method not in ("snell", "consistent") or (method == "consistent" and dense):
        of = ", as it inverts a dense matcher," if method == "consistent" else ""
        raise SettingError(
            f"method {method}{of} takes the water to be one for all images; with water-per-image"
            " give snell, or leave one of the two out."
        )
    camera_set = "all" if settings.camera_set == "auto" else settings.camera_set
    return replace(settings, method=method, camera_set=camera_set)


def wants_sample(survey: Survey, views: ViewKind | None) -> bool:
    """Return whether points of the whole cloud tell something of the correction."""
    known = survey.settings.depth_factor != "auto"
    return wants_matcher(survey, views) or _wants_limit(survey.settings, views) or not known


def with_factor(batch: Batch) -> tuple[Batch, StereoFactor | None]:
    """Return a batch with a number for the factor of depths, and whence, where that is auto."""
    survey = batch.survey
    if survey.settings.depth_factor != "auto":
        return batch, None
    known = batch.surface.height_m[np.isfinite(batch.surface.height_m)]
    found = None
    if len(known):  # else no point lies below the water, which is said elsewhere
        n = survey.settings.refractive_index
        found = stereo_factor(survey.cameras, float(np.median(known)), n)
    settings = replace(survey.settings, depth_factor=None if found is None else found.factor)
    return replace(batch, survey=replace(survey, settings=settings)), found


def _wants_limit(settings: ScienceOptions, views: ViewKind | None) -> bool:
    """Whether the largest incidence angle is to be told by the cloud."""
    return views is None and settings.max_angle == "auto" and settings.method in ALIKE


def _wants_comparison(survey: Survey) -> bool:
    """Whether SigmaZ shall have how far the method is from the way that fits the cloud best.

    That takes the water to be one.
    """
    settings, cameras = survey.settings, survey.cameras
    told = settings.dimensions == "all" and settings.method != "regression"
    full = cameras.lenses is not None and cameras.rotations is not None
    return told and full and survey.own_water is None


def wants_matcher(survey: Survey, views: ViewKind | None) -> bool:
    """Return whether the images' partners must be known, with views of a kind or without any."""
    settings, compared = survey.settings, _wants_comparison(survey)
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
    check_method(resolved(batch.survey.settings, cameras, kind), cameras)
    batch, _ = with_factor(batch)
    given = batch.survey.settings
    settings = resolved(given, cameras, kind)
    if settings.method == "regression" and regression is None:
        raise SettingError("method regression needs a regression; fit one of check depths first.")
    hides = wants_occlusion(cameras, settings)
    listed = settings.occlusion == "auto" and views is not None
    occluder = occluder_of(batch.xyz) if hides and not listed else None
    learned = Learned(regression=regression, occluder=occluder)
    batch = replace(batch, survey=replace(batch.survey, settings=settings, learned=learned))
    if not wants_sample(batch.survey, kind):
        return batch
    survey, _ = learn_of_sample(batch, len(batch))
    if views is not None and (np.diff(views.start) == 0).any():
        hidden = occluder_of(batch.xyz) if hides else None
        as_given = replace(batch.survey, settings=given, learned=Learned(occluder=hidden))
        unlisted, _ = learn_of_unlisted(replace(batch, survey=as_given), len(batch))
        survey = replace(survey, parts={UNLISTED: unlisted})
    return replace(batch, survey=survey)


class Near(NamedTuple):
    """Submerged points with their neighbours, and how many of the cloud each stands for."""

    batch: Batch
    step: float

    def of_source(self, source: int) -> Near:
        """Return those of one point source."""
        rows = np.flatnonzero(self.batch.source == source)
        return Near(replace(self.batch.take(rows), source=None), self.step)


def learn_of_sample(
    batch: Batch,
    points: int,
    ties: TiePoints | None = None,
    hint: Hint | None = None,
    near: Near | None = None,
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
    near : Near, optional
        Which points tell how it was made, where those of the batch are too far apart.

    Returns
    -------
    survey : Survey
        Without ``auto``.
    verdicts : tuple of Verdict
        Why, as far as something was to be told, and could be.
    """
    if batch.views is None and batch.survey.settings.method == "auto":
        found = _learn_of_sources(batch, points, ties, hint, near)
        if found is not None:
            return found
    survey = batch.survey
    kind = None if batch.views is None else batch.views.kind
    if wants_matcher(survey, kind):
        survey = with_matcher(batch, ties)
    sample = replace(submerged_of(batch), survey=survey)
    if batch.views is not None:
        verdict = weigh_lists(sample, is_open=False)
        return as_told(survey, verdict), () if verdict is None else (verdict,)
    near = near or Near(sample, points / max(len(batch), 1))
    survey, verdicts = _weighed(replace(near.batch, survey=survey), near.step, hint)
    settings, learned = survey.settings, survey.learned._replace(land=None)
    if batch.original_model is not None:
        learned = learned._replace(land=_land_of(survey, verdicts))
    if not settings.models_matcher:
        learned = learned._replace(matcher=None)
    elif settings.method == "consistent" and settings.matcher == "depth-maps" and len(sample):
        learned = learned._replace(bed=_learn_bed(replace(sample, survey=survey)))
    return replace(survey, learned=learned), verdicts


def submerged_of(batch: Batch) -> Batch:
    """Return the submerged points of a batch."""
    return batch.take(np.flatnonzero(is_submerged(batch.xyz[:, 2], batch.surface)))


MOST_SOURCES = 8
"""More point sources than these are strips or images, and not clouds that were merged."""


def _learn_of_sources(
    batch: Batch, points: int, ties: TiePoints | None, hint: Hint | None, near: Near | None
) -> tuple[Survey, tuple[Verdict, ...]] | None:
    """Learn of each source by itself; None where all of them were made in one way."""
    if batch.source is None:
        return None
    submerged = is_submerged(batch.xyz[:, 2], batch.surface)
    source, count = np.unique(batch.source[submerged], return_counts=True)
    large = source[count >= FEWEST_WITHOUT_LIST][np.argsort(count[count >= FEWEST_WITHOUT_LIST])]
    if not 2 <= len(large) <= MOST_SOURCES:
        return None
    surveys, verdicts = dict[int, Survey](), list[Verdict]()
    for one in large.tolist():
        part = replace(batch.take(np.flatnonzero(batch.source == one)), source=None)
        own, of_it = points * len(part) // len(batch), near and near.of_source(one)
        surveys[one], told = learn_of_sample(part, own, ties, hint, of_it)
        of = f"point source {one} ({100.0 * len(part) / len(batch):.0f} % of the points)"
        verdicts += [verdict._replace(of=of) for verdict in told]
    if len({verdict.chosen.words for verdict in verdicts if verdict.is_sure}) < 2:
        return None
    most = int(large[-1])
    others = {one: survey for one, survey in surveys.items() if one != most}
    return replace(surveys[most], parts=others), tuple(verdicts)


def learn_of_unlisted(
    batch: Batch,
    points: int,
    ties: TiePoints | None = None,
    hint: Hint | None = None,
    near: Near | None = None,
) -> tuple[Survey, tuple[Verdict, ...]]:
    """Learn of points as without their list, for those that are in none; see `learn_of_sample`.

    `batch.survey.settings` are those that were given, ``auto`` included.
    """
    settings = resolved(batch.survey.settings, batch.survey.cameras, None)
    bare = replace(batch, views=None, survey=replace(batch.survey, settings=settings))
    return learn_of_sample(bare, points, ties, hint, near)


def _weighed(sample: Batch, step: float, hint: Hint | None) -> tuple[Survey, tuple[Verdict, ...]]:
    """Return the survey without ``auto``, and with the model uncertainty of submerged points without lists."""
    survey = sample.survey
    reconstructions = reconstructions_of(sample)
    if survey.settings.method == "auto" and len(reconstructions) > 1:
        verdict = weigh(sample, reconstructions, step, hint=hint)
        survey = as_told(survey, verdict, reconstructions[0])
        return survey, () if verdict is None else (verdict,)
    if survey.settings.method == "auto":
        survey = as_told(survey, None, reconstructions[0])
    verdicts = list[Verdict | None]()
    if _wants_limit(survey.settings, None):
        verdicts.append(weigh(replace(sample, survey=survey), LIMITS, step))
        survey = as_told(survey, verdicts[0], LIMITS[0])
    if _wants_comparison(survey):
        told = told_by(replace(sample, survey=survey))
        verdicts.append(weigh(sample, IN_FRAME, step, told=told))
        survey = as_told(survey, verdicts[-1])
    return survey, tuple(one for one in verdicts if one is not None)


def as_told(
    survey: Survey, verdict: Verdict | None, else_as: Reconstruction | None = None
) -> Survey:
    """Return a survey with the options, and the model uncertainty, of what the cloud was taken for."""
    if verdict is None:
        given = survey.settings
        return survey if else_as is None else replace(survey, settings=else_as.settings(given))
    learned = survey.learned._replace(model_uncertainty=verdict.model_uncertainty)
    return replace(survey, settings=verdict.chosen.settings(survey.settings), learned=learned)


def with_matcher(batch: Batch, ties: TiePoints | None) -> Survey:
    """Return the survey with how the images were matched."""
    survey = batch.survey
    places, matched = batch.original_model or (batch.xyz, survey.cameras)
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


def _land_of(survey: Survey, verdicts: tuple[Verdict, ...]) -> Survey:
    """Return what land is corrected with that was carried to adjusted cameras.

    It goes by how the cloud was made, also where a formula corrects the bed.
    """
    for verdict in verdicts:
        if verdict.is_told and verdict.is_against:
            survey = replace(survey, settings=verdict.runner_up.settings(survey.settings))
    dry = on_land(survey)
    if survey.settings.models_matcher:
        return dry
    return replace(dry, learned=dry.learned._replace(matcher=None))


LEAST_TIES, LEAST_DEPTH_M = 50, 0.3
CORRECTED_RATIO = 1.2
"""Depth of a cloud by that of its tie points, beyond which it was likely corrected before: as it
came it is near 1, corrected 1.34 and more."""


def depth_ratio(batch: Batch, ties: TiePoints) -> float | None:
    """Return how much deeper submerged points, shape (m, 3), lie than tie points of their block.

    The median over the tie points of the ratio to the nearest point's depth; None for few of them.
    """
    from scipy.spatial import cKDTree

    xyz = ties.xyz[np.isfinite(ties.xyz).all(axis=1)]
    if len(batch) < LEAST_TIES or len(xyz) < LEAST_TIES:
        return None
    near_m = 3.0 * float(np.sqrt(np.ptp(batch.xyz[:, :2], axis=0).prod() / len(batch)))
    apart_m, near = cKDTree(batch.xyz[:, :2]).query(xyz[:, :2])
    found = np.asarray(apart_m) < near_m
    row = np.asarray(near)[found]
    level = batch.surface.height_m[row]
    depth, tie_depth = level - batch.xyz[row, 2], level - xyz[found, 2]
    deep = tie_depth > LEAST_DEPTH_M
    return float(np.median(depth[deep] / tie_depth[deep])) if deep.sum() >= LEAST_TIES else None


def seen_flat(batch: Batch) -> BoolArray:
    """Return which points are seen by flat obliques alone; see `Batch.seen_flat`."""
    return with_rays(batch).seen_flat()


def weigh_lists(batch: Batch, *, is_open: bool) -> Verdict | None:
    """Tell what the lists of submerged points list, or what the given way leaves open.

    None where there are too few points, or nothing is to be told.
    """
    if is_open and batch.survey.settings.method == "consistent":
        return weigh(batch, reconstructions_of(batch), 1.0)
    if not _wants_comparison(batch.survey):
        return None
    return weigh(batch, reconstructions_of(batch), 1.0, told=told_by(batch))
