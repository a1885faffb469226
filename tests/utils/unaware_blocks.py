"""Blocks over water that were adjusted by software which knew of no water, and what came of it.

Images are made by `pcfix.simulate`. The unaware adjustment is an ordinary one, of straight rays,
with a free focal length and no datum but its start, laid onto the GNSS positions by a similarity.
"""

from dataclasses import dataclass, replace

import numpy as np

from pcfix.adjust.normal import SQUARES
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.problem import prepare, solved_cameras
from pcfix.adjust.solve import solve
from pcfix.model import Cameras, FloatArray, TiePoints
from pcfix.simulate.tracing import triangulate
from tests.utils.tie_blocks import block_of, some_ties
from tests.utils.tie_points import TieScene


@dataclass(frozen=True, eq=False)
class Unaware:
    """A scene, and the cameras and apparent points of an adjustment that knew of no water."""

    scene: TieScene
    cameras: Cameras
    ties: TiePoints


def unaware(scene: TieScene, *, exact: bool = False, loss: int = SQUARES) -> Unaware:
    """Adjust a scene with straight rays."""
    block = block_of(scene, exact=exact, gnss=False)
    dry = replace(block, water=None, wet=np.zeros(len(block.xyz), bool))
    problem, start = prepare(dry, Unknowns(lens=("f",), free_network=True))
    found = solve(problem, start, loss)
    cameras, xyz = solved_cameras(problem, found), found.state.xyz + problem.origin
    target = scene.true_cameras.centres if exact else scene.cameras.gnss.xyz
    scale, turn, shift = similarity(cameras.centres, target)
    cameras = replace(
        cameras, centres=scale * cameras.centres @ turn.T + shift,
        rotations=cameras.rotations @ turn.T, gnss=None,
    )  # fmt: skip
    image = scene.exact_xy if exact else scene.ties.image_xy
    return Unaware(scene, cameras, TiePoints(scale * xyz @ turn.T + shift, scene.views, image))


def similarity(start: FloatArray, target: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return scale, turn and shift that take points nearest to others (Umeyama 1991)."""
    a, b = start - start.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = (u * sign) @ vt
    scale = float((s * sign).sum() / (a * a).sum())
    return scale, turn, target.mean(axis=0) - scale * turn @ start.mean(axis=0)


def parted(scene: TieScene, ties: int) -> tuple[TieScene, TieScene]:
    """Return a scene with the first tie points, and one with the others."""
    return some_ties(scene, np.arange(ties)), some_ties(scene, np.arange(ties, len(scene.truth)))


def apparent_cloud(data: Unaware, others: TieScene) -> FloatArray:
    """Return where the unaware cameras see points, by straight rays."""
    old, views = data.cameras, others.views
    return triangulate(
        others.ties.image_xy, old, views.camera, views.start, old.lenses[0], others.truth
    )
