"""Tracks of tie points as view lists: the images in which the nearest tie point was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.views.lists import RawList

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import FloatArray, IntArray, TiePoints


def read(path: Path, tie_points: TiePoints) -> RawList:
    """Return the tie points that have a position, each camera once.

    Raises
    ------
    InputError
        If there are none.
    """
    rows = np.flatnonzero(np.isfinite(tie_points.xyz).all(axis=1))
    if rows.size == 0:
        raise InputError(f"{path}: has no tie points with positions; give another view list.")
    views = tie_points.views.take(rows)
    start, image = _once(views.start, views.camera)
    return RawList(
        path, "tie points", start, image.astype(np.int32), None, _positions(tie_points, rows)
    )


def _positions(tie_points: TiePoints, rows: IntArray) -> FloatArray:
    return np.ascontiguousarray(tie_points.xyz[rows], np.float64)


def _once(start: IntArray, camera: IntArray) -> tuple[IntArray, IntArray]:
    """Drop a camera that a list names again, as tracks sometimes do, and sort the others."""
    row = np.repeat(np.arange(len(start) - 1), np.diff(start))
    pairs = np.unique(np.column_stack([row, camera]), axis=0)
    counts = np.bincount(pairs[:, 0], minlength=len(start) - 1)
    return np.concatenate([[0], np.cumsum(counts)]), pairs[:, 1]
