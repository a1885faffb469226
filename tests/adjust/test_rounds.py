"""Noise, outliers, datum, check points and weak lens parameters of an adjustment by tie points."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pcfix.adjust.block import Unknowns
from pcfix.adjust.gather import Datum, Material, block_of, no_datum
from pcfix.adjust.lens_choice import default_lens
from pcfix.adjust.problem import prepare
from pcfix.adjust.rounds import adjust_ties, check_datum, noise_px
from pcfix.adjust.solve import solve
from pcfix.errors import GeometryError
from pcfix.kernels import threads
from tests.utils.tie_blocks import block_of as simple_block
from tests.utils.tie_points import simulate_tie_points

FOCAL = Unknowns(lens=("f",))


@pytest.fixture(autouse=True)
def _one_thread():
    """So small a block spends more on waking a second thread than it does."""
    with threads(1):
        yield


@cache
def scene(image_px=0.5, **settings):
    return simulate_tie_points(
        300, area_m=(50, 40), greatest_depth_m=5, position_noise_m=0.3, attitude_noise_deg=0.2,
        image_noise=image_px, **settings,
    )  # fmt: skip


def block(made, ties=None, gnss=True, control=None):
    datum = no_datum(len(made.cameras))
    if gnss:
        datum = Datum(made.cameras.gnss.xyz, made.cameras.gnss.sigma_m)
    ties = made.ties if ties is None else ties
    material = Material(
        "model", made.cameras, made.water, made.refractive_index, datum, control
    )  # fmt: skip
    return block_of(material, ties, 1.0)


def with_gross_errors(made, share=0.05):
    """Return tie points of which some are 5 to 50 px off, and which."""
    rng = np.random.default_rng(4)
    bad = rng.random(len(made.views.camera)) < share
    way, length = rng.uniform(0.0, 2.0 * np.pi, len(bad)), rng.uniform(5.0, 50.0, len(bad))
    error = np.where(bad, length, 0.0)[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    return replace(made.ties, image_xy=made.ties.image_xy + error), bad


@pytest.mark.parametrize("image_px", [0.15, 1.5])
@pytest.mark.parametrize("gross", [False, True])
def test_the_noise_is_found(image_px, gross):
    """In 8000 coordinates, the median's own error is 1 %, and unit weight's the same."""
    made = scene(image_px)
    ties = with_gross_errors(made)[0] if gross else made.ties
    found = adjust_ties(block(made, ties), FOCAL)
    # sigma0 says that the weights were right, the residuals what they were
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)
    r = found.residual_px[found.used]
    share = found.redundancy / (2 * len(r) + 3 * len(made.cameras))
    # of errors of 5 px and noise of 1.5 some pass for good ones: 4 % more
    assert np.sqrt(np.mean(r * r) / share) == pytest.approx(image_px, rel=0.1)


def test_the_median_hardly_sees_outliers():
    made = scene()
    problem, start = prepare(block(made), FOCAL)
    assert noise_px(problem, solve(problem, start)) == pytest.approx(0.5, rel=0.05)
    problem, start = prepare(block(made, with_gross_errors(made)[0]), FOCAL)
    # what is left of their pull on points of a few rays comes on top
    assert noise_px(problem, solve(problem, start, "huber")) == pytest.approx(0.5, rel=0.3)


def test_gross_errors_are_left_out_and_good_ones_are_not():
    made = scene()
    ties, bad = with_gross_errors(made)
    found = adjust_ties(block(made, ties), FOCAL)
    # the smallest are ten standard deviations
    assert not found.used[bad].any()
    # longer than four standard deviations are 3 in 10,000 vectors
    assert (~found.used[~bad]).sum() <= 5
    clean = adjust_ties(block(made), FOCAL)
    apart = found.cameras.centres - clean.cameras.centres
    # with 5 % less to go by, they differ by a quarter of the standard error
    assert np.sqrt(np.mean((apart / clean.precision.centre_sigma_m) ** 2)) < 0.5
    kept = adjust_ties(block(made, ties), FOCAL, outliers=False)
    assert kept.used.all()


def test_a_given_noise_is_not_estimated():
    made = scene()
    weighed = replace(block(made), sigma_px=np.full(len(made.views.camera), 0.25))
    found = adjust_ties(weighed, FOCAL, sigma_px=0.25, outliers=False)
    assert found.sigma0 == pytest.approx(2.0, rel=0.1)


def test_check_points_tell_and_do_not_count():
    made = scene()
    control = made.control
    first = int(np.argmax(control.is_check))
    off = control.is_check[:, None] * [10.0, -5.0, 3.0]
    marks = control.is_check[control.point][:, None] * np.array([80.0, 40.0])
    wild = replace(control, xyz=control.xyz + off, image_xy=control.image_xy + marks)
    one, two = (adjust_ties(block(made, control=c), FOCAL) for c in (control, wild))
    np.testing.assert_array_equal(one.cameras.centres, two.cameras.centres)
    np.testing.assert_array_equal(one.cameras.rotations, two.cameras.rotations)
    assert one.cameras.lenses == two.cameras.lenses
    assert one.sigma0 == two.sigma0
    rows = {row.name: row for row in one.control}
    assert set(rows) == set(control.names)
    for i, name in enumerate(control.names):
        row = rows[name]
        assert row.role == ("check" if control.is_check[i] else "control")
        # m: a mark of 0.5 px is 11 mm on the ground, a height from it 25 mm, survey 10 mm
        assert max(abs(row.dx_m), abs(row.dy_m)) < 0.06
        assert abs(row.dz_m) < 0.12
    shifted = {row.name: row for row in two.control}[control.names[first]]
    assert shifted.dx_m < rows[control.names[first]].dx_m - 5.0


def test_marks_of_control_points_are_never_outliers():
    made = scene()
    control = made.control
    mine = np.flatnonzero(control.point == 0)
    marks = control.image_xy.copy()
    marks[mine[0]] += 100.0
    wrong = replace(control, image_xy=marks)
    found = adjust_ties(block(made, control=wrong), FOCAL)
    m = len(made.truth)
    assert found.used[found.block.owner == m].all()
    worst = max(found.control, key=lambda row: row.rms_px)
    assert worst.name == control.names[0]
    assert worst.rms_px > 10.0


@pytest.mark.parametrize(
    ("gnss", "unknowns"),
    [(0, FOCAL), (2, FOCAL), (0, replace(FOCAL, fixed_images=("IMG_0001.JPG",)))],
)
def test_without_a_datum_it_says_what_is_undetermined(gnss, unknowns):
    made = scene()
    whole = block(made)
    few = whole.gnss_xyz.copy()
    few[gnss:] = np.nan
    with pytest.raises(GeometryError, match="shift in plan, turn and scale stay undetermined"):
        adjust_ties(replace(whole, gnss_xyz=few), unknowns)


def test_three_points_two_images_or_the_wish_are_a_datum():
    made = scene()
    labels = made.cameras.labels
    nothing = block(made, gnss=False)
    check_datum(nothing, replace(FOCAL, free_network=True))
    check_datum(nothing, replace(FOCAL, fixed_images=labels[:2]))
    check_datum(nothing, replace(FOCAL, poses="fixed"))
    check_datum(block(made, gnss=False, control=made.control), FOCAL)
    with pytest.raises(GeometryError, match="0 control points"):
        checks = replace(made.control, is_check=np.ones(len(made.control.names), bool))
        check_datum(block(made, gnss=False, control=checks), FOCAL)


def test_lens_parameters_that_the_block_does_not_tell_are_left():
    made = scene()
    lens = ("f", "cx", "cy", "k1", "k2", "p2")
    found = adjust_ties(block(made), replace(FOCAL, lens=lens))
    note = next(note for note in found.notes if "does not determine" in note)
    weak = set(lens) - set(found.unknowns.lens)
    assert {"cx", "cy"} <= weak  # nadir images over an even bed: a shift of all centres does it
    assert all(name in note for name in weak)
    before, after = made.cameras.lenses[0], found.cameras.lenses[0]
    assert (after.principal_x, after.principal_y) == (before.principal_x, before.principal_y)
    assert after.focal != before.focal
    named = adjust_ties(block(made), replace(FOCAL, lens=lens), choose_lens=False)
    assert named.unknowns.lens == lens
    assert not named.notes


def test_lens_parameters_that_may_move_are_those_of_the_lens():
    plain = scene().cameras.lenses[0]
    assert default_lens((plain,)) == ("f", "cx", "cy")
    bent = replace(plain, radial=(-0.1, 0.0, 0.01), tangential=(0.0, 1e-4))
    assert default_lens((bent,)) == ("f", "cx", "cy", "k1", "k3", "p2")


def test_it_is_the_least_squares_of_what_it_kept():
    made = scene()
    whole = simple_block(made)
    found = adjust_ties(whole, FOCAL, sigma_px=0.5, outliers=False)
    problem, start = prepare(whole, FOCAL)
    once = solve(problem, start)
    # m: both stop where the cost no longer changes
    centres = found.cameras.centres - problem.origin
    np.testing.assert_allclose(centres, once.state.centres, atol=1e-6)


def test_sides_of_the_water_that_differ_count_by_their_own_noise():
    """Noise of 0.3 px and of 0.9 px under water, each found to a tenth; a given one is kept."""
    made = scene(0.3)
    wet = np.repeat(made.is_wet, np.diff(made.views.start))
    more = np.random.default_rng(5).normal(0.0, np.sqrt(0.9**2 - 0.3**2), (len(wet), 2))
    ties = replace(made.ties, image_xy=made.ties.image_xy + np.where(wet[:, None], more, 0.0))
    found = adjust_ties(block(made, ties), FOCAL)
    (note,) = [words for words in found.notes if "the noise of tie points differs" in words]
    land, under = re.match(
        r".*: ([\d.]+) px on land and ([\d.]+) px under water; each", note
    ).groups()
    assert float(land) == pytest.approx(0.3, rel=0.1)
    assert float(under) == pytest.approx(0.9, rel=0.1)
    equal = adjust_ties(block(made, ties), FOCAL, sigma_px=0.7)
    assert not any("differs" in words for words in equal.notes)
    assert not any("differs" in words for words in adjust_ties(block(made), FOCAL).notes)
