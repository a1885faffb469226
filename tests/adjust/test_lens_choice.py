"""Which lens parameters move by default: what the images were really made with decides."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pcfix.adjust.block import Unknowns
from pcfix.adjust.lens_choice import default_lens
from pcfix.adjust.rounds import adjust_ties
from pcfix.kernels import threads
from tests.utils.tie_blocks import block_of
from tests.utils.tie_points import simulate_tie_points

# px: what distortion may hide in the noise, and what a block of so few points sees of it
NOISE_PX = 0.3


@pytest.fixture(autouse=True)
def _one_thread():
    """So small a block spends more on waking a second thread than it does."""
    with threads(1):
        yield


@cache
def scene():
    return simulate_tie_points(
        150, area_m=(35, 30), greatest_depth_m=5, position_noise_m=0.3, attitude_noise_deg=0.2,
        obliques_deg=30, oblique_directions=4, image_noise=NOISE_PX, seed=3,
    )  # fmt: skip


def with_lens(b1=0.0, k1=0.0, p1=0.0, start_b1=0.0):
    """Return a block whose images were made by a lens with these terms, and their start values.

    A term is added to the places of a lens without any: to the first order they are the same.
    """
    block = block_of(scene(), sigma_px=NOISE_PX)
    lens = block.cameras.lenses[0]
    middle = [lens.principal_x, lens.principal_y]
    x, y = ((block.image_xy - middle) / lens.focal).T
    r2 = x * x + y * y
    along_x = b1 * x + lens.focal * (k1 * x * r2 + p1 * (r2 + 2.0 * x * x))
    along_y = lens.focal * (k1 * y * r2 + p1 * 2.0 * x * y)
    start = (replace(lens, b1=start_b1),) * len(block.cameras)
    return replace(
        block,
        image_xy=block.image_xy + np.column_stack([along_x, along_y]),
        cameras=replace(block.cameras, lenses=start),
    )


def adjusted(block):
    return adjust_ties(block, Unknowns(lens=default_lens(block.cameras.lenses)))


def test_nothing_is_found_where_nothing_is():
    found = adjusted(with_lens())
    assert found.unknowns.lens == ("f", "cx", "cy")
    assert found.notes == ["lens parameters free: f, cx, cy."]


@pytest.mark.parametrize("term", [{"b1": 0.6}, {"k1": 2e-3}, {"p1": 2e-4}], ids=["b1", "k1", "p1"])
def test_a_term_that_the_file_lacks_is_found(term):
    """Each moves the edge of the frame by half a pixel or so."""
    ((name, value),) = term.items()
    found = adjusted(with_lens(**term))
    assert found.unknowns.lens == ("f", "cx", "cy", name)
    assert f"f, cx, cy, {name} (tests of the residuals: {name} too)" in found.notes[0]
    row = next(row for row in found.precision.shared if row.name == name)
    assert abs(row.added - value) < 4.0 * row.sigma
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)


def test_what_the_old_adjustment_left_in_the_lens_goes():
    """Square pixels came with an aspect of 0.2 px, too little to be missed among the residuals."""
    found = adjusted(with_lens(start_b1=0.2))
    assert found.unknowns.lens == ("f", "cx", "cy", "b1")
    sigma = found.precision.sigma_of("b1")
    assert abs(found.cameras.lenses[0].b1) < 4.0 * sigma


def test_what_is_named_or_calibrated_stays():
    named = adjust_ties(with_lens(k1=2e-3), Unknowns(lens=("f",)), choose_lens=False)
    assert named.unknowns.lens == ("f",)
    assert not named.notes
