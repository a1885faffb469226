"""The adjustment of a block by tie points or by the cloud, and the checks of its result.

An antenna's lever arm, another height datum or a wrong water level offset all GNSS positions from
the projection centres alike. The block follows them, focal length and heights absorb the offset,
and residuals hardly show it. The water level, control points and strips flown in both directions
reveal it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.adjust.block import (
    FIRST_SIGMA_PX,
    Block,
    Material,
    Progress,
    Unknowns,
    block_of,
    check_datum,
    marks_of,
    plain_block,
    restricted,
    some_cameras,
    ties_of_cloud,
    well_seen,
)
from pcfix.adjust.from_cloud import CloudBlock, adjust_cloud
from pcfix.adjust.from_ties import adjust_ties, default_lens
from pcfix.adjust.precision import correlated, shape_notes, undetermined
from pcfix.adjust.problem import intersect_fixed
from pcfix.adjust.result import Adjusted
from pcfix.adjust.solve import reduced_at, solver
from pcfix.errors import GeometryError, PcfixWarning, SettingError
from pcfix.model import Cameras, FloatArray, GroundControl, IntArray, TiePoints, WaterSurface
from pcfix.options.correct import AdjustRules
from pcfix.refract.choice import views_in_frame
from pcfix.water.surface import surface_above

LEAST_TIES = 100
SMALL_WATER = 10
"""Tie points on one side of the surface that are needed for it to count as observed."""

GROSS_SIGMAS, GROSS_PX = 20.0, 10.0
"""A control point with larger errors than both is a mistake, not noise."""

ELSEWHERE = 0.1
"""Share of the flying height; no absorbed refraction puts control points that far off."""

_REMEDY = (
    "Check its name, coordinates and marks (swapped names?). A point with the role check has no"
    " weight."
)


def adjust_block(
    material: Material,
    rules: AdjustRules,
    *,
    ties: TiePoints | None = None,
    cloud_xyz: FloatArray | None = None,
    progress: Progress | None = None,
) -> Adjusted:
    """Adjust a block by measured tie points, or by the apparent cloud that it made.

    Parameters
    ----------
    cloud_xyz : array, shape (m, 3)
        Points of the cloud, in place of tie points.
    """
    original, chooses_lens = material.original, False
    lens: tuple[str, ...] = ()
    if rules.lens_unknowns is not None:
        lens = rules.lens_unknowns
    elif material.calibrated is None:
        lens, chooses_lens = default_lens(original.lenses or ()), True
    if cloud_xyz is not None:
        ties = ties_of_cloud(cloud_xyz, views_in_frame(cloud_xyz, original), original)
    if ties is None or len(ties.xyz) < LEAST_TIES:
        words = (
            f"{material.name}: no image shows the cloud. Check the poses with 'pcfix cameras"
            " --cloud'."
        )
        raise GeometryError("cameras.no_overlap", words, path=material.name)
    tilt = None if rules.sigma_tilt is None else float(np.tan(np.radians(rules.sigma_tilt)))
    stated = {"level": rules.sigma_level, "tilt": tilt, "index": rules.sigma_index}
    surface: dict[str, float] = dict.fromkeys(rules.free, np.inf)
    surface |= {name: sigma for name, sigma in stated.items() if sigma is not None}
    is_free = rules.datum == "free"
    unknowns = Unknowns(rules.poses, rules.fixed_images, lens, surface, free_network=is_free)
    sigma_px, level_sigma_m = rules.sigma_image or FIRST_SIGMA_PX, surface.get("level", 0.0)
    block = block_of(material, ties, sigma_px, level_sigma_m)
    check_datum(block, unknowns, material.no_gnss)
    xyz, water = block.xyz[: len(ties.xyz)], material.water
    wet = len(xyz) if water is None else int((surface_above(water, xyz).height_m > xyz[:, 2]).sum())
    if wet < SMALL_WATER:
        words = (
            f"Only {wet} of {len(xyz):,} points are below the water, so there is no refraction to"
            " adjust. Check the water level, or use an ordinary bundle adjustment."
        )
        raise GeometryError("water.below_points", words, wet=wet, points=len(xyz))
    rows, notes = _well_seen(material.name, block)
    block = restricted(block, rows)
    if cloud_xyz is None:
        found = adjust_ties(
            block, unknowns, progress, sigma_px=rules.sigma_image, outliers=rules.outliers,
            choose_lens=chooses_lens,
        )  # fmt: skip
    else:
        surveyed = [] if material.control is None else [material.control.xyz]
        apparent = np.vstack([ties.xyz, *surveyed])
        sets = [lens]
        if chooses_lens:
            sets = list(dict.fromkeys([("f",), ("f", "cx", "cy"), lens]))
        given = CloudBlock(block, some_cameras(original, rows), apparent)
        found = adjust_cloud(given, unknowns, sets, progress)
    notes += [*_check_dry(water, found), *found.notes]
    notes += [*undetermined(found.precision), *correlated(found.precision)]
    if found.precision.members is None:
        words = (
            f"The block is too large ({len(block.cameras):,} images) for covariances of its points,"
            " so the correction cannot use the errors of the poses."
        )
        notes.append(PcfixWarning("adjust.too_large", words, images=len(block.cameras)))
    on_bed = found.is_wet & np.isfinite(found.xyz).all(axis=1)
    notes += shape_notes(found.precision, (found.xyz - found.problem.origin)[on_bed, :2])
    return replace(found, notes=[*notes, *datum_notes(found), *bed_notes(found)])


# Checks of what goes in


def _well_seen(name: str, block: Block) -> tuple[IntArray, list[PcfixWarning]]:
    """Return the rows of the images that can be adjusted, and a warning about others."""
    rows, count = well_seen(block), len(block.cameras)
    if len(rows) < 2:
        words = (
            f"{name}: only {len(rows)} of {count} images have enough observations for a pose. Give"
            " a model with more tie points."
        )
        raise GeometryError("ties.few_images", words, path=name, images=len(rows))
    lost = np.setdiff1d(np.arange(count), rows)
    if not len(lost):
        return rows, []
    words = (
        f"{len(lost)} of {count} images (first {block.cameras.labels[lost[0]]}) have too few"
        " observations for a pose and were excluded."
    )
    return rows, [PcfixWarning("ties.few_in_image", words, images=len(lost))]


def check_images(
    name: str, cameras: Cameras, water: WaterSurface | None, fixed_images: tuple[str, ...]
) -> None:
    """Check that the fixed images exist, and that the cameras are above the water."""
    missing = [label for label in fixed_images if label not in cameras.labels]
    if missing:
        words = (
            f"Fixed image {missing[0]} is not in the model, which has {len(cameras)} images (first"
            f" {cameras.labels[0]})."
        )
        raise SettingError("adjust.fixed_image", words, image=missing[0])
    if water is None:
        return
    level = surface_above(water, cameras.centres).height_m
    wet = np.flatnonzero(level > cameras.centres[:, 2])
    if len(wet):
        i = int(wet[0])
        raise GeometryError(
            "cameras.under_water",
            f"{name}: {len(wet)} of {len(cameras)} cameras are below the water (first"
            f" {cameras.labels[i]}, {cameras.centres[i, 2]:.2f} m). Check the water level and the"
            " CRS of both; for underwater images give --port.",
            path=name,
            images=len(wet),
            image=cameras.labels[i],
        )


def check_marks(
    control: GroundControl, cameras: Cameras, name: str, *, is_placed: bool = False
) -> None:
    """Refuse control points whose marks are somewhere else altogether, before any adjustment.

    Each point is intersected from the original cameras by straight rays. All may be offset alike,
    as the block may be if nothing else places it; one that is offset differently is a mistake.

    Parameters
    ----------
    name : str
        Of the file.
    is_placed : bool
        Whether GNSS positions have placed the block already.
    """
    marks, _ = marks_of(control)
    found = intersect_fixed(plain_block(cameras, marks))
    met = np.isfinite(found.squares) & (np.diff(found.start) >= 2) & ~control.is_check
    if met.sum() < 3:
        return
    off = found.xyz - control.xyz
    middle = np.median(off[met], axis=0)
    apart = np.linalg.norm(off - middle, axis=1)
    height = float(np.median(cameras.centres[:, 2]) - np.nanmedian(control.xyz[:, 2]))
    if is_placed and np.abs(middle).max() > ELSEWHERE * height > 0.0:
        x, y, z = (-middle).tolist()
        words = (
            f"{name}: the control points are {x:.1f}, {y:.1f}, {z:.1f} m (x, y, z; median) from the"
            " intersections of their marks, while the GNSS positions fit. One of the two has"
            " another CRS or height datum; name it with --gcps-crs or --gnss-crs."
        )
        raise GeometryError("gcps.offset", words, path=name, offset_m=[x, y, z])
    worst = int(np.argmax(np.where(met, apart, 0.0)))
    if apart[worst] > ELSEWHERE * height > 0.0:
        raise GeometryError(
            "gcps.gross_error",
            f"{name}: control point {control.names[worst]} does not fit: its marks intersect"
            f" {apart[worst]:.1f} m from its coordinates, relative to the other points. {_REMEDY}",
            path=name,
            point=control.names[worst],
            off_m=float(apart[worst]),
        )


# Checks of what comes out


def _check_dry(water: WaterSurface | None, found: Adjusted) -> list[PcfixWarning]:
    """Check that there is land, which a free water surface needs."""
    if water is None:
        return []
    above, count = int((found.is_observed & ~found.is_wet).sum()), int(found.is_observed.sum())
    if above >= SMALL_WATER:
        return []
    few = f"Only {above} of {count:,} points are above the water"
    if any(found.unknowns.water_sigma):
        words = (
            f"{few}, so level, tilt and index cannot be separated from the height of the block."
            " Fix the water."
        )
        raise GeometryError("water.no_land", words, land=above, points=count)
    words = f"{few}, so only GNSS and control points determine the heights of the bed."
    return [PcfixWarning("water.no_land", words, land=above, points=count)]


def check_control(found: Adjusted, name: str) -> None:
    """Refuse control points with gross errors.

    The adjustment distributes a gross error over the coordinates of the point and its marks, so
    both count: the coordinates as they appear in the images.
    """
    block = found.block
    known, fits = np.isfinite(block.surveyed_sigma_m), np.isfinite(found.residual_px).all(axis=1)
    fits &= np.isfinite(block.sigma_px)
    marks = np.flatnonzero(fits & block.is_surveyed[block.owner])
    point, camera = block.owner[marks], block.camera[marks]
    off_m = np.where(known, found.xyz - block.surveyed_xyz, 0.0)[point]
    off_px = np.linalg.norm(found.residual_px[marks], axis=1)
    away = np.linalg.norm(found.cameras.centres[camera] - found.xyz[point], axis=1)
    focal = np.array([lens.focal for lens in found.cameras.lenses or ()])[camera]
    px = off_px + np.linalg.norm(off_m, axis=1) * focal / away
    of_place = (np.abs(off_m) / block.surveyed_sigma_m[point]).max(axis=1)
    sigmas = np.maximum(off_px / block.sigma_px[marks], of_place)
    gross = (px > GROSS_PX) & (sigmas > GROSS_SIGMAS)
    if not gross.any():
        return
    worst = int(np.argmax(np.where(gross, px, 0.0)))
    name_of_worst = block.control_names[point[worst] - block.tie_points]
    words = (
        f"{name}: control point {name_of_worst} does not fit: its error is {px[worst]:.0f} px or"
        f" {sigmas[worst]:.0f} standard deviations. {_REMEDY}"
    )
    values = {"point": name_of_worst, "off_px": float(px[worst])}
    raise GeometryError("gcps.gross_error", words, path=name, **values)


# Datum and heights of the bed


UNKNOWN_M = 10.0
"""Prior standard deviation of an offset; one that keeps it is not determined."""

SIGMAS, OF_GNSS = 3.0, 2.0
"""An offset is reported if it exceeds so many of its standard errors, and so many standard
deviations of a position: smaller ones come from fixed lens parameters, and move the bed by less."""

FEW = 6
"""GNSS positions and control points; fewer hardly determine the weight of a cloud."""

BED_GSD = 1.5
"""Standard error of the heights of the bed, in ground pixels, that is worth a warning."""

SIDES = (("to the right of", "to the left of"), ("ahead of", "behind"), ("above", "below"))
"""Relative to the projection centres, with the top of the image ahead."""


def offset_of(found: Adjusted) -> tuple[FloatArray, FloatArray] | None:
    """Return the offset of the GNSS with which a block would fit best, and its standard errors.

    Both are to the right, ahead and up, shape (3,), metres. It is one more unknown of all
    positions, estimated by one step from the solution. None if nothing is free.
    """
    problem, now, weight = found.problem, found.solution, found.block.gnss_weights
    # axes of each image in the world: right, ahead, up
    right = np.asarray(found.cameras.rotations)[:, 0] * [1.0, 1.0, 0.0]
    right /= np.maximum(np.linalg.norm(right, axis=1), 1e-9)[:, None]
    up = np.broadcast_to([0.0, 0.0, 1.0], right.shape)
    axes = np.stack([right, np.cross(up, right), up], axis=1)
    with_centres = np.zeros((len(weight), 6, 3))
    with_centres[:, 3:] = weight[:, :, None] * axes.transpose(0, 2, 1)
    matrix, right_side = reduced_at(problem, now)
    others = np.zeros((problem.given.shared, 3))
    taken_up = problem.spread(now.state).T @ np.vstack([with_centres.reshape(-1, 3), others])
    solve_for = solver(matrix)
    if solve_for is None or not taken_up.any():
        return None
    own = np.einsum("kij,kj,klj->il", axes, weight, axes) + np.eye(3) / UNKNOWN_M**2
    covariance = np.linalg.inv(own - taken_up.T @ solve_for(taken_up))
    side = -np.einsum("kij,kj->i", axes, weight * np.nan_to_num(found.gnss_residual_m))
    step = covariance @ (side - taken_up.T @ solve_for(right_side))
    return step, max(found.sigma0, 1.0) * np.sqrt(np.diag(covariance))


def datum_notes(found: Adjusted) -> list[PcfixWarning]:
    """Return warnings if GNSS positions are few for a cloud, or have a significant offset."""
    known = np.isfinite(found.gnss_residual_m)
    if not known.any() or found.unknowns.poses != "free" or found.unknowns.free_network:
        return []
    if found.source == "cloud":
        count, control = (
            int(known.all(axis=1).sum()),
            sum(r.role == "control" for r in found.control),
        )
        if count + control >= FEW:
            return []
        words = (
            f"Only {count} GNSS positions and {control} control points determine the weight of the"
            " cloud. Give positions of more images, spread over the block, or control points."
        )
        return [PcfixWarning("gnss.few", words, gnss=count, control=control)]
    stated_m = float(np.median(found.block.gnss_sigma_m[known]))
    offset_m, sigma_m = offset_of(found) or (np.zeros(3), np.zeros(3))
    is_off = np.abs(offset_m) > np.maximum(SIGMAS * sigma_m, OF_GNSS * stated_m)
    if not is_off.any():
        return []
    parts = [
        f"{abs(m):.2f} m {side[int(m < 0.0)]} the projection centres (standard error {sigma:.2f} m)"
        for m, sigma, side, off in zip(offset_m, sigma_m, SIDES, is_off, strict=True)
        if off
    ]
    level = ""
    if is_off[2] and found.water is not None:
        level = f", or a water level that is too {'low' if offset_m[2] > 0.0 else 'high'}"
    words = (
        f"The GNSS positions are {' and '.join(parts)}: an antenna lever arm, another datum{level}."
        " The block followed them. Correct them, or omit them if there are control points."
    )
    more = {"offset_m": offset_m.tolist(), "sigma_m": sigma_m.tolist()}
    return [PcfixWarning("gnss.offset_found", words, **more)]


def bed_notes(found: Adjusted) -> list[PcfixWarning]:
    """Return a warning if the heights of the bed are imprecise."""
    sigma, bed = found.precision.point_sigma_m, found.is_wet & found.is_observed
    if sigma is None or not bed.any():
        return []
    sigma_m = float(np.nanmedian(sigma[bed, 2]))
    focal = float(np.median([lens.focal for lens in found.cameras.lenses or ()]))
    away_m = float(np.median(found.cameras.centres[:, 2]) - np.median(found.xyz[bed, 2]))
    gsd = sigma_m / (away_m / focal)
    if gsd < BED_GSD:
        return []
    words = (
        f"The heights of the bed have a standard error of {sigma_m:.2f} m ({gsd:.1f} ground"
        " pixels). Give control points, GNSS positions of more images that are not on one line,"
        " or a calibrated lens."
    )
    return [PcfixWarning("adjust.imprecise_bed", words, sigma_m=sigma_m, gsd=gsd)]
