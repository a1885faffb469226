"""Image blocks as drones fly them: strips of nadir images, and obliques around them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.io.cameras.table import rotations_from_yaw_pitch_roll
from pcfix.model import Cameras, FloatArray, Lens
from pcfix.simulate.terrain import GREATEST_DEPTH_M

FOCAL_MM, SENSOR_MM, SENSOR_PX = 8.8, (13.2, 8.8), (5472, 3648)  # a common survey drone
FORWARD_OVERLAP, SIDE_OVERLAP = 0.8, 0.7
OBLIQUE_PITCH_DEG = 20.0
ATTITUDE_SD_DEG = 1.5


class Block(NamedTuple):
    """Cameras with the angles that they were made from, degrees, shape (k, 3)."""

    cameras: Cameras
    yaw_pitch_roll_deg: FloatArray


def lens() -> Lens:
    """Return the lens in pixels."""
    width, height = SENSOR_PX
    return Lens(FOCAL_MM / SENSOR_MM[0] * width, width, height, width / 2.0, height / 2.0)


def gsd_m(flying_height_m: float) -> float:
    """Return the ground size of a pixel at the water surface."""
    return flying_height_m / lens().focal


def base_and_spacing_m(flying_height_m: float) -> tuple[float, float]:
    """Return the distance between images of a strip, and between strips."""
    width, height = (flying_height_m * side / FOCAL_MM for side in SENSOR_MM)
    return height * (1.0 - FORWARD_OVERLAP), width * (1.0 - SIDE_OVERLAP)


def reach_m(cameras: Cameras, water_level_m: float) -> FloatArray:
    """Return how far from below each camera it can see anything, metres, shape (k,).

    Generous: the flattest ray of the frame's corner, prolonged as if there were no refraction.
    """
    if cameras.rotations is None:
        return np.full(len(cameras), np.inf)
    half_diagonal = np.arctan(np.hypot(*SENSOR_MM) / 2.0 / FOCAL_MM)
    off_nadir = np.arccos(np.clip(-cameras.rotations[:, 2, 2], -1.0, 1.0))
    flattest = np.minimum(half_diagonal + off_nadir, np.radians(80.0))
    height = cameras.centres[:, 2] - water_level_m + GREATEST_DEPTH_M
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
    """Cover a rectangle from the origin with images; strips run along x."""
    base, spacing = base_and_spacing_m(flying_height_m)
    nadir = _grid(length_m, width_m, base, spacing)
    yaw = np.where(np.rint(nadir[:, 1] / spacing) % 2, 270.0, 90.0)  # to and fro
    places, angles = [nadir], [np.column_stack([yaw, np.zeros((len(nadir), 2))])]
    if obliques:
        back = flying_height_m * np.tan(np.radians(OBLIQUE_PITCH_DEG))
        for heading in (0.0, 90.0, 180.0, 270.0):
            away = back * np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
            ring = _grid(length_m, width_m, 2.0 * base, 1.5 * spacing) - away
            places.append(ring)
            angles.append(np.tile([heading, OBLIQUE_PITCH_DEG, 0.0], (len(ring), 1)))
    plan, attitude = np.vstack(places), np.vstack(angles)
    attitude = attitude + rng.normal(0.0, ATTITUDE_SD_DEG, attitude.shape)
    height = water_level_m + flying_height_m + rng.normal(0.0, 0.5, len(plan))
    centres = np.column_stack([plan + rng.normal(0.0, 0.5, plan.shape), height])
    cameras = Cameras(
        labels=tuple(f"IMG_{i + 1:04d}.JPG" for i in range(len(centres))),
        centres=centres,
        rotations=rotations_from_yaw_pitch_roll(*attitude.T),
        lenses=(lens(),) * len(centres),
    )
    return Block(cameras, attitude)


def _grid(length_m: float, width_m: float, base_m: float, spacing_m: float) -> FloatArray:
    """Return plan positions that reach half a step beyond the rectangle on every side."""
    x = np.arange(-base_m / 2.0, length_m + base_m, base_m)
    y = np.arange(-spacing_m / 2.0, width_m + spacing_m, spacing_m)
    return np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x))])
