"""Where the stereo pairs of a cell place a point of the bed, as polynomials.

Where a pair of images intersects its straight rays, less the true place, depends on that place
alone, and smoothly. So it becomes three polynomials for each pair (`pcfix.refract.cells`), and the
median over many pairs costs their values, and not the way of the light to each image.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, dot, minus, plus, row_of, vector
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Chosen
from pcfix.refract.cells import (
    BASIS,
    CUBIC,
    FIT_CUBIC,
    INSIDE,
    NODES,
    Box,
    box_of,
    counts_of,
    fit,
    in_box,
    is_under,
    no_box,
    nodes_of,
    set_powers,
)
from pcfix.refract.map_table import TOLERANCE_PX, USUAL, bed_under, values_of
from pcfix.refract.pair_places import RAY_WIDTH, PairImages, begin, meet, see

LEAST_POINTS = 150
"""Of a cell: its polynomials cost about as much as so many points."""


class PairTable(NamedTuple):
    """The polynomials of a cell.

    Attributes
    ----------
    box : Box
        Of the bed.
    row : array, shape (k x partners,)
        The row of each image and partner in `terms`, or -1; none at all without polynomials.
    terms : array, shape (pairs, 19 x 3)
        How far from the true place the pair has it, metres.
    powers : array, shape (19,)
        Room.
    """

    box: Box
    row: IntArray
    terms: FloatArray
    powers: FloatArray


@device(allocates=True)
def no_pair_table() -> PairTable:
    """Return a table without polynomials."""
    return PairTable(no_box(), np.empty(0, np.int64), np.empty((0, 0)), np.empty(CUBIC))


@device(allocates=True)
def pair_table_of(
    rows: IntArray, points: Chosen, images: PairImages, matched: IntArray, focal_px: FloatArray
) -> PairTable:
    """Fit the polynomials of all pairs of images that may see some points."""
    seeing, partners = np.flatnonzero(counts_of(rows, points) > 0), matched.shape[1]
    place, row = np.full(len(points.centres), -1), np.full(len(points.centres) * partners, -1)
    place[seeing] = np.arange(seeing.size)
    box = bed_under(box_of(rows, points))
    bed, apparent = nodes_of(box, points), nodes_of(box, points)
    for k in range(len(NODES)):
        apparent.xyz[k, 2] += (1.0 - USUAL) * (bed.height[k] - bed.xyz[k, 2])
    rays = np.empty((seeing.size, len(NODES), RAY_WIDTH))
    for at in range(seeing.size):
        for k in range(len(NODES)):
            begin(rays[at, k], apparent, k, seeing[at], images)
            q = minus(row_of(bed.xyz, k), row_of(apparent.xyz, k))
            see(rays[at, k], q, seeing[at], row_of(bed.normals, k), images)
    terms, count = np.empty((seeing.size * partners, 3 * CUBIC)), 0
    values, off = np.empty((len(NODES), 3)), apparent.xyz - bed.xyz
    for at in range(seeing.size):
        c = seeing[at]
        for p in range(partners):
            j = matched[c, p]
            if j < 0 or place[j] < 0:
                continue
            _look(values, rays[at], rays[place[j]], off)
            fit(terms[count], FIT_CUBIC, values)
            if _is_near(terms[count], values, rays[at], focal_px[c]):
                row[c * partners + p] = count
                count += 1
    return PairTable(box, row, terms, np.empty(CUBIC))


@device
def _look(values: FloatArray, a: FloatArray, b: FloatArray, off: FloatArray) -> None:
    """Set how far from the nodes a pair has them, metres."""
    for k in range(len(NODES)):
        values[k, 0], values[k, 1], values[k, 2] = plus(meet(a[k], b[k]), row_of(off, k))


@device
def _is_near(terms: FloatArray, values: FloatArray, rays: FloatArray, focal_px: float) -> bool:
    """Whether polynomials are what they should be at the corners."""
    near = True
    for k in range(INSIDE, len(NODES)):
        lack = minus(values_of(terms, BASIS[k]), row_of(values, k))
        pixel2 = dot(vector(rays[k]), vector(rays[k])) / (focal_px * focal_px)
        near = near and dot(lack, lack) <= TOLERANCE_PX * TOLERANCE_PX * pixel2
    return near


@device
def has_pairs(table: PairTable, points: Chosen, i: int, pairs: IntArray) -> bool:
    """Whether a table has all pairs of a point, which are named in their last column."""
    found = table.row.size > 0 and is_under(points, i, table.box)
    for p in range(len(pairs) if found else 0):
        found = found and table.row[pairs[p, 2]] >= 0
    return found


@device
def read_pairs(
    places: FloatArray, q: Vector, point: Vector, pairs: IntArray, table: PairTable
) -> None:
    """Set where pairs place Q, relative to the apparent point; NaN beyond the table."""
    u, v, w = in_box(table.box, plus(point, q))
    inside = abs(u) <= 1.0 and abs(v) <= 1.0 and abs(w) <= 1.0
    set_powers(table.powers, (u, v, w))
    for p in range(len(pairs)):
        x, y, z = plus(q, values_of(table.terms[table.row[pairs[p, 2]]], table.powers))
        places[0, p], places[1, p], places[2, p] = x if inside else np.nan, y, z
