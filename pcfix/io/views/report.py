"""How the view lists were given to the points of a cloud."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray

_BINS = 1000
_MANY = 0.1
"""A share of points without a list that the user should hear of."""


@dataclass
class ViewReport:
    """What was matched so far; it grows with every chunk.

    Attributes
    ----------
    source : str
        Kind and path of the list.
    list_points : int
    image_order : str
        What the image numbers were found to mean.
    share_seen : float or None
        Share of listed cameras whose frame holds the point, the lowest of all chunks.
    tolerance_m : float or None
        Largest distance of a match by position.
    by_row, by_position, unmatched : int
        Points of the cloud.
    without_camera : int
        Matched points of whose images none has a pose.
    entries, unposed_entries : int
        Of the lists: cameras given out, and images without a pose that were dropped.
    unposed : tuple of str
        Images without a pose that a list may name.
    weights : bool
        Whether the list has weights.
    notes : list of str
    """

    source: str
    list_points: int
    image_order: str = ""
    share_seen: float | None = None
    tolerance_m: float | None = None
    by_row: int = 0
    by_position: int = 0
    unmatched: int = 0
    without_camera: int = 0
    entries: int = 0
    unposed_entries: int = 0
    unposed: tuple[str, ...] = ()
    weights: bool = False
    notes: list[str] = field(default_factory=list)
    _histogram: IntArray = field(default_factory=lambda: np.zeros(_BINS + 1, np.int64), repr=False)

    @property
    def points(self) -> int:
        """Points of the cloud so far."""
        return self.by_row + self.by_position + self.unmatched

    @property
    def matched_share(self) -> float:
        """Share of the points that have a list."""
        return (self.by_row + self.by_position) / max(self.points, 1)

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
        """Refuse a list that has nothing for the cloud.

        Raises
        ------
        InputError
            If no point got a camera.
        """
        if self.points and self.entries == 0:
            raise InputError(
                f"{self.source}: none of the cloud's {self.points:,} points is in the list"
                f" ({self.list_points:,} points, {self._tolerance()}); the list is of another"
                " cloud, or its coordinates need an offset (--cameras-offset)."
            )

    def warnings(self) -> list[str]:
        """Return what the user should know of, as sentences."""
        said = list(self.notes)
        if self.unmatched > _MANY * self.points:
            said.append(
                f"{self.source}: {self.unmatched:,} of the cloud's {self.points:,} points are not"
                f" in the list ({self._tolerance()})."
            )
        if self.share_seen is None and self.entries:
            said.append(
                f"{self.source}: the cameras have no frames, so nothing shows that the list counts"
                f" its images in the order assumed ({self.image_order})."
            )
        if self.unposed_entries:
            named = f", among them {', '.join(self.unposed[:3])}" if self.unposed else ""
            said.append(
                f"{self.source}: {self.unposed_entries:,} entries name images without a pose"
                f"{named}; they are left out."
            )
        return said

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
