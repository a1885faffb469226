"""A block from what there is: tie points or the cloud, surveyed points, GNSS positions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import Block
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
    SettingError
        If the water is a dimension of the cloud, which tie points do not have.
    GeometryError
        If a control point lies under water and the survey does not say so.
    """
    water, control = material.water, material.control
    check_surface(water)
    m, inside = len(ties.xyz), material.inside
    wet = None if inside is None else inside(ties.xyz[:, 0], ties.xyz[:, 1])
    sigma = np.full(len(ties.views.camera), sigma_px)
    xyz = true_start(ties.xyz, water, material.refractive_index, wet)
    parts = [(xyz, ties.views.start, ties.views.camera, ties.image_xy, sigma)]
    names: tuple[str, ...] = ()
    is_check = np.zeros(0, np.bool_)
    if control is not None:
        _check_under_water(control, water, material.level_sigma_m)
        names, is_check = control.names, control.is_check
        parts.append(_control_part(control))
    allowed = np.ones(m, np.bool_) if wet is None else wet
    surveyed_xyz, surveyed_sigma = np.full((m, 3), np.nan), np.full((m, 3), np.inf)
    if control is not None:
        held = np.where(is_check[:, None], np.inf, control.sigma_m)
        surveyed_xyz = np.vstack([surveyed_xyz, control.xyz])
        surveyed_sigma = np.vstack([surveyed_sigma, held])
        allowed = np.concatenate([allowed, control.under_water])
    starts = [parts[0][1]] + [part[1][1:] + parts[0][1][-1] for part in parts[1:]]
    return Block(
        cameras=material.start,
        xyz=np.vstack([part[0] for part in parts]),
        start=np.concatenate(starts),
        camera=np.concatenate([part[2] for part in parts]),
        image_xy=np.vstack([part[3] for part in parts]),
        sigma_px=np.concatenate([part[4] for part in parts]),
        water=water,
        refractive_index=material.refractive_index,
        wet=allowed,
        surveyed_xyz=surveyed_xyz,
        surveyed_sigma_m=surveyed_sigma,
        gnss_xyz=material.gnss.xyz,
        gnss_sigma_m=material.gnss.sigma_m,
        port=material.port,
        control_names=names,
        is_check=is_check,
    )


def _control_part(
    control: GroundControl,
) -> tuple[FloatArray, IntArray, IntArray, FloatArray, FloatArray]:
    order = np.argsort(control.point, kind="stable")
    counts = np.bincount(control.point, minlength=len(control.names))
    start = np.concatenate([[0], np.cumsum(counts)])
    point = control.point[order]
    sigma = np.where(control.is_check[point], np.inf, control.sigma_px[order])
    return control.xyz, start, control.camera[order], control.image_xy[order], sigma


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
    xyz: FloatArray, water: WaterSurface | None, n: float, wet: BoolArray | None = None
) -> FloatArray:
    """Return apparent points with their depths times n, where a true point may be looked for."""
    if water is None:
        return xyz.copy()
    level = surface_above(water, xyz).height_m
    below = level > xyz[:, 2]
    if wet is not None:
        below &= wet
    moved = xyz.copy()
    moved[below, 2] = level[below] - n * (level[below] - xyz[below, 2])
    return moved


def usable_ties(
    ties: TiePoints, cameras: Cameras, most: int = TIE_POINTS, seed: int = 0
) -> TiePoints:
    """Return the tie points that can be adjusted.

    Those with a place in space, two images or more, and rays that meet at an angle; a random part
    of them where they are very many.
    """
    counts = np.diff(ties.views.start)
    good = np.isfinite(ties.xyz).all(axis=1) & (counts >= LEAST_VIEWS)
    rows = np.flatnonzero(good)
    rows = rows[_ray_angle_deg(taken(ties, rows), cameras) >= LEAST_ANGLE_DEG]
    if len(rows) > most:
        rows = np.sort(np.random.default_rng(seed).choice(rows, most, replace=False))
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
        mine = some.views.camera == c
        ray[mine] = unproject(cameras.lenses[c], some.image_xy[mine]) @ cameras.rotations[c]
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
    """Return apparent points as tie points: where the cameras image them, straight.

    Parameters
    ----------
    xyz : array, shape (m, 3)
    views : Views
        Which cameras made them, or hold them in frame.
    cameras : Cameras
    """
    if cameras.lenses is None or cameras.rotations is None:
        raise GeometryError("an adjustment needs cameras with angles and lenses.")
    owner = np.repeat(np.arange(len(xyz)), np.diff(views.start))
    image = np.empty((len(owner), 2))
    for c in range(len(cameras)):
        mine = views.camera == c
        ahead = (xyz[owner[mine]] - cameras.centres[c]) @ cameras.rotations[c].T
        image[mine] = project(cameras.lenses[c], ahead)
    seen = np.isfinite(image).all(axis=1)
    counts = np.bincount(owner[seen], minlength=len(xyz))
    start = np.concatenate([[0], np.cumsum(counts)])
    tracks = Views(start, np.asarray(views.camera)[seen])
    rows = np.flatnonzero(counts >= LEAST_VIEWS)
    return taken(TiePoints(xyz, tracks, image[seen]), rows)


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
