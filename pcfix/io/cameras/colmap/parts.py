"""What the text and the binary form of a COLMAP model both give."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import FloatArray, IntArray


class Image(NamedTuple):
    """A row of the image list.

    `pose` is qw, qx, qy, qz, tx, ty, tz. `xy` (o, 2) and `points` (o,) are the image points that
    have a point in space, and the identifiers of those; empty where they were not asked for.
    """

    identifier: int
    pose: tuple[float, ...]
    camera: int
    name: str
    xy: FloatArray
    points: IntArray

    @property
    def posed(self) -> bool:
        """Whether it has a pose at all; COLMAP itself writes no others."""
        return bool(np.isfinite(self.pose).all())


class Points(NamedTuple):
    """Identifiers and places of the points in space."""

    identifiers: IntArray
    xyz: FloatArray


NO_XY: FloatArray = np.empty((0, 2))
NO_POINTS: IntArray = np.empty(0, np.int64)


def cut_off(path: Path) -> InputError:
    """Return the error for a file that ends too early."""
    return InputError(f"{path}: is cut off or damaged; export the model again.")
