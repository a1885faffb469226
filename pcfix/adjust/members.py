"""How else a block may be than as it was adjusted: members drawn from the joint covariance.

Standard errors forget that the errors of a block go together: a focal length that is too long is
made good by cameras that stand too high. What is computed with each of the members, one after the
other, scatters as it does by all of the adjustment's errors at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import CODES, INDEX, PORT, SHAPE, lens_parameter, moved_lens
from pcfix.adjust.problem import Problem, Solution, polynomial
from pcfix.adjust.solve import moved_by
from pcfix.model import Cameras, FloatArray, IntArray, WaterPlane, WaterRaster, WaterSurface

MEMBERS, AXES = 32, 16
"""Chance leaves an eighth of a standard deviation open with so many, but along the axes nothing."""

TINY = 1e-10
"""Added to the diagonal of correlations, which rounding may leave indefinite."""

SAME_M, SAME_FOCAL = 1e-3, 1e-6
"""By how much distances between centres, and relatively focal lengths, of one block may differ."""


@dataclass(frozen=True, eq=False)
class Members:
    """What m members add to the k cameras of a block and to its water.

    Attributes
    ----------
    labels : tuple of str, length k
    centres : array, shape (k, 3)
    focal : array, shape (k,)
        Of the block as adjusted, to know it by.
    turn : array, shape (m, k, 3)
        About the axes of each camera's frame, rotation vectors, radians.
    shift_m : array, shape (m, k, 3)
        Of the centres, along the same axes.
    lens_names : tuple of str, length p
    lens : array, shape (m, k, p)
        Added to these parameters.
    water : array, shape (m, 7), or (m, 4) of a plane
        Added to the height of the water below the mean of the centres, to its slopes along x and
        y, to the refractive index, and to d, e, f of d x^2 + e x y + f y^2 about there; zero of
        what was fixed.
    """

    labels: tuple[str, ...]
    centres: FloatArray
    focal: FloatArray
    turn: FloatArray
    shift_m: FloatArray
    lens_names: tuple[str, ...]
    lens: FloatArray
    water: FloatArray

    def __len__(self) -> int:
        return len(self.turn)

    def rows_of(self, cameras: Cameras) -> IntArray | None:
        """Return the row here of each of some cameras, in any CRS; None if these are others."""
        row = {label: i for i, label in enumerate(self.labels)}
        if len(row) < len(self.labels) or sorted(cameras.labels) != sorted(self.labels):
            return None
        rows = np.array([row[label] for label in cameras.labels])
        if cameras.rotations is None or cameras.lenses is None:
            return None
        focal = np.array([lens.focal for lens in cameras.lenses])
        here, there = (
            np.linalg.norm(c - c.mean(axis=0), axis=1)
            for c in (self.centres[rows], cameras.centres)
        )
        # maps differ in scale
        there = there * (here.mean() / max(float(there.mean()), SAME_M))
        is_same = np.abs(focal / self.focal[rows] - 1.0).max() < SAME_FOCAL
        return rows if is_same and np.abs(there - here).max() < SAME_M else None

    def cameras(self, member: int, nominal: Cameras, rows: IntArray) -> Cameras:
        """Return the cameras of a member; `rows` is what `rows_of` gave for the nominal ones."""
        rotations = np.asarray(nominal.rotations)
        turn, shift = self.turn[member, rows], self.shift_m[member, rows]
        codes = tuple(CODES[name] for name in self.lens_names)
        by = self.lens[member, rows]
        lenses = tuple(
            map(lambda lens, add: moved_lens(lens, codes, add), nominal.lenses or (), by)
        )
        return replace(
            nominal,
            centres=nominal.centres + np.einsum("kji,kj->ki", rotations, shift),
            rotations=Rotation.from_rotvec(turn).as_matrix() @ rotations,
            lenses=lenses,
        )

    def surface(self, member: int, water: WaterSurface, cameras: Cameras) -> WaterSurface:
        """Return the water of a member; that of a mesh or a dimension as it is."""
        level, b, c, _ = self.water[member, :4].tolist()
        if not np.delete(self.water[member], INDEX).any():
            return water
        x, y, _ = cameras.centres.mean(axis=0).tolist()
        if isinstance(water, WaterRaster):
            rows, columns = (np.arange(n) + 0.5 for n in water.height_m.shape)
            dx = (water.left_m + water.cell_m[0] * columns - x)[None, :]
            dy = (water.top_m - water.cell_m[1] * rows - y)[:, None]
            return replace(water, height_m=water.height_m + polynomial(self.water[member], dx, dy))
        if not isinstance(water, WaterPlane):
            return water
        return WaterPlane(water.a + level - b * x - c * y, water.b + b, water.c + c)


def drawn(covariance: FloatArray, count: int = MEMBERS) -> FloatArray:
    """Return draws of a covariance, shape (a, a), as rows; always the same.

    Along the largest axes of its correlations, on which most unknowns go together, they scatter
    by the very variance; on all others as chance has it.
    """
    from scipy.linalg import cholesky
    from scipy.sparse.linalg import eigsh

    sigma, rng = np.sqrt(covariance.diagonal()), np.random.default_rng(0)
    correlation = np.array(covariance / sigma, order="F")
    correlation /= sigma[:, None]
    correlation[np.diag_indices(len(sigma))] += TINY
    few = min(AXES, count, len(sigma) - 1)
    found = eigsh(correlation, few, v0=np.ones(len(sigma))) if few > 0 else None
    factor = cholesky(correlation, lower=True, overwrite_a=True)
    draws = rng.standard_normal((count, len(sigma))) @ factor.T
    if found is not None:
        values, axes = found
        even = np.linalg.qr(draws @ axes)[0] * np.sqrt(count * values)
        draws += (even - draws @ axes) @ axes.T
    return np.asarray(draws * sigma)


def members_of(problem: Problem, found: Solution, active: IntArray, steps: FloatArray) -> Members:
    """Return the members that lie by steps, shape (m, a), of the active unknowns off a solution.

    One that a lens or an index cannot follow is left out.
    """
    state, names = found.state, problem.unknowns.lens
    turn, shift, lens, water = [], [], [], []
    for one in steps:
        step = np.zeros(len(problem.moves))
        step[active] = one
        moved = moved_by(problem, found, step, np.zeros_like(state.xyz))
        if moved is None:
            continue
        r, by = state.rotations, moved.state.water - state.water
        turn.append(Rotation.from_matrix(moved.state.rotations @ r.transpose(0, 2, 1)).as_rotvec())
        shift.append(np.einsum("kij,kj->ki", r, moved.state.centres - state.centres))
        lens.append(_parameters(moved, names) - _parameters(found, names))
        x, y, _ = state.centres.mean(axis=0)
        level = float(polynomial(by, x, y))
        d, e, f = by[SHAPE:PORT]
        slopes = by[1] + 2.0 * d * x + e * y, by[2] + e * x + 2.0 * f * y
        water.append([level, *slopes, by[INDEX], d, e, f])
    k, m = len(state.centres), len(turn)
    return Members(
        problem.block.cameras.labels,
        state.centres + problem.origin,
        np.array([lens.focal for lens in found.lenses]),
        np.reshape(turn, (m, k, 3)),
        np.reshape(shift, (m, k, 3)),
        names,
        np.reshape(lens, (m, k, len(names))),
        np.reshape(water, (m, 7)),
    )


def _parameters(found: Solution, names: tuple[str, ...]) -> FloatArray:
    """Return lens parameters of each image, shape (k, p)."""
    codes = [CODES[name] for name in names]
    of = {lens: [lens_parameter(lens, code) for code in codes] for lens in set(found.lenses)}
    return np.array([of[lens] for lens in found.lenses])
