"""The adjustment of a block by tie points or by the cloud, with checks of what goes in and out."""

from dataclasses import replace
from typing import Any

import numpy as np

from pcfix.adjust.block import (
    LEAST_VIEWS,
    Block,
    marks_of,
    plain_block,
    restricted,
    some_cameras,
    well_seen,
)
from pcfix.adjust.from_cloud import adjust_cloud
from pcfix.adjust.from_ties import adjust_ties
from pcfix.adjust.parameters import Unknowns, words_of
from pcfix.adjust.precision import Precision
from pcfix.adjust.problem import intersect_fixed
from pcfix.adjust.result import Adjusted
from pcfix.errors import GeometryError, PcfixWarning
from pcfix.model import Cameras, FloatArray, GnssPositions, GroundControl
from pcfix.water.surface import surface_above

LEAST_GNSS_SIGMA_M = 0.02
# Mean offset between GNSS and projection centres that indicates another datum, if it exceeds both.
MOST_OFFSET_M, MOST_OFFSET_SIGMAS = 1.0, 10.0

GROSS_SIGMAS, GROSS_PX = 20.0, 10.0  # larger errors of a control point are a mistake, not noise
MOST_OFFSET = 0.1  # share of the flying height; absorbed refraction moves no control point so far

_REMEDY = (
    "Check its name, coordinates and marks (swapped names?). A point with the role check has no"
    " weight."
)

SMALL_WATER = 10  # tie points on one side of the surface that make it count as observed
BED_GSD = 1.5  # standard error of the heights of the bed, in ground pixels, that is worth a warning

# Standard errors beyond which an unknown counts as undetermined; 1e-4 / m is 2 cm at 14 m.
LIMITS = {
    "level": 0.02, "tilt_x": 0.0005, "tilt_y": 0.0005, "index": 0.005,
    "distance": 0.002, "centre_x": 0.002, "centre_y": 0.002, "centre_z": 0.002,
    "shape_xx": 1e-4, "shape_xy": 1e-4, "shape_yy": 1e-4,
}  # fmt: skip

STRONG = 0.95  # correlation of two unknowns that are hardly separated


def adjust_block(
    block: Block,
    unknowns: Unknowns,
    *,
    cloud: tuple[Cameras, FloatArray] | None = None,
    choose_lens: bool = True,
) -> Adjusted:
    """Adjust a block by measured tie points, or by its apparent cloud.

    `cloud` has the original cameras, and the apparent points, shape (m, 3), that the block has in
    place of tie points. `choose_lens`: the observations decide which lens parameters are free.
    """
    # 1. Images with too few observations are excluded
    water, xyz, count = block.water, block.xyz[: block.tie_points], len(block.cameras)
    wet = len(xyz) if water is None else int((surface_above(water, xyz).height_m > xyz[:, 2]).sum())
    if wet < SMALL_WATER:
        words = (
            f"Only {wet} of {len(xyz):,} points are below the water, so there is no refraction to"
            " adjust. Check the water level, or use an ordinary bundle adjustment."
        )
        raise GeometryError("water.below_points", words, wet=wet, points=len(xyz))
    rows, notes = well_seen(block), list[PcfixWarning]()
    if len(rows) < count:
        lost = np.setdiff1d(np.arange(count), rows)
        words = (
            f"{len(lost)} of {count} images (first {block.cameras.labels[lost[0]]}) have too few"
            " observations for a pose and were excluded."
        )
        notes.append(PcfixWarning("ties.few_in_image", words, images=len(lost)))
    block = restricted(block, rows)

    # 2. The adjustment
    if cloud is None:
        found = adjust_ties(block, unknowns, choose_lens=choose_lens)
    else:
        original, apparent = some_cameras(cloud[0], rows), np.vstack([cloud[1], block.control.xyz])
        found = adjust_cloud(block, original, apparent, unknowns, choose_lens=choose_lens)

    # 3. What its user should know
    above, count = int((found.is_observed & ~found.is_wet).sum()), int(found.is_observed.sum())
    if water is not None and above < SMALL_WATER:
        few = f"Only {above} of {count:,} points are above the water"
        if any(unknowns.water_sigma):
            words = (
                f"{few}, so level, tilt and index cannot be separated from the height of the block."
                " Fix the water."
            )
            raise GeometryError("water.no_land", words, land=above, points=count)
        words = f"{few}, so only GNSS and control points determine the heights of the bed."
        notes.append(PcfixWarning("water.no_land", words, land=above, points=count))
    notes += [*found.notes, *undetermined(found.precision), *_bed_notes(found)]
    return replace(found, notes=notes)


# Checks of what goes in


def gnss_with_sigma(
    centres: FloatArray, found: GnssPositions, name: str, sigma_m: float | None
) -> tuple[GnssPositions | None, list[PcfixWarning]]:
    """Return GNSS positions with standard deviations (infinite for unknown ones), and warnings.

    They are in the frame of the centres, shape (k, 3), metres; `name` is their file. Positions that
    state no standard deviation get `sigma_m`, or None estimates it from their scatter about the
    centres.
    """
    known = np.isfinite(found.xyz)
    if not known.any():
        return None, []
    sigma = np.where(known, found.sigma_m, np.inf)
    silent = known & ~np.isfinite(found.sigma_m)
    off, notes = np.where(known, centres - found.xyz, np.nan), []
    if silent.any() and sigma_m is None:
        rest = off - np.nanmedian(off, axis=0)
        sigma_m = max(1.4826 * float(np.nanmedian(np.abs(rest))), LEAST_GNSS_SIGMA_M)
        words = (
            f"The GNSS positions have no standard deviations; {sigma_m:.2f} m is assumed, from"
            " their scatter about the projection centres. Give --gnss-sigma if you know it."
        )
        notes.append(PcfixWarning("gnss.no_sigma", words, sigma_m=sigma_m))
    if silent.any():
        sigma[silent] = sigma_m
    mean = np.nan_to_num(np.nanmean(off, axis=0))
    typical = float(np.median(sigma[np.isfinite(sigma)]))
    if np.abs(mean).max() > max(MOST_OFFSET_M, MOST_OFFSET_SIGMAS * typical):
        x, y, z = (-mean).tolist()
        words = (
            f"{name}: the GNSS positions are on average {x:.2f}, {y:.2f}, {z:.2f} m (x, y, z) from"
            " the projection centres, so they have another datum or CRS (ellipsoidal heights?)."
            " Name it with --gnss-crs, or transform the positions or the model."
        )
        raise GeometryError("gnss.offset", words, path=name, offset_m=[x, y, z])
    return GnssPositions(found.xyz, sigma, None), notes


def check_datum(block: Block, unknowns: Unknowns, reason: str = "") -> None:
    """Check that GNSS, control points, fixed poses or a free network give a datum.

    `reason` is why GNSS positions are not used.
    """
    if unknowns.free_network or unknowns.poses == "fixed":
        return
    gnss = int((block.gnss_weights > 0.0).all(axis=1).sum())
    is_control = (block.survey[1] > 0.0).any(axis=1) & (np.diff(block.start) >= LEAST_VIEWS)
    control = int(is_control.sum())
    if gnss + control >= 3:
        return
    words = (
        f"Position, orientation and scale of the block are undetermined: {gnss} GNSS positions,"
        f" {control} control points in two or more images. Give --gnss or --gcps with three points"
        " or more, or --datum free to keep the mean of the original projection centres."
        + (f" {reason}" if reason else "")
    )
    raise GeometryError("adjust.no_datum", words, gnss=gnss, control=control)


def check_marks(
    control: GroundControl, cameras: Cameras, name: str, *, is_placed: bool = False
) -> None:
    """Refuse control points whose marks are somewhere else altogether, before any adjustment.

    Each point is intersected from the original cameras by straight rays. All may be offset alike,
    as the block may be unless GNSS positions have placed it (`is_placed`); one that is offset
    differently is a mistake. `name` is that of the file.
    """
    marks, _ = marks_of(control)
    off = intersect_fixed(plain_block(cameras, marks))[0] - control.xyz
    intersect = np.isfinite(off).all(axis=1) & (np.diff(marks.views.start) >= 2) & ~control.is_check
    if intersect.sum() < 3:
        return
    middle = np.median(off[intersect], axis=0)
    distance = np.where(intersect, np.linalg.norm(off - middle, axis=1), 0.0)
    height = float(np.median(cameras.centres[:, 2]) - np.nanmedian(control.xyz[:, 2]))
    if is_placed and np.abs(middle).max() > MOST_OFFSET * height > 0.0:
        x, y, z = (-middle).tolist()
        words = (
            f"{name}: the control points are {x:.1f}, {y:.1f}, {z:.1f} m (x, y, z; median) from the"
            " intersections of their marks, while the GNSS positions fit. One of the two has"
            " another CRS or height datum; name it with --gcps-crs or --gnss-crs."
        )
        raise GeometryError("gcps.offset", words, path=name, offset_m=[x, y, z])
    worst = int(np.argmax(distance))
    if distance[worst] > MOST_OFFSET * height > 0.0:
        point = control.names[worst]
        words = (
            f"{name}: control point {point} does not fit: its marks intersect"
            f" {distance[worst]:.1f} m from its coordinates, relative to the other points."
            f" {_REMEDY}"
        )
        raise GeometryError("gcps.gross_error", words, path=name, point=point)


# Checks of what comes out


def check_control(found: Adjusted, name: str) -> None:
    """Refuse control points with gross errors.

    The adjustment distributes a gross error over the coordinates of the point and its marks, so
    both count: the coordinates as they appear in the images.
    """
    control, errors = found.block.control, []
    focal = float(np.median([lens.focal for lens in found.cameras.lenses or ()]))
    for row in found.control:
        i = control.names.index(row.name)
        off_m = np.array([row.dx_m, row.dy_m, row.dz_m])
        away_m = float(np.linalg.norm(found.cameras.centres - control.xyz[i], axis=1).min())
        px = row.rms_px + float(np.linalg.norm(off_m)) * focal / away_m
        of_marks = row.rms_px / float(np.median(control.sigma_px))
        sigmas = max(of_marks, float((np.abs(off_m) / control.sigma_m[i]).max()))
        if row.role == "control" and px > GROSS_PX and sigmas > GROSS_SIGMAS:
            errors.append((px, sigmas, row.name))
    if errors:
        px, sigmas, point = max(errors)
        words = (
            f"{name}: control point {point} does not fit: its error is {px:.0f} px or"
            f" {sigmas:.0f} standard deviations. {_REMEDY}"
        )
        raise GeometryError("gcps.gross_error", words, path=name, point=point, off_px=px)


def _bed_notes(found: Adjusted) -> list[PcfixWarning]:
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
        f"The heights of the bed have a median standard error of {sigma_m:.2f} m ({gsd:.1f} ground"
        " pixels). Give control points, GNSS positions of more images that are not on one line,"
        " or a calibrated lens."
    )
    return [PcfixWarning("adjust.imprecise_bed", words, sigma_m=sigma_m, gsd=gsd)]


def undetermined(precision: Precision) -> list[PcfixWarning]:
    """Return a warning for each unknown whose standard error is too large to be useful.

    It names the unknown from which this one is hardly separated, if there is one.
    """
    notes, names = [], [*precision.shared]
    for i, (name, row) in enumerate(precision.shared.items()):
        (what, unit), limit = words_of(name), LIMITS.get(name, np.inf)
        if row.sigma <= limit:
            continue
        words = (
            f"the {what} is undetermined: standard error {row.sigma:.2g}{unit} (limit"
            f" {limit:.2g}{unit})."
        )
        values: dict[str, Any] = {"unknown": name, "sigma": row.sigma}
        r = np.where(np.arange(len(names)) == i, 0.0, precision.correlation[i])
        other = int(np.abs(r).argmax())
        if abs(r[other]) > STRONG:
            values["correlated_with"] = names[other]
            pair = words_of(names[other])[0]
            words += f" It is strongly correlated with the {pair} (r = {r[other]:.3f})."
        words += " Fix it to a measured value, or give control points at several heights."
        notes.append(PcfixWarning("adjust.undetermined", words, **values))
    return notes
