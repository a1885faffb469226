"""Simulate two scenes, correct them, and compare the results with the truth: ``pcfix demo``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcfix.flow.correct import correct_points
from pcfix.flow.run import run
from pcfix.flow.runner import Bar, no_bar
from pcfix.io.las.source import read_xyz
from pcfix.io.scenes import write_scene
from pcfix.model import FloatArray
from pcfix.options.declare import File
from pcfix.options.steps import BlockKind
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
