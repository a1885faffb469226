"""An adjustment as a least squares problem: observations, unknowns and prior knowledge.

The datum and all other prior knowledge enter as observations of the unknowns: GNSS positions,
surveyed points, standard deviations of lens, water and index.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcfix.adjust.block import WATER, Block
from pcfix.adjust.collinearity import SHARED, Given, State
from pcfix.adjust.normal import UNDAMPED, cost_of, linearised, point_steps, residuals
from pcfix.adjust.parameters import (
    INDEX,
    NAMES,
    PLANES,
    PORT,
    SHAPE,
    WATER_NAMES,
    Unknowns,
    effect_at_corner,
    lens_parameter,
    sensor_groups,
    similarity_gradients,
    usable_codes,
)
from pcfix.errors import GeometryError
from pcfix.lens.formulas import lens_table
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
from pcfix.port.housing import DomePort, FlatPort, Port, window_of
from pcfix.water.surface import build_fields, build_tin

NETWORK_SIGMA_M = 1e-4  # standard deviation of the mean of the projection centres in a free network
CELLS = 400  # of a raster of curved water, along its longer side, which represents 10 cm to 1 um
MARGIN = 0.2  # by which that raster exceeds the block, as a share of its extent


@dataclass(frozen=True, eq=False)
class Problem:
    """A block prepared for the solver."""

    block: Block
    unknowns: Unknowns
    origin: FloatArray  # (3,), of the coordinates in `given` and in states
    given: Given  # what the kernels need
    lens_unknowns: list[tuple[int, int]]  # of each the first image of its sensor, and the code
    names: list[str]  # of the g shared unknowns
    start_values: FloatArray  # (g,), heights in the world frame

    @property
    def fixed(self) -> int:
        """Number of fixed pose parameters, the first of all 6 k + g: all or none."""
        return 6 * len(self.block.cameras) if self.unknowns.poses == "fixed" else 0

    @property
    def used(self) -> BoolArray:
        """Observations that count, shape (o,)."""
        return np.asarray(self.given.weight > 0.0)

    @property
    def of_ties(self) -> BoolArray:
        """Observations of tie points, shape (o,)."""
        return np.asarray(self.block.owner < self.block.tie_points)

    @property
    def lens_effects(self) -> FloatArray:
        """Image movement at the corner of the frame per unit of each lens unknown."""
        lenses = self.block.cameras.lenses or ()
        return np.array([effect_at_corner(lenses[i], code) for i, code in self.lens_unknowns])

    def weighted(self, weight: FloatArray) -> "Problem":
        """Return the problem with other weights of its observations."""
        return replace(self, given=self.given._replace(weight=weight))


@dataclass(frozen=True, eq=False)
class Solution:
    """State of a problem after some steps."""

    state: State
    lenses: tuple[Lens, ...]  # of the k cameras
    shared: FloatArray  # (g,), corrections of the shared unknowns
    cost: float = np.inf  # sum of weighted squares, including prior knowledge


def prepare(block: Block, unknowns: Unknowns) -> tuple[Problem, Solution]:
    """Return a problem and its start."""
    cameras, water, lenses = block.cameras, block.water, block.cameras.lenses or ()
    origin = np.round(cameras.centres.mean(axis=0))
    group = sensor_groups(lenses)
    first_images = np.unique(group, return_index=True)[1].tolist()
    codes = [usable_codes(lenses[i], unknowns.lens) for i in first_images]
    lens_unknowns = [(i, code) for i, of in zip(first_images, codes, strict=True) for code in of]
    numbers = surface_numbers(block, origin)
    planes, plane_names, axis, alike = _planes(block, origin, numbers)
    # columns of the shared unknowns: lenses, then surface and planes
    first_lens = np.concatenate([[0], np.cumsum([len(one) for one in codes])]).astype(np.int64)
    is_free = [sigma != 0.0 for sigma in unknowns.water_sigma]
    is_free += [len(WATER_NAMES) + i not in alike for i in range(len(planes))]
    column = np.full(len(is_free), -1, np.int64)
    column[is_free] = first_lens[-1] + np.arange(sum(is_free))
    for number, other in alike.items():
        column[number] = column[other]
    names = [
        NAMES[code] if len(codes) == 1 else f"{NAMES[code]} of sensor {group[i] + 1}"
        for i, code in lens_unknowns
    ]
    names += [name for name, one in zip((*WATER_NAMES, *plane_names), is_free, strict=True) if one]
    numbers = np.concatenate([numbers, planes])
    world = numbers.copy()  # the level, and the position of each plane along its axis
    world[[0, *range(PLANES, len(numbers), 3)]] += origin[axis]
    start_values = [lens_parameter(lenses[i], code) for i, code in lens_unknowns]
    row, table = lens_table(lenses)
    surveyed_xyz, surveyed_weight = block.survey
    _, on, on_sigma_m = block.surfaces
    given = Given(
        start=np.ascontiguousarray(block.start, np.int64),
        camera=np.ascontiguousarray(block.camera, np.int64),
        image_xy=np.ascontiguousarray(block.image_xy, np.float64),
        weight=1.0 / np.asarray(block.sigma_px, np.float64),
        wet=np.ascontiguousarray(block.wet & (water is not None), np.bool_),
        lens_row=row.astype(np.int64),
        group=group,
        tin=build_tin(water) if isinstance(water, WaterMesh) else None,
        field=build_fields({}, 1, water) if isinstance(water, WaterRaster) else None,
        origin=origin,
        curved=bool(unknowns.surface.get("shape")),
        first_lens=first_lens,
        code=np.array([code for _, code in lens_unknowns], np.int64),
        column=column,
        shared=len(names),
        surveyed_xyz=surveyed_xyz - origin,
        surveyed_weight=surveyed_weight,
        on=on,
        on_weight=np.where(on >= 0, 1.0 / on_sigma_m, 0.0),
        axis=axis,
        tests=np.zeros((0, 2, SHARED + len(names))),
    )
    values = np.append(start_values, world[is_free])
    problem = Problem(block, unknowns, origin, given, lens_unknowns, names, values)
    state = State(
        cameras.centres - origin, np.ascontiguousarray(cameras.rotations, np.float64), table,
        block.xyz - origin, numbers, window_of(block.port),
    )  # fmt: skip
    return problem, Solution(state, lenses, np.zeros(len(names)))


def surface_numbers(block: Block, origin: FloatArray) -> FloatArray:
    """Return the start values of `WATER_NAMES`, shape (11,)."""
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


def _planes(
    block: Block, origin: FloatArray, water: FloatArray
) -> tuple[list[float], list[str], IntArray, dict[int, int]]:
    """Fit the planes of a block to the start values of their points.

    Parallel planes share two slopes, those of the water if that is one of them.

    Returns their numbers (height and two slopes), names, main axes, and which numbers are the same
    unknown as another one, counted from the first of `WATER_NAMES`.
    """
    planes, on_surface, _ = block.surfaces
    xyz, seen = block.xyz - origin, np.diff(block.start) > 0
    bundles = [block.parallel] if block.parallel else []
    bundles += [(name,) for name in planes if name not in block.parallel]
    numbers = np.zeros((len(planes), 3))
    axis, alike = np.full(1 + len(planes), 2, np.int64), dict[int, int]()
    for bundle in bundles:
        rows = [planes.index(name) for name in bundle if name != WATER]
        on = [xyz[(on_surface == row + 1) & seen] for row in rows]
        normal = np.array([-water[1], -water[2], 1.0])
        if WATER not in bundle:
            # any three points lie on a plane: one more is needed to say anything
            count, least = sum(map(len, on)), len(bundle) + 3
            if count < least:
                words = (
                    f"Plane {', '.join(bundle)}: {count} points are on it, at least {least} are"
                    " needed. Mark more points."
                )
                raise GeometryError("gcps.few_on_plane", words, plane=", ".join(bundle))
            offsets = np.vstack([points - points.mean(axis=0) for points in on])
            normal = np.linalg.svd(offsets, full_matrices=False)[2][-1]
        up = int(np.abs(normal).argmax())
        x, y = (up + 1) % 3, (up + 2) % 3
        slopes = -normal[[x, y]] / normal[up]
        first = 0 if WATER in bundle else PLANES + 3 * rows[0]
        for row, points in zip(rows, on, strict=True):
            middle = points.mean(axis=0) if len(points) else np.zeros(3)
            numbers[row], axis[1 + row] = [middle[up] - slopes @ middle[[x, y]], *slopes], up
            if PLANES + 3 * row != first:
                alike |= {PLANES + 3 * row + i: first + i for i in (1, 2)}
    names = [f"{word} of {name}" for name in planes for word in WATER_NAMES[:3]]
    return numbers.ravel().tolist(), names, axis, alike


# What was found


def solved_cameras(problem: Problem, found: Solution) -> Cameras:
    """Return the cameras of a solution, world frame."""
    return replace(
        problem.block.cameras,
        centres=found.state.centres + problem.origin,
        rotations=found.state.rotations,
        lenses=found.lenses,
    )


def port_of(block: Block, numbers: FloatArray) -> Port | None:
    """Return the port of a block with the parameters of a state."""
    match block.port:
        case FlatPort():
            return replace(block.port, distance_m=float(numbers[PORT]))
        case DomePort():
            x, y, z = numbers[PORT + 1 : PORT + 4].tolist()
            return replace(block.port, centre_m=(x, y, z))
    return None


def water_of(problem: Problem, state: State) -> WaterSurface | None:
    """Return the water surface of a state, world frame."""
    water, origin = problem.block.water, problem.origin
    if not isinstance(water, WaterPlane):
        return water
    if not problem.given.curved:
        level, b, c = (float(value) for value in state.water[:3])
        return WaterPlane(level + origin[2] - (b * origin[0] + c * origin[1]), b, c)
    # water of the second order as a raster over all images and points
    known = state.xyz[np.isfinite(state.xyz).all(axis=1)]
    places = np.vstack([state.centres[:, :2], known[:, :2]])
    low, high = places.min(axis=0), places.max(axis=0)
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    cell = float((high - low).max()) / CELLS
    columns, rows = np.maximum(np.ceil((high - low) / cell).astype(int), 2)
    x, y = low[0] + cell * (np.arange(columns) + 0.5), high[1] - cell * (np.arange(rows) + 0.5)
    height = polynomial(state.water, x[None, :], y[:, None]) + origin[2]
    left, top = float(origin[0] + low[0]), float(origin[1] + high[1])
    return WaterRaster(height, left, top, (cell, cell), "water of second order")


def polynomial(water: FloatArray, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
    """Return the height of the water at x, y, block frame."""
    (a, b, c), (d, e, f) = water[:3], water[SHAPE:PORT]
    return np.asarray(a + b * x + c * y + d * x * x + e * x * y + f * y * y)


# Prior knowledge


def prior_rows(problem: Problem, found: Solution) -> tuple[Any, FloatArray]:
    """Return prior knowledge of poses, lens and water as weighted observations of them.

    These are the derivatives by poses and shared unknowns, a sparse array of shape (n, 6 k + g),
    and observed minus current values, shape (n,), both over the standard deviations.
    """
    from scipy import sparse

    given, block = problem.given, problem.block
    k, size = len(block.cameras), 6 * len(block.cameras) + given.shared
    # GNSS positions of the centres, and unknowns of the surface about their start
    root = np.sqrt(block.gnss_weights)
    camera, axis = np.nonzero(root)
    sigma = np.array([one for one in problem.unknowns.water_sigma if one])
    free = given.column[: len(WATER_NAMES)]
    free, sigma = free[free >= 0][np.isfinite(sigma)], sigma[np.isfinite(sigma)]
    column = np.concatenate([6 * camera + 3 + axis, 6 * k + free])
    weight = np.concatenate([root[camera, axis], 1.0 / sigma])
    centres = (block.gnss.xyz - problem.origin - found.state.centres)[camera, axis]
    left = weight * np.concatenate([centres, -found.shared[free]])
    rows = sparse.csc_array((weight, (np.arange(len(column)), column)), (len(column), size))
    if not problem.unknowns.free_network:
        return rows, left
    # mean, direction and scale of the centres of a free network
    start = block.cameras.centres - problem.origin
    d = start - start.mean(axis=0)
    by = similarity_gradients(d) / np.array([1.0] * 3 + [np.sqrt((d * d).sum() / k)] * 4)
    # water whose level or tilt is fixed determines height or tilt of the block
    known, surface = np.zeros(7, np.bool_), problem.unknowns.surface
    if given.wet.any() and (block.refractive_index != 1.0 or surface.get("index", 0.0) > 0.0):
        known[2], known[3:5] = surface.get("level") != np.inf, surface.get("tilt") != np.inf
    by = by[:, :, ~known] / k / NETWORK_SIGMA_M
    held = np.zeros((by.shape[2], size))
    held[:, : 6 * k].reshape(-1, k, 6)[:, :, 3:] = by.transpose(2, 0, 1)
    moved = np.einsum("kja,kj->a", by, found.state.centres - start)
    return sparse.vstack([rows, sparse.csc_array(held)], format="csc"), np.append(left, -moved)


def cost_at(problem: Problem, found: Solution, loss: int) -> float:
    """Return the cost of a solution: images, surveyed points and all prior knowledge."""
    return cost_of(found.state, problem.given, loss) + survey_cost(problem, found)


def survey_cost(problem: Problem, found: Solution) -> float:
    """Return the weighted squares of all observations that are no images."""
    given, state, left = problem.given, found.state, prior_rows(problem, found)[1]
    cost = (given.surveyed_weight * (given.surveyed_xyz - state.xyz) ** 2).sum() + left @ left
    if len(given.on):  # distances from surfaces; zero for points that their rays do not fix
        rows = linearised(state, given, UNDAMPED, problem.block.tie_points, len(state.xyz))
        cost += (rows.r[~rows.is_image] ** 2).sum()
    return float(cost)


# Intersection with fixed poses


STEPS = 10
CLOSE_M = 1e-4


def intersect_fixed(block: Block) -> tuple[FloatArray, FloatArray]:
    """Intersect the points of a block by least squares, with fixed poses, lens and water.

    Returns the points, shape (m, 3), metres, world frame, and their residuals, measured minus
    computed, shape (o, 2). Both are NaN for points that need more than `STEPS` Gauss-Newton steps.
    """
    problem, start = prepare(block, Unknowns(poses="fixed", lens=()))
    state, step = intersected(problem, start.state)
    xyz, residual_px = state.xyz + problem.origin, residuals(state, problem.given)
    failed = np.asarray(~(np.abs(step) < CLOSE_M).all(axis=1))
    xyz[failed], residual_px[failed[block.owner]] = np.nan, np.nan
    return xyz, residual_px


def intersected(problem: Problem, state: State) -> tuple[State, FloatArray]:
    """Return a state with its points intersected, and the last step of each, shape (m, 3)."""
    # surfaces have no weight here: the points shall show how well they fit
    given = problem.given._replace(on=np.zeros(0, np.int64))
    fixed, step = np.zeros(6 * len(state.centres) + given.shared), np.zeros_like(state.xyz)
    for _ in range(STEPS):
        step = point_steps(state, given, UNDAMPED, fixed)
        state = state._replace(xyz=state.xyz + step)
        if np.nanmax(np.abs(step), initial=0.0) < CLOSE_M:
            break
    return state, step
