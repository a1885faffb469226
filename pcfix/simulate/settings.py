"""The settings of a simulated scene, checked together, its lens and its ground."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from pcfix.errors import SettingError
from pcfix.lens.imaging import project, unproject
from pcfix.model import FloatArray, Lens, WaterPlane
from pcfix.options.steps import BedKind, SceneOptions
from pcfix.water.index import index_of


@dataclass(frozen=True, slots=True)
class Optics:
    """A lens, the same without distortion, and the tangent of the most oblique ray in the frame.

    *Ideal* pixels are those of the pinhole camera, *image* pixels those of the real lens.
    """

    lens: Lens
    pinhole: Lens
    reach: float

    def to_image(self, ideal: FloatArray) -> FloatArray:
        """Return image pixels of ideal pixels, shape (m, 2); NaN beyond the fold of the lens."""
        if not self.lens.radial:
            return ideal
        return project(self.lens, unproject(self.pinhole, ideal))

    def to_ideal(self, image: FloatArray) -> FloatArray:
        """Return ideal pixels of image pixels, shape (m, 2)."""
        return project(self.pinhole, unproject(self.lens, image)) if self.lens.radial else image


class SceneSettings(SceneOptions):
    """The options of a scene, and what follows from them.

    The images have the true poses; the cloud is intersected with the given ones, which have noise.
    The water level is that of the mean plane in the middle of the area.
    """

    def check(self) -> None:
        """Check what options say together."""
        object.__setattr__(self, "index", index_of(self.index, self.index_formula)[0])
        pitch = [mm / px for mm, px in zip(self.sensor_mm, self.sensor_px, strict=True)]
        if not 0.98 < pitch[0] / pitch[1] < 1.02:
            um = [1000 * side for side in pitch]
            sentence = f"sensor_mm makes pixels of {um[0]:.3g} x {um[1]:.3g} um. Give square ones."
            raise SettingError("scene.pixels", sentence, pixel_um=um)
        # above the highest water of the area
        height = self.flying_height_m - self.water_tilt * float(np.hypot(*self.area_m)) / 2.0
        if height <= 0.5 * self.depth_m:
            sentence = f"{height:.4g} m is too low for a depth of {self.depth_m:g} m. Fly higher."
            raise SettingError("scene.too_low", sentence, height_m=height, depth_m=self.depth_m)
        if self.oblique_share is not None and not self.has_obliques:
            sentence = f"oblique share {self.oblique_share:g} needs obliques. Give their angle."
            raise SettingError("option.no_use", sentence, option="oblique_share")

    @property
    def has_obliques(self) -> bool:
        """Whether the block has oblique images."""
        return self.block == "oblique" or self.obliques_deg is not None

    @property
    def depth_m(self) -> float:
        """The greatest depth, as given or the default of the bed."""
        usual = BEDS[self.bed].default_depth_m
        return usual if self.greatest_depth_m is None else self.greatest_depth_m

    @property
    def water_tilt(self) -> float:
        """The slope of the mean water plane, m/m."""
        usual = 0.3 if self.bed == "river" else 0.0
        return (usual if self.tilt_percent is None else self.tilt_percent) / 100.0

    @cached_property
    def optics(self) -> Optics:
        """The lens of the camera; where it folds the image, nothing is seen."""
        width, height = self.sensor_px
        middle = np.array([width / 2.0, height / 2.0])
        pinhole = Lens(self.focal_mm / self.sensor_mm[0] * width, width, height, *middle.tolist())
        lens = pinhole
        if any(self.distortion):
            lens = replace(lens, radial=self.distortion[:3], tangential=self.distortion[3:])
        along = np.linspace(-1.0, 1.0, 41)
        side = np.ones_like(along)
        edges = [(along, side), (along, -side), (side, along), (-side, along)]
        rays = unproject(lens, np.hstack(edges).T * middle + middle)
        return Optics(lens, pinhole, float(np.nanmax(np.hypot(*(rays[:, :2] / rays[:, 2:]).T))))

    @property
    def base_and_spacing_m(self) -> tuple[float, float]:
        """Distance between nadir images of a strip, and between strips."""
        width, height = (self.flying_height_m * side / self.focal_mm for side in self.sensor_mm)
        return height * (1.0 - self.forward_overlap), width * (1.0 - self.side_overlap)

    @property
    def gsd_m(self) -> float:
        """Ground size of a pixel at the water surface."""
        return self.flying_height_m / self.optics.lens.focal

    def water_plane(self, extent_m: tuple[float, float]) -> WaterPlane:
        """Return the mean water plane over a rectangle from the origin."""
        if self.water_tilt == 0.0:
            return WaterPlane(self.water)
        heading = math.radians(self.tilt_heading_deg)
        b, c = (-self.water_tilt * part for part in (math.sin(heading), math.cos(heading)))
        return WaterPlane(self.water - (b * extent_m[0] + c * extent_m[1]) / 2.0, b, c)


# Made-up ground, as depth below the mean water plane: it tilts with the water

GREATEST_DEPTH_M = 12.0
STEPS = 6


@dataclass(frozen=True)
class Terrain:
    """A surface z(x, y) over a rectangle from the origin, below a mean water plane.

    `rocks`, shape (r, 4), are plan position, height and radius, metres, of a shore.
    """

    kind: BedKind
    length_m: float
    width_m: float
    water: WaterPlane
    greatest_depth_m: float
    rocks: FloatArray

    @classmethod
    def random(
        cls, kind: BedKind, extent_m: tuple[float, float], water: WaterPlane,
        greatest_depth_m: float, rng: np.random.Generator,
    ) -> "Terrain":  # fmt: skip
        """Make a terrain; a shore gets random rocks."""
        rocks = np.zeros((0, 4))
        if kind == "shore":
            count = int(extent_m[0] * extent_m[1] * (1.0 / 150.0))  # one in 150 m2
            place = rng.uniform(0.0, 1.0, (count, 2)) * extent_m
            size = np.column_stack([rng.uniform(0.2, 0.8, count), rng.uniform(0.5, 2.0, count)])
            rocks = np.column_stack([place, size])
        return cls(kind, *extent_m, water, greatest_depth_m, rocks)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z at plan positions, metres; never deeper than `greatest_depth_m`."""
        above = np.maximum(BEDS[self.kind].above_water(self, x, y), -self.greatest_depth_m)
        return np.asarray(self.water.a + self.water.b * x + self.water.c * y + above)


def _shore(ground: Terrain, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return land at x = 0, then beach and bed with swells, rocks and a ledge to deep water."""
    size = min(1.0, ground.greatest_depth_m / GREATEST_DEPTH_M)  # shallow shores are smoother
    land, share = 3.0 * size, np.maximum(x / ground.length_m, 0.0)
    slope = land - (land + ground.greatest_depth_m) * share**1.2
    swell = 0.4 * np.sin(x / 7.0) * np.cos(y / 9.0) + 0.15 * np.sin(x / 2.3 + y / 3.1)
    ledge = -0.6 * expit((x - 0.6 * ground.length_m - 0.1 * y) / 0.3)
    z = slope + size * swell + size * ledge
    if len(ground.rocks):
        distance, rock = cKDTree(ground.rocks[:, :2]).query(np.column_stack([x, y]))
        height, radius = ground.rocks[rock, 2:].T
        z = z + size * (height * np.exp(-((distance / radius) ** 2)))
    return np.asarray(z)


def _steps(ground: Terrain, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return `STEPS` level steps of equal length and height along x, as in a flume."""
    step = np.clip(np.floor(STEPS * (x / ground.length_m)) + 1.0, 1.0, STEPS)
    return np.asarray(-ground.greatest_depth_m * step / STEPS)


def _river(ground: Terrain, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return a winding channel along x with pools, and banks above the water."""
    turn = 2.0 * np.pi * x / ground.length_m
    middle = ground.width_m * (0.5 + 0.1 * np.sin(turn))
    across = (y - middle) / (0.35 * ground.width_m)
    pools = 0.8 + 0.2 * np.sin(3.0 * turn)
    deepest = ground.greatest_depth_m
    return np.asarray(np.minimum(-deepest * pools * (1.0 - across**2), 0.3 * deepest))


class Bed(NamedTuple):
    """A kind of bed: its usual greatest depth, and its height above the water at n places."""

    default_depth_m: float
    above_water: Callable[[Terrain, FloatArray, FloatArray], FloatArray]


# Flat: one depth everywhere; slope: from the waterline at x = 0 to the greatest depth at the end. A
# new kind is an entry here and in `BedKind`.
BEDS: dict[BedKind, Bed] = {
    "shore": Bed(GREATEST_DEPTH_M, _shore),
    "flat": Bed(3.0, lambda ground, x, y: np.full(len(x), -ground.greatest_depth_m)),
    "slope": Bed(6.0, lambda ground, x, y: -ground.greatest_depth_m * (x / ground.length_m)),
    "steps": Bed(6.0, _steps),
    "river": Bed(2.5, _river),
}
