"""Compute where stereo pairs place a point of the bed, exactly or by polynomials.

A pair of images intersects its two straight rays of the point. Coordinates are relative to an
apparent point P; each image has a row of numbers, its ray. See `pcfix.refract.stereo_pairs`.

The place of a pair, less the true place, is a smooth function of the true place. In a cell with
many points it is replaced by three polynomials for each pair (`pcfix.refract.cells`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, beyond, dot, minus, plus, row_of, scaled, solved, vector
from pcfix.lens.formulas import KIND, PERSPECTIVE
from pcfix.lens.imaging import image_in_world
from pcfix.model import FloatArray, IntArray
from pcfix.refract import cells
from pcfix.refract.batch import Chosen, Images, Optics, to_original
from pcfix.refract.cells import BASIS, CUBIC, FIT_CUBIC, INSIDE, NODES, Box
from pcfix.refract.map_table import TOLERANCE_PX, USUAL, bed_under, values_of
from pcfix.refract.rays import direction, light_path

# Columns of a ray: e, the height of its water over P, e of the original model, the gradient of its
# scale (g of `meet`), and of the image of Q G'G (xx, xy, xz, yy, yz, zz), G'G e, |G e|^2.
ABOVE, _ORIGINAL, _BY_PLACE, _SQUARE, _RIGHT, RAY_WIDTH = 3, 4, 7, 10, 16, 20


class PairImages(NamedTuple):
    """The images of the original model; `both` relates them to the adjusted ones; n."""

    optics: Optics
    both: Images
    n: float


@device
def begin(ray: FloatArray, points: Chosen, i: int, c: int, images: PairImages) -> None:
    """Fill in where a ray comes from, and how the scale of its image changes with the place.

    The scale depends on the distance, relative to that of P: along the axis in a perspective
    image, from the centre in other projections.
    """
    e = minus(row_of(points.centres, c), row_of(points.xyz, i))
    ray[ABOVE] = points.normals[i, 2] * (points.height[i] - points.xyz[i, 2] + points.offset[c])
    original, optics = e, images.optics
    if len(images.both.centres):
        original = minus(row_of(images.both.centres, c), row_of(points.original_xyz, i))
    axis, size2 = row_of(optics.rotations[c], 2), dot(original, original)
    ahead = -dot(axis, original)
    # behind a perspective camera the depth along the axis has no meaning
    flat = optics.lenses[optics.row[c], KIND] == PERSPECTIVE and ahead > 0.0
    for j in range(3):
        ray[j], ray[_ORIGINAL + j] = e[j], original[j]
        ray[_BY_PLACE + j] = axis[j] / ahead if flat else -original[j] / size2


@device
def see(ray: FloatArray, q: Vector, c: int, normal: Vector, images: PairImages) -> None:
    """Write the normal equations of the image of Q: G'G, G'G e and |G e|^2.

    The direction w, in the original model, is scaled to the distance of P, so that G is that there.
    """
    path = light_path(q, vector(ray), normal, ray[ABOVE], images.n)
    w = to_original(images.both, c, direction(path, normal))
    # g.w is the distance of w in terms of P
    w = scaled(1.0 / dot(w, vector(ray, _BY_PLACE)), w)
    optics, e = images.optics, vector(ray, _ORIGINAL)
    _, _, by_u, by_v = image_in_world(optics.lenses[optics.row[c]], optics.rotations[c], w)
    ray[_SQUARE:] = 0.0
    for g in (by_u, by_v):
        (x, y, z), off = g, dot(g, e)
        # one row g of G: g g', (g.e) g and (g.e)^2
        terms = (x * x, x * y, x * z, y * y, y * z, z * z, off * x, off * y, off * z, off * off)
        for i in range(10):
            ray[_SQUARE + i] += terms[i]


@device
def meet(a: FloatArray, b: FloatArray) -> Vector:
    """Return where two straight rays have the least squared residuals in their images.

    At X the residual of a camera is G (X - e) / t, with t = 1 + g.X the distance of X relative to
    that of P. The first round takes t = 1. The second has t, and its change with X: at the minimum

        sum_c G'G (X - e) / t^2 - r^2 / t^3 g = 0,    r^2 = |G (X - e)|^2

    That matters for narrow pairs whose rays pass each other.
    """
    # first t = 1, then with the t and r^2 of that place
    place = _solve_two(a, b, 1.0, 1.0, 0.0, 0.0)
    t, r2 = _residual(place, a)
    t_b, r2_b = _residual(place, b)
    return _solve_two(a, b, 1.0 / (t * t), 1.0 / (t_b * t_b), r2 / t**3, r2_b / t_b**3)


@device
def _residual(place: Vector, ray: FloatArray) -> tuple[float, float]:
    """Return t and r^2 of a place."""
    (x, y, z), s = place, ray[_SQUARE:]
    t = 1.0 + x * ray[_BY_PLACE] + y * ray[_BY_PLACE + 1] + z * ray[_BY_PLACE + 2]
    # |G (X - e)|^2 from the sums
    twice = x * (s[1] * y + s[2] * z) + s[4] * y * z - (s[6] * x + s[7] * y + s[8] * z)
    return t, s[0] * x * x + s[3] * y * y + s[5] * z * z + 2.0 * twice + s[9]


@device
def _solve_two(
    a: FloatArray, b: FloatArray, of_a: float, of_b: float, g_a: float, g_b: float
) -> Vector:
    """Solve the normal equations of two rays, with the weights and gradients of each."""
    right = beyond(_sum(a, b, of_a, of_b, _RIGHT), g_a, vector(a, _BY_PLACE))
    right = beyond(right, g_b, vector(b, _BY_PLACE))
    xx, xy, xz = _sum(a, b, of_a, of_b, _SQUARE)
    yy, yz, zz = _sum(a, b, of_a, of_b, _SQUARE + 3)
    return solved((xx, xy, xz, yy, yz, zz), right)[1]


@device
def _sum(a: FloatArray, b: FloatArray, of_a: float, of_b: float, at: int) -> Vector:
    """Return a weighted sum of three columns of two rays."""
    return plus(scaled(of_a, vector(a, at)), scaled(of_b, vector(b, at)))


LEAST_POINTS = 150
"""Least points of a cell: its polynomials cost about as much as so many points."""


class PairTable(NamedTuple):
    """The polynomials of a cell.

    Attributes
    ----------
    box : Box
        Of the bed.
    row : array, shape (k x partners,)
        The row of each image and partner in `terms`, or -1; empty without polynomials.
    terms : array, shape (pairs, 19 x 3)
        The place of the pair less the true place, metres.
    powers : array, shape (19,)
        Temporary.
    """

    box: Box
    row: IntArray
    terms: FloatArray
    powers: FloatArray


@device(allocates=True)
def no_pair_table() -> PairTable:
    """Return a table without polynomials."""
    return PairTable(cells.no_box(), np.empty(0, np.int64), np.empty((0, 0)), np.empty(CUBIC))


@device(allocates=True)
def pair_table_of(
    rows: IntArray, points: Chosen, images: PairImages, matched: IntArray, focal_px: FloatArray
) -> PairTable:
    """Fit the polynomials of all pairs of images that may see some points."""
    seeing, partners = np.flatnonzero(cells.counts_of(rows, points) > 0), matched.shape[1]
    place, row = np.full(len(points.centres), -1), np.full(len(points.centres) * partners, -1)
    place[seeing] = np.arange(seeing.size)
    box = bed_under(cells.box_of(rows, points))
    # each node of the bed is seen from an apparent point at its usual depth
    bed, apparent = cells.nodes_of(box, points), cells.nodes_of(box, points)
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
            for k in range(len(NODES)):
                met = plus(meet(rays[at, k], rays[place[j], k]), row_of(off, k))
                values[k, 0], values[k, 1], values[k, 2] = met
            cells.fit(terms[count], FIT_CUBIC, values)
            if _is_near(terms[count], values, rays[at], focal_px[c]):
                row[c * partners + p] = count
                count += 1
    return PairTable(box, row, terms, np.empty(CUBIC))


@device
def _is_near(terms: FloatArray, values: FloatArray, rays: FloatArray, focal_px: float) -> bool:
    """Whether polynomials are accurate at the corners, which were not fitted."""
    near = True
    for k in range(INSIDE, len(NODES)):
        lack = minus(values_of(terms, BASIS[k]), row_of(values, k))
        # a pixel of the image on the ground, squared
        pixel2 = dot(vector(rays[k]), vector(rays[k])) / (focal_px * focal_px)
        near = near and dot(lack, lack) <= TOLERANCE_PX * TOLERANCE_PX * pixel2
    return near


@device
def has_pairs(table: PairTable, points: Chosen, i: int, pairs: IntArray) -> bool:
    """Whether a table has all pairs of a point; their last column is the image and partner."""
    found = table.row.size > 0 and cells.is_under(points, i, table.box)
    for p in range(len(pairs) if found else 0):
        found = found and table.row[pairs[p, 2]] >= 0
    return found


@device
def read_pairs(
    places: FloatArray, q: Vector, point: Vector, pairs: IntArray, table: PairTable
) -> None:
    """Set where pairs place Q, relative to the apparent point; NaN outside the box of the table."""
    u, v, w = cells.in_box(table.box, plus(point, q))
    inside = abs(u) <= 1.0 and abs(v) <= 1.0 and abs(w) <= 1.0
    cells.set_powers(table.powers, (u, v, w))
    for p in range(len(pairs)):
        x, y, z = plus(q, values_of(table.terms[table.row[pairs[p, 2]]], table.powers))
        places[0, p], places[1, p], places[2, p] = x if inside else np.nan, y, z
