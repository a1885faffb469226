"""Which parameters of the lens may move where nobody named any: those that tests ask for.

An adjustment that knew nothing of the water bent its lens to take up the refraction: a sensor of
square pixels comes with an aspect, one without distortion with some. What it left must be free to
go back, and what it lacked may be found. So the block is adjusted with what its lenses have; then
it is asked, parameter by parameter, by how much another one would lower the weighted squares.

The answer needs no further adjustment. With the normal equations [[A, B], [B', C]] of all unknowns
and of the candidates, at a solution where nothing pulls at the unknowns and c at the candidates,
some of these, freed, take R^-1 c with R = C - B' A^-1 B, and lower the squares by c' R^-1 c.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from pcfix.adjust.block import CODES, CX, CY, K1, NAMES, P1, P2, usable_codes
from pcfix.adjust.equations import solver, undamped
from pcfix.adjust.precision import Precision
from pcfix.adjust.problem import Problem, Solution, prepare
from pcfix.model import FloatArray, IntArray, Lens

SURE = 1e-3
"""Probability that a further lens parameter lowers the squares by so much for nothing."""

WEAK_PX = 2.0
"""Standard error of the image at the corner of the frame above which a lens parameter is left as
it was, if the residuals let it; the focal length always moves."""

BENT = 0.05
"""Probability at which weak parameters go as far for nothing. An unaware adjustment bends them too:
one that is held there bends the block instead, and no standard error knows of it."""

TRIED = ("b1", "k1", "k2", "k3", "p1", "p2")
"""What a lens may lack. The skew b2 is none of these: sensors have none, nor do COLMAP's lenses."""


def default_lens(lenses: tuple[Lens, ...]) -> tuple[str, ...]:
    """Return the parameters that may move where the user names none: those that the lenses have."""
    names = ["f", "cx", "cy"]
    for lens in lenses:
        names += [name for name in ("b1", "b2") if getattr(lens, name)]
        names += [f"k{i}" for i, value in enumerate(lens.radial[:4], start=1) if value]
        names += [f"p{i}" for i, value in enumerate(lens.tangential[:2], start=1) if value]
    return tuple(
        name for name in dict.fromkeys(names) if any(usable_codes(lens, (name,)) for lens in lenses)
    )


def weak_lens_parameters(problem: Problem, found: Solution, precision: Precision) -> list[str]:
    """Return which lens parameters, the focal length apart, stay: the block hardly determines them.

    None does where all of these went further together than chance takes them.
    """
    names = [NAMES[code] for codes in problem.codes for code in codes]
    effects = [
        effect_at_corner(_first_lens(problem, group), code)
        for group, codes in enumerate(problem.codes)
        for code in codes
    ]
    sigma = np.array([row.sigma for row in precision.shared[: len(names)]])
    by_px = zip(names, sigma * effects, strict=True)
    weak = list(dict.fromkeys(name for name, by in by_px if name != "f" and by > WEAK_PX))
    rows = np.flatnonzero(np.isin(names, weak))
    went = found.shared[rows] / sigma[rows]
    squares = went @ np.linalg.pinv(precision.correlation[np.ix_(rows, rows)]) @ went
    return [] if squares > chdtri(max(len(rows), 1), BENT) else weak


def effect_at_corner(lens: Lens, code: int) -> float:
    """Return by how much the image moves at the corner of the frame with a lens parameter."""
    r = 0.5 * np.hypot(lens.width, lens.height) / lens.focal
    if code in (CX, CY):
        return 1.0
    if code >= K1:
        return float(lens.focal * r ** (2 * (code - K1) + 3))
    return float(3.0 * lens.focal * r * r if code in (P1, P2) else r)


def _first_lens(problem: Problem, group: int) -> Lens:
    return (problem.block.cameras.lenses or ())[problem.groups[group][0]]


class _Candidates(NamedTuple):
    """Columns of the parameters to be tried: which each is, its effect, R and c; see above."""

    code: IntArray
    effect: FloatArray
    matrix: FloatArray
    pull: FloatArray


def missing_lens_parameters(problem: Problem, now: Solution, sigma0: float) -> list[str]:
    """Return which lens parameters lower the squares by more than chance does, the best first.

    Parameters
    ----------
    problem, now : Problem, Solution
        Adjusted with the parameters that its lenses have.
    sigma0 : float
        A-posteriori standard deviation of unit weight.
    """
    tried = _candidates(problem, now)
    chosen: list[int] = []
    while tried is not None:
        gains = {
            int(code): gain
            for code in np.unique(tried.code)
            if code not in chosen and (gain := _gain(tried, [*chosen, int(code)], sigma0))
        }
        if not gains:
            break
        chosen.append(max(gains, key=gains.__getitem__))
    return [NAMES[code] for code in chosen]


def _gain(tried: _Candidates, codes: list[int], sigma0: float) -> float:
    """Return what the last parameter takes off the squares; zero if too little or not known."""
    rows = np.isin(tried.code, codes)
    before = np.isin(tried.code, codes[:-1])
    covariance = np.linalg.inv(tried.matrix[np.ix_(rows, rows)])
    if (sigma0 * np.sqrt(covariance.diagonal()) * tried.effect[rows] > WEAK_PX).any():
        return 0.0
    gain = float(tried.pull[rows] @ covariance @ tried.pull[rows])
    if before.any():
        kept = np.linalg.solve(tried.matrix[np.ix_(before, before)], tried.pull[before])
        gain -= float(tried.pull[before] @ kept)
    gain /= max(sigma0, 1.0) ** 2
    return gain if gain > chdtri(int(rows.sum() - before.sum()), SURE) else 0.0


def _candidates(problem: Problem, now: Solution) -> _Candidates | None:
    """Return what is to be tried; None where there is nothing, or nothing can be solved."""
    lenses = problem.block.cameras.lenses or ()
    names = problem.unknowns.lens
    if any(lens.projection != "perspective" for lens in lenses):
        return None  # other projections have terms of their own that do the same
    more = tuple(name for name in TRIED if name not in names)
    wide, start = prepare(problem.block, replace(problem.unknowns, lens=names + more))
    wide.seen = problem.seen
    shared = np.zeros(wide.columns.total)
    is_tried = np.zeros(wide.columns.total, np.bool_)
    last = wide.columns.lens[-1]
    is_tried[:last] = np.isin(wide.columns.code, [CODES[name] for name in more])
    shared[~is_tried] = now.shared
    reduced = undamped(wide, replace(start, state=now.state, lenses=now.lenses, shared=shared))[0]
    matrix = reduced.matrix
    place = np.concatenate([np.zeros(len(wide.moves) - len(shared), np.bool_), is_tried])
    mine = place[reduced.active]
    if not mine.any():
        return None
    old = reduced._replace(matrix=matrix[~mine][:, ~mine])
    solve_for = solver(old)
    if solve_for is None:
        return None
    border = _dense(matrix[~mine][:, mine])
    taken = solve_for(np.column_stack([border, reduced.right[~mine]]))
    code = wide.columns.code[is_tried[:last]]
    group = np.searchsorted(wide.columns.lens, np.flatnonzero(is_tried), side="right") - 1
    effect = [
        effect_at_corner(_first_lens(wide, int(i)), int(c))
        for i, c in zip(group, code, strict=True)
    ]
    return _Candidates(
        code, np.array(effect), _dense(matrix[mine][:, mine]) - border.T @ taken[:, :-1],
        reduced.right[mine] - border.T @ taken[:, -1],
    )  # fmt: skip


def _dense(matrix: object) -> FloatArray:
    return np.asarray(matrix if isinstance(matrix, np.ndarray) else matrix.toarray())  # type: ignore[attr-defined]
