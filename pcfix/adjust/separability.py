"""What a block cannot tell apart, in words: correlations, weak unknowns, singular equations.

Water level, its tilt, the refractive index and the lens all move the bed, and over some blocks
alike (Mulsow 2024): then they cannot all be free.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.adjust.solve import similarity_gradients
from pcfix.adjust.undamped import undamped

if TYPE_CHECKING:
    from scipy.sparse import csc_array

    from pcfix.adjust.block import Unknowns
    from pcfix.adjust.precision import Precision
    from pcfix.adjust.solve import Problem, Solution
    from pcfix.model import FloatArray, IntArray

STRONG = 0.95
LIMITS = {
    "level": (0.02, "m", "the water level"),
    "tilt_x": (0.0005, "m/m", "the tilt of the water along x"),
    "tilt_y": (0.0005, "m/m", "the tilt of the water along y"),
    "index": (0.005, "", "the refractive index"),
    "scale": (0.001, "", "the scale of the block"),
}
"""Standard errors beyond which an unknown counts as undetermined, its unit and its name."""

NO_NEWS = 0.9
"""Share of a given standard deviation above which the images told nothing beyond it."""

WEAK = 1e-11
"""Eigenvalues of the matrix with unit diagonal, below which a motion costs nothing."""

_WORDS = {name: words for name, (_, _, words) in LIMITS.items()} | {
    "f": "the focal length", "cx": "the principal point's x", "cy": "the principal point's y",
    "b1": "the affinity b1", "b2": "the skew b2",
}  # fmt: skip
_MOTIONS = {"shift x", "shift y", "shift z", "turn x", "turn y", "turn z"}
_BED = {"level", "index", "tilt_x", "tilt_y"}
_BLOCK = (
    "the mean height of the projection centres",
    "the mean tilt of the projection centres along x",
    "the mean tilt of the projection centres along y",
)


def words_of(name: str) -> str:
    """Return what a surveyor calls a shared unknown."""
    base, _, sensor = name.partition(" of sensor ")
    words = _WORDS.get(base, base)
    if base in _MOTIONS:
        words = (
            f"the block's {base.replace('shift ', 'shift along ').replace('turn ', 'turn about ')}"
        )
    elif base[0] in "kp" and base[1:].isdigit():
        words = f"the distortion {base}"
    return f"{words} of sensor {sensor}" if sensor else words


def strong_correlations(precision: Precision, limit: float = STRONG) -> list[str]:
    """Return a sentence for each two unknowns that are hardly told apart, the strongest first.

    Pairs of k1, k2, ... are left out: they always are, and it harms nothing.
    """
    names = [row.name for row in precision.shared]
    found: list[tuple[float, str]] = []
    for i, name in enumerate(names):
        for j in range(i):
            r = float(precision.correlation[i, j])
            if abs(r) > limit and not (_is_radial(name) and _is_radial(names[j])):
                found.append((r, _pair(names[j], name, r)))
        for words, r in zip(_BLOCK, precision.block_correlation[i].tolist(), strict=True):
            # where poses move together, their shift is a shared unknown of its own
            if abs(r) > limit and not _moves_block(name):
                found.append((r, _with_block(name, words, r)))
    return [words for _, words in sorted(found, key=lambda row: -abs(row[0]))]


def _is_radial(name: str) -> bool:
    return name[0] == "k" and name[1:2].isdigit()


def _moves_block(name: str) -> bool:
    return name in _MOTIONS or name == "scale"


def _pair(a: str, b: str, r: float) -> str:
    first, second = words_of(a), words_of(b)
    if a in _BED and b in _BED:
        return f"{first} and {second} move the bed alike: r = {r:.3f}; fix one of them."
    if a in _BED or b in _BED:
        return (
            f"{first} and {second} are hardly told apart: r = {r:.3f}; fix one of them, or give"
            " control points at several heights."
        )
    return f"{first} and {second} do the same to the images: r = {r:.3f}; fix one of them."


def _with_block(name: str, motion: str, r: float) -> str:
    first = words_of(name)
    if name in _BED:
        remedy = "fix it, or give control points on land or better GNSS positions"
    else:
        remedy = "fix it, or give control points at several heights or obliques"
    return f"{first} and {motion} are hardly told apart: r = {r:.3f}; {remedy}."


def undetermined(precision: Precision, unknowns: Unknowns) -> list[str]:
    """Return a sentence for each unknown whose standard error is too large to be of use."""
    sigma = dict(zip(("level", "tilt_x", "tilt_y", "index"), unknowns.water_sigma, strict=True))
    given = sigma | unknowns.lens_sigma
    notes = []
    for row in precision.shared:
        limit, unit, _ = LIMITS.get(row.name, (math.inf, "", ""))
        prior = given.get(row.name.partition(" of ")[0], math.inf)
        space = f" {unit}" if unit else ""
        if row.sigma > limit:
            notes.append(
                f"{words_of(row.name)} is undetermined: its standard error of"
                f" {row.sigma:.2g}{space} exceeds {limit:g}{space}; fix it to a measured value."
            )
        elif prior < math.inf and row.sigma > NO_NEWS * prior:
            notes.append(
                f"{words_of(row.name)} is what was given: the images tell no more than its standard"
                f" deviation of {prior:g}{space}."
            )
    return notes


class _Motion(NamedTuple):
    """A motion of everything together that images alone cannot see."""

    words: str
    pose: FloatArray
    shared: dict[str, float]


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
    for motion in _motions(problem, solution):
        v = _vector(problem, motion)[reduced.active] / scale
        length = float(np.linalg.norm(v))
        if length > 0.0 and float(np.linalg.norm(free.T @ v)) > 0.99 * length:
            found.append(motion.words)
            v = left @ (left.T @ v)
            left = _without(left, v)
    parts = [_datum(found)] if found else []
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


def _motions(problem: Problem, solution: Solution) -> list[_Motion]:
    """Return shift, turn and scale of everything, the water with it where it is free.

    Turned and scaled about the place of the water at the block's origin, whose level stays. The
    normal of z = a + b x + c y turns with the rest, and with it the slopes.
    """
    state = solution.state
    k = len(state.centres)
    a, b, c, _ = state.water
    about = np.array([0.0, 0.0, a]) if problem.surface.there else problem.pivot
    by = np.zeros((k, 6, 7))
    by[:, :3, 3:6] = -state.rotations
    by[:, 3:] = similarity_gradients(state.centres - about)
    water: tuple[tuple[str, dict[str, float]], ...] = (
        ("along x", {"level": -b}), ("along y", {"level": -c}), ("in height", {"level": 1.0}),
        ("about x", {"tilt_x": b * c, "tilt_y": 1.0 + c * c}),
        ("about y", {"tilt_x": -1.0 - b * b, "tilt_y": -b * c}),
        ("about the vertical", {"tilt_x": -c, "tilt_y": b}), ("", {}),
    )  # fmt: skip
    kinds = ("shift",) * 3 + ("turn",) * 3 + ("scale",)
    return [
        _Motion(f"{kind} {way}".strip(), by[:, :, i], shared)
        for i, (kind, (way, shared)) in enumerate(zip(kinds, water, strict=True))
    ]


def _vector(problem: Problem, motion: _Motion) -> FloatArray:
    """Return a motion as a step of all unknowns."""
    k, names = len(problem.block.cameras), problem.names
    step = np.concatenate([motion.pose.ravel(), np.zeros(len(names))])
    for name, by in motion.shared.items():
        if name in names:
            step[6 * k + names.index(name)] = by
    step[: 6 * k][~problem.moves[: 6 * k]] = 0.0
    return step


def _datum(found: list[str]) -> str:
    return (
        f"nothing holds the {_listed(found)} of the block (no datum): give GNSS positions, three"
        " control points, or fix images, or ask for a free network"
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
        wet = " (no point lies under water)" if set(names) & _BED else ""
        parts.append(
            f"no observation depends on {_listed([words_of(name) for name in names])}{wet}: fix it"
        )
    return "; ".join(parts) + "."


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
