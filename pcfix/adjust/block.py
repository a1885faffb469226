"""A block of images: tie points, control points and GNSS positions, and what refracts the rays.

Everything is in one frame, metres, Z up.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pcfix.errors import GeometryError
from pcfix.lens.imaging import straight_images, unproject
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    GnssPositions,
    GroundControl,
    IntArray,
    TiePoints,
    Views,
    WaterSurface,
)
from pcfix.port.housing import Port
from pcfix.water.surface import surface_above

WATER = "water"  # the name of the water among the surfaces of control points

LEAST_VIEWS = 2
LEAST_POINTS_IN_IMAGE = 4  # a pose has up to four solutions with three points
LEAST_ANGLE_DEG = 2.0  # between the rays of a tie point; smaller ones hardly determine its depth
LEAST_DETERMINANT = 1e-5  # of the normal matrix of unit rays: two at a third of a degree
TIE_POINTS = 150_000  # at most; more reduce only the noise, then no longer the largest error

NO_CONTROL = GroundControl(
    (), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.bool_), np.zeros(0, np.bool_),
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Block:
    """Images, points and measurements."""

    cameras: Cameras  # start values of the exterior and interior orientation
    xyz: FloatArray  # (m, 3), start values of the true points: tie points, then control points
    start: IntArray  # (m + 1,), the observations of point i are start[i]:start[i + 1]
    camera: IntArray  # (o,), row of the cameras
    image_xy: FloatArray  # (o, 2), in the unit of the lens, from the upper left corner
    sigma_px: FloatArray  # (o,), of u and v; infinite for observations without weight
    # (m,), points that may be under water; refracted while they are below the surface
    wet: BoolArray
    gnss: GnssPositions  # of the k projection centres, NaN if unknown
    water: WaterSurface | None = None
    refractive_index: float = 1.0
    port: Port | None = None  # a housing port as the refracting surface, instead of water
    control: GroundControl = NO_CONTROL  # its points are the last ones; check points do not count
    # parallel planes on which control points lie, perhaps with `WATER`
    parallel: tuple[str, ...] = ()

    @property
    def owner(self) -> IntArray:
        """Row of the point of each observation."""
        return np.repeat(np.arange(len(self.xyz)), np.diff(self.start))

    @property
    def tie_points(self) -> int:
        """Number of tie points."""
        return len(self.xyz) - len(self.control.names)

    @property
    def is_check(self) -> BoolArray:
        """Check points, shape (m,)."""
        return np.append(np.zeros(self.tie_points, np.bool_), self.control.is_check)

    @property
    def survey(self) -> tuple[FloatArray, FloatArray]:
        """Coordinates of control points and their inverse variances, both (m, 3), else zero."""
        control, none = self.control, np.zeros((self.tie_points, 3))
        sigma_m = np.where(control.is_check[:, None], np.inf, control.sigma_m)
        weight = inverse_variances(control.xyz, sigma_m)
        return np.vstack([none, np.nan_to_num(control.xyz)]), np.vstack([none, weight])

    @property
    def gnss_weights(self) -> FloatArray:
        """Inverse variances of the GNSS positions, shape (k, 3); zero where there is none."""
        return inverse_variances(self.gnss.xyz, self.gnss.sigma_m)

    @property
    def surfaces(self) -> tuple[tuple[str, ...], IntArray, FloatArray]:
        """Surfaces on which points lie, which may be the water or planes.

        Names of the planes; of each point the number of its surface (0 the water, i + 1 plane i,
        -1 none), and the standard deviation of its distance in metres. These two are empty if no
        point lies on a surface.
        """
        control = self.control
        if not any(control.on):
            return (), np.zeros(0, np.int64), np.zeros(0)
        names = tuple(dict.fromkeys(name for name in control.on if name and name != WATER))
        number = {"": -1, WATER: 0} | {name: i for i, name in enumerate(names, start=1)}
        on = np.array([-1] * self.tie_points + [number[name] for name in control.on], np.int64)
        return names, on, np.append(np.ones(self.tie_points), control.on_sigma_m)


def inverse_variances(values: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return inverse variances; zero where the value or its standard deviation is unknown."""
    return np.where(np.isfinite(values), np.nan_to_num(1.0 / sigma**2), 0.0)


def plain_block(
    cameras: Cameras,
    ties: TiePoints,
    water: WaterSurface | None = None,
    refractive_index: float = 1.0,
    wet: BoolArray | None = None,
) -> Block:
    """Return a block of tie points only, with a standard deviation of 1 px; dry without `wet`."""
    views, unknown = ties.views, np.full((len(cameras), 3), np.nan)
    return Block(
        cameras, ties.xyz, views.start, views.camera, ties.image_xy, np.ones(len(views.camera)),
        np.zeros(len(ties.xyz), np.bool_) if wet is None else wet,
        GnssPositions(unknown, unknown, None), water, refractive_index,
    )  # fmt: skip


def block_of(
    cameras: Cameras,
    ties: TiePoints,
    water: WaterSurface | None,
    refractive_index: float,
    *,
    inside: Callable[[FloatArray, FloatArray], BoolArray] | None = None,
    control: GroundControl = NO_CONTROL,
    level_sigma_m: float = 0.0,
) -> Block:
    """Return the block of tie points and control points.

    The tie points are apparent points in the frame of the cameras. They may be under water where
    `inside`, a function of x and y, says so; everywhere without it. The standard deviation of the
    water level is infinite if it is free.
    """
    wet = np.ones(len(ties.xyz), np.bool_) if inside is None else inside(*ties.xyz[:, :2].T)
    begin = replace(ties, xyz=true_start(ties.xyz, water, refractive_index, wet))
    block = plain_block(cameras, begin, water, refractive_index, wet)

    # control points and their marks are appended
    xyz, under_water = control.xyz, control.under_water.copy()
    deep = [] if water is None else used_as_dry(control, water, level_sigma_m)
    if deep:
        words = (
            "Control points below the water surface are not marked as under water:"
            f" {', '.join(deep)}. Put yes into the column under_water, or check the height datum"
            " and the water level."
        )
        raise GeometryError("gcps.under_water", words, points=deep)
    marks, sigma_px = marks_of(control)
    bare = np.asarray(np.isnan(xyz).any(axis=1))
    if bare.any():  # points on surfaces without coordinates start where their rays meet
        under_water[bare] = np.array(control.on)[bare] != WATER
        places = with_places(marks, cameras).xyz
        start = true_start(places, water, refractive_index, under_water)
        xyz = np.where(bare[:, None], start, xyz)
    lost = np.isnan(xyz).any(axis=1)
    if lost.any():
        name = control.names[int(np.argmax(lost))]
        words = (
            f"Point {name} has no coordinates and its image rays do not intersect."
            " Mark it in at least two images from different directions."
        )
        raise GeometryError("gcps.no_coordinates", words, point=name)
    return replace(
        block,
        xyz=np.vstack([block.xyz, xyz]),
        start=np.append(block.start, marks.views.start[1:] + block.start[-1]),
        camera=np.append(block.camera, marks.views.camera),
        image_xy=np.vstack([block.image_xy, marks.image_xy]),
        sigma_px=np.append(block.sigma_px, sigma_px),
        wet=np.append(block.wet, under_water),
        control=control,
    )


def used_as_dry(
    control: GroundControl, water: WaterSurface, level_sigma_m: float = 0.0
) -> list[str]:
    """Return the names of points below the water that are not marked as under water.

    Their images show them too high, so an adjustment without water that used them is wrong.
    """
    level = surface_above(water, control.xyz).height_m
    least = level - 3.0 * np.hypot(control.sigma_m[:, 2], level_sigma_m)
    deep = (control.xyz[:, 2] < least) & ~control.under_water
    return [control.names[i] for i in np.flatnonzero(deep)]


def marks_of(control: GroundControl) -> tuple[TiePoints, FloatArray]:
    """Return surveyed points and their marks as tie points, and the marks' standard deviations.

    Those of check points are infinite.
    """
    order = np.argsort(control.point, kind="stable")
    counts = np.bincount(control.point, minlength=len(control.names))
    views = Views(np.concatenate([[0], np.cumsum(counts)]), control.camera[order])
    sigma = np.where(control.is_check[control.point[order]], np.inf, control.sigma_px[order])
    return TiePoints(control.xyz, views, control.image_xy[order]), sigma


def true_start(
    xyz: FloatArray, water: WaterSurface | None, n: float, allowed: BoolArray
) -> FloatArray:
    """Return apparent points with their depths times n, as start values of the true points.

    That is where they are seen vertically; only those `allowed` may be under water.
    """
    true = xyz.copy()
    if water is None:
        return true
    level = surface_above(water, xyz).height_m
    wet = (level > xyz[:, 2]) & allowed
    true[wet, 2] = level[wet] - n * (level - xyz[:, 2])[wet]
    return true


# Tie points


def some_ties(ties: TiePoints, rows: IntArray) -> TiePoints:
    """Return some of the tie points, in the given order."""
    of_observations = Views(ties.views.start, np.arange(len(ties.image_xy)))
    observations = of_observations.take(rows).camera
    return TiePoints(ties.xyz[rows], ties.views.take(rows), ties.image_xy[observations])


def well_observed(ties: TiePoints, kept: BoolArray, least: int = LEAST_VIEWS) -> TiePoints:
    """Return tie points with some of their observations, without points in too few images."""
    start = np.append(0, np.cumsum(kept))[ties.views.start]
    views = Views(start, np.asarray(ties.views.camera)[kept])
    rows = np.flatnonzero(np.diff(start) >= least)
    return some_ties(TiePoints(ties.xyz, views, ties.image_xy[kept]), rows)


def usable_ties(ties: TiePoints, cameras: Cameras) -> TiePoints:
    """Return the tie points that can be adjusted; a random part of them if there are very many.

    They have two images or more, and a sufficient angle between their rays: twice the largest angle
    between a ray and the mean ray of its point. Those without coordinates are intersected.
    """
    ties = with_places(ties, cameras)
    seen = np.diff(ties.views.start) >= LEAST_VIEWS
    rows = np.flatnonzero(np.isfinite(ties.xyz).all(axis=1) & seen)
    some = some_ties(ties, rows)
    first, counts = some.views.start[:-1], np.diff(some.views.start)
    ray = cameras.centres[some.views.camera] - np.repeat(some.xyz, counts, axis=0)
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    mean = np.add.reduceat(ray, first)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    cosine = np.minimum.reduceat((ray * np.repeat(mean, counts, axis=0)).sum(axis=1), first)
    angle_deg = 2.0 * np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    rows = rows[angle_deg >= LEAST_ANGLE_DEG]
    if len(rows) > TIE_POINTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, TIE_POINTS, replace=False))
    return some_ties(ties, rows)


def with_places(ties: TiePoints, cameras: Cameras) -> TiePoints:
    """Return tie points in which those without coordinates are intersected by straight rays.

    The sum of squared distances from the rays is minimised, which is good enough as a start:
    sum (I - r r') (Q - C) = 0 for unit rays r from the centres C.
    """
    seen = np.diff(ties.views.start) >= LEAST_VIEWS
    lost = np.flatnonzero(~np.isfinite(ties.xyz).all(axis=1) & seen)
    rotations, lenses = np.asarray(cameras.rotations), cameras.lenses or ()
    some = some_ties(ties, lost)
    first, camera = some.views.start[:-1], some.views.camera
    ray = np.full((len(camera), 3), np.nan)
    for c in np.unique(camera):
        ray[camera == c] = unproject(lenses[c], some.image_xy[camera == c]) @ rotations[c]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    middle = cameras.centres.mean(axis=0)
    right = np.einsum("oij,oj->oi", across, cameras.centres[camera] - middle)
    across, right = np.add.reduceat(across, first), np.add.reduceat(right, first)
    known = np.linalg.det(np.nan_to_num(across)) > LEAST_DETERMINANT
    xyz = ties.xyz.copy()
    xyz[lost[known]] = np.linalg.solve(across[known], right[known][:, :, None])[:, :, 0] + middle
    return replace(ties, xyz=xyz)


def ties_of_cloud(
    xyz: FloatArray, views: Views, cameras: Cameras, least: int = LEAST_VIEWS
) -> TiePoints:
    """Return apparent points in enough images, shape (m, 3), as tie points with straight rays.

    The views say which cameras contributed to them, or have them in their frame.
    """
    owner = np.repeat(np.arange(len(xyz)), np.diff(views.start))
    image_xy = straight_images(xyz[owner], np.asarray(views.camera), cameras)
    is_imaged = np.asarray(np.isfinite(image_xy).all(axis=1))
    return well_observed(TiePoints(xyz, views, image_xy), is_imaged, least)


# Some of the images


def well_seen(block: Block) -> IntArray:
    """Return the rows of the images with enough observations for a pose."""
    counts = np.bincount(block.camera[np.isfinite(block.sigma_px)], minlength=len(block.cameras))
    return np.flatnonzero(counts >= LEAST_POINTS_IN_IMAGE)


def restricted(block: Block, rows: IntArray) -> Block:
    """Return a block with some of its images, in the given order."""
    place = np.full(len(block.cameras), -1)
    place[rows] = np.arange(len(rows))
    is_left, gnss = place[block.camera] >= 0, block.gnss
    return replace(
        block,
        cameras=some_cameras(block.cameras, rows),
        start=np.append(0, np.cumsum(is_left))[block.start],
        camera=place[block.camera[is_left]],
        image_xy=block.image_xy[is_left],
        sigma_px=block.sigma_px[is_left],
        gnss=GnssPositions(gnss.xyz[rows], gnss.sigma_m[rows], gnss.crs),
    )


def some_cameras(cameras: Cameras, rows: IntArray) -> Cameras:
    """Return some of the cameras, in the given order, without their GNSS positions."""
    return replace(
        cameras,
        labels=tuple(cameras.labels[i] for i in rows),
        centres=cameras.centres[rows],
        rotations=None if cameras.rotations is None else cameras.rotations[rows],
        lenses=None if cameras.lenses is None else tuple(cameras.lenses[i] for i in rows),
        gnss=None,
    )
