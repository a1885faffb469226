"""Observations as straight rays would have made them.

A point Q under water is imaged at pi_w(Q), and straight rays would image it at pi(Q). What was
observed at l is handed to an adjustment that knows nothing of the water as

    l + pi(Q) - pi_w(Q)

so that its residual at Q is the one with the water. As the cameras move, Q and these places are
found anew.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.adjust.block import Unknowns
from pcfix.adjust.normal import CAUCHY, HUBER, Loss, point_steps, residuals
from pcfix.adjust.solve import prepare
from pcfix.adjust.state import Surface

if TYPE_CHECKING:
    from pcfix.adjust.solve import Problem
    from pcfix.adjust.state import State
    from pcfix.model import FloatArray

STEPS, TRIALS = 12, 4
CLOSE_M = 1e-7
FIT_DAMPING = 1e-8
"""So little that it only keeps points at rest whose rays are parallel."""


def fixed_poses(problem: Problem) -> Problem:
    """Return the same problem with nothing free but the points."""
    return prepare(problem.block, Unknowns(poses="fixed", lens=()))[0]


def intersected(points_only: Problem, state: State, loss: Loss) -> State:
    """Return a state whose points fit their images best, poses, lens and water as they are.

    Parameters
    ----------
    points_only : Problem
        Of `fixed_poses`.
    state : State
        Relative to the problem's origin.
    loss : Loss

    Notes
    -----
    Steps of Gauss and Newton, each point's halved while its own cost would rise.
    """
    poses, shared = np.zeros((len(state.centres), 6)), np.zeros(0)
    cost = _point_costs(points_only, state, loss)
    for _ in range(STEPS):
        steps = point_steps(
            state, points_only.seen, points_only.surface, points_only.columns, points_only.priors,
            loss, FIT_DAMPING, points_only.pivot, poses, shared,
        )  # fmt: skip
        for _ in range(TRIALS):
            trial = state._replace(xyz=state.xyz + steps)
            found = _point_costs(points_only, trial, loss)
            better = found <= cost
            if better.all():
                break
            steps[~better] *= 0.5
        steps[~better] = 0.0
        state = state._replace(xyz=state.xyz + steps)
        cost = np.where(better, found, cost)
        if np.abs(steps).max(initial=0.0) < CLOSE_M:
            break
    return state


def _point_costs(problem: Problem, state: State, loss: Loss) -> FloatArray:
    """Return what the residuals of each point cost, its survey included; infinite out of sight."""
    r = residuals(state, problem.seen, problem.surface)
    s = (r * r).sum(axis=1) * problem.seen.weight**2
    c2 = loss.scale**2
    if loss.kind == HUBER:
        s = np.where(s <= c2, s, 2.0 * loss.scale * np.sqrt(s) - c2)
    elif loss.kind == CAUCHY:
        s = c2 * np.log1p(s / c2)
    s = np.where(problem.seen.weight > 0.0, np.where(np.isnan(s), np.inf, s), 0.0)
    own = np.bincount(problem.block.owner, s, len(state.xyz))
    priors = problem.priors.weight * (problem.priors.xyz - state.xyz) ** 2
    return np.asarray(own + priors.sum(axis=1))


def straight_places(problem: Problem, state: State) -> FloatArray:
    """Return where straight rays would have imaged what was observed, shape (o, 2), px.

    NaN where a camera does not image its point, with the water or without.
    """
    dry = Surface(there=False, tin=None, field=None, origin=problem.origin, port=np.zeros(0))
    bent = residuals(state, problem.seen, problem.surface)
    straight = residuals(state, problem.seen, dry)
    return problem.seen.image_xy + (bent - straight)
