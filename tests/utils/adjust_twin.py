"""The slow twin of the bundle adjustment: the simulator's tracing in scipy's least squares.

Nothing of `pcfix.adjust` or `pcfix.refract` is in it. Unknowns stand in one vector: of each free
camera a rotation vector, applied on the left (camera frame), and its centre; then focal length,
level, tilt, index and shape as asked, height and slopes of planes; then all points. Lenses have no
distortion.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.optimize._numdiff import approx_derivative
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import Block
from pcfix.model import FloatArray
from pcfix.simulate.tracing import piercing_points_of_planes, project
from tests.utils.curved_water import height, piercing_points


class Twin(NamedTuple):
    """A block, the names of the free shared unknowns, whether poses move, what n is known to."""

    block: Block
    shared: tuple[str, ...] = ()
    free_poses: bool = True
    index_sigma: float = np.inf

    @property
    def poses(self) -> int:
        return 6 * len(self.block.cameras) if self.free_poses else 0

    def start(self) -> FloatArray:
        """Return the vector of the block's own values: all steps zero, the points as they are."""
        return np.concatenate(
            [np.zeros(self.poses + len(self.shared)), (self.block.xyz - self.origin).ravel()]
        )

    @property
    def origin(self) -> FloatArray:
        return np.round(self.block.cameras.centres.mean(axis=0))

    def parts(self, x: FloatArray) -> tuple[FloatArray, FloatArray, dict[str, float], FloatArray]:
        """Return centres, rotations, what was added to the shared unknowns, and the points."""
        cameras = self.block.cameras
        centres, rotations = cameras.centres - self.origin, cameras.rotations
        if self.free_poses:
            step = x[: self.poses].reshape(-1, 6)
            rotations = Rotation.from_rotvec(step[:, :3]).as_matrix() @ rotations
            centres = centres + step[:, 3:]
        g = self.poses + len(self.shared)
        added = dict(zip(self.shared, x[self.poses : g], strict=True))
        return centres, rotations, added, x[g:].reshape(-1, 3)

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return all weighted residuals: images, surveyed points, GNSS positions."""
        block = self.block
        centres, rotations, added, xyz = self.parts(x)
        cameras = replace(block.cameras, centres=centres, rotations=rotations)
        point = np.repeat(np.arange(len(xyz)), np.diff(block.start))
        a = block.water.a + block.water.b * self.origin[0] + block.water.c * self.origin[1]
        a += added.get("level", 0.0) - self.origin[2]
        b, c = block.water.b + added.get("tilt_x", 0.0), block.water.c + added.get("tilt_y", 0.0)
        n = block.refractive_index + added.get("index", 0.0)
        shape = [added.get(name, 0.0) for name in ("shape_xx", "shape_xy", "shape_yy")]
        if any(name.startswith("shape") for name in added):
            surface = piercing_points(
                xyz[point], centres[block.camera], np.array([a, b, c, *shape]), n
            )
        else:
            normal = np.array([-b, -c, 1.0]) / np.sqrt(1.0 + b * b + c * c)
            surface = piercing_points_of_planes(
                xyz[point], centres[block.camera], np.tile([0.0, 0.0, a], (len(point), 1)),
                np.tile(normal, (len(point), 1)), n,
            )  # fmt: skip
        lens = block.cameras.lenses[0]
        lens = replace(lens, focal=lens.focal + added.get("f", 0.0))
        seen, _ = project(surface, cameras, block.camera, lens)
        parts = [((block.image_xy - seen) / block.sigma_px[:, None]).ravel()]
        surveyed, weight = block.survey
        for found, given, sigma in (
            (xyz, surveyed, 1.0 / np.sqrt(np.where(weight > 0.0, weight, np.nan))),
            (centres, block.gnss.xyz, block.gnss.sigma_m),
        ):
            known = np.isfinite(sigma) & np.isfinite(given)
            parts.append((found[known] - (given - self.origin)[known]) / sigma[known])
        planes, on_surface, sigma_m = block.surfaces
        for number, name in enumerate(("water", *planes) if len(on_surface) else ()):
            on = on_surface == number
            plane = [added.get(f"{word} of {name}", 0.0) for word in ("level", "tilt_x", "tilt_y")]
            if name in block.parallel:  # slopes are those of the water
                plane[1:] = b, c
            numbers = (a, b, c, *shape) if number == 0 else (*plane, 0.0, 0.0, 0.0)
            off = height(numbers, *xyz[on, :2].T) - xyz[on, 2]
            parts.append(off / sigma_m[on])
        if np.isfinite(self.index_sigma):
            parts.append(np.array([added["index"] / self.index_sigma]))
        return np.concatenate(parts)

    def solve(self) -> FloatArray:
        """Return the vector of least squares."""
        return least_squares(
            self.residuals, self.start(), jac="3-point", x_scale="jac",
            ftol=1e-13, xtol=1e-13, gtol=1e-13, max_nfev=60,
        ).x  # fmt: skip

    def covariance(self, x: FloatArray) -> FloatArray:
        """Return the full inverse of the normal matrix, its Jacobian by differences."""
        jacobian = approx_derivative(self.residuals, x, method="3-point")
        scale = np.linalg.norm(jacobian, axis=0)
        j = jacobian / scale
        return np.linalg.inv(j.T @ j) / np.outer(scale, scale)
