"""The reduced normal equations as a matrix: put together, solved, inverted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from scipy.sparse import csc_array

    from pcfix.adjust.normal import Sums
    from pcfix.model import BoolArray, FloatArray, IntArray

DENSE_UP_TO = 6000
"""Unknowns up to which a full matrix is quicker than a sparse one, and small (288 MB)."""


class Reduced(NamedTuple):
    """The system of the unknowns that are not points.

    matrix : dense array or scipy's sparse one, shape (a, a), of the active unknowns.
    right : shape (a,).
    active : rows, of poses and then of what is shared, that move.
    """

    matrix: FloatArray | csc_array
    right: FloatArray
    active: IntArray


def assemble(
    sums: Sums, pairs: IntArray, damping: float, extra: FloatArray, extra_right: FloatArray,
    moves: BoolArray,
) -> Reduced:  # fmt: skip
    """Put the blocks together.

    Parameters
    ----------
    sums : Sums
    pairs : array, shape (slots, 2)
        Of `pcfix.adjust.normal.pair_slots`.
    damping : float
        Factor on the diagonal before the points were eliminated, priors included.
    extra, extra_right : array, shape (u, u) or (u,), and (u,)
        What priors add to the matrix or to its diagonal, and to the right side.
    moves : array of bool, shape (u,)
        Which unknowns move.
    """
    k, g = sums.border.shape[0], sums.border.shape[2]
    size = 6 * k + g
    right = np.concatenate([sums.poses.ravel(), sums.shared]) + extra_right
    diagonal = np.concatenate([sums.diagonal.ravel(), sums.shared_diagonal])
    own = np.diag(extra) if extra.ndim == 2 else extra
    active = np.flatnonzero(moves)
    if size <= DENSE_UP_TO:
        matrix = np.zeros((size, size))
        blocks = matrix[: 6 * k, : 6 * k].reshape(k, 6, k, 6)
        blocks[pairs[:, 0], :, pairs[:, 1], :] = sums.blocks
        blocks[pairs[:, 1], :, pairs[:, 0], :] = sums.blocks.transpose(0, 2, 1)
        matrix[: 6 * k, 6 * k :] = sums.border.reshape(6 * k, g)
        matrix[6 * k :, : 6 * k] = matrix[: 6 * k, 6 * k :].T
        matrix[6 * k :, 6 * k :] = sums.corner
        if extra.ndim == 2:
            matrix += extra
        else:
            matrix[np.diag_indices(size)] += extra
        matrix[np.diag_indices(size)] += damping * (diagonal + own)
        return Reduced(matrix[np.ix_(active, active)], right[active], active)
    from scipy import sparse

    total = _sparse(sums, pairs, k, g)
    total += sparse.csc_array(extra) if extra.ndim == 2 else sparse.diags_array(extra)
    total += sparse.diags_array(damping * (diagonal + own))
    return Reduced(total.tocsc()[active][:, active], right[active], active)


def _sparse(sums: Sums, pairs: IntArray, k: int, g: int) -> Any:
    from scipy import sparse

    i, j = pairs[:, 0], pairs[:, 1]
    six = np.arange(6)
    rows = np.broadcast_to((6 * i)[:, None, None] + six[:, None], sums.blocks.shape)
    cols = np.broadcast_to((6 * j)[:, None, None] + six[None, :], sums.blocks.shape)
    off = i != j
    values = [sums.blocks.ravel(), sums.blocks[off].ravel()]
    r = [rows.ravel(), cols[off].ravel()]
    c = [cols.ravel(), rows[off].ravel()]
    body = sparse.coo_array(
        (np.concatenate(values), (np.concatenate(r), np.concatenate(c))), (6 * k, 6 * k)
    )
    if g == 0:
        return body.tocsc()
    border = sparse.csc_array(sums.border.reshape(6 * k, g))
    parts: Any = [[body, border], [border.T, sparse.csc_array(sums.corner)]]
    return sparse.block_array(parts).tocsc()


def solver(reduced: Reduced) -> Callable[[FloatArray], FloatArray] | None:
    """Return a function that solves for a right side; None where the matrix is not definite."""
    if reduced.matrix.shape[0] == 0:
        return lambda right: right
    scale = _scale(reduced.matrix.diagonal())
    if scale is None:
        return None
    solve = (
        _dense(reduced.matrix * scale * scale[:, None])
        if isinstance(reduced.matrix, np.ndarray)
        else _factored(reduced.matrix, scale)
    )
    if solve is None:
        return None
    return lambda right: (solve((right.T * scale).T).T * scale).T


def _dense(scaled: FloatArray) -> Callable[[FloatArray], FloatArray] | None:
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    try:
        factor = cho_factor(scaled, lower=True)
    except LinAlgError:
        return None
    return lambda right: np.asarray(cho_solve(factor, right))


def _factored(matrix: csc_array, scale: FloatArray) -> Callable[[FloatArray], FloatArray] | None:
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    scaled = diags_array(scale) @ matrix @ diags_array(scale)
    try:
        lu = splu(
            scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
    except RuntimeError:
        return None
    return lambda right: np.asarray(lu.solve(right))


def _scale(diagonal: FloatArray) -> FloatArray | None:
    """Return what makes the diagonal one; None where that cannot be."""
    if not (diagonal > 0.0).all():
        return None
    return np.asarray(1.0 / np.sqrt(diagonal))
