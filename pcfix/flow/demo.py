"""Simulate two scenes, correct them, and compare the results with the truth: ``pcfix demo``."""

from __future__ import annotations

from pathlib import Path

from pcfix.compare.statistics import errors_against_truth
from pcfix.flow.correct import correct_points
from pcfix.flow.request import Request
from pcfix.flow.run import run_all
from pcfix.flow.runner import Bar, no_bar
from pcfix.io.las.source import read_xyz
from pcfix.io.scenes import write_scene
from pcfix.model import FloatArray
from pcfix.options.declare import File
from pcfix.options.scenes import BlockKind
from pcfix.simulate.scene import Scene, simulate_scene

LEAST_DEPTH_M = 0.2  # shallower points have no refraction worth a percentage
BLOCKS: tuple[BlockKind, ...] = ("nadir", "oblique")
REPORT = "run"


def run_demo(
    out_dir: File, *, points: int = 50_000, overwrite: bool = False, bar: Bar = no_bar
) -> str:
    """Simulate both blocks in a folder, run all steps on them, and return a table of errors."""
    sections = []
    for kind in BLOCKS:
        folder = Path(out_dir) / kind
        with bar(f"Simulating, {kind}") as progress:
            scene = simulate_scene(points, block=kind, progress=progress)
        write_scene(scene, folder, overwrite=overwrite)
        corrected = _corrected(scene, folder, f"pcfix demo, {kind} block", overwrite, bar)
        table = _table(scene, corrected)
        sections.append(
            f"{folder}\n{scene.description}\n{table}\nreport: {folder / REPORT / 'report.html'}"
        )
    return "\n\n".join(sections)


def _table(scene: Scene, corrected: FloatArray) -> str:
    deep = scene.true_xyz[:, 2] < scene.water_level_m - LEAST_DEPTH_M
    below = scene.apparent_xyz[:, 2] < scene.water_level_m
    times_n = scene.apparent_xyz.copy()
    depth = scene.water_level_m - times_n[below, 2]
    times_n[below, 2] = scene.water_level_m - scene.refractive_index * depth
    by_default = correct_points(
        scene.apparent_xyz, scene.cameras, scene.water, index=scene.refractive_index
    )
    rows = [
        ("uncorrected", scene.apparent_xyz),
        (f"depth times {scene.refractive_index:g}", times_n),
        ("default options", by_default.xyz),
        ("with the view list", corrected),
    ]
    head = f"error of {deep.sum():,} bed points"
    lines = [f"{head:<30}{'mean Z':>20}{'RMSE Z':>20}{'RMSE XY':>20}"]
    for name, xyz in rows:
        errors = errors_against_truth(xyz[deep], scene.true_xyz[deep])
        cells = (f"{100 * e:.1f} cm {e / scene.gsd_m:6.1f} GSD" for e in errors)
        lines.append(f"{name:<30}" + "".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)


def _corrected(scene: Scene, folder: Path, project: str, overwrite: bool, bar: Bar) -> FloatArray:
    """Run all steps on the scene's files and read the corrected cloud."""
    request = Request(
        input=str(folder / "cloud.laz"),
        cameras=str(folder / "cameras.csv"),
        water=str(scene.water_level_m),
        reference=str(folder / "lidar.laz"),
        index=scene.refractive_index,
        method="consistent",
        views=str(folder / "fused.ply.vis"),
        views_are="tracks",
        project=project,
    )
    run_all(request, folder / REPORT, overwrite=overwrite, bar=bar)
    return read_xyz(folder / REPORT / "corrected.laz")
