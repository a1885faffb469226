"""Undo the fusion of depth maps, where a list says of which images.

A fused map counts by its weight, that of the list or one by its squared distance. What was
averaged into it before (see `pcfix.refract.depth_maps`) shares that.
"""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot
from pcfix.lens.frames import holds
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract.batch import Batch, Intersection
from pcfix.refract.cells import cells_of, counts_of, is_quick
from pcfix.refract.depth_maps import (
    ABSENT,
    AVERAGED_WITHIN,
    COLUMNS,
    Lines,
    Room,
    Sight,
    balance,
    find_lines,
    intersection_of,
    likely_bed,
    made_up,
    room_for,
    settle_bed,
    sight_of,
)
from pcfix.refract.map_table import LEAST_POINTS, Block, Table, block_of, no_table, reads, table_of

_ROUNDS, _BEDS = 4, 3
FAR = 0.1
"""Of the way to the bed: farther off, it is asked anew which depths were averaged."""

LEAST_LIKELY, MOST_LIKELY = 0.7, 2.0
_OUTSIDE = -2


def invert_depth_maps(batch: Batch) -> Intersection:
    """Return the true points from which dense matching would have made the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its views are the images whose depth maps were fused, with their weights;
        `batch.survey.learned.matcher` says how they were matched.

    Notes
    -----
    The surface above each point is taken as a plane.
    """
    weights = batch.rays.weight
    result = np.zeros((len(batch.xyz), COLUMNS))
    given = np.zeros(0) if weights is None else weights.astype(np.float64)
    order, first = cells_of(batch)
    in_tiles(
        _invert, len(first) - 1, (order, first), block_of(batch), is_quick(batch), given, result,
        points=len(batch),
    )  # fmt: skip
    return intersection_of(batch, result)


@kernel(allocates=True)
def _invert(
    span: Span, cells: tuple[IntArray, IntArray], block: Block, quick: bool, weight: FloatArray,
    result: FloatArray,
) -> None:  # fmt: skip
    points, (order, first) = block.points, cells
    room, none = room_for(len(points.centres)), no_table()
    for cell in range(*span):
        rows = order[first[cell] : first[cell + 1]]
        fitted = none
        if quick and rows.size >= LEAST_POINTS:
            fitted = table_of(rows, _may_count(rows, block), block)
        for i in rows:
            begin, end = points.start[i], points.start[i + 1]
            given = weight[begin:end] if weight.size else weight
            table = fitted if reads(fitted, points, i) else none
            _invert_one(result[i], i, points.camera[begin:end], given, block, table, room)


@device(allocates=True)
def _may_count(rows: IntArray, block: Block) -> BoolArray:
    """Return which images, or their neighbours, are listed for some points."""
    listed = counts_of(rows, block.points) > 0
    with_neighbours = listed.copy()
    for c in np.flatnonzero(listed):
        for a in block.matcher.averaged[c]:
            if a >= 0:
                with_neighbours[a] = True
    return with_neighbours


@device
def _invert_one(
    row: FloatArray, i: int, listed: IntArray, given: FloatArray, block: Block, table: Table,
    room: Room,
) -> None:  # fmt: skip
    sight, averaged = sight_of(block.points, i), block.matcher.averaged
    maps = room.found[: _with_neighbours(room.found, room.place, listed, sight, block)]
    t, slope = room.t[: maps.size], room.slope[: maps.size]
    counts, own = room.weight[: maps.size], room.own[: listed.size]
    for k in range(listed.size):
        made = made_up(sight, block, listed[k])
        own[k] = given[k] if given.size else 1.0 / dot(made, made)
    likely, step = likely_bed(sight, block), 0.0
    bed = likely * table.likely[0]
    for _ in range(_BEDS):
        bed += step
        find_lines(Lines(bed, t, slope), maps, sight, block, table, room)
        step = 0.0
        for _ in range(_ROUNDS):
            for q in range(maps.size):
                room.now[q] = t[q] + slope[q] * step
            _share(counts, listed, own, room.now, averaged, room.place)
            step = balance(t, slope, counts)
        if not abs(step) > FAR * abs(bed):
            break
    settle_bed(row, maps, counts, Lines(bed, t, slope), sight, block, table, room)
    if table.place.size:
        table.likely[0] = min(max(row[2] / likely, LEAST_LIKELY), MOST_LIKELY)
    for q in maps:
        room.place[q] = ABSENT
    for c in listed:
        for a in averaged[c]:
            if a >= 0:
                room.place[a] = ABSENT


@device
def _with_neighbours(
    found: IntArray, place: IntArray, listed: IntArray, sight: Sight, block: Block
) -> int:
    """Gather the listed images and those in frame that their depths were averaged with.

    Returns how many they are. `place` says where each image is among them.
    """
    count, matcher = 0, block.matcher
    for c in listed:
        if place[c] < 0:
            place[c], found[count] = count, c
            count += 1
        for a in matcher.averaged[c]:
            if a < 0:
                break
            if place[a] == ABSENT:
                place[a] = _OUTSIDE
                if holds(matcher.inner, a, made_up(sight, block, a)):
                    place[a], found[count] = count, a
                    count += 1
    return count


@device
def _share(
    counts: FloatArray, listed: IntArray, own: FloatArray, now: FloatArray, averaged: IntArray,
    place: IntArray,
) -> None:  # fmt: skip
    """Set what each depth map counts for in the point, with their depths as they are now."""
    counts[:] = 0.0
    for k in range(listed.size):
        at, members = place[listed[k]], 1.0
        for a in averaged[listed[k]]:
            members += _averages(at, a, now, place)
        counts[at] += own[k] / members
        for a in averaged[listed[k]]:
            if _averages(at, a, now, place):
                counts[place[a]] += own[k] / members


@device
def _averages(own: int, a: int, now: FloatArray, place: IntArray) -> bool:
    """Whether a depth is averaged with that of image a: both show the place, nearly alike."""
    if a < 0 or place[a] < 0:
        return False
    return bool(abs(now[place[a]] - now[own]) < AVERAGED_WITHIN)
