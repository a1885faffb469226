"""Points intersected from what the images measured, with the poses as they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import Block, Loss, Unknowns
from pcfix.adjust.normal import point_steps, residuals
from pcfix.adjust.problem import prepare
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, WaterSurface

STEPS = 10
CLOSE_M = 1e-4


class Intersected(NamedTuple):
    """Points and how well they fit their images.

    xyz : shape (m, 3), metres, world frame.
    residual_px : shape (o, 2), measured minus computed; NaN where the intersection failed.
    start : shape (m + 1,), the residuals of point i are ``start[i]:start[i + 1]``.
    """

    xyz: FloatArray
    residual_px: FloatArray
    start: IntArray

    @property
    def redundancy(self) -> IntArray:
        """Measured coordinates minus the three of the point, shape (m,)."""
        return np.asarray(2 * np.diff(self.start) - 3)

    def sums(self, values: FloatArray) -> FloatArray:
        """Return sums over the observations of each point, shape (m,)."""
        owner = np.repeat(np.arange(len(self.xyz)), np.diff(self.start))
        return np.asarray(np.bincount(owner, values, len(self.xyz)), np.float64)

    @property
    def squares(self) -> FloatArray:
        """Sum of squared residuals of each point, px2, shape (m,)."""
        return self.sums((self.residual_px**2).sum(axis=1))


def plain_block(
    cameras: Cameras, xyz: FloatArray, start: IntArray, camera: IntArray, image_xy: FloatArray,
    water: WaterSurface | None, refractive_index: float, wet: BoolArray,
    gnss: tuple[FloatArray, FloatArray] | None = None,
) -> Block:  # fmt: skip
    """Return a block without control points, all observations of 1 px.

    Parameters
    ----------
    cameras : Cameras
    xyz : array, shape (m, 3)
    start, camera, image_xy
        See `pcfix.adjust.block.Block`.
    water : WaterSurface or None
    refractive_index : float
    wet : array of bool, shape (m,)
    gnss : positions and standard deviations, shape (k, 3) each, optional
    """
    k, m = len(cameras), len(xyz)
    nowhere, unknown = np.full((k, 3), np.nan), np.full((k, 3), np.inf)
    return Block(
        cameras, xyz, start, camera, image_xy, np.ones(len(camera)), water, refractive_index, wet,
        np.full((m, 3), np.nan), np.full((m, 3), np.inf), *(gnss or (nowhere, unknown)),
    )  # fmt: skip


def intersect_fixed(block: Block) -> Intersected:
    """Return the points of a block by least squares, poses, lens and water as they are.

    A point that takes more than `STEPS` steps of Gauss and Newton has failed.
    """
    problem, now = prepare(block, Unknowns(poses="fixed", lens=()))
    nothing = np.zeros(len(problem.moves))
    state, step = now.state, np.full((len(block.xyz), 3), np.inf)
    for _ in range(STEPS):
        step = point_steps(state, problem.given, Loss(), 0.0, nothing)
        state = state._replace(xyz=state.xyz + step)
        if np.nanmax(np.abs(step), initial=0.0) < CLOSE_M:
            break
    r = residuals(state, problem.seen, problem.surface)
    settled = (np.abs(step) < CLOSE_M).all(axis=1)
    r[~settled[block.owner]] = np.nan
    return Intersected(state.xyz + problem.origin, r, np.asarray(block.start))
