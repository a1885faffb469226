"""A whole scene: shore, images, and the cloud that SfM software would have made of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import Cameras, FloatArray, Views
from pcfix.settings import DEFAULT_REFRACTIVE_INDEX, Settings
from pcfix.simulate.block import FOCAL_MM, SENSOR_MM, base_and_spacing_m, fly, gsd_m, lens, reach_m
from pcfix.simulate.terrain import Shore
from pcfix.simulate.tracing import piercing_points, project, triangulate

if TYPE_CHECKING:
    from collections.abc import Callable

BlockKind = Literal["nadir", "oblique"]

ORIGIN_M = np.array([410_200.0, 4_650_300.0, 0.0])  # in UTM zone 33 north
EPSG = 32633
FLYING_HEIGHT_M = 80.0
LENGTH_M, WIDTH_M = 120.0, 80.0
LIDAR_PER_M2, LIDAR_NOISE_M = 2.0, 0.05
LEAST_VIEWS = 3
_PAIRS_AT_ONCE = 2_000_000


@dataclass(frozen=True, eq=False)
class Scene:
    """What `simulate_scene` made; metres, UTM.

    Attributes
    ----------
    apparent_xyz, true_xyz : array, shape (n, 3)
        The cloud as SfM software would place it, and the truth, row by row.
    views : Views
        The cameras that made each point.
    cameras : Cameras
    yaw_pitch_roll_deg : array, shape (k, 3)
    lidar_xyz : array, shape (m, 3)
        A reference cloud of the true surface with noise.
    water_level_m, refractive_index, gsd_m : float
    sensor_mm : tuple of float
        Focal length, sensor width and height.
    epsg : int
    settings : dict
        The arguments that made it.
    """

    apparent_xyz: FloatArray
    true_xyz: FloatArray
    views: Views
    cameras: Cameras
    yaw_pitch_roll_deg: FloatArray
    lidar_xyz: FloatArray
    water_level_m: float
    refractive_index: float
    gsd_m: float
    sensor_mm: tuple[float, float, float]
    epsg: int
    settings: dict[str, Any]

    @property
    def description(self) -> str:
        """One line about the scene."""
        per_point = len(self.views.camera) / len(self.true_xyz)
        return (
            f"{len(self.true_xyz):,} points seen by {per_point:.0f} of {len(self.cameras)} cameras"
            f" each, GSD {100.0 * self.gsd_m:.1f} cm, water level {self.water_level_m:g} m,"
            f" refractive index {self.refractive_index:g}"
        )


def simulate_scene(
    points: int = 100_000,
    *,
    block: BlockKind = "nadir",
    cameras: int | None = None,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    water_level_m: float = 0.37,
    image_noise_px: float = 0.5,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Make a scene with known truth: a shore from land to 12 m deep under a block of images.

    Every point is traced through the level water surface into every image that shows it; the
    image points get noise; straight rays through them are triangulated with the least
    reprojection error, as software that knows nothing of water does. Poses and lens are true.

    Parameters
    ----------
    points : int
        Points of the cloud.
    block : {"nadir", "oblique"}
        Strips of nadir images, or obliques of 20 degrees from four sides as well.
    cameras : int, optional
        About so many nadir images; the area grows or shrinks with it. Default: 120 m x 80 m.
    refractive_index, water_level_m : float
    image_noise_px : float
        Standard deviation of an image coordinate, pixels.
    seed : int
        The same seed gives the same scene.
    progress : callable, optional
        Called with (points done, points in all).

    Returns
    -------
    Scene

    Raises
    ------
    SettingError
        If an argument is outside its rule.
    """
    _check(points, block, cameras, image_noise_px, refractive_index)
    rng = np.random.default_rng(seed)
    length, width = _extent(cameras)
    shore = Shore.random(length, width, water_level_m, rng)
    flown = fly(length, width, water_level_m, FLYING_HEIGHT_M, obliques=block == "oblique", rng=rng)
    truth = _on(shore, points, rng)
    parts, done = [], 0
    at_once = max(1, _PAIRS_AT_ONCE // len(flown.cameras))
    for first in range(0, points, at_once):
        part = truth[first : first + at_once]
        noise = (image_noise_px, rng)
        parts.append(_observe(part, flown.cameras, water_level_m, refractive_index, noise))
        done += len(part)
        if progress is not None:
            progress(done, points)
    counts = np.concatenate([np.diff(views.start) for _, views in parts])
    views = Views(
        np.concatenate([[0], np.cumsum(counts)]), np.concatenate([v.camera for _, v in parts])
    )
    lidar = _on(shore, round(length * width * LIDAR_PER_M2), rng)
    lidar[:, 2] += rng.normal(0.0, LIDAR_NOISE_M, len(lidar))
    return Scene(
        apparent_xyz=np.vstack([apparent for apparent, _ in parts]) + ORIGIN_M,
        true_xyz=truth + ORIGIN_M,
        views=views,
        cameras=replace(flown.cameras, centres=flown.cameras.centres + ORIGIN_M),
        yaw_pitch_roll_deg=flown.yaw_pitch_roll_deg,
        lidar_xyz=lidar + ORIGIN_M,
        water_level_m=water_level_m,
        refractive_index=refractive_index,
        gsd_m=gsd_m(FLYING_HEIGHT_M),
        sensor_mm=(FOCAL_MM, *SENSOR_MM),
        epsg=EPSG,
        settings={
            "points": points,
            "block": block,
            "cameras": cameras,
            "refractive_index": refractive_index,
            "water_level_m": water_level_m,
            "image_noise_px": image_noise_px,
            "seed": seed,
        },
    )


def _check(points: int, block: str, cameras: int | None, noise: float, index: float) -> None:
    Settings(refractive_index=index)
    if points < 1:
        raise SettingError(f"points {points} is less than 1.")
    if block not in ("nadir", "oblique"):
        raise SettingError(f"block '{block}' is not one of nadir, oblique.")
    if cameras is not None and cameras < 9:
        raise SettingError(f"cameras {cameras} is less than 9: a block needs some overlap.")
    if noise < 0.0:
        raise SettingError(f"image noise {noise:g} px is negative.")


def _extent(cameras: int | None) -> tuple[float, float]:
    """Return length and width of the area that about so many nadir images cover."""
    if cameras is None:
        return LENGTH_M, WIDTH_M
    base, spacing = base_and_spacing_m(FLYING_HEIGHT_M)
    side = float(np.sqrt(cameras * base * spacing * LENGTH_M / WIDTH_M))
    length = max(side - 1.5 * base, base)
    return length, max(cameras * base * spacing / side - 1.5 * spacing, spacing / 2.0)


def _on(shore: Shore, count: int, rng: np.random.Generator) -> FloatArray:
    """Return random points of the surface, west to east in narrow bands, as matchers write."""
    plan = rng.uniform(0.0, 1.0, (count, 2)) * [shore.length_m, shore.width_m]
    plan = plan[np.lexsort((plan[:, 0], np.floor(plan[:, 1])))]
    return np.column_stack([plan, shore.height(*plan.T)])


def _observe(
    truth: FloatArray,
    cameras: Cameras,
    water_level_m: float,
    refractive_index: float,
    noise: tuple[float, np.random.Generator],
) -> tuple[FloatArray, Views]:
    """Return the apparent points and their views; with too few views a point is not moved."""
    optics = lens()
    across = truth[:, None, 0] - cameras.centres[:, 0], truth[:, None, 1] - cameras.centres[:, 1]
    point, camera = np.nonzero(np.hypot(*across) < reach_m(cameras, water_level_m))
    surface = piercing_points(
        truth[point], cameras.centres[camera], water_level_m, refractive_index
    )
    pixels, z = project(surface, cameras, camera, optics)
    inside = (z > 0) & ((pixels >= 0) & (pixels < [optics.width, optics.height])).all(axis=1)
    count = np.bincount(point[inside], minlength=len(truth))
    inside &= count[point] >= LEAST_VIEWS
    point, camera, pixels = point[inside], camera[inside], pixels[inside]
    pixels = pixels + noise[1].normal(0.0, noise[0], pixels.shape)
    start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(truth)))])
    made = np.diff(start) > 0
    apparent = truth.copy()
    if made.any():
        starts = np.concatenate([start[:-1][made], start[-1:]])
        apparent[made] = triangulate(pixels, cameras, camera, starts, optics, truth[made])
    return apparent, Views(start, camera)
