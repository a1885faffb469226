"""A laboratory flume with known truth: a gravel bed that falls away under still water.

A stand-in for the flume of Hsu & Wang, whose dimensions were not at hand: 6 m x 1 m, from the
waterline to 0.6 m of water, photographed from 3 m above it. Cameras and truth are known exactly,
only the image points have noise; so what remains after a correction is the correction's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.errors import SettingError
from pcfix.lens.rotations import from_yaw_pitch_roll
from pcfix.model import Cameras, FloatArray, Lens, Views
from pcfix.options.correct import ScienceOptions
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.simulate.sight import starts_of
from pcfix.simulate.tracing import piercing_points, project, triangulate

LENGTH_M, WIDTH_M, DEEPEST_M, GRAVEL_M = 6.0, 1.0, 0.6, 0.008
WATER_LEVEL_M = 1.0
CAMERA_HEIGHT_M, BASE_M, STRIPS_M, TILT_SD_DEG = 3.0, 0.6, (0.1, 0.9), 2.0
LENS = Lens(24.0 / 6.0e-3, 6000, 4000, 3000.0, 2000.0)  # 24 mm, 36 mm x 24 mm of 6 um
GSD_M = CAMERA_HEIGHT_M / LENS.focal
_LEAST_DEPTH_M = 0.01


@dataclass(frozen=True, eq=False)
class Flume:
    """What `simulate_flume` made; metres, x along the flume.

    Attributes
    ----------
    apparent_xyz, true_xyz : array, shape (n, 3)
        The points as SfM software would place them, and the truth, row by row; all submerged.
    cameras : Cameras
    views : Views
        The cameras that made each point.
    water_level_m, refractive_index : float
    """

    apparent_xyz: FloatArray
    true_xyz: FloatArray
    cameras: Cameras
    views: Views
    water_level_m: float
    refractive_index: float

    @property
    def true_depth_m(self) -> FloatArray:
        """Depth of the bed under the water, shape (n,)."""
        return self.water_level_m - self.true_xyz[:, 2]

    @property
    def apparent_depth_m(self) -> FloatArray:
        """What the cloud says it is, shape (n,)."""
        return self.water_level_m - self.apparent_xyz[:, 2]


def simulate_flume(
    points: int = 3000,
    *,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    image_noise_px: float = 0.5,
    seed: int = 1,
) -> Flume:
    """Make the flume and the cloud of its bed.

    Every point is traced through the water into every image that shows it, gets noise there, and
    is triangulated with straight rays from all of them.

    Raises
    ------
    SettingError
        If an argument is outside its rule.
    """
    ScienceOptions(index=refractive_index)
    if points < 1:
        raise SettingError(f"points {points} is less than 1.")
    if image_noise_px < 0.0:
        raise SettingError(f"image noise {image_noise_px:g} px is negative.")
    rng = np.random.default_rng(seed)
    bed, cameras = _bed(points, rng), _cameras(rng)
    point, camera = (pairs.ravel() for pairs in np.indices((points, len(cameras))))
    surface = piercing_points(bed[point], cameras.centres[camera], WATER_LEVEL_M, refractive_index)
    pixels, _ = project(surface, cameras, camera, LENS)
    inside = ((pixels >= 0.0) & (pixels < [LENS.width, LENS.height])).all(axis=1)
    point, camera, pixels = point[inside], camera[inside], pixels[inside]
    pixels = pixels + rng.normal(0.0, image_noise_px, pixels.shape)
    start = starts_of(point, points)
    return Flume(
        apparent_xyz=triangulate(pixels, cameras, camera, start, LENS, bed),
        true_xyz=bed,
        cameras=cameras,
        views=Views(start, camera),
        water_level_m=WATER_LEVEL_M,
        refractive_index=refractive_index,
    )


def _bed(points: int, rng: np.random.Generator) -> FloatArray:
    """Return random points of the bed: an even fall with gravel on it, always under water."""
    plan = rng.uniform(0.0, 1.0, (points, 2)) * [LENGTH_M, WIDTH_M]
    depth = DEEPEST_M * plan[:, 0] / LENGTH_M + rng.normal(0.0, GRAVEL_M, points)
    return np.column_stack([plan, WATER_LEVEL_M - np.clip(depth, _LEAST_DEPTH_M, DEEPEST_M)])


def _cameras(rng: np.random.Generator) -> Cameras:
    """Return two strips of images along the flume, nearly level, to half a frame beyond it."""
    along = np.arange(-2.0 * BASE_M, LENGTH_M + 2.5 * BASE_M, BASE_M)
    x, y = (side.ravel() for side in np.meshgrid(along, STRIPS_M))
    centres = np.column_stack([x, y, np.full(len(x), WATER_LEVEL_M + CAMERA_HEIGHT_M)])
    tilt = np.array([90.0, 0.0, 0.0]) + rng.normal(0.0, TILT_SD_DEG, (len(x), 3))
    return Cameras(
        labels=tuple(f"F{i + 1:02d}" for i in range(len(x))),
        centres=centres,
        rotations=from_yaw_pitch_roll(*tilt.T),
        lenses=(LENS,) * len(x),
    )
