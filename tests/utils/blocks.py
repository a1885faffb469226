"""Small blocks with tie points, for what writes them."""

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.model import Cameras, Lens, TiePoints, Views

PLAIN = Lens(1500.25, 1600.0, 1200.0, 806.3, 594.5)
DOWN = np.diag([1.0, -1.0, -1.0])


def small_block(lenses=(PLAIN,), crs="EPSG:32636", origin=(319900.0, 3842700.0, 0.0), k=6):
    """Return k cameras 75 m up that look about down, turned each in its own way."""
    rng = np.random.default_rng(5)
    centres = np.array(origin) + rng.uniform([0, 0, 70], [120, 120, 80], (k, 3))
    turns = Rotation.from_euler(
        "zyx", rng.uniform([-180, -20, -20], [180, 20, 20], (k, 3)), degrees=True
    )
    rotations = DOWN @ turns.as_matrix()
    return Cameras(
        labels=tuple(f"strip_{i % 2}/IMG_{i:03d}.JPG" for i in range(k)),
        centres=centres,
        rotations=rotations,
        lenses=tuple(lenses[i % len(lenses)] for i in range(k)),
        crs=crs,
    )


def some_ties(cameras, origin=(319900.0, 3842700.0, 0.0), m=50):
    """Return points and places in the images; the places need not fit, as nobody asks."""
    rng = np.random.default_rng(6)
    counts = rng.integers(2, len(cameras) + 1, m)
    camera = np.concatenate([np.sort(rng.permutation(len(cameras))[:n]) for n in counts])
    start = np.concatenate([[0], np.cumsum(counts)])
    xyz = np.array(origin) + rng.uniform([0, 0, -10], [120, 120, 5], (m, 3))
    uv = rng.uniform([0, 0], [1600, 1200], (len(camera), 2))
    return TiePoints(xyz, Views(start, camera), uv)
