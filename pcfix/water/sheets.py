"""Whether a mesh is one sheet: a height field has one height above each place."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray, IntArray
    from pcfix.water.tin import Tin

APART_M = 0.01
"""Facets that overlap are of no harm where their heights differ by less."""
_EDGE = 1e-9  # of a barycentric coordinate: an edge belongs to both sides
_AT_ONCE = 200_000


def in_two_sheets(tin: Tin) -> tuple[BoolArray, FloatArray]:
    """Return which facets have another above or below their centre, and all plan areas, m2."""
    centres = tin.corners.mean(axis=1)
    column, row = (centres // tin.cell_m).astype(np.int64).T
    cell = row * tin.columns + column
    double = np.zeros(len(centres), np.bool_)
    for first in range(0, len(centres), _AT_ONCE):
        facet = np.arange(first, min(first + _AT_ONCE, len(centres)))
        double[facet] = _meet_others(tin, facet, centres[facet], cell[facet])
    edge1, edge2 = tin.corners[:, 1] - tin.corners[:, 0], tin.corners[:, 2] - tin.corners[:, 0]
    area_m2 = np.abs(edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]) / 2.0
    return double, area_m2


def _meet_others(tin: Tin, facet: IntArray, centres: FloatArray, cell: IntArray) -> BoolArray:
    """Return which facets' centres lie in another facet of another height."""
    counts = tin.cell_start[cell + 1] - tin.cell_start[cell]
    mine = np.repeat(np.arange(len(facet)), counts)
    within = np.arange(len(mine)) - np.repeat(np.cumsum(counts) - counts, counts)
    other = tin.cell_facet[tin.cell_start[cell][mine] + within]
    place = centres[mine]
    planes = tin.planes[other] - tin.planes[facet[mine]]
    apart_m = np.abs(planes[:, 0] + (planes[:, 1:] * place).sum(axis=1))
    hit = (apart_m > APART_M) & _holds(tin.corners[other], place)
    return np.bincount(mine[hit], minlength=len(facet)) > 0


def _holds(corners: FloatArray, place: FloatArray) -> BoolArray:
    """Whether each place lies in its triangle."""
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    px, py = (place - corners[:, 0]).T
    area = ax * by - ay * bx
    s, t = (px * by - py * bx) / area, (ax * py - ay * px) / area
    return np.asarray((s >= -_EDGE) & (t >= -_EDGE) & (s + t <= 1.0 + _EDGE))
