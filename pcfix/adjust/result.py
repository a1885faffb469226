"""What an adjustment found, ready for files, reports and further work."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from pcfix.adjust.block import WATER, Block, Unknowns
from pcfix.adjust.conditions import distances
from pcfix.adjust.gather import LEAST_VIEWS
from pcfix.adjust.normal import residuals
from pcfix.adjust.precision import Precision
from pcfix.adjust.problem import (
    LogRow,
    Problem,
    Solution,
    gnss_weights,
    port_of,
    prepare,
    solved_cameras,
    water_of,
)
from pcfix.adjust.solve import solve
from pcfix.model import BoolArray, Cameras, FloatArray, WaterSurface
from pcfix.port.shapes import Port
from pcfix.water.surface import surface_above

Source = Literal["tie points", "cloud"]
Role = Literal["control", "check"]


@dataclass(frozen=True)
class ControlRow:
    """A surveyed point: adjusted minus surveyed in metres, and its residuals in the images."""

    name: str
    role: Role
    dx_m: float
    dy_m: float
    dz_m: float
    rms_px: float
    images: int


class OnSurface(NamedTuple):
    """How marked points lie on a surface: which, how many, stated and found distances in metres."""

    surface: str
    points: int
    sigma_m: float
    rms_m: float
    largest_m: float
    largest_point: str


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A block after its adjustment.

    Attributes
    ----------
    block : Block
        What went in; its cameras are those before.
    unknowns : Unknowns
        What was free.
    cameras : Cameras
        Adjusted, in the same order and frame.
    water : WaterSurface or None
    refractive_index : float
    xyz : array, shape (m, 3)
        Adjusted true points, metres.
    residual_px : array, shape (o, 2)
        Measured minus computed; NaN where a camera does not image its point.
    used : array of bool, shape (o,)
        Observations that were not left out as outliers.
    is_wet : array of bool, shape (m,)
        Points that lie below the water; before a port all.
    sigma0 : float
        A-posteriori standard deviation of unit weight.
    redundancy : int
        Observations, those of the unknowns included, minus unknowns.
    rounds : list of LogRow
    source : {"tie points", "cloud"}
        What the observations are: measured, or images of the apparent cloud.
    engine : str
    precision : Precision or None
    gnss_residual_m : array, shape (k, 3)
        Adjusted projection centres minus GNSS positions; NaN where there is none.
    control : list of ControlRow
    notes : list of str
        What was decided and what a user should know.
    port : Port or None
        Adjusted.
    on_surfaces : list of OnSurface
        Of the points that shall lie on the water or on a plane.
    origin, numbers : array or None
        Where the block's frame has its origin, and `pcfix.adjust.block.State.water` there.
    """

    block: Block
    unknowns: Unknowns
    cameras: Cameras
    water: WaterSurface | None
    refractive_index: float
    xyz: FloatArray
    residual_px: FloatArray
    used: BoolArray
    is_wet: BoolArray
    sigma0: float
    redundancy: int
    rounds: list[LogRow]
    source: Source
    engine: str
    precision: Precision | None
    gnss_residual_m: FloatArray
    control: list[ControlRow]
    notes: list[str]
    port: Port | None = None
    on_surfaces: list[OnSurface] = field(default_factory=list)
    origin: FloatArray | None = None
    numbers: FloatArray | None = None

    def rms_px(self, points: BoolArray) -> float | None:
        """Return the root mean square residual of the used observations of some points."""
        r = self.residual_px[self.used & points[self.block.owner]]
        return float(np.sqrt(np.nanmean(r * r))) if len(r) else None

    def rms_m(self, points: BoolArray) -> float | None:
        """Return the same on the ground: residuals by distance over focal length."""
        rows = self.used & points[self.block.owner]
        if not rows.any():
            return None
        camera = self.block.camera[rows]
        away = self.xyz[self.block.owner[rows]] - self.cameras.centres[camera]
        focal = np.array([lens.focal for lens in self.cameras.lenses or ()])[camera]
        metres = self.residual_px[rows] * (np.linalg.norm(away, axis=1) / focal)[:, None]
        return float(np.sqrt(np.nanmean(metres * metres)))


def sigma0_of(problem: Problem, now: Solution) -> float:
    """Return the a-posteriori standard deviation of unit weight."""
    return float(np.sqrt(now.cost / max(redundancy_of(problem), 1)))


def redundancy_of(problem: Problem) -> int:
    """Return the number of observations, those of the unknowns included, minus unknowns."""
    block, seen = problem.block, problem.seen
    used = seen.weight > 0.0
    points = len(np.unique(block.owner[used]))
    priors = int((gnss_weights(block) > 0.0).sum() + (problem.priors.weight > 0.0).sum())
    sigma = [*problem.unknowns.lens_sigma.values(), *problem.unknowns.water_sigma]
    priors += sum(0.0 < value < np.inf for value in sigma)
    priors += len(np.intersect1d(np.flatnonzero(problem.on_surfaces.on >= 0), block.owner[used]))
    datum = 7 if problem.unknowns.free_network else 0
    return int(2 * used.sum() + priors + datum - 3 * points - problem.moves.sum())


def adjusted_of(
    problem: Problem, now: Solution, precision: Precision | None, notes: list[str],
    source: Source, engine: str,
) -> Adjusted:  # fmt: skip
    """Return what a solution says, with check points intersected."""
    block = problem.block
    state = now.state
    xyz = with_checks(problem, now, state.xyz + problem.origin)
    r = residuals(state._replace(xyz=xyz - problem.origin), problem.seen, problem.surface)
    water = water_of(problem, state)
    none = -np.inf if block.port is None else np.inf  # before a port all is under water
    level = np.full(len(xyz), none) if water is None else surface_above(water, xyz).height_m
    cameras = solved_cameras(problem, now)
    off = cameras.centres - block.gnss_xyz
    return Adjusted(
        block=block,
        unknowns=problem.unknowns,
        cameras=cameras,
        water=water,
        refractive_index=float(state.water[3]),
        xyz=xyz,
        residual_px=r,
        used=problem.seen.weight > 0.0,
        is_wet=np.asarray((xyz[:, 2] < level) & block.wet),
        sigma0=sigma0_of(problem, now),
        redundancy=redundancy_of(problem),
        rounds=now.log,
        source=source,
        engine=engine,
        precision=precision,
        gnss_residual_m=np.where(gnss_weights(block) > 0.0, off, np.nan),
        control=_control_rows(block, xyz, r),
        notes=notes,
        port=port_of(block, state.water),
        on_surfaces=_on_surfaces(problem, now),
        origin=problem.origin,
        numbers=state.water,
    )


def _on_surfaces(problem: Problem, now: Solution) -> list[OnSurface]:
    given, block = problem.block.conditions, problem.block
    if given is None:
        return []
    off = np.where(np.diff(block.start) > 0, distances(now.state, problem.given), np.nan)
    first, found = len(block.xyz) - len(block.control_names), []
    for number, name in enumerate((WATER, *given.names)):
        rows = np.flatnonzero((given.on == number) & np.isfinite(off))
        if len(rows):
            worst = rows[np.argmax(np.abs(off[rows]))]
            rms, sigma = (float(np.sqrt(np.mean(v[rows] ** 2))) for v in (off, given.sigma_m))
            label = block.control_names[worst - first]
            found.append(OnSurface(name, len(rows), sigma, rms, float(abs(off[worst])), label))
    return found


def with_checks(problem: Problem, now: Solution, xyz: FloatArray) -> FloatArray:
    """Return the points, those to check with intersected from the adjusted cameras."""
    block = problem.block
    rows = len(block.xyz) - len(block.control_names) + np.flatnonzero(block.is_check)
    rows = rows[np.diff(block.start)[rows] >= LEAST_VIEWS]
    if len(rows) == 0:
        return xyz
    whole = replace(
        block, cameras=solved_cameras(problem, now), xyz=xyz, water=water_of(problem, now.state),
        conditions=None, port=port_of(block, now.state.water),
        refractive_index=float(now.state.water[3]),
        sigma_px=np.where(np.isin(block.owner, rows), 1.0, np.inf),
    )  # fmt: skip
    part, start = prepare(whole, Unknowns(poses="fixed", lens=()))
    moved = xyz.copy()
    moved[rows] = solve(part, start).state.xyz[rows] + part.origin
    return moved


def _control_rows(block: Block, xyz: FloatArray, r: FloatArray) -> list[ControlRow]:
    first = len(block.xyz) - len(block.control_names)
    rows = []
    for p, (name, check) in enumerate(zip(block.control_names, block.is_check, strict=True), first):
        marks = r[block.start[p] : block.start[p + 1]]
        marks = marks[np.isfinite(marks).all(axis=1)]
        if (check and len(marks) < LEAST_VIEWS) or np.isnan(block.surveyed_xyz[p]).any():
            continue
        dx, dy, dz = (xyz[p] - block.surveyed_xyz[p]).tolist()
        rms = float(np.sqrt((marks * marks).mean())) if len(marks) else float("nan")
        rows.append(ControlRow(name, "check" if check else "control", dx, dy, dz, rms, len(marks)))
    return rows
