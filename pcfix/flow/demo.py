"""Write simulated scenes as the files of a survey, with their truth; correct them and compare.

These are the commands ``pcfix simulate`` and ``pcfix demo``.
"""

import json
from pathlib import Path

import numpy as np

from pcfix.flow.runner import Bar, no_bar
from pcfix.io.files import check_output, write_bytes
from pcfix.io.las.source import read_xyz
from pcfix.io.las.writing import write_points
from pcfix.model import BATHYMETRIC_POINT, Cameras, FloatArray, Views
from pcfix.options.declare import File
from pcfix.options.steps import BlockKind
from pcfix.simulate.scene import Scene, simulate_scene
from pcfix.version import __version__

CLOUDS = ("cloud.laz", "truth.laz", "lidar.laz")  # apparent and true points, and a survey


def write_scene(scene: Scene, out_dir: File, *, overwrite: bool) -> None:
    """Write `CLOUDS`, the cameras, their sensor, view lists and ``scene.json`` into a folder."""
    folder = Path(out_dir)
    lens = None if scene.cameras.lenses is None else scene.cameras.lenses[0]
    sensor = dict(zip(("focal", "sensor_x", "sensor_y"), scene.sensor_mm, strict=True))
    if lens is not None and lens.radial:
        sensor = {"focal_px": lens.focal, "width_px": lens.width, "height_px": lens.height}
        sensor |= dict(zip(("k1", "k2", "k3"), lens.radial, strict=True))
        p1, p2 = lens.tangential
        sensor |= {"p1": p2, "p2": p1}  # OpenCV counts them the other way round
    contents = {
        "sensor.csv": f"{','.join(sensor)}\n{','.join(map(repr, sensor.values()))}\n".encode(),
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
    classes = np.where(wet, BATHYMETRIC_POINT, 2).astype(np.uint8)  # 2 is ground
    depth = np.clip(scene.depth_m(scene.apparent_xyz) / 10.0, 0.0, 1.0)[:, None]
    sand, sea = np.array([[214, 196, 150]]), np.array([[22, 66, 110]])
    colours = np.asarray(np.rint(sand + depth * (sea - sand)) * 257.0)  # 16 bit, bluer with depth
    place = (scene.epsg, 0.001 if scene.gsd_m >= 0.005 else 0.0001)  # with steps in metres
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


def _cameras_csv(cameras: Cameras, yaw_pitch_roll_deg: FloatArray) -> bytes:
    text = "label,x,y,z,yaw,pitch,roll\n"
    for label, xyz, turn in zip(cameras.labels, cameras.centres, yaw_pitch_roll_deg, strict=True):
        numbers = [*(f"{v:.4f}" for v in xyz), *(f"{v:.6f}" for v in turn)]
        text += ",".join([label, *numbers]) + "\n"
    return text.encode()


LEAST_DEPTH_M = 0.2  # shallower points have no refraction worth a percentage
BLOCKS: tuple[BlockKind, ...] = ("nadir", "oblique")
REPORT = "run"


def run_demo(
    out_dir: File, *, points: int = 50_000, overwrite: bool = False, bar: Bar = no_bar
) -> str:
    """Simulate both blocks in a folder, run all steps on them, and return a table of errors."""
    from pcfix.flow.run import run  # slow to load, and not needed to write a scene

    sections = []
    for kind in BLOCKS:
        folder = Path(out_dir) / kind
        with bar(f"Simulating, {kind}") as progress:
            scene = simulate_scene(points, block=kind, progress=progress)
        write_scene(scene, folder, overwrite=overwrite)
        result = run(
            folder / "cloud.laz",
            folder / REPORT,
            bar=bar,
            cameras=str(folder / "cameras.csv"),
            water=str(scene.water_level_m),
            reference=str(folder / "lidar.laz"),
            index=scene.refractive_index,
            method="consistent",
            views=str(folder / "fused.ply.vis"),
            views_are="tracks",
            project=f"pcfix demo, {kind} block",
            overwrite=overwrite,
        )
        table = _table(scene, read_xyz(folder / REPORT / "corrected.laz"))
        sections.append(f"{folder}\n{scene.description}\n{table}\nreport: {result.report}")
    return "\n\n".join(sections)


def _table(scene: Scene, corrected: FloatArray) -> str:
    """Return the errors of the bed without and with a correction, in centimetres and GSD."""
    from pcfix.flow.correct import correct_points

    level, n = scene.water_level_m, scene.refractive_index
    deep = scene.true_xyz[:, 2] < level - LEAST_DEPTH_M
    by_default = correct_points(scene.apparent_xyz, scene.cameras, scene.water, index=n)
    rows = {
        "uncorrected": scene.apparent_xyz,
        "default options": by_default.xyz,
        "with the view list": corrected,
    }
    head = f"error of {deep.sum():,} bed points"
    lines = [f"{head:<30}{'mean Z':>20}{'RMSE Z':>20}{'RMSE XY':>20}"]
    for name, xyz in rows.items():
        error = xyz[deep] - scene.true_xyz[deep]
        squares = error**2
        plan = np.sqrt(squares[:, :2].sum(axis=1).mean())
        errors = error[:, 2].mean(), np.sqrt(squares[:, 2].mean()), plan
        cells = (f"{100 * e:.1f} cm {e / scene.gsd_m:6.1f} GSD" for e in errors)
        lines.append(f"{name:<30}" + "".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)
