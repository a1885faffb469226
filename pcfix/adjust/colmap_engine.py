"""An adjustment by COLMAP's ordinary engine, which knows nothing of water, in rounds.

Each round intersects the points through the water with the cameras as they are, takes from the
observations what the water did to them, and has COLMAP adjust the rest with straight rays. It has
settled when the projection centres have.

Departures from the direct engine (`pcfix.adjust.solve`), of which the rounds' fixed point is not
quite the minimum: at rest J'r = 0 with the gradients J of straight rays instead of refracted ones.
COLMAP holds control points fast, as if the survey had no error, and gives all image points the
same weight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pcfix.adjust.colmap_lens import Flags, camera_for
from pcfix.adjust.colmap_model import Plan, adjusted, load_pycolmap
from pcfix.adjust.normal import Loss
from pcfix.adjust.solve import LOSSES, LogRow, Problem, Solution, cost_at, counts_of, gnss_weights
from pcfix.adjust.state import CODES
from pcfix.adjust.straight import fixed_poses, intersected, straight_places
from pcfix.errors import GeometryError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable

    from pcfix.adjust.block import Robust
    from pcfix.model import BoolArray, FloatArray, Lens

MOST_ROUNDS = 15
CLOSE_M = 1e-4
TOLERANCE = 1e-6
HELD_UP_TO_M = 0.05
"""Standard deviation of a control point up to which it may as well stay where it is."""


def solve_with_colmap(
    problem: Problem,
    start: Solution,
    robust: Robust = "squares",
    scale: float = 2.0,
    number: int = 1,
    progress: Callable[[LogRow], None] | None = None,
    tolerance: float = TOLERANCE,
) -> Solution:
    """Adjust a problem by COLMAP, from a start.

    Parameters
    ----------
    problem, start
        Of `pcfix.adjust.solve.prepare`.
    robust : {"squares", "huber", "cauchy"}
    scale : float
        Where the loss begins to bend, in standard deviations.
    number : int
        For the log; its steps are the rounds here.
    progress : callable, optional
    tolerance : float
        Relative change of the cost at which COLMAP stops in each round.

    Returns
    -------
    Solution

    Raises
    ------
    SettingError
        If pycolmap is missing, or cannot do what is asked.
    GeometryError
        If COLMAP finds no solution, or the rounds do not settle.
    """
    load_pycolmap()
    plan = plan_for(problem)
    loss, only_points = Loss(LOSSES[robust], scale), fixed_poses(problem)
    there = problem.surface.there
    now, log, moved_m = start, list(start.log), np.inf
    for step in range(MOST_ROUNDS):
        state = intersected(only_points, now.state, loss)
        places = straight_places(problem, state)
        state, lenses = adjusted(problem, plan, state, now.lenses, places, loss, tolerance)
        state = state._replace(**_datum(problem, state.centres, state.rotations, state.xyz))
        moved_m = float(np.abs(state.centres - now.state.centres).max()) if there else 0.0
        if moved_m < CLOSE_M:
            state = intersected(only_points, state, loss)
        now = replace(now, state=state, lenses=lenses)
        now = replace(now, cost=cost_at(problem, now, loss))
        row = LogRow(number, step + 1, now.cost, 0.0, *counts_of(problem, now))
        log.append(row)
        if progress is not None:
            progress(row)
        if moved_m < CLOSE_M:
            change = _lens_change(problem, start.lenses, lenses)
            return replace(now, shared=start.shared + change, log=log)
    raise GeometryError(
        f"the rounds with COLMAP did not settle: the last of {MOST_ROUNDS} still moved a projection"
        f" centre by {moved_m:.2g} m; take the direct engine."
    )


def plan_for(problem: Problem) -> Plan:
    """Return how a block goes to COLMAP.

    Raises
    ------
    SettingError
        If it cannot be done there: which unknowns, and what instead.
    """
    _check_unknowns(problem)
    block, unknowns = problem.block, problem.unknowns
    lenses = block.cameras.lenses or ()
    distinct = tuple(dict.fromkeys(lenses))
    by_code = {code: name for name, code in CODES.items()}
    names = {
        lenses[i]: frozenset(by_code[code] for code in problem.codes[group])
        for group, rows in enumerate(problem.groups)
        for i in rows
    }
    found = [camera_for(lens, names[lens]) for lens in distinct]
    is_free = [any(flags) for _, flags in found]
    kinds = {flags for _, flags in found if any(flags)}
    if len(kinds) > 1:
        raise SettingError(
            "COLMAP frees the same parameters of all lenses, and these have different ones; take"
            " the direct engine."
        )
    fixed = np.array([label in unknowns.fixed_images for label in block.cameras.labels])
    fixed |= unknowns.poses == "fixed"
    held = _held_points(problem)
    has_priors = _has_priors(problem, held, fixed)
    flags = kinds.pop() if kinds else Flags(focal=False, principal=False, extra=False)
    cameras = [camera for camera, _ in found]
    return Plan(cameras, is_free, flags, _sigma_px(problem), held, fixed, has_priors)


def _check_unknowns(problem: Problem) -> None:
    unknowns, block = problem.unknowns, problem.block
    sigma = unknowns.water_sigma
    refused = {
        "a free water level": bool(sigma[0]),
        "a free tilt of the water": bool(sigma[1]),
        "a free refractive index": bool(sigma[3]),
        "a similarity of the block": unknowns.poses == "similarity",
        "standard deviations of lens parameters": bool(unknowns.lens_sigma),
        "a housing port": block.port is not None,
        "a lens of one sensor with a calibration per image": any(
            len({(block.cameras.lenses or ())[i] for i in rows}) > 1 and codes
            for rows, codes in zip(problem.groups, problem.codes, strict=True)
        ),
    }
    named = [name for name, is_there in refused.items() if is_there]
    if named:
        raise SettingError(f"COLMAP's engine cannot do {', '.join(named)}; take the direct engine.")


def _held_points(problem: Problem) -> BoolArray:
    """Return which points are surveyed, and so stay."""
    sigma = np.where(problem.priors.weight > 0.0, problem.block.surveyed_sigma_m, np.inf)
    surveyed = np.isfinite(sigma)
    held = np.asarray((sigma <= HELD_UP_TO_M).all(axis=1))
    if (surveyed.any(axis=1) & ~held).any():
        raise SettingError(
            "COLMAP's engine holds control points fast, and cannot do ones with a standard"
            f" deviation above {HELD_UP_TO_M:g} m or without one of the coordinates; take the"
            " direct engine."
        )
    return held


def _has_priors(problem: Problem, held: BoolArray, fixed: BoolArray) -> bool:
    """Return whether GNSS positions make the datum, and check that something does."""
    known = (gnss_weights(problem.block) > 0.0) & ~fixed[:, None]
    positions = int(known.all(axis=1).sum())
    shown = np.unique(problem.block.owner[problem.seen.weight > 0.0])
    enough = int(held[shown].sum()) >= 3 or int(fixed.sum()) >= 2
    if problem.unknowns.free_network:
        if positions or held.any() or fixed.any() or problem.surface.there:
            raise SettingError(
                "COLMAP's engine can do a free network without water, GNSS positions, control"
                " points and fixed images only; take the direct engine."
            )
        return False
    if fixed.all():
        return False
    if (known.any(axis=1) & ~known.all(axis=1)).any() or 0 < positions < 3:
        raise SettingError(
            "COLMAP's engine needs GNSS positions of three images that move at least, or of none,"
            f" each with x, y and z: {positions} are there; take the direct engine."
        )
    if not positions and not enough:
        raise SettingError(
            "nothing tells COLMAP's engine where the block lies: give GNSS positions of three"
            " images, three control points or two fixed images."
        )
    return positions >= 3


def _sigma_px(problem: Problem) -> float:
    """Return the standard deviation of the image points of points that are not surveyed."""
    weight = problem.seen.weight
    counts = weight > 0.0
    tie = counts & ~problem.block.is_surveyed[problem.block.owner]
    chosen = weight[tie] if tie.any() else weight[counts]
    if not len(chosen):
        raise GeometryError("no image point counts in the adjustment.")
    if np.ptp(chosen) > 1e-9 * chosen.max():
        raise SettingError(
            "COLMAP's engine gives all image points the same weight, and these have standard"
            f" deviations from {1.0 / chosen.max():g} to {1.0 / chosen.min():g} px; take the direct"
            " engine."
        )
    return float(1.0 / chosen[0])


def _datum(
    problem: Problem, centres: FloatArray, rotations: FloatArray, xyz: FloatArray
) -> dict[str, FloatArray]:
    """Return a free network moved to where the projection centres have their first datum.

    As in `pcfix.adjust.solve`: mean place, mean direction and mean scale of the centres.
    """
    if not problem.unknowns.free_network:
        return {}
    from scipy.spatial.transform import Rotation

    first = problem.block.cameras.centres - problem.origin
    pivot, mean = first.mean(axis=0), centres.mean(axis=0)
    d, c = first - pivot, centres - mean
    turn = Rotation.align_vectors(d, c)[0].as_matrix()
    factor = float((d * d).sum() / (d * (c @ turn.T)).sum())
    return {
        "centres": pivot + factor * c @ turn.T,
        "rotations": np.ascontiguousarray(rotations @ turn.T),
        "xyz": pivot + factor * (xyz - mean) @ turn.T,
    }


def _lens_change(problem: Problem, before: tuple[Lens, ...], after: tuple[Lens, ...]) -> FloatArray:
    """Return what was added to the shared unknowns, shape (g,)."""
    by_code = {code: name for name, code in CODES.items()}
    change = [
        _number(after[rows[0]], by_code[code]) - _number(before[rows[0]], by_code[code])
        for rows, codes in zip(problem.groups, problem.codes, strict=True)
        for code in codes
    ]
    return np.array(change, np.float64)


def _number(lens: Lens, name: str) -> float:
    """Return a parameter of a lens by its short name."""
    plain = {
        "f": lens.focal, "cx": lens.principal_x, "cy": lens.principal_y,
        "b1": lens.b1, "b2": lens.b2,
    }  # fmt: skip
    if name in plain:
        return plain[name]
    listed = lens.radial if name[0] == "k" else lens.tangential
    place = int(name[1:]) - 1
    return listed[place] if place < len(listed) else 0.0
