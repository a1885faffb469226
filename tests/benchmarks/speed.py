"""How long commands take and how much memory they need, each as a process of its own.

    python -m tests.benchmarks.speed start [--cold]
    python -m tests.benchmarks.speed correct [--points 5000000] [--cameras 200] [--cloud pairs]
    python -m tests.benchmarks.speed compare [--points 1000000]
    python -m tests.benchmarks.speed raster --runs 0 [--points 400000000]

start : Imports, help, and a correction of the sample scene. The first correction with --cold, in an
    empty folder for compiled kernels, takes a minute.

correct : A simulated cloud corrected by the default and by ``--method snell --max-angle none``, and
    plain laspy copies of the input and of the records that the correction writes.

compare : Two clouds of a wavy bed in random order, 10 points a square metre: distances between the
    clouds (c2c) and of M3C2, heights, and cleaning; CloudCompare's c2c, if it is installed, reads
    binary PLY, the quickest to load of what every build of it reads.

raster : A simulated DSM of a lake, with cells of 0.1 m, corrected to a raster: 30 % of its cells
    are water, 30 % land and 40 % have no height.

Commands run by turns, --runs times after one that compiles kernels and fills the disk's cache;
with 0 only that one. Prints the medians of clock and processor time and the peak memory. Clouds are
made once and kept in --folder.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np
import rasterio
from rasterio.transform import from_origin

from tests.utils.shared import SCENE

PYTHON, PCFIX = [sys.executable, "-c"], [sys.executable, "-m", "pcfix"]
MAKE = """
from pcfix.flow.demo import write_scene
from tests.utils.matchers import matched_scene
write_scene(matched_scene({points}, cameras={cameras}, cloud={cloud!r}), {folder!r}, overwrite=True)
"""
COPY = """
import sys, laspy
with laspy.open(sys.argv[1]) as source, laspy.open(
    sys.argv[2], "w", header=source.header, do_compress=sys.argv[2].endswith("z")
) as sink:
    for points in source.chunk_iterator(1_000_000):
        sink.write_points(points)
"""
OVER = ["--overwrite", "--quiet"]
CHUNK = 1_000_000


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=["start", "correct", "compare", "raster"])
    parser.add_argument("--points", type=int)
    parser.add_argument("--cameras", type=int, default=200)
    parser.add_argument("--cloud", choices=["tracks", "depth-maps", "pairs"], default="tracks")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--cold", action="store_true")
    default = Path(tempfile.gettempdir()) / "pcfix-benchmark"
    parser.add_argument("--folder", type=Path, default=default)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    kinds = {"start": start, "correct": correct, "compare": compare, "raster": raster}
    commands = kinds[given.kind](given)
    found = {name: [] for name in commands}
    for turn in range(given.runs + 1):
        for name, command in commands.items():
            taken = run(command)
            if turn or not given.runs:
                found[name].append(taken)
    for name, runs in found.items():
        show(name, *np.median(runs, axis=0))


def start(given):
    words = [SCENE / "cloud.laz", given.folder / "out.laz", "--cameras", SCENE / "cameras.csv"]
    corrected = [*PCFIX, "correct", *words, "--water", "0.37", *OVER]
    if given.cold:
        with tempfile.TemporaryDirectory() as kernels:
            show("first correction", *run(corrected, NUMBA_CACHE_DIR=kernels))
    return {
        "import pcfix": [*PYTHON, "import pcfix"],
        "pcfix --help": [*PCFIX, "--help"],
        "correction": corrected,
    }


def correct(given):
    folder, points = given.folder, given.points or 5_000_000
    scene = folder / f"{given.cloud}_{points}_{given.cameras}"
    if not scene.exists():
        scene_options = {"points": points, "cameras": given.cameras, "cloud": given.cloud}
        run([*PYTHON, MAKE.format(**scene_options, folder=str(scene))])
    cloud, corrected = scene / "cloud.laz", folder / "corrected.laz"
    words = ["--cameras", scene / "cameras.csv", "--water", "0.37", *OVER]
    default = [*PCFIX, "correct", cloud, corrected, *words]
    return {
        "snell": [*default, "--method", "snell", "--max-angle", "none"],
        "default": default,
        "copy of the input": [*PYTHON, COPY, cloud, folder / "copy.laz"],
        "copy of the same records": [*PYTHON, COPY, corrected, folder / "copy.laz"],
    }


def compare(given):
    names = [given.folder / f"{name}_{given.points or CHUNK}" for name in ("cloud", "reference")]
    for seed, name in enumerate(names):
        if not name.with_suffix(".las").exists():
            wavy(name, given.points or CHUNK, seed)
    files = [name.with_suffix(".las") for name in names]
    words = [*PCFIX, "compare", *files, "--summary", given.folder / "found.json", *OVER]
    commands = {
        "c2c": [*words, "--c2c-only"],
        "heights": [*words, "--water", "-5"],
        "M3C2": [*words, "--c2c-only", "--m3c2"],
        "clean": [*PCFIX, "clean", files[0], given.folder / "clean.las", *OVER],
    }
    if program := shutil.which("CloudCompare"):
        opened = [word for name in names for word in ("-O", name.with_suffix(".ply"))]
        commands["CloudCompare, c2c"] = [program, "-SILENT", "-AUTO_SAVE", "OFF", *opened]
        commands["CloudCompare, c2c"] += ["-C2C_DIST"]
    return commands


def raster(given):
    """Correct the DSM of a lake with cameras 500 m above it."""
    side = round(np.sqrt(given.points or 400_000_000))
    dsm, cameras = given.folder / f"lake_{side}.tif", given.folder / f"lake_{side}.csv"
    if not dsm.exists():
        lake(dsm, side)
        along, across = (np.arange(0.0, 0.1 * side, step) for step in (100.0, 300.0))
        lines = [f"{x}_{y},{x},{y},500,0,0,0" for y in across for x in along]
        cameras.write_text("\n".join(["label,x,y,z,yaw,pitch,roll", *lines]))
    words = [dsm, given.folder / "lake_corrected.tif", "--cameras", cameras, "--water", "0"]
    sensor = ["--sensor", SCENE / "sensor.csv"]
    return {"raster": [*PCFIX, "correct", *words, *sensor, "--method", "snell", *OVER]}


def lake(path, side, cell_m=0.1):
    """Write a DSM whose shore and edge are circles, window by window."""
    profile = {
        "driver": "GTiff", "width": side, "height": side, "count": 1, "dtype": "float32",
        "nodata": -9999.0, "crs": "EPSG:32633", "tiled": True, "compress": "deflate", "zlevel": 1,
        "transform": from_origin(0.0, cell_m * side, cell_m, cell_m), "bigtiff": "yes",
    }  # fmt: skip
    rng, middle, shore = np.random.default_rng(1), side / 2.0, 0.3 / np.pi
    with rasterio.open(path, "w", **profile) as out:
        for _, window in out.block_windows(1):
            row = np.arange(window.height)[:, None] + window.row_off - middle
            column = np.arange(window.width) + window.col_off - middle
            area = (row**2 + column**2) / side**2
            z = 20.0 * (np.sqrt(area / shore) - 1.0) + np.sin(row / 40.0) * np.cos(column / 30.0)
            z += rng.normal(0.0, 0.02, z.shape)
            z[area > 2.0 * shore] = -9999.0
            out.write(z.astype(np.float32), 1, window=window)


def wavy(path, count, seed):
    """Write points on a wavy bed as LAS and as binary PLY, chunk by chunk."""
    rng = np.random.default_rng(seed)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{axes}end_header\n"
    las, ply = path.with_suffix(".las"), path.with_suffix(".ply")
    with laspy.open(las, "w", header=header) as sink, ply.open("wb") as stream:
        stream.write(head.encode())
        for first in range(0, count, CHUNK):
            some = min(CHUNK, count - first)
            xy = rng.uniform(0.0, np.sqrt(count / 10.0), (some, 2))
            z = -5.0 + 2.0 * np.sin(xy[:, 0] / 30.0) + np.cos(xy[:, 1] / 17.0)
            points = laspy.ScaleAwarePointRecord.zeros(some, header=header)
            points.x, points.y = xy.T
            points.z = z + 0.03 * seed + rng.normal(0.0, 0.02, some)
            sink.write_points(points)
            xyz = np.column_stack([points.x, points.y, points.z])
            stream.write(xyz.astype("<f8").tobytes())


def run(command, **variables):
    """Return seconds by the clock and of the processor, and peak memory, MB, of a process."""
    started = time.perf_counter()
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", **variables}
    child = subprocess.Popen(
        [str(word) for word in command], stdout=subprocess.DEVNULL, env=environment
    )
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"failed: {command}")
    return time.perf_counter() - started, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def show(name, clock, core, peak):
    print(f"{name:<26}{clock:8.2f} s{core:8.2f} s of the processor{peak:8.0f} MB", flush=True)


if __name__ == "__main__":
    main()
