"""A block whose nadir images cover one half of the bed: obliques alone see the other."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import laspy
import numpy as np

from pcfix.adjust.transfer import renumbered
from pcfix.io.scenes import write_scene
from pcfix.model import BoolArray, Cameras, FloatArray, WaterPlane
from pcfix.simulate.scene import Scene, simulate_scene


@cache
def half_oblique() -> Scene:
    """Return the scene, under a water that falls by 1 %."""
    scene = simulate_scene(
        3000, seed=2, lidar_per_m2=0.1, obliques_deg=45.0, area_m=(70.0, 50.0), focal_mm=24.0,
        forward_overlap=0.7, side_overlap=0.6, tilt_percent=1.0,
    )  # fmt: skip
    whole, middle_m = scene.cameras, np.median(scene.xyz[:, 0])
    kept = np.flatnonzero((whole.rotations[:, 2, 2] > -0.9) | (whole.centres[:, 0] < middle_m))
    cameras = Cameras(
        tuple(whole.labels[i] for i in kept), whole.centres[kept], whole.rotations[kept],
        tuple(whole.lenses[i] for i in kept),
    )  # fmt: skip
    row = np.full(len(whole), -1)
    row[kept] = np.arange(len(kept))
    turn = scene.yaw_pitch_roll_deg[kept]
    views, _ = renumbered(scene.views, row)
    return replace(
        scene, cameras=cameras, true_cameras=cameras, yaw_pitch_roll_deg=turn, views=views
    )


def write_half_oblique(folder: Path) -> dict[str, str]:
    """Write it, some points withheld, as ``cloud.las``; return what ``pcfix correct`` needs."""
    scene = half_oblique()
    write_scene(scene, folder, overwrite=False)
    las = laspy.read(folder / "cloud.laz")
    las.withheld[:] = np.arange(len(las)) % 5 == 0
    las.write(folder / "cloud.las")
    water = scene.water
    return {
        "cameras": str(folder / "cameras.csv"),
        "water": f"plane:{water.a!r},{water.b!r},{water.c!r}",
    }


def seen_flat(xyz: FloatArray, cameras: Cameras, water: WaterPlane) -> BoolArray:
    """Return the points that have rays, and those beyond 35 degrees from the normal alone.

    Of cameras with one lens without distortion.
    """
    away = cameras.centres - xyz[:, None]
    x, y, z = np.moveaxis(np.einsum("kij,nkj->nki", cameras.rotations, -away), -1, 0)
    lens = cameras.lenses[0]
    u, v = lens.principal_x + lens.focal * x / z, lens.principal_y + lens.focal * y / z
    held = (z > 0.0) & (u >= 0.0) & (u <= lens.width) & (v >= 0.0) & (v <= lens.height)
    normal = np.array([-water.b, -water.c, 1.0])
    cosine = away @ normal / (np.linalg.norm(away, axis=2) * np.linalg.norm(normal))
    steepest = np.where(held, np.degrees(np.arccos(cosine)), np.inf).min(axis=1)
    return (steepest > 35.0) & np.isfinite(steepest)
