"""How wrong inputs come through to Z, measured, beside what the error budget says.

The method is `consistent` with known tracks. One input is wrong at a time, and the budget has that
one only. Level, index and tilt are common to the whole scene: measured is the mean change of Z
when the correction is given a value that is off by one standard deviation (of the tilt, about each
axis in turn, both changes added in quadrature, as the budget has it), predicted the mean sigma.
The others are random: the scene is simulated with them, of several seeds, as a block has few
poses; measured is the RMS error of Z, predicted the RMS of sigma.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import pcfix
from pcfix.model import WaterPlane
from pcfix.options.correct import BudgetOptions
from tests.benchmarks.accuracy_scenes import SETTINGS, measured_of

SCENES = ("flat", "oblique")
SEEDS = 5
LEVEL_M, INDEX, TILT = 0.05, 0.005, 0.001
CENTRE_M, ATTITUDE_DEG, WAVES_DEG = 0.03, 0.01, 1.0
NOTHING = BudgetOptions(sigma_image=0.0, sigma_level=0.0, sigma_index=0.0)
RANDOM = (
    ("image", "0.5 px", {"image_noise": 0.5}, {"image_px": 0.5}),
    ("image", "1 px", {"image_noise": 1.0}, {"image_px": 1.0}),
    ("centres", "3 cm", {"position_noise_m": CENTRE_M}, {"centre_m": CENTRE_M}),
    ("attitude", "0.01 deg", {"attitude_noise_deg": ATTITUDE_DEG}, {"attitude_deg": ATTITUDE_DEG}),
    ("waves", "1 deg", {"wave_slope_deg": WAVES_DEG}, {"waves_deg": WAVES_DEG}),
)
COLUMNS = [
    ("scene", "scene", ""),
    ("input", "input", ""),
    ("error", "wrong by", ""),
    ("bias_cm", "bias, cm", "+.2f"),
    ("measured_cm", "measured, cm", ".2f"),
    ("predicted_cm", "predicted, cm", ".2f"),
    ("ratio", "ratio", ".2f"),
]


def sensitivity(points: int, seed: int) -> list[dict[str, Any]]:
    """Return the rows of the table; random inputs have `SEEDS` scenes of fewer points."""
    rows = []
    for name in SCENES:
        quiet = _scene(name, points, seed)
        found = [*_common(quiet), *(_random(name, points // SEEDS, seed, *how) for how in RANDOM)]
        rows += [{"scene": name, **row} for row in found]
    return rows


def _scene(name: str, points: int, seed: int, **more: Any) -> Any:
    return pcfix.simulate_scene(points, seed=seed, **{**SETTINGS[name], "image_noise": 0.0, **more})


def _corrected(scene: Any, water: Any = None, n: float | None = None, **errors: float) -> Any:
    return pcfix.correct_points(
        scene.apparent_xyz,
        scene.cameras,
        scene.water if water is None else water,
        method="consistent",
        views=scene.views,
        index=scene.refractive_index if n is None else n,
        **vars(replace(NOTHING, **errors)),
    )


def _common(scene: Any) -> list[dict[str, Any]]:
    """Return the rows of level, index and tilt."""
    level, use = scene.water, measured_of(scene)
    right = _corrected(scene).xyz[use, 2]
    x, y = scene.cameras.centres[:, :2].mean(axis=0)
    tilts = (
        WaterPlane(level.a - TILT * x, level.b + TILT, level.c),
        WaterPlane(level.a - TILT * y, level.b, level.c + TILT),
    )

    def row(name: str, error: str, changes: list[np.ndarray], **sigma: float) -> dict[str, Any]:
        size = np.sqrt(np.sum(np.square(changes), axis=0)).mean()
        predicted = _corrected(scene, **sigma).sigma_z_m[use].mean()
        return _row(name, error, np.mean(changes), size, predicted)

    def change(**wrong: Any) -> np.ndarray:
        return _corrected(scene, **wrong).xyz[use, 2] - right

    higher = replace(level, a=level.a + LEVEL_M)
    n, tilt_deg = scene.refractive_index + INDEX, float(np.degrees(np.arctan(TILT)))
    return [
        row("level", "+5 cm", [change(water=higher)], level_m=LEVEL_M),
        row("index", "+0.005", [change(n=n)], index=INDEX),
        row("tilt", "0.1 %", [change(water=tilted) for tilted in tilts], tilt_deg=tilt_deg),
    ]


def _random(
    name: str, points: int, seed: int, what: str, size: str, made: dict, sigma: dict
) -> dict[str, Any]:
    """Return the row of an input that is wrong at random."""
    errors, predicted = [], []
    for one in range(seed, seed + SEEDS):
        scene = _scene(name, points, one, **made)
        found = _corrected(scene, **sigma)
        use = measured_of(scene) & found.corrected
        errors.append((found.xyz - scene.true_xyz)[use, 2])
        predicted.append(found.sigma_z_m[use])
    error = np.concatenate(errors)
    return _row(what, size, error.mean(), _rms(error), _rms(np.concatenate(predicted)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _row(what: str, error: str, bias: float, measured: float, predicted: float) -> dict[str, Any]:
    return {
        "input": what,
        "error": error,
        "bias_cm": 100.0 * float(bias),
        "measured_cm": 100.0 * float(measured),
        "predicted_cm": 100.0 * float(predicted),
        "ratio": float(measured / predicted) if predicted else None,
    }
