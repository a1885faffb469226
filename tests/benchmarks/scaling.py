"""How the kernel of ``snell``, standard errors included, goes with the number of cameras.

Blocks of more and more images at one overlap (80 % along, 60 % across), always the same number of
points to the square metre in the middle of them, a chunk of a file at a time. Files have neighbours
near each other, here in strips of 2 m; points at random wait for memory. Prints the rays a second,
of points in strips and at random, and the processor time a point.

    python -m tests.benchmarks.scaling [--points 400000]
"""

import argparse
import time

import numpy as np

import pcfix
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Survey
from pcfix.refract.intersect import intersect
from pcfix.water.surface import SurfaceAbove

CAMERAS = (50, 200, 1000, 5000)
HEIGHT_M, LENS = 100.0, pcfix.Lens(8.8, 13.2, 8.8, 6.6, 4.4)
ALONG_M, ACROSS_M = 0.2 * HEIGHT_M * 8.8 / 8.8, 0.4 * HEIGHT_M * 13.2 / 8.8


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=400_000)
    given = parser.parse_args()
    print("cameras  rays a point  M rays/s (clock)  a core  processor, us a point  at random")
    for count in CAMERAS:
        _, rays, *at_random = measured(count, given.points, in_strips=False)
        _, _, clock_s, core_s = measured(count, given.points, in_strips=True)
        print(
            f"{count:7,}  {rays:12.1f}  {rays / clock_s:16.1f}  {rays / core_s:6.1f}"
            f"  {core_s:21.3f}  {rays / at_random[0]:9.1f}"
        )


def measured(count, points, *, in_strips):
    """Return cameras, rays a point, and microseconds a point by the clock and the processor."""
    strips = max(1, round(np.sqrt(count * ALONG_M / ACROSS_M)))
    place = np.arange(count)
    strip, along = place % strips, place // strips
    centres = np.column_stack([strip * ACROSS_M, along * ALONG_M, np.full(count, HEIGHT_M)])
    down = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (count, 3, 3))
    names = tuple(f"{i}" for i in range(count))
    cameras = pcfix.Cameras(names, centres, down, (LENS,) * count)
    middle, side = centres[:, :2].mean(axis=0), 100.0
    xy = middle + np.random.default_rng(1).uniform(-side / 2, side / 2, (points, 2))
    if in_strips:
        xy = xy[np.lexsort((xy[:, 0], np.floor(xy[:, 1] / 2.0)))]
    xyz = np.column_stack([xy, -3.0 + np.sin(xy[:, 0] / 30.0)])
    above = SurfaceAbove(np.zeros(points), np.zeros((points, 2)))
    survey = Survey(pcfix.WaterPlane(0.0), cameras, ScienceOptions(method="snell"))
    clock, core = np.inf, np.inf
    for _ in range(6):
        started, used = time.perf_counter(), time.process_time()
        found = intersect(Batch(xyz, above, survey))
        clock = min(clock, time.perf_counter() - started)
        core = min(core, time.process_time() - used)
    return count, float(found.ray_count.mean()), 1e6 * clock / points, 1e6 * core / points


if __name__ == "__main__":
    main()
