"""How near each method comes to the truth, and how fast, by what it knows of the cameras.

    python tests/benchmarks/accuracy.py

Simulated scenes (`accuracy_scenes.SETTINGS`) and, of the shared test data (environment variable
PCFIX_SHARED), the clouds that COLMAP and OpenMVS made of rendered images (``rendered_a``, ``_c``).
All numbers are over the same points of a scene, those under more than 0.2 m of water, in ground
sampling distances; XY bias is the length of the mean error in plan. Points that a method left
uncorrected are not in its row; "done" is the share of the others.

Cameras: "views" are those that made the point, as the software's list has them; "pairs" the
stereo pairs, which for all but `consistent` are the same cameras; "mvs" a model of dense matching,
which tracks and pairs are not; "all" every camera whose frame holds the point; "auto" what the
cloud itself tells, as without any option. "In 95 %" is the share of points whose error in Z is
within 1.96 SigmaZ.

"floor" is the least-squares triangulation through the water from the listed images, with fresh
noise of the same size, of 1000 points. Of depth maps the list has no partner images, and each is
matched anew, so that there it is a scale rather than a limit.

``--sensitivity`` prints how wrong inputs come through instead, beside the predicted budget.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import pcfix
from pcfix.options.correct import ScienceOptions

sys.path.insert(0, str(Path(__file__).parents[2]))
from pcfix.flow.learning import learn_regression
from pcfix.label.labelling import Part
from pcfix.water.surface import surface_above
from tests.benchmarks.accuracy_scenes import NAMES, Case, make
from tests.benchmarks.accuracy_sensitivity import COLUMNS as SENSITIVITY_COLUMNS
from tests.benchmarks.accuracy_sensitivity import sensitivity
from tests.benchmarks.accuracy_tables import table

METHODS = ("butler", "murase", "shan", "snell", "consistent")
CHECK_DEPTHS, CHECK_NOISE_M = 50, 0.03
WARM_POINTS = 1000
COLUMNS = [
    ("scene", "scene", ""),
    ("method", "method", ""),
    ("cameras", "cameras", ""),
    ("rays", "rays", ".1f"),
    ("z_bias", "Z bias", "+.2f"),
    ("z_rmse", "Z RMSE", ".2f"),
    ("xy_bias", "XY bias", ".2f"),
    ("xy_rmse", "XY RMSE", ".2f"),
    ("covered", "in 95 %", ".1%"),
    ("done", "done", ".1%"),
    ("points_per_s", "points/s", ",.0f"),
]


def rows_of(case: Case, runs: int, seed: int) -> list[dict[str, Any]]:
    """Return the rows of a scene: no correction, the floor, then every method."""
    every = np.flatnonzero(case.measured)
    rows = [{"method": "uncorrected", **errors(case, case.error(case.xyz[every], every))}]
    if case.floor is not None:
        rows.append({"method": "floor", **errors(case, case.floor)})
    rows.append(row_of(case, "factor", None, {}, runs))
    rows.append(row_of(case, "factor", "auto", {"depth_factor": "auto"}, runs))
    learned = regression_of(case, seed)
    rows.append(row_of(case, "regression", None, {"regression": learned}, runs))
    rows.append(row_of(case, "auto", "auto", {}, runs))
    if "views" in case.knowledge:
        rows.append(row_of(case, "auto", "views", case.knowledge["views"], runs))
    rows.append(row_of(case, "snell", "auto", {}, runs))
    rows += [
        row_of(case, method, name, {**options, "max_angle": None}, runs)
        for method in METHODS
        for name, options in case.knowledge.items()
        if name != "pairs" or method == "consistent"
    ]
    return [{"scene": case.name, **row} for row in rows]


def row_of(
    case: Case, method: str, cameras: str | None, options: dict[str, Any], runs: int
) -> dict[str, Any]:
    """Correct a scene, and return what came of it."""
    row: dict[str, Any] = {"method": method, "cameras": cameras}
    try:
        found, seconds = timed(case, {"method": method, **options}, runs)
    except pcfix.PcfixError as refusal:
        print(f"{case.name}, {method}, {cameras}: {refusal}", file=sys.stderr)
        return row
    rows = np.flatnonzero(case.measured & found.corrected)
    error = case.error(found.xyz[rows], rows)
    rays = float(found.ray_count[rows].mean()) if cameras else None
    within = np.abs(error[:, 2]) / found.sigma_z_m[rows]
    return {
        **row,
        "rays": rays,
        **errors(case, error),
        "covered": float(np.mean(within <= 1.96)),
        "done": len(rows) / int(case.measured.sum()),
        "points_per_s": int(found.submerged.sum()) / seconds,
    }


def timed(case: Case, options: dict[str, Any], runs: int) -> tuple[pcfix.Correction, float]:
    """Return the result and the median of the seconds, after a small run that compiles."""
    few = np.arange(0, len(case.xyz), max(1, len(case.xyz) // WARM_POINTS))
    views = options.get("views")
    warm = {**options, "views": None if views is None else views.take(few)}
    fixed = {"index": case.refractive_index}
    pcfix.correct_points(case.xyz[few], case.cameras, case.water, **fixed, **warm)
    seconds = []
    for _ in range(runs):
        clock = time.perf_counter()
        found = pcfix.correct_points(case.xyz, case.cameras, case.water, **fixed, **options)
        seconds.append(time.perf_counter() - clock)
    return found, float(np.median(seconds))


def errors(case: Case, error: np.ndarray) -> dict[str, float | None]:
    """Return bias and RMSE of errors, shape (m, 3), in GSD."""
    x, y, z = error.T / case.gsd_m
    plan = not np.isnan(x).any()
    return {
        "z_bias": float(z.mean()),
        "z_rmse": float(np.sqrt(np.mean(z**2))),
        "xy_bias": float(np.hypot(x.mean(), y.mean())) if plan else None,
        "xy_rmse": float(np.sqrt(np.mean(x**2 + y**2))) if plan else None,
    }


def regression_of(case: Case, seed: int) -> Any:
    """Fit the regression to check depths that are drawn from the truth."""
    rng = np.random.default_rng([seed, 50])
    bed = case.bed[rng.choice(np.flatnonzero(case.measured), CHECK_DEPTHS, replace=False)]
    depth = surface_above(case.water, bed).height_m - bed[:, 2]
    depth += rng.normal(0.0, CHECK_NOISE_M, CHECK_DEPTHS)
    part = Part(case.xyz, surface_above(case.water, case.xyz), np.ones(len(case.xyz), np.uint8))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "check_depths.csv"
        with path.open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["x", "y", "depth"])
            writer.writerows(np.column_stack([bed[:, :2], depth]).tolist())
        return learn_regression(path, [part], ScienceOptions())


def accuracy(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Print the table scene by scene, or whole as Markdown."""
    rows = []
    for name in given.scenes:
        case = make(name, given.points, given.seed)
        if case is None:
            print(f"{name}: no data; set PCFIX_SHARED", file=sys.stderr)
            continue
        found = rows_of(case, given.runs, given.seed)
        rows += found
        if not given.markdown:
            print(f"\n{name}: {case.words}\n{int(case.measured.sum()):,} points are measured, "
                  f"errors in GSD of {100 * case.gsd_m:.1f} cm")  # fmt: skip
            print(table(found, COLUMNS[1:], markdown=False), flush=True)
    if given.markdown:
        print(table(rows, COLUMNS, markdown=True))
    return rows


def main() -> None:
    """Print the table that was asked for."""
    ask = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    ask.add_argument("--points", type=int, default=30_000, help="of each scene")
    ask.add_argument("--scenes", nargs="+", choices=NAMES, default=list(NAMES))
    ask.add_argument("--runs", type=int, default=1, help="the speed is the median of so many")
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--sensitivity", action="store_true", help="print the other table")
    ask.add_argument("--markdown", action="store_true")
    ask.add_argument("--json", type=Path, help="write the rows there as well")
    given = ask.parse_args()
    if given.sensitivity:
        rows = sensitivity(given.points, given.seed)
        print(table(rows, SENSITIVITY_COLUMNS, markdown=given.markdown))
    else:
        rows = accuracy(given)
    if given.json:
        asked = {"points": given.points, "seed": given.seed, "runs": given.runs}
        given.json.write_text(json.dumps({"pcfix": pcfix.__version__, **asked, "rows": rows}))


if __name__ == "__main__":
    main()
