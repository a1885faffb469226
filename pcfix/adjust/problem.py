"""A block as a problem to solve: what is measured, what moves, what is known beforehand.

The datum and all other prior knowledge enter as observations of the unknowns: GNSS positions,
surveyed points, standard deviations of lens, water and index.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import (
    CODES,
    INDEX,
    LEAST_SQUARES,
    MOTIONS,
    NAMES,
    PORT,
    SHAPE,
    WATER_NAMES,
    Block,
    Columns,
    Given,
    Loss,
    OnSurfaces,
    PointPriors,
    Seen,
    State,
    Surface,
    Unknowns,
    columns_of,
    sensor_groups,
    usable_codes,
)
from pcfix.adjust.conditions import distances, planes_of
from pcfix.adjust.normal import cost_of, pair_slots, point_steps, residuals
from pcfix.errors import GeometryError
from pcfix.lens.imaging import lens_table
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    IntArray,
    Lens,
    WaterMesh,
    WaterPlane,
    WaterRaster,
    WaterSurface,
)
from pcfix.port.light import coefficients as port_coefficients
from pcfix.port.shapes import DomePort, FlatPort, Port
from pcfix.water.surface import build_field, build_tin

NETWORK_SIGMA_M = 1e-4
"""How tightly the mean of the projection centres is held in a free network."""


class LogRow(NamedTuple):
    """One step: which round, what it came to, and the damping."""

    round: int
    step: int
    cost: float
    damping: float
    observations: int
    rms_px: float

    def __str__(self) -> str:
        return (
            f"round {self.round}, step {self.step}, {self.observations:,} observations,"
            f" {self.rms_px:.3f} px"
        )


Progress = Callable[[LogRow], None]
"""What is called after each step."""


@dataclass(eq=False)
class Problem:
    """A block with everything that stays as it is while it is solved."""

    block: Block
    unknowns: Unknowns
    origin: FloatArray
    seen: Seen
    surface: Surface
    columns: Columns
    groups: list[list[int]]
    codes: list[tuple[int, ...]]
    slots: tuple[IntArray, IntArray]
    priors: PointPriors
    moves: BoolArray
    on_surfaces: OnSurfaces
    numbers: tuple[str, ...]

    @property
    def given(self) -> Given:
        """What the kernels take of it."""
        return Given(self.seen, self.surface, self.columns, self.priors, self.on_surfaces)

    @property
    def names(self) -> list[str]:
        """What each of the shared unknowns is."""
        names = [
            NAMES[code] if len(self.groups) == 1 else f"{NAMES[code]} of sensor {i}"
            for i, codes in enumerate(self.codes, start=1)
            for code in codes
        ]
        by_column = dict(zip(self.columns.water[::-1].tolist(), self.numbers[::-1], strict=True))
        names += [by_column[at] for at in sorted(by_column) if at >= 0]
        return names + list(MOTIONS if self.columns.similarity >= 0 else ())


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a problem came to rest.

    state : relative to `Problem.origin`; lenses : k of them.
    shared : shape (g,), what was added to the shared unknowns.
    cost : sum of weighted squares, priors included.
    """

    state: State
    lenses: tuple[Lens, ...]
    shared: FloatArray
    cost: float
    log: list[LogRow]


def prepare(
    block: Block, unknowns: Unknowns, origin: FloatArray | None = None
) -> tuple[Problem, Solution]:
    """Return a problem and its start; the origin of its frame is the middle of the cameras.

    Raises
    ------
    GeometryError
        If cameras lack angles or lenses, or the water's tilt is to move over a mesh or raster.
    """
    cameras = block.cameras
    if cameras.rotations is None or cameras.lenses is None:
        raise GeometryError("an adjustment needs cameras with angles and lenses.")
    origin = np.round(cameras.centres.mean(axis=0)) if origin is None else origin
    group, groups = sensor_groups(cameras.lenses)
    codes = [usable_codes(cameras.lenses[images[0]], unknowns.lens) for images in groups]
    plane = isinstance(block.water, WaterPlane) or block.water is None
    if (unknowns.tilt_sigma or unknowns.shape_sigma) and not plane:
        what = "tilt" if unknowns.tilt_sigma else "shape"
        raise GeometryError(f"the {what} of the water can be free for a level or plane only.")
    water = _water_numbers(block, origin)
    planes = planes_of(block, origin, water)
    free = [sigma != 0.0 for sigma in unknowns.water_sigma]
    free += [len(WATER_NAMES) + i not in planes.alike for i in range(len(planes.numbers))]
    centres = cameras.centres - origin
    columns = columns_of(
        codes, free, unknowns.poses == "similarity", centres.mean(axis=0), planes.alike
    )
    row, table = lens_table(cameras.lenses)
    seen = Seen(
        np.ascontiguousarray(block.start, np.int64),
        np.ascontiguousarray(block.camera, np.int64),
        np.ascontiguousarray(block.image_xy, np.float64),
        1.0 / np.asarray(block.sigma_px, np.float64),
        np.ascontiguousarray(block.wet, np.bool_),
        row.astype(np.int64),
        group,
    )
    state = State(
        centres, np.ascontiguousarray(cameras.rotations, np.float64), table,
        block.xyz - origin, np.concatenate([water, planes.numbers]),
    )  # fmt: skip
    problem = Problem(
        block, unknowns, origin, seen, _surface(block, origin, unknowns), columns, groups, codes,
        pair_slots(seen, len(cameras)), _point_priors(block, origin),
        _moves(block, unknowns, columns), planes.rows, (*WATER_NAMES, *planes.names),
    )  # fmt: skip
    start = Solution(state, cameras.lenses, np.zeros(columns.total), np.inf, [])
    return problem, start


def _water_numbers(block: Block, origin: FloatArray) -> FloatArray:
    water, numbers = block.water, np.zeros(len(WATER_NAMES))
    numbers[INDEX] = block.refractive_index
    if isinstance(water, WaterPlane):
        a, b, c = water.a, water.b, water.c
        numbers[:3] = a + (b * origin[0] + c * origin[1]) - origin[2], b, c
    match block.port:
        case FlatPort(distance):
            numbers[PORT] = distance
        case DomePort(centre_m=centre):
            numbers[PORT + 1 :] = centre
    return numbers


def port_of(block: Block, numbers: FloatArray) -> Port | None:
    """Return the port of a block with the numbers of a state."""
    match block.port:
        case FlatPort():
            return replace(block.port, distance_m=float(numbers[PORT]))
        case DomePort():
            x, y, z = numbers[PORT + 1 : PORT + 4].tolist()
            return replace(block.port, centre_m=(x, y, z))
    return None


def water_of(problem: Problem, state: State) -> WaterSurface | None:
    """Return the water surface as it was found, world frame."""
    water, origin = problem.block.water, problem.origin
    level, b, c = (float(value) for value in state.water[:3])
    match water:
        case WaterPlane() if problem.surface.curved:
            return _curved_raster(problem, state)
        case WaterPlane():
            return WaterPlane(level + origin[2] - (b * origin[0] + c * origin[1]), b, c)
        case WaterRaster() if level:
            return replace(water, height_m=water.height_m + level)
        case WaterMesh() if level:
            return replace(water, vertices=water.vertices + np.array([0.0, 0.0, level]))
        case _:
            return water


CELLS = 400
"""Along the longer side of a raster of curved water: a bend of 10 cm in all is met within 1 um."""
MARGIN = 0.2
"""Of the block's extent, by which the raster goes beyond it."""


def _curved_raster(problem: Problem, state: State) -> WaterRaster:
    """Return water of the second order as a raster over all images and points."""
    known = state.xyz[np.isfinite(state.xyz).all(axis=1)]
    places = np.vstack([state.centres[:, :2], known[:, :2]])
    low, high = places.min(axis=0), places.max(axis=0)
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    cell = float((high - low).max()) / CELLS
    columns, rows = np.maximum(np.ceil((high - low) / cell).astype(int), 2)
    x, y = low[0] + cell * (np.arange(columns) + 0.5), high[1] - cell * (np.arange(rows) + 0.5)
    height = polynomial(state.water, x[None, :], y[:, None]) + problem.origin[2]
    left, top = float(problem.origin[0] + low[0]), float(problem.origin[1] + high[1])
    return WaterRaster(height, left, top, (cell, cell), "water of second order")


def polynomial(water: FloatArray, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
    """Return the height of the water's numbers at places, block frame."""
    (a, b, c), (d, e, f) = water[:3], water[SHAPE:PORT] if len(water) > SHAPE else (0.0, 0.0, 0.0)
    return np.asarray(a + b * x + c * y + d * x * x + e * x * y + f * y * y)


def _surface(block: Block, origin: FloatArray, unknowns: Unknowns) -> Surface:
    water = block.water
    return Surface(
        water is not None,
        build_tin(water) if isinstance(water, WaterMesh) else None,
        build_field(water) if isinstance(water, WaterRaster) else None,
        origin,
        np.zeros(0) if block.port is None else port_coefficients(block.port),
        unknowns.shape_sigma != 0.0,
    )


def _point_priors(block: Block, origin: FloatArray) -> PointPriors:
    weight = _weights(block.surveyed_xyz, block.surveyed_sigma_m)
    return PointPriors(np.where(weight > 0.0, block.surveyed_xyz - origin, 0.0), weight)


def _moves(block: Block, unknowns: Unknowns, columns: Columns) -> BoolArray:
    labels, fixed = block.cameras.labels, set(unknowns.fixed_images)
    poses = [unknowns.poses == "free" and label not in fixed for label in labels]
    return np.concatenate([np.repeat(poses, 6), np.ones(columns.total, bool)])


class Priors(NamedTuple):
    """What priors add: cost, to the matrix or its diagonal, and to the right side."""

    cost: float
    matrix: FloatArray
    right: FloatArray


def gnss_weights(block: Block) -> FloatArray:
    """Return inverse variances of the GNSS positions, shape (k, 3); zero where there is none."""
    return _weights(block.gnss_xyz, block.gnss_sigma_m)


def _weights(values: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return inverse variances; zero where value or standard deviation is not known."""
    known = np.isfinite(values) & np.isfinite(sigma)
    return np.where(known, 1.0 / np.where(known, sigma, 1.0) ** 2, 0.0)


def priors_at(problem: Problem, found: Solution) -> Priors:
    """Return what the priors of poses, lens and water say at a state."""
    block, columns, unknowns = problem.block, problem.columns, problem.unknowns
    k, g = len(block.cameras), columns.total
    diagonal, right = np.zeros(6 * k + g), np.zeros(6 * k + g)
    weight = gnss_weights(block)
    off = np.where(weight > 0.0, block.gnss_xyz - problem.origin - found.state.centres, 0.0)
    cost = float((weight * off * off).sum())
    tight = _weights(found.shared, _shared_sigma(problem))
    cost += float((tight * found.shared**2).sum())
    diagonal[6 * k :] = tight
    right[6 * k :] = -tight * found.shared
    poses = np.column_stack([np.zeros((k, 3)), weight])
    if columns.similarity < 0:
        diagonal[: 6 * k] = poses.ravel()
        right[: 6 * k] = np.column_stack([np.zeros((k, 3)), weight * off]).ravel()
        if unknowns.free_network:
            return _with_network(problem, found, Priors(cost, diagonal, right))
        return Priors(cost, diagonal, right)
    matrix = np.diag(diagonal)
    by = similarity_gradients(found.state.centres - columns.pivot)
    at = 6 * k + columns.similarity
    matrix[at:, at:] += np.einsum("kia,ki,kib->ab", by, weight, by)
    right[at:] += np.einsum("kia,ki->a", by, weight * off)
    return Priors(cost, matrix, right)


def similarity_gradients(d: FloatArray) -> FloatArray:
    """Return how places move with a shift, a turn and a scale about the pivot, shape (k, 3, 7)."""
    by = np.zeros((len(d), 3, 7))
    by[:, [0, 1, 2], [0, 1, 2]] = 1.0
    x, y, z = d.T
    by[:, 0, 4], by[:, 0, 5] = z, -y
    by[:, 1, 3], by[:, 1, 5] = -z, x
    by[:, 2, 3], by[:, 2, 4] = y, -x
    by[:, :, 6] = d
    return by


def pose_gradients(state: State, pivot: FloatArray) -> FloatArray:
    """Return how poses, turn and centre, move with the same, shape (k, 6, 7)."""
    by = np.zeros((len(state.centres), 6, 7))
    by[:, :3, 3:6] = -state.rotations
    by[:, 3:] = similarity_gradients(state.centres - pivot)
    return by


def _with_network(problem: Problem, found: Solution, extra: Priors) -> Priors:
    """Hold mean place, direction and scale of the projection centres."""
    start = problem.block.cameras.centres - problem.origin
    k = len(start)
    d = start - start.mean(axis=0)
    by = similarity_gradients(d) / np.array([1.0] * 3 + [np.sqrt((d * d).sum() / k)] * 4)
    rows = np.zeros((7, len(extra.right)))
    rows[:, : 6 * k].reshape(7, k, 6)[:, :, 3:] = by.transpose(2, 0, 1) / k
    rows = rows[_undetermined(problem)]
    off = rows[:, : 6 * k].reshape(len(rows), k, 6)[:, :, 3:]
    miss = np.einsum("akj,kj->a", off, found.state.centres - start)
    weight = 1.0 / NETWORK_SIGMA_M**2
    return Priors(
        extra.cost + weight * float((miss * miss).sum()),
        np.diag(extra.matrix) + weight * rows.T @ rows,
        extra.right - weight * rows.T @ miss,
    )


def _undetermined(problem: Problem) -> list[int]:
    """Return which of shift, turn and scale nothing in the images tells.

    A water surface whose level or tilt does not move freely tells the height or tilt of the block.
    """
    unknowns = problem.unknowns
    bends = problem.block.refractive_index != 1.0 or unknowns.index_sigma > 0.0
    if not (problem.surface.there and bends and problem.block.wet.any()):
        return list(range(7))
    level = [2] if np.isinf(unknowns.level_sigma_m) else []
    tilt = [3, 4] if np.isinf(unknowns.tilt_sigma) else []
    return [0, 1, *level, *tilt, 5, 6]


def _shared_sigma(problem: Problem) -> FloatArray:
    """Return the standard deviations of the shared unknowns about their start."""
    unknowns = problem.unknowns
    given = {CODES[name]: value for name, value in unknowns.lens_sigma.items()}
    lens = [given.get(int(code), np.inf) for code in problem.columns.code]
    water = [sigma for sigma in unknowns.water_sigma if sigma]
    rest = problem.columns.total - len(lens) - len(water)
    return np.array([*lens, *water, *([np.inf] * rest)], np.float64)


def cost_at(problem: Problem, found: Solution, loss: Loss) -> float:
    """Return what a solution costs: images, surveyed points and all priors."""
    counts = problem.seen.weight > 0.0
    r = residuals(found.state, problem.seen, problem.surface)[counts]
    images = cost_of((r**2).sum(axis=1) * problem.seen.weight[counts] ** 2, loss)
    return images + survey_cost(problem, found) + priors_at(problem, found).cost


def survey_cost(problem: Problem, found: Solution) -> float:
    """Return the weighted squares by which surveyed points were moved, or lie off their surface."""
    priors, rows = problem.priors, problem.on_surfaces
    cost = float((priors.weight * (priors.xyz - found.state.xyz) ** 2).sum())
    if not len(rows.on):
        return cost
    off = distances(found.state, problem.given)
    return cost + float(np.nansum((rows.weight * off) ** 2))


def counts_of(problem: Problem, found: Solution) -> tuple[int, float]:
    """Return how many observations count, and the root mean square of their residuals."""
    counts = problem.seen.weight > 0.0
    r = residuals(found.state, problem.seen, problem.surface)[counts]
    n = int(counts.sum())
    return n, float(np.sqrt(np.nansum(r * r) / max(2 * n, 1)))


def solved_cameras(problem: Problem, found: Solution) -> Cameras:
    """Return the cameras of a solution, world frame."""
    return replace(
        problem.block.cameras,
        centres=found.state.centres + problem.origin,
        rotations=found.state.rotations,
        lenses=found.lenses,
    )


STEPS = 10
CLOSE_M = 1e-4


class Intersected(NamedTuple):
    """Points and how well they fit their images.

    xyz : shape (m, 3), metres, world frame.
    residual_px : shape (o, 2), measured minus computed; NaN where the intersection failed.
    start : shape (m + 1,), the residuals of point i are ``start[i]:start[i + 1]``.
    """

    xyz: FloatArray
    residual_px: FloatArray
    start: IntArray

    @property
    def redundancy(self) -> IntArray:
        """Measured coordinates minus the three of the point, shape (m,)."""
        return np.asarray(2 * np.diff(self.start) - 3)

    def sums(self, values: FloatArray) -> FloatArray:
        """Return sums over the observations of each point, shape (m,)."""
        owner = np.repeat(np.arange(len(self.xyz)), np.diff(self.start))
        return np.asarray(np.bincount(owner, values, len(self.xyz)), np.float64)

    @property
    def squares(self) -> FloatArray:
        """Sum of squared residuals of each point, px2, shape (m,)."""
        return self.sums((self.residual_px**2).sum(axis=1))


def intersect_fixed(block: Block) -> Intersected:
    """Return the points of a block by least squares, poses, lens and water as they are.

    A point that takes more than `STEPS` steps of Gauss and Newton has failed.
    """
    problem, now = prepare(replace(block, conditions=None), Unknowns(poses="fixed", lens=()))
    nothing = np.zeros(len(problem.moves))
    state, step = now.state, np.full((len(block.xyz), 3), np.inf)
    for _ in range(STEPS):
        step = point_steps(state, problem.given, LEAST_SQUARES, 0.0, nothing)
        state = state._replace(xyz=state.xyz + step)
        if np.nanmax(np.abs(step), initial=0.0) < CLOSE_M:
            break
    r = residuals(state, problem.seen, problem.surface)
    settled = (np.abs(step) < CLOSE_M).all(axis=1)
    r[~settled[block.owner]] = np.nan
    return Intersected(state.xyz + problem.origin, r, np.asarray(block.start))
