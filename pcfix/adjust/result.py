"""The result of an adjustment, as arrays and as the plain values of ``adjustment.json``."""

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import LEAST_VIEWS, NO_CONTROL, Block
from pcfix.adjust.normal import residuals
from pcfix.adjust.parameters import INDEX, Unknowns
from pcfix.adjust.precision import Precision
from pcfix.adjust.problem import (
    Problem,
    Solution,
    intersect_fixed,
    intersected,
    port_of,
    solved_cameras,
    water_of,
)
from pcfix.errors import PcfixWarning, plain
from pcfix.model import BoolArray, Cameras, FloatArray, WaterSurface
from pcfix.port.housing import Port
from pcfix.water.surface import surface_above

Source = Literal["tie points", "cloud"]
Plain = dict[str, Any]


class ControlRow(NamedTuple):
    """A surveyed point: adjusted minus surveyed in metres, and its residuals in the images."""

    name: str
    role: str  # control or check
    dx_m: float
    dy_m: float
    dz_m: float
    rms_px: float
    images: int


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjusted block."""

    block: Block  # as it was given, with the original cameras
    unknowns: Unknowns  # what was free
    cameras: Cameras  # adjusted, in the same order and frame
    water: WaterSurface | None
    refractive_index: float
    xyz: FloatArray  # (m, 3), adjusted true points, metres
    # (o, 2), measured minus computed; NaN if a camera does not image its point
    residual_px: FloatArray
    used: BoolArray  # (o,), observations that are not outliers
    is_wet: BoolArray  # (m,), points below the water; behind a port all of them
    sigma0: float  # a-posteriori standard deviation of unit weight
    redundancy: int  # observations, with those of the unknowns, minus unknowns
    source: Source  # what was observed: tie points, or images of the apparent cloud
    precision: Precision
    control: list[ControlRow]
    notes: list[PcfixWarning]
    port: Port | None = None  # adjusted

    @property
    def is_observed(self) -> BoolArray:
        """Points with observations that were used, shape (m,)."""
        return np.bincount(self.block.owner[self.used], minlength=len(self.xyz)) > 0


def sigma0_of(problem: Problem, now: Solution) -> float:
    """Return the a-posteriori standard deviation of unit weight."""
    return float(np.sqrt(now.cost / max(redundancy_of(problem), 1)))


def redundancy_of(problem: Problem) -> int:
    """Return the number of observations, including those of the unknowns, minus unknowns."""
    block, given, used = problem.block, problem.given, problem.used
    points = len(np.unique(block.owner[used]))
    priors = int((block.gnss_weights > 0.0).sum() + (given.surveyed_weight > 0.0).sum())
    priors += sum(0.0 < value < np.inf for value in problem.unknowns.water_sigma)
    priors += len(np.intersect1d(np.flatnonzero(given.on >= 0), block.owner[used]))
    datum = 7 if problem.unknowns.free_network else 0
    unknowns = 6 * len(block.cameras) - problem.fixed + len(problem.names)
    return int(2 * used.sum() + priors + datum - 3 * points - unknowns)


def adjusted_of(
    problem: Problem, now: Solution, precision: Precision, notes: list[PcfixWarning],
    source: Source,
) -> Adjusted:  # fmt: skip
    """Return a solution as a result, with check points intersected."""
    block, owner, state = problem.block, problem.block.owner, now.state
    # check points have no weight yet
    is_check = (block.is_check & (np.diff(block.start) >= LEAST_VIEWS))[owner]
    with_checks, _ = intersected(problem.weighted(np.where(is_check, 1.0, 0.0)), state)
    xyz, r = with_checks.xyz + problem.origin, residuals(with_checks, problem.given)
    water = water_of(problem, state)
    none = -np.inf if block.port is None else np.inf  # behind a port everything is under water
    level = np.full(len(xyz), none) if water is None else surface_above(water, xyz).height_m
    rows, control = list[ControlRow](), block.control
    names = zip(control.names, control.is_check, control.xyz, strict=True)
    for p, (name, check, surveyed) in enumerate(names, block.tie_points):
        marks = r[block.start[p] : block.start[p + 1]]
        marks = marks[np.isfinite(marks).all(axis=1)]
        if (check and len(marks) < LEAST_VIEWS) or np.isnan(surveyed).any():
            continue
        dx, dy, dz = (xyz[p] - surveyed).tolist()
        rms_px, role = float(rms(marks.ravel())), "check" if check else "control"
        rows.append(ControlRow(name, role, dx, dy, dz, rms_px, len(marks)))
    return Adjusted(
        block=block,
        unknowns=problem.unknowns,
        cameras=solved_cameras(problem, now),
        water=water,
        refractive_index=float(state.water[INDEX]),
        xyz=xyz,
        residual_px=r,
        used=problem.used,
        is_wet=np.asarray((xyz[:, 2] < level) & block.wet),
        sigma0=sigma0_of(problem, now),
        redundancy=redundancy_of(problem),
        source=source,
        precision=precision,
        control=rows,
        notes=notes,
        port=port_of(block, state.water),
    )


# Plain values


def residuals_before(adjusted: Adjusted) -> FloatArray:
    """Return residuals with the original poses, lenses and water, with refraction, shape (o, 2).

    Control points are intersected like all others, so that the residuals do not contain their
    survey; observations that the adjustment excluded have no weight.
    """
    sigma_px = np.where(adjusted.used, adjusted.block.sigma_px, np.inf)
    return intersect_fixed(replace(adjusted.block, sigma_px=sigma_px, control=NO_CONTROL))[1]


def mean(values: FloatArray) -> FloatArray:
    """Return the mean of the finite values, of each column; NaN if there is none."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def rms(values: FloatArray) -> FloatArray:
    """Return the root mean square of the finite values, of each column; NaN if there is none."""
    return np.asarray(np.sqrt(mean(values * values)))


def adjustment_dict(adjusted: Adjusted) -> Plain:
    """Return the content of adjustment.json; pcfix/cli/README.md lists its keys."""
    a, block, u = adjusted, adjusted.block, adjusted.unknowns
    observed, lenses, before_px = a.is_observed, block.cameras.lenses or (), residuals_before(a)
    # by how much the poses changed
    far = np.linalg.norm(a.cameras.centres - block.cameras.centres, axis=1)
    before, after = np.asarray(block.cameras.rotations), np.asarray(a.cameras.rotations)
    turned = np.asarray(Rotation.from_matrix(after @ before.transpose(0, 2, 1)).magnitude())
    found = {
        "source": a.source,
        "image_unit": lenses[0].unit,
        "images": len(lenses),
        "unknowns": {
            "poses": u.poses,
            "lens": u.lens,
            "surface": dict(u.surface),
            "free_network": u.free_network,
            "parallel": block.parallel,
        },
        "points": {
            "all": observed.sum(),
            "land": (observed & ~a.is_wet).sum(),
            "water": (observed & a.is_wet).sum(),
        },
        "observations": {
            "used": a.used.sum(),
            "excluded": (~a.used & ~block.is_check[block.owner]).sum(),
        },
        "sigma0": a.sigma0,
        "redundancy": a.redundancy,
        "residuals": {
            "land": _residuals(a, before_px, ~a.is_wet),
            "water": _residuals(a, before_px, a.is_wet),
        },
        "shared": {name: row._asdict() for name, row in a.precision.shared.items()},
        "water": None if a.water is None else str(a.water),
        "port": None if a.port is None else str(a.port),
        "index": a.refractive_index,
        "poses": {"moved_rms_m": rms(far), "turned_rms_deg": rms(np.degrees(turned))},
        "precision": {
            "centre_mean_m": mean(a.precision.centre_sigma_m),
            "angle_mean_deg": mean(a.precision.angle_sigma_deg),
            "correlation": a.precision.correlation,
        },
        "gnss": _gnss(a),
        "control": _surveyed(a, "control"),
        "check": _surveyed(a, "check"),
        "notes": [one.as_dict() for one in {str(one): one for one in a.notes}.values()],
    }
    return dict(plain(found))


def _residuals(a: Adjusted, before_px: FloatArray, points: BoolArray) -> Plain:
    """Return residuals and standard errors on land or under water, as in Mulsow 2024."""
    points = points & a.is_observed
    rows = a.used & points[a.block.owner]
    sigma = a.precision.point_sigma_m
    camera, r = a.block.camera[rows], a.residual_px[rows]
    # on the ground: by distance over focal length
    away = np.linalg.norm(a.xyz[a.block.owner[rows]] - a.cameras.centres[camera], axis=1)
    focal = np.array([lens.focal for lens in a.cameras.lenses or ()])[camera]
    return {
        "points": points.sum(),
        "observations": rows.sum(),
        "rms_before_px": rms(before_px[rows].ravel()),
        "rms_px": rms(r.ravel()),
        "rms_xy_px": rms(r),
        "rms_m": rms((r * (away / focal)[:, None]).ravel()),
        "sigma_xyz_m": None if sigma is None else rms(sigma[points]),
    }


def _gnss(a: Adjusted) -> Plain | None:
    """Return centres minus GNSS positions; None if there is none."""
    is_used = a.block.gnss_weights > 0.0
    known = is_used.any(axis=1)
    if not known.any():
        return None
    off = np.where(is_used, a.cameras.centres - a.block.gnss.xyz, np.nan)[known]
    return {
        "images": known.sum(),
        "mean_m": mean(off),
        "rms_m": rms(off),
        "rms_before_m": rms((a.block.cameras.centres - a.block.gnss.xyz)[known]),
    }


def _surveyed(a: Adjusted, role: str) -> Plain | None:
    """Return the control or the check points."""
    rows = [row for row in a.control if row.role == role]
    if not rows:
        return None
    off = np.array([[row.dx_m, row.dy_m, row.dz_m] for row in rows])
    return {
        "rms_m": rms(off),
        "mean_m": mean(off),
        "rms_px": rms(np.array([row.rms_px for row in rows])),
        "points": [row._asdict() for row in rows],
    }
