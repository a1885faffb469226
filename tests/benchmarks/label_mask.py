"""How long a labelling with a mask takes, beside a plain copy of the same file.

Makes a shore of noisy points once (kept in a folder for the next run), and a lake with thousands
of vertices and many islands as a mask; then times, by turns and each as a process of its own, a
plain laspy read-and-write and ``pcfix label`` with more and more rules. Prints seconds, the ratio
to the copy, and the peak memory; and the mask alone on coordinates in memory.

    python tests/benchmarks/label_mask.py [--points 5000000] [--runs 3] [--folder DIR]
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.benchmarks.copy_ratio import COPY, run

EAST, NORTH, SIDE_M = 456_000.0, 5_432_000.0, 400.0
VERTICES, ISLANDS = 8000, 60


def main():
    arguments = parsed()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    cloud = arguments.folder / f"shore_{arguments.points}.laz"
    if not cloud.exists():
        make(cloud, arguments.points)
    mask = arguments.folder / "lake.wkt"
    mask.write_text(lake().wkt + "\n")
    out = arguments.folder / "out.laz"
    label = [
        sys.executable,
        "-m",
        "pcfix",
        "label",
        cloud,
        out,
        "--water",
        "0",
        "--overwrite",
        "-q",
    ]
    masked = [*label, "--water-mask", mask]
    commands = {
        "plain copy": [sys.executable, "-c", COPY, cloud, out],
        "label": label,
        "label, mask": masked,
        "label, mask, dead band": [*masked, "--dead-band", "0.1"],
        "label, mask, dead band, connected": [*masked, "--dead-band", "0.1", "--connected"],
    }
    run(commands["label, mask, dead band, connected"])  # compile the kernels
    seconds, peak = {name: [] for name in commands}, dict.fromkeys(commands, 0.0)
    for _ in range(arguments.runs):
        for name, command in commands.items():
            taken, _, memory = run(command)
            seconds[name].append(taken)
            peak[name] = max(peak[name], memory)
    copy = statistics.median(seconds["plain copy"])
    for name, taken in seconds.items():
        middle = statistics.median(taken)
        print(
            f"{name:<34} {middle:6.2f} s, {middle / copy:5.2f} times the copy,"
            f" peak {peak[name]:5.0f} MB"
        )
    in_memory(cloud)


def parsed():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--runs", type=int, default=3)
    default = Path(tempfile.gettempdir()) / "pcfix_label_benchmark"
    parser.add_argument("--folder", type=Path, default=default)
    return parser.parse_args()


def make(path, count):
    """Write a shore of 2 % with waves in its line, heights noisy to 3 cm."""
    rng = np.random.default_rng(1)
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, 0.001), np.array([EAST, NORTH, 0.0])
    las = laspy.LasData(header)
    # in the order of flight lines, as clouds are, not of chance
    x, y = rng.uniform(0, SIDE_M, count), np.sort(rng.uniform(0, SIDE_M, count))
    height = 0.02 * (x - SIDE_M / 2) + 0.5 * np.sin(x / 17) * np.sin(y / 23)
    las.x, las.y, las.z = EAST + x, NORTH + y, height + rng.normal(0, 0.03, count)
    for name in ("red", "green", "blue"):
        las[name] = rng.integers(0, 65535, count)
    las.write(path)


def lake():
    """Return a polygon with a jagged border and islands."""
    import shapely

    rng = np.random.default_rng(2)
    middle = np.array([EAST, NORTH]) + SIDE_M / 2
    angle = np.linspace(0, 2 * np.pi, VERTICES, endpoint=False)
    radius = SIDE_M * (0.4 + 0.04 * np.sin(7 * angle) + 0.01 * np.sin(53 * angle))
    radius += rng.normal(0, 0.02, VERTICES)
    area = shapely.Polygon(
        middle + np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]
    )
    places = middle + rng.uniform(-0.35, 0.35, (ISLANDS, 2)) * SIDE_M
    islands = shapely.union_all(shapely.buffer(shapely.points(places), 4.0, quad_segs=30))
    return shapely.make_valid(area).difference(islands)


def in_memory(cloud):
    """Time the mask alone, the cells and the question to the polygons for every point."""
    import shapely

    from pcfix.label.areas import WaterMask

    las = laspy.read(cloud)
    x, y, area = np.array(las.x), np.array(las.y), lake()
    WaterMask(area).inside(x[:10], y[:10])
    started = time.perf_counter()
    found = WaterMask(area).inside(x, y)
    taken = time.perf_counter() - started
    started = time.perf_counter()
    exact = shapely.intersects_xy(area, x, y)
    alone = time.perf_counter() - started
    print(
        f"mask alone: {shapely.get_num_coordinates(area):,} vertices,"
        f" {shapely.get_num_interior_rings(area)} holes, {len(x):,} points: {taken:.2f} s;"
        f" shapely alone {alone:.2f} s; {(found != exact).sum()} differ"
    )


if __name__ == "__main__":
    main()
