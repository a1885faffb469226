"""Levenberg-Marquardt steps, the reduced matrix and its solution, and what is undetermined.

Water level, its tilt, the refractive index and the lens all move the bed, and over some blocks in
the same way (Mulsow 2024): then they cannot all be free.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.collinearity import State
from pcfix.adjust.normal import SQUARES, UNDAMPED, Rule, normal_equations, point_steps, residuals
from pcfix.adjust.parameters import INDEX, moved_lens, words_of
from pcfix.adjust.problem import Problem, Solution, cost_at, port_of, prior_rows
from pcfix.errors import GeometryError, PcfixError
from pcfix.lens.formulas import lens_table
from pcfix.model import FloatArray, Lens
from pcfix.port.housing import window_of
from pcfix.running import current

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-12, 1e8
MOST_STEPS = 60
CLOSE = 1e-10  # two steps in a row that lower the cost by a smaller share end the adjustment
EXACT = 1e-10  # squared residual, in variances, of an observation that is met exactly

# Share of the cost by which it may rise at the minimum. In large blocks some points near the water
# surface change sides at each step, so that the cost does not fall further. Shorter steps do not
# help and would double the time. With a million observations this is 0.04 standard errors at most.
ROUNDING = 1e-9


# Steps


def solve(problem: Problem, start: Solution, loss: int = SQUARES, close: float = CLOSE) -> Solution:
    """Minimise the weighted squared residuals, or a robust loss of `pcfix.adjust.normal`.

    Two steps in a row that lower the cost by less than the share `close` end the round.
    """
    now = replace(start, cost=cost_at(problem, start, loss))
    damping, up, calm, steps = FIRST_DAMPING, 2.0, 0, 0
    # with exact observations the cost ends at zero, of which there is no share
    least_cost = EXACT * max(int(problem.used.sum()), 1)
    while steps < MOST_STEPS and calm < 2 and damping <= MOST_DAMPING:
        trial = _trial(problem, now, Rule(loss, damping))
        gain = np.nan if trial is None else (now.cost - trial.cost) / max(now.cost, least_cost)
        if trial is not None and gain >= 0.0:
            now, steps = trial, steps + 1
            damping, up = max(damping / 10.0, LEAST_DAMPING), 2.0
            calm = calm + 1 if gain < close else 0
            show(problem, now)
        elif gain > -ROUNDING:
            break
        else:
            damping, up = damping * up, 2.0 * up  # a shorter step
    if trial is None and steps == 0:
        raise singular(problem, now)
    return now


def show(problem: Problem, now: Solution) -> None:
    """Show the residuals after a step, if the command shows its progress."""
    if (say := current().say) is not None:
        r = residuals(now.state, problem.given)[problem.used]
        rms_px = np.sqrt(np.nansum(r * r) / max(r.size, 1))
        say(f"{len(r):,} observations, residuals {rms_px:.3f} px")


def _trial(problem: Problem, now: Solution, rule: Rule) -> Solution | None:
    """Return the solution one step further; None if the equations are singular."""
    matrix, right = reduced_at(problem, now, rule)
    solve_for = solver(matrix)
    if solve_for is None:
        return None
    step = solve_for(right)
    if not np.isfinite(step).all():
        return None
    step = np.append(np.zeros(problem.fixed), step)
    moved = moved_by(problem, now, step, point_steps(now.state, problem.given, rule, step))
    return None if moved is None else replace(moved, cost=cost_at(problem, moved, rule.loss))


def moved_by(
    problem: Problem, now: Solution, step: FloatArray, points: FloatArray
) -> Solution | None:
    """Return a solution with steps of poses and shared unknowns, (6 k + g,), and points added.

    None if a parameter leaves its range.
    """
    state, given, count = now.state, problem.given, 6 * len(now.lenses)
    poses, shared = step[:count].reshape(-1, 6), step[count:]
    rotations = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ state.rotations
    water, free = state.water.copy(), given.column >= 0
    water[free] += shared[given.column[free]]
    if not 1.0 <= water[INDEX] < 3.0:
        return None
    try:
        port = port_of(problem.block, water)
    except PcfixError:  # a distance below zero, or a dome that does not contain the camera
        return None
    pairs, moved = [*zip(now.lenses, given.group.tolist(), strict=True)], dict[Any, Lens]()
    for lens, sensor in set(pairs):  # images with one lens keep one
        own = slice(*given.first_lens[sensor : sensor + 2])
        moved[lens, sensor] = moved_lens(lens, given.code[own].tolist(), shared[own])
    lenses = tuple(moved[pair] for pair in pairs)
    if not all(lens.focal > 0.0 for lens in lenses):
        return None
    table = lens_table(lenses)[1]
    return replace(
        now,
        state=State(
            state.centres + poses[:, 3:], np.ascontiguousarray(rotations),
            np.ascontiguousarray(table), state.xyz + points, water, window_of(port),
        ),
        lenses=lenses,
        shared=now.shared + shared,
    )  # fmt: skip


# The reduced equations


def reduced_at(problem: Problem, found: Solution, rule: Rule = UNDAMPED) -> tuple[Any, FloatArray]:
    """Return the equations of the free unknowns at a solution, with prior knowledge.

    The matrix, shape (u, u), is dense or scipy's sparse one; the right side has the shape (u,).
    These are the last u of all 6 k + g unknowns.
    """
    from scipy.sparse import diags_array

    total, right, diagonal = normal_equations(found.state, problem.given, rule)
    rows, left = prior_rows(problem, found)
    extra = rows.T @ rows
    # the damping is a factor on the diagonal before the points were eliminated
    extra = extra + diags_array(rule.damping * (diagonal + extra.diagonal()))
    free = slice(problem.fixed, None)
    return (total + extra)[free, free], (right + rows.T @ left)[free]


def solver(matrix: Any) -> Callable[[FloatArray], FloatArray] | None:
    """Return a function that solves for a right side; None if the matrix is not definite."""
    if matrix.shape[0] == 0:
        return lambda right: right
    from scipy.linalg import cho_factor, cho_solve
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    diagonal = matrix.diagonal()
    if not (diagonal > 0.0).all():
        return None
    scale = diags_array(1.0 / np.sqrt(diagonal))  # units differ, so that rounding would too
    scaled = scale @ matrix @ scale
    solve_scaled: Callable[[FloatArray], FloatArray]
    try:
        if isinstance(scaled, np.ndarray):
            solve_scaled = partial(cho_solve, cho_factor(scaled, lower=True))
        else:
            solve_scaled = splu(
                scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            ).solve  # fmt: skip
    except (np.linalg.LinAlgError, RuntimeError):
        return None
    return lambda right: np.asarray(scale @ solve_scaled(scale @ right))


def singular(problem: Problem, solution: Solution) -> GeometryError:
    """Return an error that names the unknowns that the observations leave undetermined.

    These are the ones on which no observation depends, or if there are none, all of them.
    """
    matrix = reduced_at(problem, solution)[0]
    weak, why = ~(matrix.diagonal() > 0.0), "no observation depends on them"
    if not weak.any():
        weak, why = np.ones(len(weak), np.bool_), "the observations do not separate them"
    of_poses, of_names = np.split(weak, [len(weak) - len(problem.names)])
    images = np.flatnonzero(of_poses.reshape(-1, 6).any(axis=1))
    labels = [problem.block.cameras.labels[i] for i in images]
    names = [name for name, is_weak in zip(problem.names, of_names, strict=True) if is_weak]
    words = [f"the {words_of(name)[0]}" for name in names]
    if labels:
        some = f"of {', '.join(labels[:3])}" if len(labels) <= 3 else f"of {len(labels)} images"
        words.append(f"the poses {some}")
    datum = ", or give GNSS positions or three control points" if labels else ""
    return GeometryError(
        "adjust.singular",
        f"The adjustment cannot determine {', '.join(words)}: {why}. Fix some of them{datum}.",
        unknowns=names,
        images=labels,
    )
