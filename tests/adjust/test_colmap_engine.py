"""The engine around pycolmap, and the direct one beside pycolmap where there is no water.

The blocks without water and their reconstructions are made here, from numpy alone.
"""

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust import colmap_lens
from pcfix.adjust.block import Block, Unknowns
from pcfix.adjust.colmap_engine import solve_with_colmap
from pcfix.adjust.normal import residuals
from pcfix.adjust.solve import prepare, solve
from pcfix.errors import SettingError
from pcfix.model import Cameras, Lens, WaterPlane
from pcfix.simulate.tie_points import simulate_tie_points
from tests.utils.tie_blocks import block_of

pycolmap = pytest.importorskip("pycolmap")

SAME_PX = 1e-6
"""Of every residual: what the issue asks for; both are run until their costs stand still."""

MODELS = {
    "PINHOLE": ({}, ("f", "b1"), ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": ({"k1": -0.08}, ("f", "k1"), ("f", "cx", "cy", "k1")),
    "OPENCV": (
        {"k1": -0.09, "k2": 0.04, "p1": 8e-4, "p2": -5e-4},
        ("f", "b1", "k1", "k2", "p1", "p2"),
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    ),
}
"""Distortion in OpenCV's order of p1 and p2, what moves, and COLMAP's parameters."""


def imaged(xyz, centre, rotation, focal, cx, cy, bent):
    """Return where an OpenCV camera images points: the formula of OpenCV's manual."""
    x, y, z = ((xyz - centre) @ rotation.T).T
    x, y = x / z, y / z
    r2 = x * x + y * y
    p1, p2 = bent.get("p1", 0.0), bent.get("p2", 0.0)
    radial = 1.0 + bent.get("k1", 0.0) * r2 + bent.get("k2", 0.0) * r2**2
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    return np.column_stack([focal * u + cx, focal * v + cy])


class Scene:
    """12 images in a ring and strips over hills, 150 points, noise of 0.5 px."""

    focal, width, height, cx, cy = 1200.0, 1600, 1200, 806.0, 594.0

    def __init__(self, bent, seed=3):
        rng = np.random.default_rng(seed)
        self.bent = bent
        self.xyz = rng.uniform([-30, -30, -8], [30, 30, 8], (150, 3))
        around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        away = np.where(np.arange(12) % 2, 35.0, 12.0)
        self.centres = np.column_stack(
            [away * np.cos(around), away * np.sin(around), 50 + away / 4]
        )
        self.centres += rng.normal(0, 1.0, (12, 3))
        ahead = rng.uniform([-5, -5, -3], [5, 5, 3], (12, 3)) - self.centres
        ahead /= np.linalg.norm(ahead, axis=1)[:, None]
        right = np.cross(ahead, rng.normal(size=(12, 3)))
        right /= np.linalg.norm(right, axis=1)[:, None]
        self.rotations = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        places = np.stack(
            [
                imaged(self.xyz, c, r, self.focal, self.cx, self.cy, bent)
                for c, r in zip(self.centres, self.rotations, strict=True)
            ]
        )
        inside = ((places > 0) & (places < [self.width, self.height])).all(axis=2).T
        assert (inside.sum(axis=1) >= 3).all()
        self.point, self.camera = np.nonzero(inside)
        self.uv = places[self.camera, self.point] + rng.normal(0, 0.5, (inside.sum(), 2))
        self.start_centres = self.centres + rng.normal(0, 0.2, (12, 3))
        turn = Rotation.from_rotvec(rng.normal(0, 0.003, (12, 3))).as_matrix()
        self.start_rotations = turn @ self.rotations
        self.start_xyz = self.xyz + rng.normal(0, 0.3, self.xyz.shape)
        self.start_focal = self.focal + 4.0

    def block(self, water=None, n=1.34, gnss_sigma_m=np.inf, sigma_px=0.5):
        m, k = len(self.xyz), len(self.centres)
        radial = tuple(self.bent[key] for key in ("k1", "k2") if key in self.bent)
        brown = tuple(self.bent[key] for key in ("p2", "p1") if key in self.bent)
        lens = Lens(
            self.start_focal, self.width, self.height, self.cx, self.cy,
            radial=radial, tangential=brown,
        )  # fmt: skip
        labels = tuple(f"image {i}" for i in range(k))
        return Block(
            Cameras(labels, self.start_centres, self.start_rotations, (lens,) * k),
            self.start_xyz, np.searchsorted(self.point, np.arange(m + 1)), self.camera, self.uv,
            np.full(len(self.uv), sigma_px), water, n, np.ones(m, bool),
            np.full((m, 3), np.nan), np.full((m, 3), np.inf),
            self.centres if np.isfinite(gnss_sigma_m) else np.full((k, 3), np.nan),
            np.full((k, 3), gnss_sigma_m),
        )  # fmt: skip

    def reconstruction(self, model, names):
        """Return the same start as pycolmap has it."""
        values = {"f": self.start_focal, "fx": self.start_focal, "fy": self.start_focal}
        values |= {"cx": self.cx, "cy": self.cy} | self.bent
        made = pycolmap.Reconstruction()
        made.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=1, model=model, width=self.width, height=self.height,
                params=[values[name] for name in names],
            )
        )  # fmt: skip
        places = np.empty(len(self.uv), int)
        for i, (c, r) in enumerate(zip(self.start_centres, self.start_rotations, strict=True)):
            rows = np.flatnonzero(self.camera == i)
            places[rows] = np.arange(len(rows))
            turn = pycolmap.Rotation3d(Rotation.from_matrix(r).as_quat())
            image = pycolmap.Image(
                name=f"{i}", keypoints=self.uv[rows], camera_id=1, image_id=i + 1
            )
            made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, -r @ c))
        for p, xyz in enumerate(self.start_xyz):
            rows = np.flatnonzero(self.point == p)
            track = [pycolmap.TrackElement(int(self.camera[o]) + 1, int(places[o])) for o in rows]
            made.add_point3D_with_id(p + 1, pycolmap.Point3D(xyz=xyz, track=pycolmap.Track(track)))
        return made

    def residuals_of(self, made):
        """Return measured minus projected by pycolmap, in the order of the block."""
        there = [
            made.image(int(c) + 1).project_point(made.point3D(int(p) + 1).xyz)
            for p, c in zip(self.point, self.camera, strict=True)
        ]
        return self.uv - np.array(there)


def tight(options):
    solver = options.ceres.solver_options
    solver.function_tolerance, solver.gradient_tolerance = 1e-18, 1e-14
    solver.parameter_tolerance, solver.max_num_iterations = 1e-14, 500
    options.print_summary = False
    return options


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("water", [None, WaterPlane(0.0)], ids=["dry", "n=1"])
def test_direct_engine_is_an_ordinary_adjustment_without_refraction(model, water):
    bent, free, names = MODELS[model]
    scene = Scene(bent)
    made = scene.reconstruction(model, names)
    pycolmap.bundle_adjustment(made, tight(pycolmap.BundleAdjustmentOptions()))
    expected = scene.residuals_of(made)
    block = scene.block(water, n=1.0 if water else 1.34)
    problem, start = prepare(block, Unknowns(lens=free, free_network=True))
    found = solve(problem, start)
    r = residuals(found.state, problem.seen, problem.surface)
    assert 0.3 < expected.std() < 0.6  # px; the noise, less what the unknowns took
    assert np.abs(r - expected).max() < SAME_PX


def test_one_round_without_water_is_that_adjustment():
    scene = Scene(MODELS["OPENCV"][0])
    problem, start = prepare(scene.block(), Unknowns(lens=MODELS["OPENCV"][1], free_network=True))
    direct, around = solve(problem, start), solve_with_colmap(problem, start, tolerance=1e-18)
    here, there = (
        residuals(each.state, problem.seen, problem.surface) for each in (direct, around)
    )
    assert np.abs(here - there).max() < SAME_PX
    # the datum of the free network too: 1 um, a ten thousandth of what the images determine
    assert np.abs(direct.state.centres - around.state.centres).max() < 1e-6
    assert around.shared == pytest.approx(direct.shared, abs=1e-5)  # px, the largest unit in it
    assert [row.step for row in around.log] == [1]


def test_priors_weigh_as_in_the_direct_engine():
    # sigma_px other than 1, so that the scaling of the covariances matters
    scene = Scene(MODELS["SIMPLE_RADIAL"][0])
    block = scene.block(gnss_sigma_m=0.02, sigma_px=0.25)
    problem, start = prepare(block, Unknowns(lens=("f", "k1")))
    direct, around = solve(problem, start), solve_with_colmap(problem, start, tolerance=1e-18)
    assert around.cost == pytest.approx(direct.cost, rel=1e-9)
    # 1 um beside 20 mm of the prior
    assert np.abs(direct.state.centres - around.state.centres).max() < 1e-6


@pytest.fixture(scope="module")
def river():
    """A block over water with GNSS and control, 0.5 px of noise and poses that are off."""
    return simulate_tie_points(
        150, seed=4, area_m=(50, 40), greatest_depth_m=5, position_noise_m=0.1,
        attitude_noise_deg=0.1, image_noise_px=0.5,
    )  # fmt: skip


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize("lens", [(), ("f",)])
def test_rounds_come_near_the_direct_engine_through_water(river, control, lens):
    block = block_of(river, control=control)
    problem, start = prepare(block, Unknowns(lens=lens))
    direct = solve(problem, start)
    around = solve_with_colmap(problem, start)
    before = np.abs(start.state.centres - direct.state.centres).max()
    apart = np.abs(around.state.centres - direct.state.centres).max()
    # straight gradients weigh the residuals of wet points a little otherwise, and control points
    # have no error: a third of the GNSS's 30 mm, a sigma and a half of the control's 10 mm
    assert apart < (0.015 if control else 0.010) < 0.1 * before
    assert direct.cost * (1.0 - 1e-9) <= around.cost <= direct.cost * 1.002
    assert around.log[-1].cost == pytest.approx(around.cost)


def test_robust_loss_leaves_outliers_aside(river):
    block = block_of(river)
    wrong = np.random.default_rng(8).choice(len(block.camera), 20, replace=False)
    places = block.image_xy.copy()
    places[wrong] += [15.0, -20.0]
    good = solve_with_colmap(*prepare(block, Unknowns(lens=())), "cauchy")
    problem, start = prepare(replace(block, image_xy=places), Unknowns(lens=()))
    found = solve_with_colmap(problem, start, "cauchy")
    plain = solve_with_colmap(problem, start)
    shift, without = (np.abs(s.state.centres - good.state.centres).max() for s in (found, plain))
    # 1 % of outliers pull with 2 sigma at most: less than GNSS tells, and far less than squares
    assert shift < 0.01  # m
    assert shift < 0.2 * without


def test_observations_without_weight_do_not_count(river):
    block = block_of(river)
    out = np.arange(len(block.camera)) % 7 == 0
    places = np.where(out[:, None], block.image_xy + 300.0, block.image_xy)
    sigma = np.where(out, np.inf, block.sigma_px)
    found = [
        solve_with_colmap(*prepare(replace(block, sigma_px=sigma, image_xy=xy), Unknowns(lens=())))
        for xy in (block.image_xy, places)
    ]
    assert np.array_equal(found[0].state.centres, found[1].state.centres)


def test_fixed_images_stay(river):
    labels = river.cameras.labels[:2]
    block = block_of(river)
    problem, start = prepare(block, Unknowns(lens=(), fixed_images=labels))
    found = solve_with_colmap(problem, start)
    # COLMAP turns the model by what rounding leaves of the GNSS positions
    assert np.abs(found.state.centres[:2] - start.state.centres[:2]).max() < 1e-6
    assert np.abs(found.state.centres[2:] - start.state.centres[2:]).max() > 0.05


@pytest.mark.parametrize(
    ("unknowns", "words"),
    [
        ({"level_sigma_m": 0.1}, "water level"),
        ({"tilt_sigma": 0.01}, "tilt"),
        ({"index_sigma": 0.01}, "refractive index"),
        ({"poses": "similarity"}, "similarity"),
        ({"lens_sigma": {"f": 1.0}}, "standard deviations of lens"),
        ({"lens": ("f", "cx")}, "cx with cy"),
        ({"lens": ("b2",)}, "b2"),
        ({"free_network": True}, "free network"),
    ],
)
def test_what_it_cannot_do_is_said(river, unknowns, words):
    problem, start = prepare(block_of(river), Unknowns(**({"lens": ()} | unknowns)))
    with pytest.raises(SettingError, match=words) as error:
        solve_with_colmap(problem, start)
    assert "direct engine" in str(error.value)


def test_a_block_that_lies_anywhere_is_refused(river):
    problem, start = prepare(block_of(river, gnss=False), Unknowns(lens=()))
    with pytest.raises(SettingError, match="three control points"):
        solve_with_colmap(problem, start)


def test_control_with_a_large_error_and_unequal_weights_are_refused(river):
    block = block_of(river, control=True)
    loose = replace(block, surveyed_sigma_m=block.surveyed_sigma_m * 100.0)
    with pytest.raises(SettingError, match="control points fast"):
        solve_with_colmap(*prepare(loose, Unknowns(lens=())))
    sigma = np.linspace(0.5, 1.0, len(block.camera))
    with pytest.raises(SettingError, match="same weight"):
        solve_with_colmap(*prepare(replace(block, sigma_px=sigma), Unknowns(lens=())))


@pytest.mark.parametrize(
    ("lens", "free", "model"),
    [
        (Lens(900.0, 1600, 1200, 800, 600), ("f",), "SIMPLE_PINHOLE"),
        (Lens(900.0, 1600, 1200, 800, 600), ("f", "b1"), "PINHOLE"),
        (Lens(900.0, 1600, 1200, 800, 600, b1=0.5), ("f",), "PINHOLE"),
        (Lens(900.0, 1600, 1200, 800, 600), ("f", "k1", "k2"), "RADIAL"),
        (Lens(900.0, 1600, 1200, 800, 600, tangential=(1e-4, 0.0)), (), "OPENCV"),
    ],
)
def test_camera_model_is_the_simplest_whose_flags_do(lens, free, model):
    camera, flags = colmap_lens.camera_for(lens, frozenset(free))
    assert camera.model.name == model
    assert flags == ("f" in free, False, "k1" in free)
    assert colmap_lens.lens_of(camera, lens).focal == lens.focal


def test_missing_pycolmap_names_the_extra(monkeypatch, river):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(SettingError, match=r"pip install 'pcfix\[adjust\]'"):
        solve_with_colmap(*prepare(block_of(river), Unknowns(lens=())))
