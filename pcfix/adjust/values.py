"""An adjustment in plain values: what its text, its page and ``adjustment.json`` tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import (
    INDEX,
    NAMES,
    PORT,
    WATER_NAMES,
    Unknowns,
    lens_parameter,
    sensor_groups,
    usable_codes,
)
from pcfix.adjust.normal import residuals
from pcfix.adjust.precision import Precision, strong_correlations, undetermined
from pcfix.adjust.problem import intersect_fixed, prepare
from pcfix.adjust.result import Adjusted, ControlRow
from pcfix.model import BoolArray, FloatArray, WaterPlane
from pcfix.port.shapes import spec_of
from pcfix.water.surface import surface_above

Plain = dict[str, Any]

MOST_DEPTH_BINS = 8


class Before(NamedTuple):
    """The block with its poses, lenses and water as they came.

    xyz : shape (m, 3), true points, metres, world frame; NaN where the rays do not meet.
    residual_px : shape (o, 2), measured minus computed; NaN there too.
    """

    xyz: FloatArray
    residual_px: FloatArray


def before_of(adjusted: Adjusted) -> Before:
    """Intersect the points with the poses as they came, the light bent.

    Control points are intersected as all others, so that what the survey says does not go into
    the residuals; observations that the adjustment left out stay out.
    """
    block = adjusted.block
    free = replace(
        block,
        sigma_px=np.where(adjusted.used, block.sigma_px, np.inf),
        surveyed_sigma_m=np.full_like(block.surveyed_sigma_m, np.inf),
    )
    found = intersect_fixed(free)
    met = (np.isfinite(found.squares) & carried_by(adjusted))[:, None]
    problem, start = prepare(replace(free, xyz=found.xyz), Unknowns(poses="fixed", lens=()))
    residual_px = residuals(start.state, problem.seen, problem.surface)
    return Before(np.where(met, found.xyz, np.nan), np.where(met[block.owner], residual_px, np.nan))


def adjustment_dict(adjusted: Adjusted, before: Before | None = None) -> Plain:
    """Return what an adjustment came to, in lists, dicts, numbers and text.

    Parameters
    ----------
    adjusted : Adjusted
    before : Before, optional
        Of `before_of`; without it what stands below as "before" of residuals is None.

    Returns
    -------
    dict
        Angles in degrees, else metres or the unit of the images. Every root mean square of
        residuals is that of a coordinate. None where a number is not known.

        source, engine : str
            What the observations are, and what solved them.
        image_unit : {"px", "mm"}
            Of residuals and lens; keys that end in ``_px`` are in it.
        images, images_fixed : int
            Images, and those whose pose was kept.
        poses_are : {"free", "fixed", "similarity"}
        port : bool
            Whether light bends at a housing port instead of at water.
        unknowns : dict
            `lens`, the names of its free parameters; and standard deviations about the start of
            `lens_sigma`, `level_sigma_m`, `tilt_sigma`, `index_sigma`, `shape_sigma`,
            `distance_sigma_m`, `centre_sigma_m`, None where free without bounds, 0 where fixed;
            `free_network`, a bool; `parallel`, names of planes.
        points : dict
            `all` with observations that were used, those on `land` and under `water`; `left_out`,
            tie points without any; `control` and `check`, surveyed ones.
        observations : dict
            `used`, `left_out`, `of_check_points`, which are never used, and `out_of_sight`: used,
            but not imaged by the adjusted camera.
        sigma0 : float
        redundancy : int
        residuals : dict
            Of `land` and `water`: `points`, `observations`, `rms_before_px`, `rms_px`, `rms_xy_px`
            (of x' and y' apart), `rms_m` (on the ground: residual by distance over focal length)
            and `sigma_xyz_m`, the root mean square of the points' standard errors along x, y, z.
        depth_bins : list of dict
            `from_m`, `to_m`, `observations`, `rms_before_px`, `rms_px`, by depth below water.
        lens : list of dict
            Each free parameter: `sensor`, `images`, `lenses` (different ones; the values are then
            those of the first), `name`, `before`, `after`, `sigma`.
        water : dict or None
            `surface`, `level` and `index` with `before`, `after`, `sigma` and `free`;
            `tilt_x` and `tilt_y` likewise for a plane, and of one whose shape was free `shape_xx`,
            `shape_xy`, `shape_yy` (1/m, the factors of x^2, x y, y^2). Level, tilt and shape are
            those below the middle of the projection centres, or the level over a mesh or raster
            its mean over the points.
        port_found : dict or None
            `port`, as --port takes it, and of what was free of `index`, `distance` or `centre_x`,
            `centre_y`, `centre_z`: `before`, `after`, `sigma`, `free`.
        on_surfaces : list of dict
            Of marked points that shall lie on the water or a plane: `surface`, `points`,
            `sigma_m` (stated), `rms_m`, `largest_m`, `largest_point`.
        poses : dict
            `moved_mean_m` east, north and up; `moved_rms_m`, `moved_largest_m` with
            `moved_largest_image`; `turned_rms_deg`, `turned_largest_deg`.
        precision : dict or None
            `images` that moved, `centre_mean_m`, `centre_largest_m` (x, y, z),
            `angle_mean_deg`, `angle_largest_deg` (about the axes of the camera), `shared`: a list
            of `name`, `added`, `sigma`; `correlation`: the rows of their matrix; `doubts`:
            sentences on what is undetermined or strongly correlated.
        gnss : dict or None
            Adjusted minus GNSS: `images`, `mean_m`, `rms_m` (east, north, up), `largest_m` and
            `largest_image`.
        control, check : dict or None
            Adjusted minus surveyed: `rms_m` (x, y, z), `mean_m`, `rms_px`, and `points`: a list
            of `name`, `dx_m`, `dy_m`, `dz_m`, `rms_px`, `images`.
        rounds : list of dict
            `round`, `steps`, `cost`, `observations`, `rms_px` as each round ended.
        notes : list of str
    """
    a, block, u = adjusted, adjusted.block, adjusted.unknowns
    kept = len(block.cameras) if u.poses == "fixed" else 0
    known, lenses = a.precision, block.cameras.lenses or ()
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
        "points": _points(a),
        "observations": _observations(a),
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
        "notes": list(dict.fromkeys([*a.notes, *(known.notes if known is not None else ())])),
    }


def number(value: float | np.floating[Any] | None) -> float | None:
    """Return a plain number; None where it is not finite."""
    return float(value) if value is not None and np.isfinite(value) else None


def numbers(values: FloatArray) -> list[float | None]:
    """Return plain numbers, None where they are not finite."""
    return [number(value) for value in values]


def depth_of(adjusted: Adjusted) -> FloatArray | None:
    """Return how deep the points lie below the water, shape (m,), metres; None without water.

    Negative above it, NaN where the surface is not known.
    """
    if adjusted.water is None:
        return None
    return np.asarray(surface_above(adjusted.water, adjusted.xyz).height_m - adjusted.xyz[:, 2])


def carried_by(adjusted: Adjusted) -> BoolArray:
    """Return which points have observations that were used, shape (m,)."""
    a = adjusted
    return np.bincount(a.block.owner[a.used], minlength=len(a.xyz)) > 0


def _is_check(a: Adjusted) -> BoolArray:
    """Return which points are check points, shape (m,); surveyed points are the last ones."""
    ties = len(a.xyz) - len(a.block.is_check)
    return np.concatenate([np.zeros(ties, np.bool_), a.block.is_check])


def _points(a: Adjusted) -> Plain:
    roles, carried = [row.role for row in a.control], carried_by(a)
    return {
        "all": int(carried.sum()),
        "land": int((carried & ~a.is_wet).sum()),
        "water": int((carried & a.is_wet).sum()),
        "left_out": int((~carried & ~_is_check(a)).sum()),
        "control": roles.count("control"),
        "check": roles.count("check"),
    }


def _observations(a: Adjusted) -> Plain:
    of_check = _is_check(a)[a.block.owner]
    lost = np.isnan(a.residual_px).any(axis=1) & a.used
    return {
        "used": int(a.used.sum()),
        "left_out": int((~a.used & ~of_check).sum()),
        "of_check_points": int(of_check.sum()),
        "out_of_sight": int(lost.sum()),
    }


def _residuals(a: Adjusted, before: Before | None, points: BoolArray) -> Plain:
    points = points & carried_by(a)
    rows = a.used & points[a.block.owner]
    known = bool(np.isfinite(a.residual_px[rows]).any())
    sigma = None if a.precision is None else a.precision.point_sigma_m
    return {
        "points": int(points.sum()),
        **_fit(a, before, rows),
        "rms_px": number(a.rms_px(points)) if known else None,
        "rms_xy_px": _columns(rms, a.residual_px[rows]),
        "rms_m": number(a.rms_m(points)) if known else None,
        "sigma_xyz_m": None if sigma is None else _columns(rms, sigma[points]),
    }


def _fit(a: Adjusted, before: Before | None, rows: BoolArray) -> Plain:
    """Return how many observations some rows are, and how they fit."""
    return {
        "observations": int(rows.sum()),
        "rms_before_px": None if before is None else rms(before.residual_px[rows]),
        "rms_px": rms(a.residual_px[rows]),
    }


def rms(values: FloatArray) -> float | None:
    """Return the root mean square of those that are finite; None where none is."""
    known = values[np.isfinite(values)]
    return number(np.sqrt(np.mean(known * known))) if known.size else None


def mean(values: FloatArray) -> float | None:
    """Return the mean of those that are finite; None where none is."""
    known = values[np.isfinite(values)]
    return number(known.mean()) if known.size else None


def _columns(of: Callable[[FloatArray], float | None], values: FloatArray) -> list[float | None]:
    return [of(column) for column in values.T]


def _depth_bins(a: Adjusted, before: Before | None) -> list[Plain]:
    depth = depth_of(a)
    if depth is None or not a.is_wet.any():
        return []
    depth = np.where(a.is_wet & carried_by(a), depth, np.nan)
    deepest = float(np.nanmax(depth, initial=0.0))
    step = nice_step(deepest / MOST_DEPTH_BINS)
    of_point = np.where(np.isfinite(depth), depth // step, -1)
    bins = []
    for i in range(int(deepest // step) + 1):
        rows = a.used & (of_point == i)[a.block.owner]
        if rows.any():
            bins.append({"from_m": i * step, "to_m": (i + 1) * step, **_fit(a, before, rows)})
    return bins


def nice_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not below a number."""
    if not least > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(f * power for f in (1, 2, 5, 10) if f * power >= least * (1.0 - 1e-9)))


def _lens(a: Adjusted) -> list[Plain]:
    old, new = a.block.cameras.lenses or (), a.cameras.lenses or ()
    _, groups = sensor_groups(old)
    rows = []
    for place, images in enumerate(groups, start=1):
        first, after = old[images[0]], new[images[0]]
        for code in usable_codes(first, a.unknowns.lens):
            unknown = NAMES[code] if len(groups) == 1 else f"{NAMES[code]} of sensor {place}"
            rows.append({
                "sensor": first.sensor or f"sensor {place}",
                "images": len(images),
                "lenses": len({old[i] for i in images}),
                "name": NAMES[code],
                "before": lens_parameter(first, code),
                "after": lens_parameter(after, code),
                "sigma": _sigma(a, unknown),
            })  # fmt: skip
    return rows


def _sigma(a: Adjusted, name: str) -> float | None:
    return None if a.precision is None else number(a.precision.sigma_of(name))


def _water(a: Adjusted) -> Plain | None:
    old, new = a.block.water, a.water
    if old is None or new is None:
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
    elif isinstance(old, WaterPlane) and isinstance(new, WaterPlane):
        # the level that is estimated stands at the origin of the block
        origin = np.round(a.block.cameras.centres.mean(axis=0))[None]
        values["level"] = (
            float(surface_above(old, origin).height_m[0]),
            float(surface_above(new, origin).height_m[0]),
        )
        values["tilt_x"], values["tilt_y"] = (old.b, new.b), (old.c, new.c)
    else:
        heights = [surface_above(water, a.xyz).height_m for water in (old, new)]
        known = np.isfinite(heights).all(axis=0)
        if known.any():
            values["level"] = float(heights[0][known].mean()), float(heights[1][known].mean())
    found: Plain = {
        name: {"before": was, "after": now, "sigma": _sigma(a, name), "free": bool(free[name])}
        for name, (was, now) in values.items()
    }
    return {"surface": str(new), **found}


def _port(a: Adjusted) -> Plain | None:
    if a.port is None or a.numbers is None:
        return None
    start = prepare(a.block, a.unknowns, a.origin)[1].state.water
    found: Plain = {"port": spec_of(a.port)}
    for i, (name, sigma) in enumerate(zip(WATER_NAMES, a.unknowns.water_sigma, strict=True)):
        if sigma and (i == INDEX or i >= PORT):
            before, after = float(start[i]), float(a.numbers[i])
            sigma_found = _sigma(a, name)
            row = {"before": before, "after": after, "sigma": sigma_found, "free": True}
            found[name] = row
    return found


def _poses(a: Adjusted) -> Plain:
    moved = a.cameras.centres - a.block.cameras.centres
    far = np.linalg.norm(moved, axis=1)
    old, new = np.asarray(a.block.cameras.rotations), np.asarray(a.cameras.rotations)
    turned = np.degrees(Rotation.from_matrix(new @ old.transpose(0, 2, 1)).magnitude())
    return {
        "moved_mean_m": numbers(moved.mean(axis=0)),
        "moved_rms_m": number(np.sqrt(np.mean(far * far))),
        "moved_largest_m": number(far.max()),
        "moved_largest_image": a.cameras.labels[int(far.argmax())],
        "turned_rms_deg": number(np.sqrt(np.mean(turned * turned))),
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
    found["doubts"] = [*undetermined(p, unknowns), *strong_correlations(p)]
    return found


def _gnss(a: Adjusted) -> Plain | None:
    known = np.isfinite(a.gnss_residual_m).any(axis=1)
    if not known.any():
        return None
    off = a.gnss_residual_m[known]
    far = np.linalg.norm(np.where(np.isfinite(off), off, 0.0), axis=1)
    worst = int(np.flatnonzero(known)[far.argmax()])
    return {
        "images": int(known.sum()),
        "mean_m": _columns(mean, off),
        "rms_m": _columns(rms, off),
        "rms_before_m": _columns(rms, (a.block.cameras.centres - a.block.gnss_xyz)[known]),
        "largest_m": number(far.max()),
        "largest_image": a.cameras.labels[worst],
    }


def _surveyed(rows: Sequence[ControlRow]) -> Plain | None:
    if not rows:
        return None
    off = np.array([[row.dx_m, row.dy_m, row.dz_m] for row in rows], np.float64)
    pixels = np.array([row.rms_px for row in rows], np.float64)
    return {
        "rms_m": _columns(rms, off),
        "mean_m": _columns(mean, off),
        "rms_px": rms(pixels),
        "points": [
            {
                "name": row.name,
                **dict(zip(("dx_m", "dy_m", "dz_m"), numbers(xyz), strict=True)),
                "rms_px": number(row.rms_px),
                "images": row.images,
            }
            for row, xyz in zip(rows, off, strict=True)
        ],
    }
