"""A cloud taken from the cameras that made it to adjusted ones, chunk by chunk, before all else.

What the old cameras of a point saw is still true, so the point is where the same places in the
images meet now (`pcfix.adjust.carry`): by the cameras of its view list, or else by every old camera
whose frame holds it. Land moves as the bed does. What is submerged is decided afterwards, as an
adjustment that knew of no water sinks or lifts whole beaches.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.adjust.carry import carry
from pcfix.errors import GeometryError, PcfixWarning
from pcfix.model import Outcome, Views
from pcfix.refract.batch import MadeWith
from pcfix.refract.choice import spatial_order, views_in_frame
from pcfix.water.surface import SurfaceAbove, is_submerged

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import TypeAlias

    from pcfix.flow.old_cameras import Pair
    from pcfix.model import BoolArray, Correction, FloatArray, IntArray, TiePoints

    Label: TypeAlias = Callable[[FloatArray, SurfaceAbove], BoolArray]

POINTS_AT_ONCE = 100_000
"""Whose cameras are listed at a time, which bounds the memory."""

MOST_APART = 0.1
"""Of the flying height, between two centres of one image. What refraction does to a block, datum
and scale included, is a few hundredths."""

REASON = "fewer than two old cameras image them"


class Step(NamedTuple):
    """Points on the way: n of them.

    came : where they were, shape (n, 3), metres; xyz : where they are with the new cameras;
    carried : which could be taken there; views : theirs, of the new cameras, where there are any.
    """

    came: FloatArray
    xyz: FloatArray
    carried: BoolArray
    views: Views | None

    def rule(self, label: Label | None) -> Label:
        """Return the rule that says what is submerged, by which no point is that stayed behind."""
        below = _below if label is None else label
        return lambda xyz, surface: below(xyz, surface) & self.carried

    def whole(self, correction: Correction) -> Correction:
        """Return the correction of `xyz` as one of the points as they came.

        A point that is submerged and got no rays stays where it came from, and so does one that
        was not carried.
        """
        outcome = np.where(self.carried, correction.outcome, np.uint8(Outcome.NOT_CARRIED))
        found = replace(correction, outcome=outcome)
        stays = found.uncorrected
        shift = np.where(stays[:, None], 0.0, self.xyz - self.came + correction.shift_m)
        return replace(found, apparent_xyz=self.came, shift_m=shift)


def _below(xyz: FloatArray, surface: SurfaceAbove) -> BoolArray:
    return is_submerged(xyz[:, 2], surface)


class Carrying:
    """The two models of a block, and what became of the points so far.

    Parameters
    ----------
    pair : Pair
    """

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
        views = None if listed is None else self.pair.renumbered(listed)
        shift = np.zeros((len(xyz), 3))
        carried = np.zeros(len(xyz), np.bool_)
        if views is not None:
            # whatever the list means to the correction, these images saw the point
            shift, carried = carry(xyz, replace(views, kind="tracks"), self.pair.old, self.pair.new)
        for rows in _batches(xyz, np.flatnonzero(~carried)):
            shift[rows], carried[rows] = self._by_all(xyz[rows])
        return Step(xyz, xyz + shift, carried, views)

    def _by_all(self, xyz: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Take points over by every old camera whose frame holds them."""
        return carry(xyz, views_in_frame(xyz, self.pair.old), self.pair.old, self.pair.new)

    def made_with(self, xyz: FloatArray) -> MadeWith:
        """Return what made points, as they came."""
        return MadeWith(xyz, self.pair.old)

    def of_new_ties(self, ties: TiePoints) -> TiePoints:
        """Return tie points of the adjusted block, taken back to the old cameras."""
        known = np.flatnonzero(np.isfinite(ties.xyz).all(axis=1))
        xyz = ties.xyz.copy()
        some = ties.views.take(known)
        xyz[known] += carry(xyz[known], some, self.pair.new, self.pair.old).shift_m
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
        came_along = step.carried & ~correction.uncorrected
        shift = (step.xyz - step.came)[came_along]
        length2 = (shift**2).sum(axis=1)
        self._points += len(shift)
        self._land += int((correction.outcome[came_along] == Outcome.LAND).sum())
        self._not_carried += int((~step.carried).sum())
        self._sum_m += [*shift.sum(axis=0), length2.sum()]
        self._most_m = max(self._most_m, float(np.sqrt(length2.max(initial=0.0))))

    @property
    def not_carried(self) -> int:
        """Points so far that could not be taken over."""
        return self._not_carried

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
        return {
            "points": self._points,
            "land": self._land,
            "not_carried": self._not_carried,
            "not_carried_reason": REASON,
            "shift_m": {
                "mean_x": _rounded(mean[0]),
                "mean_y": _rounded(mean[1]),
                "mean_z": _rounded(mean[2]),
                "rms": _rounded(np.sqrt(mean[3])),
                "max": _rounded(self._most_m),
            },
            "cameras": len(apart),
            "cameras_left_out": list(self.pair.left_out),
            "centres_m": {
                "rms": _rounded(np.sqrt((apart**2).mean())),
                "max": _rounded(apart.max()),
            },
        }

    def words(self) -> dict[str, Any]:
        """Return what a file shall say of it."""
        return {"adjusted_from": {"cameras": len(self.pair.row), "source": self.pair.old.source}}


def _batches(xyz: FloatArray, rows: IntArray) -> Iterator[IntArray]:
    """Yield rows of points, neighbours together."""
    order = rows[spatial_order(np.ascontiguousarray(xyz[rows]))]
    for first in range(0, len(order), POINTS_AT_ONCE):
        yield order[first : first + POINTS_AT_ONCE]


def _metres(value: float) -> str:
    return f"{value:,.2f} m" if value < 100.0 else f"{value:,.0f} m"


def _rounded(value: float) -> float:
    return round(float(value), 4)
