"""Blocks for an adjustment, made of the simulator's scenes."""

from dataclasses import replace
from functools import cache

import numpy as np

from pcfix.adjust.block import Block
from pcfix.adjust.problem import prepare
from pcfix.adjust.solve import solve
from pcfix.model import GnssPositions, TiePoints
from tests.utils.tie_points import TieScene, simulate_tie_points


@cache
def tiny_scene(points: int = 14, **settings) -> TieScene:
    """Return a scene that is small enough for slow twins."""
    return simulate_tie_points(
        points, seed=2, area_m=(25, 20), greatest_depth_m=6, forward_overlap=0.6, side_overlap=0.5,
        obliques_deg=25, oblique_directions=2, oblique_share=0.3, position_noise_m=0.05,
        attitude_noise_deg=0.05, **settings,
    )  # fmt: skip


def block_of(
    scene: TieScene,
    *,
    gnss: bool = True,
    control: bool = False,
    cameras=None,
    water=None,
    index=None,
    exact: bool = False,
    start_xyz=None,
    sigma_px=None,
    checks: bool = False,
) -> Block:
    """Return a scene as a block: tie points, then control points, check points without survey."""
    cameras = scene.cameras if cameras is None else cameras
    rows = np.flatnonzero(control & ~scene.control.is_check | checks & scene.control.is_check)
    marks = [np.flatnonzero(scene.control.point == row) for row in rows]
    each = np.concatenate([np.zeros(0, int), *marks]).astype(int)
    counts = [len(mine) for mine in marks]
    start = np.concatenate([scene.views.start, scene.views.start[-1] + np.cumsum(counts)])
    ties = scene.exact_xy if exact else scene.ties.image_xy
    seen = scene.control_exact_xy if exact else scene.control.image_xy
    xyz = scene.truth if start_xyz is None else start_xyz
    survey = scene.control_truth if exact else scene.control.xyz
    surveyed = replace(
        scene.control, names=tuple(scene.control.names[i] for i in rows), xyz=survey[rows],
        sigma_m=scene.control.sigma_m[rows], is_check=scene.control.is_check[rows],
    )  # fmt: skip
    positions = scene.cameras.gnss
    place = scene.true_cameras.centres if exact else positions.xyz
    nowhere = np.full((len(cameras), 3), np.nan)
    return Block(
        cameras=replace(cameras, gnss=None),
        xyz=np.vstack([xyz, scene.control_truth[rows]]),
        start=start.astype(np.int64),
        camera=np.concatenate([scene.views.camera, scene.control.camera[each]]),
        image_xy=np.vstack([ties, seen[each]]),
        sigma_px=np.full(
            len(scene.views.camera) + len(each), sigma_px or scene.noise.image_px or 0.5
        ),
        wet=np.ones(len(xyz) + len(rows), bool),
        gnss=GnssPositions(place if gnss else nowhere, positions.sigma_m, None),
        water=scene.water if water is None else water,
        refractive_index=scene.refractive_index if index is None else index,
        control=surveyed,
    )


def adjusted(block: Block, unknowns):
    """Return a block as a problem and its solution."""
    problem, start = prepare(block, unknowns)
    return problem, solve(problem, start)


def clear_of_the_waterline(scene: TieScene, by_m: float) -> TieScene:
    """Return a scene without the tie points that are nearer to the water plane.

    The image of a point has a kink where it goes under, which has no normal equations.
    """
    water = scene.water
    level = water.a + scene.truth[:, :2] @ [water.b, water.c]
    return some_ties(scene, np.flatnonzero(np.abs(scene.truth[:, 2] - level) > by_m))


def some_ties(scene: TieScene, rows) -> TieScene:
    """Return a scene with some of its tie points, in the given order."""
    views, start = scene.views.take(rows), scene.views.start
    seen = np.concatenate([np.arange(start[row], start[row + 1]) for row in rows])
    ties = TiePoints(scene.truth[rows], views, scene.ties.image_xy[seen])
    return replace(
        scene,
        truth=scene.truth[rows],
        views=views,
        exact_xy=scene.exact_xy[seen],
        ties=ties,
        is_wet=scene.is_wet[rows],
    )
