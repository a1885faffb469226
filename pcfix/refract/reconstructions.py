"""In which ways a cloud may have been made, and what it was taken for.

Which of them it was, the cloud itself tells: see `pcfix.refract.weighing`.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any, NamedTuple

from pcfix.model import ViewKind
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, ModelUncertainty

SURE = 3.0
"""Standard errors by which a share must differ from one half to tell."""


class Reconstruction(NamedTuple):
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
        of_factor = self.changes.get("method", given.method) == "factor"
        gone: dict[str, Any] = {} if of_factor else {"depth_factor": None}
        return replace(given, **gone, **self.changes)


_TRACKS, _MAPS, _PAIRS = "intersected rays", "fused depth maps", "stereo pairs"
IN_FRAME = (
    Reconstruction(_TRACKS, {"method": "consistent", "camera_set": "all"}),
    Reconstruction(_MAPS, {"method": "consistent", "camera_set": "mvs", "matcher": "depth-maps"}),
    Reconstruction(_PAIRS, {"method": "consistent", "camera_set": "mvs", "matcher": "pairs"}),
)
LISTED = (
    Reconstruction(_TRACKS, {"method": "consistent"}, "tracks"),
    Reconstruction(_MAPS, {"method": "consistent"}, "depth-maps"),
    Reconstruction(_PAIRS, {"method": "consistent"}, "pair-images"),
)
BARE = Reconstruction(_TRACKS, {"method": "snell", "camera_set": "all"})
"""Without lenses or angles no other method is possible."""

LIMITS = (
    Reconstruction("all rays", {"max_angle": None}),
    *(
        Reconstruction(f"rays within {limit:g} degrees of the surface normal", {"max_angle": limit})
        for limit in (60.0, 50.0, 40.0, 35.0)
    ),
)
"""Which rays made the points; a method that weighs all alike is spoilt by others."""

ALIKE = ("snell", "shan", "butler", "murase", "dietrich")

SOFTWARE = {
    "metashape": _MAPS, "photoscan": _MAPS, "openmvs": _MAPS, "colmap": _MAPS, "odm": _MAPS,
    "opendronemap": _MAPS, "opensfm": _MAPS, "realitycapture": _MAPS, "realityscan": _MAPS,
    "micmac": _PAIRS, "sure": _PAIRS,
}  # fmt: skip
"""Of what dense clouds are made, by a word in the name of the software; Pix4D does not say."""


FITS = 0.3
"""Share of the steps in the bed of the right way, at most; of stereo pairs it may be more. With
cameras that were moved, and of smoothed clouds, the best way has 0.35 to 0.48; of a wrong level the
steps say nothing."""

MOST_BEYOND = -0.5
"""Steps that are turned over by more than so much of them were never there: of good blocks nothing
lies three standard errors beyond."""

CAUSES = (
    "Where no way fits, the cameras may be of another block or moved against the cloud, the poses"
    " may have absorbed the refraction (see pcfix cameras), or the cloud was filtered or meshed."
)


class Hint(NamedTuple):
    """What files say of how a dense cloud was made.

    words : str
        Of the reconstruction that they speak for.
    source : str
        What says it.
    """

    words: str
    source: str


def hint_of(names: tuple[str, ...]) -> Hint | None:
    """Return what the names of software say, the first that says something."""
    for name in names:
        for word in re.findall(r"[a-z]+", name.lower()):
            if word in SOFTWARE:
                return Hint(SOFTWARE[word], name.strip())
    return None


class Verdict(NamedTuple):
    """What the cloud was taken for, and why.

    Attributes
    ----------
    chosen, runner_up : Reconstruction
        What it was taken for, and what comes next; where the user told the way, what fits best of
        all others.
    share, runner_up_share : float
        Of the steps by which the two differ, what is left in the bed of either: 0 where right.
    sigma : float
        Standard error of both.
    deeper_m : float
        By how much the other would have the bed deeper, on the average of the patches.
    patches : int
        How many told it; 0 if they told nothing.
    model_uncertainty : ModelUncertainty
        What it leaves open.
    by : str
        What else decided than the steps, in words; empty where they did.
    is_told : bool
        Whether the user said what to do, so that nothing was decided.
    straight : tuple of 2 float, or None
        Of the steps by which the chosen way differs from straight rays, what is left in its bed,
        near 1 where the poses have absorbed the refraction; and its standard error.
    of : str
        Which points it is of; empty for all.
    remarks : tuple of str
        What makes the evidence weak, a sentence each.
    """

    chosen: Reconstruction
    runner_up: Reconstruction
    share: float
    runner_up_share: float
    sigma: float
    deeper_m: float
    patches: int
    model_uncertainty: ModelUncertainty
    by: str = ""
    is_told: bool = False
    remarks: tuple[str, ...] = ()
    of: str = ""
    straight: tuple[float, float] | None = None

    @property
    def is_fused(self) -> bool:
        """Whether the cloud was taken for fused depth maps, whose model is the closest."""
        return self.chosen.words == _MAPS

    @property
    def is_sure(self) -> bool:
        """Whether the points tell the two apart."""
        return self.patches > 0 and 0.5 - self.share > SURE * self.sigma

    @property
    def is_against(self) -> bool:
        """Whether the points say that the other one is right."""
        return self.patches > 0 and self.share - 0.5 > SURE * self.sigma

    def warnings(self) -> tuple[str, ...]:
        """Return what the user must know of it, a sentence each."""
        apart = self.is_against and abs(self.deeper_m) > self.model_uncertainty.formal_m
        unsure = apart if self.is_told else not self.is_sure
        is_way = "method" in self.chosen.changes and not self.is_told
        open_ = not self.is_sure and self.share > FITS
        absurd = self.share < MOST_BEYOND and self.share < -SURE * self.sigma
        none_fits = is_way and self.patches > 0 and (open_ or absurd)
        said = ((str(self), unsure), (CAUSES, none_fits))
        return (*self.remarks, *(sentence for sentence, holds in said if holds))

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
            "by": self.by,
            "scatter_m": round(self.model_uncertainty.scatter_m, 4),
            "doubt_per_depth": round(self.model_uncertainty.per_depth, 4),
        }

    def __str__(self) -> str:
        way = "deeper" if self.deeper_m >= 0.0 else "higher"
        other = (
            f"; taken for {self.runner_up.words}, the bed would be {abs(self.deeper_m):.3f} m"
            f" {way} on average"
        )
        whole = self.of[:1].upper() + self.of[1:] or "The cloud"
        taken = f"{'Told' if self.is_told else f'{whole} is taken for'} {self.chosen.words}"
        if not self.patches:
            by = "" if self.is_told else f", by {self.by or 'its density'} alone"
            return f"{taken}{by}{other}."
        steps = (
            f"of the steps between neighbours by which {self.runner_up.words} would be corrected"
            f" differently, {_percent(self.share)} are left in its bed, else"
            f" {_percent(self.runner_up_share)} ({self.patches} patches)"
        )
        if self.is_told:
            fit = f"; the cloud fits {self.runner_up.words} better" if self.is_against else ""
            return f"{taken}: {steps}{fit}{other}."
        unsure = "" if self.is_sure else ", which is not sure"
        by = f" (by {self.by})" if self.by else ""
        return f"{taken}{unsure}{by}: {steps}{other}."


def _percent(share: float) -> str:
    return f"{100.0 * min(max(share, 0.0), 1.0):.0f} %"


def reconstructions_of(batch: Batch) -> tuple[Reconstruction, ...]:
    """Return what may have made the points; the kind of a list is only asked if it may be any."""
    cameras, views = batch.survey.cameras, batch.views
    if cameras.lenses is None or cameras.rotations is None:
        return (BARE,)
    if views is None:
        given, auto = batch.survey.settings.camera_set, batch.survey.settings.method == "auto"
        return tuple(
            one for one in IN_FRAME if not auto or given in ("auto", one.changes["camera_set"])
        )
    if views.kind == "pairs":
        return (LISTED[2]._replace(kind="pairs"), LISTED[0])
    return LISTED if batch.survey.learned.matcher is not None else LISTED[:1]


def told_by(batch: Batch) -> Reconstruction:
    """Return the way in which the options say to correct points, limits of angles resolved."""
    settings, views = batch.survey.settings, batch.views
    changes: dict[str, Any] = {"method": settings.method, "max_angle": settings.max_angle}
    if views is None:
        changes["camera_set"] = "mvs" if settings.models_matcher else "all"
        changes["matcher"] = settings.matcher
    kind = None if views is None else views.kind
    for one in reconstructions_of(batch) if views is not None else IN_FRAME:
        if one.kind == kind and all(changes[name] == one.changes[name] for name in one.changes):
            return one
    return Reconstruction(settings.method, changes, kind)
