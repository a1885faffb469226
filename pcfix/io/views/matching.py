"""Give each row of a cloud its list: by row where that is safe, else by position.

A row of the cloud gets the list of the same row when the list's position agrees with it to a
fraction of the spacing, whatever the numbers of rows. Every other row gets the list of the nearest
point within a tolerance. The default tolerance is as strict: neighbours in a dense cloud are often
made by other images (on a real one, points 5 cm apart hardly have a camera in common), so that a
list is trusted for its own point only. A list without positions goes by row alone; then the
numbers must match, and the listed cameras must have the points in their frames, chunk by chunk.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError
from pcfix.io.views.lists import ViewList
from pcfix.io.views.orders import entries, fitted
from pcfix.lens.frames import beside_frames
from pcfix.model import Cameras, FloatArray, IntArray, Views
from pcfix.sums import Sums

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


_QUERIES = 250_000
"""Points looked up at a time, which bounds the memory."""

_SAME = 0.05
"""A fraction of the spacing within which two positions are those of one point."""

_ROUNDING = 1.01 * np.sqrt(3.0)
_BINS = 1000
_MANY = 0.1
"""A share of points without a list that the user should hear of."""
_ENOUGH = 20_000


class ViewMatch:
    """A view list and a cloud whose chunks come in order; `report` says how they went together."""

    def __init__(
        self, views: ViewList, cameras: Cameras, *, points: int | None = None, step_m: float = 0.0
    ) -> None:
        """Check that a list, read with these cameras, can belong to a cloud of so many points.

        The cloud's coordinates are rounded to `step_m`, the scale of a LAS file. A list without
        positions that has another number of points is an `InputError`.
        """
        self._views, self._cameras = views, cameras
        self._tree: cKDTree | None = None
        raw = views.raw
        source, weights = f"{raw.what} {raw.path}", raw.weight is not None
        self.report = ViewReport(source, len(views), notes=list(raw.notes), weights=weights)
        if raw.xyz is not None:
            self._set_tolerances(
                views.spacing_m or 0.0, _ROUNDING * (step_m / 2 + raw.resolution_m)
            )
        elif points != len(views):
            raise InputError(
                f"{raw.path}: has the lists of {len(views):,} points, the cloud has"
                f" {'an unknown number' if points is None else f'{points:,}'}, and without"
                " positions in the frame of the cameras they cannot be told apart; put the PLY file"
                " that was written with the list beside it, or give the cloud as it was when the"
                " list was written."
            )
        self._note_order()

    def _set_tolerances(self, spacing_m: float, rounding_m: float) -> None:
        """Take what rounding explains, or a share of the spacing: see `ViewList`."""
        self.report.tolerance_m = max(rounding_m, self._views.default_spacings * spacing_m)
        self._same_m = max(rounding_m, _SAME * spacing_m)
        if rounding_m > spacing_m / 2:
            self.report.notes.append(
                f"{self._views.raw.path}: positions agree with the cloud's to {rounding_m:.2g} m at"
                f" best, but points are {spacing_m:.2g} m apart, so that a point may get its"
                " neighbour's list; use files with more decimals, as the software wrote them."
            )

    def _note_order(self) -> None:
        order = self._views.orders[0]
        shares = (self.report.share_seen, self._views.share_seen)
        self.report.share_seen = min((s for s in shares if s is not None), default=None)
        self.report.image_order = order.what
        self.report.unposed = order.unposed

    def for_chunk(self, xyz: FloatArray, first_row: int) -> Views:
        """Return the cameras of a chunk's points; a point without a match has none.

        The points, shape (n, 3), are apparent ones in the frame of the cameras, from the cloud's
        `first_row` on. A list that goes by row alone is refused if its cameras do not see them.
        """
        if self._views.raw.xyz is None:
            row = np.arange(first_row, first_row + len(xyz))
            if row.size and not 0 <= row[0] <= row[-1] < len(self._views):
                raise InputError(
                    f"{self._views.raw.path}: has no row {row[-1]:,}, it has"
                    f" {len(self._views):,}; the cloud has changed since its points were counted."
                )
            self._views = fitted(self._views, self._cameras, xyz, row)
            self._note_order()
            self.report.by_row += len(row)
        else:
            row = self._rows(xyz, first_row, self._views.raw.xyz)
        views = self._given(row)
        apart = beside_frames(xyz, views, self._cameras)
        self.report.beside_entries += int(apart.sum())
        self.report.beside_points += int(np.count_nonzero(apart))
        return views

    def _rows(self, xyz: FloatArray, first_row: int, listed: FloatArray) -> IntArray:
        """Return the list's row of each point, -1 where it has none."""
        row = np.full(len(xyz), -1)
        beside = listed[first_row : first_row + len(xyz)]
        apart_m = np.linalg.norm(beside - xyz[: len(beside)], axis=1)
        near = apart_m <= self._same_m
        row[: len(beside)][near] = first_row + np.flatnonzero(near)
        self.report.by_row += int(np.count_nonzero(near))
        rest = np.flatnonzero(row < 0)
        for at in range(0, len(rest), _QUERIES):
            part = rest[at : at + _QUERIES]
            row[part] = self._nearest(xyz[part], listed)
        return row

    def _nearest(self, xyz: FloatArray, listed: FloatArray) -> IntArray:
        """Return the nearest row within the tolerance of each point, -1 where there is none."""
        if self._tree is None:
            from scipy.spatial import cKDTree

            self._tree = cKDTree(listed, balanced_tree=False, compact_nodes=False)
        tolerance_m = self.report.tolerance_m or 0.0
        reach = float(np.nextafter(tolerance_m, np.inf))
        found_at, row = self._tree.query(xyz, distance_upper_bound=reach, workers=-1)
        distance = np.asarray(found_at)
        found = np.isfinite(distance)
        self.report.add_distances(distance[found])
        self.report.unmatched += int(np.count_nonzero(~found))
        return np.where(found, row, -1)

    def _given(self, row: IntArray) -> Views:
        """Turn the images of the given rows into cameras, and leave out those without a pose."""
        raw = self._views.raw
        listed = np.flatnonzero(row >= 0)
        ends, entry = entries(raw.start, row[listed])
        camera = self._views.orders[0].camera[raw.image[entry]].astype(np.int64)
        weight = None if raw.weight is None else raw.weight[entry].copy()
        posed = camera >= 0
        if not posed.all():
            ends = np.concatenate([[0], np.cumsum(posed)])[ends]
            camera, weight = camera[posed], None if weight is None else weight[posed]
        start = np.zeros(len(row) + 1, np.int64)
        start[listed + 1] = np.diff(ends)
        self.report.entries += len(camera)
        self.report.unposed_entries += len(posed) - len(camera)
        self.report.without_camera += int(np.count_nonzero(start[listed + 1] == 0))
        return Views(np.cumsum(start), camera, weight, self._views.kind)


@dataclass
class ViewReport(Sums):
    """What was matched so far; it grows with every chunk."""

    added = (
        *("by_row", "by_position", "unmatched", "without_camera"),
        *("entries", "unposed_entries", "beside_entries", "beside_points", "_histogram"),
    )
    least = ("share_seen",)

    source: str  # kind and path of the list
    list_points: int
    image_order: str = ""  # what the image numbers were found to mean
    share_seen: float | None = None  # see `ViewList`, the lowest of all chunks
    tolerance_m: float | None = None  # largest distance of a match by position
    by_row: int = 0  # points of the cloud, as the next two
    by_position: int = 0
    unmatched: int = 0
    without_camera: int = 0  # matched points of whose images none has a pose
    entries: int = 0  # of the lists: cameras given out
    unposed_entries: int = 0  # images without a pose that were dropped
    beside_entries: int = 0  # cameras that cannot have imaged their point, which do not count
    beside_points: int = 0  # that they are listed for
    unposed: tuple[str, ...] = ()  # images without a pose that a list may name
    weights: bool = False
    notes: list[str] = field(default_factory=list)
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
        """Return the distance that this share of the matches by position do not exceed.

        To a thousandth of the tolerance; None where no point was matched by position.
        """
        if not self.by_position or self.tolerance_m is None:
            return None
        enough = np.cumsum(self._histogram) >= share * self.by_position
        return float(int(np.argmax(enough)) * self.tolerance_m / _BINS)

    def check(self) -> None:
        """Refuse a list that gave no point of the cloud a camera."""
        if self.points and self.entries == 0:
            raise InputError(
                f"{self.source}: none of the cloud's {self.points:,} points is in the list"
                f" ({self.list_points:,} points, {self._tolerance()}); the list is of another"
                " cloud, or its coordinates need an offset (--cameras-offset)."
            )

    def warnings(self) -> list[str]:
        """Return what the user should know of, as sentences."""
        sentences = list(self.notes)
        if self.unmatched > _MANY * self.points:
            sentences.append(
                f"{self.source}: {self.unmatched:,} of the cloud's {self.points:,} points are not"
                f" in the list ({self._tolerance()})."
            )
        if self.share_seen is None and self.entries:
            sentences.append(
                f"{self.source}: the cameras have no frames, so nothing shows that the list counts"
                f" its images in the order assumed ({self.image_order})."
            )
        if self.unposed_entries:
            named = f", among them {', '.join(self.unposed[:3])}" if self.unposed else ""
            sentences.append(
                f"{self.source}: {self.unposed_entries:,} entries name images without a pose"
                f"{named}; they are left out."
            )
        if self.beside_entries:
            sentences.append(f"{self.source}: {beside(self.beside_entries, self.beside_points)}")
        return sentences

    def _tolerance(self) -> str:
        return "by row" if self.tolerance_m is None else f"tolerance {self.tolerance_m:.3g} m"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        values = {k: v for k, v in vars(self).items() if not k.startswith("_") and k != "notes"}
        return {
            **values,
            "unposed": list(self.unposed),
            "cameras_per_point": self.cameras_per_point,
            "distance_median_m": self.distance_m(0.5),
            "distance_95_m": self.distance_m(0.95),
        }


def beside(entries: int, points: int) -> str:
    """Return the sentence on cameras that cannot have imaged what they are listed for."""
    return (
        f"{entries:,} entries, of {points:,} points, name cameras that look elsewhere: the point is"
        " farther beside the image than that is long, or behind the camera. They are left out; the"
        " list, or poses, are of another cloud or in part wrong."
    )


def spacing_m(xyz: FloatArray) -> float | None:
    """Return the median distance of a point from its nearest neighbour, metres.

    From a box about the point in the middle of the file that holds some ten thousand points; None
    for fewer than two points.
    """
    from scipy.spatial import cKDTree

    if len(xyz) < 2:
        return None
    centre = xyz[len(xyz) // 2]
    away = np.maximum(np.abs(xyz[:, 0] - centre[0]), np.abs(xyz[:, 1] - centre[1]))
    near = min(_ENOUGH, len(xyz) - 1)
    box = xyz[away <= np.partition(away, near)[near]]
    distance = np.asarray(cKDTree(box).query(box[:_ENOUGH], k=2)[0])
    return float(np.median(distance[:, 1]))
