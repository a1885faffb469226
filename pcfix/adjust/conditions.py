"""Conditions between unknowns: points that lie on the water or on a plane, and parallel planes.

Mulsow 2024 names the membership of a point to a surface and the parallelism of planes. The first
is one more observation of a point: its distance from the surface, along the axis that is nearest to
the normal (z of the water), is zero within a standard deviation. The surface itself may be unknown:
the water as far as it is free, a plane always. Parallel planes have the same two slopes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import (
    ON_NOTHING,
    PLANES,
    SHAPE,
    WATER,
    WATER_NAMES,
    Block,
    Given,
    OnSurfaces,
    State,
)
from pcfix.adjust.curved import height_of
from pcfix.adjust.observe import POINT
from pcfix.errors import GeometryError
from pcfix.kernels import device, kernel
from pcfix.model import FloatArray
from pcfix.refract.rays import plane_at


@device
def condition(
    state: State, given: Given, p: int, own: FloatArray, shared: FloatArray, r: FloatArray
) -> bool:
    """Fill in the row of a point that lies on a surface; whether it lies on one.

    As `pcfix.adjust.normal.linearise`: the weighted residual and its Jacobians, in the first of two
    rows.
    """
    rows, surface, q, numbers = given.on_surfaces, given.surface, state.xyz[p], state.water
    if rows.on.size == 0 or rows.on[p] < 0:
        return False
    number, weight = rows.on[p], rows.weight[p]
    up = rows.axis[number]
    x, y = q[(up + 1) % 3], q[(up + 2) % 3]
    at = 0 if number == 0 else PLANES + 3 * (number - 1)
    if number > 0:
        b, c = numbers[at + 1], numbers[at + 2]
        z = numbers[at] + b * x + c * y
    elif surface.field is None and surface.tin is None:
        z, b, c = height_of(numbers, x, y)
    else:
        z, b, c = plane_at(surface.tin, surface.field, x, y, surface.origin)
        z += numbers[0]
    if np.isnan(z):
        return False
    own[:], shared[:], r[1] = 0.0, 0.0, 0.0
    r[0] = weight * (z - q[up])
    own[0, POINT + up] = weight
    own[0, POINT + (up + 1) % 3], own[0, POINT + (up + 2) % 3] = -weight * b, -weight * c
    columns, by = given.columns.water, (1.0, x, y)
    for i in range(3):
        if columns[at + i] >= 0:
            shared[0, columns[at + i]] -= weight * by[i]
    by = (x * x, x * y, y * y)
    for i in range(3):
        if number == 0 and columns[SHAPE + i] >= 0:
            shared[0, columns[SHAPE + i]] -= weight * by[i]
    return True


@kernel(allocates=True)
def distances(state: State, given: Given) -> FloatArray:
    """Return surface minus point, shape (m,), metres along the axis of the surface.

    NaN for points on none.
    """
    own, shared, r = np.zeros((2, POINT + 3)), np.zeros((2, given.columns.total)), np.zeros(2)
    off = np.full(len(state.xyz), np.nan)
    for p in range(len(off)):
        if condition(state, given, p, own, shared, r):
            off[p] = r[0] / given.on_surfaces.weight[p]
    return off


class Planes(NamedTuple):
    """Planes at the start.

    numbers : height and slopes of each, one after the other, block frame.
    rows : which points lie on which, and along which axis these have their heights.
    names : of the numbers, as `WATER_NAMES`.
    alike : of numbers that are those of another, counted from the first of `WATER_NAMES`.
    """

    numbers: list[float]
    rows: OnSurfaces
    names: list[str]
    alike: dict[int, int]


def planes_of(block: Block, origin: FloatArray, water: FloatArray) -> Planes:
    """Return the planes of a block, each fitted to the start values of its points.

    Parameters
    ----------
    water : array, shape (11,)
        The numbers of `WATER_NAMES`.

    Raises
    ------
    GeometryError
        If so few points lie on parallel planes that they say nothing, or a plane that shall be
        parallel to the water is steep.
    """
    given = block.conditions
    if given is None:
        return Planes([], ON_NOTHING, [], {})
    xyz, counts = block.xyz - origin, np.diff(block.start) > 0
    bundles = [tuple(given.parallel)] if given.parallel else []
    bundles += [(name,) for name in given.names if name not in given.parallel]
    numbers, axes = np.zeros((len(given.names), 3)), np.full(1 + len(given.names), 2)
    alike: dict[int, int] = {}
    for bundle in bundles:
        rows = [given.names.index(name) for name in bundle if name != WATER]
        on = [xyz[(given.on == row + 1) & counts] for row in rows]
        normal = np.array([-water[1], -water[2], 1.0])
        if WATER not in bundle:
            _check_enough(bundle, sum(map(len, on)))
            apart = np.vstack([points - points.mean(axis=0) for points in on])
            normal = np.linalg.svd(apart, full_matrices=False)[2][-1]
        up = int(np.abs(normal).argmax())
        slopes = -normal[[(up + 1) % 3, (up + 2) % 3]] / normal[up]
        first = 0 if WATER in bundle else PLANES + 3 * rows[0]
        for row, points in zip(rows, on, strict=True):
            middle = points.mean(axis=0) if len(points) else np.zeros(3)
            height = middle[up] - slopes @ middle[[(up + 1) % 3, (up + 2) % 3]]
            numbers[row], axes[1 + row] = [height, *slopes], up
            if PLANES + 3 * row != first:
                alike |= {PLANES + 3 * row + i: first + i for i in (1, 2)}
    weight = np.where(given.on >= 0, 1.0 / given.sigma_m, 0.0)
    names = [f"{word} of {name}" for name in given.names for word in WATER_NAMES[:3]]
    rows_of = OnSurfaces(np.asarray(given.on, np.int64), weight, axes.astype(np.int64))
    return Planes(numbers.ravel().tolist(), rows_of, names, alike)


def _check_enough(bundle: tuple[str, ...], count: int) -> None:
    least = len(bundle) + 3
    if count < least:
        planes = f"plane {bundle[0]}" if len(bundle) == 1 else f"planes {', '.join(bundle)}"
        raise GeometryError(
            f"{planes}: {count} points lie there, which says nothing, as any such points do; mark"
            f" {least} at least."
        )
