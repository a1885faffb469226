"""How long filling holes of a raster takes, by the share of its cells that is empty.

A raster of 1024 by 1024 cells, single cells or squares of 8 by 8 of it empty at random; holes up to
3 and 30 cells wide are filled. Prints seconds, and the share of the empty cells that is left.

    python tests/benchmarks/holes.py
"""

import time

import numpy as np

from pcfix.grid.delaunay import fill_holes
from pcfix.grid.lattice import Window

SIDE = 1024


def main():
    window = Window(0, SIDE, 0, SIDE)
    fill_holes(
        raster(0.3, 1)[:64, :64], Window(0, 64, 0, 64), Window(0, 64, 0, 64), 3.0
    )  # compiles
    for hole in (1, 8):
        for share in (0.0, 0.05, 0.33, 0.66):
            for widest in (3.0, 30.0):
                height = raster(share, hole)
                started = time.perf_counter()
                filled = fill_holes(height, window, window, widest)
                seconds = time.perf_counter() - started
                left = np.isnan(filled).sum() / max(np.isnan(height).sum(), 1)
                print(
                    f"holes of {hole} cells, {share:4.0%} empty, filled up to {widest:2.0f} cells:"
                    f" {seconds:6.2f} s, {left:4.0%} left"
                )


def raster(share, hole):
    rng = np.random.default_rng(1)
    height = np.add.outer(np.sin(np.arange(SIDE) / 50.0), np.cos(np.arange(SIDE) / 30.0))
    empty = rng.random((SIDE // hole, SIDE // hole)) < share
    height[np.kron(empty, np.ones((hole, hole), bool))] = np.nan
    return height


if __name__ == "__main__":
    main()
