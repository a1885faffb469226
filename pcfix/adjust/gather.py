"""A block from what there is: tie points or the cloud, surveyed points, GNSS positions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import WATER, Block, Conditions, plain_block
from pcfix.errors import GeometryError, SettingError
from pcfix.lens.imaging import project, unproject
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    GroundControl,
    IntArray,
    Lens,
    TiePoints,
    Views,
    WaterDimension,
    WaterSurface,
)
from pcfix.port.shapes import Port
from pcfix.water.surface import surface_above

LEAST_VIEWS = 2
LEAST_SEEN = 4
"""Points in an image: three have up to four poses."""

LEAST_ANGLE_DEG = 2.0
"""Between the rays of a tie point: a point of less is hardly known, and tells hardly anything."""

LEAST_DETERMINANT = 1e-5
"""Of the normal matrix of unit rays: two at a third of a degree."""

TIE_POINTS = 150_000
"""At most; more tell nothing new, as their number beats down the noise of single images only."""

FIRST_SIGMA_PX = 1.0
"""Of measured tie points, until the adjustment itself has told it."""


class Datum(NamedTuple):
    """GNSS positions in the block's frame, shape (k, 3); NaN and infinite where there is none."""

    xyz: FloatArray
    sigma_m: FloatArray


LEAST_GNSS_SIGMA_M = 0.02
FAR_OFF_M, FAR_OFF_SIGMAS = 1.0, 10.0
"""Mean distance of GNSS positions from the projection centres that no adjustment leaves, where it
is also so many standard deviations: another datum."""


def no_datum(k: int) -> Datum:
    """Return the datum of a block without GNSS."""
    return Datum(np.full((k, 3), np.nan), np.full((k, 3), np.inf))


def datum_of(
    centres: FloatArray, found: Datum, name: str, sigma_m: float | None
) -> tuple[Datum, list[str]]:
    """Return GNSS positions with standard deviations, and what a user should know of them.

    Parameters
    ----------
    centres : array, shape (k, 3)
        Projection centres, metres.
    found : Datum
        As they were read: both are NaN where unknown.
    name : str
        Of their file, for messages.
    sigma_m : float or None
        Of those whose file states none; None: as they lie about the projection centres.

    Raises
    ------
    GeometryError
        If they lie off as a whole: another datum or CRS.
    """
    known = np.isfinite(found.xyz)
    if not known.any():
        return no_datum(len(centres)), []
    sigma = np.where(known, found.sigma_m, np.inf)
    silent = known & ~np.isfinite(found.sigma_m)
    off = np.where(known, centres - found.xyz, np.nan)
    notes = []
    if silent.any() and sigma_m is None:
        rest = off - np.nanmedian(off, axis=0)
        sigma_m = max(1.4826 * float(np.nanmedian(np.abs(rest))), LEAST_GNSS_SIGMA_M)
        notes.append(
            f"the GNSS positions come without standard deviations; {sigma_m:.2f} m is taken, as"
            " they lie about the projection centres; --gnss-sigma says it yourself."
        )
    if silent.any():
        sigma[silent] = sigma_m
    mean = np.nan_to_num(np.nanmean(off, axis=0))
    typical = float(np.median(sigma[np.isfinite(sigma)]))
    if np.abs(mean).max() > max(FAR_OFF_M, FAR_OFF_SIGMAS * typical):
        x, y, z = (-mean).tolist()
        raise GeometryError(
            f"{name}: the GNSS positions lie {x:.2f}, {y:.2f}, {z:.2f} m (x, y, z) from the"
            " projection centres on average, which is another datum or CRS (heights above the"
            " ellipsoid?): name it with --gnss-crs, bring them into one, or align the model to them"
            " first."
        )
    return Datum(found.xyz, sigma), notes


def check_surface(water: WaterSurface | None) -> None:
    """Check that the water is known everywhere, as tie points have no dimensions.

    Raises
    ------
    SettingError
        If it is a dimension of the cloud.
    """
    if isinstance(water, WaterDimension):
        raise SettingError(
            f"water {water} is known at the points of the cloud only; an adjustment needs the water"
            " as a level, plane, raster, mesh or shoreline."
        )


@dataclass(frozen=True, eq=False)
class Material:
    """What a block is made of beside its observations; in one frame, metres, Z up.

    Attributes
    ----------
    name : str
        Of the model, for messages.
    old : Cameras
        As they came, with angles and lenses.
    water, refractive_index, port
        See `pcfix.adjust.block.Block`.
    gnss : Datum
    control : GroundControl or None
        Points to check with get no weight.
    calibrated : Lens or None
        Instead of the lenses of the cameras.
    inside : callable or None
        Whether places, x and y, may be under water; everywhere by default.
    level_sigma_m : float
        Standard deviation of the water level; infinite where it is to be found.
    no_gnss : str
        Why GNSS positions that there are do not count.
    parallel : tuple of str
        Planes on which control points lie, and the water, that are parallel.
    """

    name: str
    old: Cameras
    water: WaterSurface | None
    refractive_index: float
    gnss: Datum
    control: GroundControl | None = None
    port: Port | None = None
    calibrated: Lens | None = None
    inside: Callable[[FloatArray, FloatArray], BoolArray] | None = None
    level_sigma_m: float = 0.0
    no_gnss: str = ""
    parallel: tuple[str, ...] = ()

    @property
    def start(self) -> Cameras:
        """The cameras from which the adjustment starts."""
        if self.calibrated is None:
            return self.old
        return replace(self.old, lenses=(self.calibrated,) * len(self.old))


def block_of(material: Material, ties: TiePoints, sigma_px: float) -> Block:
    """Return the block of tie points and surveyed points.

    Parameters
    ----------
    material : Material
    ties : TiePoints
        Apparent points, in the frame of the cameras.
    sigma_px : float
        Of their image places.

    Raises
    ------
    GeometryError
        If a control point lies under water and the survey does not say so.
    """
    water, n, inside = material.water, material.refractive_index, material.inside
    wet = np.ones(len(ties.xyz), np.bool_) if inside is None else inside(*ties.xyz[:, :2].T)
    ties = replace(ties, xyz=true_start(ties.xyz, water, n, wet))
    block = replace(
        plain_block(material.start, ties, water, n, wet),
        sigma_px=np.full(len(ties.views.camera), sigma_px),
        gnss_xyz=material.gnss.xyz,
        gnss_sigma_m=material.gnss.sigma_m,
        port=material.port,
    )
    control = material.control
    if control is None:
        return block
    _check_under_water(control, water, material.level_sigma_m)
    marks, sigma = marks_of(control)
    held = np.where(control.is_check[:, None], np.inf, control.sigma_m)
    under_water = control.under_water.copy()
    xyz = control.xyz
    if control.on:
        bare, on = np.asarray(np.isnan(xyz).any(axis=1)), np.array(control.on)
        under_water[bare] = on[bare] != WATER
        places = with_places(marks, material.old).xyz
        xyz = np.where(bare[:, None], true_start(places, water, n, under_water), xyz)
        if np.isnan(xyz).any():
            name = control.names[int(np.argmax(np.isnan(xyz).any(axis=1)))]
            raise GeometryError(
                f"point {name}: has no coordinates, and its marks do not meet in a place; mark it"
                " in two images at least, from different sides."
            )
    return replace(
        block,
        xyz=np.vstack([block.xyz, xyz]),
        conditions=_conditions(control, len(block.xyz), material.parallel),
        start=np.concatenate([block.start, marks.views.start[1:] + block.start[-1]]),
        camera=np.concatenate([block.camera, marks.views.camera]),
        image_xy=np.vstack([block.image_xy, marks.image_xy]),
        sigma_px=np.concatenate([block.sigma_px, sigma]),
        wet=np.concatenate([block.wet, under_water]),
        surveyed_xyz=np.vstack([block.surveyed_xyz, control.xyz]),
        surveyed_sigma_m=np.vstack([block.surveyed_sigma_m, held]),
        control_names=control.names,
        is_check=control.is_check,
    )


def _conditions(control: GroundControl, ties: int, parallel: tuple[str, ...]) -> Conditions | None:
    """Return on which surfaces control points lie, that follow so many tie points."""
    if not any(control.on):
        return None
    names = tuple(dict.fromkeys(name for name in control.on if name and name != WATER))
    number = {"": -1, WATER: 0} | {name: i for i, name in enumerate(names, start=1)}
    on = np.array([-1] * ties + [number[name] for name in control.on])
    return Conditions(names, on, np.concatenate([np.ones(ties), control.on_sigma_m]), parallel)


def marks_of(control: GroundControl) -> tuple[TiePoints, FloatArray]:
    """Return surveyed points with their marks as tie points, and the marks' standard deviations.

    Those of check points are infinite.
    """
    order = np.argsort(control.point, kind="stable")
    counts = np.bincount(control.point, minlength=len(control.names))
    views = Views(np.concatenate([[0], np.cumsum(counts)]), control.camera[order])
    sigma = np.where(control.is_check[control.point[order]], np.inf, control.sigma_px[order])
    return TiePoints(control.xyz, views, control.image_xy[order]), sigma


def _check_under_water(
    control: GroundControl, water: WaterSurface | None, level_sigma_m: float
) -> None:
    if water is None:
        return
    level = surface_above(water, control.xyz).height_m
    least = level - 3.0 * np.hypot(control.sigma_m[:, 2], level_sigma_m)
    deep = (control.xyz[:, 2] < least) & ~control.under_water
    if deep.any():
        i = int(np.argmax(deep))
        raise GeometryError(
            f"control point {control.names[i]}: its height {control.xyz[i, 2]:.3f} m is below the"
            f" water surface ({level[i]:.3f} m), and the survey does not say that it lies under"
            " water: add a column under_water with yes to the file, or check height datum and"
            " level."
        )


def true_start(
    xyz: FloatArray, water: WaterSurface | None, n: float, allowed: BoolArray | None = None
) -> FloatArray:
    """Return apparent points with their depths times n, where a true point may be looked for."""
    if water is None:
        return xyz.copy()
    level = surface_above(water, xyz).height_m
    below = level > xyz[:, 2]
    return deeper(xyz, level, below if allowed is None else below & allowed, n)


def deeper(
    apparent: FloatArray, level_m: FloatArray, wet: BoolArray, refractive_index: float
) -> FloatArray:
    """Return about where apparent points are: straight down the depth grows by the index."""
    true = apparent.copy()
    true[wet, 2] = level_m[wet] - refractive_index * (level_m - apparent[:, 2])[wet]
    return true


def usable_ties(ties: TiePoints, cameras: Cameras, most: int = TIE_POINTS) -> TiePoints:
    """Return the tie points that can be adjusted.

    Those with a place in space, two images or more, and rays that meet at an angle; a random part
    of them where they are very many.
    """
    seen = np.diff(ties.views.start) >= LEAST_VIEWS
    rows = np.flatnonzero(np.isfinite(ties.xyz).all(axis=1) & seen)
    rows = rows[_ray_angle_deg(taken(ties, rows), cameras) >= LEAST_ANGLE_DEG]
    if len(rows) > most:
        rows = np.sort(np.random.default_rng(0).choice(rows, most, replace=False))
    return taken(ties, rows)


def with_places(ties: TiePoints, cameras: Cameras) -> TiePoints:
    """Return tie points, those without a place in space put where their straight rays meet best.

    Least squares of the distances from the rays, which is near enough to start from.
    """
    lost = np.flatnonzero(~np.isfinite(ties.xyz).all(axis=1) & (np.diff(ties.views.start) >= 2))
    if len(lost) == 0 or cameras.lenses is None or cameras.rotations is None:
        return ties
    some = taken(ties, lost)
    owner = np.repeat(np.arange(len(lost)), np.diff(some.views.start))
    ray = np.full((len(owner), 3), np.nan)
    for c in np.unique(some.views.camera):
        entries = some.views.camera == c
        ray[entries] = unproject(cameras.lenses[c], some.image_xy[entries]) @ cameras.rotations[c]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    middle = cameras.centres.mean(axis=0)
    centre = cameras.centres[some.views.camera] - middle
    normal, right = np.zeros((len(lost), 3, 3)), np.zeros((len(lost), 3))
    np.add.at(normal, owner, across)
    np.add.at(right, owner, np.einsum("oij,oj->oi", across, centre))
    finite = np.flatnonzero(np.isfinite(normal).all(axis=(1, 2)))
    known = finite[np.linalg.det(normal[finite]) > LEAST_DETERMINANT]
    xyz = ties.xyz.copy()
    meet = np.linalg.solve(normal[known], right[known][:, :, None])[:, :, 0]
    xyz[lost[known]] = meet + middle
    return replace(ties, xyz=xyz)


def taken(ties: TiePoints, rows: IntArray) -> TiePoints:
    """Return some of the tie points, in the given order."""
    first, counts = ties.views.start[rows], np.diff(ties.views.start)[rows]
    begin = np.cumsum(counts) - counts
    where = np.repeat(first - begin, counts) + np.arange(counts.sum())
    return TiePoints(ties.xyz[rows], ties.views.take(rows), ties.image_xy[where])


def _ray_angle_deg(ties: TiePoints, cameras: Cameras) -> FloatArray:
    """Return about the largest angle between the rays of each point: twice that to their mean."""
    owner = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    ray = cameras.centres[ties.views.camera] - ties.xyz[owner]
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    mean = np.zeros((len(ties.xyz), 3))
    np.add.at(mean, owner, ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    cosine = np.full(len(mean), 1.0)
    np.minimum.at(cosine, owner, np.einsum("oi,oi->o", ray, mean[owner]))
    return 2.0 * np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def ties_of_cloud(xyz: FloatArray, views: Views, cameras: Cameras) -> TiePoints:
    """Return apparent points, shape (m, 3), as tie points: where cameras image them, straight.

    The views say which cameras made them, or hold them in frame.
    """
    if cameras.lenses is None or cameras.rotations is None:
        raise GeometryError("an adjustment needs cameras with angles and lenses.")
    owner = np.repeat(np.arange(len(xyz)), np.diff(views.start))
    image = np.empty((len(owner), 2))
    for c in range(len(cameras)):
        entries = views.camera == c
        ahead = (xyz[owner[entries]] - cameras.centres[c]) @ cameras.rotations[c].T
        image[entries] = project(cameras.lenses[c], ahead)
    seen = np.isfinite(image).all(axis=1)
    counts = np.bincount(owner[seen], minlength=len(xyz))
    start = np.concatenate([[0], np.cumsum(counts)])
    tracks = Views(start, np.asarray(views.camera)[seen])
    rows = np.flatnonzero(counts >= LEAST_VIEWS)
    return taken(TiePoints(xyz, tracks, image[seen]), rows)


def straight_images(xyz: FloatArray, camera: IntArray, cameras: Cameras) -> FloatArray:
    """Return where cameras image points by straight rays, a camera for each, shape (o, 2)."""
    rotations, lenses = np.asarray(cameras.rotations), cameras.lenses or ()
    local = np.einsum("oij,oj->oi", rotations[camera], xyz - cameras.centres[camera])
    image_xy = np.empty((len(local), 2))
    for c in np.unique(camera):
        image_xy[camera == c] = project(lenses[c], local[camera == c])
    return image_xy


def well_seen(block: Block) -> IntArray:
    """Return rows of the images with observations enough to find their pose."""
    counts = np.bincount(block.camera[np.isfinite(block.sigma_px)], minlength=len(block.cameras))
    return np.flatnonzero(counts >= LEAST_SEEN)


def restricted(block: Block, rows: IntArray) -> Block:
    """Return a block with some of its images, in the given order."""
    place = np.full(len(block.cameras), -1)
    place[rows] = np.arange(len(rows))
    kept = place[block.camera] >= 0
    counts = np.bincount(block.owner[kept], minlength=len(block.xyz))
    return replace(
        block,
        cameras=some_cameras(block.cameras, rows),
        start=np.concatenate([[0], np.cumsum(counts)]),
        camera=place[block.camera[kept]],
        image_xy=block.image_xy[kept],
        sigma_px=block.sigma_px[kept],
        gnss_xyz=block.gnss_xyz[rows],
        gnss_sigma_m=block.gnss_sigma_m[rows],
    )


def some_cameras(cameras: Cameras, rows: IntArray) -> Cameras:
    """Return some of the cameras, in the given order, without what was read beside them."""
    return replace(
        cameras,
        labels=tuple(cameras.labels[i] for i in rows),
        centres=cameras.centres[rows],
        rotations=None if cameras.rotations is None else cameras.rotations[rows],
        lenses=None if cameras.lenses is None else tuple(cameras.lenses[i] for i in rows),
        gnss=None,
    )
