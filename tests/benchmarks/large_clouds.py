"""How much memory and time `pcfix compare` and `pcfix clean` take of large clouds.

Makes two clouds of a wavy bed once (kept in a folder for the next run), points in random order, 10
a square metre, and runs each command as a process of its own. Prints its time and the most memory
it had resident, pages of temporary files included (what /usr/bin/time -v says).

    python -m tests.benchmarks.large_clouds [--points 20000000] [--folder DIR] [--only NAME]
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np

CHUNK = 1_000_000


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=20_000_000)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "pcfix_large")
    parser.add_argument("--only", help="one of the commands: c2c, vertical, m3c2, clean")
    arguments = parser.parse_args()
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    names = [folder / f"{name}_{arguments.points}.las" for name in ("cloud", "reference")]
    for seed, name in enumerate(names):
        if not name.exists():
            make(name, arguments.points, seed)
    compare = ["compare", *map(str, names), "--overwrite", "--summary", str(folder / "found.json")]
    commands = {
        "c2c": [*compare, "--c2c-only"],
        "vertical": [*compare, "--water", "-5"],
        "m3c2": [*compare, "--c2c-only", "--m3c2"],
        "clean": ["clean", str(names[0]), str(folder / "clean.las"), "--overwrite"],
    }
    for name, words in commands.items():
        if arguments.only in (None, name):
            seconds, megabytes = run([sys.executable, "-m", "pcfix", *words, "--quiet"])
            print(f"{name:<9} {arguments.points:>12,} points {seconds:7.1f} s {megabytes:6.0f} MB")


def run(command):
    started = time.perf_counter()
    child = os.spawnv(os.P_NOWAIT, command[0], command)
    _, status, used = os.wait4(child, 0)
    if status:
        sys.exit(f"{' '.join(command)} ended with {status}")
    return time.perf_counter() - started, used.ru_maxrss / 1024


def make(path, count, seed):
    """Write points on a wavy bed, chunk by chunk."""
    rng = np.random.default_rng(seed)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    with laspy.open(path, "w", header=header) as sink:
        for first in range(0, count, CHUNK):
            some = min(CHUNK, count - first)
            xy = rng.uniform(0.0, np.sqrt(count / 10.0), (some, 2))
            z = -5.0 + 2.0 * np.sin(xy[:, 0] / 30.0) + np.cos(xy[:, 1] / 17.0)
            points = laspy.ScaleAwarePointRecord.zeros(some, header=header)
            points.x, points.y = xy.T
            points.z = z + 0.03 * seed + rng.normal(0.0, 0.02, some)
            sink.write_points(points)


if __name__ == "__main__":
    main()
