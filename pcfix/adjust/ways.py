"""A block adjusted by its tie points, or by the cloud, and what must hold of it for that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.adjust.block import CODES, Block, Unknowns, plain_block
from pcfix.adjust.datum import bed_notes, datum_notes
from pcfix.adjust.gather import (
    FIRST_SIGMA_PX,
    Material,
    block_of,
    marks_of,
    restricted,
    some_cameras,
    ties_of_cloud,
    well_seen,
)
from pcfix.adjust.lens_choice import default_lens
from pcfix.adjust.mend import Candidate, mend
from pcfix.adjust.precision import shape_doubts, strong_correlations, undetermined
from pcfix.adjust.problem import Progress, intersect_fixed
from pcfix.adjust.result import Adjusted
from pcfix.adjust.rounds import adjust_ties, check_datum
from pcfix.errors import GeometryError, SettingError
from pcfix.model import Cameras, FloatArray, GroundControl, IntArray, TiePoints, Views, WaterSurface
from pcfix.options.survey import AdjustRules
from pcfix.water.surface import surface_above

LEAST_TIES = 100
SMALL_WATER = 10
"""Tie points on one side of the surface, at least, so that both sides count as observed."""

GROSS_SIGMAS, GROSS_PX = 20.0, 10.0
"""A control point that is off by more than both was not measured badly but mixed up."""


ELSEWHERE = 0.1
"""Of the flying height: no block is bent so far that a control point is off by as much."""


_REMEDY = (
    "Check its name, its coordinates and its marks; names that are swapped look like this. A point"
    " with the role check does not count."
)


def unknowns_of(rules: AdjustRules, lens: tuple[str, ...]) -> Unknowns:
    """Return what moves, with these lens parameters.

    Raises
    ------
    SettingError
        If one of those that the user names is none.
    """
    for name in rules.lens_unknowns or ():
        if name not in CODES:
            raise SettingError(
                f"lens parameter '{name}' must be among {', '.join(CODES)}, or none."
            )
    tilt = None if rules.sigma_tilt is None else float(np.tan(np.radians(rules.sigma_tilt)))
    sigma = {"level": rules.sigma_level, "tilt": tilt, "index": rules.sigma_index}
    water = {
        name: (np.inf if value is None else value) if name in rules.free or value else 0.0
        for name, value in sigma.items()
    }
    return Unknowns(
        poses=rules.poses,
        fixed_images=rules.fixed_images,
        lens=lens,
        level_sigma_m=water["level"],
        tilt_sigma=water["tilt"],
        index_sigma=water["index"],
        shape_sigma=np.inf if "shape" in rules.free else 0.0,
        distance_sigma_m=np.inf if "distance" in rules.free else 0.0,
        centre_sigma_m=np.inf if "centre" in rules.free else 0.0,
        free_network=rules.datum == "free",
    )


def _lens_of(material: Material, rules: AdjustRules) -> tuple[str, ...]:
    """Return the lens parameters that may move: those named, none of a calibration, or default."""
    if rules.lens_unknowns is not None:
        return rules.lens_unknowns
    return () if material.calibrated is not None else default_lens(material.old.lenses or ())


def by_ties(
    material: Material, ties: TiePoints, rules: AdjustRules, progress: Progress | None = None
) -> Adjusted:
    """Adjust a block by measured tie points.

    Raises
    ------
    GeometryError
        If it cannot be adjusted: no datum, no water over it, images without points.
    """
    block = block_of(material, ties, rules.sigma_image or FIRST_SIGMA_PX)
    unknowns = unknowns_of(rules, _lens_of(material, rules))
    check_datum(block, unknowns, material.no_gnss)
    _check_wet(material.water, block.xyz[: len(ties.xyz)])
    kept, left_out = _kept(material.name, block)
    found = adjust_ties(
        restricted(block, kept), unknowns, progress, sigma_px=rules.sigma_image,
        outliers=rules.outliers,
        choose_lens=rules.lens_unknowns is None and material.calibrated is None,
    )  # fmt: skip
    notes = [*left_out, *_check_dry(material.water, found), *found.notes]
    if found.precision is not None:
        notes += undetermined(found.precision, unknowns)
        notes += strong_correlations(found.precision)
        if found.origin is not None:
            wet = found.is_wet & np.isfinite(found.xyz).all(axis=1)
            notes += shape_doubts(found.precision, (found.xyz - found.origin)[wet, :2])
    return replace(found, notes=[*notes, *datum_notes(found), *bed_notes(found)])


def by_cloud(
    material: Material, xyz: FloatArray, guesses: dict[str, Views], rules: AdjustRules,
    progress: Progress | None = None,
) -> Adjusted:  # fmt: skip
    """Adjust a block by points of the apparent cloud that it made, shape (m, 3).

    The guesses say which images made them, each under its name.

    Raises
    ------
    GeometryError
        If the images do not see the cloud, or as of `by_ties`.
    """
    candidates: list[Candidate] = []
    notes: list[str] = []
    for name, views in guesses.items():
        ties = ties_of_cloud(xyz, views, material.old)
        if len(ties.xyz) < LEAST_TIES:
            continue
        block = block_of(material, ties, FIRST_SIGMA_PX)
        check_datum(block, unknowns_of(rules, ()), material.no_gnss)
        surveyed = [] if material.control is None else [material.control.xyz]
        apparent = np.vstack([ties.xyz, *surveyed])
        kept, notes = (well_seen(block), notes) if len(guesses) > 1 else _kept(material.name, block)
        if len(kept) < 2:
            continue
        old = some_cameras(material.old, kept)
        candidates.append(Candidate(name, restricted(block, kept), old, apparent))
    if not candidates:
        raise GeometryError(
            f"{material.name}: the images do not see the cloud; check the poses with 'pcfix cameras"
            " --cloud'."
        )
    _check_wet(material.water, candidates[0].block.xyz)
    sets = [_lens_of(material, rules)]
    if rules.lens_unknowns is None and material.calibrated is None:
        sets = list(dict.fromkeys([("f",), ("f", "cx", "cy"), *sets]))
    found = mend(candidates, unknowns_of(rules, sets[0]), sets, progress)
    notes += [*_check_dry(material.water, found), *found.notes]
    return replace(found, notes=[*notes, *datum_notes(found), *bed_notes(found)])


def _check_wet(water: WaterSurface | None, xyz: FloatArray) -> None:
    """Check that there is water over some points."""
    if water is None:
        return
    below = int((surface_above(water, xyz).height_m > xyz[:, 2]).sum())
    if below < SMALL_WATER:
        raise GeometryError(
            f"only {below} of {len(xyz):,} points lie below the water, so there is no"
            " refraction to adjust: check the water level against the model's heights, or use"
            " an ordinary bundle adjustment."
        )


def _check_dry(water: WaterSurface | None, found: Adjusted) -> list[str]:
    """Check that land tells what of the water moved; an absorbed block may have sunk it."""
    if water is None:
        return []
    seen = np.zeros(len(found.xyz), np.bool_)
    seen[found.block.owner[found.used]] = True
    above = int((seen & ~found.is_wet).sum())
    if above >= SMALL_WATER:
        return []
    few = f"only {above} of {int(seen.sum()):,} points lie above the water"
    if any(found.unknowns.water_sigma):
        raise GeometryError(
            f"{few}: level, tilt and index cannot be told from the height of the block then;"
            " leave the water fixed."
        )
    return [f"{few}: nothing but GNSS and control points ties the heights of the bed."]


def _kept(name: str, block: Block) -> tuple[IntArray, list[str]]:
    """Return rows of the images that can be adjusted, and a note on those that cannot."""
    kept = well_seen(block)
    if len(kept) < 2:
        raise GeometryError(
            f"{name}: {len(kept)} of {len(block.cameras)} images have observations enough"
            " for a pose; two at least are needed."
        )
    lost = np.setdiff1d(np.arange(len(block.cameras)), kept)
    if not len(lost):
        return kept, []
    return kept, [
        f"{len(lost)} of {len(block.cameras)} images have too few observations for a pose"
        f" and are left out; the first is {block.cameras.labels[lost[0]]}."
    ]


def check_images(
    name: str, old: Cameras, water: WaterSurface | None, fixed_images: tuple[str, ...]
) -> None:
    """Check that the images named are there, and that the cameras are above the water."""
    missing = [label for label in fixed_images if label not in old.labels]
    if missing:
        raise SettingError(
            f"fixed image {missing[0]} is not in the model, which has {len(old)} images,"
            f" the first {old.labels[0]}."
        )
    if water is None:
        return
    level = surface_above(water, old.centres).height_m
    wet = np.flatnonzero(level > old.centres[:, 2])
    if len(wet):
        i = int(wet[0])
        raise GeometryError(
            f"{name}: {len(wet)} of {len(old)} cameras are under the water, the"
            f" first {old.labels[i]} at {old.centres[i, 2]:.2f} m; check the water"
            " level, its CRS and that of the cameras; for images taken under water give --port."
        )


def check_marks(
    control: GroundControl, cameras: Cameras, name: str, *, is_placed: bool = False
) -> None:
    """Refuse control points whose marks are somewhere else altogether, before any adjustment.

    Each point is intersected from the cameras as they came, with straight rays. All may lie off
    alike, as the block may where nothing else places it; one that lies elsewhere than the others
    was mixed up.

    Parameters
    ----------
    name : str
        Of the file.
    is_placed : bool
        Whether GNSS positions say already where the block is.

    Raises
    ------
    GeometryError
        Naming the point that is farthest off.
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
        raise GeometryError(
            f"{name}: the control points lie {x:.1f}, {y:.1f}, {z:.1f} m (x, y, z; the median) from"
            " where their marks meet, but the GNSS positions say that the block lies right: one of"
            " the two is in another CRS or height datum; name it with --gcps-crs or --gnss-crs."
        )
    worst = int(np.argmax(np.where(met, apart, 0.0)))
    if not apart[worst] > ELSEWHERE * height > 0.0:
        return
    raise GeometryError(
        f"{name}: control point {control.names[worst]} does not fit: its marks meet"
        f" {apart[worst]:.1f} m from its coordinates, the other points taken as right. {_REMEDY}"
    )


def check_control(found: Adjusted, name: str) -> None:
    """Refuse control points that are off by far more than they were measured to.

    The adjustment shares a gross error out between the place of the point and its marks, so that
    both count: the place as it shows in the images.

    Raises
    ------
    GeometryError
        Naming the point that is farthest off.
    """
    block = found.block
    first = len(block.xyz) - len(block.control_names)
    rows = np.flatnonzero(block.is_surveyed[first:])
    off = np.array([_off(found, first + int(i)) for i in rows])
    px, sigmas = off.reshape(-1, 2).T
    gross = (px > GROSS_PX) & (sigmas > GROSS_SIGMAS)
    if not gross.any():
        return
    worst = int(np.argmax(np.where(gross, px, 0.0)))
    others = int(gross.sum()) - 1
    more = f" ({others} more are off as well)" if others else ""
    raise GeometryError(
        f"{name}: control point {block.control_names[rows[worst]]} does not fit: it is off by"
        f" {px[worst]:.0f} px, {sigmas[worst]:.0f} standard deviations{more}. {_REMEDY}"
    )


def _off(found: Adjusted, point: int) -> tuple[float, float]:
    """Return by how much a control point is off in the images, and in standard deviations."""
    block = found.block
    marks = slice(block.start[point], block.start[point + 1])
    sigma_px, residual = block.sigma_px[marks], found.residual_px[marks]
    seen = np.isfinite(residual).all(axis=1) & np.isfinite(sigma_px)
    if not seen.any():
        return 0.0, 0.0
    off = np.linalg.norm(residual[seen], axis=1)
    known = np.isfinite(block.surveyed_sigma_m[point])
    place = np.where(known, found.xyz[point] - block.surveyed_xyz[point], 0.0)
    camera = block.camera[marks][seen]
    away = np.linalg.norm(found.cameras.centres[camera] - found.xyz[point], axis=1)
    focal = np.array([lens.focal for lens in found.cameras.lenses or ()])[camera]
    px = float(off.max() + np.linalg.norm(place) * float(np.median(focal / away)))
    of_place = np.abs(place[known] / block.surveyed_sigma_m[point][known]).max(initial=0.0)
    return px, float(max((off / sigma_px[seen]).max(), of_place))
