"""Data types that all folders share, as frozen dataclasses.

Frames: the *world* is the cloud's own projected CRS, metres, right-handed, Z up. The *camera frame*
is OpenCV's: x right, y down, z forward; ``x_camera = R (x_world - C)``.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import PcfixWarning, SettingError

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

BATHYMETRIC_POINT = 40  # a point on the bed; classes of LAS 1.4 and its topo-bathy domain profile
NOISE_CLASSES = LOW_NOISE, HIGH_NOISE = 7, 18

Projection = Literal[
    "perspective", "equidistant", "equisolid", "polynomial", "fov", "dual", "division", "eucm"
]
ViewKind = Literal["tracks", "depth-maps", "pairs"]

# Width of the image of a lens in millimetres whose pixel size is unknown: that of a survey drone's
# camera of 20 megapixels, 13.2 mm with pixels of 2.4 um.
NOMINAL_WIDTH_PX = 5472.0


@dataclass(frozen=True, slots=True)
class Lens:
    """An interior orientation: it maps a direction in the camera frame to image coordinates.

    There are three steps. First the direction (X, Y, Z), at the angle theta from the axis, is
    projected; with (e, g) = (X, Y) / hypot(X, Y):

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

    and last the image coordinates, from the upper left corner of the upper left pixel:

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
        k1, k2, ... and d1, d2, ...; any number of them.
    tangential : tuple of float
        p1 ... p4 in Brown's order (Metashape's; OpenCV's p1 and p2 the other way round).
    thin_prism : tuple of float
        s1 ... s4.
    distortion_centre : tuple of 2 float
        In plane coordinates.
    inverse : bool
        Brown's formula maps (x', y') to (x, y) instead.
    in_turn : bool
        The tangential and thin prism terms use x, y and r after the radial terms (COLMAP's
        RAD_TAN_THIN_PRISM_FISHEYE).
    sensor : str
        Name of the sensor in the camera file.
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
        World to camera. None if the file has no angles; then every camera is a candidate for
        every point.
    lenses : tuple of Lens, length k, or None
        Interior orientation of each image. None if the file has none; then every point in front
        of the camera counts as in its frame.
    crs : str or None
        CRS of centres and rotations: what pyproj understands (geocentric ones are allowed), or
        ``ENU:latitude,longitude,height`` for axes east, north, up at that place, or ``local``
        if the file states that its frame is not tied to the earth. None if it states nothing;
        then the CRS of the cloud is assumed.
    project_crs : str or None
        The CRS in which the software exports its clouds, if that is not `crs`.
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
        """Check the shapes of the arrays."""
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


# The cameras of a correction without any; see `MethodOptions.check_no_cameras`.
NO_CAMERAS = Cameras((), np.zeros((0, 3)))


@dataclass(frozen=True, slots=True)
class WaterPlane:
    """The plane z = a + b x + c y in world coordinates; a level when b = c = 0."""

    a: float
    b: float = 0.0
    c: float = 0.0

    def __str__(self) -> str:
        if self.b == self.c == 0.0:
            return f"level {round(self.a, 3):.9g} m"
        return f"plane z = {self.a:g} + {self.b:g} x + {self.c:g} y"


@dataclass(frozen=True, slots=True)
class WaterDimension:
    """A dimension of the cloud that holds the height (m) of the water surface above each point.

    The surface is assumed to be level above each point.
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

    The height at a position is known if the heights of all four centres around it are. In the outer
    half of the cells at the edge it is extrapolated, so a raster without gaps covers all its cells.

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
        """Check size, position and heights."""
        shape = self.height_m.shape
        if len(shape) != 2 or min(shape) < 2:
            sentence = f"Give at least 2 rows and columns, not {shape}."
            raise SettingError("water.raster_size", sentence)
        place = (self.left_m, self.top_m, *self.cell_m)
        if not (np.isfinite(place).all() and min(self.cell_m) > 0.0):
            sentence = f"Water raster {self.name}: the corner {self.left_m:g}, {self.top_m:g} must"
            cell = f"{self.cell_m[0]:g} x {self.cell_m[1]:g} m"
            sentence += f" be finite and the cells {cell} positive."
            raise SettingError("water.raster_place", sentence)
        if np.isinf(self.height_m).any() or not np.isfinite(self.height_m).any():
            sentence = f"Water raster {self.name}: heights must be finite, or NaN in some cells."
            raise SettingError("water.raster_heights", sentence)

    def __str__(self) -> str:
        rows, columns = self.height_m.shape
        return f"raster {self.name}, {columns} x {rows} cells of {self.cell_m[0]:g} m"


WaterSurface: TypeAlias = WaterPlane | WaterDimension | WaterMesh | WaterRaster


@dataclass(frozen=True, eq=False)
class Views:
    """The images that contributed to each of n points: a view list, as a ragged table.

    The images of point i are ``camera[start[i]:start[i + 1]]``, row numbers of `Cameras`. `weight`
    has the weight of each of them in the same order, if the list states weights.

    The kind states what these images are:

    - `tracks`: the images whose rays were intersected;
    - `depth-maps`: the images whose depth maps were averaged, each matched with other images;
    - `pairs`: the images of stereo pairs, over which the point is the median; any two of them may
      have been matched.
    """

    start: IntArray
    camera: IntArray
    weight: npt.NDArray[np.float32] | None = None
    kind: ViewKind = "tracks"

    def take(self, rows: IntArray) -> "Views":
        """Return the view list of the given points, in that order."""
        counts = (self.start[1:] - self.start[:-1])[rows]
        start = np.concatenate([[0], np.cumsum(counts)])
        where = np.repeat(self.start[rows] - start[:-1], counts) + np.arange(start[-1])
        weight = None if self.weight is None else self.weight[where]
        return Views(start, self.camera[where], weight, self.kind)


@dataclass(frozen=True, eq=False)
class TiePoints:
    """The m tie points of a model, and their o observations."""

    xyz: FloatArray  # (m, 3), in the frame of the cameras that were read with them; NaN if unknown
    views: Views  # the images that observed each point
    image_xy: FloatArray  # (o, 2), in the unit of the lens, from the upper left corner


@dataclass(frozen=True, eq=False)
class GroundControl:
    """The m control and check points, and their o observations.

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


class Outcome(IntEnum):
    """Whether a point was corrected, and why not."""

    LAND = 0
    CORRECTED = 1
    NO_CAMERA = 2
    ONE_CAMERA = 3
    PARALLEL_RAYS = 4
    NOT_TRANSFERRED = 5  # it could not be transferred to the adjusted poses
    FLAT_RAYS = 6  # two images or more show it, fewer than two with rays within the maximum angle


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
        Whether the height of the water surface above the point is known.
    lowest_water_m : float
        The lowest height of the water surface above any point; infinite if none is known.
    covariance_m2 : array, shape (n, 6), or None
        Covariances of the coordinates: xx, xy, xz, yy, yz, zz; see `pcfix.refract.uncertainty`.
        None if they were not requested.
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

    @cached_property
    def xyz(self) -> FloatArray:
        """Corrected points, metres, world frame; for land and uncorrected points apparent ones."""
        xyz = self.apparent_xyz.copy()
        xyz[self.moved] += self.shift_m[self.moved]
        return xyz

    @property
    def submerged(self) -> BoolArray:
        """Points below the water surface."""
        return np.asarray(
            (self.outcome != Outcome.LAND) & (self.outcome != Outcome.NOT_TRANSFERRED)
        )

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
        """Points with a shift: corrected ones, and land after a transfer to adjusted poses."""
        x, y, z = self.shift_m.T  # by axis, because numpy is slow along the short one
        return np.asarray(self.corrected | (x != 0.0) | (y != 0.0) | (z != 0.0))
