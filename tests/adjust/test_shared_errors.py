"""Standard errors hold where observations share errors, and are no larger where they do not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import disagreement_of, precision_of
from pcfix.adjust.result import sigma0_of
from tests.utils.tie_blocks import adjusted, block_of
from tests.utils.tie_points import simulate_tie_points

NOISE_PX = 0.2
DRAWS = 2


@cache
def scene():
    return simulate_tie_points(
        400, area_m=(40, 35), greatest_depth_m=5, obliques_deg=30, oblique_directions=4,
        image_noise=NOISE_PX, seed=5,
    )  # fmt: skip


def with_errors(rng, kind):
    """Return a block with fresh noise, and with errors of the same size that many share."""
    block = block_of(scene().measured(rng), sigma_px=NOISE_PX)
    if kind == "none":
        return block
    if kind == "lens":  # a plate that is bent by a wave of half the diagonal
        lens = block.cameras.lenses[0]
        half = 0.5 * np.hypot(lens.width, lens.height)
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        along = (block.image_xy - [lens.principal_x, lens.principal_y]) @ [
            np.cos(angle),
            np.sin(angle),
        ]
        wave = 1.5 * NOISE_PX * np.cos(2.0 * np.pi * along / half + phase)
        off = wave[:, None] * [np.cos(phase), np.sin(phase)]
        return replace(block, image_xy=block.image_xy + off)
    place = np.floor(block.xyz[block.owner, :2] / 10.0).astype(int)
    _, tile = np.unique(
        np.column_stack([place, block.camera]), axis=0, return_inverse=True
    )  # what a patch of the bed looks like from one image
    error = rng.normal(0.0, 1.5 * NOISE_PX, (tile.max() + 1, 2))
    return replace(block, image_xy=block.image_xy + error[tile.ravel()])


def draws(kind, count=DRAWS):
    """Return errors over standard errors of each kind of unknown, formal ones and larger ones."""
    rng, data, both = np.random.default_rng(8), scene(), []
    for _ in range(count):
        problem, found = adjusted(with_errors(rng, kind), Unknowns(lens=("f",)))
        formal = precision_of(problem, found, sigma0_of(problem, found))
        factor = disagreement_of(problem, found, formal)
        off = found.state.centres + problem.origin - data.true_cameras.centres
        turn = found.state.rotations @ data.true_cameras.rotations.transpose(0, 2, 1)
        angles = np.degrees(Rotation.from_matrix(turn).as_rotvec())
        rows = []
        for precision in (formal, precision_of(problem, found, formal.sigma0, factor)):
            z = np.hstack([angles / precision.angle_sigma_deg, off / precision.centre_sigma_m])
            rows.append(np.sqrt([(z[:, :3] ** 2).mean(), (z[:, 3:] ** 2).mean()]))
        both.append(rows)
    return np.sqrt((np.array(both) ** 2).mean(axis=0))


def test_independent_errors():
    formal, larger = draws("none")
    assert (formal > 0.7).all() and (formal < 1.4).all()
    assert (larger > 0.85 * formal).all()


@pytest.mark.parametrize(("kind", "count", "least"), [("shared", DRAWS, 1.7), ("lens", 4, 2.0)])
def test_shared_errors(kind, count, least):
    """Errors of patches of 10 m in one image, and of a bent lens, most of which poses absorb.

    Over 12 draws patches give 2.4 and 2.8, then 1 and 1.1. So few draws leave a third to chance.
    """
    formal, larger = draws(kind, count)
    assert (formal > least).all()
    assert (larger > 0.7).all() and (larger < 1.4).all()
