"""The adjustment beside pycolmap's, where nothing refracts: without water, and with n = 1.

The blocks without water and their reconstructions are made here, from numpy alone.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import Block, Unknowns
from pcfix.adjust.normal import residuals
from pcfix.adjust.problem import prepare
from pcfix.adjust.solve import solve
from pcfix.model import Cameras, Lens, WaterPlane

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
def test_it_is_an_ordinary_adjustment_without_refraction(model, water):
    bent, free, names = MODELS[model]
    scene = Scene(bent)
    made = scene.reconstruction(model, names)
    pycolmap.bundle_adjustment(made, tight(pycolmap.BundleAdjustmentOptions()))
    expected = scene.residuals_of(made)
    block = scene.block(water, n=1.0 if water else 1.34)
    problem, start = prepare(block, Unknowns(lens=free, free_network=True))
    found = solve(problem, start)
    r = residuals(found.state, problem.given)
    assert 0.3 < expected.std() < 0.6  # px; the noise, less what the unknowns took
    assert np.abs(r - expected).max() < SAME_PX
