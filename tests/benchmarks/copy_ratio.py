"""How much longer a correction takes than a plain copy of the same file.

Simulates a cloud once (kept in a folder for the next run), then times, in one run and by turns,
``pcfix correct``, the same with ``--method snell --max-angle none``, and a plain laspy
read-and-write, each as a process of its own. Prints the ratios, the peak memory, and the speed of
the kernel of ``snell`` in point-camera pairs per second.

    python tests/benchmarks/copy_ratio.py [--points 5000000] [--cameras 200] [--cloud depth-maps]
        [--folder DIR]
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COPY = """
import sys, laspy
with laspy.open(sys.argv[1]) as source, laspy.open(
    sys.argv[2], "w", header=source.header, do_compress=sys.argv[2].endswith("z")
) as sink:
    for points in source.chunk_iterator(1_000_000):
        sink.write_points(points)
"""


def main():
    arguments = parsed(__doc__)
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    kind = f"{arguments.cloud}_{arguments.points}_{arguments.cameras}"
    cloud = folder / f"cloud_{kind}.laz"
    if not cloud.exists():
        make(cloud, arguments)
    scene = camera_table(cloud)
    copied, corrected = folder / "copy.laz", folder / "corrected.laz"
    words = ["--cameras", scene, "--sensor", folder / "sensor.csv", "--water", "0.37"]
    commands = {"plain copy": [sys.executable, "-c", COPY, cloud, copied]}
    options = {"snell": ["--method", "snell", "--max-angle", "none"], "pcfix correct": []}
    for name, more in options.items():
        commands[name] = [
            *(sys.executable, "-m", "pcfix", "correct", cloud, corrected),
            *(*words, *more, "--overwrite", "--quiet"),
        ]
        run(commands[name])  # compile the kernels
    seconds, peak = {name: [] for name in commands}, dict.fromkeys(commands, 0.0)
    for _ in range(arguments.runs):
        for name, command in commands.items():
            taken, memory = run(command)
            seconds[name].append(taken)
            peak[name] = max(peak[name], memory)
    for name in commands:
        middle, least = statistics.median(seconds[name]), min(seconds[name])
        print(
            f"{name:<14} {middle:7.2f} s median, {least:6.2f} s least,"
            f" {arguments.points / middle / 1e6:5.2f} M points/s, peak {peak[name]:5.0f} MB"
        )
    for one, other in (("snell", "plain copy"), ("pcfix correct", "snell")):
        pairs = zip(seconds[one], seconds[other], strict=True)
        ratio = statistics.median(a / b for a, b in pairs)
        print(f"ratio {ratio:7.2f} ({one} / {other}, median of {arguments.runs} pairs of runs)")
    sizes = [p.stat().st_size / arguments.points for p in (cloud, corrected)]
    print(f"file           {sizes[0]:.2f} -> {sizes[1]:.2f} bytes a point")
    kernel(cloud, scene, folder / "sensor.csv")


def parsed(about):
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--cameras", type=int, default=200)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--cloud", choices=["tracks", "depth-maps", "pairs"], default="tracks")
    parser.add_argument(
        "--folder", type=Path, default=Path(tempfile.gettempdir()) / "pcfix-benchmark"
    )
    return parser.parse_args()


def make(cloud, arguments):
    """Simulate in a process of its own: what this one holds would count as its children's."""
    folder, words = cloud.parent, ["--overwrite"]
    for name in ("points", "cameras", "cloud"):
        words += [f"--{name}", getattr(arguments, name)]
    run([sys.executable, "-m", "pcfix", "simulate", folder, *words])
    (folder / "cloud.laz").rename(cloud)
    (folder / "cameras.csv").rename(camera_table(cloud))


def camera_table(cloud):
    return cloud.with_name(cloud.name.replace("cloud", "cameras")).with_suffix(".csv")


def run(command, stdout=None):
    """Return seconds and peak memory, MB, of a process."""
    started = time.perf_counter()
    child = subprocess.Popen([str(word) for word in command], stdout=stdout)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"failed: {command}")
    return time.perf_counter() - started, usage.ru_maxrss / 1024


def kernel(cloud, cameras, sensor):
    """Time the intersection alone on a million points in memory."""
    import numpy as np

    import pcfix
    from pcfix.io.las.source import read_xyz
    from pcfix.options.correct import ScienceOptions
    from pcfix.refract.batch import Batch, Survey
    from pcfix.refract.intersect import intersect_in_frame
    from pcfix.water.surface import SurfaceAbove

    xyz = read_xyz(cloud)
    xyz = xyz[xyz[:, 2] < 0.37][:1_000_000]
    block, water = pcfix.read_cameras(cameras, sensor), pcfix.WaterPlane(0.37)
    surface = SurfaceAbove(np.full(len(xyz), 0.37), np.zeros((len(xyz), 2)))
    survey = Survey(water, block, ScienceOptions(method="snell", dimensions="minimal"))
    best, found = np.inf, None
    for _ in range(15):
        started = time.perf_counter()
        found = intersect_in_frame(Batch(xyz, surface, survey))
        best = min(best, time.perf_counter() - started)
    rays = int(found.ray_count.sum())
    print(
        f"kernel         {rays / best / 1e6:7.0f} M rays/s ({len(xyz):,} points,"
        f" {len(block)} cameras, {rays / len(xyz):.0f} rays a point; least of 15 runs, ordering"
        f" and scattering included);"
        f"\n               all pairs of the block, most of them ruled out by tile:"
        f" {len(xyz) * len(block) / best / 1e6:,.0f} M/s"
    )


if __name__ == "__main__":
    main()
