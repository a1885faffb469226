"""What is undetermined, precision of large blocks, and members of the ensemble."""

from dataclasses import replace

import numpy as np
import pytest

from pcfix.adjust.methods import undetermined
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import members_of, precision_of
from pcfix.adjust.problem import solved_cameras, water_of
from pcfix.adjust.solve import moved_by
from pcfix.water.surface import surface_above
from tests.utils.codes import refused
from tests.utils.tie_blocks import adjusted, block_of, tiny_scene
from tests.utils.tie_points import simulate_tie_points

FREE = np.inf


def without_image(block):
    return replace(block, sigma_px=np.where(block.camera == 2, np.inf, block.sigma_px))


def dry(block):
    return replace(block, wet=np.zeros(len(block.xyz), bool))


@pytest.mark.parametrize(
    ("change", "given", "unknowns", "wanted"),
    [
        (None, {"gnss": False}, Unknowns(lens=()), {"unknowns": []}),
        (
            None, {"gnss": False}, Unknowns(lens=(), surface={"level": FREE, "tilt": FREE}),
            {"unknowns": ["level", "tilt_x", "tilt_y"]},
        ),
        (
            dry, {"control": True},
            Unknowns(lens=("f",), surface={"level": FREE, "index": FREE}),
            {"unknowns": ["level", "index"], "images": []},
        ),
        (
            dry, {"control": True}, Unknowns(lens=(), surface={"shape": FREE}),
            {"unknowns": ["shape_xx", "shape_xy", "shape_yy"]},
        ),
        (without_image, {}, Unknowns(lens=()), {"unknowns": [], "images": ["2"]}),
    ],
    ids=["no datum", "no datum, water free", "dry", "dry, shape free", "image without points"],
)  # fmt: skip
def test_undetermined(change, given, unknowns, wanted):
    block = block_of(tiny_scene(), **given)
    block = block if change is None else change(block)
    if wanted.get("images"):
        wanted = wanted | {"images": [block.cameras.labels[int(i)] for i in wanted["images"]]}
    with refused("adjust.singular", **wanted):
        precision_of(*adjusted(block, unknowns))


def test_sloping_bed():
    """Over an evenly sloping bed, straight down, level, tilt and index move the bed alike.

    The depth grows with x, and with it what an error of the index does: so does a tilt along x.
    """
    data = simulate_tie_points(
        150, bed="shore", greatest_depth_m=3, area_m=(40, 30), forward_overlap=0.7,
        side_overlap=0.6, seed=4,
    )  # fmt: skip
    block, sigma = block_of(data, control=True), {}
    for name, free in (
        ("level", ("level",)), ("index", ("index",)), ("all", ("level", "tilt", "index")),
    ):  # fmt: skip
        unknowns = Unknowns(lens=("f",), surface=dict.fromkeys(free, FREE))
        precision = precision_of(*adjusted(block, unknowns))
        sigma[name] = precision
    every = sigma["all"]
    found = {
        one.values["unknown"]: one.values.get("correlated_with") for one in undetermined(every)
    }
    assert found["level"] == "tilt_x"
    assert found["index"] in ("level", "tilt_x")
    for name in ("level", "index"):
        assert every.shared[name].sigma > 2.0 * sigma[name].shared[name].sigma
    assert not any("correlated_with" in one.values for one in undetermined(sigma["level"]))


def test_large_block(monkeypatch):
    data = tiny_scene()
    block = block_of(data, control=True)
    problem, found = adjusted(block, Unknowns(lens=("f",), surface={"level": FREE}))
    whole = precision_of(problem, found)
    monkeypatch.setattr("pcfix.adjust.precision.DENSE_UP_TO", 0)
    parts = precision_of(problem, found)
    assert parts.point_sigma_m is parts.members is None
    # two solutions of one system with a condition of about 1e8
    np.testing.assert_allclose(parts.pose_covariance, whole.pose_covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(parts.correlation, whole.correlation, atol=1e-6)


@pytest.mark.parametrize("shape", [{}, {"shape": 0.01}], ids=["plane", "curved"])
def test_member(shape):
    unknowns = Unknowns(lens=("f", "k1"), surface={"level": 0.1, "tilt": 0.01} | shape)
    problem, found = adjusted(block_of(tiny_scene(), control=True), unknowns)
    free = 6 * len(found.lenses) + len(problem.names)
    steps = np.random.default_rng(2).normal(0.0, 1e-3, (3, free))
    members = members_of(problem, found, steps)
    nominal = solved_cameras(problem, found)
    order = np.arange(len(nominal))[::-1]
    shuffled = replace(
        nominal, labels=nominal.labels[::-1], centres=nominal.centres[order],
        rotations=nominal.rotations[order], lenses=nominal.lenses[::-1],
    )  # fmt: skip
    members = members.aligned(shuffled)
    for i, one in enumerate(steps):
        moved = moved_by(problem, found, one, np.zeros_like(found.state.xyz))
        wanted, got = solved_cameras(problem, moved), members.cameras(i, shuffled)
        np.testing.assert_allclose(got.centres[order], wanted.centres, atol=1e-8)
        np.testing.assert_allclose(got.rotations[order], wanted.rotations, atol=1e-12)
        assert got.lenses[0].focal == pytest.approx(wanted.lenses[-1].focal, rel=1e-12)
        assert got.lenses[0].radial == pytest.approx(wanted.lenses[-1].radial, rel=1e-12)
        water, wanted = water_of(problem, found.state), water_of(problem, moved.state)
        heights = [
            surface_above(surface, nominal.centres).height_m
            for surface in (members.surface(i, water, nominal), wanted)
        ]
        # m: rasters of curved water are bilinear between cells
        np.testing.assert_allclose(*heights, atol=1e-4 if shape else 1e-7)


def test_members_scatter():
    problem, found = adjusted(block_of(tiny_scene()), Unknowns(lens=("f",)))
    precision = precision_of(problem, found, sigma0=2.0)
    members = precision.members
    squares = np.einsum("mki,kij->mkj", members.shift_m, found.state.rotations) ** 2
    wanted = precision.centre_sigma_m
    # 32 draws tell a standard deviation to an eighth
    np.testing.assert_allclose(np.sqrt(squares.mean(axis=0)), wanted, rtol=0.4)
    assert np.sqrt(squares.mean() / (wanted**2).mean()) == pytest.approx(1.0, abs=0.1)
    f = np.sqrt((members.lens[:, 0, 0] ** 2).mean())
    assert f == pytest.approx(precision.shared["f"].sigma, rel=0.3)
