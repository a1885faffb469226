"""Read view lists, which say which cameras contributed to each point of a dense cloud.

Read one with `read_views`, or make one of tie points with `track_views`; then `ViewMatch` gives its
lists to the rows of a cloud, chunk by chunk.

Give each row of a cloud its view list: by row number if positions agree, else by position.

A row of the cloud gets the list of the same row if the list's position agrees with it to a
fraction of the spacing, whatever the numbers of rows. Every other row gets the list of the nearest
point within a tolerance. The default tolerance is as strict: neighbours in a dense cloud often
have other images (on a real one, points 5 cm apart hardly have a camera in common), so a list is
used for its own point only. A list without positions is matched by row number only; then the
numbers of points must agree, and the listed cameras must have the points in their frames, chunk by
chunk.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pcfix.errors import InputError, PcfixWarning, bad_file
from pcfix.io.files import check_input
from pcfix.io.views.lists import (
    COLMAP_LIST,
    ImageOrder,
    ViewList,
    entries,
    fitted,
    image_orders,
    read_list,
    tracks_as_list,
)
from pcfix.lens.frames import beside_frames
from pcfix.model import Cameras, FloatArray, IntArray, TiePoints, Views
from pcfix.options.declare import File
from pcfix.sums import LEAST, SAME, Sums

__all__ = ["ViewList", "ViewMatch", "ViewReport", "read_views", "track_views"]

Transformation: TypeAlias = "Callable[[FloatArray], FloatArray]"

_SPACINGS = {"depth-maps": 0.05, "tracks": 2.0}
"""Default tolerance of a match by position. On a real block the nearest track holds 77 % of a dense
point's images at any distance up to two spacings, so that a tie point represents its surroundings
as a dense point does not."""


def read_views(path: File, cameras: Cameras, *, to_cloud: Transformation | None = None) -> ViewList:
    """Read the view list of a dense cloud.

    Parameters
    ----------
    path : path
        COLMAP's ``fused.ply.vis``, or the dense PLY file of OpenMVS with its ``view_indices``. For
        COLMAP the ``fused.ply`` will do if the list lies beside it. Images are counted as in a
        sparse model beside the list, or as the cameras are, whichever the geometry confirms.
    cameras : Cameras
        In the cloud's frame.
    to_cloud : callable, optional
        Takes positions, shape (n, 3), from the list's frame to the cloud's. Default: the same.
    """
    views = read_list(check_input(path))
    orders = image_orders(views, cameras)
    return _fitted(replace(views, orders=orders), cameras, to_cloud)


def track_views(
    path: Path, tie_points: TiePoints, cameras: Cameras, *, to_cloud: Transformation | None = None
) -> ViewList:
    """Make a view list of the tracks of a sparse model that was read from `path`.

    The tie points count the images as `cameras` does; for the others see `read_views`.
    """
    order = ImageOrder("the cameras of the tie points", np.arange(len(cameras), dtype=np.int32))
    views = replace(tracks_as_list(path, tie_points), orders=(order,), kind="tracks")
    return _fitted(views, cameras, to_cloud)


def _fitted(views: ViewList, cameras: Cameras, to_cloud: Transformation | None) -> ViewList:
    """Return a list whose cameras see its points, if it has positions to test that."""
    views = replace(views, default_spacings=_SPACINGS[views.kind])
    if views.xyz is None:
        return views
    xyz = views.xyz if to_cloud is None else to_cloud(views.xyz)
    placed = np.ascontiguousarray(xyz, np.float64)
    try:
        placed_views = replace(views, xyz=placed, spacing_m=spacing_m(xyz))
        return fitted(placed_views, cameras, xyz, np.arange(len(views)))
    except InputError:
        if views.what != COLMAP_LIST:
            raise
    sentence = f"{views.path}: the PLY file beside it is in another frame and is not used."
    note = PcfixWarning("views.other_frame", sentence, path=views.path)
    return replace(views, xyz=None, notes=(*views.notes, note))


_QUERIES = 250_000
"""Points looked up at a time, which bounds the memory."""
_SAME = 0.05
"""A fraction of the spacing within which two positions are those of one point."""
_ROUNDING = 1.01 * np.sqrt(3.0)
"""Of three coordinates that are each off by half a step, relative to that half step."""
_BINS = 1000
_MANY = 0.1
"""A share of points without a list from which on the user is warned."""
_ENOUGH = 20_000


class ViewMatch:
    """A view list and a cloud whose chunks come in order; `report` counts the matches."""

    def __init__(
        self, views: ViewList, cameras: Cameras, *, points: int | None = None, step_m: float = 0.0
    ) -> None:
        """Check that a list, read with these cameras, can belong to a cloud of so many points.

        The cloud's coordinates are rounded to `step_m`, the scale of a LAS file.
        """
        self.view_list, self._cameras = views, cameras
        self._tree: Any = None  # a cKDTree of the list's positions, when one is needed
        source, weights = f"{views.what} {views.path}", views.weight is not None
        self.report = ViewReport(source, len(views), notes=list(views.notes), weights=weights)
        if views.xyz is not None:
            # a match may be off by the rounding of both files, or by a share of the spacing
            spacing_m = views.spacing_m or 0.0
            rounding_m = _ROUNDING * (step_m / 2 + views.resolution_m)
            self.report.tolerance_m = max(rounding_m, views.default_spacings * spacing_m)
            self._same_m = max(rounding_m, _SAME * spacing_m)
            if rounding_m > spacing_m / 2:
                sentence = f"{views.path}: positions are rounded to {rounding_m:.2g} m, for points"
                sentence += f" {spacing_m:.2g} m apart. Points may get lists of their neighbours."
                values = {"rounding_m": rounding_m, "spacing_m": spacing_m}
                self.report.notes.append(PcfixWarning("views.rounding", sentence, **values))
        elif points != len(views):
            sentence = f"has {len(views):,} points, the cloud {points}. Put its PLY file beside it."
            values = {"listed": len(views), "points": points}
            raise bad_file(views.path, "views.other_points", sentence, **values)
        self._note_order()

    def _note_order(self) -> None:
        order = self.view_list.orders[0]
        shares = (self.report.share_seen, self.view_list.share_seen)
        self.report.share_seen = min((s for s in shares if s is not None), default=None)
        self.report.image_order, self.report.unposed = order.what, order.unposed

    def for_chunk(self, xyz: FloatArray, first_row: int) -> Views:
        """Return the cameras of a chunk's points; a point without a match has none.

        The points, shape (n, 3), are apparent ones in the frame of the cameras, from the cloud's
        `first_row` on. A list that is matched by row number is refused if its cameras do not see
        them.
        """
        if self.view_list.xyz is None:
            row = np.arange(first_row, first_row + len(xyz))
            self.view_list = fitted(self.view_list, self._cameras, xyz, row)
            self._note_order()
            self.report.by_row += len(row)
        else:
            row = self._rows(xyz, first_row, self.view_list.xyz)
        views = self._given(row)
        apart = beside_frames(xyz, views, self._cameras)
        self.report.beside_entries += int(apart.sum())
        self.report.beside_points += int(np.count_nonzero(apart))
        return views

    def counted(self, xyz: FloatArray, first_row: int) -> tuple[Views, ViewReport]:
        """Return the cameras of a chunk's points, and the counts of its matches only, no notes."""
        one = self._anew()
        views = one.for_chunk(xyz, first_row)
        self._tree = one._tree  # it takes long to build
        return views, one.report

    def settled(self, xyz: FloatArray) -> ViewMatch:
        """Return the match with the order of the images that the first points show."""
        one = self._anew()
        one.for_chunk(xyz, 0)
        one.report = replace(self.report)
        one._note_order()
        return one

    def _anew(self) -> ViewMatch:
        """Return a match that counts from zero."""
        one = copy(self)
        none = np.zeros(_BINS + 1, np.int64)
        one.report = replace(self.report, notes=[], _histogram=none)
        return one

    def _rows(self, xyz: FloatArray, first_row: int, listed: FloatArray) -> IntArray:
        """Return the list's row of each point, -1 if it has none."""
        row = np.full(len(xyz), -1)
        beside = listed[first_row : first_row + len(xyz)]
        apart_m = np.linalg.norm(beside - xyz[: len(beside)], axis=1)
        near = apart_m <= self._same_m
        row[: len(beside)][near] = first_row + np.flatnonzero(near)
        self.report.by_row += int(np.count_nonzero(near))
        rest = np.flatnonzero(row < 0)
        if len(rest) and self._tree is None:
            from scipy.spatial import cKDTree

            self._tree = cKDTree(listed, balanced_tree=False, compact_nodes=False)
        reach = float(np.nextafter(self.report.tolerance_m or 0.0, np.inf))
        for at in range(0, len(rest), _QUERIES):
            some = rest[at : at + _QUERIES]
            away, nearest = self._tree.query(xyz[some], distance_upper_bound=reach, workers=-1)
            distance = np.asarray(away)
            found = np.isfinite(distance)
            self.report.add_distances(distance[found])
            self.report.unmatched += int(np.count_nonzero(~found))
            row[some] = np.where(found, nearest, -1)
        return row

    def _given(self, row: IntArray) -> Views:
        """Turn the images of the given rows into cameras, without images that have no pose."""
        views = self.view_list
        listed = np.flatnonzero(row >= 0)
        ends, entry = entries(views.start, row[listed])
        camera = self.view_list.orders[0].camera[views.image[entry]].astype(np.int64)
        weight = None if views.weight is None else views.weight[entry].copy()
        posed = camera >= 0
        if not posed.all():
            ends = np.concatenate([[0], np.cumsum(posed)])[ends]
            camera, weight = camera[posed], None if weight is None else weight[posed]
        start = np.zeros(len(row) + 1, np.int64)
        start[listed + 1] = np.diff(ends)
        self.report.entries += len(camera)
        self.report.unposed_entries += len(posed) - len(camera)
        self.report.without_camera += int(np.count_nonzero(start[listed + 1] == 0))
        return Views(np.cumsum(start), camera, weight, self.view_list.kind)


@dataclass
class ViewReport(Sums):
    """Counts of the matches so far; by row, by position and unmatched are points of the cloud."""

    source: str = field(metadata=SAME)  # kind and path of the list
    list_points: int = field(metadata=SAME)
    image_order: str = field(default="", metadata=SAME)  # the source of the order of the images
    share_seen: float | None = field(default=None, metadata=LEAST)  # see `ViewList`
    tolerance_m: float | None = field(default=None, metadata=SAME)  # of a match by position
    by_row: int = 0
    by_position: int = 0
    unmatched: int = 0
    without_camera: int = 0  # matched points none of whose images has a pose
    entries: int = 0  # cameras of all lists that were matched
    unposed_entries: int = 0  # images without a pose, which are ignored
    beside_entries: int = 0  # cameras that cannot have imaged their point, which are ignored
    beside_points: int = 0  # points that these are listed for
    unposed: tuple[str, ...] = field(default=(), metadata=SAME)  # that a list may name
    weights: bool = field(default=False, metadata=SAME)
    notes: list[PcfixWarning] = field(default_factory=list, metadata=SAME)
    _histogram: IntArray = field(default_factory=lambda: np.zeros(_BINS + 1, np.int64), repr=False)

    @property
    def points(self) -> int:
        """Points of the cloud so far."""
        return self.by_row + self.by_position + self.unmatched

    @property
    def cameras_per_point(self) -> float:
        """Mean over the points that have a list."""
        return self.entries / max(self.by_row + self.by_position, 1)

    def add_distances(self, distance_m: FloatArray) -> None:
        """Count the distances of matches by position."""
        step = (self.tolerance_m or 0.0) / _BINS
        bins = np.ceil(distance_m / step) if step else np.zeros(len(distance_m))
        self._histogram += np.bincount(bins.astype(np.int64).clip(0, _BINS), minlength=_BINS + 1)
        self.by_position += len(distance_m)

    def distance_m(self, share: float) -> float | None:
        """Return a quantile of the distances of matches by position, to 0.1 % of the tolerance."""
        if not self.by_position or self.tolerance_m is None:
            return None
        enough = np.cumsum(self._histogram) >= share * self.by_position
        return float(int(np.argmax(enough)) * self.tolerance_m / _BINS)

    def check(self) -> None:
        """Refuse a list that gave no point of the cloud a camera."""
        if self.points and self.entries == 0:
            sentence = f"{self.source}: has none of the cloud's {self.points:,} points. Give the"
            sentence += " list of this cloud, or the offset of its coordinates (--cameras-offset)."
            values = {"points": self.points, "listed": self.list_points}
            raise InputError("views.no_match", sentence, **values)

    def warnings(self) -> list[PcfixWarning]:
        """Return warnings on points without a list and on images that are ignored."""
        notes = list(self.notes)

        def note(code: str, sentence: str, **values: Any) -> None:
            notes.append(PcfixWarning(code, f"{self.source}: {sentence}", **values))

        if self.unmatched > _MANY * self.points:
            sentence = f"lacks {self.unmatched:,} of the cloud's {self.points:,} points."
            note("views.unmatched", sentence, count=self.unmatched, points=self.points)
        if self.share_seen is None and self.entries:
            note("views.order_untested", "the order of its images is untested: no camera frames.")
        if self.unposed_entries:
            named = f", such as {', '.join(self.unposed[:3])}" if self.unposed else ""
            sentence = f"{self.unposed_entries:,} entries without a pose{named} are ignored."
            note("views.unposed", sentence, count=self.unposed_entries)
        if self.beside_entries:
            note("views.not_in_frame", beside(self.beside_entries, self.beside_points))
        return notes

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        values = {k: v for k, v in vars(self).items() if not k.startswith("_") and k != "notes"}
        values["unposed"] = list(self.unposed)
        values["cameras_per_point"] = self.cameras_per_point
        values["distance_median_m"] = self.distance_m(0.5)
        values["distance_95_m"] = self.distance_m(0.95)
        return values


def beside(entries: int, points: int) -> str:
    """Return the sentence on cameras that cannot have imaged the points they are listed for."""
    return f"{entries:,} entries, of {points:,} points, name cameras that look elsewhere: ignored."


def spacing_m(xyz: FloatArray) -> float | None:
    """Return the median distance to the nearest neighbour around the middle of the file, metres."""
    from scipy.spatial import cKDTree

    if len(xyz) < 2:
        return None
    centre = xyz[len(xyz) // 2]
    away = np.maximum(np.abs(xyz[:, 0] - centre[0]), np.abs(xyz[:, 1] - centre[1]))
    near = min(_ENOUGH, len(xyz) - 1)
    box = xyz[away <= np.partition(away, near)[near]]
    distance = np.asarray(cKDTree(box).query(box[:_ENOUGH], k=2)[0])
    return float(np.median(distance[:, 1]))
