"""From the shifts at the nodes of a grid to a photograph."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.libraries import photo_library
from pcfix.model import BoolArray
from pcfix.photos.mapping import Shifts

STRIP_ROWS = 512
"""Rows at once, so that the places stay in the processor's cache."""
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
    groups = [slice(k, min(k + CHANNELS_AT_ONCE, bands)) for k in range(0, bands, CHANNELS_AT_ONCE)]
    sources = [np.ascontiguousarray(image[..., some]) for some in groups]
    out = np.empty_like(image)
    touched = np.empty((rows, columns), bool)
    black = 0
    for top in range(0, rows, STRIP_ROWS):
        bottom = min(top + STRIP_ROWS, rows)
        shift, lost = _strip(shifts, top, bottom, columns)
        moved = (shift[..., 0] != 0.0) | (shift[..., 1] != 0.0)
        part = out[top:bottom]
        if not moved.all():
            part[...] = image[top:bottom]
        if moved.any():
            u = np.arange(columns, dtype=np.float32)[None, :] + shift[..., 0]
            v = np.arange(top, bottom, dtype=np.float32)[:, None] + shift[..., 1]
            for some, source in zip(groups, sources, strict=True):
                _put(_looked_up(source, u, v), moved, part[..., some])
            lost |= _beyond(u, columns) | _beyond(v, rows)
        if lost.any():
            part[lost] = 0
        touched[top:bottom] = moved | lost
        black += int(np.count_nonzero(lost))
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


def _put(source: npt.NDArray[Any], where: BoolArray, target: npt.NDArray[Any]) -> None:
    """Copy pixels, all bands of them; many times as fast as by a mask of numpy."""
    cv2 = photo_library("cv2")

    if where.all():
        target[...] = source
        return
    whole = np.ascontiguousarray(target)
    target[...] = cv2.copyTo(source, where.view(np.uint8), whole).reshape(target.shape)


def _beyond(place: Any, size: int) -> BoolArray:
    """Return which places lie beyond the outer edges of so many pixels."""
    return np.asarray((place < -0.5) | (place > size - 0.5))


def _looked_up(source: npt.NDArray[Any], u: Any, v: Any) -> npt.NDArray[Any]:
    cv2 = photo_library("cv2")

    found = cv2.remap(source, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(*u.shape, -1)
