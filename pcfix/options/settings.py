"""What the user may choose; every door turns its user's words into these."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args

from pcfix.errors import SettingError

Uncorrected = Literal["keep", "withhold", "drop"]
Dimensions = Literal["all", "minimal", "none"]
Method = Literal[
    "snell", "consistent", "shan", "butler", "murase", "dietrich", "factor", "regression"
]
CameraSet = Literal["auto", "mvs", "all"]
Occlusion = Literal["auto", "on", "off"]
MatcherKind = Literal["depth-maps", "pairs"]
ViewsAre = Literal["auto", "tracks", "depth-maps"]

DEFAULT_REFRACTIVE_INDEX = 1.34


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """Standard deviations of what goes into a correction; see `pcfix.refract.uncertainty`.

    Attributes
    ----------
    image_px : float
        Of an image coordinate that the cloud was made from.
    level_m : float or None
        Of the height of the water surface. None: what its fit says, else `LEVEL_M`.
    tilt_deg : float
        Of the slope of the water surface, about each horizontal axis.
    index : float
        Of the refractive index.
    waves_deg : float
        Of the slope of the surface where each ray pierces it, independent from ray to ray.
    centre_m : float
        Of a projection centre, each axis, independent from image to image.
    attitude_deg : float
        Of the attitude of an image, about each axis, independent from image to image.
    """

    image_px: float = 0.5
    level_m: float | None = None
    tilt_deg: float = 0.0
    index: float = 0.002
    waves_deg: float = 0.0
    centre_m: float = 0.0
    attitude_deg: float = 0.0

    def __post_init__(self) -> None:
        """Check that none is negative."""
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            object.__setattr__(self, field.name, float(value))
            if not (math.isfinite(value) and value >= 0.0):
                name = field.name.rpartition("_")[0] or field.name
                raise SettingError(
                    f"sigma-{name} {value:g} must not be negative: give a standard deviation."
                )


LEVEL_M = 0.02
"""Standard deviation of a water level that nothing else is known of."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What the user may choose; every door turns its user's words into one of these.

    Attributes
    ----------
    refractive_index : float
        Water relative to air, 1.0 to 1.5.
    max_angle_deg : float or None
        Largest incidence angle in air of a ray that is used, from the surface normal.
    max_cameras : int or None
        Use at most so many rays a point, those with the smallest incidence angle.
    uncorrected : {"withhold", "keep", "drop"}
        What becomes of a submerged point with fewer than two usable rays.
    dimensions : {"all", "minimal", "none"}
        Extra dimensions to write.
    refractive_index_from : str
        Which water it is of, in words, where it was not given as a number.
    method : Method
        How the true point follows from the apparent one; see `pcfix.refract.methods`.
    camera_set : {"auto", "mvs", "all"}
        Which cameras made a point, where no list says it: those of a model of dense matching,
        or all in whose frame it lies; auto: the model with the method consistent, else all.
    occlusion : {"auto", "on", "off"}
        Whether cameras are left out to which the cloud itself hides the point; auto: where some
        are oblique.
    depth_factor : float or None
        With the method factor: true by apparent depth. None: the refractive index.
    least_r2 : float
        With the method regression: a fit with a lower coefficient of determination is refused.
    errors : ErrorBudget
        From which the standard errors of the points follow.
    matcher : {"depth-maps", "pairs"}
        With camera_set mvs and the method consistent: what the matcher made a point of, the
        weighted mean of depth maps (`pcfix.refract.depth_maps`) or the median of stereo pairs
        (`pcfix.refract.stereo_pairs`).
    """

    refractive_index: float = DEFAULT_REFRACTIVE_INDEX
    max_angle_deg: float | None = None
    max_cameras: int | None = None
    uncorrected: Uncorrected = "withhold"
    dimensions: Dimensions = "all"
    refractive_index_from: str = ""
    method: Method = "snell"
    camera_set: CameraSet = "auto"
    occlusion: Occlusion = "auto"
    depth_factor: float | None = None
    least_r2: float = 0.5
    errors: ErrorBudget = ErrorBudget()
    matcher: MatcherKind = "depth-maps"

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        object.__setattr__(self, "refractive_index", float(self.refractive_index))
        if self.max_angle_deg is not None:
            object.__setattr__(self, "max_angle_deg", float(self.max_angle_deg))
        n, angle, most = self.refractive_index, self.max_angle_deg, self.max_cameras
        if not (math.isfinite(n) and 1.0 <= n <= 1.5):
            raise SettingError(
                f"refractive index {n:g} is outside 1.0 to 1.5: give the index of water"
                " relative to air, about 1.333 for fresh and 1.34 for sea water."
            )
        if angle is not None and not 0.0 < angle <= 90.0:
            raise SettingError(
                f"max-angle {angle:g} is outside 0 to 90: give degrees from the surface normal."
            )
        if most is not None and most < 2:
            raise SettingError(
                f"max-cameras {most} is less than 2: an intersection needs two rays."
            )
        self._check_depths()
        for name, allowed in _CHOICES.items():
            value = getattr(self, name)
            if value not in get_args(allowed):
                raise SettingError(
                    f"{name.replace('_', '-')} '{value}' is not one of"
                    f" {', '.join(get_args(allowed))}."
                )

    @property
    def models_matcher(self) -> bool:
        """Whether a model of dense matching stands in for a list of views."""
        automatic = self.camera_set == "auto" and self.method == "consistent"
        return automatic or self.camera_set == "mvs"

    def _check_depths(self) -> None:
        factor, r2 = self.depth_factor, self.least_r2
        if factor is not None and not 1.0 <= factor <= 3.0:
            raise SettingError(
                f"depth-factor {factor:g} is outside 1 to 3: give true by apparent depth."
            )
        if factor is not None and self.method != "factor":
            raise SettingError("depth-factor is of no use without --method factor; give both.")
        if not 0.0 <= r2 <= 1.0:
            raise SettingError(f"least-r2 {r2:g} is outside 0 to 1.")


_CHOICES = {
    "uncorrected": Uncorrected,
    "dimensions": Dimensions,
    "method": Method,
    "camera_set": CameraSet,
    "occlusion": Occlusion,
    "matcher": MatcherKind,
}


@dataclass(frozen=True, slots=True)
class LabelSettings:
    """Which points count as submerged, beyond lying below the surface; see `pcfix.flow.label`.

    Attributes
    ----------
    band_m : float
        Points at most so far from the water surface, above or below, are water surface (class
        41); 0 for none.
    dead_band_m : float
        Points at most so far from it take the label of their surroundings; 0 for none.
    connected : bool
        Leave out pools that are apart from the water.
    least_pool_m2 : float or None
        With `connected`: pools of at least this area stay in. None: of at least a tenth of the
        largest water.
    respect_classes : tuple of int
        Points that come with one of these classes are never submerged.
    reset : bool
        Points that come as class 40 or 41 and are neither become class 1.
    """

    band_m: float = 0.0
    dead_band_m: float = 0.0
    connected: bool = False
    least_pool_m2: float | None = None
    respect_classes: tuple[int, ...] = ()
    reset: bool = False

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        for name in ("band", "dead_band"):
            value = float(getattr(self, f"{name}_m"))
            object.__setattr__(self, f"{name}_m", value)
            if not (math.isfinite(value) and value >= 0.0):
                raise SettingError(
                    f"{name.replace('_', '-')} {value:g} must not be negative: give metres from"
                    " the water surface, or 0 for none."
                )
        if 0.0 < self.dead_band_m <= self.band_m:
            raise SettingError(
                f"dead-band {self.dead_band_m:g} does not reach beyond band {self.band_m:g}, in"
                " which all points are class 41: give a wider dead band, or 0 for none."
            )
        self._check_pool()
        object.__setattr__(self, "respect_classes", _class_numbers(self.respect_classes))

    def _check_pool(self) -> None:
        least = self.least_pool_m2
        if least is None:
            return
        if not self.connected:
            raise SettingError("least-pool is of no use without connected; give both, or neither.")
        if not (math.isfinite(least) and least >= 0.0):
            raise SettingError(f"least-pool {least:g} must not be negative: give square metres.")
        object.__setattr__(self, "least_pool_m2", float(least))


def _class_numbers(given: tuple[int, ...]) -> tuple[int, ...]:
    """Return class numbers, each once, in order."""
    for number in given:
        if not 0 <= number <= 255:
            raise SettingError(
                f"respect-classes: {number} is no class of LAS; give numbers from 0 to 255."
            )
    return tuple(sorted({int(number) for number in given}))
