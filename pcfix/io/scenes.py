"""Write a simulated scene as the files that a surveyor would have, and its truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import laspy
import numpy as np
from pyproj import CRS

import pcfix
from pcfix.io.files import check_output, write_text
from pcfix.io.las.columns import BATHYMETRIC_POINT
from pcfix.io.las.sink import LasSink

if TYPE_CHECKING:
    import os

    from pcfix.model import FloatArray
    from pcfix.simulate.scene import Scene

GROUND = 2
FILES = {
    "cloud.laz": "the cloud as SfM software that knows nothing of water makes it",
    "truth.laz": "the true position of each of its points, row by row",
    "lidar.laz": "a reference cloud with noise, as bathymetric LiDAR gives; 2 land, 40 bed",
    "cameras.csv": "label, x, y, z, yaw, pitch, roll of each image",
    "sensor.csv": "focal length and sensor size, mm",
    "scene.json": "water level, refractive index, GSD, and the arguments that made the scene",
}


def write_scene(scene: Scene, out_dir: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Write the files of `FILES` into a folder, made if need be.

    Raises
    ------
    SettingError
        If one of them exists and `overwrite` is not set; then none is written.
    """
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        check_output(folder / name, overwrite=overwrite)
    wet = scene.lidar_xyz[:, 2] < scene.water_level_m
    classes = np.where(wet, BATHYMETRIC_POINT, GROUND).astype(np.uint8)
    _write_cloud(folder / "cloud.laz", scene.apparent_xyz, scene.epsg, _colours(scene))
    _write_cloud(folder / "truth.laz", scene.true_xyz, scene.epsg)
    _write_cloud(folder / "lidar.laz", scene.lidar_xyz, scene.epsg, classes=classes)
    write_text(folder / "cameras.csv", _cameras_csv(scene), overwrite=overwrite)
    sensor = "focal,sensor_x,sensor_y\n" + ",".join(map(str, scene.sensor_mm)) + "\n"
    write_text(folder / "sensor.csv", sensor, overwrite=overwrite)
    facts = {
        "made_by": f"pcfix {pcfix.__version__}",
        "crs": f"EPSG:{scene.epsg}",
        "water_level_m": scene.water_level_m,
        "refractive_index": scene.refractive_index,
        "gsd_m": scene.gsd_m,
        "arguments": scene.settings,
        "files": FILES,
    }
    write_text(folder / "scene.json", json.dumps(facts, indent=2) + "\n", overwrite=overwrite)


def _cameras_csv(scene: Scene) -> str:
    lines = ["label,x,y,z,yaw,pitch,roll"]
    for label, centre, angles in zip(
        scene.cameras.labels, scene.cameras.centres, scene.yaw_pitch_roll_deg, strict=True
    ):
        numbers = [f"{v:.4f}" for v in centre] + [f"{v:.6f}" for v in angles]
        lines.append(",".join([label, *numbers]))
    return "\n".join(lines) + "\n"


def _colours(scene: Scene) -> FloatArray:
    """Return RGB, 16 bit: sand on land, bluer with depth."""
    depth = np.clip((scene.water_level_m - scene.apparent_xyz[:, 2]) / 10.0, 0.0, 1.0)[:, None]
    sand, sea = np.array([[214, 196, 150]]), np.array([[22, 66, 110]])
    return np.asarray(np.rint(sand + depth * (sea - sand)) * 257.0)


def _write_cloud(
    path: Path,
    xyz: FloatArray,
    epsg: int,
    colours: FloatArray | None = None,
    classes: np.ndarray | None = None,
) -> None:
    header = laspy.LasHeader(version="1.4", point_format=6 if colours is None else 7)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(xyz.min(axis=0))
    header.add_crs(CRS.from_epsg(epsg))
    header.generating_software = f"pcfix {pcfix.__version__}"
    points = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
    for axis, name in enumerate("XYZ"):
        points.array[name] = np.rint((xyz[:, axis] - header.offsets[axis]) / 0.001)
    points["return_number"][:] = 1
    points["number_of_returns"][:] = 1
    if classes is not None:
        points.array["classification"] = classes
    if colours is not None:
        for i, name in enumerate(("red", "green", "blue")):
            points.array[name] = colours[:, i]
    with LasSink(path, header, []) as sink:
        sink.write(points)
