"""How long an adjustment takes, and where it ends.

Makes a block of nadir images in strips, four fifths of forward and three of side overlap, over
land and a bed under water, with points in six to ten images, and adjusts it from poses that are
off. Each case is a process of its own, so that its peak memory is its own. With the shared data,
the rendered block whose poses were fitted to refracted tie points too.

    python tests/benchmarks/adjust.py [--images 300] [--points 25000 50000 100000]
                                      [--loss squares] [--rendered]
"""

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import Block, Unknowns
from pcfix.adjust.problem import prepare, solved_cameras
from pcfix.adjust.solve import solve
from pcfix.model import Cameras, Lens, WaterPlane

LENS = Lens(1500.0, 1600, 1200, 800.0, 600.0)
HEIGHT_M, N, NOISE_PX, GNSS_M = 60.0, 1.34, 0.5, 0.03
MOST_VIEWS = 10


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--points", type=int, nargs="+", default=[25_000, 50_000, 100_000])
    parser.add_argument("--loss", choices=("squares", "huber", "cauchy"), default="squares")
    parser.add_argument("--rendered", action="store_true")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        case, loss = arguments.one
        print(json.dumps(run(case, arguments.images, loss)))
        return
    print("case           obs      wall s   cpu s  steps  us/obs  MB    centres m  df px")
    cases = ["rendered"] if arguments.rendered else map(str, arguments.points)
    for case in cases:
        show(case, arguments)


def show(case, arguments):
    command = [sys.executable, __file__, "--images", str(arguments.images)]
    command += ["--one", case, arguments.loss]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    r = json.loads(done.stdout.splitlines()[-1])
    print(
        f"{case:<11} {r['observations']:>8} {r['wall_s']:>8.1f} {r['cpu_s']:>7.1f}"
        f" {r['steps']:>5} {1e6 * r['cpu_s'] / r['observations']:>7.1f} {r['peak_mb']:>6.0f}"
        f" {r['before_m']:>7.4f} -> {r['after_m']:.4f} {r['focal_px']:+.3f}",
        flush=True,
    )


def run(case, images, loss):
    """Return the figures of one adjustment in this process; kernels are compiled before."""
    make, unknowns = (rendered, ("f", "cx", "cy")) if case == "rendered" else (flown, ("f",))
    small, _, _ = flown(500, 12)
    solve(*prepare(small, Unknowns(lens=unknowns)), loss)
    block, centres, focal = make(*(() if case == "rendered" else (int(case), images)))
    started, cpu = time.perf_counter(), time.process_time()
    problem, start = prepare(block, Unknowns(lens=unknowns))
    found = solve(problem, start, loss)
    cameras = solved_cameras(problem, found)
    return {
        "wall_s": time.perf_counter() - started,
        "cpu_s": time.process_time() - cpu,
        "steps": len(found.log),
        "observations": len(block.camera),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "before_m": off_m(block.cameras.centres, centres),
        "after_m": off_m(cameras.centres, centres),
        "focal_px": cameras.lenses[0].focal - focal,
        "cost": found.cost,
    }


def off_m(one, other):
    return float(np.sqrt(((one - other) ** 2).sum(axis=1).mean()))


def flown(points, images):
    """Return a block, the true projection centres and the true focal length."""
    rng = np.random.default_rng(1)
    base, strip = 0.2 * HEIGHT_M * 0.8, 0.4 * HEIGHT_M * 1600.0 / 1500.0
    rows = max(2, round(np.sqrt(images * base / strip)))
    each = -(-images // rows)
    place = np.arange(images)
    flat = np.column_stack([place // each * strip, place % each * base])
    centres = np.column_stack([flat, np.full(images, HEIGHT_M)]) + rng.normal(0, 0.5, (images, 3))
    turn = Rotation.from_euler("zyx", rng.normal(0, [4.0, 2.0, 2.0], (images, 3)), degrees=True)
    rotations = np.diag([1.0, -1.0, -1.0]) @ turn.as_matrix()
    xyz = rng.uniform([0, 0, 0], [*flat.max(axis=0), 1], (points, 3))
    xyz[:, 2] = 3.0 * np.sin(xyz[:, 0] / 25.0) + 2.0 * np.cos(xyz[:, 1] / 17.0) + xyz[:, 2] - 0.5
    start, camera, uv = seen(xyz, centres, rotations, rng)
    xyz = xyz[np.diff(start) > 0]
    start = np.concatenate([[0], np.cumsum(np.diff(start)[np.diff(start) > 0])])
    m, noise = len(xyz), rng.normal
    given = Cameras(
        tuple(f"{i}" for i in range(images)),
        centres + noise(0, 0.05, (images, 3)),
        Rotation.from_rotvec(noise(0, 1e-3, (images, 3))).as_matrix() @ rotations,
        (replace(LENS, focal=LENS.focal + 3.0),) * images,
    )
    block = Block(
        given, xyz + noise(0, 0.1, xyz.shape), start, camera, uv + noise(0, NOISE_PX, uv.shape),
        np.full(len(uv), NOISE_PX), WaterPlane(0.0), N, np.ones(m, bool),
        np.full((m, 3), np.nan), np.full((m, 3), np.inf),
        centres + noise(0, GNSS_M, (images, 3)), np.full((images, 3), GNSS_M),
    )  # fmt: skip
    return block, centres, LENS.focal


def seen(xyz, centres, rotations, rng):
    """Return which images show each point, at most `MOST_VIEWS` and three at least, and where."""
    point, camera, uv = [], [], []
    for i, (c, r) in enumerate(zip(centres, rotations, strict=True)):
        near = np.flatnonzero((np.abs(xyz[:, :2] - c[:2]) < 45.0).all(axis=1))
        x, y, z = (ahead(xyz[near], c) @ r.T).T
        place = np.column_stack([LENS.focal * x / z + 800.0, LENS.focal * y / z + 600.0])
        inside = ((place > 0) & (place < [1600, 1200])).all(axis=1)
        point.append(near[inside])
        camera.append(np.full(inside.sum(), i))
        uv.append(place[inside])
    point, camera, uv = map(np.concatenate, (point, camera, uv))
    order = np.lexsort((rng.random(len(point)), point))
    point, camera, uv = point[order], camera[order], uv[order]
    counts = np.bincount(point, minlength=len(xyz))
    rank = np.arange(len(point)) - np.repeat(np.cumsum(counts) - counts, counts)
    kept = (rank < MOST_VIEWS) & (counts[point] >= 3)
    counts = np.bincount(point[kept], minlength=len(xyz))
    return np.concatenate([[0], np.cumsum(counts)]), camera[kept], uv[kept]


def ahead(xyz, centre):
    """Return the direction at a projection centre from which light of points comes.

    Snell's law at the level z = 0 by bisection of the place where the light leaves the water.
    """
    flat, down = xyz[:, :2] - centre[:2], np.maximum(-xyz[:, 2], 0.0)
    far = np.linalg.norm(flat, axis=1)
    low, high = np.zeros(len(xyz)), far.copy()
    for _ in range(60):
        mid = 0.5 * (low + high)
        above, below = (
            mid / np.hypot(mid, centre[2]),
            (far - mid) / np.hypot(far - mid, down + 1e-300),
        )
        short = above < N * below
        low, high = np.where(short, mid, low), np.where(short, high, mid)
    out = xyz - centre
    wet = down > 0.0
    along = flat / np.maximum(far, 1e-12)[:, None]
    out[wet] = np.column_stack(
        [along * (0.5 * (low + high))[:, None], np.full(len(xyz), -centre[2])]
    )[wet]
    return out


def rendered():
    """Return the rendered block with its tie points and GNSS, and the truth of it."""
    from pcfix.io.cameras import read_cameras, read_tie_points

    data = Path(os.environ["PCFIX_SHARED"]) / "data"
    folder, level = data / "rendered_a_free", 0.37
    offset = np.loadtxt(folder / "offset.txt")
    cameras = read_cameras(folder / "sparse")
    ties = read_tie_points(folder / "sparse", cameras)
    true = read_cameras(data / "rendered_a" / "colmap")
    row = {label: i for i, label in enumerate(true.labels)}
    centres = true.centres[[row[label] for label in cameras.labels]] + offset
    with (folder / "gnss.csv").open() as file:
        rows = {each["image"]: each for each in csv.DictReader(file)}
    gnss = np.array([[float(rows[label][c]) for c in "xyz"] for label in cameras.labels])
    cameras = replace(cameras, centres=cameras.centres + offset)
    xyz = ties.xyz + offset
    counts = np.diff(ties.views.start)
    keep = np.flatnonzero((counts >= 3) & np.isfinite(xyz).all(axis=1))
    keep = np.sort(np.random.default_rng(0).choice(keep, 9000, replace=False))
    views = ties.views.take(keep)
    where = np.repeat(ties.views.start[keep] - views.start[:-1], counts[keep])
    uv = ties.image_xy[where + np.arange(views.start[-1])]
    xyz = xyz[keep]
    depth = np.maximum(level - xyz[:, 2], 0.0)
    xyz[:, 2] -= (N - 1.0) * depth
    m, k = len(xyz), len(cameras)
    block = Block(
        cameras, xyz, views.start, views.camera, uv, np.full(len(uv), 0.25), WaterPlane(level), N,
        np.ones(m, bool), np.full((m, 3), np.nan), np.full((m, 3), np.inf),
        gnss, np.full((k, 3), GNSS_M),
    )  # fmt: skip
    return block, centres, 1500.0


if __name__ == "__main__":
    main()
