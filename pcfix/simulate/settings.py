"""What a simulated scene can be asked for, and the rules of every value."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import WaterPlane
from pcfix.options import DEFAULT_REFRACTIVE_INDEX, Settings
from pcfix.simulate.block import (
    FLYING_HEIGHT_M,
    FOCAL_MM,
    FORWARD_OVERLAP,
    OBLIQUE_PITCH_DEG,
    SENSOR_MM,
    SENSOR_PX,
    SIDE_OVERLAP,
    Flight,
    Optics,
    make_optics,
)
from pcfix.simulate.terrain import BEDS, BedKind

BlockKind = Literal["nadir", "oblique"]
CloudKind = Literal["tracks", "pairs", "depth-maps"]

RIVER_TILT_PERCENT = 0.3
_NEIGHBOURS = {"tracks": 0, "pairs": 4, "depth-maps": 5}

# name in messages, unit, least, most, what to give
_RULES: dict[str, tuple[str, str, float, float, str]] = {
    "flying_height_m": ("flying height", " m", 0.5, 10_000, "the height above the water"),
    "focal_mm": ("focal length", " mm", 0.5, 2000, "that of the lens"),
    "forward_overlap": ("forward overlap", "", 0.3, 0.95, "the share of an image in the next"),
    "side_overlap": ("side overlap", "", 0.0, 0.95, "the share of a strip in the next"),
    "obliques_deg": ("obliques", " deg", 1, 60, "the angle from straight down"),
    "oblique_directions": ("oblique directions", "", 1, 36, "how many ways obliques look"),
    "oblique_share": ("oblique share", "", 0.01, 1.0, "the share of images that are obliques"),
    "position_noise_m": ("position noise", " m", 0, 100, "a standard deviation"),
    "attitude_noise_deg": ("attitude noise", " deg", 0, 5, "a standard deviation"),
    "image_noise_px": ("image noise", " px", 0, 100, "a standard deviation"),
    "wave_slope_deg": ("wave slope", " deg", 0, 10, "the standard deviation along one axis"),
    "wave_length_m": ("wavelength", " m", 0.01, 1000, "from crest to crest"),
    "tilt_percent": ("tilt", " %", 0, 20, "how far the water falls in 100 m"),
    "tilt_heading_deg": ("tilt heading", " deg", -360, 360, "where the water falls to, from north"),
    "greatest_depth_m": ("greatest depth", " m", 0.01, 1000, "metres below the water"),
    "detection": ("detection", "", 0.01, 1.0, "a probability"),
    "neighbours": ("neighbours", "", 1, 20, "how many images each is matched with"),
    "lidar_per_m2": ("lidar density", " points/m2", 0, 10_000, "points per square metre"),
    "lidar_noise_m": ("lidar noise", " m", 0, 10, "a standard deviation"),
}


@dataclass(frozen=True)
class SceneSettings:
    """The arguments of `simulate_scene`.

    Attributes
    ----------
    points : int
        Points of the cloud.
    block : {"nadir", "oblique"}
        Strips of nadir images, or obliques around them as well.
    cameras : int, optional
        About so many nadir images; the area grows or shrinks with it. Default: as it needs.
    refractive_index, water_level_m : float
        The level is that of the mean water plane in the middle of the area.
    image_noise_px : float
        Standard deviation of an image coordinate, pixels.
    seed : int
        The same seed gives the same scene. Position and attitude noise, waves, detection and
        the noise of dense matching have random numbers of their own: switching one on changes
        neither terrain nor block.
    area_m : tuple of 2 float
        Extent in x (along the strips) and y.
    flying_height_m : float
        Above the water.
    focal_mm : float
    sensor_mm, sensor_px : tuple of 2
        Width and height of the sensor; pixels are square.
    distortion : tuple of 5 float
        Brown's k1, k2, k3, p1, p2 as in `pcfix.model.Lens` (Metashape's order), known to the
        user. All zero: an ideal lens.
    forward_overlap, side_overlap : float
        Shares of nadir images at the water surface.
    obliques_deg : float, optional
        Angle of obliques from straight down; giving one makes the block oblique. Default 20.
    oblique_directions : int
        Headings from which obliques look, evenly spaced from north.
    oblique_share : float, optional
        Share of the block's images that are obliques; 1: no nadir images. Default: each
        direction has a third of the density of the nadir images.
    position_noise_m, attitude_noise_deg : float
        Standard deviation of each coordinate of the projection centres, and of yaw, pitch and
        roll, of the cameras that the user is given. The images are made with the true ones, the
        cloud is intersected with the given ones.
    wave_slope_deg : float
        Standard deviation of the slope of the water along either axis; see
        `pcfix.simulate.tracing`.
    wave_length_m : float
    tilt_percent : float, optional
        How steeply the mean water plane falls. Default: 0, of a river 0.3.
    tilt_heading_deg : float
        Where it falls to, clockwise from north.
    bed : {"shore", "flat", "slope", "steps", "river"}
        See `pcfix.simulate.terrain`.
    greatest_depth_m : float, optional
        Default: shore 12, flat 3, slope and steps 6, river 2.5.
    cloud : {"tracks", "pairs", "depth-maps"}
        How the cloud is made of the images: every image that shows a point at once, the median
        of stereo pairs (see `pcfix.simulate.sight`), or the weighted mean of depth maps.
    detection : float
        Probability that an image that shows a point takes part in it; three at least do.
    neighbours : int, optional
        Images that each is matched with. Default: pairs 4, depth maps 5.
    lidar_per_m2, lidar_noise_m : float
        Density of the reference cloud and the standard deviation of its heights.
    """

    points: int = 100_000
    block: BlockKind = "nadir"
    cameras: int | None = None
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX
    water_level_m: float = 0.37
    image_noise_px: float = 0.5
    seed: int = 1
    area_m: tuple[float, float] = (120.0, 80.0)
    flying_height_m: float = FLYING_HEIGHT_M
    focal_mm: float = FOCAL_MM
    sensor_mm: tuple[float, float] = SENSOR_MM
    sensor_px: tuple[int, int] = SENSOR_PX
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    forward_overlap: float = FORWARD_OVERLAP
    side_overlap: float = SIDE_OVERLAP
    obliques_deg: float | None = None
    oblique_directions: int = 4
    oblique_share: float | None = None
    position_noise_m: float = 0.0
    attitude_noise_deg: float = 0.0
    wave_slope_deg: float = 0.0
    wave_length_m: float = 1.0
    tilt_percent: float | None = None
    tilt_heading_deg: float = 90.0
    bed: BedKind = "shore"
    greatest_depth_m: float | None = None
    cloud: CloudKind = "tracks"
    detection: float = 1.0
    neighbours: int | None = None
    lidar_per_m2: float = 2.0
    lidar_noise_m: float = 0.05

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        for name in ("area_m", "sensor_mm", "sensor_px", "distortion"):
            object.__setattr__(self, name, tuple(getattr(self, name)))  # JSON has lists
        Settings(refractive_index=self.refractive_index)
        choices = {"block": get_args(BlockKind), "bed": BEDS, "cloud": _NEIGHBOURS}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise SettingError(
                    f"{name} '{getattr(self, name)}' is not one of {', '.join(allowed)}."
                )
        for name, rule in _RULES.items():
            _check_range(getattr(self, name), *rule)
        self._check_counts()
        self._check_shapes()
        self._check_together()

    def _check_counts(self) -> None:
        if self.points < 1:
            raise SettingError(f"points {self.points} is less than 1.")
        if self.cameras is not None and self.cameras < 9:
            raise SettingError(
                f"cameras {self.cameras} is less than 9: a block needs some overlap."
            )
        if self.seed < 0:
            raise SettingError(f"seed {self.seed} is negative: give a whole number from 0.")
        if not math.isfinite(self.water_level_m):
            raise SettingError(f"water level {self.water_level_m} must be a finite height, m.")

    def _check_shapes(self) -> None:
        for name, count in (("area_m", 2), ("sensor_mm", 2), ("sensor_px", 2), ("distortion", 5)):
            values = getattr(self, name)
            if len(values) != count or not np.isfinite(values).all():
                raise SettingError(f"{name} {values} must be {count} finite numbers.")
            if name != "distortion" and min(values) <= 0:
                raise SettingError(f"{name} {values} must be positive: width and height.")
        pitch = [mm / px for mm, px in zip(self.sensor_mm, self.sensor_px, strict=True)]
        if not 0.98 < pitch[0] / pitch[1] < 1.02:
            raise SettingError(
                f"sensor_mm {self.sensor_mm} and sensor_px {self.sensor_px} make pixels of"
                f" {1000 * pitch[0]:.3g} x {1000 * pitch[1]:.3g} um: give one with square pixels."
            )

    def _check_together(self) -> None:
        if self.flying_height_m <= 0.5 * self.depth_m:
            raise SettingError(
                f"flying height {self.flying_height_m:g} m is not more than half the greatest"
                f" depth {self.depth_m:g} m: the land would come too near; fly higher or give a"
                " smaller greatest depth."
            )
        rise = self.water_tilt * float(np.hypot(*self.area_m))
        if rise > 0.25 * self.flying_height_m:
            raise SettingError(
                f"tilt {100 * self.water_tilt:g} % makes the water fall {rise:.3g} m over the area,"
                f" too much below a flight at {self.flying_height_m:g} m: give a smaller one."
            )
        if self.neighbours is not None and self.cloud == "tracks":
            raise SettingError(
                "neighbours belong to the clouds of pairs and depth maps: give one of those, or"
                " leave them out."
            )
        if self.oblique_share is not None and not self.has_obliques:
            raise SettingError(
                f"oblique share {self.oblique_share:g} needs obliques: give the block oblique, or"
                " their angle."
            )

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
        if self.tilt_percent is None:
            return RIVER_TILT_PERCENT / 100.0 if self.bed == "river" else 0.0
        return self.tilt_percent / 100.0

    @property
    def matched_with(self) -> int:
        """How many images each is matched with."""
        return _NEIGHBOURS[self.cloud] if self.neighbours is None else self.neighbours

    @property
    def flight(self) -> Flight:
        """How the block is flown."""
        return Flight(
            height_m=self.flying_height_m,
            forward_overlap=self.forward_overlap,
            side_overlap=self.side_overlap,
            optics=self.optics,
            sensor=(self.focal_mm, *self.sensor_mm),
            obliques_deg=OBLIQUE_PITCH_DEG if self.obliques_deg is None else self.obliques_deg,
            directions=self.oblique_directions if self.has_obliques else 0,
            oblique_share=self.oblique_share,
        )

    @property
    def optics(self) -> Optics:
        """The camera's."""
        return make_optics(self.focal_mm, self.sensor_mm, self.sensor_px, self.distortion)

    def water_plane(self, extent_m: tuple[float, float]) -> WaterPlane:
        """Return the mean water plane over a rectangle from the origin."""
        if self.water_tilt == 0.0:
            return WaterPlane(self.water_level_m)
        heading = math.radians(self.tilt_heading_deg)
        b, c = (-self.water_tilt * way for way in (math.sin(heading), math.cos(heading)))
        return WaterPlane(self.water_level_m - (b * extent_m[0] + c * extent_m[1]) / 2.0, b, c)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON and for `simulate_scene`."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


def _check_range(
    value: float | None, name: str, unit: str, least: float, most: float, what: str
) -> None:
    if value is None or least <= value <= most:
        return
    if least == 0 and value < 0:
        raise SettingError(f"{name} {value:g}{unit} is negative: give {what}.")
    raise SettingError(f"{name} {value:g}{unit} is outside {least:g} to {most:g}: give {what}.")
