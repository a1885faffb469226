"""The settings of a simulated scene, checked together, and its lens."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pcfix.errors import SettingError
from pcfix.lens.imaging import project, unproject
from pcfix.model import FloatArray, Lens, WaterPlane
from pcfix.options.scenes import SceneOptions
from pcfix.simulate.terrain import BEDS
from pcfix.water.index import index_of


@dataclass(frozen=True, slots=True)
class Optics:
    """A lens, and the tangent of the angle from its axis to the farthest corner of the frame.

    *Ideal* pixels are those of a pinhole camera, *image* pixels those of the real lens.
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
