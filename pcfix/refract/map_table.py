"""Polynomials for the depth maps of a cell.

For two images that see a place on the bed, the depth at which their rays are nearest, the residual
there and its curvature are smooth functions of that place. So is the direction in which a partner
sees the bed, which decides whether its frame holds the place. In a cell they are replaced by cubic
polynomials, for each image and each of its partners. A correction of many points takes less than
half of the time.

The cells are fixed in the world: squares in plan, whose side is a power of two, by layers of the
apparent depth. So the polynomials of a point do not depend on the other points. They are fitted at
Chebyshev nodes and are off most at the corners of the cell, where they are tested; an image with
polynomials that are off too much is computed exactly. The water above the cell is a plane.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, cross, dot, minus, normal_of, row_of, scaled, unit
from pcfix.lens.frames import holds
from pcfix.model import BoolArray, FloatArray, IntArray, WaterPlane
from pcfix.refract.batch import Batch, Chosen, Images, images_of, to_original
from pcfix.refract.matcher import MATCHED, Matcher
from pcfix.refract.rays import direction, light_path
from pcfix.refract.tiling import cell_side

LEAST_POINTS = 60
"""Least points of a cell: its polynomials cost as much as so many points."""

TOLERANCE_PX = 0.02
"""Largest error of polynomials at the corners of a cell, in pixels of the image."""

USUAL = 0.7
"""Approximate ratio of apparent to true depth along a ray; the polynomials have the rest."""

DEEPEST, ASIDE = 1.9, 0.5
"""Largest depth of the bed, and distance from the apparent point in plan, in apparent depths."""

LAYER = 1.25
"""Ratio of the apparent depths of two layers."""
SHALLOWEST_M, SAME_PLANE = 0.05, 1e-6
"""Depth of the first layer's lower edge; metres of height, and of slope."""

CUBIC = 19
"""Terms of a polynomial; it has no w^3, as the height varies least."""

AWAY, RESIDUAL, CURVED, EACH = 0, 1, 2, 3
ALWAYS, NEVER, SOMETIMES = 1, 0, 2


def _powers(u: float, v: float, w: float) -> tuple[float, ...]:
    """Return the powers of coordinates, one for each term."""
    uu, uv, vv, ww = u * u, u * v, v * v, w * w
    return (
        1.0, u, v, w, uu, uv, u * w, vv, v * w, ww,
        uu * u, uu * v, uu * w, uv * v, uv * w, u * ww, vv * v, vv * w, v * ww,
    )  # fmt: skip


_FOUR, _THREE = np.cos(np.pi / 8.0 * np.arange(1, 8, 2)), np.sqrt(0.75) * np.arange(-1.0, 2.0)
NODES = np.array([*product(_FOUR, _FOUR, _THREE), *product((-1.0, 1.0), repeat=3)])
INSIDE = len(NODES) - 8
POWERS = np.array([_powers(*node) for node in NODES])
FIT = np.asarray(np.linalg.pinv(POWERS[:INSIDE]), np.float64)
"""The corners, which come last, are not fitted."""
_powers_of = device(forceinline=True)(_powers)


class Block(NamedTuple):
    """All points and cameras, the images of the original model, and the matcher, for kernels."""

    points: Chosen
    images: Images
    matcher: Matcher
    water: Vector  # a, b, c of the plane of the water, NaN if it is none
    cell_m: float


class Table(NamedTuple):
    """The polynomials of a cell; u, v, w go from -1 to 1 in its box."""

    middle: FloatArray  # (3,), of the box of the bed in x, y and the height over the water
    half: FloatArray  # (3,), metres
    place: IntArray  # (k,), the row of each image in `ways`, or -1; empty without polynomials
    terms: FloatArray  # (images, 5 x 19 x 3), for each partner: depth less the usual one, `meet`
    in_frame: IntArray  # (images, 5), whether the frame of each partner holds all, nothing or some
    ways: FloatArray  # (images and partners, 19 x 3), the direction in which each sees the bed
    steep: FloatArray  # (k,), change of the apparent depth with the bed, by the usual one


def block_of(batch: Batch) -> Block:
    """Return what the kernels take of a batch."""
    survey = batch.survey
    matcher, water = survey.learned.matcher, survey.water
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    plane = np.nan, np.nan, np.nan
    if isinstance(water, WaterPlane) and survey.own_water is None and not survey.settings.exact:
        plane = water.a, water.b, water.c
    images = images_of(batch.original_model, survey.cameras)
    return Block(batch.chosen(), images, matcher, plane, cell_side(batch))


def layers_of(batch: Batch) -> IntArray:
    """Return the layer of each point by its apparent depth, 0 for the shallowest."""
    depth = np.maximum(batch.surface.height_m - batch.xyz[:, 2], SHALLOWEST_M)
    return np.asarray(np.ceil(np.log(depth / SHALLOWEST_M) / np.log(LAYER))).astype(np.int64)


@device(allocates=True)
def no_table() -> Table:
    """Return a table without polynomials."""
    none = np.empty((0, 0))
    return Table(
        np.zeros(3), np.ones(3), np.empty(0, np.int64), none, np.empty((0, 0), np.int64), none,
        np.ones(1),
    )  # fmt: skip


@device(allocates=True)
def table_of(i: int, layer: int, seeing: BoolArray, block: Block) -> Table:
    """Fit the polynomials of the cell of point i for the images that may see its points."""
    matched, first = block.matcher.matched, np.flatnonzero(seeing)
    # the partners of these images are needed too
    involved = seeing.copy()
    for c in first:
        for j in matched[c]:
            if j >= 0:
                involved[j] = True
    # images that see points first, as only these get depths
    order = np.concatenate((first, np.flatnonzero(involved & ~seeing)))
    # the bed lies below the points of the cell and around it
    deep = SHALLOWEST_M * LAYER**layer
    shallow = deep / LAYER if layer > 0 else 0.02 * deep
    middle, half = np.empty(3), np.full(3, 0.5 * block.cell_m + ASIDE * deep)
    for axis in range(2):
        middle[axis] = (np.floor(block.points.xyz[i, axis] / block.cell_m) + 0.5) * block.cell_m
    middle[2], half[2] = -0.5 * (DEEPEST * deep + shallow), 0.5 * (DEEPEST * deep - shallow)
    place = np.full(seeing.size, -1)
    views, ways = np.empty((order.size, len(NODES), 4)), np.empty((order.size, CUBIC * 3))
    for at in range(order.size):
        place[order[at]] = at
        _see(views[at], order[at], middle, half, block)
        _fit(ways[at], views[at, :, :3])
    terms, values = np.empty((first.size, EACH * CUBIC * MATCHED)), np.empty((len(NODES), EACH))
    in_frame = np.zeros((first.size, MATCHED), np.int64)
    for at in range(first.size):
        if not _fit_image(terms[at], in_frame[at], values, views, first[at], place, block):
            terms[at, 0] = np.nan
    return Table(middle, half, place, terms, in_frame, ways, np.ones(seeing.size))


@device(forceinline=True)
def water_at(block: Block, x: float, y: float) -> float:
    """Return the height of the plane of the water at a place."""
    return block.water[0] + block.water[1] * x + block.water[2] * y


@device(forceinline=True)
def reads(block: Block, i: int) -> bool:
    """Whether the water above a point is that of the cells."""
    points, (_, b, c) = block.points, block.water
    off = points.height[i] - water_at(block, points.xyz[i, 0], points.xyz[i, 1])
    b, c = points.slope[i, 0] - b, points.slope[i, 1] - c
    return (abs(off) <= SAME_PLANE) & (abs(b) <= SAME_PLANE) & (abs(c) <= SAME_PLANE)


@device
def _see(view: FloatArray, c: int, middle: FloatArray, half: FloatArray, block: Block) -> None:
    """Write the directions of the nodes in an image of the original model, and the usual depths."""
    points, normal = block.points, normal_of(block.water[1], block.water[2])
    for k in range(len(NODES)):
        x, y = middle[0] + half[0] * NODES[k, 0], middle[1] + half[1] * NODES[k, 1]
        under = middle[2] + half[2] * NODES[k, 2]
        e = minus(row_of(points.centres, c), (x, y, water_at(block, x, y) + under))
        above = normal[2] * (points.offset[c] - under)
        path = light_path((0.0, 0.0, 0.0), e, normal, above, points.n)
        w = direction(path, normal)
        view[k, 0], view[k, 1], view[k, 2] = to_original(block.images, c, w)
        # the length of the ray in air, and the usual part of that in water
        view[k, 3] = np.sqrt(dot(w, w)) * (path[2] + USUAL * path[3])


@device
def _fit(terms: FloatArray, values: FloatArray) -> None:
    """Fit polynomials by least squares to three values at the nodes; write them term by term."""
    for j in range(CUBIC):
        for f in range(3):
            total = 0.0
            for k in range(INSIDE):
                total += FIT[j, k] * values[k, f]
            terms[3 * j + f] = total


@device
def _fit_image(
    terms: FloatArray, in_frame: IntArray, values: FloatArray, views: FloatArray, c: int,
    place: IntArray, block: Block,
) -> bool:  # fmt: skip
    """Write the polynomials of an image; return whether they are accurate enough."""
    partners, own, near = block.matcher.matched[c], views[place[c]], True
    centres = block.images.centres
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
        _fit(of_pair, values)
        if in_frame[p] != NEVER:
            near = near and _is_near(of_pair, values, own, block.matcher.focal_px[c])
    return near


@device(forceinline=True)
def meet(u: Vector, a: Vector, base: Vector, focal_px: float) -> Vector:
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
        away, residual, curved = values_of(terms, POWERS[k])
        off_px = abs(away - values[k, AWAY]) * focal_px / view[k, 3]
        near = near and max(off_px, abs(residual - values[k, RESIDUAL])) <= TOLERANCE_PX
        near = near and abs(curved - values[k, CURVED]) <= TOLERANCE_PX * values[k, CURVED]
    return near


@device(forceinline=True)
def has_terms(table: Table, c: int) -> bool:
    """Whether a table has the polynomials of an image; inaccurate ones are NaN."""
    at = table.place[c] if table.place.size else -1
    return bool(0 <= at < len(table.terms) and table.terms[at, 0] == table.terms[at, 0])


@device(forceinline=True)
def read_table(
    partners: FloatArray, powers: FloatArray, table: Table, c: int, place: Vector,
    usual_m: float, block: Block,
) -> int:  # fmt: skip
    """Write what the partners of an image see of a place on the bed; return how many see it.

    The depth beyond P (m), given the usual one, its squared residual (px^2) and half the curvature
    of that (px^2/m^2); see `depth_maps._compare`. Returns -1 for places outside the box.
    """
    x, y, z = place
    u, v = (x - table.middle[0]) / table.half[0], (y - table.middle[1]) / table.half[1]
    w = (z - water_at(block, x, y) - table.middle[2]) / table.half[2]
    if not (abs(u) <= 1.0 and abs(v) <= 1.0 and abs(w) <= 1.0):
        return -1
    terms = _powers_of(u, v, w)
    for j in range(CUBIC):
        powers[j] = terms[j]
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


@device(forceinline=True, fastmath={"reassoc", "contract"})
def values_of(terms: FloatArray, powers: FloatArray) -> Vector:
    """Return the values of three polynomials."""
    x, y, z = 0.0, 0.0, 0.0
    for t in range(CUBIC):
        x += powers[t] * terms[3 * t]
        y += powers[t] * terms[3 * t + 1]
        z += powers[t] * terms[3 * t + 2]
    return x, y, z
