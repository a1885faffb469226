"""From the shifts at the nodes of a grid to a photograph."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import photo_library
from pcfix.model import BoolArray
from pcfix.photos.mapping import Shifts

STRIP_ROWS = 512
"""Rows at once, which bounds the memory of the places."""
CHANNELS_AT_ONCE = 4


class Resampled(NamedTuple):
    """A photograph without water, shape (rows, columns, bands), and which pixels were touched."""

    image: npt.NDArray[Any]
    touched: BoolArray
    black_share: float


def resample(image: npt.NDArray[Any], shifts: Shifts) -> Resampled:
    """Return an image with the colours of other places; bicubic, black where nothing is known.

    Parameters
    ----------
    image : array, shape (rows, columns, bands), uint8 or uint16 or float32
    shifts : Shifts

    Returns
    -------
    Resampled
        Pixels with no shift are those of the image, bit by bit.
    """
    rows, columns, bands = image.shape
    out = np.empty_like(image)
    touched = np.empty((rows, columns), bool)
    black = 0
    for top in range(0, rows, STRIP_ROWS):
        bottom = min(top + STRIP_ROWS, rows)
        shift, lost = _strip(shifts, top, bottom, columns)
        moved = (shift != 0.0).any(axis=2)
        part = image[top:bottom].copy()
        if moved.any():
            for first in range(0, bands, CHANNELS_AT_ONCE):
                some = slice(first, min(first + CHANNELS_AT_ONCE, bands))
                part[..., some][moved] = _looked_up(image[..., some], shift, top)[moved]
        part[lost] = 0
        out[top:bottom], touched[top:bottom] = part, moved | lost
        black += int(lost.sum())
    return Resampled(out, touched, black / (rows * columns))


def _strip(shifts: Shifts, top: int, bottom: int, columns: int) -> tuple[Any, BoolArray]:
    """Return shifts and what is not known of some rows, from the nodes around them."""
    cv2 = photo_library("cv2")

    step = shifts.step_px
    first, last = top // step, -(-bottom // step) + 2  # nodes half a step above and below
    size = ((shifts.known.shape[1]) * step, (last - first) * step)
    # nodes are the centres of the cells that a resize makes of them, one step further up and left
    window = np.s_[top - first * step + step : bottom - first * step + step, step : step + columns]
    wide = cv2.resize(shifts.shift_px[first:last], size, interpolation=cv2.INTER_LINEAR)[window]
    lost = (~shifts.known[first:last]).astype(np.float32)
    if not lost.any():
        return wide, np.zeros(wide.shape[:2], bool)
    return wide, cv2.resize(lost, size, interpolation=cv2.INTER_LINEAR)[window] > 0.0


def _looked_up(image: npt.NDArray[Any], shift: Any, top: int) -> npt.NDArray[Any]:
    cv2 = photo_library("cv2")

    rows, columns = shift.shape[:2]
    u = np.arange(columns, dtype=np.float32)[None, :] + shift[..., 0]
    v = np.arange(top, top + rows, dtype=np.float32)[:, None] + shift[..., 1]
    found = cv2.remap(
        np.ascontiguousarray(image), u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT
    )
    return found.reshape(rows, columns, -1)
