"""A block of images: what was measured, what may move, and the parameters of its lenses.

`Material` is what the doors read; `block_of` makes a `Block` of it with tie points or points of the
cloud. Everything is in one frame, metres, Z up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning
from pcfix.lens.imaging import straight_images, unproject
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    GnssPositions,
    GroundControl,
    IntArray,
    Lens,
    TiePoints,
    Views,
    WaterSurface,
)
from pcfix.port.shapes import Port
from pcfix.water.surface import surface_above

WATER_NAMES = (
    *("level", "tilt_x", "tilt_y", "index", "shape_xx", "shape_xy", "shape_yy"),
    *("distance", "centre_x", "centre_y", "centre_z"),
)
"""Parameters of the refracting surface: of the water, then of a housing port.

The water is z = a + b x + c y + d x^2 + e x y + f y^2 about the origin of the block; a mesh or
raster stays where it is.
"""
INDEX, SHAPE, PORT, PLANES = 3, 4, 7, 11
"""Positions of the index, of d, e, f, of the port's parameters, and of planes (`Conditions`)."""

MOTIONS = ("shift x", "shift y", "shift z", "turn x", "turn y", "turn z", "scale")
"""Parameters of a similarity transformation of all poses."""

WORDS = {
    "f": "focal length", "cx": "principal point x", "cy": "principal point y", "b1": "affinity b1",
    "b2": "skew b2", "level": "water level", "tilt_x": "water tilt along x",
    "tilt_y": "water tilt along y", "index": "refractive index", "shape_xx": "water shape x^2",
    "shape_xy": "water shape x y", "shape_yy": "water shape y^2", "distance": "port distance",
    "centre_x": "dome centre x", "centre_y": "dome centre y", "centre_z": "dome centre z",
    **{one: f"block {one}" for one in MOTIONS},
    **{one: f"distortion {one}" for one in ("p1", "p2", *(f"k{i}" for i in range(1, 9)))},
}  # fmt: skip
"""What a surveyor calls the shared unknowns."""

UNITS = {"level": " m", "tilt": " m/m", "shape": " /m", "distance": " m", "centre": " m",
         "shift": " m", "turn": " rad"}  # fmt: skip
"""By the first word of a name."""


def words_of(name: str) -> tuple[str, str]:
    """Return what a surveyor calls a shared unknown, and its unit; that of a lens is not known."""
    base, of, sensor = name.partition(" of sensor ")
    first = name.replace("_", " ").split()[0]
    return WORDS.get(base, base) + of + sensor, UNITS.get(first, "")


Poses = Literal["free", "fixed", "similarity"]

WATER = "water"
"""The name of the water among planes."""

LEAST_VIEWS = 2
LEAST_POINTS_IN_IMAGE = 4
"""A pose has up to four solutions with three points."""

LEAST_ANGLE_DEG = 2.0
"""Between the rays of a tie point; the depth of points with smaller angles is hardly determined."""

LEAST_DETERMINANT = 1e-5
"""Of the normal matrix of unit rays: two at a third of a degree."""

TIE_POINTS = 150_000
"""At most; more reduce only the noise, which is no longer the largest error then."""

FIRST_SIGMA_PX = 1.0
"""Of measured tie points, until the adjustment has estimated it."""

LEAST_GNSS_SIGMA_M = 0.02
MOST_OFFSET_M, MOST_OFFSET_SIGMAS = 1.0, 10.0
"""Mean offset between GNSS and projection centres that indicates another datum, if it exceeds
both."""

FEW_IMAGES = 5.0
"""Images per lens, on average, below which the lenses of one sensor share their corrections."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """Points that lie on the water or on planes, and which planes are parallel."""

    names: tuple[str, ...]  # of the planes
    on: IntArray  # (m,), 0 on the water, i + 1 on plane i, -1 on no surface
    sigma_m: FloatArray  # (m,), of the distance from the surface
    parallel: tuple[str, ...] = ()  # names of parallel planes, perhaps with `WATER`


NO_CONDITIONS = Conditions((), np.zeros(0, np.int64), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Block:
    """Images, points and measurements."""

    cameras: Cameras  # start values of the exterior and interior orientation
    xyz: FloatArray  # (m, 3), start values of the true points
    start: IntArray  # (m + 1,), the observations of point i are start[i]:start[i + 1]
    camera: IntArray  # (o,), row of the cameras
    image_xy: FloatArray  # (o, 2), in the unit of the lens, from the upper left corner
    sigma_px: FloatArray  # (o,), of u and v; infinite for observations without weight
    water: WaterSurface | None  # None for a block without water
    refractive_index: float
    # (m,), points that may be under water; refracted while they are below the surface
    wet: BoolArray
    surveyed_xyz: FloatArray  # (m, 3), of control points; NaN for other points
    surveyed_sigma_m: FloatArray  # (m, 3), infinite for other points
    gnss_xyz: FloatArray  # (k, 3), of the projection centres; NaN if unknown
    gnss_sigma_m: FloatArray  # (k, 3), infinite if unknown
    port: Port | None = None  # a housing port as the refracting surface, instead of water
    control_names: tuple[str, ...] = ()  # of the surveyed points, the last ones of `xyz`
    # of them, not used in the adjustment
    is_check: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    conditions: Conditions = NO_CONDITIONS  # points on surfaces

    @property
    def owner(self) -> IntArray:
        """Row of the point of each observation."""
        return np.repeat(np.arange(len(self.xyz)), np.diff(self.start))

    @property
    def tie_points(self) -> int:
        """Number of tie points; they come before the surveyed points."""
        return len(self.xyz) - len(self.control_names)

    @property
    def is_surveyed(self) -> BoolArray:
        """Points that count as control points."""
        return np.asarray(np.isfinite(self.surveyed_sigma_m).any(axis=1))

    @property
    def gnss_weights(self) -> FloatArray:
        """Inverse variances of the GNSS positions, shape (k, 3); zero where there is none."""
        return inverse_variances(self.gnss_xyz, self.gnss_sigma_m)


def inverse_variances(values: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return inverse variances; zero where the value or its standard deviation is unknown."""
    known = np.isfinite(values) & np.isfinite(sigma)
    return np.where(known, 1.0 / np.where(known, sigma, 1.0) ** 2, 0.0)


@dataclass(frozen=True)
class Unknowns:
    """What may move: a standard deviation of zero fixes a parameter, infinity frees it."""

    poses: Poses = "free"  # `similarity` shifts, turns and scales all poses together
    fixed_images: tuple[str, ...] = ()  # labels of images whose pose is fixed
    lens: tuple[str, ...] = ("f",)  # free of each sensor: f, cx, cy, b1, b2, k1 ... k8, p1, p2
    # of level (m), tilt, index, shape (1/m), distance (m) and centre (m); others are fixed
    surface: Mapping[str, float] = field(default_factory=dict)
    free_network: bool = False  # mean position, direction and scale of the centres stay

    @property
    def water_sigma(self) -> tuple[float, ...]:
        """Standard deviations in the order of `WATER_NAMES`."""
        return tuple(self.surface.get(name.partition("_")[0], 0.0) for name in WATER_NAMES)


def similarity_gradients(d: FloatArray) -> FloatArray:
    """Return how places d from the pivot move with shift, turn and scale, shape (k, 3, 7)."""
    by = np.zeros((len(d), 3, 7))
    by[:, [0, 1, 2], [0, 1, 2]] = 1.0
    x, y, z = d.T
    by[:, 0, 4], by[:, 0, 5] = z, -y
    by[:, 1, 3], by[:, 1, 5] = -z, x
    by[:, 2, 3], by[:, 2, 4] = y, -x
    by[:, :, 6] = d
    return by


def check_datum(block: Block, unknowns: Unknowns, reason: str = "") -> None:
    """Check that GNSS, control points, fixed images or a free network give a datum.

    `reason` is why GNSS positions are not used.
    """
    if unknowns.free_network or unknowns.poses == "fixed":
        return
    gnss = int((block.gnss_weights > 0.0).all(axis=1).sum())
    control = int((block.is_surveyed & (np.diff(block.start) >= LEAST_VIEWS)).sum())
    fixed = len(set(unknowns.fixed_images) & set(block.cameras.labels))
    if gnss + control >= 3 or fixed >= 2:
        return
    words = (
        f"Position, orientation and scale of the block are undetermined: {gnss} GNSS positions,"
        f" {control} control points in two or more images, {fixed} fixed images. Give --gnss or"
        " --gcps with three points or more, or --datum free to keep the mean of the original"
        " projection centres." + (f" {reason}" if reason else "")
    )
    raise GeometryError("adjust.no_datum", words, gnss=gnss, control=control, fixed=fixed)


# Lens parameters


FOCAL, CX, CY, B1, B2, P1, P2, K1 = range(8)
"""Codes of the lens parameters; k1, k2, ... follow from `K1` on."""

NAMES = ("f", "cx", "cy", "b1", "b2", "p1", "p2", *(f"k{i}" for i in range(1, 9)))
CODES = {name: code for code, name in enumerate(NAMES)}
_FIELDS = ("focal", "principal_x", "principal_y", "b1", "b2")


def sensor_groups(lenses: tuple[Lens, ...]) -> tuple[IntArray, list[list[int]]]:
    """Return the sensor of each of k lenses, and the rows of each sensor.

    Images that have a calibration each, but one sensor and frame, share the corrections.
    """
    sensors = [(one.sensor, one.width, one.height, one.projection, one.inverse) for one in lenses]
    distinct = len(set(lenses))
    # several lenses of one sensor, each with enough images for corrections of its own
    is_own = distinct > len(set(sensors)) and len(lenses) / distinct >= FEW_IMAGES
    keys: Sequence[object] = lenses if is_own else sensors
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    group = np.array([number[key] for key in keys], np.int64)
    return group, [np.flatnonzero(group == i).tolist() for i in range(len(number))]


def usable_codes(lens: Lens, names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the codes of those parameters that the model of a lens has."""
    codes = tuple(CODES[name] for name in names)
    return tuple(code for code in codes if code < P1) if lens.in_turn else codes


def lens_parameter(lens: Lens, code: int) -> float:
    """Return a parameter of a lens; zero for terms that its polynomial does not have."""
    if code < P1:
        return float(getattr(lens, _FIELDS[code]))
    values, place = (lens.radial, code - K1) if code >= K1 else (lens.tangential, code - P1)
    return float(values[place]) if place < len(values) else 0.0


def moved_lens(lens: Lens, codes: tuple[int, ...], by: FloatArray) -> Lens:
    """Return a lens with corrections added to some of its parameters."""
    changes: dict[str, Any] = {}
    radial, tangential = [*lens.radial], [*lens.tangential]
    for code, step in zip(codes, by.tolist(), strict=True):
        if code < P1:
            changes[_FIELDS[code]] = getattr(lens, _FIELDS[code]) + step
            continue
        terms, at, least = (radial, code - K1, 0) if code >= K1 else (tangential, code - P1, 2)
        terms += [0.0] * (max(at + 1, least) - len(terms))
        terms[at] += step
    return replace(lens, radial=tuple(radial), tangential=tuple(tangential), **changes)


def effect_at_corner(lens: Lens, code: int) -> float:
    """Return the image movement at the corner of the frame per unit of a lens parameter."""
    r = 0.5 * np.hypot(lens.width, lens.height) / lens.focal
    if code in (CX, CY):
        return 1.0
    if code >= K1:
        return float(lens.focal * r ** (2 * (code - K1) + 3))
    return float(3.0 * lens.focal * r * r if code in (P1, P2) else r)


# Blocks from what was read


def plain_block(
    cameras: Cameras,
    ties: TiePoints,
    water: WaterSurface | None = None,
    refractive_index: float = 1.0,
    wet: BoolArray | None = None,
) -> Block:
    """Return a block of tie points only, with a standard deviation of 1 px; dry without `wet`."""
    k, m, o = len(cameras), len(ties.xyz), len(ties.views.camera)
    nowhere, unknown = np.full((max(k, m), 3), np.nan), np.full((max(k, m), 3), np.inf)
    return Block(
        cameras, ties.xyz, ties.views.start, ties.views.camera, ties.image_xy, np.ones(o),
        water, refractive_index, np.zeros(m, np.bool_) if wet is None else wet,
        nowhere[:m], unknown[:m], nowhere[:k], unknown[:k],
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Material:
    """Everything a block is made of, besides its tie points."""

    name: str  # camera file, for messages
    original: Cameras  # as they were read, with angles and lenses
    water: WaterSurface | None
    refractive_index: float
    gnss: GnssPositions | None = None  # in the frame of the block
    control: GroundControl | None = None  # with check points, which get no weight
    port: Port | None = None
    calibrated: Lens | None = None  # replaces the lenses of the cameras
    # Whether points, by x and y, may be under water; everywhere without it.
    inside: Callable[[FloatArray, FloatArray], BoolArray] | None = None
    no_gnss: str = ""  # why GNSS positions of the camera file are not used
    # parallel planes on which control points lie, perhaps with the water
    parallel: tuple[str, ...] = ()


def block_of(
    material: Material, ties: TiePoints, sigma_px: float, level_sigma_m: float = 0.0
) -> Block:
    """Return the block of tie points and surveyed points.

    Parameters
    ----------
    material : Material
    ties : TiePoints
        Apparent points, in the frame of the cameras.
    sigma_px : float
        Standard deviation of their image coordinates.
    level_sigma_m : float
        Standard deviation of the water level, infinite if it is free.
    """
    water, n, cameras = material.water, material.refractive_index, material.original
    if material.calibrated is not None:
        cameras = replace(cameras, lenses=(material.calibrated,) * len(cameras))
    inside, control, m = material.inside, material.control, len(ties.xyz)
    wet = np.ones(m, np.bool_) if inside is None else inside(*ties.xyz[:, :2].T)
    ties = replace(ties, xyz=true_start(ties.xyz, water, n, wet))
    sigma, more = np.full(len(ties.views.camera), sigma_px), dict[str, Any]()
    if control is not None:
        deep = [] if water is None else used_as_dry(control, water, level_sigma_m)
        if deep:
            raise GeometryError(
                "gcps.under_water",
                f"Control points below the water surface are not marked as under water:"
                f" {', '.join(deep)}. Put yes into the column under_water, or check the height"
                " datum and the water level.",
                points=deep,
            )
        marks, of_marks = marks_of(control)
        conditions, under_water, xyz = _on_surfaces(material, control, marks, m)
        views = Views(
            np.concatenate([ties.views.start, marks.views.start[1:] + ties.views.start[-1]]),
            np.concatenate([ties.views.camera, marks.views.camera]),
        )
        ties = TiePoints(
            np.vstack([ties.xyz, xyz]), views, np.vstack([ties.image_xy, marks.image_xy])
        )
        sigma, wet = np.concatenate([sigma, of_marks]), np.concatenate([wet, under_water])
        sigma_m = np.where(control.is_check[:, None], np.inf, control.sigma_m)
        more = {
            "surveyed_xyz": np.vstack([np.full((m, 3), np.nan), control.xyz]),
            "surveyed_sigma_m": np.vstack([np.full((m, 3), np.inf), sigma_m]),
            "control_names": control.names, "is_check": control.is_check, "conditions": conditions,
        }  # fmt: skip
    if material.gnss is not None:
        more |= {"gnss_xyz": material.gnss.xyz, "gnss_sigma_m": material.gnss.sigma_m}
    block = plain_block(cameras, ties, water, n, wet)
    return replace(block, sigma_px=sigma, port=material.port, **more)


def _on_surfaces(
    material: Material, control: GroundControl, marks: TiePoints, ties: int
) -> tuple[Conditions, BoolArray, FloatArray]:
    """Return conditions of surveyed points, which are under water, and their start values."""
    under_water, xyz, on = control.under_water.copy(), control.xyz, np.array(control.on)
    if not any(control.on):
        return NO_CONDITIONS, under_water, xyz
    names = tuple(dict.fromkeys(name for name in control.on if name and name != WATER))
    number = {"": -1, WATER: 0} | {name: i for i, name in enumerate(names, start=1)}
    rows = np.array([-1] * ties + [number[name] for name in control.on])
    sigma_m = np.concatenate([np.ones(ties), control.on_sigma_m])
    # points without coordinates start where their rays meet
    bare = np.asarray(np.isnan(xyz).any(axis=1))
    under_water[bare] = on[bare] != WATER
    places = with_places(marks, material.original).xyz
    start = true_start(places, material.water, material.refractive_index, under_water)
    xyz = np.where(bare[:, None], start, xyz)
    if np.isnan(xyz).any():
        name = control.names[int(np.argmax(np.isnan(xyz).any(axis=1)))]
        words = (
            f"Point {name} has no coordinates and its image rays do not intersect."
            " Mark it in at least two images from different directions."
        )
        raise GeometryError("gcps.no_coordinates", words, point=name)
    return Conditions(names, rows, sigma_m, material.parallel), under_water, xyz


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


def gnss_with_sigma(
    centres: FloatArray, found: GnssPositions, name: str, sigma_m: float | None
) -> tuple[GnssPositions | None, list[PcfixWarning]]:
    """Return GNSS positions with standard deviations (infinite for unknown ones), and warnings.

    Parameters
    ----------
    centres : array, shape (k, 3)
        Projection centres, metres.
    found : GnssPositions
        In the same frame, as read: NaN where unknown.
    name : str
        Their file, for messages.
    sigma_m : float or None
        For positions without one; None estimates it from their scatter about the centres.
    """
    known = np.isfinite(found.xyz)
    if not known.any():
        return None, []
    sigma = np.where(known, found.sigma_m, np.inf)
    silent = known & ~np.isfinite(found.sigma_m)
    off = np.where(known, centres - found.xyz, np.nan)
    notes = []
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
    xyz: FloatArray, water: WaterSurface | None, n: float, allowed: BoolArray | None = None
) -> FloatArray:
    """Return apparent points with their depths times n, as start values of the true points.

    That is where they are seen vertically; only those `allowed` may be under water.
    """
    true = xyz.copy()
    if water is None:
        return true
    level = surface_above(water, xyz).height_m
    wet = level > xyz[:, 2] if allowed is None else (level > xyz[:, 2]) & allowed
    true[wet, 2] = level[wet] - n * (level - xyz[:, 2])[wet]
    return true


# Tie points


def taken(ties: TiePoints, rows: IntArray) -> TiePoints:
    """Return some of the tie points, in the given order."""
    first, counts = ties.views.start[rows], np.diff(ties.views.start)[rows]
    begin = np.cumsum(counts) - counts
    where = np.repeat(first - begin, counts) + np.arange(counts.sum())
    return TiePoints(ties.xyz[rows], ties.views.take(rows), ties.image_xy[where])


def usable_ties(ties: TiePoints, cameras: Cameras, most: int = TIE_POINTS) -> TiePoints:
    """Return the tie points that can be adjusted; a random part of them if there are very many.

    They have coordinates, two images or more, and a sufficient angle between their rays: twice the
    largest angle between a ray and the mean ray of its point.
    """
    seen = np.diff(ties.views.start) >= LEAST_VIEWS
    rows = np.flatnonzero(np.isfinite(ties.xyz).all(axis=1) & seen)
    some = taken(ties, rows)
    owner = np.repeat(np.arange(len(rows)), np.diff(some.views.start))
    ray = cameras.centres[some.views.camera] - some.xyz[owner]
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    mean = np.zeros((len(rows), 3))
    np.add.at(mean, owner, ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    cosine = np.full(len(rows), 1.0)
    np.minimum.at(cosine, owner, np.einsum("oi,oi->o", ray, mean[owner]))
    angle_deg = 2.0 * np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    rows = rows[angle_deg >= LEAST_ANGLE_DEG]
    if len(rows) > most:
        rows = np.sort(np.random.default_rng(0).choice(rows, most, replace=False))
    return taken(ties, rows)


def with_places(ties: TiePoints, cameras: Cameras) -> TiePoints:
    """Return tie points in which those without coordinates are intersected by straight rays.

    The sum of squared distances from the rays is minimised, which is good enough as a start.
    """
    lost = np.flatnonzero(~np.isfinite(ties.xyz).all(axis=1) & (np.diff(ties.views.start) >= 2))
    some, rotations, lenses = taken(ties, lost), np.asarray(cameras.rotations), cameras.lenses or ()
    owner, camera = np.repeat(np.arange(len(lost)), np.diff(some.views.start)), some.views.camera
    ray = np.full((len(owner), 3), np.nan)
    for c in np.unique(camera):
        ray[camera == c] = unproject(lenses[c], some.image_xy[camera == c]) @ rotations[c]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    middle = cameras.centres.mean(axis=0)
    normal, right = np.zeros((len(lost), 3, 3)), np.zeros((len(lost), 3))
    np.add.at(normal, owner, across)
    np.add.at(right, owner, np.einsum("oij,oj->oi", across, cameras.centres[camera] - middle))
    known = np.linalg.det(normal) > LEAST_DETERMINANT  # NaN is not
    xyz = ties.xyz.copy()
    xyz[lost[known]] = np.linalg.solve(normal[known], right[known][:, :, None])[:, :, 0] + middle
    return replace(ties, xyz=xyz)


def ties_of_cloud(
    xyz: FloatArray, views: Views, cameras: Cameras, least: int = LEAST_VIEWS
) -> TiePoints:
    """Return apparent points in enough images, shape (m, 3), as tie points with straight rays.

    The views say which cameras contributed to them, or have them in their frame.
    """
    owner = np.repeat(np.arange(len(xyz)), np.diff(views.start))
    image = straight_images(xyz[owner], np.asarray(views.camera), cameras)
    seen = np.isfinite(image).all(axis=1)
    counts = np.bincount(owner[seen], minlength=len(xyz))
    start = np.concatenate([[0], np.cumsum(counts)])
    tracks = Views(start, np.asarray(views.camera)[seen])
    return taken(TiePoints(xyz, tracks, image[seen]), np.flatnonzero(counts >= least))


# Parts of a block


def well_seen(block: Block) -> IntArray:
    """Return the rows of the images with enough observations for a pose."""
    counts = np.bincount(block.camera[np.isfinite(block.sigma_px)], minlength=len(block.cameras))
    return np.flatnonzero(counts >= LEAST_POINTS_IN_IMAGE)


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
    """Return some of the cameras, in the given order, without their GNSS positions."""
    return replace(
        cameras,
        labels=tuple(cameras.labels[i] for i in rows),
        centres=cameras.centres[rows],
        rotations=None if cameras.rotations is None else cameras.rotations[rows],
        lenses=None if cameras.lenses is None else tuple(cameras.lenses[i] for i in rows),
        gnss=None,
    )
