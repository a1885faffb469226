"""The adjustment itself: Levenberg and Marquardt's steps, and what a block does not determine.

Water level, its tilt, the refractive index and the lens all move the bed, and over some blocks
alike (Mulsow 2024): then they cannot all be free.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import (
    CAUCHY,
    CODES,
    HUBER,
    PLANES,
    PORT,
    SQUARES,
    Loss,
    Robust,
    State,
    moved_lens,
)
from pcfix.adjust.equations import reduced_at, solver, undamped
from pcfix.adjust.normal import point_steps
from pcfix.adjust.problem import (
    LogRow,
    Problem,
    Progress,
    Solution,
    cost_at,
    counts_of,
    pose_gradients,
)
from pcfix.errors import GeometryError
from pcfix.lens.imaging import lens_table
from pcfix.model import FloatArray, IntArray, Lens
from pcfix.port.shapes import DomePort, FlatPort, Port

if TYPE_CHECKING:
    from scipy.sparse import csc_array


LOSSES = {"squares": SQUARES, "huber": HUBER, "cauchy": CAUCHY}
BEND = 2.0
"""Where a robust loss begins to bend, in standard deviations."""

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-12, 1e8
MOST_STEPS = 60
CLOSE = 1e-10
"""Of the cost, relative: two steps in a row that gain less end the last round."""

EXACT = 1e-10
"""Squared residual, in variances, below which an observation is met exactly."""

ROUNDING = 1e-12


def solve(
    problem: Problem,
    start: Solution,
    robust: Robust = "squares",
    number: int = 1,
    progress: Progress | None = None,
    close: float = CLOSE,
) -> Solution:
    """Minimise the weighted squares from a start.

    Parameters
    ----------
    robust : {"squares", "huber", "cauchy"}
    number : int
        Of the round, for the log.
    close : float
        Two steps in a row that lower the cost by less than this share end the round.

    Raises
    ------
    GeometryError
        If the normal equations stay singular, or the cost is not finite.
    """
    loss = Loss(LOSSES[robust], BEND)
    now = replace(start, cost=cost_at(problem, start, loss))
    if not np.isfinite(now.cost):
        raise GeometryError("the adjustment has no finite start: check the poses and the water.")
    damping, up, calm = FIRST_DAMPING, 2.0, 0
    least_cost = EXACT * max(int((problem.seen.weight > 0.0).sum()), 1)
    log = list(start.log)
    for step in range(MOST_STEPS):
        while (trial := _trial(problem, now, loss, damping)) is None or not trial.cost <= now.cost:
            if trial is not None and trial.cost - now.cost < ROUNDING * max(now.cost, least_cost):
                return replace(now, log=log)  # the cost is known no better than this
            damping, up = damping * up, 2.0 * up
            if damping > MOST_DAMPING:
                if trial is None and step == 0:
                    raise GeometryError(
                        "the normal equations are singular: " + weakest(problem, now)
                    )
                return replace(now, log=log)
        # exact data end at a cost of nothing, of which there is no share
        gain = (now.cost - trial.cost) / max(now.cost, least_cost)
        now, up = trial, 2.0
        damping = max(damping / 10.0, LEAST_DAMPING)
        row = LogRow(number, step + 1, now.cost, damping, *counts_of(problem, now))
        log.append(row)
        if progress is not None:
            progress(row)
        calm = calm + 1 if gain < close else 0
        if calm == 2:
            break
    return replace(now, log=log)


def _trial(problem: Problem, now: Solution, loss: Loss, damping: float) -> Solution | None:
    """Return the state one step on; None where the equations are singular."""
    reduced = reduced_at(problem, now, loss, damping)
    solve_for = solver(reduced)
    if solve_for is None:
        return None
    step = np.zeros(len(problem.moves))
    step[reduced.active] = solve_for(reduced.right)
    if not np.isfinite(step).all():
        return None
    points = point_steps(now.state, problem.given, loss, damping, step)
    moved = moved_by(problem, now, step, points)
    return None if moved is None else replace(moved, cost=cost_at(problem, moved, loss))


def moved_by(
    problem: Problem, now: Solution, step: FloatArray, points: FloatArray
) -> Solution | None:
    """Return a solution with steps added; None where a number leaves its range."""
    state, columns, k = now.state, problem.columns, len(now.state.centres)
    poses, shared = step[: 6 * k].reshape(k, 6), step[6 * k :]
    centres = state.centres + poses[:, 3:]
    rotations = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ state.rotations
    if columns.similarity >= 0:
        t, phi, s = np.split(shared[columns.similarity :], [3, 6])
        turn = Rotation.from_rotvec(phi).as_matrix()
        d = centres - problem.columns.pivot
        centres = problem.columns.pivot + t + (1.0 + s[0]) * d @ turn.T
        rotations = rotations @ turn.T
    water = state.water.copy()
    free = columns.water >= 0
    water[free] += shared[columns.water[free]]
    if not 1.0 <= water[3] < 3.0 or not _is_port(problem.block.port, water[PORT:PLANES]):
        return None
    lenses = _moved_lenses(problem, now.lenses, shared)
    if lenses is None:
        return None
    table = state.lenses if lenses is now.lenses else lens_table(lenses)[1]
    if table.shape[0] != state.lenses.shape[0]:
        return None
    return replace(
        now,
        state=State(
            centres, np.ascontiguousarray(rotations), np.ascontiguousarray(table),
            state.xyz + points, water,
        ),
        lenses=lenses,
        shared=now.shared + shared,
    )  # fmt: skip


def _is_port(port: Port | None, numbers: FloatArray) -> bool:
    """Whether a port may have this distance, or this centre."""
    match port:
        case FlatPort():
            return bool(numbers[0] >= 0.0)
        case DomePort():
            return bool(np.linalg.norm(numbers[1:]) < port.radius_m)
    return True


def _moved_lenses(
    problem: Problem, lenses: tuple[Lens, ...], shared: FloatArray
) -> tuple[Lens, ...] | None:
    """Return the lenses with what was added to each group; None where one is no lens any more."""
    if problem.columns.lens[-1] == 0:
        return lenses
    moved = list(lenses)
    parts = np.split(shared, problem.columns.lens[1:])
    for rows, codes, by in zip(problem.groups, problem.codes, parts, strict=False):
        new = {lens: moved_lens(lens, codes, by) for lens in {lenses[i] for i in rows}}
        for i in rows:
            moved[i] = new[lenses[i]]
    return tuple(moved) if all(lens.focal > 0.0 for lens in moved) else None


WEAK = 1e-11
"""Eigenvalues of the matrix with unit diagonal, below which a motion costs nothing."""


LIMITS = {
    "level": (0.02, "m", "the water level"),
    "tilt_x": (0.0005, "m/m", "the tilt of the water along x"),
    "tilt_y": (0.0005, "m/m", "the tilt of the water along y"),
    "index": (0.005, "", "the refractive index"),
    "scale": (0.001, "", "the scale of the block"),
    "distance": (0.002, "m", "the distance of the port"),
    "centre_x": (0.002, "m", "the dome's centre along x"),
    "centre_y": (0.002, "m", "the dome's centre along y"),
    "centre_z": (0.002, "m", "the dome's centre along z"),
}
"""Standard errors beyond which an unknown counts as undetermined, its unit and its name."""


_WORDS = {name: words for name, (_, _, words) in LIMITS.items()} | {
    "f": "the focal length", "cx": "the principal point's x", "cy": "the principal point's y",
    "b1": "the affinity b1", "b2": "the skew b2",
}  # fmt: skip
_WORDS |= {f"shape_{which}": f"the water's shape {which}" for which in ("xx", "xy", "yy")}
_WORDS |= {name: f"the distortion {name}" for name in CODES if name[0] in "kp"}
for _axis in "xyz":
    _WORDS[f"shift {_axis}"] = f"the block's shift along {_axis}"
    _WORDS[f"turn {_axis}"] = f"the block's turn about {_axis}"


BED = {"level", "index", "tilt_x", "tilt_y", "shape_xx", "shape_xy", "shape_yy"}


def words_of(name: str) -> str:
    """Return what a surveyor calls a shared unknown."""
    base, of, sensor = name.partition(" of sensor ")
    return _WORDS.get(base, base) + of + sensor


def weakest(problem: Problem, solution: Solution) -> str:
    """Say which unknowns the normal equations leave free at a solution.

    The eigenvectors of the smallest eigenvalues of the reduced matrix with unit diagonal are
    compared with motions of the whole block; what remains is named by the unknowns in it.
    """
    equations = undamped(problem, solution)
    reduced = equations.reduced
    diagonal = reduced.matrix.diagonal()
    silent = reduced.active[~(diagonal > 0.0)]
    if len(silent):
        return _not_observed(problem, silent)
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = _smallest(reduced.matrix, scale)
    weak = values < max(WEAK, 10.0 * float(values[0]))
    free = vectors[:, weak]
    found, left = [], free
    for words, step in _motions(problem, solution):
        v = step[reduced.active] / scale
        length = float(np.linalg.norm(v))
        if length > 0.0 and float(np.linalg.norm(free.T @ v)) > 0.99 * length:
            found.append(words)
            v = left @ (left.T @ v)
            left = _without(left, v)
    parts = [_NO_DATUM.format(_listed(found))] if found else []
    parts += [_named(problem, left[:, i], reduced.active) for i in range(left.shape[1])]
    return "; ".join(parts) + "."


def _smallest(matrix: FloatArray | csc_array, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the smallest eight eigenvalues and their vectors of the scaled matrix."""
    count, size = 8, len(scale)
    if isinstance(matrix, np.ndarray):
        from scipy.linalg import eigh

        last = min(count, size) - 1
        return eigh(matrix * scale * scale[:, None], subset_by_index=[0, last])
    from scipy import sparse
    from scipy.sparse.linalg import eigsh

    scaled = sparse.diags_array(scale) @ matrix @ sparse.diags_array(scale)
    start = np.random.default_rng(0).normal(size=size)
    values, vectors = eigsh(scaled.tocsc(), k=count, sigma=-1e-9, which="LM", v0=start)
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _without(basis: FloatArray, v: FloatArray) -> FloatArray:
    """Return a basis of what is at right angles to v, which lies in the given one."""
    length = float(np.linalg.norm(v))
    if length < 0.1:
        return basis
    rest = basis - np.outer(v, v @ basis) / length**2
    u, s, _ = np.linalg.svd(rest, full_matrices=False)
    return np.asarray(u[:, s > 0.5])


def _motions(problem: Problem, solution: Solution) -> Iterator[tuple[str, FloatArray]]:
    """Yield motions of everything that images alone cannot see, each as a step of all unknowns.

    Shift, turn and scale, the water with it where it is free. Turned and scaled about the place of
    the water at the block's origin, whose level stays. The normal of z = a + b x + c y turns with
    the rest, and with it the slopes.
    """
    a, b, c = solution.state.water[:3]
    pivot = np.array([0.0, 0.0, a]) if problem.surface.there else problem.columns.pivot
    poses = pose_gradients(solution.state, pivot)
    water: dict[str, dict[str, float]] = {
        "shift along x": {"level": -b}, "shift along y": {"level": -c},
        "shift in height": {"level": 1.0},
        "turn about x": {"tilt_x": b * c, "tilt_y": 1.0 + c * c},
        "turn about y": {"tilt_x": -1.0 - b * b, "tilt_y": -b * c},
        "turn about the vertical": {"tilt_x": -c, "tilt_y": b}, "scale": {},
    }  # fmt: skip
    for i, (words, by_name) in enumerate(water.items()):
        shared = [by_name.get(name, 0.0) for name in problem.names]
        step = np.concatenate([poses[:, :, i].ravel(), shared])
        step[~problem.moves] = 0.0
        yield words, step


_NO_DATUM = (
    "nothing holds the {} of the block (no datum): give GNSS positions, three control points, or"
    " fix images, or ask for a free network"
)


def _named(problem: Problem, v: FloatArray, active: IntArray) -> str:
    """Return the unknowns that one free motion moves most."""
    full = np.zeros(len(problem.moves))
    full[active] = v
    k = len(problem.block.cameras)
    shared, poses = full[6 * k :], np.linalg.norm(full[: 6 * k].reshape(k, 6), axis=1)
    largest = float(np.abs(v).max())
    most = [words_of(problem.names[i]) for i in np.flatnonzero(np.abs(shared) > 0.1 * largest)]
    if poses.max(initial=0.0) > 0.1 * largest:
        moved = np.flatnonzero(poses > 0.3 * poses.max())
        labels = [problem.block.cameras.labels[i] for i in moved[:3]]
        few = f"the pose of {_listed(labels)}" if len(moved) <= 3 else "the poses"
        most.append(few)
    if len(most) == 1:
        return f"nothing in the block determines {most[0]}: fix it"
    return f"the block cannot tell {_listed(most)} apart: fix one of them"


def _not_observed(problem: Problem, rows: IntArray) -> str:
    """Return what has no observation at all."""
    k = len(problem.block.cameras)
    images = sorted({int(row) // 6 for row in rows if row < 6 * k})
    names = [problem.names[int(row) - 6 * k] for row in rows if row >= 6 * k]
    parts = []
    if images:
        labels = [problem.block.cameras.labels[i] for i in images[:3]]
        more = f" and {len(images) - 3} more" if len(images) > 3 else ""
        parts.append(
            f"{', '.join(labels)}{more}: no tie point that two images fix: leave the image out or"
            " fix its pose"
        )
    if names:
        wet = " (no point lies under water)" if set(names) & BED else ""
        parts.append(
            f"no observation depends on {_listed([words_of(name) for name in names])}{wet}: fix it"
        )
    return "; ".join(parts) + "."


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
