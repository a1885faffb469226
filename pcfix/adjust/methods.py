"""The adjustment of a block by tie points or by the cloud, and the checks of its result.

An antenna's lever arm, another height datum or a wrong water level offset all GNSS positions from
the projection centres alike. The block follows them, focal length and heights absorb the offset,
and residuals hardly show it. The water level and control points reveal an offset of the heights.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.adjust.block import (
    FIRST_SIGMA_PX,
    Material,
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
from pcfix.adjust.from_cloud import adjust_cloud
from pcfix.adjust.from_ties import adjust_ties, default_lens
from pcfix.adjust.precision import undetermined
from pcfix.adjust.problem import intersect_fixed
from pcfix.adjust.result import Adjusted
from pcfix.adjust.solve import Progress, reduced_at, solver
from pcfix.errors import GeometryError, PcfixWarning, SettingError
from pcfix.model import Cameras, FloatArray, GroundControl, TiePoints, WaterSurface
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
    original, water = material.original, material.water
    if cloud_xyz is not None:
        ties = ties_of_cloud(cloud_xyz, views_in_frame(cloud_xyz, original), original)
    if ties is None or len(ties.xyz) < LEAST_TIES:
        words = (
            f"{material.name}: no image shows the cloud. Check the poses with 'pcfix cameras"
            " --cloud'."
        )
        raise GeometryError("cameras.no_overlap", words, path=material.name)
    # 1. What is free
    lens: tuple[str, ...] = rules.lens_unknowns or ()
    chooses_lens = rules.lens_unknowns is None and material.calibrated is None
    if chooses_lens:
        lens = default_lens(original.lenses or ())
    tilt = None if rules.sigma_tilt is None else float(np.tan(np.radians(rules.sigma_tilt)))
    stated = {"level": rules.sigma_level, "tilt": tilt, "index": rules.sigma_index}
    surface: dict[str, float] = dict.fromkeys(rules.free, np.inf)
    surface |= {name: sigma for name, sigma in stated.items() if sigma is not None}
    is_free = rules.datum == "free"
    unknowns = Unknowns(rules.poses, rules.fixed_images, lens, surface, free_network=is_free)

    # 2. The block, without images that have too few observations
    level_sigma_m = surface.get("level", 0.0)
    block = block_of(material, ties, rules.sigma_image or FIRST_SIGMA_PX, level_sigma_m)
    check_datum(block, unknowns, material.no_gnss)
    xyz = block.xyz[: len(ties.xyz)]
    wet = len(xyz) if water is None else int((surface_above(water, xyz).height_m > xyz[:, 2]).sum())
    if wet < SMALL_WATER:
        words = (
            f"Only {wet} of {len(xyz):,} points are below the water, so there is no refraction to"
            " adjust. Check the water level, or use an ordinary bundle adjustment."
        )
        raise GeometryError("water.below_points", words, wet=wet, points=len(xyz))
    rows, count, notes = well_seen(block), len(block.cameras), list[PcfixWarning]()
    if len(rows) < 2:
        words = (
            f"{material.name}: only {len(rows)} of {count} images have enough observations for a"
            " pose. Give a model with more tie points."
        )
        raise GeometryError("ties.few_images", words, path=material.name, images=len(rows))
    if len(rows) < count:
        lost = np.setdiff1d(np.arange(count), rows)
        words = (
            f"{len(lost)} of {count} images (first {block.cameras.labels[lost[0]]}) have too few"
            " observations for a pose and were excluded."
        )
        notes.append(PcfixWarning("ties.few_in_image", words, images=len(lost)))
    block = restricted(block, rows)

    # 3. The adjustment, and what its user should know
    if cloud_xyz is None:
        found = adjust_ties(
            block, unknowns, progress, sigma_px=rules.sigma_image, outliers=rules.outliers,
            choose_lens=chooses_lens,
        )  # fmt: skip
    else:
        surveyed = [] if material.control is None else [material.control.xyz]
        apparent = np.vstack([ties.xyz, *surveyed])
        found = adjust_cloud(
            block, some_cameras(original, rows), apparent, unknowns, progress,
            choose_lens=chooses_lens,
        )  # fmt: skip
    notes += [*_land_notes(water, found), *found.notes]
    bed_xy = found.xyz[found.is_wet & found.is_observed, :2]
    reach_m = float(np.sqrt(np.var(bed_xy, axis=0).sum())) if len(bed_xy) else 0.0
    notes += undetermined(found.precision, reach_m)
    if found.precision.members is None:
        words = (
            f"The block is too large ({len(block.cameras):,} images) for covariances of its points,"
            " so the correction cannot use the errors of the poses."
        )
        notes.append(PcfixWarning("adjust.too_large", words, images=len(block.cameras)))
    return replace(found, notes=[*notes, *datum_notes(found), *bed_notes(found)])


# Checks of what goes in


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


def _land_notes(water: WaterSurface | None, found: Adjusted) -> list[PcfixWarning]:
    """Return a warning if there is hardly any land; refuse that for a free water surface."""
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


def height_offset(found: Adjusted) -> tuple[float, float] | None:
    """Return how far the GNSS positions lie too high for a block, and the standard error, metres.

    It is one more unknown of all positions, estimated by one step from the solution. None if
    nothing is free.
    """
    problem, now, weight = found.problem, found.solution, found.block.gnss_weights[:, 2]
    with_poses = np.zeros((len(weight), 6))
    with_poses[:, 5] = weight
    spread = problem.spread(now.state)
    border = spread.T @ np.append(with_poses, np.zeros(problem.given.shared))
    matrix, right = reduced_at(problem, now)
    solve_for = solver(matrix)
    if solve_for is None or not border.any():
        return None
    # the poses and shared unknowns are eliminated
    by_border, by_right = border @ solve_for(np.column_stack([border, right]))
    variance = 1.0 / (weight.sum() + 1.0 / UNKNOWN_M**2 - by_border)
    pull = -weight @ np.nan_to_num(found.gnss_residual_m[:, 2]) - by_right
    return float(variance * pull), max(found.sigma0, 1.0) * float(np.sqrt(variance))


def datum_notes(found: Adjusted) -> list[PcfixWarning]:
    """Return a warning if GNSS positions are few for a cloud, or too high or low for the block."""
    known = np.isfinite(found.gnss_residual_m)
    if not known.any() or found.unknowns.poses != "free" or found.unknowns.free_network:
        return []
    if found.source == "cloud":
        control = sum(row.role == "control" for row in found.control)
        count = int(known.all(axis=1).sum())
        if count + control >= FEW:
            return []
        words = (
            f"Only {count} GNSS positions and {control} control points determine the weight of the"
            " cloud. Give positions of more images, spread over the block, or control points."
        )
        return [PcfixWarning("gnss.few", words, gnss=count, control=control)]
    stated_m = float(np.median(found.block.gnss_sigma_m[known]))
    offset_m, sigma_m = height_offset(found) or (0.0, 0.0)
    if abs(offset_m) <= max(SIGMAS * sigma_m, OF_GNSS * stated_m):
        return []
    side, level = ("above", "low") if offset_m > 0.0 else ("below", "high")
    water = "" if found.water is None else f", or a water level that is too {level}"
    words = (
        f"The GNSS positions are {abs(offset_m):.2f} m {side} the projection centres (standard"
        f" error {sigma_m:.2f} m): an antenna lever arm, another height datum{water}. The block"
        " followed them. Correct them, or omit them if there are control points."
    )
    return [PcfixWarning("gnss.offset_found", words, offset_m=offset_m, sigma_m=sigma_m)]


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
