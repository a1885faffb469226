r"""Transfer of a dense cloud from the original to the adjusted cameras.

An apparent point P is the intersection of rays of the original cameras. The images have not
changed, so it moves to P', where the same image coordinates intersect now:

    sum J'(pi_adjusted(P') - pi_original(P)) = 0

with straight rays, as ordinary software intersects them, land and bed alike. The cloud is then the
one that the same software would have made with the adjusted cameras, and can be corrected with them
by any method. Points are classified as submerged afterwards, because an adjustment without water
may lower or raise a beach.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pcfix.adjust.block import some_cameras
from pcfix.errors import GeometryError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot, minus, plus, plus_square, row_of, scaled, solved, times, vector
from pcfix.lens.imaging import image_and_slopes, image_of
from pcfix.model import BoolArray, Cameras, Correction, FloatArray, IntArray, Outcome, Views
from pcfix.refract.batch import Optics, optics_of
from pcfix.refract.choice import views_in_frame
from pcfix.refract.tiling import spatial_order
from pcfix.sums import Sums

MAX_STEPS = 12
CLOSE_M = 1e-6
LEAST_CONDITION = 1e-6  # determinant of the normal matrix over the product of its diagonal
SAME_SIDES = 0.002  # relative difference of the sides of one image, which may be rounded
POINTS_AT_ONCE = 100_000  # points whose cameras are listed at a time, which limits the memory

# Share of the flying height between two centres of one image; refraction moves a block, with its
# datum and scale, by a few hundredths.
MOST_SHIFT = 0.1


# Points


def transfer(
    xyz: FloatArray, views: Views, original: Cameras, adjusted: Cameras
) -> tuple[FloatArray, BoolArray]:
    """Intersect the images of points again, with adjusted cameras.

    The cameras are the same images in the same order, with angles and lenses. Points and shifts
    have the shape (n, 3), metres, world frame. Returns the shifts, zero for points that stay, and
    which points two cameras or more image, before and after.
    """
    shift, moved = np.zeros((len(xyz), 3)), np.zeros(len(xyz), np.bool_)
    start, camera = np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64)
    in_tiles(
        _transfer, len(xyz), np.ascontiguousarray(xyz), start, camera,
        np.ascontiguousarray(original.centres), optics_of(original),
        np.ascontiguousarray(adjusted.centres), optics_of(adjusted), shift, moved,
    )  # fmt: skip
    return shift, moved


@kernel(allocates=True)
def _transfer(
    span: Span, xyz: FloatArray, start: IntArray, camera: IntArray, original_centres: FloatArray,
    original: Optics, centres: FloatArray, adjusted: Optics, shift: FloatArray, moved: BoolArray,
) -> None:  # fmt: skip
    most = np.diff(start[span[0] : span[1] + 1]).max()
    image, who = np.empty((most, 2)), np.empty(most, np.int64)
    for i in range(*span):
        # where the original cameras image the point, by straight rays
        count = 0
        for j in range(start[i], start[i + 1]):
            c = camera[j]
            ahead = times(original.rotations[c], minus(row_of(xyz, i), row_of(original_centres, c)))
            u, v = image_of(original.lenses[original.row[c]], *ahead)
            if u == u and v == v:  # not NaN
                image[count, 0], image[count, 1], who[count] = u, v, c
                count += 1
        if count >= 2:
            moved[i] = _intersect(shift[i], xyz[i], image[:count], who[:count], centres, adjusted)


@device
def _intersect(
    shift: FloatArray, xyz: FloatArray, image: FloatArray, who: IntArray, centres: FloatArray,
    cameras: Optics,
) -> bool:  # fmt: skip
    """Find the shift of a point that minimises its residuals; return whether that converges."""
    moved, point = (0.0, 0.0, 0.0), vector(xyz)
    for _ in range(MAX_STEPS):
        # Gauss-Newton: m = sum J'J (upper triangle), b = sum J'r
        m, b = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for j in range(who.size):
            c = who[j]
            ahead = minus(plus(point, moved), row_of(centres, c))
            lens = cameras.lenses[cameras.row[c]]
            u, v, by_u, by_v = image_and_slopes(lens, None, cameras.rotations[c], ahead)
            m, b = plus_square(m, by_u), plus(b, scaled(image[j, 0] - u, by_u))
            m, b = plus_square(m, by_v), plus(b, scaled(image[j, 1] - v, by_v))
        # nearly parallel rays do not fix the point
        det, step = solved(m, b)
        if not det > LEAST_CONDITION * m[0] * m[3] * m[5]:
            return False
        moved = plus(moved, step)
        if dot(step, step) <= CLOSE_M * CLOSE_M:
            shift[0], shift[1], shift[2] = moved
            return True
    return False


def transfer_of(original: Cameras, adjusted: Cameras, place: IntArray) -> "CloudTransfer":
    """Return the transfer between two models, given the original row of each adjusted image."""
    row = np.full(len(original), -1)
    row[place] = np.arange(len(adjusted))
    original = some_cameras(original, place)
    pairs = zip(original.labels, original.lenses or (), adjusted.lenses or (), strict=True)
    for label, before, after in pairs:
        sides = np.array([[after.width, after.height], [before.width, before.height]])
        if before.unit != after.unit or np.abs(sides[0] / sides[1] - 1.0).max() > SAME_SIDES:
            words = (
                f"--adjusted-from: image {label} has {before.width:g} x {before.height:g}"
                f" {before.unit}, but {after.width:g} x {after.height:g} {after.unit} in the"
                " cameras. Give the model from which the cameras were adjusted."
            )
            raise GeometryError("adjusted_from.shape", words, image=label)
    return CloudTransfer(original, adjusted, row)


def renumbered(views: Views, row: IntArray) -> tuple[Views, IntArray]:
    """Return views with other camera numbers, without negative ones, and the entries that stay."""
    camera = row[np.asarray(views.camera)]
    entry = np.flatnonzero(camera >= 0)
    start = np.append(0, np.cumsum(camera >= 0))[views.start]
    weight = None if views.weight is None else views.weight[entry]
    return Views(start, camera[entry], weight, views.kind), entry


# Clouds


class Transferred(NamedTuple):
    """Points after their transfer."""

    original_xyz: FloatArray  # (n, 3), metres, with the original cameras
    xyz: FloatArray  # (n, 3), with the adjusted ones
    moved: BoolArray  # (n,), whether a point could be transferred
    views: Views | None  # their view list with the adjusted cameras, if there is one

    def as_original(self, correction: Correction) -> Correction:
        """Return the correction of `xyz` as one of the original points.

        Points that were not transferred or not corrected stay at their original place.
        """
        outcome = np.where(self.moved, correction.outcome, np.uint8(Outcome.NOT_TRANSFERRED))
        found = replace(correction, outcome=outcome)
        shift = self.xyz - self.original_xyz + correction.shift_m
        shift = np.where(found.uncorrected[:, None], 0.0, shift)
        return replace(found, apparent_xyz=self.original_xyz, shift_m=shift)


@dataclass(frozen=True)
class TransferCounts(Sums):
    """Statistics of transferred points."""

    points: int
    not_moved: int
    land: int
    sum_z_m: float
    sum_squares_m2: float  # of the length of the shift

    @classmethod
    def of(cls, step: Transferred, correction: Correction) -> "TransferCounts":
        """Return those of a chunk, with the correction that `Transferred.as_original` returned."""
        followed = step.moved & ~correction.uncorrected
        shift = (step.xyz - step.original_xyz)[followed]
        land = int((correction.outcome[followed] == Outcome.LAND).sum())
        not_moved, squares = int((~step.moved).sum()), float((shift**2).sum())
        return cls(len(shift), not_moved, land, float(shift[:, 2].sum()), squares)

    def check(self, name: str) -> None:
        """Refuse a cloud that the original cameras do not see."""
        if self.points == 0 and self.not_moved:
            words = (
                f"{name}: no point could be transferred to the adjusted cameras, because fewer than"
                " two original cameras image them. Check that --adjusted-from is the model of the"
                " cloud, in its CRS."
            )
            raise GeometryError("adjusted_from.no_overlap", words, path=name)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, metres."""
        count = max(self.points, 1)
        return {
            "points": self.points,
            "land": self.land,
            "not_transferred": self.not_moved,
            "shift_m": {
                "mean_z": round(self.sum_z_m / count, 4),
                "rms": round(float(np.sqrt(self.sum_squares_m2 / count)), 4),
            },
        }


@dataclass(frozen=True, eq=False)
class CloudTransfer:
    """The transfer of a cloud from the original to the adjusted cameras of the same k images."""

    original: Cameras  # in the cloud's CRS, with angles and lenses
    adjusted: Cameras  # the same, row by row; both lenses of an image have one unit
    row: IntArray  # (o,), row here of each original camera as read, -1 if it was not adjusted

    def step(self, xyz: FloatArray, listed: Views | None) -> Transferred:
        """Transfer points, shape (n, 3), metres; `listed` are views of the original cameras."""
        original, adjusted = self.original, self.adjusted
        shift, moved = np.zeros((len(xyz), 3)), np.zeros(len(xyz), np.bool_)
        views = None if listed is None else renumbered(listed, self.row)[0]
        if views is not None:
            shift, moved = transfer(xyz, views, original, adjusted)
        left = np.flatnonzero(~moved)
        left = left[spatial_order(np.ascontiguousarray(xyz[left]))]
        for first in range(0, len(left), POINTS_AT_ONCE):
            rows = left[first : first + POINTS_AT_ONCE]
            in_frame = views_in_frame(xyz[rows], original)
            shift[rows], moved[rows] = transfer(xyz[rows], in_frame, original, adjusted)
        return Transferred(xyz, xyz + shift, moved, views)

    def check_models(self, xyz: FloatArray) -> None:
        """Refuse models in different places, given points of the cloud."""
        if not len(xyz):
            return
        height = float(np.median(self.original.centres[:, 2]) - np.median(xyz[:, 2]))
        offset = self.adjusted.centres - self.original.centres
        off_m = float(np.median(np.linalg.norm(offset, axis=1)))
        if off_m > MOST_SHIFT * height > 0.0:
            words = (
                f"--adjusted-from: its cameras are {off_m:,.0f} m from the adjusted ones (median;"
                f" flying height {height:,.0f} m). Check both files, --cameras-crs and"
                " --cameras-offset, which count for the file that has no CRS."
            )
            raise GeometryError("adjusted_from.too_far", words, distance_m=off_m, height_m=height)

    def provenance(self) -> dict[str, Any]:
        """Return the record of the transfer for the output file."""
        source = self.original.source
        return {"adjusted_from": {"cameras": len(self.row), "source": source}}
