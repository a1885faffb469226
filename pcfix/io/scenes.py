"""Write a simulated scene as the files of a survey, and its truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.io.files import check_output, write_bytes
from pcfix.io.las.writing import write_points
from pcfix.model import BATHYMETRIC_POINT, Cameras, FloatArray, Views
from pcfix.options.declare import File
from pcfix.version import __version__

if TYPE_CHECKING:
    from pcfix.simulate.scene import Scene

GROUND = 2
CLOUDS = ("cloud.laz", "truth.laz", "lidar.laz")
"""The apparent cloud, the true position of each of its points, a reference with noise."""
_FINE_GSD_M = 0.005  # clouds of finer images get steps of 0.1 mm


def write_scene(scene: Scene, out_dir: File, *, overwrite: bool) -> None:
    """Write `CLOUDS`, the cameras, their sensor, view lists and ``scene.json`` into a folder."""
    folder = Path(out_dir)
    contents = {
        "sensor.csv": _sensor_csv(scene),
        "cameras.csv": _cameras_csv(scene.cameras, scene.yaw_pitch_roll_deg),
        "fused.ply.vis": colmap_vis(scene.views),
    }
    if scene.true_cameras is not scene.cameras:
        true = _cameras_csv(scene.true_cameras, scene.true_yaw_pitch_roll_deg)
        contents["true_cameras.csv"] = true
    plane = scene.water
    tilted = f"plane:{plane.a!r},{plane.b!r},{plane.c!r}"
    facts = {
        "made_by": f"pcfix {__version__}",
        "crs": f"EPSG:{scene.epsg}",
        "water": f"{plane.a!r}" if plane.b == plane.c == 0.0 else tilted,  # as --water takes it
        "water_level_m": scene.water_level_m,
        "refractive_index": scene.refractive_index,
        "gsd_m": scene.gsd_m,
        "arguments": scene.settings,
    }
    contents["scene.json"] = (json.dumps(facts, indent=2) + "\n").encode()
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*CLOUDS, *contents):
        check_output(folder / name, overwrite=overwrite)
    wet = scene.depth_m(scene.lidar_xyz) > 0.0
    classes = np.where(wet, BATHYMETRIC_POINT, GROUND).astype(np.uint8)
    depth = np.clip(scene.depth_m(scene.apparent_xyz) / 10.0, 0.0, 1.0)[:, None]
    sand, sea = np.array([[214, 196, 150]]), np.array([[22, 66, 110]])
    colours = np.asarray(np.rint(sand + depth * (sea - sand)) * 257.0)  # 16 bit, bluer with depth
    place = (scene.epsg, 0.001 if scene.gsd_m >= _FINE_GSD_M else 0.0001)
    write_points(folder / "cloud.laz", scene.apparent_xyz, place, colours)
    write_points(folder / "truth.laz", scene.true_xyz, place)
    write_points(folder / "lidar.laz", scene.lidar_xyz, place, classes=classes)
    for name, content in contents.items():
        write_bytes(folder / name, content, overwrite=overwrite)


def colmap_vis(views: Views) -> bytes:
    """Return view lists in the layout of COLMAP's ``fused.ply.vis``; see its reader."""
    counts = np.diff(views.start)
    words = np.insert(views.camera.astype("<u4"), views.start[:-1], counts)
    return len(counts).to_bytes(8, "little") + words.tobytes()


def _sensor_csv(scene: Scene) -> bytes:
    lens = None if scene.cameras.lenses is None else scene.cameras.lenses[0]
    values = dict(zip(("focal", "sensor_x", "sensor_y"), scene.sensor_mm, strict=True))
    if lens is not None and lens.radial:
        values = {"focal_px": lens.focal, "width_px": lens.width, "height_px": lens.height}
        values |= dict(zip(("k1", "k2", "k3"), lens.radial, strict=True))
        p1, p2 = lens.tangential
        values |= {"p1": p2, "p2": p1}  # OpenCV counts them the other way round
    return f"{','.join(values)}\n{','.join(map(repr, values.values()))}\n".encode()


def _cameras_csv(cameras: Cameras, yaw_pitch_roll_deg: FloatArray) -> bytes:
    text = "label,x,y,z,yaw,pitch,roll\n"
    for label, xyz, turn in zip(cameras.labels, cameras.centres, yaw_pitch_roll_deg, strict=True):
        numbers = [*(f"{v:.4f}" for v in xyz), *(f"{v:.6f}" for v in turn)]
        text += ",".join([label, *numbers]) + "\n"
    return text.encode()
