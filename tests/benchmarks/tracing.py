"""The four backward ray tracers beside each other: speed, range and failures.

Light is traced from points 1 to 8 m deep to cameras 20 to 60 m above six waters: level, tilted,
gentle and steep waves as rasters of cells of 0.25 m, and both as meshes of facets of 0.5 m. For
each method, the CPU time of a path (the best of three), the steps, and which share of paths it
found by itself, left through a crease (the grids narrowed down to it) or lost; by how much at most
a ray that Snell's law bends in numpy where the method says misses the point; and how far it ended
from `scattershot` where it went elsewhere, which on broken surfaces may be another of several true
paths. Then the range: the steepest incidence at which all paths come back over a level, and the
roughest waves at which the method by itself finds 99 % of the rays that there are.

    python -m tests.benchmarks.tracing [--paths 20000]
"""

import argparse
import time

import numpy as np

from pcfix.model import WaterMesh, WaterPlane, WaterRaster
from pcfix.refract.tracing import METHODS, trace
from pcfix.running import threads
from pcfix.water.surface import surface_above

INDEX = 1.34
HEAD = (
    "method       us/path  steps   ray %  crease %  lost %  miss, nm  elsewhere %"
    "  95 % of these within, m"
)
HALF_M, CELL_M, FACET_M, WAVELENGTH_M = 150.0, 0.25, 0.5, 5.0
INCIDENCES_DEG = (60.0, 70.0, 80.0, 85.0, 87.0, 88.0, 89.0, 89.5, 89.8)
SLOPES_DEG = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 25.0, 30.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--paths", type=int, default=20_000)
    count = parser.parse_args().paths
    waters = {
        "level": WaterPlane(0.0),
        "tilted plane, 3 deg": WaterPlane(0.2, np.tan(np.radians(3.0)), 0.0),
        "gentle waves, 2 deg, raster": waves(2.0),
        "gentle waves, 2 deg, mesh": facets(waves(2.0, FACET_M)),
        "steep waves, 15 deg, raster": waves(15.0),
        "steep waves, 15 deg, mesh": facets(waves(15.0, FACET_M)),
    }
    points, centres = block(count)
    for name, water in waters.items():
        print(f"\n{name}")
        print(HEAD)
        compare(points, centres, water)
    print("\nrange")
    print("method       steepest incidence, deg   roughest waves, largest slope, deg")
    for method in METHODS:
        print(f"{method:12} {steepest(method):>23} {roughest(method, count // 10):>36}")


def block(count, seed=1):
    """Return true points and a camera for each, up to 60 degrees of incidence."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-30, 30, (count, 2)), rng.uniform(-8.0, -1.0, count)])
    height = rng.uniform(20.0, 60.0, count)
    aside = height * np.tan(np.radians(rng.uniform(0.0, 60.0, count)))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    centres = np.column_stack([aside * np.cos(angle), aside * np.sin(angle), height])
    centres[:, :2] += points[:, :2]
    return points, centres


def waves(slope_deg, cell_m=CELL_M):
    """Return two crossing trains of waves with that largest slope along either, as a raster."""
    wave = 2.0 * np.pi / WAVELENGTH_M
    x = np.arange(-HALF_M + cell_m / 2, HALF_M, cell_m)
    height = np.tan(np.radians(slope_deg)) / wave * np.sin(wave * x)
    other = np.sin(wave * x[::-1, None] + 0.7)
    return WaterRaster(0.5 * (height + height.max() * other), -HALF_M, HALF_M, (cell_m, cell_m))


def facets(raster):
    """Return two triangles for each four cells of a raster."""
    rows, columns = raster.height_m.shape
    cell = raster.cell_m[0]
    x = raster.left_m + cell * (np.arange(columns) + 0.5)
    y = raster.top_m - cell * (np.arange(rows) + 0.5)
    vertices = np.dstack([*np.meshgrid(x, y), raster.height_m]).reshape(-1, 3)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (side.ravel() for side in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    return WaterMesh(vertices, np.concatenate([np.c_[a, c, b], np.c_[b, c, d]]))


def compare(points, centres, water):
    """Print one line for each method."""
    truth = trace(centres, points, water, refractive_index=INDEX, method="scattershot")
    for method in METHODS:
        seconds = []
        for _ in range(3):
            started = time.process_time()
            with threads(1):
                found = trace(centres, points, water, refractive_index=INDEX, method=method)
            seconds.append(time.process_time() - started)
        alone = trace(centres, points, water, refractive_index=INDEX, method=method, narrow=False)
        ray = alone.converged & ~alone.on_crease
        miss = misses(points, alone, water)[ray].max()
        apart = np.linalg.norm(found.piercing_xyz - truth.piercing_xyz, axis=1)
        other = apart[apart > 1e-4]
        print(
            f"{method:12} {1e6 * min(seconds) / len(points):7.2f} {alone.iterations.mean():6.1f}"
            f" {100 * ray.mean():7.2f} {100 * found.on_crease.mean():9.2f}"
            f" {100 * (1 - found.converged.mean()):7.2f} {1e9 * miss:9.2f}"
            f" {100 * len(other) / len(apart):12.2f}"
            f" {np.percentile(other, 95) if len(other) else 0.0:17.3f}"
        )


def misses(points, found, water):
    """Return how far from the points the rays pass that Snell's law bends where they pierce."""
    b, c = surface_above(water, found.piercing_xyz).slope.T
    normal = np.column_stack([-b, -c, np.ones(len(b))]) / np.sqrt(1 + b * b + c * c)[:, None]
    down = (found.direction * normal).sum(axis=1)[:, None]
    along = (found.direction - down * normal) / INDEX
    wet = along - np.sqrt(1.0 - (along * along).sum(axis=1))[:, None] * normal
    return np.linalg.norm(np.cross(points - found.piercing_xyz, wet), axis=1)


def steepest(method):
    """Return the steepest incidence up to which all of 500 paths over a level come back."""
    rng = np.random.default_rng(2)
    last = "none"
    for angle in INCIDENCES_DEG:
        i = np.radians(angle)
        height, depth = rng.uniform(20.0, 60.0, 500), rng.uniform(1.0, 8.0, 500)
        leaves = np.column_stack([height * np.tan(i), np.zeros(500), np.zeros(500)])
        below = depth * np.tan(np.arcsin(np.sin(i) / INDEX))
        points = leaves + np.column_stack([below, np.zeros(500), -depth])
        centres = np.column_stack([np.zeros((500, 2)), height])
        found = trace(
            centres, points, WaterPlane(0.0), refractive_index=INDEX, method=method, narrow=False
        )
        apart = np.linalg.norm(found.piercing_xyz - leaves, axis=1)
        if not (apart < 1e-6).all():
            break
        last = f"{angle:g}"
    return last


def roughest(method, count):
    """Return the roughest waves in which the method finds 99 % of the rays there are."""
    points, centres = block(count, 3)
    last = "none"
    for slope in SLOPES_DEG:
        water = waves(slope)
        truth = trace(centres, points, water, refractive_index=INDEX, method="scattershot")
        there = truth.converged & ~truth.on_crease
        found = trace(centres, points, water, refractive_index=INDEX, method=method, narrow=False)
        if (found.converged & ~found.on_crease)[there].mean() < 0.99:
            break
        last = f"{slope:g}"
    return last


if __name__ == "__main__":
    main()
