"""The simulated camera, and blocks as drones fly them: nadir strips, and obliques around them.

The lens is reckoned by numpy alone: Brown's distortion and its inverse. *Ideal* pixels are those of
a pinhole with the lens's focal length and principal point; *image* pixels are those that the real
lens makes. The formula is that of `pcfix.model.Lens`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.lens.rotations import from_yaw_pitch_roll
from pcfix.model import Cameras, FloatArray, Lens
from pcfix.simulate.terrain import GREATEST_DEPTH_M

_NEWTON_STEPS = 50
_CONVERGED = 1e-14
_MARGIN = 1.02  # of the radius up to which a lens must not fold


@dataclass(frozen=True, slots=True)
class Optics:
    """A lens, and how far from the axis its frame reaches.

    Attributes
    ----------
    lens : Lens
        Pixels, perspective, `radial` of k1, k2, k3 and `tangential` of p1, p2, or neither.
    reach : float
        Tangent of the angle from the axis to the farthest corner of the frame.
    """

    lens: Lens
    reach: float

    @property
    def is_ideal(self) -> bool:
        """Whether there is no distortion."""
        return not (any(self.lens.radial) or any(self.lens.tangential))

    def to_image(self, ideal: FloatArray) -> FloatArray:
        """Return image pixels of ideal pixels, shape (m, 2)."""
        return ideal if self.is_ideal else self._pixels(_brown(self._plane(ideal), self.lens)[0])

    def to_ideal(self, image: FloatArray) -> FloatArray:
        """Return ideal pixels of image pixels, shape (m, 2)."""
        return image if self.is_ideal else self._pixels(_unbrown(self._plane(image), self.lens))

    def frames(self, ideal: FloatArray, image: FloatArray) -> np.ndarray:
        """Return which image points, given as both kinds of pixels, lie in the frame."""
        inside = ((image >= 0) & (image < [self.lens.width, self.lens.height])).all(axis=1)
        if self.is_ideal:
            return np.asarray(inside)
        # beyond the corner the polynomial may come back into the frame
        return np.asarray(inside & (np.hypot(*self._plane(ideal).T) <= _MARGIN * self.reach))

    def _plane(self, pixels: FloatArray) -> FloatArray:
        principal = [self.lens.principal_x, self.lens.principal_y]
        return np.asarray((pixels - principal) / self.lens.focal)

    def _pixels(self, plane: FloatArray) -> FloatArray:
        principal = [self.lens.principal_x, self.lens.principal_y]
        return np.asarray(plane * self.lens.focal + principal)


def make_optics(
    focal_mm: float,
    sensor_mm: tuple[float, float],
    sensor_px: tuple[int, int],
    distortion: tuple[float, ...] = (),
) -> Optics:
    """Return the optics of a camera.

    Parameters
    ----------
    focal_mm : float
    sensor_mm, sensor_px : tuple of 2
        Width and height of the sensor.
    distortion : tuple of float
        k1, k2, k3, p1, p2 of `pcfix.model.Lens`, or nothing.

    Raises
    ------
    SettingError
        If the distortion is so strong that the image folds inside the frame.
    """
    width, height = sensor_px
    focal = focal_mm / sensor_mm[0] * width
    radial, tangential = (distortion[:3], distortion[3:]) if any(distortion) else ((), ())
    lens = Lens(
        focal, width, height, width / 2.0, height / 2.0, radial=radial, tangential=tangential
    )
    if not radial:
        return Optics(lens, float(np.hypot(*sensor_mm) / 2.0 / focal_mm))
    return Optics(lens, _reach_of(lens))


def _reach_of(lens: Lens) -> float:
    """Return the largest distance from the axis, in the plane at unit distance, of the border."""
    along = np.linspace(-1.0, 1.0, 41)
    side = np.ones_like(along)
    edges = [(along, side), (along, -side), (side, along), (-side, along)]
    border = np.vstack([np.column_stack(edge) for edge in edges])
    border = border * [lens.width, lens.height] / (2.0 * lens.focal)
    ideal = _unbrown(border, lens)
    reach = float(np.hypot(*ideal.T).max())
    known = np.isfinite(reach) and reach < 10.0 * float(np.hypot(*border.T).max())
    if known:
        share = np.linspace(0.0, _MARGIN, 60)[:, None, None]
        _, (xx, xy, yy) = _brown((share * ideal).reshape(-1, 2), lens)
        there = np.abs(_brown(ideal, lens)[0] - border).max() < 1e-9
        known = bool(there and (xx > 0.0).all() and (xx * yy - xy * xy > 0.0).all())
    if not known:
        raise SettingError(
            f"the distortion {', '.join(f'{v:g}' for v in (*lens.radial, *lens.tangential))} folds"
            " the image inside the frame; give smaller k1, k2, k3, p1, p2."
        )
    return reach


def _brown(xy: FloatArray, lens: Lens) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return Brown's formula at places, shape (m, 2), and d x'/dx, d x'/dy = d y'/dx, d y'/dy."""
    (k1, k2, k3), (p1, p2) = lens.radial, lens.tangential
    x, y = xy.T
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    to_x = x * g + p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y
    to_y = y * g + p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y
    xx = g + 2.0 * x * x * slope + 6.0 * p1 * x + 2.0 * p2 * y
    across = 2.0 * x * y * slope + 2.0 * p1 * y + 2.0 * p2 * x
    yy = g + 2.0 * y * y * slope + 6.0 * p2 * y + 2.0 * p1 * x
    return np.column_stack([to_x, to_y]), (xx, across, yy)


def _unbrown(image: FloatArray, lens: Lens) -> FloatArray:
    """Return the inverse of Brown's formula by Newton's method, beginning at the image itself."""
    xy = image.copy()
    with np.errstate(all="ignore"):  # a lens that folds is found out by the caller
        for _ in range(_NEWTON_STEPS):
            there, (xx, across, yy) = _brown(xy, lens)
            (u, v), area = (image - there).T, xx * yy - across * across
            step = np.column_stack([yy * u - across * v, xx * v - across * u]) / area[:, None]
            xy = xy + step
            if not np.abs(step).max(initial=0.0) > _CONVERGED:
                break
    return xy


FOCAL_MM, SENSOR_MM, SENSOR_PX = 8.8, (13.2, 8.8), (5472, 3648)  # a common survey drone
FLYING_HEIGHT_M = 80.0
FORWARD_OVERLAP, SIDE_OVERLAP = 0.8, 0.7
OBLIQUE_PITCH_DEG = 20.0
ATTITUDE_SD_DEG = 1.5
PLACE_SD_M = 0.5  # of a drone; below the usual flying height it shrinks with the height
_RING_BASES, _RING_SPACINGS = 2.0, 1.5  # steps of a ring of obliques in those of the nadir images


class Block(NamedTuple):
    """Cameras with the angles that they were made from, degrees, shape (k, 3)."""

    cameras: Cameras
    yaw_pitch_roll_deg: FloatArray


@dataclass(frozen=True)
class Flight:
    """How a block is flown.

    Attributes
    ----------
    height_m : float
        Above the water.
    forward_overlap, side_overlap : float
        Of nadir images at the water surface.
    optics : Optics
    sensor : tuple of 3 float
        Focal length, width and height of the sensor, mm.
    obliques_deg : float
        Of oblique images, from straight down.
    directions : int
        Headings of obliques, evenly spaced from north; 0 for none.
    oblique_share : float or None
        Of the images; None: each direction has a third of the density of nadir images.
    """

    height_m: float = FLYING_HEIGHT_M
    forward_overlap: float = FORWARD_OVERLAP
    side_overlap: float = SIDE_OVERLAP
    optics: Optics = field(default_factory=lambda: make_optics(FOCAL_MM, SENSOR_MM, SENSOR_PX))
    sensor: tuple[float, float, float] = (FOCAL_MM, *SENSOR_MM)
    obliques_deg: float = OBLIQUE_PITCH_DEG
    directions: int = 0
    oblique_share: float | None = None

    @property
    def base_and_spacing_m(self) -> tuple[float, float]:
        """Distance between nadir images of a strip, and between strips."""
        focal, *sides = self.sensor
        width, height = (self.height_m * side / focal for side in sides)
        return height * (1.0 - self.forward_overlap), width * (1.0 - self.side_overlap)

    @property
    def gsd_m(self) -> float:
        """Ground size of a pixel at the water surface."""
        return self.height_m / self.optics.lens.focal

    @property
    def has_nadir(self) -> bool:
        """Whether there are nadir images."""
        return not (self.directions and self.oblique_share == 1.0)

    @property
    def ring_m(self) -> tuple[float, float]:
        """The steps of each direction's obliques along and across the strips."""
        base, spacing = self.base_and_spacing_m
        stretch = 1.0
        if self.has_nadir and self.oblique_share is not None:
            density = self.oblique_share / (1.0 - self.oblique_share) / self.directions
            stretch = float(np.sqrt(1.0 / (_RING_BASES * _RING_SPACINGS) / density))
        return _RING_BASES * base * stretch, _RING_SPACINGS * spacing * stretch


def lens() -> Lens:
    """Return the default lens in pixels."""
    return Flight().optics.lens


def gsd_m(flying_height_m: float) -> float:
    """Return the ground size of the default lens's pixel at the water surface."""
    return flying_height_m / lens().focal


def reach_m(
    cameras: Cameras,
    water_level_m: float,
    greatest_depth_m: float = GREATEST_DEPTH_M,
    optics: Optics | None = None,
) -> FloatArray:
    """Return how far from below each camera it can see anything, metres, shape (k,).

    Generous: the flattest ray of the frame's corner, prolonged as if there were no refraction.
    """
    if cameras.rotations is None:
        return np.full(len(cameras), np.inf)
    half_diagonal = np.arctan((optics or Flight().optics).reach)
    off_nadir = np.arccos(np.clip(-cameras.rotations[:, 2, 2], -1.0, 1.0))
    flattest = np.minimum(half_diagonal + off_nadir, np.radians(80.0))
    height = cameras.centres[:, 2] - water_level_m + greatest_depth_m
    return np.asarray(height * np.tan(flattest))


def fly(
    length_m: float,
    width_m: float,
    water_level_m: float,
    flying_height_m: float,
    *,
    obliques: bool,
    rng: np.random.Generator,
) -> Block:
    """Cover a rectangle from the origin with the default camera's images; see `fly_block`."""
    flight = Flight(height_m=flying_height_m, directions=4 if obliques else 0)
    return fly_block((length_m, width_m), water_level_m, flight, rng)


def fly_block(
    extent_m: tuple[float, float], water_level_m: float, flight: Flight, rng: np.random.Generator
) -> Block:
    """Cover a rectangle from the origin with images; strips run along x."""
    plan, attitude = _plan(extent_m, flight)
    attitude = attitude + rng.normal(0.0, ATTITUDE_SD_DEG, attitude.shape)
    sd = PLACE_SD_M * min(1.0, flight.height_m / FLYING_HEIGHT_M)
    height = water_level_m + flight.height_m + rng.normal(0.0, sd, len(plan))
    centres = np.column_stack([plan + rng.normal(0.0, sd, plan.shape), height])
    cameras = Cameras(
        labels=tuple(f"IMG_{i + 1:04d}.JPG" for i in range(len(centres))),
        centres=centres,
        rotations=from_yaw_pitch_roll(*attitude.T),
        lenses=(flight.optics.lens,) * len(centres),
    )
    return Block(cameras, attitude)


def misplaced(
    block: Block, position_noise_m: float, attitude_noise_deg: float, rng: np.random.Generator
) -> Block:
    """Return the block with noise on every coordinate, and on yaw, pitch and roll."""
    if position_noise_m == attitude_noise_deg == 0.0:
        return block
    k = len(block.cameras)
    angles = block.yaw_pitch_roll_deg + rng.normal(0.0, attitude_noise_deg, (k, 3))
    cameras = replace(
        block.cameras,
        centres=block.cameras.centres + rng.normal(0.0, position_noise_m, (k, 3)),
        rotations=from_yaw_pitch_roll(*angles.T),
    )
    return Block(cameras, angles)


def _plan(extent_m: tuple[float, float], flight: Flight) -> tuple[FloatArray, FloatArray]:
    """Return plan positions and yaw, pitch, roll, nadir images first."""
    base, spacing = flight.base_and_spacing_m
    places, angles = [], []
    if flight.has_nadir:
        nadir = _grid(*extent_m, base, spacing)
        yaw = np.where(np.rint(nadir[:, 1] / spacing) % 2, 270.0, 90.0)  # to and fro
        places.append(nadir)
        angles.append(np.column_stack([yaw, np.zeros((len(nadir), 2))]))
    back = flight.height_m * np.tan(np.radians(flight.obliques_deg))
    for heading in 360.0 / max(flight.directions, 1) * np.arange(flight.directions):
        away = back * np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
        ring = _grid(*extent_m, *flight.ring_m) - away
        places.append(ring)
        angles.append(np.tile([heading, flight.obliques_deg, 0.0], (len(ring), 1)))
    return np.vstack(places), np.vstack(angles)


def _grid(length_m: float, width_m: float, base_m: float, spacing_m: float) -> FloatArray:
    """Return plan positions that reach half a step beyond the rectangle on every side."""
    x = np.arange(-base_m / 2.0, length_m + base_m, base_m)
    y = np.arange(-spacing_m / 2.0, width_m + spacing_m, spacing_m)
    return np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x))])
