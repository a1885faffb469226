"""How a cloud was made, told by the cloud itself: what ``auto`` stands for.

The same apparent points are corrected as different software would have made them: of rays that
were all intersected, of depth maps that were fused, of stereo pairs. Where the images that see a
point change, two such corrections differ by a step. Of the right one the bed has no step there; of
the wrong one it has just the step by which the two differ.

So from patches of neighbours, with r_a and r_b what is left of the heights of either correction
after a smooth surface (a quadratic one) is taken out, and d = r_a - r_b, comes the share of d that
is in r_a,

    beta = sum(w r_a d) / sum(w d d),

near 0 if a is right and near 1 if b is. The weights are one over the square of the scatter of the
apparent patch. Noise of the points is in r_a and r_b by the factors by which either makes depths
larger; that part of d is taken out first, as it tells nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pcfix.model import FloatArray, IntArray, Outcome, ViewKind
from pcfix.options.correct import Dimensions, ScienceOptions
from pcfix.refract.batch import Batch, Doubt
from pcfix.refract.fusion import likely_beds
from pcfix.refract.matcher import bed_of
from pcfix.refract.methods import correct, with_rays

PATCHES, PATCH_POINTS, FEWEST_POINTS = 500, 16, 400
FEWEST_WITHOUT_LIST = 2000
"""Fewer are tie points, and their patches overlap."""

WIDEST_PATCH = 0.055
PATCH_WIDTH = 0.04
"""Of a patch, in flying heights: wide enough for borders of images to cross many of them. Where the
points are so sparse that patches are wider than the widest, relief drowns the steps of images."""

LEAST_PATCHES = 100
"""Patches with all their points corrected under each hypothesis, below which nothing is told."""

SURE = 3.0
"""Standard errors by which a share must differ from one half to tell."""

DENSE_GSD = 8.0
"""Points of dense matching are nearer to each other than this, those of tracks are not."""


class Hypothesis(NamedTuple):
    """A way in which a cloud may have been made.

    words : str
        What the cloud is then.
    changes : dict
        Of the options, by which such a cloud is corrected.
    kind : ViewKind or None
        What a list lists then; None without one.
    """

    words: str
    changes: dict[str, Any]
    kind: ViewKind | None = None

    def settings(self, given: ScienceOptions) -> ScienceOptions:
        """Return the options by which such a cloud is corrected."""
        return replace(given, **self.changes)


_TRACKS, _MAPS, _PAIRS = "intersected rays", "fused depth maps", "stereo pairs"
IN_FRAME = (
    Hypothesis(_TRACKS, {"method": "consistent", "camera_set": "all"}),
    Hypothesis(_MAPS, {"method": "consistent", "camera_set": "mvs", "matcher": "depth-maps"}),
    Hypothesis(_PAIRS, {"method": "consistent", "camera_set": "mvs", "matcher": "pairs"}),
)
LISTED = (
    Hypothesis(_TRACKS, {"method": "consistent"}, "tracks"),
    Hypothesis(_MAPS, {"method": "consistent"}, "depth-maps"),
    Hypothesis(_PAIRS, {"method": "consistent"}, "pair-images"),
)
BARE = Hypothesis(_TRACKS, {"method": "snell", "camera_set": "all"})
"""Without lenses or angles no other method is possible."""

LIMITS = (
    Hypothesis("all rays", {"max_angle": None}),
    *(
        Hypothesis(f"rays within {limit:g} degrees of the surface normal", {"max_angle": limit})
        for limit in (60.0, 50.0, 40.0, 35.0)
    ),
)
"""Which rays made the points; a method that weighs all alike is spoilt by others."""

ALIKE = ("snell", "shan", "butler", "murase", "dietrich")
COVERED = 0.95
"""Of the points that most hypotheses correct, what a hypothesis must correct to be one."""


class Verdict(NamedTuple):
    """What the cloud was taken for, and why.

    Attributes
    ----------
    chosen, runner_up : Hypothesis
    share, runner_up_share : float
        Of the steps by which the two differ, what is left in the bed of either: 0 where right.
    sigma : float
        Standard error of both.
    deeper_m : float
        By how much the runner-up would have the bed deeper, on the average of the patches.
    patches : int
        How many told it; 0 if they told nothing.
    doubt : Doubt
        What it leaves open: of the difference to each other hypothesis that share which is left in
        the bed, the largest of them; and the scatter of neighbours.
    """

    chosen: Hypothesis
    runner_up: Hypothesis
    share: float
    runner_up_share: float
    sigma: float
    deeper_m: float
    patches: int
    doubt: Doubt

    @property
    def is_sure(self) -> bool:
        """Whether the points tell the two apart."""
        return self.patches > 0 and 0.5 - self.share > SURE * self.sigma

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "made_of": self.chosen.words,
            "sure": self.is_sure,
            "share": round(self.share, 3),
            "runner_up": self.runner_up.words,
            "runner_up_share": round(self.runner_up_share, 3),
            "sigma": round(self.sigma, 3),
            "runner_up_deeper_m": round(self.deeper_m, 4),
            "patches": self.patches,
            "scatter_m": round(self.doubt.scatter_m, 4),
            "doubt_per_depth": round(self.doubt.per_depth, 4),
        }

    def __str__(self) -> str:
        way = "deeper" if self.deeper_m >= 0.0 else "higher"
        other = (
            f"; taken for {self.runner_up.words}, the bed would be {abs(self.deeper_m):.3f} m"
            f" {way} on average"
        )
        if not self.patches:
            return f"The cloud is taken for {self.chosen.words}, by its density alone{other}."
        steps = (
            f"of the steps between neighbours by which {self.runner_up.words} would be corrected"
            f" differently, {_percent(self.share)} are left in its bed, else"
            f" {_percent(self.runner_up_share)} ({self.patches} patches)"
        )
        doubt = "" if self.is_sure else ", which is not sure"
        return f"The cloud is taken for {self.chosen.words}{doubt}: {steps}{other}."


def _percent(share: float) -> str:
    return f"{100.0 * min(max(share, 0.0), 1.0):.0f} %"


def hypotheses_of(batch: Batch) -> tuple[Hypothesis, ...]:
    """Return what may have made the points; the kind of a list is only asked if it may be any."""
    cameras, views = batch.survey.cameras, batch.views
    if cameras.lenses is None or cameras.rotations is None:
        return (BARE,)
    if views is None:
        given = batch.survey.settings.camera_set
        return tuple(one for one in IN_FRAME if given in ("auto", one.changes["camera_set"]))
    return LISTED if views.kind == "depth-maps" else (LISTED[0]._replace(kind=views.kind),)


def weigh(batch: Batch, hypotheses: tuple[Hypothesis, ...], step: float) -> Verdict | None:
    """Tell which of the hypotheses made the points.

    Parameters
    ----------
    batch : Batch
        Submerged points, evenly spread over the cloud; `batch.survey.learned` has the matcher.
    hypotheses : tuple of Hypothesis
        Two or more.
    step : float
        Points of the whole cloud for each of these.

    Returns
    -------
    Verdict or None
        None where there is one hypothesis alone, or too few points to form patches of.
    """
    rows, place, thinned = _patches(batch)
    if not len(rows) or len(hypotheses) < 2:
        return None
    part = batch.take(rows)
    part = replace(part, survey=replace(part.survey, level_offset_m=None), level_sigma_m=None)
    around = _around(replace(batch, survey=part.survey), rows)
    z = np.array([_heights(part, around, hypothesis) for hypothesis in hypotheses])
    covered = np.isfinite(z).sum(axis=1)
    kept = np.flatnonzero(covered >= COVERED * covered.max())
    if len(kept) < 2 or not covered.max():
        return None
    z, hypotheses = z[kept], tuple(hypotheses[i] for i in kept)
    patches = place[np.isfinite(z[:, place]).all(axis=(0, 2))]
    enough = len(patches) >= LEAST_PATCHES
    share, sigma = _shares(part, patches, z) if enough else np.full((2, *z.shape[:1] * 2), 0.5)
    np.fill_diagonal(share, -np.inf)
    best = int(np.argmin(share.max(axis=1)))
    other = int(np.argmax(share[best]))
    told = 0.5 - share[best, other] > sigma[best, other]
    if not told and batch.views is None:
        # dense clouds are not of tracks, sparse ones are
        doubtful = best if _is_dense(part, place, step * thinned) else other
        if hypotheses[doubtful] is IN_FRAME[0]:
            best, other = other, best
    both = patches if enough else place
    deeper_m = float(np.nanmean(z[best][both] - z[other][both]))
    return Verdict(
        hypotheses[best], hypotheses[other], float(share[best, other]), float(share[other, best]),
        float(sigma[best, other]), deeper_m, len(patches) if enough else 0,
        _doubt(part, both, z, best, (share[best], sigma[best]), hypotheses[best]),
    )  # fmt: skip


def _doubt(
    part: Batch, place: IntArray, z: FloatArray, best: int, shares: tuple[FloatArray, FloatArray],
    chosen: Hypothesis,
) -> Doubt:  # fmt: skip
    """Return what the choice leaves open."""
    share, sigma = shares
    depth = part.surface.height_m[place] - z[best][place]
    others = [i for i in range(len(z)) if i != best]
    left = [
        min(max(share[i], 0.0) + sigma[i], 1.0)
        * float(np.sqrt(np.nanmean((z[best] - z[i])[place] ** 2)))
        for i in others
    ]
    rest = _rest(_smooth(part.xyz[place]), z[best][place])
    free = PATCH_POINTS - _TERMS
    scatter2 = float(np.nanmedian((rest**2).sum(axis=1) / free))
    budget = correct(_as(part, chosen, "all"))
    explained2 = float(np.median(budget.sigma_z_m) ** 2)
    return Doubt(
        math.sqrt(max(scatter2 - explained2, 0.0)), max(left) / max(float(np.nanmean(depth)), 1e-3)
    )


def _patches(batch: Batch) -> tuple[IntArray, IntArray, int]:
    """Return rows of points, which of these form each patch of neighbours, (p, k), and the step.

    Every so many points are used.
    """
    from scipy.spatial import cKDTree

    usable = np.arange(len(batch))
    if batch.views is not None:
        usable = np.flatnonzero(np.diff(batch.views.start) >= 2)
    if len(usable) < (FEWEST_POINTS if batch.views is not None else FEWEST_WITHOUT_LIST):
        return usable[:0], usable[:0], 1
    width_m = PATCH_WIDTH * float(_flying_height_m(batch))
    # so dense that a patch is as wide as the images' borders are far apart
    extent = np.maximum(np.ptp(batch.xyz[usable, :2], axis=0), width_m)
    wanted = max(FEWEST_POINTS, PATCH_POINTS * float(extent.prod()) / width_m**2)
    step = max(1, int(len(usable) / wanted))
    usable = usable[::step]
    xy = batch.xyz[usable, :2]
    seeds = np.unique(np.linspace(0, len(xy) - 1, PATCHES).astype(int))
    tree = cKDTree(xy, balanced_tree=False, compact_nodes=False)
    patch = usable[tree.query(xy[seeds], k=PATCH_POINTS)[1]]
    across = np.ptp(batch.xyz[patch, :2], axis=1).prod(axis=1)
    sparse = math.sqrt(np.median(across)) * PATCH_WIDTH > WIDEST_PATCH * width_m
    if batch.views is None and sparse:
        return usable[:0], usable[:0], 1
    rows, place = np.unique(patch, return_inverse=True)
    return rows, place.reshape(patch.shape), step


def _around(batch: Batch, rows: IntArray) -> Batch:
    """Return other points around some, as near as there are."""
    from scipy.spatial import cKDTree

    others = np.setdiff1d(np.arange(len(batch)), rows, assume_unique=True)
    if batch.views is not None or len(others) < PATCH_POINTS:
        return batch.take(rows)
    tree = cKDTree(batch.xyz[others, :2], balanced_tree=False, compact_nodes=False)
    near = tree.query(batch.xyz[rows[::4], :2], k=PATCH_POINTS)[1]
    return batch.take(others[np.unique(near)])


def _flying_height_m(batch: Batch) -> float:
    """Return the height of the cameras above the water, in the median."""
    return float(np.median(batch.survey.cameras.centres[:, 2]) - batch.surface.height_m.mean())


def _as(part: Batch, hypothesis: Hypothesis, dimensions: Dimensions = "none") -> Batch:
    """Return the points as those of a hypothesis."""
    survey = part.survey
    settings = replace(hypothesis.settings(survey.settings), dimensions=dimensions)
    learned = survey.learned
    if hypothesis.changes.get("camera_set") == "all":
        learned = learned._replace(matcher=None)
    views = part.views
    if views is not None and hypothesis.kind is not None:
        views = replace(views, kind=hypothesis.kind)
    return replace(part, views=views, survey=replace(survey, settings=settings, learned=learned))


def _heights(part: Batch, around: Batch, hypothesis: Hypothesis) -> FloatArray:
    """Return the heights under a hypothesis, NaN where a point is not corrected."""
    part = _as(part, hypothesis)
    if part.views is not None or hypothesis.changes.get("matcher") != "depth-maps":
        return _corrected_z(part)
    # the bed tells which images made a point: that of others, or its own noise would seem right
    likely = likely_beds(with_rays(_as(around, hypothesis)))
    bed = bed_of(around.xyz, likely) if np.isfinite(likely).any() else None
    # in steps, as a smooth bed would make smooth whatever is chosen by it
    bed = None if bed is None else bed._replace(between=False)
    learned = part.survey.learned._replace(bed=bed)
    return _corrected_z(replace(part, survey=replace(part.survey, learned=learned)))


def _corrected_z(part: Batch) -> FloatArray:
    found = correct(part)
    z = part.xyz[:, 2] + found.shift_m[:, 2]
    return np.where(found.outcome == Outcome.CORRECTED, z, np.nan)


def _shares(part: Batch, place: IntArray, z: FloatArray) -> FloatArray:
    """Return beta of each hypothesis a against each b, and its standard error, (2, h, h)."""
    h = len(z)
    table = np.full((2, h, h), np.nan)
    if not len(place):
        table[:] = 0.5
        return table
    smooth = _smooth(part.xyz[place])
    level = part.surface.height_m[place]
    apparent = part.xyz[place, 2]
    noise = _rest(smooth, apparent)
    scatter = np.sqrt((noise**2).mean(axis=1))
    weight = 1.0 / np.maximum(scatter, max(float(np.median(scatter)), 1e-6)) ** 2
    depth = np.maximum((level - apparent).mean(axis=1), 1e-6)
    rest = [_rest(smooth, one[place]) for one in z]
    gain = [(level - one[place]).mean(axis=1) / depth for one in z]
    for a in range(h):
        for b in range(h):
            if a == b:
                continue
            d = rest[a] - rest[b] - (gain[a] - gain[b])[:, None] * noise
            inner, square = weight * (rest[a] * d).sum(axis=1), weight * (d * d).sum(axis=1)
            total = max(float(square.sum()), 1e-12)
            table[0, a, b] = inner.sum() / total
            table[1, a, b] = np.sqrt(((inner - table[0, a, b] * square) ** 2).sum()) / total
    return table


def _smooth(patch: FloatArray) -> FloatArray:
    """Return an orthonormal basis of quadratic surfaces over patches, (p, k, 3), as (p, k, 6)."""
    across = patch[..., :2] - patch[..., :2].mean(axis=1, keepdims=True)
    x, y = np.moveaxis(across / (np.abs(across).max(axis=(1, 2), keepdims=True) + 1e-9), -1, 0)
    columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    return np.asarray(np.linalg.qr(columns)[0])


_TERMS = 6


def _rest(smooth: FloatArray, z: FloatArray) -> FloatArray:
    """Return what is left of heights, (p, k), without the nearest smooth surface."""
    return z - np.einsum("pki,pi->pk", smooth, np.einsum("pki,pk->pi", smooth, z))


def _is_dense(part: Batch, place: IntArray, step: float) -> bool:
    """Whether neighbouring points of the cloud are as near to each other as dense matching is."""
    patch = part.xyz[place, :2]
    extent = np.ptp(patch, axis=1).prod(axis=1)
    spacing_m = np.sqrt(np.median(extent) / PATCH_POINTS / step)
    lenses = part.survey.cameras.lenses or ()
    gsd_m = _flying_height_m(part) / np.median([lens.focal_px for lens in lenses])
    return bool(spacing_m < DENSE_GSD * gsd_m)
