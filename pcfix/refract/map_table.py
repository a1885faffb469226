"""Polynomials for the depth maps of a cell.

For two images that see a place on the bed, the depth at which their rays are nearest, the residual
there and its curvature are smooth functions of that place. They are replaced by polynomials
(`pcfix.refract.cells`), for each image and each of its partners. So is the direction in which a
partner sees the bed, which decides whether its frame holds the place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, cross, dot, minus, normal_of, row_of, scaled, unit
from pcfix.lens.frames import holds
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract import cells
from pcfix.refract.batch import Batch, Chosen, Images, images_of, to_original
from pcfix.refract.cells import BASIS, CUBIC, FIT_CUBIC, INSIDE, LEAST_LENGTH_M, NODES, Box
from pcfix.refract.matcher import MATCHED, Matcher
from pcfix.refract.rays import direction, light_path

LEAST_POINTS = 60
"""Least points of a cell: its polynomials cost as much as so many points."""

TOLERANCE_PX = 0.02
"""Largest error of polynomials at the corners of a cell, in pixels of the image."""

USUAL = 0.7
"""Approximate ratio of apparent to true depth along a ray; the polynomials have the rest."""

DEEPEST = 1.9
ASIDE = 0.5
"""Largest depth of the bed, and distance from the apparent point in plan, in apparent depths."""

AWAY, RESIDUAL, CURVED, EACH = 0, 1, 2, 3
ALWAYS, NEVER, SOMETIMES = 1, 0, 2


class Block(NamedTuple):
    """All points and cameras, the images of the original model, and the matcher, for kernels."""

    points: Chosen
    images: Images
    matcher: Matcher


class Table(NamedTuple):
    """The polynomials of a cell.

    Attributes
    ----------
    box : Box
        Of the bed.
    place : array, shape (k,)
        The row of each image in `ways`, or -1; empty without polynomials.
    terms : array, shape (images, 5 x 19 x 3)
        Of the first images of `ways`, for each partner: the depth less the usual one (m), and the
        other two results of `meet`.
    in_frame : array, shape (images, 5)
        Whether the frame of each partner holds the whole cell, nothing, or a part of it.
    ways : array, shape (images and partners, 19 x 3)
        The direction in which each sees the bed.
    steep : array, shape (k,)
        Ratio of the change of the apparent depth in an image with the bed to the usual one.
    likely : array, shape (1,)
        Ratio of the depth of the last point to the likely one.
    """

    box: Box
    place: IntArray
    terms: FloatArray
    in_frame: IntArray
    ways: FloatArray
    steep: FloatArray
    likely: FloatArray


def block_of(batch: Batch) -> Block:
    """Return what the kernels take of a batch."""
    matcher = batch.survey.learned.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    return Block(batch.chosen(), images_of(batch.original_model, batch.survey.cameras), matcher)


@device(allocates=True)
def no_table() -> Table:
    """Return a table without polynomials."""
    none = np.empty((0, 0))
    return Table(
        cells.no_box(), np.empty(0, np.int64), none, np.empty((0, 0), np.int64), none, np.ones(1),
        np.ones(1),
    )  # fmt: skip


@device(allocates=True)
def table_of(rows: IntArray, seeing: BoolArray, block: Block) -> Table:
    """Fit the polynomials of some points, for the images that may see them."""
    matched, first = block.matcher.matched, np.flatnonzero(seeing)
    # the partners of these images are needed too
    involved = seeing.copy()
    for c in first:
        for j in matched[c]:
            if j >= 0:
                involved[j] = True
    # images that see points first, as only these get depths
    order = np.concatenate((first, np.flatnonzero(involved & ~seeing)))
    place, box = np.full(seeing.size, -1), bed_under(cells.box_of(rows, block.points))
    views = np.empty((order.size, len(NODES), 4))
    ways = np.empty((order.size, CUBIC * 3))
    for at in range(order.size):
        place[order[at]] = at
        _see(views[at], order[at], box, block)
        cells.fit(ways[at], FIT_CUBIC, views[at, :, :3])
    terms, values = np.empty((first.size, EACH * CUBIC * MATCHED)), np.empty((len(NODES), EACH))
    in_frame = np.zeros((first.size, MATCHED), np.int64)
    for at in range(first.size):
        if not _fit_image(terms[at], in_frame[at], values, views, first[at], place, block):
            terms[at, 0] = np.nan
    return Table(box, place, terms, in_frame, ways, np.zeros(seeing.size), np.ones(1))


@device(allocates=True)
def bed_under(box: Box) -> Box:
    """Return the box in which the bed of the points of a box lies."""
    # depths of the deepest and shallowest apparent point of the cell
    deep, shallow = box.half[2] - box.middle[2], -box.half[2] - box.middle[2]
    low, high = -DEEPEST * deep, -max(shallow, LEAST_LENGTH_M)
    middle, half = box.middle.copy(), box.half + ASIDE * deep
    middle[2], half[2] = 0.5 * (low + high), max(0.5 * (high - low), LEAST_LENGTH_M)
    return Box(middle, half, 1.0 / half, box.water)


@device
def _see(view: FloatArray, c: int, box: Box, block: Block) -> None:
    """Write the directions of the nodes in an image of the original model, and the usual depths."""
    points = block.points
    normal = normal_of(box.water[1], box.water[2])
    for k in range(len(NODES)):
        x = box.middle[0] + box.half[0] * NODES[k, 0]
        y = box.middle[1] + box.half[1] * NODES[k, 1]
        under = box.middle[2] + box.half[2] * NODES[k, 2]
        e = minus(row_of(points.centres, c), (x, y, cells.water_at(box, x, y) + under))
        above = normal[2] * (points.offset[c] - under)
        path = light_path((0.0, 0.0, 0.0), e, normal, above, points.n)
        w = direction(path, normal)
        view[k, 0], view[k, 1], view[k, 2] = to_original(block.images, c, w)
        # the length of the ray in air, and the usual part of that in water
        view[k, 3] = np.sqrt(dot(w, w)) * (path[2] + USUAL * path[3])


@device
def _fit_image(
    terms: FloatArray, in_frame: IntArray, values: FloatArray, views: FloatArray, c: int,
    place: IntArray, block: Block,
) -> bool:  # fmt: skip
    """Write the polynomials of an image; return whether they are accurate enough."""
    partners, own, near = block.matcher.matched[c], views[place[c]], True
    images = block.images
    centres = images.centres if len(images.centres) else block.points.centres
    for p in range(MATCHED):
        j = partners[p]
        if j < 0:
            continue
        view = views[place[j]]
        in_frame[p] = _has(view, j, block)
        base = minus(row_of(centres, c), row_of(centres, j))
        for k in range(len(NODES)):
            u, a = unit(row_of(own, k)), unit(row_of(view, k))
            away, residual, values[k, CURVED] = meet(u, a, base, block.matcher.focal_px[j])
            values[k, AWAY], values[k, RESIDUAL] = away - own[k, 3], residual
        of_pair = terms[EACH * CUBIC * p : EACH * CUBIC * (p + 1)]
        cells.fit(of_pair, FIT_CUBIC, values)
        if in_frame[p] != NEVER:
            near = near and _is_near(of_pair, values, own, block.matcher.focal_px[c])
    return near


@device
def meet(u: Vector, a: Vector, base: Vector, focal_px: float) -> tuple[float, float, float]:
    """Return where the ray u is nearest to the ray a, and the residual in the image of a.

    The distance from the centre of u, metres; the residual there, px, with a sign; half the
    curvature of its square, px^2/m^2. `base` leads from the centre of a to that of u.
    """
    across = cross(u, a)
    # squared sine and cosine of the angle between the rays
    sine2, along = dot(across, across), dot(u, a)
    away = (dot(base, a) * along - dot(base, u)) / sine2
    # pixels per metre at that place, as the image of a sees it
    scale = focal_px / (dot(base, a) + away * along)
    return away, scale * dot(base, across) / np.sqrt(sine2), scale * scale * sine2


@device
def _has(view: FloatArray, j: int, block: Block) -> int:
    """Return whether a frame holds all nodes, or none as they lie beyond one of its sides."""
    planes, all_in, none_in = block.matcher.inner.planes[j], True, False
    for k in range(len(NODES)):
        all_in = all_in and holds(block.matcher.inner, j, scaled(-1.0, row_of(view, k)))
    for side in range(4):
        beyond = 0
        for k in range(len(NODES)):
            beyond += dot(row_of(planes, side), row_of(view, k)) < 0.0
        none_in = none_in or beyond == len(NODES)
    if all_in:
        return ALWAYS
    return NEVER if none_in else SOMETIMES


@device
def _is_near(terms: FloatArray, values: FloatArray, view: FloatArray, focal_px: float) -> bool:
    """Whether polynomials are accurate at the corners, which were not fitted."""
    near = True
    for k in range(INSIDE, len(NODES)):
        away, residual, curved = values_of(terms, BASIS[k])
        off_px = abs(away - values[k, AWAY]) * focal_px / view[k, 3]
        near = near and max(off_px, abs(residual - values[k, RESIDUAL])) <= TOLERANCE_PX
        near = near and abs(curved - values[k, CURVED]) <= TOLERANCE_PX * values[k, CURVED]
    return near


@device
def has_terms(table: Table, c: int) -> bool:
    """Whether a table has the polynomials of an image; inaccurate ones are NaN."""
    at = table.place[c] if table.place.size else -1
    return bool(0 <= at < len(table.terms) and table.terms[at, 0] == table.terms[at, 0])


@device
def read_table(
    partners: FloatArray, powers: FloatArray, table: Table, c: int, place: Vector,
    usual_m: float, block: Block,
) -> int:  # fmt: skip
    """Write what the partners of an image see of a place on the bed; return how many see it.

    The depth beyond P (m), given the usual one, its squared residual (px^2) and half the curvature
    of that (px^2/m^2); see `depth_maps._compare`. Returns -1 for places outside the box.
    """
    u, v, w = cells.in_box(table.box, place)
    if not (abs(u) <= 1.0 and abs(v) <= 1.0 and abs(w) <= 1.0):
        return -1
    cells.set_powers(powers, (u, v, w))
    at, count = table.place[c], 0
    for p in range(MATCHED):
        state = table.in_frame[at, p]
        if state == NEVER:
            continue
        j = block.matcher.matched[c, p]
        if state == SOMETIMES:  # the border of the frame goes through the cell
            way = values_of(table.ways[table.place[j]], powers)
            if not holds(block.matcher.inner, j, scaled(-1.0, way)):
                continue
        away, residual, partners[count, 2] = values_of(table.terms[at, EACH * CUBIC * p :], powers)
        partners[count, 0], partners[count, 1] = usual_m + away, residual * residual
        count += 1
    return count


@device(fastmath={"reassoc", "contract"})
def values_of(terms: FloatArray, powers: FloatArray) -> Vector:
    """Return the values of three polynomials."""
    x, y, z = 0.0, 0.0, 0.0
    for t in range(CUBIC):
        x += powers[t] * terms[3 * t]
        y += powers[t] * terms[3 * t + 1]
        z += powers[t] * terms[3 * t + 2]
    return x, y, z


@device
def reads(table: Table, points: Chosen, i: int) -> bool:
    """Whether the water above a point is that of the table."""
    return table.place.size > 0 and cells.is_under(points, i, table.box)
