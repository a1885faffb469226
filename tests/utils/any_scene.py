"""Scenes as hypothesis thinks them up: points, cameras and water about a local origin."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from pcfix import Cameras, Lens, WaterPlane
from tests.utils.clouds import random_cloud

STEP_M = 0.001  # all coordinates of points are multiples of it


@dataclass(frozen=True)
class Scene:
    """Points on a grid of `STEP_M`, cameras, and the water's plane z = a + b x + c y."""

    xyz: np.ndarray
    cameras: Cameras
    plane: tuple[float, float, float]

    @property
    def water(self) -> WaterPlane:
        return WaterPlane(*self.plane)

    def height_m(self, xyz: np.ndarray) -> np.ndarray:
        """Return how far points lie above the water along the vertical."""
        a, b, c = self.plane
        return xyz[:, 2] - (a + b * xyz[:, 0] + c * xyz[:, 1])

    def moved(self, turn: float, shift: tuple[float, float, float]) -> "Scene":
        """Return the scene turned about the vertical, and then shifted; points exactly."""
        cos, sin = math.cos(turn), math.sin(turn)
        turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        a, b, c = self.plane
        b, c = cos * b - sin * c, sin * b + cos * c
        plane = (a + shift[2] - b * shift[0] - c * shift[1], b, c)
        rotations = self.cameras.rotations
        cameras = replace(
            self.cameras,
            centres=self.cameras.centres @ turned.T + shift,
            rotations=None if rotations is None else rotations @ turned.T,
        )
        return Scene(self.xyz @ turned.T + shift, cameras, plane)

    def reordered(
        self, cameras: list[int] | None = None, points: list[int] | None = None
    ) -> "Scene":
        """Return the scene with its cameras, and its points, in another order."""
        old, order = self.cameras, range(len(self.cameras)) if cameras is None else cameras
        rows = np.array(order, np.int64)
        new = Cameras(
            tuple(old.labels[i] for i in order),
            old.centres[rows],
            None if old.rotations is None else old.rotations[rows],
            None if old.lenses is None else tuple(old.lenses[i] for i in order),
        )
        return replace(self, cameras=new, xyz=self.xyz if points is None else self.xyz[points])

    def write(self, path: Path, point_format: int, **choices: object) -> Path:
        """Write the points, everything else of them at random, and return the path."""
        given = {"scales": (STEP_M,) * 3, "offsets": (0.0, 0.0, 0.0)} | choices
        with np.errstate(invalid="ignore"):  # its points are beyond such offsets
            las = random_cloud(point_format, count=len(self.xyz), **given)
        for axis, name in enumerate("XYZ"):
            steps = (self.xyz[:, axis] - given["offsets"][axis]) / given["scales"][axis]
            las.points.array[name] = np.rint(steps)
        if path.suffix == ".laz" and point_format in (9, 10):
            las.scanner_channel[:] = 2  # see `write_cloud`
        las.write(path)
        return path


@st.composite
def scenes(draw, on_surface: bool = False) -> Scene:
    """Draw a scene in which a point or more lies under the water, and no camera does.

    Points may lie on the surface, to the bit where it is level, only if that is asked for.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, k = draw(st.integers(1, 60)), draw(st.integers(2, 8))
    side, deepest = (
        draw(st.sampled_from([1.0, 20.0, 60.0])),
        draw(st.sampled_from([0.05, 3.0, 25.0])),
    )
    land = draw(st.sampled_from([0.0, 0.3, 0.9]))
    slope = st.floats(-0.045, 0.045)
    tilted = st.tuples(slope, slope).filter(lambda tilt: math.hypot(*tilt) < 0.045)
    tilt = draw(st.just((0.0, 0.0)) | tilted)
    plane = (draw(st.sampled_from([0.0, 0.37])), *tilt)
    plan = rng.uniform(-side, side, (n, 2))
    height = np.where(
        rng.random(n) < land, rng.uniform(0.01, 9.0, n), -rng.uniform(0.0, deepest, n)
    )
    if on_surface:
        height[rng.random(n) < 0.2] = 0.0
    height[0] = -max(0.01, -height[0])
    plan[rng.random(n) < 0.1] = plan[0]  # one above the other, or twice the same
    surface = plane[0] + plan @ tilt
    xyz = np.rint(np.column_stack([plan, surface + height]) / STEP_M) * STEP_M
    spread, flying_m = draw(st.sampled_from([3.0, 30.0])), draw(st.sampled_from([20.0, 90.0]))
    centres = np.column_stack([rng.uniform(-spread, spread, (k, 2)), rng.normal(0.0, 2.0, k)])
    centres[:, 2] += plane[0] + flying_m
    if draw(st.booleans()):
        centres[0, :2] = xyz[0, :2]  # straight above a point
    if draw(st.booleans()) and k > 2:
        centres[-1] = centres[0]
    cameras = Cameras(tuple(f"c{i}" for i in range(k)), centres)
    if draw(st.booleans()):
        cameras = _with_frames(cameras, rng, draw(st.sampled_from([0.0, 5.0, 35.0])))
    return Scene(xyz, cameras, plane)


def _with_frames(cameras: Cameras, rng: np.random.Generator, off_deg: float) -> Cameras:
    """Give cameras a wide lens and angles, up to so many degrees off the vertical."""
    k = len(cameras)
    yaw, off = rng.uniform(0.0, 2.0 * np.pi, k), np.radians(rng.uniform(0.0, off_deg, k))
    zero, one = np.zeros(k), np.ones(k)
    about_z = np.array([[np.cos(yaw), np.sin(yaw), zero], [-np.sin(yaw), np.cos(yaw), zero],
                        [zero, zero, one]])  # fmt: skip
    tilted = np.array([[one, zero, zero], [zero, np.cos(off), np.sin(off)],
                       [zero, -np.sin(off), np.cos(off)]])  # fmt: skip
    down = np.diag([1.0, -1.0, -1.0])
    rotations = np.einsum("ij,jkn,kln->nil", down, tilted, about_z)
    lens = Lens(
        focal=1500.0, width=4000.0, height=3000.0, principal_x=2010.0, principal_y=1490.0,
        radial=(-0.02, 0.003), tangential=(1e-4, -2e-4),
    )  # fmt: skip
    return replace(cameras, rotations=rotations, lenses=(lens,) * k)


# Scales and offsets that hold every point of a scene exactly.
ENCODINGS = [((STEP_M,) * 3, (0.0, 0.0, 0.0)), ((STEP_M / 2,) * 3, (1.0, -7.0, 0.25)),
             ((STEP_M / 10,) * 3, (0.0, 0.0, 0.0)), ((STEP_M,) * 3, (-250.0, 40.0, -3.0)),
             ((STEP_M, STEP_M / 4, STEP_M / 5), (12.0, 0.0, 1.0))]  # fmt: skip
