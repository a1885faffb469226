"""What every reader of a view list gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from pcfix.io.views.orders import ImageOrder
    from pcfix.model import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class RawList:
    """The lists of n points as a file has them.

    Attributes
    ----------
    path : Path
    what : str
        The kind of file.
    start : array of int64, shape (n + 1,)
    image : array of int32, shape (start[-1],)
        What the file counts its images by.
    weight : array of float32, shape (start[-1],), or None
    xyz : array, shape (n, 3), or None
        Positions, frame of the file.
    resolution_m : float
        How far from where it was a position can be, from the type of its numbers.
    notes : tuple of str
    """

    path: Path
    what: str
    start: IntArray
    image: npt.NDArray[np.int32]
    weight: npt.NDArray[np.float32] | None = None
    xyz: FloatArray | None = None
    resolution_m: float = 0.0
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.start) - 1


@dataclass(frozen=True, eq=False)
class ViewList:
    """Which cameras made each of n points; `pcfix.io.views.matching` gives it to a cloud's rows.

    Attributes
    ----------
    raw : RawList
        With positions in the frame of the cameras.
    orders : tuple of ImageOrder
        What an image number may mean; one, once geometry has told which.
    share_seen : float or None
        Share of the listed cameras whose frame holds the point; None while not looked at, or
        where the cameras have no frames.
    spacing_m : float or None
        Between neighbouring points, where there are positions.
    default_spacings : float
        A match by position may be off by so many spacings unless the user says otherwise.
    kind : {"tracks", "depth-maps"}
        See `pcfix.model.Views`.
    """

    raw: RawList
    orders: tuple[ImageOrder, ...]
    share_seen: float | None
    spacing_m: float | None
    default_spacings: float
    kind: Literal["tracks", "depth-maps"]

    def __len__(self) -> int:
        return len(self.raw)


def images_of(path: Path, number: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Return image numbers as int32.

    Raises
    ------
    InputError
        If one is not a whole number from 0 to 2147483647.
    """
    if number.size == 0:
        return np.zeros(0, np.int32)
    low, high = number.min(), number.max()
    if not (low >= 0 and high <= np.iinfo(np.int32).max):
        wrong = high if low >= 0 else low
        raise InputError(
            f"{path}: names an image {wrong}; image numbers start at 0, the file is damaged or of"
            " another kind."
        )
    whole = number.astype(np.int32)
    if number.dtype.kind == "f" and (whole != number).any():
        raise InputError(f"{path}: names an image by a number that is not whole; export it again.")
    return whole
