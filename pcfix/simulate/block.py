"""Blocks as drones fly them: nadir strips, and obliques around them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.lens.rotations import from_yaw_pitch_roll
from pcfix.model import Cameras, FloatArray
from pcfix.simulate.settings import SceneSettings

OBLIQUE_PITCH_DEG = 20.0
ATTITUDE_SD_DEG = 1.5
PLACE_SD_M, USUAL_HEIGHT_M = 0.5, 80.0  # of a drone; below the usual height it shrinks with it
_RING_BASES, _RING_SPACINGS = 2.0, 1.5  # steps of a ring of obliques in those of the nadir images


def fly_block(
    extent_m: tuple[float, float], chosen: SceneSettings, rng: np.random.Generator
) -> tuple[Cameras, FloatArray]:
    """Cover a rectangle from the origin with images; strips run along x.

    Returns the cameras, and yaw, pitch and roll of each, degrees, shape (k, 3).
    """
    plan, attitude = _plan(extent_m, chosen)
    attitude = attitude + rng.normal(0.0, ATTITUDE_SD_DEG, attitude.shape)
    sd = PLACE_SD_M * min(1.0, chosen.flying_height_m / USUAL_HEIGHT_M)
    height = chosen.water + chosen.flying_height_m + rng.normal(0.0, sd, len(plan))
    centres = np.column_stack([plan + rng.normal(0.0, sd, plan.shape), height])
    cameras = Cameras(
        labels=tuple(f"IMG_{i + 1:04d}.JPG" for i in range(len(centres))),
        centres=centres,
        rotations=from_yaw_pitch_roll(*attitude.T),
        lenses=(chosen.optics.lens,) * len(centres),
    )
    return cameras, attitude


def misplaced(
    cameras: Cameras, attitude: FloatArray, chosen: SceneSettings, rng: np.random.Generator
) -> tuple[Cameras, FloatArray]:
    """Return cameras and angles with noise on every coordinate, and on yaw, pitch and roll."""
    if chosen.position_noise_m == chosen.attitude_noise_deg == 0.0:
        return cameras, attitude
    angles = attitude + rng.normal(0.0, chosen.attitude_noise_deg, attitude.shape)
    centres = cameras.centres + rng.normal(0.0, chosen.position_noise_m, attitude.shape)
    return replace(cameras, centres=centres, rotations=from_yaw_pitch_roll(*angles.T)), angles


def _plan(extent_m: tuple[float, float], chosen: SceneSettings) -> tuple[FloatArray, FloatArray]:
    """Return plan positions and yaw, pitch, roll, nadir images first."""
    base, spacing = chosen.base_and_spacing_m
    places, angles = [], []
    if chosen.oblique_share != 1.0:
        nadir = _grid(*extent_m, base, spacing)
        yaw = np.where(np.rint(nadir[:, 1] / spacing) % 2, 270.0, 90.0)  # to and fro
        places.append(nadir)
        angles.append(np.column_stack([yaw, np.zeros((len(nadir), 2))]))
    pitch = OBLIQUE_PITCH_DEG if chosen.obliques_deg is None else chosen.obliques_deg
    back = chosen.flying_height_m * np.tan(np.radians(pitch))
    directions = chosen.oblique_directions if chosen.has_obliques else 0
    share = chosen.oblique_share
    stretch = 1.0  # of the steps of a ring
    if share is not None and share != 1.0:
        density = share / (1.0 - share) / chosen.oblique_directions
        stretch = float(np.sqrt(1.0 / (_RING_BASES * _RING_SPACINGS) / density))
    steps = _RING_BASES * base * stretch, _RING_SPACINGS * spacing * stretch
    for heading in 360.0 / max(directions, 1) * np.arange(directions):
        away = back * np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
        ring = _grid(*extent_m, *steps) - away
        places.append(ring)
        angles.append(np.tile([heading, pitch, 0.0], (len(ring), 1)))
    return np.vstack(places), np.vstack(angles)


def _grid(length_m: float, width_m: float, base_m: float, spacing_m: float) -> FloatArray:
    """Return plan positions that reach half a step beyond the rectangle on every side."""
    x = np.arange(-base_m / 2.0, length_m + base_m, base_m)
    y = np.arange(-spacing_m / 2.0, width_m + spacing_m, spacing_m)
    return np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x))])
