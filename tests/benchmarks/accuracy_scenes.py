"""The scenes of `accuracy.py`: simulated blocks, and rendered ones that real software matched."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import map_coordinates

import pcfix
from pcfix.io.views import ViewMatch, read_views
from pcfix.model import Views
from tests.benchmarks.accuracy_floor import triangulated_again
from tests.utils.shared import needs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

LEAST_DEPTH_M = 0.2
FLOOR_POINTS = 1000
SHORE = {"bed": "shore", "lidar_per_m2": 0.0}
SETTINGS = {
    "flat": SHORE,
    "oblique": {**SHORE, "obliques_deg": 35.0, "detection": 0.5},
    "river": {"bed": "river", "lidar_per_m2": 0.0},  # falls by 0.3 %
    "pairs": {**SHORE, "cloud": "pairs"},
    "depth-maps": {**SHORE, "cloud": "depth-maps"},
}
"""Names of `pcfix.simulate.settings.SceneSettings`; the rest is its default."""
REAL = ("rendered_a", "rendered_c")
"""Clouds that COLMAP and OpenMVS made of rendered images, of the shared test data."""
NAMES = (*SETTINGS, *REAL)
BY_FRAME = {"mvs": {"camera_set": "mvs"}, "all": {"camera_set": "all"}}
"""What can be known without a list."""


@dataclass(frozen=True, eq=False)
class Case:
    """A cloud, what the correction is given, and how wrong a result is.

    Attributes
    ----------
    name, words : str
    xyz : array, shape (n, 3)
        As the software placed it, metres, world frame.
    cameras : Cameras
    water : WaterPlane
    refractive_index, gsd_m : float
    measured : array of bool, shape (n,)
        Points under more than `LEAST_DEPTH_M` of water, of which the errors are taken.
    knowledge : dict
        What is known of each point's cameras, as arguments of `pcfix.correct_points`.
    bed : array, shape (n, 3)
        The true points; of a scene with a true surface only, that at the apparent x and y.
    error : callable
        Of points, shape (m, 3), and their rows: result minus truth, metres; x and y are NaN
        where only the true surface is known.
    floor : array, shape (p, 3), or None where the images of a list did not make the point
        Errors of points that are triangulated through the water from fresh image points.
    """

    name: str
    words: str
    xyz: np.ndarray
    cameras: pcfix.Cameras
    water: pcfix.WaterPlane
    refractive_index: float
    gsd_m: float
    measured: np.ndarray
    bed: np.ndarray
    error: Callable[[np.ndarray, np.ndarray], np.ndarray]
    knowledge: dict[str, dict[str, Any]] = field(default_factory=dict)
    floor: np.ndarray | None = None


def make(name: str, points: int, seed: int) -> Case | None:
    """Return the scene of a name; None where its data are not there."""
    return rendered(name, points) if name in REAL else simulated(name, points, seed)


def simulated(name: str, points: int, seed: int) -> Case:
    """Simulate a scene of `SETTINGS`."""
    scene = pcfix.simulate_scene(points, seed=seed, **SETTINGS[name])
    measured = measured_of(scene)
    kind = "depth-maps" if name == "depth-maps" else "tracks"
    knowledge = {"views": {"views": replace(scene.views, kind=kind)}}
    if scene.pairs is not None:
        paired = Views(2 * scene.pairs_start, scene.pairs.ravel(), kind="pairs")
        knowledge["pairs"] = {"views": paired}
    return Case(
        name=name,
        words=scene.description,
        xyz=scene.apparent_xyz,
        cameras=scene.cameras,
        water=scene.water,
        refractive_index=scene.refractive_index,
        gsd_m=scene.gsd_m,
        measured=measured,
        bed=scene.true_xyz,
        error=lambda xyz, rows: xyz - scene.true_xyz[rows],
        knowledge={**knowledge, **_by_frame(scene)},
        floor=None if kind == "depth-maps" else _floor(scene, measured, seed),
    )


def _by_frame(scene: Any) -> dict[str, dict[str, Any]]:
    """Return the knowledge of cameras without a list; the model is of the scene's own matcher."""
    if scene.pairs is None:
        return BY_FRAME
    return {**BY_FRAME, "mvs": {**BY_FRAME["mvs"], "matcher": "pairs"}}


def measured_of(scene: Any) -> np.ndarray:
    """Return which points of a simulated scene are far enough under water, and were made."""
    made = np.diff(scene.views.start) > 1
    apparent = scene.depth_m(scene.apparent_xyz) > 0.0
    return made & apparent & (scene.depth_m(scene.true_xyz) > LEAST_DEPTH_M)


def _floor(scene: Any, measured: np.ndarray, seed: int) -> np.ndarray:
    """Return errors of refractive triangulation from the listed images, shape (p, 3)."""
    rng = np.random.default_rng([seed, 99])
    rows = np.flatnonzero(measured)
    rows = np.sort(rng.choice(rows, min(FLOOR_POINTS, len(rows)), replace=False))
    noise_px = scene.settings["image_noise"]
    truth = scene.true_xyz[rows]
    again = triangulated_again(
        truth, scene.views.take(rows), scene.true_cameras, scene.water,
        scene.refractive_index, noise_px, rng,
    )  # fmt: skip
    return again - truth


def rendered(name: str, points: int) -> Case | None:
    """Return the cloud that OpenMVS made of rendered images, about so many points of it."""
    folder, _ = needs(name)
    if not folder.exists():
        return None
    xyz, views, cameras = _rendered_cloud(folder, points)
    height = _true_surface(folder / "truth_dsm.tif")
    water, bed = pcfix.WaterPlane(0.37), xyz.copy()
    bed[:, 2] = height(xyz)

    def error(found: np.ndarray, _: np.ndarray) -> np.ndarray:
        unknown = np.full(len(found), np.nan)
        return np.column_stack([unknown, unknown, found[:, 2] - height(found)])

    return Case(
        name=name,
        words=f"{len(xyz):,} points, {len(cameras)} rendered images, COLMAP and OpenMVS",
        xyz=xyz,
        cameras=cameras,
        water=water,
        refractive_index=1.34,
        gsd_m=0.05,
        measured=(bed[:, 2] < water.a - LEAST_DEPTH_M) & (xyz[:, 2] < water.a),
        bed=bed,
        error=error,
        knowledge={"views": {"views": views}, **BY_FRAME},
    )


def _rendered_cloud(folder: Path, points: int) -> tuple[np.ndarray, Views, pcfix.Cameras]:
    """Return every so many points, the cameras of each as OpenMVS lists them, and all cameras."""
    import laspy

    local = pcfix.read_cameras(folder / "colmap")
    cameras = replace(local, centres=local.centres + np.loadtxt(folder / "offset.txt"))
    xyz = np.ascontiguousarray(laspy.read(folder / "cloud.las").xyz)
    match = ViewMatch(read_views(folder / "dense.vis", cameras), cameras, points=len(xyz))
    rows = np.arange(0, len(xyz), max(1, len(xyz) // points))
    return xyz[rows], match.for_chunk(xyz, 0).take(rows), cameras


def _true_surface(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Return the height of a raster at points, bilinear; NaN outside."""
    import rasterio

    with rasterio.open(path) as raster:
        heights, place = raster.read(1).astype(np.float64), ~raster.transform

    def height(xyz: np.ndarray) -> np.ndarray:
        column, row = place * (xyz[:, 0], xyz[:, 1])
        at = np.array([row - 0.5, column - 0.5])
        return map_coordinates(heights, at, order=1, cval=np.nan)

    return height
