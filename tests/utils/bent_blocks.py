"""Blocks over water with what their images measured, and poses as ordinary software leaves them.

The light is traced by `pcfix.simulate.tracing`, which shares nothing with the adjustment.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import Unknowns, plain_block
from pcfix.adjust.problem import prepare, solved_cameras
from pcfix.adjust.solve import solve
from pcfix.model import Cameras, GnssPositions, Lens, TiePoints, Views
from tests.utils.bed_rays import piercing_points

HEIGHT_M, FOCAL_PX, SIZE = 75.0, 1500.0, (1600.0, 1200.0)
N = 1.34
LEVEL_M = 0.0
GNSS_M = 0.03
NOISE_PX = 0.5
DOWN = np.diag([1.0, -1.0, -1.0])


class TrueBlock:
    """True cameras and points, image places with noise, and GNSS positions.

    A beach rises at the west end; the bed goes down eastwards to `depth_m`.
    """

    def __init__(self, seed, n=N, depth_m=8.0, strips=(6, 5), points=700):
        rng = np.random.default_rng(seed)
        lens = Lens(FOCAL_PX, *SIZE, 800.0 + rng.normal(0, 3), 600.0 + rng.normal(0, 3))
        x, y = np.meshgrid(np.arange(strips[0]) * 12.0, np.arange(strips[1]) * 28.0)
        centres = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_M)])
        centres += rng.normal(0.0, 0.8, centres.shape)
        angles = rng.normal(0.0, 2.0, centres.shape)
        angles[:, 0] += 90.0 + 180.0 * (np.arange(x.size) // strips[0] % 2)
        rotations = DOWN @ Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
        k = len(centres)
        gnss = centres + rng.normal(0.0, GNSS_M, centres.shape)
        self.cameras = Cameras(
            tuple(f"{i}.jpg" for i in range(k)), centres, rotations, (lens,) * k,
            gnss=GnssPositions(gnss, np.full((k, 3), GNSS_M), None),
        )  # fmt: skip
        low, high = centres[:, :2].min(axis=0) - 15.0, centres[:, :2].max(axis=0) + 15.0
        xy = rng.uniform(low, high, (points, 2))
        east = (xy[:, 0] - low[0]) / (high[0] - low[0])
        bed = -0.2 - depth_m * (east - 0.25) + 0.5 * np.sin(xy[:, 0] / 9) * np.sin(xy[:, 1] / 7)
        xyz = np.column_stack([xy, np.where(east < 0.25, 1.0 + east, bed)])
        self._look(xyz, lens, n, rng)

    def _look(self, xyz, lens, n, rng):
        point, camera = (a.ravel() for a in np.indices((len(xyz), len(self.cameras))))
        centres = self.cameras.centres[camera]
        straight = piercing_points(xyz[point], centres, LEVEL_M, n) - centres
        local = np.einsum("oij,oj->oi", self.cameras.rotations[camera], straight)
        uv = lens.focal * local[:, :2] / local[:, 2:] + [lens.principal_x, lens.principal_y]
        inside = (local[:, 2] > 0) & (uv > 0).all(axis=1) & (uv < SIZE).all(axis=1)
        inside &= np.bincount(point[inside], minlength=len(xyz))[point] >= 3
        number = np.cumsum(np.bincount(point[inside], minlength=len(xyz)) > 0) - 1
        seen = np.unique(point[inside])
        self.xyz, self.camera = xyz[seen], camera[inside]
        counts = np.bincount(number[point[inside]], minlength=len(seen))
        self.start = np.concatenate([[0], np.cumsum(counts)])
        self.image_xy = uv[inside] + rng.normal(0.0, NOISE_PX, (inside.sum(), 2))

    def block(self, cameras, water, wet=None):
        """Return what was measured as a block with given cameras."""
        ties = TiePoints(self.xyz, Views(self.start, self.camera), self.image_xy)
        return plain_block(cameras, ties, water, N, wet)

    def adjusted(self, water=None, gnss_sigma_m=0.1):
        """Return the cameras after a bundle adjustment; without water, as usual software has it."""
        wet = np.full(len(self.xyz), water is not None)
        block = replace(
            self.block(self.cameras, water, wet),
            sigma_px=np.full(len(self.camera), NOISE_PX),
            gnss_xyz=self.cameras.gnss.xyz,
            gnss_sigma_m=np.full((len(self.cameras), 3), gnss_sigma_m),
        )
        problem, start = prepare(block, Unknowns(lens=("f", "cx", "cy")))
        found = solved_cameras(problem, solve(problem, start))
        return replace(found, gnss=self.cameras.gnss)
