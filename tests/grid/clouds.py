"""Small clouds to grid."""

import numpy as np

from tests.utils.clouds import write_las

EAST, NORTH = 456_000.0, 5_432_000.0
SCALE = "0.001"


def write(path, xyz, classes=0, withheld=0, crs=32633, offsets=(EAST, NORTH, 0.0)):
    """Write a cloud in millimetres and return its path."""
    return write_las(path, xyz, classes, withheld=withheld, crs=crs, offsets=offsets)


def scattered(count, width, height, seed=5):
    """Return random points, to the millimetre, with heights from 3 to 30 m."""
    rng = np.random.default_rng(seed)
    low, high = (EAST, NORTH, 3.0), (EAST + width, NORTH + height, 30.0)
    return np.round(rng.uniform(low, high, (count, 3)), 3)


def awkward(seed=6):
    """Return 60 x 45 m with all that makes ties: a lattice, twins, edges, holes, a dense part."""
    lattice = np.stack(np.meshgrid(np.arange(0, 30, 0.5), np.arange(0, 45, 0.5)), -1).reshape(-1, 2)
    loose = scattered(3000, 30.0, 45.0, seed)[:, :2] - (EAST - 30.0, NORTH)
    dense = scattered(3000, 4.0, 4.0, seed + 1)[:, :2] - (EAST - 40.0, NORTH - 20.0)
    plan = np.vstack([lattice, loose, dense, lattice[:50]])
    for x, y, radius in ((12.0, 12.0, 1.0), (20.0, 30.0, 4.0), (45.0, 30.0, 1.6), (52, 10, 3.0)):
        plan = plan[np.hypot(plan[:, 0] - x, plan[:, 1] - y) > radius]
    rng = np.random.default_rng(seed)
    z = 12.0 + np.sin(plan[:, 0] / 3.0) + plan[:, 1] / 10.0 + rng.normal(0.0, 0.1, len(plan))
    xyz = np.column_stack([plan[:, 0] + EAST, plan[:, 1] + NORTH, z])
    return np.round(rng.permutation(xyz), 3)
