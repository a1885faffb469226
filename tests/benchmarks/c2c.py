"""How long a cloud-to-cloud comparison takes beside CloudCompare.

Makes two clouds of a wavy bed once (kept in a folder for the next run), then times, in one run
and by turns, CloudCompare as a whole process, `pcfix compare` as one, and pcfix as a script
has it: a second ``compare_clouds`` in a Python that has its libraries loaded, files read and
figures written. CloudCompare gets its points as binary PLY, the quickest to load of what every
build of it reads; pcfix gets LAS, and in rows of their own LAZ. Prints the ratios, and mean and
standard deviation of both.

    python -m tests.benchmarks.c2c [--points 1000000] [--runs 5] [--folder DIR]
"""

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np

COMMAND = """
import sys
from pathlib import Path
from pcfix.flow.compare import compare_clouds
compare_clouds(*sys.argv[1:3], c2c_only=True, summary=Path(sys.argv[3]), overwrite=True)
"""
SECOND_CALL = f"""{COMMAND}
import time
started = time.perf_counter()
{COMMAND}
print("seconds", time.perf_counter() - started)
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "pcfix_c2c")
    arguments = parser.parse_args()
    folder, count = arguments.folder, arguments.points
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(("cloud", "reference")):
        if not (folder / f"{name}_{count}.ply").exists():
            make(folder, f"{name}_{count}", count, seed)
    names = [folder / f"{name}_{count}" for name in ("cloud", "reference")]
    summary, commands = str(folder / "summary.json"), {}
    for kind in ("LAS", "LAZ"):
        files = [f"{name}.{kind.lower()}" for name in names]
        given = ["--c2c-only", "--overwrite", "--quiet", "--summary", summary]
        commands[f"pcfix, {kind}"] = [sys.executable, "-m", "pcfix", "compare", *files, *given]
        commands[f"pcfix call, {kind}"] = [sys.executable, "-c", SECOND_CALL, *files, summary]
    program = shutil.which("CloudCompare")
    if program:
        files = [word for name in names for word in ("-O", f"{name}.ply")]
        words = [*["-SILENT", "-AUTO_SAVE", "OFF"], *files, "-C2C_DIST"]
        commands["CloudCompare, PLY"] = [program, *words]
    report(commands, arguments.runs)
    said = json.loads((folder / "summary.json").read_text())["c2c"]["after"]["statistics"]
    print(f"pcfix: mean {said['mean_m']:.6f} m, sd {said['sd_m']:.6f} m")


def report(commands, runs):
    """Time the commands by turns and print medians and ratios."""
    seconds = {name: [] for name in commands}
    text = ""
    for turn in range(runs + 1):
        for name, command in commands.items():
            taken, said = run(command)
            text = said if name.startswith("CloudCompare") else text
            inside = re.search(r"seconds (\S+)", said)
            if turn:  # the first fills the disk's cache
                seconds[name].append(float(inside[1]) if inside else taken)
    for name, taken in seconds.items():
        print(f"{name:<18} {statistics.median(taken):6.2f} s median, {min(taken):6.2f} s least")
    other = seconds.get("CloudCompare, PLY")
    if other is None:
        print("CloudCompare is not installed: no ratio")
        return
    for name in commands:
        pairs = zip(other, seconds[name], strict=True)
        print(f"CloudCompare / {name}: {statistics.median(a / b for a, b in pairs):.2f}")
    print("CloudCompare:", *re.findall(r"Mean distance = .*", text))


def run(command):
    started = time.perf_counter()
    done = subprocess.run(
        command, capture_output=True, text=True, check=True,
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
    )  # fmt: skip
    return time.perf_counter() - started, done.stdout + done.stderr


def make(folder, name, count, seed):
    """Write points on a wavy bed, 10 a square metre, as LAS, LAZ and binary PLY."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0.0, np.sqrt(count / 10.0), (count, 2))
    z = -5.0 + 2.0 * np.sin(xy[:, 0] / 30.0) + np.cos(xy[:, 1] / 17.0)
    xyz = np.column_stack([xy, z + 0.03 * seed + rng.normal(0.0, 0.02, count)])
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    las = laspy.LasData(header)
    las.xyz = xyz
    las.write(folder / f"{name}.las")
    las.write(folder / f"{name}.laz")
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    (folder / f"{name}.ply").write_bytes(head.encode() + np.asarray(las.xyz, "<f8").tobytes())


if __name__ == "__main__":
    main()
