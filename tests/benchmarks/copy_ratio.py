"""How much longer a correction takes than a plain copy of the same file.

Simulates a cloud once (kept in a folder for the next run), then times, in one run and by turns,
``pcfix correct``, the same with ``--method snell --max-angle none``, and plain laspy reading and
writing of the input and of the very records that the correction writes, each as a process of its
own. Prints times, processor time, the ratios to the latter copy, and the peak memory. How fast the
kernel is, `scaling.py` tells.

    python -m tests.benchmarks.copy_ratio [--points 5000000] [--cameras 200] [--cloud depth-maps]
        [--folder DIR]
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

COPIED = "copy of the same records"
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
    correct = [sys.executable, "-m", "pcfix", "correct", cloud, corrected, *words]
    commands = {
        "snell": [*correct, "--method", "snell", "--max-angle", "none", "--overwrite", "--quiet"],
        "default": [*correct, "--overwrite", "--quiet"],
        "copy of the input": [sys.executable, "-c", COPY, cloud, copied],
        COPIED: [sys.executable, "-c", COPY, corrected, copied],
    }
    for name in ("snell", "default"):
        run(commands[name])  # compile the kernels
    found = {name: [] for name in commands}
    for _ in range(arguments.runs):
        for name, command in commands.items():
            found[name].append(run(command))
    print("                              clock, median  processor  peak memory")
    for name, runs in found.items():
        clock, core, peak = np.median(runs, axis=0)
        print(f"{name:<28}  {clock:11.2f} s  {core:7.2f} s  {peak:8.0f} MB")
    for name in ("snell", "default"):
        ratios = np.array(found[name])[:, :2] / np.array(found[COPIED])[:, :2]
        clock, core = np.median(ratios, axis=0)
        print(f"{name} / {COPIED}: {clock:.2f} by the clock, {core:.2f} of the processor")
    sizes = [p.stat().st_size / arguments.points for p in (cloud, corrected)]
    print(f"file           {sizes[0]:.2f} -> {sizes[1]:.2f} bytes a point")


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
    folder = cloud.parent
    given = f"{arguments.points}, cameras={arguments.cameras}, cloud={arguments.cloud!r}"
    script = (
        "from pcfix.io.scenes import write_scene\n"
        "from tests.utils.matchers import matched_scene\n"
        f"write_scene(matched_scene({given}), {str(folder)!r}, overwrite=True)"
    )
    run([sys.executable, "-c", script])
    (folder / "cloud.laz").rename(cloud)
    (folder / "cameras.csv").rename(camera_table(cloud))


def camera_table(cloud):
    return cloud.with_name(cloud.name.replace("cloud", "cameras")).with_suffix(".csv")


def run(command, stdout=None):
    """Return seconds by the clock and of the processor, and peak memory, MB, of a process."""
    started = time.perf_counter()
    child = subprocess.Popen([str(word) for word in command], stdout=stdout)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"failed: {command}")
    clock, core = time.perf_counter() - started, usage.ru_utime + usage.ru_stime
    return clock, core, usage.ru_maxrss / 1024


if __name__ == "__main__":
    main()
