"""A block of images as it goes into an adjustment, what may move in it, and both as flat arrays.

`Block` and `Unknowns` are what the doors give; the named tuples are what the kernels take. Their
coordinates are relative to an origin of the block, so that nothing is lost at large coordinates.
The water's numbers are its plane z = a + b x + c y in these coordinates, and what bends it,
d x^2 + e x y + f y^2; over a mesh or raster `a` is by how much it stands higher than given, and the
others are unused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Lens, TiePoints, WaterSurface
from pcfix.port.shapes import Port

if TYPE_CHECKING:
    from pcfix.water.surface import Field, Tin


class State(NamedTuple):
    """What is estimated.

    centres : shape (k, 3); rotations : shape (k, 3, 3), world to camera.
    lenses : shape (l, ...), coefficients of `pcfix.lens.imaging.lens_table`.
    xyz : shape (m, 3), true points.
    water : shape (11 + 3 p,), the numbers of `WATER_NAMES`: a, b, c, the refractive index, d, e, f,
    and of a port its distance or its centre; then height and slopes of each plane of `Conditions`.
    """

    centres: FloatArray
    rotations: FloatArray
    lenses: FloatArray
    xyz: FloatArray
    water: FloatArray


class Seen(NamedTuple):
    """What was measured, gathered by point.

    start : shape (m + 1,); camera, image_xy, weight : o rows.
    weight : 1 / standard deviation of u and v; zero where the observation is left out.
    wet : shape (m,), whether the point may be under water; it is where it lies below it.
    lens_row, group : shape (k,), row of the lens table and group of lenses of each camera.
    """

    start: IntArray
    camera: IntArray
    image_xy: FloatArray
    weight: FloatArray
    wet: BoolArray
    lens_row: IntArray
    group: IntArray


class Surface(NamedTuple):
    """What bends the light besides the plane of `State.water`.

    there : whether there is water at all.
    tin, field : a mesh or raster instead of the plane.
    origin : shape (3,), the block's origin in the world frame.
    port : coefficients of a housing port, of length 0 where there is none.
    curved : whether the water is more than a plane: d, e, f count.
    """

    there: bool
    tin: Tin | None
    field: Field | None
    origin: FloatArray
    port: FloatArray
    curved: bool = False


FOCAL, CX, CY, B1, B2, P1, P2, K1 = range(8)
"""Codes of the lens parameters; k1, k2, ... follow from `K1` on."""

CODES = {"f": FOCAL, "cx": CX, "cy": CY, "b1": B1, "b2": B2, "p1": P1, "p2": P2}
CODES |= {f"k{i + 1}": K1 + i for i in range(8)}
NAMES = {code: name for name, code in CODES.items()}

WATER_NAMES = (
    *("level", "tilt_x", "tilt_y", "index", "shape_xx", "shape_xy", "shape_yy"),
    *("distance", "centre_x", "centre_y", "centre_z"),
)
"""What bends the light: numbers of the water, then of a port."""
INDEX, SHAPE, PORT, PLANES = 3, 4, 7, 11
"""Where the index, d, e, f, the numbers of a port and those of planes stand."""

MOTIONS = ("shift x", "shift y", "shift z", "turn x", "turn y", "turn z", "scale")
"""What a similarity does."""


class Columns(NamedTuple):
    """Where the unknowns that many points share stand, counted from the first of them.

    lens : shape (groups + 1,), where the parameters of each group begin.
    code : shape (lens[-1],), which parameter each one is.
    water : for each number of `State.water`, -1 where fixed; parallel planes share theirs.
    similarity : the first of seven, -1 where the poses move on their own.
    total : how many there are.
    pivot : shape (3,), about which a similarity turns and scales.
    """

    lens: IntArray
    code: IntArray
    water: IntArray
    similarity: int
    total: int
    pivot: FloatArray


class Loss(NamedTuple):
    """How residuals count: the kind, and where it begins to bend, in standard deviations."""

    kind: int = 0
    scale: float = 1.0


SQUARES, HUBER, CAUCHY = range(3)
"""Kinds of `Loss`."""

LEAST_SQUARES = Loss()


class PointPriors(NamedTuple):
    """Surveyed points: where, and the inverse variances along x, y, z; zero for the others."""

    xyz: FloatArray
    weight: FloatArray


class OnSurfaces(NamedTuple):
    """Points that lie on a surface; arrays of length 0 where there are none.

    on : shape (m,), 0 on the water, 1, 2, ... on a plane, -1 on none.
    weight : shape (m,), 1 / standard deviation of the distance, along `axis`.
    axis : shape (1 + p,), that along which each surface has its height: 2 is up.
    """

    on: IntArray
    weight: FloatArray
    axis: IntArray


ON_NOTHING = OnSurfaces(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))


class Given(NamedTuple):
    """What stays as it is while a block is adjusted."""

    seen: Seen
    surface: Surface
    columns: Columns
    priors: PointPriors
    on_surfaces: OnSurfaces = ON_NOTHING


def columns_of(
    codes: list[tuple[int, ...]], water: list[bool], similarity: bool, pivot: FloatArray,
    alike: dict[int, int] | None = None,
) -> Columns:  # fmt: skip
    """Return the columns of the free parameters of each group, the water's and a similarity's.

    `alike` says of numbers of the water, not free themselves, with which others they go.
    """
    lens = np.concatenate([[0], np.cumsum([len(one) for one in codes])]).astype(np.int64)
    place = np.full(len(water), -1, np.int64)
    free = np.flatnonzero(water)
    place[free] = lens[-1] + np.arange(len(free))
    for number, other in (alike or {}).items():
        place[number] = place[other]
    first = int(lens[-1]) + len(free)
    flat = np.array([code for of_sensor in codes for code in of_sensor], np.int64)
    return Columns(lens, flat, place, first if similarity else -1, first + 7 * similarity, pivot)


Poses = Literal["free", "fixed", "similarity"]
Robust = Literal["squares", "huber", "cauchy"]


@dataclass(frozen=True, eq=False)
class Conditions:
    """Which points lie on the water or on a plane, and which of these are parallel.

    Attributes
    ----------
    names : tuple of str
        Of the planes.
    on : array of int, shape (m,)
        0 on the water, i + 1 on the plane i, -1 on none.
    sigma_m : array, shape (m,)
        Standard deviation of the distance from it.
    parallel : tuple of str
        Names of planes that are parallel, `WATER` among them or not.
    """

    names: tuple[str, ...]
    on: IntArray
    sigma_m: FloatArray
    parallel: tuple[str, ...] = ()


WATER = "water"
"""The name of the water among planes."""


@dataclass(frozen=True, eq=False)
class Block:
    """Images, points and what was measured; all in one frame, metres, Z up.

    Attributes
    ----------
    cameras : Cameras
        Start values of the exterior and interior orientation.
    xyz : array, shape (m, 3)
        Start values of the true points.
    start : array of int, shape (m + 1,)
        The observations of point i are ``start[i]:start[i + 1]``.
    camera : array of int, shape (o,)
        Row of the cameras.
    image_xy : array, shape (o, 2)
        Where the image shows the point, unit of the lens, from the upper left corner.
    sigma_px : array, shape (o,)
        Standard deviation of u and v; infinite where an observation does not count.
    water : WaterPlane, WaterMesh, WaterRaster or None
        None on a block without water.
    refractive_index : float
    wet : array of bool, shape (m,)
        Which points may be under water; they are while they lie below it.
    surveyed_xyz, surveyed_sigma_m : array, shape (m, 3)
        Of control points, from the survey; NaN and infinite for the others.
    gnss_xyz, gnss_sigma_m : array, shape (k, 3)
        Of the projection centres; NaN and infinite where there is none.
    port : Port or None
        A housing port as the refracting surface, instead of water.
    control_names : tuple of str
        Of the surveyed points, which are the last ones of `xyz`.
    is_check : array of bool, shape (len(control_names),)
        Which of them are held out, to check the result.
    conditions : Conditions or None
        Which points lie on a surface.
    """

    cameras: Cameras
    xyz: FloatArray
    start: IntArray
    camera: IntArray
    image_xy: FloatArray
    sigma_px: FloatArray
    water: WaterSurface | None
    refractive_index: float
    wet: BoolArray
    surveyed_xyz: FloatArray
    surveyed_sigma_m: FloatArray
    gnss_xyz: FloatArray
    gnss_sigma_m: FloatArray
    port: Port | None = None
    control_names: tuple[str, ...] = ()
    is_check: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    conditions: Conditions | None = None

    @property
    def owner(self) -> IntArray:
        """Row of the point of each observation."""
        return np.repeat(np.arange(len(self.xyz)), np.diff(self.start))

    @property
    def is_surveyed(self) -> BoolArray:
        """Which points are control points."""
        return np.asarray(np.isfinite(self.surveyed_sigma_m).any(axis=1))


def plain_block(
    cameras: Cameras,
    ties: TiePoints,
    water: WaterSurface | None = None,
    refractive_index: float = 1.0,
    wet: BoolArray | None = None,
) -> Block:
    """Return a block of tie points alone, all observations of 1 px; dry unless `wet` says where."""
    k, m, o = len(cameras), len(ties.xyz), len(ties.views.camera)
    nowhere, unknown = np.full((max(k, m), 3), np.nan), np.full((max(k, m), 3), np.inf)
    return Block(
        cameras, ties.xyz, ties.views.start, ties.views.camera, ties.image_xy, np.ones(o),
        water, refractive_index, np.zeros(m, np.bool_) if wet is None else wet,
        nowhere[:m], unknown[:m], nowhere[:k], unknown[:k],
    )  # fmt: skip


@dataclass(frozen=True)
class Unknowns:
    """What may move: zero fixes a number, infinity frees it, else it is a standard deviation.

    Attributes
    ----------
    poses : {"free", "fixed", "similarity"}
        `similarity` moves, turns and scales them all together.
    fixed_images : tuple of str
        Labels of images that keep their pose.
    lens : tuple of str
        Parameters of each sensor that are free: f, cx, cy, b1, b2, k1 ... k8, p1, p2.
    lens_sigma : dict
        Standard deviations of some of them about their start values, in their unit.
    level_sigma_m, tilt_sigma, index_sigma, shape_sigma : float
        Of the water level, its slopes, the refractive index, and what is more than a plane (1/m).
    distance_sigma_m, centre_sigma_m : float
        Of the distance of a flat port, and of the centre of a dome.
    free_network : bool
        The datum is that of the start values: the projection centres keep mean place, mean
        direction and mean scale.
    """

    poses: Poses = "free"
    fixed_images: tuple[str, ...] = ()
    lens: tuple[str, ...] = ("f",)
    lens_sigma: dict[str, float] = field(default_factory=dict)
    level_sigma_m: float = 0.0
    tilt_sigma: float = 0.0
    index_sigma: float = 0.0
    free_network: bool = False
    shape_sigma: float = 0.0
    distance_sigma_m: float = 0.0
    centre_sigma_m: float = 0.0

    @property
    def water_sigma(self) -> tuple[float, ...]:
        """Of the numbers of `WATER_NAMES`."""
        return (
            *(self.level_sigma_m, self.tilt_sigma, self.tilt_sigma, self.index_sigma),
            *(self.shape_sigma,) * 3,
            *(self.distance_sigma_m, *(self.centre_sigma_m,) * 3),
        )


def sensor_groups(lenses: tuple[Lens, ...]) -> tuple[IntArray, list[list[int]]]:
    """Return which sensor each of k lenses is of, and the rows of each sensor.

    Images with a calibration each of one sensor and frame share what is added to it.
    """
    sensors = [(one.sensor, one.width, one.height, one.projection, one.inverse) for one in lenses]
    distinct = len(set(lenses))
    # several lenses of one sensor, each with images enough for its own
    is_own = distinct > len(set(sensors)) and len(lenses) / distinct >= FEW_IMAGES
    rows: dict[object, list[int]] = {}
    for i, key in enumerate(lenses if is_own else sensors):
        rows.setdefault(key, []).append(i)
    group = np.zeros(len(lenses), np.int64)
    for number, members in enumerate(rows.values()):
        group[members] = number
    return group, list(rows.values())


FEW_IMAGES = 5.0
"""Images a lens, in the mean, below which lenses of one sensor share what is added to them."""


def usable_codes(lens: Lens, names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the codes of those parameters that the formula of a lens has."""
    codes = tuple(CODES[name] for name in names)
    return tuple(code for code in codes if code < P1) if lens.in_turn else codes


_FIELDS = {FOCAL: "focal", CX: "principal_x", CY: "principal_y", B1: "b1", B2: "b2"}


def lens_parameter(lens: Lens, code: int) -> float:
    """Return a parameter of a lens; zero of a polynomial that ends before it."""
    if code in _FIELDS:
        return float(getattr(lens, _FIELDS[code]))
    values, place = (lens.radial, code - K1) if code >= K1 else (lens.tangential, code - P1)
    return float(values[place]) if place < len(values) else 0.0


def moved_lens(lens: Lens, codes: tuple[int, ...], by: FloatArray) -> Lens:
    """Return a lens with something added to some of its parameters."""
    changes: dict[str, Any] = {"radial": lens.radial, "tangential": lens.tangential}
    for code, step in zip(codes, by.tolist(), strict=True):
        value = lens_parameter(lens, code) + step
        if code in _FIELDS:
            changes[_FIELDS[code]] = value
            continue
        name, first, least = ("radial", K1, 0) if code >= K1 else ("tangential", P1, 2)
        values = [*changes[name], *[0.0] * (max(code - first + 1, least) - len(changes[name]))]
        values[code - first] = value
        changes[name] = tuple(values)
    return replace(lens, **changes)
