"""The four backward ray tracers beside each other: speed and which paths they find.

Light is traced from points 1 to 8 m deep to cameras 20 to 60 m above six waters: level, tilted,
gentle and steep waves as rasters of cells of 0.25 m, and both as meshes of facets of 0.5 m. Each
method has the CPU time of a path (the best of three), and the shares of paths that leave the water
through a crease or are not found.

    python -m tests.benchmarks.tracing [--paths 20000]
"""

import argparse
import time

import numpy as np

from pcfix.model import WaterMesh, WaterPlane, WaterRaster
from pcfix.refract.tracing import METHODS, trace
from pcfix.running import threads

INDEX = 1.34
HALF_M, CELL_M, FACET_M, WAVELENGTH_M = 150.0, 0.25, 0.5, 5.0


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
        print("method       us/path  crease %  lost %")
        for method in METHODS:
            seconds = []
            for _ in range(3):
                started = time.process_time()
                with threads(1):
                    found = trace(centres, points, water, refractive_index=INDEX, method=method)
                seconds.append(time.process_time() - started)
            print(
                f"{method:12} {1e6 * min(seconds) / len(points):7.2f}"
                f" {100 * found.on_crease.mean():9.2f} {100 * (1 - found.converged.mean()):7.2f}"
            )


def block(count):
    """Return true points and a camera for each, up to 60 degrees of incidence."""
    rng = np.random.default_rng(1)
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


if __name__ == "__main__":
    main()
