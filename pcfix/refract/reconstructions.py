"""Detect the reconstruction type: the one whose correction leaves the smoothest bed.

``auto`` corrects a sample of points as each type would require and looks for discontinuities where
the images that see the points change (`pcfix.refract.patches`). Of those by which the beds of the
types a and b differ, the share beta is left in that of a, with the standard error sigma. So a is
better by

    (0.5 - beta) / sqrt(sigma^2 + SHARE_ERROR^2)

standard errors or, in dense clouds, by the difference of log likelihoods over its standard error
(`pcfix.refract.patches`). What is known of density and software is added. The best type is that
with the largest distance from its runner-up; the confidence is the product of the probabilities
that it is better than each other type.
"""

import math
import re
from dataclasses import replace
from functools import partial
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from pcfix.kernels import in_threads
from pcfix.model import FloatArray, IntArray, Outcome, ViewKind
from pcfix.options.correct import Dimensions, ScienceOptions
from pcfix.refract import patches
from pcfix.refract.batch import FLAT_DEG, Batch, ModelUncertainty
from pcfix.refract.methods import bed_around, correct, with_rays
from pcfix.refract.patches import MODEL_ERROR, SMOOTH_GSD, Candidates, scatter_m, shares

SURE = 2.3264  # standard errors of a significant difference: 99 %
# In standard errors: against single maps in a sparse cloud, as theirs are dense; for tracks in a
# dense and in a sparse one, as tie points are tens of pixels apart; and for the software.
PRIOR_SPARSE, PRIOR_TRACKS, PRIOR_SOFTWARE = 8.0, (-0.5, 0.7), 1.0
SHARE_ERROR = 0.08  # standard error of a share from what the models neglect
WEAK = 3.0  # divisor of the evidence of clouds that were smoothed
MOST_CONFIDENCE = 0.99  # larger ones were not tested (`tests.benchmarks.detection`)
LEAST_PATCHES = 100  # with all their points corrected for each type; with fewer nothing is decided
# Probability of another type up to which its difference does not count as uncertainty, and from
# which all of it counts: odds of 100 : 1 and 20 : 1.
OPEN = (1.0 / 101.0, 1.0 / 21.0)
COVERED = 0.95  # least share of the points that must be corrected, of those that are for most types
LEAST_DEPTH_M = 0.1  # in shallower water the ratio of two depths means little
# Largest share of the discontinuities that the right type leaves; for stereo pairs it may be more.
# With moved cameras, and for smoothed clouds, the best type has 0.35 to 0.48. A wrong water level
# does not change the share.
FITS = 0.3
# A share below this means discontinuities that were never there: of good blocks nothing lies three
# standard errors beyond.
MOST_BEYOND = -0.5
CAUSES = (
    "No reconstruction type fits this cloud well. Check that the cameras belong to it, that the"
    " poses have not absorbed refraction (pcfix cameras), and that the cloud was not filtered or"
    " meshed."
)


class Reconstruction(NamedTuple):
    """A reconstruction type."""

    words: str  # its name
    changes: dict[str, Any]  # the options that correct such a cloud
    kind: ViewKind | None = None  # of its view list, if there is one

    @property
    def is_single(self) -> bool:
        """Whether it is single maps, which predict little but the scatter of neighbours."""
        return self.words in (_SINGLE, _NEAREST)

    def settings(self, given: ScienceOptions) -> ScienceOptions:
        """Return the options that correct such a cloud."""
        factor = given.depth_factor if self.changes["method"] == "factor" else None
        return replace(given, depth_factor=factor, **self.changes)


_TRACKS, _MAPS, _PAIRS = "tracks", "depth maps", "stereo pairs"
_SINGLE, _NEAREST = "single depth maps", "single depth maps of the nearest images"
_MVS = {"method": "consistent", "camera_set": "mvs"}
# `MODEL_ERROR` where it differs. Tracks and nearest maps name one place for each point: the right
# one was better in each of 18 clouds. The noise of stereo pairs is not modelled, so that tracks and
# fused maps seem better than pairs by up to 0.03 in clouds of pairs.
MODEL_ERRORS = {
    frozenset((_TRACKS, _NEAREST)): 0.005,
    frozenset((_TRACKS, _PAIRS)): 0.018,
    frozenset((_MAPS, _PAIRS)): 0.018,
}

IN_FRAME = (
    Reconstruction(_TRACKS, {"method": "consistent", "camera_set": "all"}),
    Reconstruction(_MAPS, {**_MVS, "matcher": "depth-maps"}),
    Reconstruction(_PAIRS, {**_MVS, "matcher": "pairs"}),
    Reconstruction(_SINGLE, {**_MVS, "matcher": "single-map"}),
    Reconstruction(_NEAREST, {**_MVS, "matcher": "nearest-map"}),
)
LISTED = (
    Reconstruction(_TRACKS, {"method": "consistent"}, "tracks"),
    Reconstruction(_MAPS, {"method": "consistent"}, "depth-maps"),
    Reconstruction(_PAIRS, {"method": "consistent"}, "pairs"),
)
# The rays that may have been used in the reconstruction, for the methods of `ALIKE`.
LIMITS = (
    Reconstruction("all rays", {"method": "snell"}),
    Reconstruction(
        f"rays within {FLAT_DEG:g} degrees of the surface normal",
        {"method": "snell", "max_angle": FLAT_DEG},
    ),
)

# Types of dense clouds by a word in the name of the software. OpenMVS, which ODM calls, and COLMAP
# fuse depth maps (their sources); Metashape merges the depth maps of single images (its manual);
# SURE triangulates a base image with several others (Rothermel et al. 2012); MicMac computes a
# depth map for each image (its manual, PIMs) or stereo models. For RealityCapture there is no
# source: fused maps are assumed. Those of Pix4D and DJI Terra are unknown.
SOFTWARE: dict[str, tuple[str, ...]] = {
    "openmvs": (_MAPS,), "odm": (_MAPS,), "opendronemap": (_MAPS,), "opensfm": (_MAPS,),
    "colmap": (_MAPS,), "realitycapture": (_MAPS,), "realityscan": (_MAPS,),
    "metashape": (_SINGLE,), "photoscan": (_SINGLE,), "sure": (_SINGLE, _PAIRS),
    "micmac": (_SINGLE, _PAIRS),
}  # fmt: skip


class Hint(NamedTuple):
    """Likely types of a dense cloud, and the name of the software by which they are known."""

    words: tuple[str, ...]
    source: str


def hint_of(software: str) -> Hint | None:
    """Return the types that software is known for, by the first word of its name that is known."""
    words = (word for word in re.findall(r"[a-z]+", software.lower()) if word in SOFTWARE)
    known = next(words, None)
    return None if known is None else Hint(SOFTWARE[known], software.strip())


class Verdict(NamedTuple):
    """The reconstruction type of a cloud, and the evidence.

    `share` is the share of the discontinuities, by which the chosen type and the runner-up differ,
    that is left in the bed of the chosen one: 0 where right. `candidates` are the shares that the
    other types leave, against the chosen one. `straight` is the share between the chosen type and
    straight rays, near 1 if the poses have absorbed the refraction, and its standard error.
    """

    chosen: Reconstruction
    runner_up: Reconstruction  # the next best; if the user set the type, the best of all others
    errors: float  # standard errors by which the evidence is for the chosen type
    share: float
    sigma: float  # standard error of the share
    candidates: dict[str, float]
    deeper_m: float  # mean depth of the runner-up's bed below the chosen one
    patches: int  # 0 without evidence
    confidence: float  # probability that the type is right, and none of the others
    model_uncertainty: ModelUncertainty
    by: str = ""  # other evidence that decided; empty if the discontinuities did
    is_given: bool = False  # whether the user set the type
    remarks: tuple[str, ...] = ()  # what makes the evidence weak
    straight: tuple[float, float] | None = None

    @property
    def is_fused(self) -> bool:
        """Whether the type is fused depth maps, whose model is the closest."""
        return self.chosen.words == _MAPS

    @property
    def is_sure(self) -> bool:
        """Whether the chosen type is significantly better than the other."""
        return self.errors > SURE

    @property
    def is_against(self) -> bool:
        """Whether the other type fits significantly better."""
        return self.errors < -SURE

    def warnings(self) -> tuple[str, ...]:
        """Return what the user must know, a sentence each."""
        differs = self.is_against and abs(self.deeper_m) > self.model_uncertainty.formal_m
        unsure = differs if self.is_given else not self.is_sure
        # of single maps the shares say little
        by_shares = not (self.chosen.is_single or self.runner_up.is_single)
        poor = by_shares and not self.is_sure and self.share > FITS
        absurd = self.share < min(MOST_BEYOND, -SURE * self.sigma)
        none_fits = not self.is_given and self.patches > 0 and (poor or absurd)
        return (*self.remarks, *[str(self)] * unsure, *[CAUSES] * none_fits)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "type": self.chosen.words,
            "sure": self.is_sure,
            "confidence": round(self.confidence, 4),
            "share": round(self.share, 3),
            "candidates": {name: round(share, 3) for name, share in self.candidates.items()},
            "runner_up": self.runner_up.words,
            "runner_up_deeper_m": round(self.deeper_m, 4),
            "patches": self.patches,
            "scatter_m": round(self.model_uncertainty.scatter_m, 4),
            "per_depth": round(self.model_uncertainty.per_depth, 4),
        }

    def __str__(self) -> str:
        side, other = "lower" if self.deeper_m >= 0.0 else "higher", self.runner_up.words
        how = "set by the user"
        if not self.is_given:
            by = f" by {self.by}" if self.by else ""
            how = f"detected{by}, confidence {100.0 * self.confidence:.0f} %"
        fit = ", which fits better" if self.is_given and self.is_against else ""
        text = (
            f"Cloud: {self.chosen.words} ({how}). Next best: {other}{fit}; the bed would be"
            f" {abs(self.deeper_m):.3f} m {side}."
        )
        if not self.patches or self.share > 0.5:
            return text
        left, more = np.clip([self.share, self.candidates[other]], 0.0, 1.0)
        return (
            f"{text} Discontinuities between image footprints left in the bed: {100.0 * left:.0f}"
            f" %, with {other} {100.0 * more:.0f} % ({self.patches} patches)."
        )


def reconstructions_of(batch: Batch) -> tuple[Reconstruction, ...]:
    """Return the possible types of the points, of every kind of view list if it may be any."""
    views = batch.views
    if views is None:
        given, auto = batch.survey.settings.camera_set, batch.survey.settings.method == "auto"
        return tuple(
            one for one in IN_FRAME if not auto or given in ("auto", one.changes["camera_set"])
        )
    return LISTED if batch.survey.learned.matcher is not None else LISTED[:1]


def type_given(batch: Batch) -> Reconstruction:
    """Return the type that the options set, with limits of angles resolved."""
    settings, views = batch.survey.settings, batch.views
    changes: dict[str, Any] = {"method": settings.method}
    if views is None:
        changes["camera_set"] = "mvs" if settings.models_matcher else "all"
        changes["matcher"] = settings.matcher
    kind = None if views is None else views.kind
    for one in IN_FRAME if views is None else reconstructions_of(batch):
        if one.kind == kind and all(changes[name] == one.changes[name] for name in one.changes):
            return one
    return Reconstruction(settings.method, changes, kind)


def weigh(
    batch: Batch,
    reconstructions: tuple[Reconstruction, ...],
    *,
    given: Reconstruction | None = None,
    hint: Hint | None = None,
) -> Verdict | None:
    """Choose the reconstruction that best explains the points, or test the one set by the user.

    The submerged points are evenly spread over the cloud, and `batch.survey.learned` has the
    matcher. `given` is set by the user, `hint` decides if the points do not. None with a single
    type, or too few points for patches.
    """
    types = reconstructions
    if given is not None and given not in types:
        types = *types, given
    # else they differ in what a view list means, or in the largest angle
    by_images = batch.views is None and LIMITS[0] not in types
    most = patches.PATCHES if given is None else patches.TEST_PATCHES
    sample = patches.patches_of(batch, at_borders=by_images, most=most) if types[1:] else None
    if sample is None:
        return None
    rows, place = sample
    batch = replace(batch, survey=replace(batch.survey, level_offset_m=None), level_sigma_m=None)
    part, is_dense = batch.take(rows), place.shape[1] == patches.PATCH_POINTS[0]
    beds = _beds(part, patches.others_around(batch, rows), place, types, by_images)
    if beds is None or (given is not None and given not in beds.types):
        return None
    remarks, among, by = _remarks(part, place), list(range(len(beds.types))), ""
    if remarks:
        beds = beds._replace(errors=beds.errors / WEAK)
    if given is None:
        if by_images:
            beds, by = _with_prior(beds, is_dense, hint)
        best, other = beds.rank(among)
    else:
        best = beds.types.index(given)
        among = [i for i in among if beds.types[i] in reconstructions]
        first, second = beds.rank(among)
        other = second if first == best else first
    confidence = math.prod(1.0 - _chance(errors) for errors in beds.errors[best, among])
    straight = None
    if beds.patches and not remarks and part.original_model is None:
        share, sigma = shares(part, beds.place, np.array([beds.z[best], part.xyz[:, 2]]))
        straight = float(share[0, 1]), float(sigma[0, 1])
    return Verdict(
        chosen=beds.types[best],
        runner_up=beds.types[other],
        errors=float(beds.errors[best, other]),
        share=float(beds.share[best, other]),
        sigma=float(beds.sigma[best, other]),
        candidates={
            one.words: float(beds.share[i, best]) for i, one in enumerate(beds.types) if i != best
        },
        deeper_m=float(np.nanmean((beds.z[best] - beds.z[other])[beds.place])),
        patches=beds.patches,
        confidence=min(confidence, MOST_CONFIDENCE),
        model_uncertainty=_model_uncertainty(part, beds, best, among),
        by=by,
        is_given=given is not None,
        remarks=remarks,
        straight=straight,
    )


def _chance(errors: float) -> float:
    """Return the probability that the other type is right, from the standard errors against it."""
    return 0.5 * math.erfc(errors / math.sqrt(2.0))


class _Beds(NamedTuple):
    """The m points of patches as corrected for each of h types, and how the types compare."""

    types: tuple[Reconstruction, ...]
    z: FloatArray  # (h, m), corrected heights, metres; NaN where a point is not corrected
    place: IntArray  # (p, n), the points of each patch
    patches: int  # 0 if too few of the patches are corrected for every type
    share: FloatArray  # (h, h), of the discontinuities left in bed a; see `patches.shares`
    sigma: FloatArray  # (h, h), its standard error
    errors: FloatArray  # (h, h), standard errors by which a is better than b; infinite for itself

    def rank(self, among: list[int]) -> tuple[int, int]:
        """Return the best of some types, and the runner-up."""
        errors = self.errors[np.ix_(among, among)]
        best = int(np.argmax(errors.min(axis=1)))
        return among[best], among[int(np.argmin(errors[best]))]


def _beds(
    part: Batch, around: Batch, place: IntArray, types: tuple[Reconstruction, ...], by_images: bool
) -> _Beds | None:
    """Correct the points of the patches for each type; None if fewer than two can."""
    z: FloatArray = np.array(in_threads(partial(_heights, part, around), types))
    covered = np.isfinite(z).sum(axis=1)
    comparable = np.flatnonzero(covered >= COVERED * covered.max())
    if len(comparable) < 2 or not covered.max():
        return None
    z, types = z[comparable], tuple(types[i] for i in comparable)
    complete = place[np.isfinite(z[:, place]).all(axis=(0, 2))]
    if len(complete) < LEAST_PATCHES:  # no evidence
        none = np.zeros((len(types), len(types)))
        beds = _Beds(types, z, place, 0, none + 0.5, none, none.copy())
    else:
        share, sigma = shares(part, complete, z)
        errors = (0.5 - share) / np.maximum(np.hypot(sigma, SHARE_ERROR * by_images), 1e-9)
        # The maps of a point are chosen by a smooth bed: their likelihood allows for that, the
        # discontinuities do not. But neighbours in sparse clouds show little of their scatter.
        if by_images and place.shape[1] == patches.PATCH_POINTS[0]:
            corrected = [*zip(types, z, strict=True)]
            likely = in_threads(partial(_log_likelihood, part, complete), corrected)
            for a, b in permutations(range(len(types)), 2):
                pair = frozenset((types[a].words, types[b].words))
                model_error = MODEL_ERRORS.get(pair, MODEL_ERROR)
                errors[a, b] = patches.standard_errors(likely[a], likely[b], model_error)
        beds = _Beds(types, z, complete, len(complete), share, sigma, errors)
    np.fill_diagonal(beds.share, -np.inf)
    np.fill_diagonal(beds.errors, np.inf)
    return beds


def _log_likelihood(
    part: Batch, place: IntArray, bed: tuple[Reconstruction, FloatArray]
) -> FloatArray:
    """Return the log likelihood of each patch for a type and its bed, per point."""
    one, z = bed
    candidates = Candidates(z[:, None], np.ones((len(z), 1)))
    if one.words in (_MAPS, _SINGLE):  # which of several images made a point is unknown
        from pcfix.refract.depth_maps import likely_beds

        candidates = likely_beds(with_rays(_as(part, one)))
    each = Candidates(*(values[place] for values in candidates))
    terms = patches.smooth_surfaces(part.xyz[place])
    level = part.surface.height_m[place]
    return patches.log_likelihood(terms, part.xyz[place, 2], level, each, patches.gsd_m(part))


def _with_prior(beds: _Beds, is_dense: bool, hint: Hint | None) -> tuple[_Beds, str]:
    """Add what is known of the types by density and software; return what decided, if these did."""
    expected, prior = () if hint is None else hint.words, np.zeros(len(beds.types))
    for i, one in enumerate(beds.types):
        prior[i] = PRIOR_SOFTWARE * (one.words in expected)
        if one.words == _TRACKS:
            prior[i] += PRIOR_TRACKS[0 if is_dense else 1]
        if one.is_single and not is_dense:
            prior[i] -= PRIOR_SPARSE
    known = beds._replace(errors=beds.errors + prior[:, None] - prior)
    every = list(range(len(prior)))
    best = known.rank(every)[0]
    if beds.patches and beds.rank(every)[0] == best:
        return known, ""
    if hint is not None and beds.types[best].words in expected:
        return known, f"its software, {hint.source}"
    return known, "the spacing of its points"


def _remarks(part: Batch, place: IntArray) -> tuple[str, ...]:
    """Return what makes the discontinuities weak evidence."""
    if part.views is not None:
        return ()
    step = patches.grid_m(part.xyz)
    if step is not None:
        return (
            f"The points are on a grid of {step:.3g} m, like the heights of a raster, which smooths"
            " the evidence of the reconstruction type. Give the cloud as the matcher wrote it.",
        )
    has_lenses, z = part.survey.cameras.lenses is not None, part.xyz[:, 2]
    if has_lenses and scatter_m(part, place, z) < SMOOTH_GSD * patches.gsd_m(part):
        return (
            "Neighbouring points scatter less than images allow, as in a mesh or a filtered cloud:"
            " its reconstruction type is uncertain, and SigmaZ has no share of mismatches. Give the"
            " cloud as the matcher wrote it.",
        )
    return ()


def _model_uncertainty(part: Batch, beds: _Beds, at: int, among: list[int]) -> ModelUncertainty:
    """Return the model uncertainty of a type, among types that may be right.

    Of the best type it is, for each other one, the share of the difference to it that is left in
    the bed; of another type, the difference to the best in addition. Of a formula, which is no
    reconstruction type, it is the whole difference: a bed can be smooth and too shallow.
    """
    depth = np.maximum(part.surface.height_m - beds.z[at], 1e-3)[beds.place]
    deep = depth > LEAST_DEPTH_M

    def left(a: int, b: int, most: float) -> float:
        difference = (np.abs((beds.z[a] - beds.z[b])[beds.place]) / depth)[deep]
        share = float(np.interp(_chance(beds.errors[a, b]), OPEN, (0.0, 1.0)))
        # single maps predict discontinuities at few places only
        if not (beds.types[a].is_single or beds.types[b].is_single):
            by_steps = max(float(beds.share[a, b]), 0.0) + float(beds.sigma[a, b])
            share = max(share, min(by_steps, 1.0))
        if not np.isfinite(difference).any():
            return 0.0
        # its 95 % interval covers 95 % of the differences
        rms = float(np.sqrt(np.nanmean(difference**2)))
        spread = max(rms, float(np.nanquantile(difference, 0.95)) / 1.96)
        return (share if share <= most else 1.0) * spread

    best, _ = beds.rank(among)
    open_m = max((left(best, i, 1.0) for i in among if i != best), default=0.0)
    if at != best:
        open_m = math.hypot(open_m, left(at, best, 0.5 if at in among else 0.0))
    scatter = scatter_m(part, beds.place, beds.z[at])
    budget = correct(_as(part, beds.types[at], "all"))
    formal = float(np.median(budget.sigma_z_m))
    return ModelUncertainty(math.sqrt(max(scatter**2 - formal**2, 0.0)), open_m, formal)


def _as(part: Batch, one: Reconstruction, dimensions: Dimensions = "none") -> Batch:
    """Return the points with the settings of a type."""
    survey = part.survey
    settings = replace(one.settings(survey.settings), dimensions=dimensions)
    learned, views = survey.learned, part.views
    if views is None and not settings.models_matcher:
        learned = learned._replace(matcher=None)
    if views is not None and one.kind is not None:
        views = replace(views, kind=one.kind)
    return replace(part, views=views, survey=replace(survey, settings=settings, learned=learned))


def _heights(part: Batch, around: Batch, one: Reconstruction) -> FloatArray:
    """Return the heights corrected for a type, NaN where a point is not corrected."""
    part = _as(part, one)
    settings, learned = part.survey.settings, part.survey.learned
    if part.views is None and settings.chooses_maps and learned.matcher is not None:
        # the bed identifies the images of a point: it must be that of other points, and not
        # interpolated, as a smooth bed would make any choice look smooth
        bed = bed_around(_as(around, one))
        bed = None if bed is None else bed._replace(between=False)
        part = replace(part, survey=replace(part.survey, learned=learned._replace(bed=bed)))
    found = correct(part)
    z = part.xyz[:, 2] + found.shift_m[:, 2]
    return np.where(found.outcome == Outcome.CORRECTED, z, np.nan)
