"""Adjustment by tie points: noise, outliers, datum, check points and lens parameters."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import pcfix
from pcfix.adjust.block import NO_CONTROL, block_of
from pcfix.adjust.from_ties import adjust_ties
from pcfix.adjust.parameters import Unknowns, default_lens
from pcfix.flow.adjust import adjust_cameras
from tests.utils.block_kinds import write_kind
from tests.utils.nightly import mostly_nightly
from tests.utils.tie_blocks import block_of as simple_block
from tests.utils.tie_points import simulate_tie_points

FOCAL = Unknowns(lens=("f",))


@cache
def scene(image_px=0.5, **settings):
    return simulate_tie_points(
        300, area_m=(50, 40), greatest_depth_m=5, position_noise_m=0.3, attitude_noise_deg=0.2,
        image_noise=image_px, **settings,
    )  # fmt: skip


def block(data, ties=None, gnss=True, control=NO_CONTROL):
    ties = data.ties if ties is None else ties
    found = block_of(data.cameras, ties, data.water, data.refractive_index, control=control)
    return replace(found, gnss=data.cameras.gnss) if gnss else found


def codes(found):
    return [note.code for note in found.notes]


def with_gross_errors(data):
    """Return tie points of which 5 % are 5 to 50 px off, and which."""
    rng = np.random.default_rng(4)
    bad = rng.random(len(data.views.camera)) < 0.05
    angle, length = rng.uniform(0.0, 2.0 * np.pi, len(bad)), rng.uniform(5.0, 50.0, len(bad))
    error = np.where(bad, length, 0.0)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return replace(data.ties, image_xy=data.ties.image_xy + error), bad


@pytest.mark.parametrize("image_px", [0.15, 1.5])
@pytest.mark.parametrize("gross", [False, True])
def test_noise(image_px, gross):
    """In 8000 coordinates, the median's own error is 1 %, and unit weight's the same."""
    data = scene(image_px)
    ties = with_gross_errors(data)[0] if gross else data.ties
    found = adjust_ties(block(data, ties), FOCAL)
    # sigma0 says that the weights were right, the residuals what they were
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)
    r = found.residual_px[found.used]
    share = found.redundancy / (2 * len(r) + 3 * len(data.cameras))
    # of errors of 5 px and noise of 1.5 some pass for good ones: 4 % more
    assert np.sqrt(np.mean(r * r) / share) == pytest.approx(image_px, rel=0.1)


def test_outliers():
    data = scene()
    ties, bad = with_gross_errors(data)
    found = adjust_ties(block(data, ties), FOCAL)
    # the smallest are ten standard deviations
    assert not found.used[bad].any()
    # longer than four standard deviations are 3 in 10,000 vectors
    assert (~found.used[~bad]).sum() <= 5
    clean = adjust_ties(block(data), FOCAL)
    distance = found.cameras.centres - clean.cameras.centres
    # with 5 % less to go by, they differ by a quarter of the standard error
    assert np.sqrt(np.mean((distance / clean.precision.centre_sigma_m) ** 2)) < 0.5


def test_check_points():
    data = scene()
    control = data.control
    first = int(np.argmax(control.is_check))
    off = control.is_check[:, None] * [10.0, -5.0, 3.0]
    marks = control.is_check[control.point][:, None] * np.array([80.0, 40.0])
    wild = replace(control, xyz=control.xyz + off, image_xy=control.image_xy + marks)
    one, two = (adjust_ties(block(data, control=c), FOCAL) for c in (control, wild))
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


def test_marks_are_no_outliers():
    data = scene()
    control = data.control
    mine = np.flatnonzero(control.point == 0)
    marks = control.image_xy.copy()
    marks[mine[0]] += 100.0
    wrong = replace(control, image_xy=marks)
    found = adjust_ties(block(data, control=wrong), FOCAL)
    m = len(data.truth)
    assert found.used[found.block.owner == m].all()
    worst = max(found.control, key=lambda row: row.rms_px)
    assert worst.name == control.names[0]
    assert worst.rms_px > 10.0


def test_weak_lens():
    data = scene()
    lens = ("f", "cx", "cy", "k1", "k2", "p2")
    found = adjust_ties(block(data), replace(FOCAL, lens=lens))
    note = next(note for note in found.notes if note.code == "adjust.weak_lens")
    weak = set(lens) - set(found.unknowns.lens)
    assert {"cx", "cy"} <= weak  # nadir images over an even bed: a shift of all centres does it
    assert set(note.values["fixed"]) == weak
    before, after = data.cameras.lenses[0], found.cameras.lenses[0]
    assert (after.principal_x, after.principal_y) == (before.principal_x, before.principal_y)
    assert after.focal != before.focal
    named = adjust_ties(block(data), replace(FOCAL, lens=lens), choose_lens=False)
    assert named.unknowns.lens == lens
    assert not named.notes


# px: what distortion may hide in the noise, and what a block of so few points sees of it
NOISE_PX = 0.3


@cache
def oblique_scene():
    return simulate_tie_points(
        150, area_m=(35, 30), greatest_depth_m=5, position_noise_m=0.3, attitude_noise_deg=0.2,
        obliques_deg=30, oblique_directions=4, image_noise=NOISE_PX, seed=3,
    )  # fmt: skip


def with_lens(b1=0.0, k1=0.0, p1=0.0, start_b1=0.0):
    """Return a block whose images were made by a lens with these terms, and their start values.

    A term is added to the places of a lens without any: to the first order they are the same.
    """
    block = simple_block(oblique_scene(), sigma_px=NOISE_PX)
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


TERMS = ({"b1": 0.6}, {"k1": 2e-3}, {"p1": 2e-4})


@pytest.mark.parametrize("term", mostly_nightly(TERMS, TERMS[0]), ids=str)
def test_missing_term(term):
    """Each moves the edge of the frame by half a pixel or so."""
    ((name, value),) = term.items()
    found = adjusted(with_lens(**term))
    assert found.unknowns.lens == ("f", "cx", "cy", name)
    assert found.notes[0].values == {"found": [name]}
    row = found.precision.shared[name]
    assert abs(row.after - row.before - value) < 4.0 * row.sigma
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)


def test_absorbed_term():
    """Square pixels came with an aspect of 0.2 px, too little to be missed among the residuals."""
    found = adjusted(with_lens(start_b1=0.2))
    assert found.unknowns.lens == ("f", "cx", "cy", "b1")
    sigma = found.precision.shared["b1"].sigma
    assert abs(found.cameras.lenses[0].b1) < 4.0 * sigma


@pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")
def test_strip(tmp_path):
    """The principal point is hardly determined; fixing it would bend the bed by 20 GSD."""
    write_kind(tmp_path, "single strip", 4, points=700, cloud=10)
    found = adjust_cameras(tmp_path / "model", water=0.0, gnss=tmp_path / "gnss.csv")
    true = pcfix.read_cameras(tmp_path / "true")
    before, after, truth = (c.lenses[0] for c in (found.block.cameras, found.cameras, true))
    assert abs(before.principal_y - truth.principal_y) > 20.0
    # standard errors: four of a normal distribution, which chance exceeds once in 16,000
    for name in ("principal_x", "principal_y", "focal"):
        sigma = found.precision.shared[{"focal": "f"}.get(name, f"c{name[-1]}")].sigma
        assert abs(getattr(after, name) - getattr(truth, name)) < 4.0 * sigma
    off = (found.cameras.centres - true.centres) / found.precision.centre_sigma_m
    # rms of 42 normalised errors: 1 with a standard deviation of a tenth, more as neighbours agree
    assert np.sqrt((off**2).mean()) < 1.3
    notes = {note.code: note.values for note in found.notes}
    assert "adjust.weak_lens" not in notes
    # the positions lie on a line, so the tilt across it is unknown
    assert notes["adjust.imprecise_bed"]["gsd"] > 1.5
