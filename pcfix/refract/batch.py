"""Input and output types of the correction methods.

`Survey` is what all points have in common, `Batch` adds what each point has. A dense matcher
compared images in the geometry of its own cameras; a direction there becomes one of the adjusted
cameras by its place in the image (`OriginalModel`, `Images`).
"""

import warnings
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import PcfixWarning, SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, dot, minus, normal_of, row_of, times, transposed_times
from pcfix.lens.formulas import lens_table
from pcfix.lens.imaging import direction_of, image_of
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Outcome, Views, WaterSurface
from pcfix.options.correct import ScienceOptions
from pcfix.water.surface import Field, SurfaceAbove

if TYPE_CHECKING:
    from pcfix.refract.fusion import Bed
    from pcfix.refract.matcher import Matcher
    from pcfix.refract.occlusion import Occluder
    from pcfix.refract.regression import DepthRegression

NO_CAMERA, ONE_CAMERA = int(Outcome.NO_CAMERA), int(Outcome.ONE_CAMERA)
PARALLEL, CORRECTED = int(Outcome.PARALLEL_RAYS), int(Outcome.CORRECTED)  # for kernels
FLAT_DEG = 35.0  # incidence angle beyond which methods differ most; see `reconstructions.LIMITS`
ALIKE = ("snell", "shan", "butler", "murase", "dietrich")  # all rays of a point count alike
NOMINAL_FOCAL_PX = 3700.0  # without a lens: a survey drone's of 20 megapixels, 0.27 mrad a pixel


class Learned(NamedTuple):
    """What was estimated from the cloud as a whole; None where it was not."""

    regression: "DepthRegression | None" = None  # for the method of that name
    occluder: "Occluder | None" = None  # the surface of the cloud
    matcher: "Matcher | None" = None  # which images were matched with each other
    bed: "Bed | None" = None  # the bed that agrees with most fused points
    model_uncertainty: "ModelUncertainty | None" = None
    land: "Survey | None" = None  # for land transferred to adjusted cameras, if it differs
    poses: "PoseErrors | None" = None  # errors of Z from the adjusted poses
    limit_deg: float | None = None  # largest incidence angle of the rays of the points


class ModelUncertainty(NamedTuple):
    """Errors of Z beyond the error budget, estimated from the cloud."""

    scatter_m: float  # of neighbours about a smooth bed, beyond the budget: mismatches
    per_depth: float  # standard deviation by depth, from the unknown reconstruction type
    formal_m: float = 0.0  # median standard error of the budget itself


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Standard errors of Z by the poses, on a grid in plan."""

    low: FloatArray  # (2,), south-west corner, metres
    cell_m: float
    sigma_m: FloatArray  # (columns, rows), in the middle of the cells
    middle_m: float  # root mean square over the bed

    def at(self, xy: FloatArray) -> FloatArray:
        """Return the standard errors at places, shape (n, 2)."""
        from scipy.ndimage import map_coordinates

        place = (xy - self.low) / self.cell_m - 0.5
        return np.asarray(map_coordinates(self.sigma_m, place.T, order=1, mode="nearest"))


class OriginalModel(NamedTuple):
    """The model of m points before their cameras were adjusted."""

    xyz: FloatArray  # (m, 3), original apparent points, metres, world frame
    cameras: Cameras  # in the order of the adjusted ones, with angles and lenses


@dataclass(frozen=True, eq=False)
class Survey:
    """What all points of a cloud have in common.

    `unlisted` is the survey of points without an entry in the view list, if there are any.
    `own_water` is the water of single images as rasters, for ``snell`` and ``consistent``; beyond
    their edges the rays are refracted at `water`.
    """

    water: WaterSurface
    cameras: Cameras
    settings: ScienceOptions
    level_offset_m: FloatArray | None = None  # (k,), how much higher the water stood per image
    learned: Learned = field(default_factory=Learned)
    unlisted: "Survey | None" = None
    own_water: Field | None = None

    @property
    def limit_deg(self) -> float | None:
        """The largest incidence angle of a ray, as set or as learned; None for no limit."""
        learned = self.learned.limit_deg if self.settings.method in ALIKE else None
        return learned if self.settings.limit_deg is None else self.settings.limit_deg

    def rig(self) -> "Rig":
        """Return the cameras for kernels."""
        cameras, k = self.cameras, len(self.cameras)
        axes, focal, offset = np.zeros((k, 3)), np.full(k, NOMINAL_FOCAL_PX), np.zeros(k)
        if cameras.lenses is not None and cameras.rotations is not None:
            is_flat = [lens.projection == "perspective" for lens in cameras.lenses]
            flat = np.flatnonzero(is_flat)
            axes[flat] = cameras.rotations[flat, 2]
            focal = np.array([lens.focal_px for lens in cameras.lenses])
        if self.level_offset_m is not None:
            offset = np.ascontiguousarray(self.level_offset_m, np.float64)
        return Rig(np.ascontiguousarray(cameras.centres), offset, axes, focal)


@dataclass(frozen=True, eq=False)
class Batch:
    """Submerged points, the water above them and the cameras that see them.

    `views` are the view lists or, once they are chosen, the cameras that give each point a ray.
    `original_model` is there if `xyz` were transferred to adjusted cameras
    (`pcfix.adjust.transfer`): dense matching is inverted in it, and the matcher has its cameras.
    """

    xyz: FloatArray  # (m, 3), apparent points, metres, world frame
    surface: SurfaceAbove
    survey: Survey
    views: Views | None = None
    original_model: OriginalModel | None = None
    level_sigma_m: FloatArray | None = None  # (m,), of the surface above each point, from its fit

    def take(self, rows: IntArray) -> "Batch":
        """Return some of the points, in the order of `rows`."""
        sigma, model = self.level_sigma_m, self.original_model
        return replace(
            self,
            xyz=self.xyz.take(rows, axis=0),  # four times as fast as with brackets
            surface=SurfaceAbove(
                self.surface.height_m[rows], self.surface.slope.take(rows, axis=0)
            ),
            views=None if self.views is None else self.views.take(rows),
            original_model=None if model is None else model._replace(xyz=model.xyz[rows]),
            level_sigma_m=None if sigma is None else sigma[rows],
        )

    def __len__(self) -> int:
        return len(self.xyz)

    def parts(self) -> "list[tuple[IntArray, Batch]]":
        """Return the points with a view list and those without: the rows and the batch of each."""
        if self.survey.unlisted is None or self.views is None:
            return [(np.arange(len(self)), self)]
        is_listed = np.diff(self.views.start) > 0
        listed, others = np.flatnonzero(is_listed), np.flatnonzero(~is_listed)
        bare = replace(self.take(others), survey=self.survey.unlisted, views=None)
        parts = [(listed, self.take(listed)), (others, bare)]
        return [part for part in parts if len(part[0])] or parts[:1]

    @property
    def rays(self) -> Views:
        """The cameras that were chosen for each point."""
        if self.views is None:
            raise ValueError("the cameras of the batch are not chosen yet")
        return self.views

    @property
    def counts(self) -> IntArray:
        """Rays of each point, shape (m,)."""
        return np.diff(self.rays.start)

    def chosen(self) -> "Chosen":
        """Return the points and their cameras, if these are known, for kernels."""
        views, none = self.views, np.zeros(0, np.int64)
        original = self.xyz if self.original_model is None else self.original_model.xyz
        return Chosen(
            xyz=np.ascontiguousarray(self.xyz),
            original_xyz=np.ascontiguousarray(original),
            height=np.ascontiguousarray(self.surface.height_m),
            slope=np.ascontiguousarray(self.surface.slope),
            rig=self.survey.rig(),
            start=none if views is None else np.ascontiguousarray(views.start, np.int64),
            camera=none if views is None else np.ascontiguousarray(views.camera, np.int64),
            n=self.survey.settings.refractive_index,
        )

    def result(
        self,
        shift_m: FloatArray,
        *,
        outcome: npt.NDArray[np.uint8],
        ray_miss_m: FloatArray | None = None,
    ) -> "Intersection":
        """Return the result of a method that gives shifts; zeros for points that are not moved."""
        moved, zero = outcome == Outcome.CORRECTED, np.zeros(len(self.xyz))
        used = np.zeros(len(self.survey.cameras), np.bool_)
        used[self.rays.camera[np.repeat(moved, self.counts)]] = True
        cosine = np.empty(len(self))
        in_tiles(_incidence, len(self), self.chosen(), cosine)
        angle = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
        return Intersection(
            shift_m=np.where(moved[:, None], shift_m, 0.0),
            outcome=outcome,
            ray_count=np.where(moved, self.counts, 0).astype(np.int32),
            ray_miss_m=zero if ray_miss_m is None else np.where(moved, ray_miss_m, 0.0),
            sigma_z_m=zero,
            incidence_deg=np.where(moved, angle, 0.0),
            camera_used=used,
        )


def stacked(batches: list[Batch]) -> Batch:
    """Join batches of one survey, without views; at least one."""
    models = [batch.original_model for batch in batches if batch.original_model is not None]
    model = None
    if models:
        model = OriginalModel(np.vstack([one.xyz for one in models]), models[0].cameras)
    return replace(
        batches[0],
        xyz=np.vstack([batch.xyz for batch in batches]),
        surface=SurfaceAbove(
            np.concatenate([batch.surface.height_m for batch in batches]),
            np.vstack([batch.surface.slope for batch in batches]),
        ),
        original_model=model,
    )


class Intersection(NamedTuple):
    """The result for m submerged points; see `pcfix.Correction` for the meaning of each.

    Methods leave `sigma_z_m` and `covariance_m2` to `pcfix.refract.methods.correct`, except for
    some that know a scatter.
    """

    shift_m: FloatArray
    outcome: npt.NDArray[np.uint8]
    ray_count: npt.NDArray[np.int32]
    ray_miss_m: FloatArray
    sigma_z_m: FloatArray
    incidence_deg: FloatArray
    camera_used: BoolArray
    covariance_m2: FloatArray | None = None
    ambiguity_m: FloatArray | None = None  # of Z, by the choice among groups of depth maps

    def take(self, rows: IntArray | BoolArray) -> "Intersection":
        """Return the results of some points."""
        known = {name: value for name, value in self._asdict().items() if value is not None}
        known.pop("camera_used")
        return self._replace(**{name: value[rows] for name, value in known.items()})

    def with_rows(self, rows: IntArray, other: "Intersection") -> "Intersection":
        """Return the results with those of some points replaced, in the same arrays."""
        for name, value in other._asdict().items():
            if value is not None and name != "camera_used":
                getattr(self, name)[rows] = value
        return self._replace(camera_used=self.camera_used | other.camera_used)


@kernel
def _incidence(span: Span, points: "Chosen", cosine: FloatArray) -> None:
    """Write the cosine of the largest incidence angle of each point's rays."""
    for i in range(*span):
        least, normal = 1.0, normal_above(points, i)
        for at in range(points.start[i], points.start[i + 1]):
            e = minus(row_of(points.rig.centres, points.camera[at]), row_of(points.xyz, i))
            least = min(least, dot(normal, e) / np.sqrt(dot(e, e)))
        cosine[i] = least


def require_orientation(cameras: Cameras, who: str, instead: str = "") -> None:
    """Raise SettingError if cameras have no angles or no lenses."""
    named = (("angles", cameras.rotations), ("lenses", cameras.lenses))
    missing = [name for name, value in named if value is None]
    if missing:
        raise SettingError(
            "cameras.no_orientation",
            f"{who} needs the angles and the lens of each image, and the cameras have no"
            f" {' and no '.join(missing)}. Give a camera file that has them, or --sensor for the"
            f" lens{f', or {instead}' if instead else ''}.",
            missing=missing,
        )


def warn_of_unsolved(beginning: str, found: BoolArray) -> None:
    """Warn of points that were moved without a solution; `found` has an entry for each."""
    if not found.all():
        unsolved = int((~found).sum())
        warnings.warn(
            PcfixWarning(
                "points.unsolved",
                f"{beginning} for {unsolved:,} of {len(found):,} points; they have that of snell.",
                points=unsolved,
            ),
            stacklevel=3,
        )


class Rig(NamedTuple):
    """The k cameras, for kernels; metres, world frame."""

    centres: FloatArray  # (k, 3), projection centres
    offset: FloatArray  # (k,), how much higher the water stood for each
    axes: FloatArray  # (k, 3), optical axes; zeros for images of nearly equal angles (fisheyes)
    focal_px: FloatArray  # (k,)


class Chosen(NamedTuple):
    """Points, the water above them and the cameras chosen for each, for kernels; see `Batch`."""

    xyz: FloatArray  # (m, 3), apparent points
    original_xyz: FloatArray  # the same in the original model
    height: FloatArray  # (m,), of the water above each point
    slope: FloatArray  # (m, 2)
    rig: Rig
    start: IntArray  # the cameras of point i are camera[start[i] : start[i + 1]]
    camera: IntArray
    n: float


@device
def normal_above(points: Chosen, i: int) -> Vector:
    """Return the unit normal, upward, of the water above point i."""
    return normal_of(points.slope[i, 0], points.slope[i, 1])


class Optics(NamedTuple):
    """The angles and lenses of k cameras, for kernels."""

    rotations: FloatArray  # (k, 3, 3), from the world
    row: IntArray  # (k,), of each camera in `lenses`
    lenses: FloatArray  # see `pcfix.lens.formulas.lens_table`


def optics_of(cameras: Cameras) -> Optics:
    """Return the angles and lenses of cameras that have them."""
    return Optics(
        np.ascontiguousarray(cameras.rotations, np.float64), *lens_table(cameras.lenses or ())
    )


class Images(NamedTuple):
    """The k images in the original and in the adjusted cameras, for kernels."""

    centres: FloatArray  # (k, 3), of the original cameras, metres, world frame
    original: Optics
    adjusted: Optics | None  # None for the same: then no direction is rounded by two lenses


def images_of(original_model: OriginalModel | None, now: Cameras) -> Images:
    """Return the images for kernels; both cameras have angles and lenses."""
    original = now if original_model is None else original_model.cameras
    adjusted = None if original is now else optics_of(now)
    return Images(np.ascontiguousarray(original.centres, np.float64), optics_of(original), adjusted)


@device
def in_other(one: Optics | None, other: Optics | None, c: int, a: Vector) -> Vector:
    """Convert a direction in which camera c sees something to another pose and lens of the image.

    Both are in the world frame, of any length, and belong to the same place in the image; NaN where
    there is no image.
    """
    if one is None or other is None:
        return a
    u, v = image_of(one.lenses[one.row[c]], *times(one.rotations[c], a))
    seen = direction_of(other.lenses[other.row[c]], u, v)
    return transposed_times(other.rotations[c], seen)
