"""What goes into a correction and what comes out: one batch of points, one result.

`Survey` is what all points have in common, `Batch` adds what each of them has of its own. The door
of the room, `pcfix.refract.methods.correct`, takes a batch whole; so does each method, with the
cameras chosen.

A dense matcher compared images in the geometry of its own cameras, right or wrong; the light went
in that of the true ones. What both have in common is the place in the image: a direction in the
one geometry is a direction in the other, through the lens of either (`OriginalModel`, `Images`).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import PcfixWarning, SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, times, transposed_times
from pcfix.lens.imaging import direction_of, image_of, lens_table
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Outcome, Views, WaterSurface
from pcfix.options.correct import ScienceOptions
from pcfix.refract.matcher import Bed, Matcher
from pcfix.refract.occlusion import Occluder
from pcfix.refract.pose_errors import PoseErrors
from pcfix.refract.regression import DepthRegression
from pcfix.water.surface import OwnWater, SurfaceAbove

NO_CAMERA, ONE_CAMERA = int(Outcome.NO_CAMERA), int(Outcome.ONE_CAMERA)
PARALLEL, CORRECTED = int(Outcome.PARALLEL_RAYS), int(Outcome.CORRECTED)
"""Of `Outcome`, for kernels."""

FLAT_DEG = 35.0
"""Rays beyond this are those by which methods differ most; see `reconstructions.LIMITS`."""


UNLISTED, MAIN = -1, -2
"""Points in no list, and those of no source of their own; see `Survey.parts`."""


class Learned(NamedTuple):
    """What methods may need beyond the points themselves; None where it was not learned.

    Attributes
    ----------
    regression : DepthRegression or None
        From check depths, for the method of that name.
    occluder : Occluder or None
        The cloud's own surface, which hides points from cameras.
    matcher : Matcher or None
        Which images were matched with which.
    bed : Bed or None
        What fused points of one place have in common.
    model_uncertainty : ModelUncertainty or None
        Of how the cloud was made.
    land : Survey or None
        What land is corrected with that was carried to adjusted cameras, if not with the same.
    poses : PoseErrors or None
        What the errors of adjusted poses come to.
    """

    regression: DepthRegression | None = None
    occluder: Occluder | None = None
    matcher: Matcher | None = None
    bed: Bed | None = None
    model_uncertainty: ModelUncertainty | None = None
    land: Survey | None = None
    poses: PoseErrors | None = None


class ModelUncertainty(NamedTuple):
    """What the standard error of Z has beyond the error budget, as the cloud itself tells it.

    Attributes
    ----------
    scatter_m : float
        Of neighbours about a smooth bed, beyond what the budget explains: mismatches.
    per_depth : float
        Standard deviation, relative to the depth, by what is not known of how the cloud was made.
    formal_m : float
        What the budget itself comes to, in the median, metres.
    """

    scatter_m: float
    per_depth: float
    formal_m: float = 0.0


class OriginalModel(NamedTuple):
    """What made m points, where that are other cameras than those they are corrected with.

    Attributes
    ----------
    xyz : array, shape (m, 3)
        Apparent points as the software had them, metres, world frame.
    cameras : Cameras
        Those it had, in the order of the adjusted ones, with angles and lenses.
    """

    xyz: FloatArray
    cameras: Cameras

    def take(self, rows: IntArray) -> OriginalModel:
        """Return what made some of the points."""
        return OriginalModel(self.xyz[rows], self.cameras)


@dataclass(frozen=True, eq=False)
class Survey:
    """What all points of a cloud are corrected with.

    Attributes
    ----------
    water : WaterSurface
        Needed for its shape where it is a mesh or raster.
    cameras : Cameras
        Projection centres and frames, world frame.
    settings : ScienceOptions
    level_offset_m : array, shape (k,), or None
        How much higher the water stood when each camera took its image. None: nowhere.
    learned : Learned
    parts : mapping
        Surveys of points that were made in another way than most: by their source, and of those in
        no list, where there is one, by `UNLISTED`.
    own_water : OwnWater or None
        Rasters of the water as single images saw it, in which all rays of ``snell`` and
        ``consistent`` bend; at `water` where they do not reach.
    """

    water: WaterSurface
    cameras: Cameras
    settings: ScienceOptions
    level_offset_m: FloatArray | None = None
    learned: Learned = field(default_factory=Learned)
    parts: Mapping[int, Survey] = field(default_factory=dict)
    own_water: OwnWater | None = None

    @property
    def offset_m(self) -> FloatArray:
        """`level_offset_m`, with zeros where the water did not move."""
        if self.level_offset_m is None:
            return np.zeros(len(self.cameras))
        return np.ascontiguousarray(self.level_offset_m, np.float64)


@dataclass(frozen=True, eq=False)
class Batch:
    """Submerged points, the water above them and the cameras that see them.

    Attributes
    ----------
    xyz : array, shape (m, 3)
        Apparent points, metres, world frame.
    surface : SurfaceAbove
        The water above each of them.
    survey : Survey
    views : Views or None
        The cameras of each point: those of a list, to choose from; or, once they are chosen, those
        that give it a ray. None where no list says it.
    original_model : OriginalModel or None
        The points as they came and the cameras they came from, where `xyz` are the same points
        carried to others (`pcfix.adjust.carry`). What undoes dense matching goes by it; the matcher
        learned is one of those cameras then.
    level_sigma_m : array, shape (m,), or None
        Standard deviation of the height of the surface above each point, as its fit has it.
    source : array of int, shape (m,), or None
        Which of several clouds each point came from.
    """

    xyz: FloatArray
    surface: SurfaceAbove
    survey: Survey
    views: Views | None = None
    original_model: OriginalModel | None = None
    level_sigma_m: FloatArray | None = None
    source: IntArray | None = None

    def take(self, rows: IntArray) -> Batch:
        """Return some of the points, in the order of `rows`."""
        sigma = self.level_sigma_m
        return replace(
            self,
            xyz=self.xyz.take(rows, axis=0),  # four times as fast as with brackets
            surface=SurfaceAbove(
                self.surface.height_m[rows], self.surface.slope.take(rows, axis=0)
            ),
            views=None if self.views is None else self.views.take(rows),
            original_model=None if self.original_model is None else self.original_model.take(rows),
            level_sigma_m=None if sigma is None else sigma[rows],
            source=None if self.source is None else self.source[rows],
        )

    def __len__(self) -> int:
        return len(self.xyz)

    def parts(self) -> list[tuple[IntArray, Batch]]:
        """Return the rows that were made in one way, and the batch of them, way by way."""
        surveys = self.survey.parts
        if not surveys:
            return [(np.arange(len(self)), self)]
        key = np.full(len(self), MAIN) if self.source is None else self.source.astype(np.int64)
        key[~np.isin(key, list(surveys))] = MAIN
        if self.views is not None and UNLISTED in surveys:
            key[np.diff(self.views.start) == 0] = UNLISTED
        parts = []
        for one in np.unique(key):
            rows = np.flatnonzero(key == one)
            part = self.take(rows)
            if one != MAIN:
                part = replace(part, survey=surveys[int(one)])
            parts.append((rows, replace(part, views=None) if one == UNLISTED else part))
        return parts or [(np.arange(0), self)]

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

    def chosen(self) -> Chosen:
        """Return the points and their cameras, if these are known, for kernels."""
        survey, views, none = self.survey, self.views, np.zeros(0, np.int64)
        original = self.xyz if self.original_model is None else self.original_model.xyz
        return Chosen(
            xyz=np.ascontiguousarray(self.xyz),
            original_xyz=np.ascontiguousarray(original),
            height=np.ascontiguousarray(self.surface.height_m),
            slope=np.ascontiguousarray(self.surface.slope),
            normals=self.normals(),
            centres=np.ascontiguousarray(survey.cameras.centres),
            offset=survey.offset_m,
            start=none if views is None else np.ascontiguousarray(views.start, np.int64),
            camera=none if views is None else np.ascontiguousarray(views.camera, np.int64),
            n=survey.settings.refractive_index,
        )

    def normals(self) -> FloatArray:
        """Return the unit normal of the surface above each point, upward, shape (m, 3)."""
        slope = self.surface.slope
        up = 1.0 / np.sqrt(1.0 + (slope**2).sum(axis=1))
        return np.column_stack([-slope * up[:, None], up])

    def outcome(self) -> npt.NDArray[np.uint8]:
        """Return what becomes of points with so many rays, shape (m,)."""
        counts = self.counts
        few = np.where(counts == 1, Outcome.ONE_CAMERA, Outcome.NO_CAMERA)
        return np.where(counts >= 2, Outcome.CORRECTED, few).astype(np.uint8)

    def incidence_deg(self) -> FloatArray:
        """Return the largest incidence angle in air of each point's rays, shape (m,)."""
        return self._angles_deg()[:, 1]

    def steepest_deg(self) -> FloatArray:
        """Return the smallest one; 90 where there is no ray."""
        return self._angles_deg()[:, 0]

    def seen_flat(self) -> BoolArray:
        """Return which points have rays, and those beyond `FLAT_DEG` from the normal alone."""
        return np.asarray((self.counts > 0) & (self.steepest_deg() > FLAT_DEG))

    def _angles_deg(self) -> FloatArray:
        """Return the smallest and the largest incidence angle of each point's rays, shape (m, 2).

        90 and 0 where there is no ray.
        """
        cosine, views = np.empty((len(self), 2)), self.rays
        in_tiles(
            _incidence, len(self), np.ascontiguousarray(self.xyz), self.normals(),
            np.ascontiguousarray(self.survey.cameras.centres),
            np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64), cosine,
        )  # fmt: skip
        return np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))

    def camera_used(self, moved: BoolArray) -> BoolArray:
        """Return which cameras give a ray to a point that is moved, shape (k,)."""
        used, views = np.zeros(len(self.survey.cameras), np.bool_), self.rays
        start, camera = np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64)
        in_tiles(_mark_used, len(self), start, camera, moved, used)
        return used

    def result(
        self,
        shift_m: FloatArray,
        *,
        outcome: npt.NDArray[np.uint8] | None = None,
        ray_miss_m: FloatArray | None = None,
    ) -> Intersection:
        """Return the result of a method that gives shifts, shape (m, 3).

        Points that are not moved get a shift of zero, and zeros beside it.
        """
        outcome = self.outcome() if outcome is None else outcome
        moved = outcome == Outcome.CORRECTED
        zero = np.zeros(len(self.xyz))
        return Intersection(
            shift_m=np.where(moved[:, None], shift_m, 0.0),
            outcome=outcome,
            ray_count=np.where(moved, self.counts, 0).astype(np.int32),
            ray_miss_m=zero if ray_miss_m is None else np.where(moved, ray_miss_m, 0.0),
            sigma_z_m=zero,
            incidence_deg=np.where(moved, self.incidence_deg(), 0.0),
            camera_used=self.camera_used(moved),
        )


def stacked(batches: list[Batch]) -> Batch:
    """Return batches of one survey, without views, as one; at least one of them."""
    made = [batch.original_model for batch in batches if batch.original_model is not None]
    source = [batch.source for batch in batches if batch.source is not None]
    return replace(
        batches[0],
        xyz=np.vstack([batch.xyz for batch in batches]),
        surface=SurfaceAbove(
            np.concatenate([batch.surface.height_m for batch in batches]),
            np.vstack([batch.surface.slope for batch in batches]),
        ),
        original_model=OriginalModel(np.vstack([one.xyz for one in made]), made[0].cameras)
        if made
        else None,
        source=np.concatenate(source) if source else None,
    )


@kernel
def _incidence(
    span: Span, xyz: FloatArray, normals: FloatArray, centres: FloatArray, start: IntArray,
    camera: IntArray, cosine: FloatArray,
) -> None:  # fmt: skip
    """Write the largest and the smallest cosine of the incidence angles of each point's rays."""
    for i in range(*span):
        most, least = 0.0, 1.0
        for at in range(start[i], start[i + 1]):
            c, across, square = camera[at], 0.0, 0.0
            for k in range(3):
                way = centres[c, k] - xyz[i, k]
                across, square = across + normals[i, k] * way, square + way * way
            along = across / np.sqrt(square)
            most, least = max(most, along), min(least, along)
        cosine[i, 0], cosine[i, 1] = most, least


@kernel
def _mark_used(
    span: Span, start: IntArray, camera: IntArray, moved: BoolArray, used: BoolArray
) -> None:
    """Mark the cameras of the points that are moved; threads write the same value."""
    for i in range(*span):
        if moved[i]:
            for at in range(start[i], start[i + 1]):
                used[camera[at]] = True


class Intersection(NamedTuple):
    """The result for m submerged points; see `pcfix.Correction` for the meaning of each.

    The methods themselves leave `sigma_z_m`, `covariance_m2` and `unsure` open, but for some that
    know a scatter; `pcfix.refract.methods.correct` fills them.
    """

    shift_m: FloatArray
    outcome: npt.NDArray[np.uint8]
    ray_count: npt.NDArray[np.int32]
    ray_miss_m: FloatArray
    sigma_z_m: FloatArray
    incidence_deg: FloatArray
    camera_used: BoolArray
    covariance_m2: FloatArray | None = None
    unsure: BoolArray | None = None

    def take(self, rows: IntArray | BoolArray) -> Intersection:
        """Return the results of some points."""
        known = {name: value for name, value in self._asdict().items() if value is not None}
        known.pop("camera_used")
        return self._replace(**{name: value[rows] for name, value in known.items()})


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
    """Warn of the points that are moved without a solution; `found` has one entry for each."""
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


class Chosen(NamedTuple):
    """Points, the water above them and the cameras chosen for each, for kernels; see `Batch`.

    Attributes
    ----------
    xyz, original_xyz : array, shape (m, 3)
        Apparent points, as they are corrected and as the matcher had them.
    height : array, shape (m,)
    slope : array, shape (m, 2)
    normals : array, shape (m, 3)
        Of the water above each point.
    centres, offset : array, shapes (k, 3) and (k,)
        Projection centres, and how much higher the water stood for each.
    start, camera : array
        Those of point i are ``camera[start[i] : start[i + 1]]``.
    n : float
        Refractive index.
    """

    xyz: FloatArray
    original_xyz: FloatArray
    height: FloatArray
    slope: FloatArray
    normals: FloatArray
    centres: FloatArray
    offset: FloatArray
    start: IntArray
    camera: IntArray
    n: float


class Optics(NamedTuple):
    """The k cameras as they image, for kernels.

    Rotations from the world, shape (k, 3, 3); the lens of each as a row of the table `lenses`, see
    `pcfix.lens.imaging.lens_table`.
    """

    rotations: FloatArray
    row: IntArray
    lenses: FloatArray


def optics_of(cameras: Cameras) -> Optics:
    """Return the angles and lenses of cameras that have them."""
    return Optics(
        np.ascontiguousarray(cameras.rotations, np.float64), *lens_table(cameras.lenses or ())
    )


class Images(NamedTuple):
    """The k images in the cameras that made the points and in those of now, for kernels.

    Without rows where they are the same: then no light goes through a lens, and nothing is rounded.

    Attributes
    ----------
    centres : array, shape (k, 3)
        Of those that made the points, metres, world frame.
    rotations, rotations_now : array, shape (k, 3, 3)
        World to camera.
    row, row_now : array, shape (k,)
        The lens of each image in the tables.
    lenses, lenses_now : array, shape (l, ...)
        See `pcfix.lens.imaging.lens_table`.
    """

    centres: FloatArray
    rotations: FloatArray
    row: IntArray
    lenses: FloatArray
    rotations_now: FloatArray
    row_now: IntArray
    lenses_now: FloatArray


def images_of(original_model: OriginalModel | None, now: Cameras) -> Images:
    """Return the images for kernels.

    Raises
    ------
    ValueError
        If there are two sets of cameras, and one has no angles or no lenses, or they are not of
        the same number.
    """
    if original_model is None or _are_equal(original_model.cameras, now):
        none, no_row = np.zeros((0, 3, 3)), np.zeros(0, np.int64)
        return Images(np.zeros((0, 3)), none, no_row, np.zeros((0, 1)), none, no_row, none[:, 0])
    made = original_model.cameras
    if made.lenses is None or now.lenses is None or len(made) != len(now):
        raise ValueError("the same images are needed twice, with angles and lenses")
    return Images(np.ascontiguousarray(made.centres, np.float64), *optics_of(made), *optics_of(now))


def _are_equal(made: Cameras, now: Cameras) -> bool:
    """Whether two sets of cameras show the same everywhere."""
    return made is now or (
        np.array_equal(made.centres, now.centres)
        and made.lenses == now.lenses
        and made.rotations is not None
        and now.rotations is not None
        and np.array_equal(made.rotations, now.rotations)
    )


@device
def to_original(images: Images, c: int, a: Vector) -> Vector:
    """Return where the matcher had what camera c sees in a direction, both in the world frame.

    NaN where there is no image; of any length.
    """
    if len(images.centres) == 0:
        return a
    return _through(
        images.rotations_now[c], images.lenses_now[images.row_now[c]],
        images.rotations[c], images.lenses[images.row[c]], a,
    )  # fmt: skip


@device
def to_adjusted(images: Images, c: int, a: Vector) -> Vector:
    """Return in which direction camera c sees what the matcher had in a direction."""
    return _through(
        images.rotations[c], images.lenses[images.row[c]],
        images.rotations_now[c], images.lenses_now[images.row_now[c]], a,
    )  # fmt: skip


@device
def _through(
    r: FloatArray, lens: FloatArray, to_r: FloatArray, to_lens: FloatArray, a: Vector
) -> Vector:
    """Return the direction of the same place in the image for another pose and lens."""
    u, v = image_of(lens, *times(r, a))
    return transposed_times(to_r, direction_of(to_lens, u, v))
