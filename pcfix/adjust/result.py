"""The result of an adjustment, as arrays and as the plain values of ``adjustment.json``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import (
    INDEX,
    LEAST_VIEWS,
    NAMES,
    PORT,
    WATER,
    WATER_NAMES,
    Block,
    Unknowns,
    lens_parameter,
    sensor_groups,
    usable_codes,
)
from pcfix.adjust.normal import residuals
from pcfix.adjust.precision import Precision, correlated, undetermined
from pcfix.adjust.problem import (
    LogRow,
    Problem,
    Solution,
    intersect_fixed,
    port_of,
    prepare,
    solved_cameras,
    surface_distances,
    water_of,
)
from pcfix.adjust.solve import solve
from pcfix.errors import PcfixWarning
from pcfix.model import BoolArray, Cameras, FloatArray, WaterPlane, WaterSurface
from pcfix.port.shapes import Port, spec_of
from pcfix.water.surface import surface_above

Source = Literal["tie points", "cloud"]
Plain = dict[str, Any]

MOST_DEPTH_BINS = 8


@dataclass(frozen=True)
class ControlRow:
    """A surveyed point: adjusted minus surveyed in metres, and its residuals in the images."""

    name: str
    role: Literal["control", "check"]
    dx_m: float
    dy_m: float
    dz_m: float
    rms_px: float
    images: int


class OnSurface(NamedTuple):
    """Marked points on a surface: how many, their stated and found distances in metres."""

    surface: str
    points: int
    sigma_m: float
    rms_m: float
    largest_m: float
    largest_point: str


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjusted block.

    Attributes
    ----------
    block : Block
        As it was given, with the original cameras.
    unknowns : Unknowns
        What was free.
    cameras : Cameras
        Adjusted, in the same order and frame.
    water : WaterSurface or None
    refractive_index : float
    xyz : array, shape (m, 3)
        Adjusted true points, metres.
    residual_px : array, shape (o, 2)
        Measured minus computed; NaN if a camera does not image its point.
    used : array of bool, shape (o,)
        Observations that are not outliers.
    is_wet : array of bool, shape (m,)
        Points below the water; behind a port all of them.
    sigma0 : float
        A-posteriori standard deviation of unit weight.
    redundancy : int
        Observations, including those of the unknowns, minus unknowns.
    rounds : list of LogRow
    source : {"tie points", "cloud"}
        What was observed: measured tie points, or images of the apparent cloud.
    engine : str
    precision : Precision or None
    gnss_residual_m : array, shape (k, 3)
        Adjusted projection centres minus GNSS positions; NaN where there is none.
    control : list of ControlRow
    notes : list of PcfixWarning
    port : Port or None
        Adjusted.
    on_surfaces : list of OnSurface
        Of points that lie on the water or on planes.
    origin, numbers : array or None
        Origin of the block's frame, and `pcfix.adjust.collinearity.State.water` there.
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
    notes: list[PcfixWarning]
    port: Port | None = None
    on_surfaces: list[OnSurface] = field(default_factory=list)
    origin: FloatArray | None = None
    numbers: FloatArray | None = None

    @property
    def is_observed(self) -> BoolArray:
        """Points with observations that were used, shape (m,)."""
        return np.bincount(self.block.owner[self.used], minlength=len(self.xyz)) > 0

    def residual_m(self) -> FloatArray:
        """Return the residuals on the ground, by distance over focal length, shape (o, 2)."""
        block, camera = self.block, self.block.camera
        away = np.linalg.norm(self.xyz[block.owner] - self.cameras.centres[camera], axis=1)
        focal = np.array([lens.focal for lens in self.cameras.lenses or ()])[camera]
        return np.asarray(self.residual_px * (away / focal)[:, None])

    def depth_m(self) -> FloatArray | None:
        """Return the depths of the points below the water, shape (m,); None without water.

        Negative above it, NaN where the surface is unknown.
        """
        if self.water is None:
            return None
        return np.asarray(surface_above(self.water, self.xyz).height_m - self.xyz[:, 2])


def sigma0_of(problem: Problem, now: Solution) -> float:
    """Return the a-posteriori standard deviation of unit weight."""
    return float(np.sqrt(now.cost / max(redundancy_of(problem), 1)))


def redundancy_of(problem: Problem) -> int:
    """Return the number of observations, including those of the unknowns, minus unknowns."""
    block, given, used = problem.block, problem.given, problem.used
    points = len(np.unique(block.owner[used]))
    priors = int((block.gnss_weights > 0.0).sum() + (given.surveyed_weight > 0.0).sum())
    sigma = [*problem.unknowns.lens_sigma.values(), *problem.unknowns.water_sigma]
    priors += sum(0.0 < value < np.inf for value in sigma)
    priors += len(np.intersect1d(np.flatnonzero(given.on >= 0), block.owner[used]))
    datum = 7 if problem.unknowns.free_network else 0
    return int(2 * used.sum() + priors + datum - 3 * points - problem.moves.sum())


def adjusted_of(
    problem: Problem, now: Solution, precision: Precision | None, notes: list[PcfixWarning],
    source: Source, engine: str,
) -> Adjusted:  # fmt: skip
    """Return a solution as a result, with check points intersected."""
    block, state = problem.block, now.state
    xyz = _with_check_points(problem, now)
    r = residuals(state._replace(xyz=xyz - problem.origin), problem.given)
    water = water_of(problem, state)
    none = -np.inf if block.port is None else np.inf  # behind a port everything is under water
    level = np.full(len(xyz), none) if water is None else surface_above(water, xyz).height_m
    cameras = solved_cameras(problem, now)
    off = cameras.centres - block.gnss_xyz
    return Adjusted(
        block=block,
        unknowns=problem.unknowns,
        cameras=cameras,
        water=water,
        refractive_index=float(state.water[INDEX]),
        xyz=xyz,
        residual_px=r,
        used=problem.used,
        is_wet=np.asarray((xyz[:, 2] < level) & block.wet),
        sigma0=sigma0_of(problem, now),
        redundancy=redundancy_of(problem),
        rounds=now.log,
        source=source,
        engine=engine,
        precision=precision,
        gnss_residual_m=np.where(block.gnss_weights > 0.0, off, np.nan),
        control=_control_rows(block, xyz, r),
        notes=notes,
        port=port_of(block, state.water),
        on_surfaces=_on_surfaces(problem, now),
        origin=problem.origin,
        numbers=state.water,
    )


def _with_check_points(problem: Problem, now: Solution) -> FloatArray:
    """Return the points, world frame, with check points intersected from the adjusted cameras."""
    block, xyz = problem.block, now.state.xyz + problem.origin
    rows = block.tie_points + np.flatnonzero(block.is_check)
    rows = rows[np.diff(block.start)[rows] >= LEAST_VIEWS]
    if len(rows) == 0:
        return xyz
    whole = replace(
        block, cameras=solved_cameras(problem, now), xyz=xyz, water=water_of(problem, now.state),
        conditions=None, port=port_of(block, now.state.water),
        refractive_index=float(now.state.water[INDEX]),
        sigma_px=np.where(np.isin(block.owner, rows), 1.0, np.inf),
    )  # fmt: skip
    part, start = prepare(whole, Unknowns(poses="fixed", lens=()))
    xyz[rows] = solve(part, start).state.xyz[rows] + part.origin
    return xyz


def _control_rows(block: Block, xyz: FloatArray, r: FloatArray) -> list[ControlRow]:
    rows = []
    names = zip(block.control_names, block.is_check, strict=True)
    for p, (name, check) in enumerate(names, block.tie_points):
        marks = r[block.start[p] : block.start[p + 1]]
        marks = marks[np.isfinite(marks).all(axis=1)]
        if (check and len(marks) < LEAST_VIEWS) or np.isnan(block.surveyed_xyz[p]).any():
            continue
        dx, dy, dz = (xyz[p] - block.surveyed_xyz[p]).tolist()
        rms = float(np.sqrt((marks * marks).mean())) if len(marks) else float("nan")
        rows.append(ControlRow(name, "check" if check else "control", dx, dy, dz, rms, len(marks)))
    return rows


def _on_surfaces(problem: Problem, now: Solution) -> list[OnSurface]:
    given, block, found = problem.block.conditions, problem.block, []
    if given is None:
        return []
    off = np.where(np.diff(block.start) > 0, surface_distances(problem, now), np.nan)
    for number, name in enumerate((WATER, *given.names)):
        rows = np.flatnonzero((given.on == number) & np.isfinite(off))
        if len(rows):
            worst = rows[np.argmax(np.abs(off[rows]))]
            rms, sigma = (float(np.sqrt(np.mean(v[rows] ** 2))) for v in (off, given.sigma_m))
            label = block.control_names[worst - block.tie_points]
            found.append(OnSurface(name, len(rows), sigma, rms, float(abs(off[worst])), label))
    return found


# Plain values


class Before(NamedTuple):
    """The block with its original poses, lenses and water.

    xyz : shape (m, 3), true points, metres, world frame; NaN where rays do not intersect.
    residual_px : shape (o, 2), measured minus computed; NaN there too.
    """

    xyz: FloatArray
    residual_px: FloatArray


def before_of(adjusted: Adjusted) -> Before:
    """Intersect the points with the original poses, with refraction.

    Control points are intersected like all others, so that the residuals do not contain their
    survey; observations that the adjustment excluded stay excluded.
    """
    block = adjusted.block
    free = replace(
        block,
        sigma_px=np.where(adjusted.used, block.sigma_px, np.inf),
        surveyed_sigma_m=np.full_like(block.surveyed_sigma_m, np.inf),
    )
    found = intersect_fixed(free)
    met = (np.isfinite(found.squares) & adjusted.is_observed)[:, None]
    problem, start = prepare(replace(free, xyz=found.xyz), Unknowns(poses="fixed", lens=()))
    residual_px = residuals(start.state, problem.given)
    return Before(np.where(met, found.xyz, np.nan), np.where(met[block.owner], residual_px, np.nan))


def adjustment_dict(adjusted: Adjusted, before: Before | None = None) -> Plain:
    """Return the content of adjustment.json; pcfix/cli/README.md lists its keys.

    Residuals before the adjustment need `before`, of `before_of`; without it they are None.
    """
    a, block, u = adjusted, adjusted.block, adjusted.unknowns
    kept = len(block.cameras) if u.poses == "fixed" else 0
    known, lenses = a.precision, block.cameras.lenses or ()
    notes = {str(one): one for one in [*a.notes, *(known.notes if known is not None else ())]}
    return {
        "source": a.source,
        "engine": a.engine,
        "image_unit": lenses[0].unit,
        "images": len(block.cameras),
        "images_fixed": kept or sum(label in u.fixed_images for label in block.cameras.labels),
        "poses_are": u.poses,
        "port": block.port is not None,
        "unknowns": {
            "lens": list(u.lens),
            "lens_sigma": {name: number(value) for name, value in u.lens_sigma.items()},
            "level_sigma_m": number(u.level_sigma_m),
            "tilt_sigma": number(u.tilt_sigma),
            "index_sigma": number(u.index_sigma),
            "shape_sigma": number(u.shape_sigma),
            "distance_sigma_m": number(u.distance_sigma_m),
            "centre_sigma_m": number(u.centre_sigma_m),
            "free_network": u.free_network,
            "parallel": list(() if block.conditions is None else block.conditions.parallel),
        },
        **_counts(a),
        "sigma0": number(a.sigma0),
        "redundancy": int(a.redundancy),
        "residuals": {
            "land": _residuals(a, before, ~a.is_wet),
            "water": _residuals(a, before, a.is_wet),
        },
        "depth_bins": _depth_bins(a, before),
        "lens": _lens(a),
        "water": _water(a),
        "port_found": _port(a),
        "on_surfaces": [row._asdict() for row in a.on_surfaces],
        "poses": _poses(a),
        "precision": None if known is None else _precision(known, u),
        "gnss": _gnss(a),
        "control": _surveyed([row for row in a.control if row.role == "control"]),
        "check": _surveyed([row for row in a.control if row.role == "check"]),
        "rounds": [
            {
                "round": row.round,
                "steps": row.step,
                "cost": number(row.cost),
                "observations": row.observations,
                "rms_px": number(row.rms_px),
            }
            for row in {row.round: row for row in a.rounds}.values()
        ],
        "notes": [one.as_dict() for one in notes.values()],
    }


def number(value: float | np.floating[Any] | None) -> float | None:
    """Return a plain number; None if it is not finite."""
    return float(value) if value is not None and np.isfinite(value) else None


def numbers(values: FloatArray) -> list[float | None]:
    """Return plain numbers, None for those that are not finite."""
    return [number(value) for value in values]


def rms(values: FloatArray) -> float | None:
    """Return the root mean square of the finite values; None if there is none."""
    known = values[np.isfinite(values)]
    return number(np.sqrt(np.mean(known * known))) if known.size else None


def mean(values: FloatArray) -> float | None:
    """Return the mean of the finite values; None if there is none."""
    known = values[np.isfinite(values)]
    return number(known.mean()) if known.size else None


def _columns(of: Callable[[FloatArray], float | None], values: FloatArray) -> list[float | None]:
    return [of(column) for column in values.T]


def nice_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not below a number."""
    if not least > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(f * power for f in (1, 2, 5, 10) if f * power >= least * (1.0 - 1e-9)))


def _counts(a: Adjusted) -> Plain:
    """Return the numbers of points and of observations."""
    roles, observed = [row.role for row in a.control], a.is_observed
    ties = len(a.xyz) - len(a.block.is_check)  # check points are among the last ones
    is_check = np.concatenate([np.zeros(ties, np.bool_), a.block.is_check])
    of_check = is_check[a.block.owner]
    return {
        "points": {
            "all": int(observed.sum()),
            "land": int((observed & ~a.is_wet).sum()),
            "water": int((observed & a.is_wet).sum()),
            "left_out": int((~observed & ~is_check).sum()),
            "control": roles.count("control"),
            "check": roles.count("check"),
        },
        "observations": {
            "used": int(a.used.sum()),
            "left_out": int((~a.used & ~of_check).sum()),
            "of_check_points": int(of_check.sum()),
            "out_of_sight": int((np.isnan(a.residual_px).any(axis=1) & a.used).sum()),
        },
    }


def _residuals(a: Adjusted, before: Before | None, points: BoolArray) -> Plain:
    points = points & a.is_observed
    rows = a.used & points[a.block.owner]
    sigma = None if a.precision is None else a.precision.point_sigma_m
    return {
        "points": int(points.sum()),
        **_fit(a, before, rows),
        "rms_xy_px": _columns(rms, a.residual_px[rows]),
        "rms_m": rms(a.residual_m()[rows]),
        "sigma_xyz_m": None if sigma is None else _columns(rms, sigma[points]),
    }


def _fit(a: Adjusted, before: Before | None, rows: BoolArray) -> Plain:
    """Return the number of some observations, and their residuals."""
    return {
        "observations": int(rows.sum()),
        "rms_before_px": None if before is None else rms(before.residual_px[rows]),
        "rms_px": rms(a.residual_px[rows]),
    }


def _depth_bins(a: Adjusted, before: Before | None) -> list[Plain]:
    depth = a.depth_m()
    if depth is None or not a.is_wet.any():
        return []
    depth = np.where(a.is_wet & a.is_observed, depth, np.nan)
    deepest = float(np.nanmax(depth, initial=0.0))
    step = nice_step(deepest / MOST_DEPTH_BINS)
    of_point = np.where(np.isfinite(depth), depth // step, -1)
    bins = []
    for i in range(int(deepest // step) + 1):
        rows = a.used & (of_point == i)[a.block.owner]
        if rows.any():
            bins.append({"from_m": i * step, "to_m": (i + 1) * step, **_fit(a, before, rows)})
    return bins


def _sigma(a: Adjusted, name: str) -> float | None:
    return None if a.precision is None else number(a.precision.sigma_of(name))


def _lens(a: Adjusted) -> list[Plain]:
    original, adjusted = a.block.cameras.lenses or (), a.cameras.lenses or ()
    _, groups = sensor_groups(original)
    rows = []
    for place, images in enumerate(groups, start=1):
        first, after = original[images[0]], adjusted[images[0]]
        for code in usable_codes(first, a.unknowns.lens):
            unknown = NAMES[code] if len(groups) == 1 else f"{NAMES[code]} of sensor {place}"
            rows.append({
                "sensor": first.sensor or f"sensor {place}",
                "images": len(images),
                "lenses": len({original[i] for i in images}),
                "name": NAMES[code],
                "before": lens_parameter(first, code),
                "after": lens_parameter(after, code),
                "sigma": _sigma(a, unknown),
            })  # fmt: skip
    return rows


def _water(a: Adjusted) -> Plain | None:
    original, adjusted = a.block.water, a.water
    if original is None or adjusted is None:
        return None
    free = dict(zip(WATER_NAMES, a.unknowns.water_sigma, strict=True))
    values: dict[str, tuple[float, float]] = {
        "index": (a.block.refractive_index, a.refractive_index)
    }
    if a.unknowns.shape_sigma and a.numbers is not None and a.origin is not None:
        start = prepare(a.block, a.unknowns, a.origin)[1].state.water
        for i, name in enumerate(WATER_NAMES[:PORT]):
            base = float(a.origin[2]) if name == "level" else 0.0
            values[name] = base + float(start[i]), base + float(a.numbers[i])
    elif isinstance(original, WaterPlane) and isinstance(adjusted, WaterPlane):
        # the estimated level is that at the origin of the block
        x, y, _ = np.round(a.block.cameras.centres.mean(axis=0)).tolist()
        levels = [one.a + one.b * x + one.c * y for one in (original, adjusted)]
        values["level"] = levels[0], levels[1]
        values["tilt_x"] = original.b, adjusted.b
        values["tilt_y"] = original.c, adjusted.c
    else:
        heights = [surface_above(water, a.xyz).height_m for water in (original, adjusted)]
        known = np.isfinite(heights).all(axis=0)
        if known.any():
            values["level"] = float(heights[0][known].mean()), float(heights[1][known].mean())
    found: Plain = {
        name: {"before": was, "after": now, "sigma": _sigma(a, name), "free": bool(free[name])}
        for name, (was, now) in values.items()
    }
    return {"surface": str(adjusted), **found}


def _port(a: Adjusted) -> Plain | None:
    if a.port is None or a.numbers is None:
        return None
    start = prepare(a.block, a.unknowns, a.origin)[1].state.water
    found: Plain = {"port": spec_of(a.port)}
    for i, (name, sigma) in enumerate(zip(WATER_NAMES, a.unknowns.water_sigma, strict=True)):
        if sigma and (i == INDEX or i >= PORT):
            found[name] = {
                "before": float(start[i]),
                "after": float(a.numbers[i]),
                "sigma": _sigma(a, name),
                "free": True,
            }
    return found


def _poses(a: Adjusted) -> Plain:
    moved = a.cameras.centres - a.block.cameras.centres
    far = np.linalg.norm(moved, axis=1)
    before, after = np.asarray(a.block.cameras.rotations), np.asarray(a.cameras.rotations)
    turned = np.degrees(Rotation.from_matrix(after @ before.transpose(0, 2, 1)).magnitude())
    return {
        "moved_mean_m": numbers(moved.mean(axis=0)),
        "moved_rms_m": rms(far),
        "moved_largest_m": number(far.max()),
        "moved_largest_image": a.cameras.labels[int(far.argmax())],
        "turned_rms_deg": rms(turned),
        "turned_largest_deg": number(turned.max()),
    }


def _precision(p: Precision, unknowns: Unknowns) -> Plain:
    centre, angle = p.centre_sigma_m, p.angle_sigma_deg
    moves = (centre > 0.0).any(axis=1) | (angle > 0.0).any(axis=1)
    found: Plain = {"images": int(moves.sum())}
    for name, values in (("centre_{}_m", centre[moves]), ("angle_{}_deg", angle[moves])):
        known = bool(moves.any())
        found[name.format("mean")] = numbers(values.mean(axis=0)) if known else None
        found[name.format("largest")] = numbers(values.max(axis=0)) if known else None
    found["shared"] = [
        {"name": row.name, "added": number(row.added), "sigma": number(row.sigma)}
        for row in p.shared
    ]
    found["correlation"] = [numbers(row) for row in p.correlation]
    found["doubts"] = [one.as_dict() for one in [*undetermined(p, unknowns), *correlated(p)]]
    return found


def _gnss(a: Adjusted) -> Plain | None:
    known = np.isfinite(a.gnss_residual_m).any(axis=1)
    if not known.any():
        return None
    off = a.gnss_residual_m[known]
    far = np.linalg.norm(np.nan_to_num(off), axis=1)
    return {
        "images": int(known.sum()),
        "mean_m": _columns(mean, off),
        "rms_m": _columns(rms, off),
        "rms_before_m": _columns(rms, (a.block.cameras.centres - a.block.gnss_xyz)[known]),
        "largest_m": number(far.max()),
        "largest_image": a.cameras.labels[int(np.flatnonzero(known)[far.argmax()])],
    }


def _surveyed(rows: Sequence[ControlRow]) -> Plain | None:
    if not rows:
        return None
    off = np.array([[row.dx_m, row.dy_m, row.dz_m] for row in rows], np.float64)
    return {
        "rms_m": _columns(rms, off),
        "mean_m": _columns(mean, off),
        "rms_px": rms(np.array([row.rms_px for row in rows], np.float64)),
        "points": [
            {
                "name": row.name,
                "dx_m": number(row.dx_m),
                "dy_m": number(row.dy_m),
                "dz_m": number(row.dz_m),
                "rms_px": number(row.rms_px),
                "images": row.images,
            }
            for row in rows
        ],
    }
