"""The frozen dataclasses that pass between the rooms.

Frames, once for all: the *world* is the cloud's own projected CRS, metres, right-handed, Z up.
The *camera frame* is OpenCV's: x right, y down, z forward; ``x_camera = R (x_world - C)``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import PcfixWarning, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

UNCLASSIFIED, BATHYMETRIC_POINT, WATER_SURFACE = 1, 40, 41
"""Classes of LAS 1.4 and its topo-bathy lidar domain profile; 40 is a point on the bed."""
NOISE_CLASSES = LOW_NOISE, HIGH_NOISE = 7, 18

Projection = Literal[
    "perspective", "equidistant", "equisolid", "polynomial", "fov", "dual", "division", "eucm"
]
ViewKind = Literal["tracks", "depth-maps", "pairs", "pair-images"]

NOMINAL_WIDTH_PX = 5472.0
"""Of lenses in millimetres whose pixel size is not known: the longer side of a survey drone's
camera of 20 megapixels, 13.2 mm of pixels of 2.4 um."""


@dataclass(frozen=True, slots=True)
class Lens:
    """An interior orientation: how a direction in the camera frame becomes a place in the image.

    Three steps. First the direction (X, Y, Z), at the angle theta from the axis, is projected;
    with (e, g) = (X, Y) / hypot(X, Y):

    =============  =============================================  =========================
    `projection`   plane coordinates (x, y)                       `shape`
    =============  =============================================  =========================
    perspective    (X, Y) / Z
    equidistant    theta (e, g)
    equisolid      2 sin(theta / 2) (e, g)
    polynomial     (s0 + s1 q + s2 q^2 + ...) (e, g), q = 2 theta / pi   s0, s1, ... (Pix4D)
    fov            atan(2 tan(s0 / 2) tan theta) / s0 (e, g)      s0 (COLMAP's FOV)
    dual           (s0 tan theta + (1 - s0) theta) (e, g)         s0 (OpenSfM's dual)
    division       m (e, g) with m / (1 + s0 m^2) = tan theta     s0
    eucm           (X, Y) / (s0 d + (1 - s0) Z), with             s0, s1 (COLMAP's EUCM)
                   d^2 = s1 (X^2 + Y^2) + Z^2
    =============  =============================================  =========================

    Then Brown's distortion, about the point `distortion_centre`, with r^2 = x^2 + y^2 there:

        x' = x (1 + k1 r^2 + k2 r^4 + ...) / (1 + d1 r^2 + d2 r^4 + ...)
             + (p1 (r^2 + 2 x^2) + 2 p2 x y) (1 + p3 r^2 + p4 r^4) + s1 r^2 + s2 r^4
        y' = y (...) + (p2 (r^2 + 2 y^2) + 2 p1 x y) (...) + s3 r^2 + s4 r^4

    and last the image, origin in the upper left corner of the upper left pixel:

        u = principal_x + (focal + b1) x' + b2 y'
        v = principal_y + focal y' + b3 x'

    Attributes
    ----------
    focal, width, height, principal_x, principal_y, b1, b2, b3 : float
        All in `unit`, pixels or millimetres.
    projection : Projection
    shape : tuple of float
        The parameters of the projection, see the table.
    radial, denominator : tuple of float
        k1, k2, ... and d1, d2, ...; as many as there are.
    tangential : tuple of float
        p1 ... p4 in Brown's order (Metashape's; OpenCV's p1 and p2 the other way round).
    thin_prism : tuple of float
        s1 ... s4.
    distortion_centre : tuple of 2 float
        In plane coordinates.
    inverse : bool
        Brown's formula goes from (x', y') to (x, y) instead.
    in_turn : bool
        The tangential and thin prism terms use x, y and r after the radial terms (COLMAP's
        RAD_TAN_THIN_PRISM_FISHEYE).
    sensor : str
        Its name in the source.
    unit : {"px", "mm"}
    """

    focal: float
    width: float
    height: float
    principal_x: float
    principal_y: float
    b1: float = 0.0
    b2: float = 0.0
    b3: float = 0.0
    projection: Projection = "perspective"
    shape: tuple[float, ...] = ()
    radial: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, ...] = ()
    thin_prism: tuple[float, ...] = ()
    distortion_centre: tuple[float, float] = (0.0, 0.0)
    inverse: bool = False
    in_turn: bool = False
    sensor: str = ""
    unit: Literal["px", "mm"] = "px"

    @property
    def pixel_size(self) -> float:
        """Size of a pixel in the unit of the lens; nominal for a lens in millimetres."""
        return 1.0 if self.unit == "px" else max(self.width, self.height) / NOMINAL_WIDTH_PX

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, of nominal size for a lens in millimetres."""
        return self.focal / self.pixel_size


@dataclass(frozen=True, eq=False)
class GnssPositions:
    """GNSS positions of the projection centres of k images."""

    xyz: FloatArray  # (k, 3), in `crs`, NaN if unknown
    sigma_m: FloatArray  # (k, 3), stated standard deviations east, north, up; NaN if unknown
    crs: str | None  # axes in the order east or longitude, north or latitude, height


@dataclass(frozen=True, eq=False)
class Cameras:
    """The exterior orientation of k images, as a struct of arrays.

    Attributes
    ----------
    labels : tuple of str, length k
        Names of the images; not a key, as real projects have duplicates.
    centres : array, shape (k, 3)
        Projection centres, metres, world frame.
    rotations : array, shape (k, 3, 3), or None
        World to camera. None when the source has no angles; then every camera is a candidate
        for every point.
    lenses : tuple of Lens, length k, or None
        Interior orientation of each image. None where the source has none; then a frame holds
        every point in front of the camera.
    crs : str or None
        CRS of centres and rotations: what pyproj understands (geocentric ones are allowed), or
        ``ENU:latitude,longitude,height`` for axes east, north, up at that place, or ``local``
        where the source says that its frame is not tied to the earth. None when it does not
        say; then the cloud's CRS is assumed.
    project_crs : str or None
        The CRS in which the software delivers its clouds, where that is not `crs`.
    gnss : GnssPositions or None
    unposed : tuple of str
        Images without a pose, which are excluded.
    notes : tuple of PcfixWarning
        Notes of the reader, for the summary.
    source : str
        The software and its version.
    """

    labels: tuple[str, ...]
    centres: FloatArray
    rotations: FloatArray | None = None
    lenses: tuple[Lens, ...] | None = None
    crs: str | None = None
    notes: tuple[PcfixWarning, ...] = ()
    project_crs: str | None = None
    gnss: GnssPositions | None = None
    unposed: tuple[str, ...] = ()
    source: str = ""

    def __post_init__(self) -> None:
        """Check that the arrays belong together."""
        k = len(self.labels)
        if self.centres.shape != (k, 3):
            shape = self.centres.shape
            raise SettingError("cameras.arrays", f"{k} labels need centres ({k}, 3), not {shape}.")
        if not np.isfinite(self.centres).all():
            bad = self.labels[int(np.argmin(np.isfinite(self.centres).all(axis=1)))]
            raise SettingError("cameras.not_finite", f"Camera {bad}: its centre is not finite.")
        if self.rotations is None and self.lenses is not None:
            raise SettingError("cameras.arrays", "Cameras with lenses need rotations.")
        if self.rotations is not None and self.rotations.shape != (k, 3, 3):
            shape = self.rotations.shape
            raise SettingError("cameras.arrays", f"rotations must be ({k}, 3, 3), not {shape}.")
        if self.lenses is not None and len(self.lenses) != k:
            count = len(self.lenses)
            raise SettingError("cameras.arrays", f"{k} cameras need {k} lenses, not {count}.")

    def __len__(self) -> int:
        return len(self.labels)


NO_CAMERAS = Cameras((), np.zeros((0, 3)))
"""For a correction without cameras; see `MethodOptions.check_no_cameras`."""


@dataclass(frozen=True, slots=True)
class WaterPlane:
    """The plane z = a + b x + c y in world coordinates; a level when b = c = 0."""

    a: float
    b: float = 0.0
    c: float = 0.0

    def __str__(self) -> str:
        if self.b == self.c == 0.0:
            return f"level {self.a:g} m"
        return f"plane z = {self.a:g} + {self.b:g} x + {self.c:g} y"


@dataclass(frozen=True, slots=True)
class WaterDimension:
    """A dimension of the cloud that holds the height (m) of the water surface above each point.

    The surface is taken as level above each point.
    """

    name: str

    def __str__(self) -> str:
        return f"dimension {self.name}"


@dataclass(frozen=True, eq=False)
class WaterMesh:
    """A triangulated height field.

    Attributes
    ----------
    vertices : array, shape (v, 3)
        Metres, world frame.
    triangles : array, shape (t, 3)
        Row numbers of `vertices`.
    name : str
        Its file.
    """

    vertices: FloatArray
    triangles: IntArray
    name: str = "mesh"

    def __str__(self) -> str:
        return f"mesh {self.name}, {len(self.triangles)} triangles"


@dataclass(frozen=True, eq=False)
class WaterRaster:
    """Heights on a regular grid, bilinear between the centres of the cells.

    The height of a place is known if those of all four centres around it are. In the outer half of
    the cells at the edge it is extrapolated, so that a raster without gaps covers all its cells.

    Attributes
    ----------
    height_m : array, shape (rows, columns)
        World frame; the first row is the northern one. NaN where the surface is not known.
    left_m, top_m : float
        The upper left corner of the upper left cell, world frame.
    cell_m : tuple of 2 float
        Width and height of a cell.
    name : str
        Its file.
    """

    height_m: FloatArray
    left_m: float
    top_m: float
    cell_m: tuple[float, float]
    name: str = "raster"

    def __post_init__(self) -> None:
        """Check that it is a raster with some heights."""
        shape = self.height_m.shape
        if len(shape) != 2 or min(shape) < 2:
            raise SettingError(
                "water.raster_size", f"Give at least 2 rows and columns, not {shape}."
            )
        place = (self.left_m, self.top_m, *self.cell_m)
        if not (np.isfinite(place).all() and min(self.cell_m) > 0.0):
            raise SettingError(
                "water.raster_place",
                f"Water raster {self.name}: the corner {self.left_m:g}, {self.top_m:g} must be"
                f" finite and the cells {self.cell_m[0]:g} x {self.cell_m[1]:g} m positive.",
            )
        if np.isinf(self.height_m).any() or not np.isfinite(self.height_m).any():
            raise SettingError(
                "water.raster_heights",
                f"Water raster {self.name}: heights must be finite, or NaN in some cells.",
            )

    def __str__(self) -> str:
        rows, columns = self.height_m.shape
        return f"raster {self.name}, {columns} x {rows} cells of {self.cell_m[0]:g} m"


WaterSurface: TypeAlias = WaterPlane | WaterDimension | WaterMesh | WaterRaster


@dataclass(frozen=True, eq=False)
class Views:
    """Which cameras made each of n points: rows of a ragged table.

    The cameras of point i are ``camera[start[i]:start[i + 1]]``, row numbers of `Cameras`;
    `weight`, where the source has one, is what each of them counted for, in the same order.

    As `tracks` they are the images whose rays were intersected; as `depth-maps` those whose depth
    maps, each matched with other images, were averaged; as `pairs` the entries 2i and 2i + 1 of a
    point are the two images of its stereo pair i, of whose places the point is the median; as
    `pair-images` they are the images of such pairs, any two that were matched.
    """

    start: IntArray
    camera: IntArray
    weight: npt.NDArray[np.float32] | None = None
    kind: ViewKind = "tracks"

    def take(self, rows: IntArray) -> Views:
        """Return the views of the given points, in that order."""
        counts = (self.start[1:] - self.start[:-1])[rows]
        start = np.concatenate([[0], np.cumsum(counts)])
        where = np.repeat(self.start[rows] - start[:-1], counts) + np.arange(start[-1])
        weight = None if self.weight is None else self.weight[where]
        return Views(start, self.camera[where], weight, self.kind)


@dataclass(frozen=True, eq=False)
class TiePoints:
    """The m points of a sparse model, and their o image points."""

    xyz: FloatArray  # (m, 3), in the frame of the cameras that were read with them; NaN if unknown
    views: Views  # the cameras that observed each point
    image_xy: FloatArray  # (o, 2), in the unit of the lens from the upper left corner, as `views`


@dataclass(frozen=True, eq=False)
class GroundControl:
    """The m surveyed points, and their o image points.

    A point on a surface (``on``) may have no coordinates: NaN, and infinite standard deviations.
    """

    names: tuple[str, ...]
    xyz: FloatArray  # (m, 3), metres, in `crs`
    sigma_m: FloatArray  # (m, 3), standard deviations along x, y, z
    is_check: BoolArray  # (m,), check points, which an adjustment does not use
    under_water: BoolArray  # (m,), according to the survey
    point: IntArray  # (o,), row of `names`
    camera: IntArray  # (o,), row of the cameras
    image_xy: FloatArray  # (o, 2), in the unit of the lens, from the upper left corner
    sigma_px: FloatArray  # (o,), standard deviations of u and v
    crs: str | None = None  # None if the source does not say
    on: tuple[str, ...] = ()  # surface of each point, if any: ``water``, name of a plane, or empty
    on_sigma_m: FloatArray = field(default_factory=lambda: np.zeros(0))  # of the distance from it

    @property
    def surveyed(self) -> GroundControl:
        """Those with coordinates."""
        known = np.asarray(np.isfinite(self.xyz).all(axis=1))
        kept, rows = known[self.point], np.flatnonzero(known)
        return replace(
            self,
            names=tuple(self.names[i] for i in rows),
            xyz=self.xyz[rows],
            sigma_m=self.sigma_m[rows],
            is_check=self.is_check[rows],
            under_water=self.under_water[rows],
            point=(np.cumsum(known) - 1)[self.point[kept]],
            camera=self.camera[kept],
            image_xy=self.image_xy[kept],
            sigma_px=self.sigma_px[kept],
            on=(),
            on_sigma_m=np.zeros(0),
        )


class Outcome(IntEnum):
    """Whether a point was corrected, and why not."""

    LAND = 0
    CORRECTED = 1
    NO_CAMERA = 2
    ONE_CAMERA = 3
    PARALLEL_RAYS = 4
    NOT_CARRIED = 5
    """It could not be transferred to the adjusted cameras."""
    FLAT_RAYS = 6
    """Two cameras or more see it, but fewer than two within the largest angle."""


PART_POINTS = 32_768
"""Points of each of `Correction.parts`: an array of them has 256 kB."""


@dataclass(frozen=True, eq=False)
class Correction:
    """The result for n points, one row per input point; zero on land.

    If the cameras were adjusted after the points were reconstructed, land has a shift too.

    Attributes
    ----------
    apparent_xyz : array, shape (n, 3)
        Apparent points, metres, world frame.
    shift_m : array, shape (n, 3)
        True minus apparent.
    outcome : array of uint8, shape (n,)
        Values of `Outcome`.
    ray_count : array of int32, shape (n,)
        Rays that were intersected.
    ray_miss_m : array, shape (n,)
        Root mean square distance of the true point from its rays.
    depth_m : array, shape (n,)
        Depth below the water surface along the vertical, positive down; of the apparent point
        where the point could not be corrected.
    incidence_deg : array, shape (n,)
        The largest incidence angle in air among the rays used.
    sigma_z_m : array, shape (n,)
        Standard error of Z: the options ``sigma_...`` by the law of error propagation and, in
        clouds with enough points, matching noise and the difference to other reconstruction types
        (`pcfix.refract.reconstructions`).
    camera_used : array of bool, shape (k,)
        Cameras with at least one ray.
    water_known : array of bool, shape (n,)
        Whether the water surface has a height above the point.
    lowest_water_m : float
        The lowest height of the water surface above any point; infinite where none is known.
    covariance_m2 : array, shape (n, 6), or None
        Covariances of the coordinates: xx, xy, xz, yy, yz, zz; see `pcfix.refract.uncertainty`.
        None if they were not requested.
    unsure : array of bool, shape (n,), or None
        Corrected points that only oblique images see, without a view list; see
        `pcfix.refract.batch.Batch.seen_flat`. None if the option `unsure` is ``keep``.
    """

    apparent_xyz: FloatArray
    shift_m: FloatArray
    outcome: npt.NDArray[np.uint8]
    ray_count: npt.NDArray[np.int32]
    ray_miss_m: FloatArray
    depth_m: FloatArray
    incidence_deg: FloatArray
    sigma_z_m: FloatArray
    camera_used: BoolArray
    water_known: BoolArray
    lowest_water_m: float
    covariance_m2: FloatArray | None = None
    unsure: BoolArray | None = None

    def parts(self) -> Iterator[tuple[slice, Correction]]:
        """Yield consecutive rows and their results, without covariances.

        The rows fit into the processor's cache: several operations on them are much faster than on
        all points.
        """
        per_point = [
            name for name, value in vars(self).items()
            if isinstance(value, np.ndarray) and name not in ("camera_used", "covariance_m2", "xyz")
        ]  # fmt: skip
        for first in range(0, len(self.outcome), PART_POINTS):
            rows = slice(first, first + PART_POINTS)
            some = {name: getattr(self, name)[rows] for name in per_point}
            yield rows, replace(self, covariance_m2=None, **some)

    @cached_property
    def xyz(self) -> FloatArray:
        """Corrected points, metres, world frame; land and uncorrected points are apparent ones."""
        xyz = self.apparent_xyz.copy()
        xyz[self.moved] += self.shift_m[self.moved]
        return xyz

    @property
    def submerged(self) -> BoolArray:
        """Points below the water surface."""
        return np.asarray((self.outcome != Outcome.LAND) & (self.outcome != Outcome.NOT_CARRIED))

    @property
    def corrected(self) -> BoolArray:
        """Corrected points."""
        return np.asarray(self.outcome == Outcome.CORRECTED)

    @property
    def uncorrected(self) -> BoolArray:
        """Submerged points that could not be corrected."""
        return np.asarray(self.outcome > Outcome.CORRECTED)

    @cached_property
    def moved(self) -> BoolArray:
        """Points with a shift: corrected ones, and land after a transfer to adjusted cameras."""
        x, y, z = self.shift_m.T  # axis by axis: numpy is slow along the short one
        return np.asarray(self.corrected | (x != 0.0) | (y != 0.0) | (z != 0.0))
