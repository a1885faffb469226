"""How near each method comes to the truth, by what is known of the cameras.

    python -m tests.benchmarks.accuracy [--points 30000] [--scenes flat oblique] [--sensitivity]

Simulated scenes (`SETTINGS`) and, of the shared test data (environment variable PCFIX_SHARED), the
clouds that COLMAP and OpenMVS made of rendered images (`REAL`). All numbers are over the same
points of a scene, those under more than 0.2 m of water, in ground sampling distances. Points that
a method left uncorrected are not in its row; "done" is the share of the others.

Cameras: "views" is the view list of the software; "mvs" a model of dense matching, which tracks are
not; "all" every camera whose frame holds the point; "auto" what pcfix detects without any option.
"In 95 %" is the share of points whose error in Z is within 1.96 SigmaZ.

"floor" is the least-squares triangulation through the water from the listed images, with new
noise of the same size, of 1000 points. Depth maps are matched anew for each map, so that there it
is no limit.

``--sensitivity`` compares the effect of wrong inputs on Z with the predicted budget instead. The
method is `consistent` with known tracks, one input is wrong at a time, and the budget has only that
one. Level and index are common to the scene: measured is the mean change of Z if the correction is
given a value that is off by one standard deviation, predicted the mean sigma. The others are
random: the scene is simulated with them, with several seeds, as a block has few poses; measured is
the RMS error of Z, predicted the RMS of sigma.
"""

import argparse
import csv
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

import pcfix
from pcfix.flow.planning import fit_check_depths
from pcfix.io.views import ViewMatch, read_views
from pcfix.options.shared import BudgetOptions
from pcfix.points.labelling import Part
from pcfix.simulate.tracing import piercing_points_of_planes, project
from pcfix.water.surface import surface_above
from tests.utils.consistent_twin import least_squares_points
from tests.utils.matchers import matched_scene
from tests.utils.shared import needs

METHODS = ("butler", "murase", "shan", "snell", "consistent")
CHECK_DEPTHS, CHECK_NOISE_M = 50, 0.03
FLOOR_POINTS = 1000
LEAST_DEPTH_M = 0.2
SHORE = {"bed": "shore", "lidar_per_m2": 0.0}
# Names of `pcfix.simulate.settings.SceneSettings`; the rest is its default.
SETTINGS = {
    "flat": SHORE,
    "oblique": {**SHORE, "obliques_deg": 35.0, "detection": 0.5},
    "river": {"bed": "river", "lidar_per_m2": 0.0},  # falls by 0.3 %
    "pairs": {**SHORE, "cloud": "pairs"},
    "depth-maps": {**SHORE, "cloud": "depth-maps"},
}
REAL = {
    "rendered_a": "rendered_a/cloud.las",
    "rendered_c": "rendered_c/cloud.las",
    "rendered_a_multi": "rendered_a_sgm/multi.laz",
    "rendered_a_steepest": "rendered_a_sgm/steepest.laz",
    "rendered_c_multi": "rendered_c_sgm/multi.laz",
    "rendered_c_steepest": "rendered_c_sgm/steepest.laz",
}
COLUMNS = {
    "method": "", "cameras": "", "rays": ".1f", "Z bias": "+.2f", "Z RMSE": ".2f", "in 95 %": ".1%",
    "done": ".1%",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Case:
    """A cloud, what the correction is given, and how wrong a result is.

    Attributes
    ----------
    words : str
    xyz : array, shape (n, 3)
        Apparent points, metres, world frame.
    cameras : Cameras
    water : WaterPlane
    index, gsd_m : float
    measured : array of bool, shape (n,)
        Points under more than `LEAST_DEPTH_M` of water, whose errors are taken.
    known : dict
        What is known of each point's cameras, as arguments of `pcfix.correct_points`.
    bed : array, shape (n, 3)
        The true points; of a scene with a true surface only, that at the apparent x and y.
    error : callable
        Of points, shape (m, 3), and their rows: height minus true height, metres.
    floor : array, shape (p,), or None if the images of a list did not make the point
    """

    words: str
    xyz: np.ndarray
    cameras: pcfix.Cameras
    water: pcfix.WaterPlane
    index: float
    gsd_m: float
    measured: np.ndarray
    bed: np.ndarray
    error: Callable[[np.ndarray, np.ndarray], np.ndarray]
    known: dict[str, dict[str, Any]] = field(default_factory=dict)
    floor: np.ndarray | None = None


def simulated(name: str, points: int, seed: int) -> Case:
    """Simulate a scene of `SETTINGS`."""
    scene = matched_scene(points, seed=seed, **SETTINGS[name])
    kind = "depth-maps" if name == "depth-maps" else "tracks"
    known: dict[str, dict[str, Any]] = {"views": {"views": replace(scene.views, kind=kind)}}
    mvs = {"camera_set": "mvs"}
    if name == "pairs":
        mvs["matcher"] = "pairs"
    measured, floor = measured_of(scene), None
    if kind == "tracks":
        rng = np.random.default_rng([seed, 99])
        rows = np.flatnonzero(measured)
        rows = np.sort(rng.choice(rows, min(FLOOR_POINTS, len(rows)), replace=False))
        floor = (triangulated_again(scene, rows, rng) - scene.true_xyz[rows])[:, 2]
    return Case(
        scene.description, scene.apparent_xyz, scene.cameras, scene.water, scene.refractive_index,
        scene.gsd_m, measured, scene.true_xyz, lambda xyz, rows: (xyz - scene.true_xyz[rows])[:, 2],
        {**known, "mvs": mvs, "all": {"camera_set": "all"}}, floor,
    )  # fmt: skip


def measured_of(scene: Any) -> np.ndarray:
    """Return which points of a simulated scene are far enough under water, and were made."""
    made = np.diff(scene.views.start) > 1
    apparent = scene.depth_m(scene.apparent_xyz) > 0.0
    return made & apparent & (scene.depth_m(scene.true_xyz) > LEAST_DEPTH_M)


def triangulated_again(scene: Any, rows: np.ndarray, rng: Any) -> np.ndarray:
    """Return the points whose images through the plane water are nearest to noisy ones, (m, 3).

    Nothing of `pcfix.refract` is used: light takes Fermat's path (`pcfix.simulate.tracing`).
    """
    truth, views, cameras = scene.true_xyz[rows], scene.views.take(rows), scene.true_cameras
    owner, water = np.repeat(np.arange(len(truth)), np.diff(views.start)), scene.water
    x, y = truth[:, :2].mean(axis=0)
    # near the points, as digits are lost far away
    anchor = np.array([x, y, water.a + water.b * x + water.c * y])
    normal = np.array([-water.b, -water.c, 1.0]) / np.sqrt(1.0 + water.b**2 + water.c**2)

    def images(points: np.ndarray) -> np.ndarray:
        of = points[owner]
        plane = (np.broadcast_to(part, of.shape) for part in (anchor, normal))
        centres = cameras.centres[views.camera]
        way = piercing_points_of_planes(of, centres, *plane, scene.refractive_index)
        return project(way, cameras, views.camera, cameras.lenses[0])[0]

    seen = images(truth)
    seen = seen + rng.normal(0.0, scene.settings["image_noise"], seen.shape)
    return least_squares_points(images, seen, views.start, truth)


def rendered(name: str, points: int) -> Case | None:
    """Return about so many points of a cloud of rendered images; None without the data.

    Of semi-global matching all points: its clouds have no view lists, and are detected as dense.
    """
    folder, cloud = needs(name[:10])[0], needs(REAL[name])[0]
    if not cloud.exists():
        return None
    import laspy

    local = pcfix.read_cameras(folder / "colmap")
    cameras = replace(local, centres=local.centres + np.loadtxt(folder / "offset.txt"))
    xyz = np.ascontiguousarray(laspy.read(cloud).xyz)
    known: dict[str, dict[str, Any]] = {}
    mvs = {"camera_set": "mvs"}
    if cloud.parent == folder:
        match = ViewMatch(read_views(folder / "dense.vis", cameras), cameras, points=len(xyz))
        rows = np.arange(0, len(xyz), max(1, len(xyz) // points))
        xyz, views = xyz[rows], match.views_of(xyz, 0)[0].take(rows)
        known["views"] = {"views": views}
    else:
        mvs["matcher"] = "single-map" if "multi" in name else "nearest-map"
    height, water, bed = true_surface(folder / "truth_dsm.tif"), pcfix.WaterPlane(0.37), xyz.copy()
    bed[:, 2] = height(xyz)

    def error(found: np.ndarray, _: np.ndarray) -> np.ndarray:
        return found[:, 2] - height(found)

    known = {**known, "mvs": mvs, "all": {"camera_set": "all"}}
    measured = (bed[:, 2] < water.a - LEAST_DEPTH_M) & (xyz[:, 2] < water.a)
    words = f"{len(xyz):,} points, {len(cameras)} rendered images, {cloud.parent.name}/{cloud.name}"
    return Case(words, xyz, cameras, water, 1.34, 0.05, measured, bed, error, known)


def true_surface(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Return the height of a raster at points, bilinear; NaN outside."""
    import rasterio

    with rasterio.open(path) as raster:
        heights, place = raster.read(1).astype(np.float64), ~raster.transform

    def height(xyz: np.ndarray) -> np.ndarray:
        column, row = place * (xyz[:, 0], xyz[:, 1])
        at = np.array([row - 0.5, column - 0.5])
        return map_coordinates(heights, at, order=1, cval=np.nan)

    return height


def rows_of(case: Case, seed: int) -> list[dict[str, Any]]:
    """Return the rows of a scene: no correction, the floor, then every method."""
    every = np.flatnonzero(case.measured)
    rows = [{"method": "uncorrected", **errors(case, case.error(case.xyz[every], every))}]
    if case.floor is not None:
        rows.append({"method": "floor", **errors(case, case.floor)})
    runs: list[tuple[str, str | None, dict[str, Any]]] = [
        ("factor", None, {}),
        ("factor", "auto", {"depth_factor": "auto"}),
        ("regression", None, {"regression": regression_of(case, seed)}),
        ("auto", "auto", {}),
        ("snell", "auto", {}),
    ]
    if "views" in case.known:
        runs.insert(4, ("auto", "views", case.known["views"]))
    runs += [
        (method, name, {**options, "max_angle": None})
        for method in METHODS
        for name, options in case.known.items()
        if name != "mvs" or method == "consistent"
    ]
    return rows + [row_of(case, *one) for one in runs]


def row_of(case: Case, method: str, cameras: str | None, options: dict[str, Any]) -> dict[str, Any]:
    """Correct a scene and return its errors."""
    row: dict[str, Any] = {"method": method, "cameras": cameras}
    options = {"index": case.index, "method": method, **options}
    try:
        found = pcfix.correct_points(case.xyz, case.cameras, case.water, **options)
    except pcfix.PcfixError as refusal:
        print(f"{method}, {cameras}: {refusal}", file=sys.stderr)
        return row
    rows = np.flatnonzero(case.measured & found.corrected)
    error = case.error(found.xyz[rows], rows)
    return {
        **row,
        "rays": float(found.ray_count[rows].mean()) if cameras else None,
        **errors(case, error),
        "in 95 %": float(np.mean(np.abs(error) <= 1.96 * found.sigma_z_m[rows])),
        "done": len(rows) / int(case.measured.sum()),
    }


def errors(case: Case, error: np.ndarray) -> dict[str, float]:
    """Return bias and RMSE of errors of height in GSD."""
    z = error / case.gsd_m
    return {"Z bias": float(z.mean()), "Z RMSE": float(np.sqrt(np.mean(z**2)))}


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
        return fit_check_depths(path, [part])


SENSITIVITY = {
    "input": "", "wrong by": "", "bias, cm": "+.2f", "measured, cm": ".2f", "predicted, cm": ".2f",
    "ratio": ".2f",
}  # fmt: skip
SEEDS = 5
LEVEL_M, INDEX = 0.05, 0.005
# Name, size, settings of the scene, and options of the budget.
RANDOM = (
    ("image", "0.5 px", {"image_noise": 0.5}, {"sigma_image": 0.5}),
    ("image", "1 px", {"image_noise": 1.0}, {"sigma_image": 1.0}),
    ("centres", "3 cm", {"position_noise_m": 0.03}, {"sigma_centre": 0.03}),
    ("attitude", "0.01 deg", {"attitude_noise_deg": 0.01}, {"sigma_attitude": 0.01}),
)


def sensitivity(name: str, points: int, seed: int) -> list[dict[str, Any]]:
    """Return the rows of a scene; random inputs have `SEEDS` scenes of fewer points."""

    def scene_of(points: int, seed: int, **more: Any) -> Any:
        return pcfix.simulate_scene(
            points, seed=seed, **{**SETTINGS[name], "image_noise": 0.0, **more}
        )

    scene = scene_of(points, seed)
    level, use, right = scene.water, measured_of(scene), corrected(scene)
    common = (
        ("level", "+5 cm", {"water": replace(level, a=level.a + LEVEL_M)}, LEVEL_M),
        ("index", "+0.005", {"index": scene.refractive_index + INDEX}, INDEX),
    )
    rows = []
    for what, size, wrong, sigma in common:
        changes = (corrected(scene, **wrong).xyz - right.xyz)[use, 2]
        measured = np.abs(changes).mean()
        predicted = corrected(scene, **{f"sigma_{what}": sigma}).sigma_z_m[use].mean()
        rows.append((what, size, np.mean(changes), measured, predicted))
    for what, size, made, sigmas in RANDOM:
        off, predicted = [], []
        for one in range(seed, seed + SEEDS):
            scene = scene_of(points // SEEDS, one, **made)
            found = corrected(scene, **sigmas)
            use = measured_of(scene) & found.corrected
            off.append((found.xyz - scene.true_xyz)[use, 2])
            predicted.append(found.sigma_z_m[use])
        rms = [np.sqrt(np.mean(np.concatenate(one) ** 2)) for one in (off, predicted)]
        rows.append((what, size, np.concatenate(off).mean(), *rms))
    return [
        dict(zip(SENSITIVITY, (what, size, *(100 * v for v in values), values[1] / values[2]),
                 strict=True))
        for what, size, *values in rows
    ]  # fmt: skip


def corrected(scene: Any, water: Any = None, **options: float) -> Any:
    """Correct a scene with its tracks; the budget has only the standard deviations given."""
    nothing = BudgetOptions(sigma_image=0.0, sigma_level=0.0, sigma_index=0.0)
    given = {"index": scene.refractive_index, **vars(nothing), **options}
    water = scene.water if water is None else water
    return pcfix.correct_points(
        scene.apparent_xyz, scene.cameras, water, method="consistent", views=scene.views, **given
    )


def show(rows: list[dict[str, Any]], columns: dict[str, str]) -> None:
    """Print a table; words to the left, numbers to the right, a dash for None."""
    cells = [
        ["-" if row.get(key) is None else format(row[key], form) for key, form in columns.items()]
        for row in rows
    ]
    width = [max(map(len, column)) for column in zip(columns, *cells, strict=True)]
    for line in [list(columns), *cells]:
        padded = zip(line, width, columns.values(), strict=True)
        print("  ".join(t.rjust(w) if form else t.ljust(w) for t, w, form in padded), flush=True)


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    ask.add_argument("--points", type=int, default=30_000, help="of each scene")
    ask.add_argument("--scenes", nargs="+", choices=(*SETTINGS, *REAL), default=None)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--sensitivity", action="store_true", help="print the other table")
    given = ask.parse_args()
    for name in given.scenes or (("flat", "oblique") if given.sensitivity else (*SETTINGS, *REAL)):
        if given.sensitivity:
            print(f"\n{name}")
            show(sensitivity(name, given.points, given.seed), SENSITIVITY)
            continue
        case = (
            rendered(name, given.points)
            if name in REAL
            else simulated(name, given.points, given.seed)
        )
        if case is None:
            print(f"{name}: no data; set PCFIX_SHARED", file=sys.stderr)
            continue
        print(f"\n{name}: {case.words}\n{int(case.measured.sum()):,} points are measured, "
              f"errors in GSD of {100 * case.gsd_m:.1f} cm")  # fmt: skip
        show(rows_of(case, given.seed), COLUMNS)


if __name__ == "__main__":
    main()
