"""Which of the ways to make a cloud leaves no steps in its bed: what ``auto`` stands for."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.model import FloatArray, IntArray, Outcome
from pcfix.options.correct import Dimensions
from pcfix.refract.batch import Batch, ModelUncertainty
from pcfix.refract.fusion import likely_beds
from pcfix.refract.matcher import bed_of
from pcfix.refract.methods import correct, with_rays
from pcfix.refract.patches import (
    Patches,
    grid_m,
    is_dense,
    is_smooth,
    others_around,
    patches_of,
    scatter_m,
    shares,
)
from pcfix.refract.reconstructions import SURE, Hint, Reconstruction, Verdict

LEAST_PATCHES = 100
"""Patches with all their points corrected under each reconstruction, below which nothing is told."""

COVERED = 0.95
"""Of the points that most reconstructions correct, what a reconstruction must correct to be one."""


class _Beds(NamedTuple):
    """What each way makes of the points of patches; see `pcfix.refract.patches.shares`."""

    ways: tuple[Reconstruction, ...]
    z: FloatArray
    place: IntArray
    patches: int
    share: FloatArray
    sigma: FloatArray

    def rank(self, among: list[int]) -> tuple[int, int]:
        """Return the best of some ways, and the one that comes nearest to it."""
        share = self.share[np.ix_(among, among)]
        best = int(np.argmin(share.max(axis=1)))
        return among[best], among[int(np.argmax(share[best]))]


def weigh(
    batch: Batch,
    reconstructions: tuple[Reconstruction, ...],
    step: float,
    *,
    told: Reconstruction | None = None,
    hint: Hint | None = None,
) -> Verdict | None:
    """Tell which of the reconstructions made the points, or how far the way that was told is off.

    Parameters
    ----------
    batch : Batch
        Submerged points, evenly spread over the cloud; `batch.survey.learned` has the matcher.
    reconstructions : tuple of Reconstruction
    step : float
        Points of the whole cloud for each of these.
    told : Reconstruction, optional
        What the user wants, which is not decided then.
    hint : Hint, optional
        What decides between reconstructions that the points leave open.

    Returns
    -------
    Verdict or None
        None where there is one way alone, or too few points to form patches of.
    """
    ways = reconstructions if told is None or told in reconstructions else (*reconstructions, told)
    patches = patches_of(batch) if len(ways) > 1 else None
    if patches is None:
        return None
    part = batch.take(patches.rows)
    part = replace(part, survey=replace(part.survey, level_offset_m=None), level_sigma_m=None)
    beds = _beds(part, replace(batch, survey=part.survey), patches, ways)
    if beds is None or (told is not None and told not in beds.ways):
        return None
    remarks, among = _remarks(part, patches.place), list(range(len(beds.ways)))
    if told is None:
        best, other, by = _decided(part, beds, patches, step, hint, weak=bool(remarks))
    else:
        best, by = beds.ways.index(told), ""
        among = [i for i in among if beds.ways[i] in reconstructions]
        first, second = beds.rank(among)
        other = second if first == best else first
    deeper_m = float(np.nanmean((beds.z[best] - beds.z[other])[beds.place]))
    return Verdict(
        beds.ways[best], beds.ways[other], float(beds.share[best, other]),
        float(beds.share[other, best]), float(beds.sigma[best, other]), deeper_m, beds.patches,
        _model_uncertainty(part, beds, best, among), by, told is not None, remarks,
        straight=None if remarks else _straight(part, beds, best),
    )  # fmt: skip


def _straight(part: Batch, beds: _Beds, way: int) -> tuple[float, float] | None:
    """Return the share of the steps of straight rays' bed in that of a way, and its error.

    None where too few points tell, or where they were made with other poses.
    """
    if not beds.patches or part.original_model is not None:
        return None
    share, sigma = shares(part, beds.place, np.array([beds.z[way], part.xyz[:, 2]]))
    return float(share[0, 1]), float(sigma[0, 1])


def _beds(
    part: Batch, batch: Batch, patches: Patches, ways: tuple[Reconstruction, ...]
) -> _Beds | None:
    """Correct the points of the patches in each way; None where fewer than two can."""
    around = others_around(batch, patches.rows)
    z = np.array([_heights(part, around, way) for way in ways])
    covered = np.isfinite(z).sum(axis=1)
    kept = np.flatnonzero(covered >= COVERED * covered.max())
    if len(kept) < 2 or not covered.max():
        return None
    z = z[kept]
    place = patches.place[np.isfinite(z[:, patches.place]).all(axis=(0, 2))]
    if len(place) >= LEAST_PATCHES:
        share, sigma = shares(part, place, z)
        told = len(place)
    else:
        share, sigma = np.full((2, len(z), len(z)), 0.5)
        place, told = patches.place, 0
    np.fill_diagonal(share, -np.inf)
    return _Beds(tuple(ways[i] for i in kept), z, place, told, share, sigma)


def _decided(
    part: Batch, beds: _Beds, patches: Patches, step: float, hint: Hint | None, *, weak: bool
) -> tuple[int, int, str]:
    """Return what the cloud is taken for, the runner-up, and what else than the steps decided.

    Where the steps leave it open, dense clouds are what their software makes, and not of tracks;
    sparse ones are of tracks.
    """
    best, other = beds.rank(list(range(len(beds.ways))))
    errors = SURE if weak else 1.0
    if 0.5 - beds.share[best, other] > errors * beds.sigma[best, other] or part.views is not None:
        return best, other, ""
    words = [one.words for one in beds.ways]
    dense = is_dense(part, patches.place, step * patches.step)
    if dense and hint is not None and hint.words in words:
        said = words.index(hint.words)
        return (best, other, f"its software, {hint.source}") if said == best else (
            said, best, f"its software, {hint.source}"
        )  # fmt: skip
    if words[best if dense else other] == "intersected rays":
        return other, best, "its density"
    return best, other, ""


def _remarks(part: Batch, place: IntArray) -> tuple[str, ...]:
    """Return what makes the steps between neighbours weak evidence."""
    if part.views is not None:
        return ()
    step = grid_m(part.xyz)
    if step is not None:
        return (
            f"The points lie on a grid of {step:.3g} m: heights of a raster, in which the steps by"
            " which a cloud tells how it was made are smoothed; the cloud itself, as the matcher"
            " wrote it, would tell more.",
        )
    if part.survey.cameras.lenses is not None and is_smooth(part, place):
        return (
            "Neighbouring points scatter less than images can tell, as those of a mesh or a"
            " filtered cloud: how it was made can hardly be told by it, and SigmaZ has no share of"
            " mismatches; the cloud itself, as the matcher wrote it, would tell more.",
        )
    return ()


def _model_uncertainty(part: Batch, beds: _Beds, way: int, among: list[int]) -> ModelUncertainty:
    """Return what a way leaves open, told or decided, among ways that may be right.

    That is of the one that fits best, for each other one, the share of the difference to it that
    is left in the bed; of a way that fits less well, the difference to the best besides. Of what is
    no way to make a cloud, but a formula, all of it: a bed can be smooth and too shallow.
    """
    depth = np.maximum(part.surface.height_m - beds.z[way], 1e-3)[beds.place]
    deep = depth > LEAST_DEPTH_M

    def left(a: int, b: int, most: float) -> float:
        apart = np.abs((beds.z[a] - beds.z[b])[beds.place]) / depth
        share = min(max(float(beds.share[a, b]), 0.0) + float(beds.sigma[a, b]), 1.0)
        return (share if share <= most else 1.0) * _spread(apart[deep])

    best, _ = beds.rank(among)
    open_m = max((left(best, i, 1.0) for i in among if i != best), default=0.0)
    if way != best:
        open_m = math.hypot(open_m, left(way, best, 0.5 if way in among else 0.0))
    scatter = scatter_m(part, beds.place, beds.z[way])
    budget = correct(_as(part, beds.ways[way], "all"))
    formal = float(np.median(budget.sigma_z_m))
    return ModelUncertainty(math.sqrt(max(scatter**2 - formal**2, 0.0)), open_m, formal)


LEAST_DEPTH_M = 0.1
"""Of water, under which the ratio of two depths says little."""


def _spread(apart: FloatArray) -> float:
    """Return a standard deviation of absolute differences that covers 95 % of them."""
    if not np.isfinite(apart).any():
        return 0.0
    rms = float(np.sqrt(np.nanmean(apart**2)))
    return max(rms, float(np.nanquantile(apart, 0.95)) / 1.96)


def _as(part: Batch, way: Reconstruction, dimensions: Dimensions = "none") -> Batch:
    """Return the points as those of a way."""
    survey = part.survey
    settings = replace(way.settings(survey.settings), dimensions=dimensions)
    learned, views = survey.learned, part.views
    if views is None and not settings.models_matcher:
        learned = learned._replace(matcher=None)
    if views is not None and way.kind is not None:
        views = replace(views, kind=way.kind)
    return replace(part, views=views, survey=replace(survey, settings=settings, learned=learned))


def _heights(part: Batch, around: Batch, way: Reconstruction) -> FloatArray:
    """Return the heights in one way, NaN where a point is not corrected."""
    part = _as(part, way)
    settings = part.survey.settings
    fuses = settings.method == "consistent" and settings.matcher == "depth-maps"
    if part.views is not None or not fuses or part.survey.learned.matcher is None:
        return _corrected_z(part)
    # the bed tells which images made a point: that of others, or its own noise would seem right
    likely = likely_beds(with_rays(_as(around, way)))
    bed = bed_of(around.xyz, likely) if np.isfinite(likely).any() else None
    # in steps, as a smooth bed would make smooth whatever is chosen by it
    bed = None if bed is None else bed._replace(between=False)
    learned = part.survey.learned._replace(bed=bed)
    return _corrected_z(replace(part, survey=replace(part.survey, learned=learned)))


def _corrected_z(part: Batch) -> FloatArray:
    found = correct(part)
    z = part.xyz[:, 2] + found.shift_m[:, 2]
    return np.where(found.outcome == Outcome.CORRECTED, z, np.nan)
