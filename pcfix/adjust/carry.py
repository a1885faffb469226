r"""A dense cloud taken from old cameras to adjusted ones.

An apparent point P is where rays of the old cameras met. What the images showed is still true, so
P is where the same places in the images meet now: P' with

    sum J'(pi_new(P') - pi_old(P)) = 0

straight rays, as ordinary software intersects them, land and bed alike. The cloud is then what the
same software would have made with the adjusted cameras, and any method of correction goes on from
there with them. What is submerged is decided afterwards, as an adjustment that knew of no water
sinks or lifts whole beaches.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pcfix.adjust.gather import some_cameras
from pcfix.errors import GeometryError, PcfixWarning
from pcfix.kernels import Span, device, in_tiles, kernel, most_between
from pcfix.lens.algebra import dot, minus, plus, plus_square, row_of, scaled, solved, times, vector
from pcfix.lens.imaging import image_in_world, image_of, lens_table
from pcfix.model import (
    BoolArray,
    Cameras,
    Correction,
    FloatArray,
    IntArray,
    Lens,
    Outcome,
    TiePoints,
    Views,
)
from pcfix.refract.choice import views_in_frame
from pcfix.refract.tiling import spatial_order
from pcfix.sums import Sums
from pcfix.water.surface import SurfaceAbove, is_submerged

Label: TypeAlias = Callable[[FloatArray, SurfaceAbove], BoolArray]

MAX_STEPS = 12
CLOSE_M = 1e-6
LEAST_CONDITION = 1e-6
"""Of the determinant of the normal matrix, against the product of its diagonal."""


class Carried(NamedTuple):
    """Where points went.

    shift_m : shape (n, 3), zero where the point stayed.
    moved : shape (n,), whether two cameras or more imaged the point, before and after.
    """

    shift_m: FloatArray
    moved: BoolArray


def carry(xyz: FloatArray, views: Views, old: Cameras, new: Cameras) -> Carried:
    """Intersect the image places of points again, with adjusted cameras.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Apparent points, metres, world frame.
    views : Views
        Which cameras each point is carried by; weights do not count.
    old, new : Cameras
        The same images, in the same order, with angles and lenses.
    """
    found = Carried(np.zeros((len(xyz), 3)), np.zeros(len(xyz), np.bool_))
    start, camera = np.asarray(views.start, np.int64), np.asarray(views.camera, np.int64)
    sides = (
        _Side(
            np.ascontiguousarray(cameras.centres),
            np.ascontiguousarray(cameras.rotations, np.float64),
            *lens_table(cameras.lenses or ()),
        )
        for cameras in (old, new)
    )
    in_tiles(_carry, len(xyz), np.ascontiguousarray(xyz), start, camera, *sides, *found)
    return found


class _Side(NamedTuple):
    """Cameras for the kernels: poses, each one's row of the lens table, and the table."""

    centres: FloatArray
    rotations: FloatArray
    row: IntArray
    lenses: FloatArray


@kernel(allocates=True)
def _carry(
    span: Span, xyz: FloatArray, start: IntArray, camera: IntArray, old: _Side, new: _Side,
    shift: FloatArray, moved: BoolArray,
) -> None:  # fmt: skip
    most = most_between(span, start)
    image, who = np.empty((most, 2)), np.empty(most, np.int64)
    for i in range(*span):
        count = 0
        for j in range(start[i], start[i + 1]):
            c = camera[j]
            ahead = times(old.rotations[c], minus(row_of(xyz, i), row_of(old.centres, c)))
            u, v = image_of(old.lenses[old.row[c]], *ahead)
            if u == u and v == v:
                image[count, 0], image[count, 1], who[count] = u, v, c
                count += 1
        if count >= 2:
            moved[i] = _meet(shift[i], xyz[i], image[:count], who[:count], new)


@device
def _meet(shift: FloatArray, xyz: FloatArray, image: FloatArray, who: IntArray, new: _Side) -> bool:
    """Find the shift after which the cameras image the point nearest to the places; whether so."""
    moved, point = (0.0, 0.0, 0.0), vector(xyz)
    for _ in range(MAX_STEPS):
        m, b = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for j in range(who.size):
            c = who[j]
            ahead = minus(plus(point, moved), row_of(new.centres, c))
            u, v, by_u, by_v = image_in_world(new.lenses[new.row[c]], new.rotations[c], ahead)
            m, b = plus_square(m, by_u), plus(b, scaled(image[j, 0] - u, by_u))
            m, b = plus_square(m, by_v), plus(b, scaled(image[j, 1] - v, by_v))
        det, step = solved(m, b)
        if not det > LEAST_CONDITION * m[0] * m[3] * m[5]:
            return False
        moved = plus(moved, step)
        if dot(step, step) <= CLOSE_M * CLOSE_M:
            shift[0], shift[1], shift[2] = moved
            return True
    return False


SAME_SHAPE = 0.002
"""Of the ratio of an image's sides. Undistorted images differ by more from those that they were
made of, unless they have the very same size; sides in millimetres are rounded by less."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Old and adjusted cameras of the same k images, row by row.

    Attributes
    ----------
    old, new : Cameras
        In the cloud's CRS, with angles and lenses; the lenses of an image in one unit.
    row : array, shape (o,)
        The row here of each of the old cameras as they were read, -1 where it was not adjusted.
    left_out : tuple of str
        Images of the old model that were not adjusted.
    """

    old: Cameras
    new: Cameras
    row: IntArray
    left_out: tuple[str, ...]


def pair_of(old: Cameras, new: Cameras, place: IntArray) -> Pair:
    """Return the pair of two models, given the row in the old one of each new image.

    Raises
    ------
    GeometryError
        If the images have not the same shape.
    """
    row = np.full(len(old), -1)
    row[place] = np.arange(len(new))
    left_out = tuple(label for label, at in zip(old.labels, row, strict=True) if at < 0)
    old = some_cameras(old, place)
    lenses = tuple(map(_in_unit_of, new.lenses or (), old.lenses or (), old.labels))
    return Pair(replace(old, lenses=lenses), new, row, left_out)


def _in_unit_of(new: Lens, old: Lens, label: str) -> Lens:
    """Return an old lens in the unit of the new one, whose image has the same shape."""
    factor = new.width / old.width
    if not abs(factor * old.height / new.height - 1.0) <= SAME_SHAPE:
        raise GeometryError(
            f"adjusted-from: image {label} has {old.width:g} x {old.height:g} {old.unit} there, but"
            f" {new.width:g} x {new.height:g} {new.unit} in the cameras; these are not the same"
            " images (one of them undistorted?); give the model that the cameras were adjusted"
            " from."
        )
    if factor == 1.0:
        return old
    lengths = ("focal", "width", "height", "principal_x", "principal_y", "b1", "b2", "b3")
    scaled = {name: factor * getattr(old, name) for name in lengths}
    return replace(old, unit=new.unit, **scaled)


def renumbered(views: Views, row: IntArray) -> tuple[Views, IntArray]:
    """Return views of other numbers, without entries of negative ones, and which entries stayed."""
    camera = row[np.asarray(views.camera)]
    stays = camera >= 0
    if views.kind == "pairs":
        stays = np.repeat(stays[::2] & stays[1::2], 2)
    entry = np.flatnonzero(stays)
    start = np.concatenate([[0], np.cumsum(stays)])[views.start]
    weight = None if views.weight is None else views.weight[entry]
    return Views(start, camera[entry], weight, views.kind), entry


POINTS_AT_ONCE = 100_000
"""Whose cameras are listed at a time, which bounds the memory."""

MOST_APART = 0.1
"""Of the flying height, between two centres of one image. What refraction does to a block, datum
and scale included, is a few hundredths."""

REASON = "fewer than two old cameras image them"


class Step(NamedTuple):
    """Points on the way: n of them.

    old_xyz : where they were, shape (n, 3), metres; xyz : where they are with the new cameras;
    carried : which could be taken there; views : theirs, of the new cameras, where there are any.
    """

    old_xyz: FloatArray
    xyz: FloatArray
    carried: BoolArray
    views: Views | None

    def rule(self, label: Label | None) -> Label:
        """Return the rule that says what is submerged, by which no point is that stayed behind."""

        def submerged(xyz: FloatArray, surface: SurfaceAbove) -> BoolArray:
            below = is_submerged(xyz[:, 2], surface) if label is None else label(xyz, surface)
            return below & self.carried

        return submerged

    def whole(self, correction: Correction) -> Correction:
        """Return the correction of `xyz` as one of the points as they were.

        A point that is submerged and got no rays stays where it was, and so does one that
        was not carried.
        """
        outcome = np.where(self.carried, correction.outcome, np.uint8(Outcome.NOT_CARRIED))
        found = replace(correction, outcome=outcome)
        stays = found.uncorrected
        shift = np.where(stays[:, None], 0.0, self.xyz - self.old_xyz + correction.shift_m)
        return replace(found, apparent_xyz=self.old_xyz, shift_m=shift)


class Carrying(Sums):
    """The two models of a block, and what became of the points so far."""

    added, most = ("_points", "_not_carried", "_land", "_sum_m"), ("_most_m",)

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self._is_checked = False
        self.restart()

    def restart(self) -> None:
        """Forget the points so far."""
        self._points = self._not_carried = self._land = 0
        self._sum_m, self._most_m = np.zeros(4), 0.0

    def step(self, xyz: FloatArray, listed: Views | None) -> Step:
        """Take points over.

        Parameters
        ----------
        xyz : array, shape (n, 3)
            Metres, world frame.
        listed : Views or None
            Of the old cameras, as they were read.

        Raises
        ------
        GeometryError
            If the two models do not lie in one place.
        """
        self._check(xyz)
        old, new = self.pair.old, self.pair.new
        shift, carried = np.zeros((len(xyz), 3)), np.zeros(len(xyz), np.bool_)
        views = None if listed is None else renumbered(listed, self.pair.row)[0]
        if views is not None:
            # whatever the list means to the correction, these images saw the point
            shift, carried = carry(xyz, replace(views, kind="tracks"), old, new)
        for rows in _batches(xyz, np.flatnonzero(~carried)):
            shift[rows], carried[rows] = carry(xyz[rows], views_in_frame(xyz[rows], old), old, new)
        return Step(xyz, xyz + shift, carried, views)

    def of_new_ties(self, ties: TiePoints) -> TiePoints:
        """Return tie points of the adjusted block, taken back to the old cameras."""
        known = np.flatnonzero(np.isfinite(ties.xyz).all(axis=1))
        xyz, views = ties.xyz.copy(), ties.views.take(known)
        xyz[known] += carry(xyz[known], views, self.pair.new, self.pair.old).shift_m
        return replace(ties, xyz=xyz)

    def _check(self, xyz: FloatArray) -> None:
        """Refuse models that are apart, by the first points to come, and warn of single images."""
        if self._is_checked or not len(xyz):
            return
        self._is_checked = True
        old, new = self.pair.old, self.pair.new
        height = float(np.median(old.centres[:, 2]) - np.median(xyz[:, 2]))
        apart = np.linalg.norm(new.centres - old.centres, axis=1)
        middle, most = float(np.median(apart)), MOST_APART * height
        if height <= 0.0 or apart.max() <= most:
            return
        if middle > most:
            raise GeometryError(
                f"adjusted-from: its cameras stand {_metres(middle)} from where the adjusted ones"
                f" do (the middle of {len(apart)} images), more than a tenth of their height of"
                f" {_metres(height)} over the cloud, so the two are not of one block in one CRS;"
                " check both files, --cameras-crs and --cameras-offset (they count for the file"
                " that does not say where it lies)."
            )
        worst = int(np.argmax(apart))
        warnings.warn(
            f"adjusted-from: {int((apart > most).sum())} of {len(apart)} images were moved by more"
            f" than a tenth of their height over the cloud, {old.labels[worst]} by"
            f" {_metres(apart[worst])}; look at their poses.",
            PcfixWarning,
            stacklevel=3,
        )

    def add(self, step: Step, correction: Correction) -> None:
        """Count a chunk: the step, and what `Step.whole` made of its correction."""
        followed = step.carried & ~correction.uncorrected
        shift = (step.xyz - step.old_xyz)[followed]
        length2 = (shift**2).sum(axis=1)
        self._points += len(shift)
        self._land += int((correction.outcome[followed] == Outcome.LAND).sum())
        self._not_carried += int((~step.carried).sum())
        self._sum_m += [*shift.sum(axis=0), length2.sum()]
        self._most_m = max(self._most_m, float(np.sqrt(length2.max(initial=0.0))))

    def check(self, name: str) -> None:
        """Refuse a cloud that the old cameras do not see.

        Raises
        ------
        GeometryError
            If no point was carried.
        """
        if self._points == 0 and self._not_carried:
            raise GeometryError(
                f"{name}: no point could be taken from the old cameras to the new ones:"
                f" {REASON}; check that adjusted-from is the model that the cloud was made with,"
                " in its CRS."
            )

    def as_dict(self) -> dict[str, Any]:
        """Return the figures in plain values, metres."""
        apart = np.linalg.norm(self.pair.new.centres - self.pair.old.centres, axis=1)
        mean = self._sum_m / max(self._points, 1)
        shift = {
            "mean_x": mean[0], "mean_y": mean[1], "mean_z": mean[2], "rms": np.sqrt(mean[3]),
            "max": self._most_m,
        }  # fmt: skip
        centres = {"rms": np.sqrt((apart**2).mean()), "max": apart.max()}
        return {
            "points": self._points,
            "land": self._land,
            "not_carried": self._not_carried,
            "not_carried_reason": REASON,
            "shift_m": {name: round(float(value), 4) for name, value in shift.items()},
            "cameras": len(apart),
            "cameras_left_out": list(self.pair.left_out),
            "centres_m": {name: round(float(value), 4) for name, value in centres.items()},
        }

    def provenance(self) -> dict[str, Any]:
        """Return what a file shall say of it."""
        return {"adjusted_from": {"cameras": len(self.pair.row), "source": self.pair.old.source}}


def _batches(xyz: FloatArray, rows: IntArray) -> Iterator[IntArray]:
    """Yield rows of points, neighbours together."""
    order = rows[spatial_order(np.ascontiguousarray(xyz[rows]))]
    for first in range(0, len(order), POINTS_AT_ONCE):
        yield order[first : first + POINTS_AT_ONCE]


def _metres(value: float) -> str:
    return f"{value:,.2f} m" if value < 100.0 else f"{value:,.0f} m"
