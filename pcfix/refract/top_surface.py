"""The upper surface of a cloud as a grid of heights, from points that come chunk by chunk.

A cell has the height of its second highest point, so that a single flying point counts for
nothing, and no more than that of the highest cell beside it, so that a single cell does not
either. Cells have sides of a power of two, in metres, and count from the origin of the world
frame; so the surface does not depend on the order of the points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.kernels import kernel
from pcfix.model import NOISE_CLASSES, Cameras, FloatArray
from pcfix.options.correct import ScienceOptions
from pcfix.refract.occlusion import BLOCK, LARGE_BLOCK, MARGIN_BLOCK, Occluder

Heights = npt.NDArray[np.float32]


MOST_CELLS = 2**24
"""Bounds the memory, 8 bytes a cell; where a cloud needs more, its cells are larger."""
CELLS_A_POINT = 16
"""To begin with: so that where a cloud fills a sixteenth of its rectangle, its cells still fit."""
POINTS_A_CELL = 4.0
"""At least, on average, where there are any: cells are two to four point spacings wide."""
FINEST_M = 2.0**-10
WIDE_GAP = 0.75
GAPS_TO_MARGIN = 4.5
"""The margin is 4.5 times the upper quartile, over the cells of a block, of the gap between the
highest two points of a cell. For noise and four to sixteen points that is about four standard
deviations: the point may be low by three, and a cell high by one. The gap does not see the height
of walls; the quartile stays that of a noisy bed where most of the block is smooth. In cells that
are steep in themselves the gap grows with what they rise."""
FEWEST_CELLS = 9
"""With heights, in a block with a margin of its own."""


class _Cells(NamedTuple):
    """Cells from a first row and column on; heights are minus infinity where there is no point."""

    side_m: float
    first_row: int
    first_column: int
    highest: Heights
    second: Heights


class OccluderBuilder:
    """Gathers the chunks of a cloud, of which noise does not count, and makes their surface.

    Parameters
    ----------
    low, high : array, shape (2,)
        South-west and north-east corner of the cloud, metres, as far as they are known; the grid
        grows where points lie outside.
    points : int
        Of the whole cloud.
    """

    def __init__(self, low: FloatArray, high: FloatArray, points: int) -> None:
        self._most = min(MOST_CELLS, CELLS_A_POINT * max(points, 1))
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)
        self._cells: _Cells | None = None
        self._points = 0
        if np.isfinite([low, high]).all() and (low <= high).all():
            self._reach(low, high)

    def add(self, xyz: FloatArray, classes: npt.NDArray[np.uint8] | None = None) -> None:
        """Add a chunk.

        Parameters
        ----------
        xyz : array, shape (n, 3)
            Apparent points, metres, world frame.
        classes : array, shape (n,), optional
            Low and high noise (7 and 18) hide nothing.
        """
        if classes is not None:
            xyz = xyz[~np.isin(classes, NOISE_CLASSES)]
        if not len(xyz):
            return
        self._points += len(xyz)
        self._reach(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0))
        if self._cells is not None:
            _add(self._cells, np.ascontiguousarray(xyz))

    def _reach(self, low: FloatArray, high: FloatArray) -> None:
        """Let the grid reach over a rectangle too."""
        low, high = np.minimum(self._low, low), np.maximum(self._high, high)
        if (low == self._low).all() and (high == self._high).all():
            return
        self._low, self._high = low, high
        self._cells = _over(low, high, self._most, self._cells)

    def build(self) -> Occluder | None:
        """Return the surface; None without points. The gathered points are used up."""
        cells, self._cells = self._cells, None
        if cells is None or not self._points:
            return None
        while _is_thin(cells, self._points):
            cells = _halved(cells)
        height = _without_spikes(cells.second)
        return Occluder(
            height=height,
            left_m=cells.first_column * cells.side_m,
            bottom_m=cells.first_row * cells.side_m,
            cell_m=cells.side_m,
            highest_m=float(np.nanmax(height, initial=-np.inf)),
            margin=_margins(cells.highest, cells.second),
            block_top=_tops(height, BLOCK),
            large_block_top=_tops(height, LARGE_BLOCK),
        )


def _shape(low: FloatArray, high: FloatArray, side: float) -> tuple[FloatArray, FloatArray]:
    """Return the first row and column, and how many there are."""
    first, last = np.floor(low[::-1] / side), np.floor(high[::-1] / side)
    return first, last - first + 1.0


def _over(low: FloatArray, high: FloatArray, most: int, old: _Cells | None) -> _Cells:
    """Return the finest cells over a rectangle, with what is in the old ones."""
    side = FINEST_M if old is None else old.side_m
    while _shape(low, high, side)[1].prod() > most:
        side *= 2.0
    while old is not None and old.side_m < side:
        old = _halved(old)
    first, shape = _shape(low, high, side)
    rows, columns = int(shape[0]), int(shape[1])
    values = [np.full((rows, columns), -np.inf, np.float32) for _ in range(2)]
    new = _Cells(side, int(first[0]), int(first[1]), *values)
    if old is not None:
        row, column = old.first_row - new.first_row, old.first_column - new.first_column
        rows, columns = old.highest.shape
        for target, source in zip(new[3:], old[3:], strict=True):
            target[row : row + rows, column : column + columns] = source
    return new


def _is_thin(cells: _Cells, points: int) -> bool:
    """Whether the cells with points have too few on average."""
    taken = np.count_nonzero(np.isfinite(cells.highest))
    return max(cells.highest.shape) > 2 and bool(points < POINTS_A_CELL * taken)


def _halved(cells: _Cells) -> _Cells:
    """Return the same in cells of twice the side."""
    (rows, columns), south, west = cells.highest.shape, cells.first_row % 2, cells.first_column % 2
    pad = (south, (south + rows) % 2), (west, (west + columns) % 2)
    highest, second = _quads(cells.highest, pad), _quads(cells.second, pad)
    first, runner_up = highest[0], second[0]
    for one, other in zip(highest[1:], second[1:], strict=True):
        runner_up = np.maximum(np.minimum(first, one), np.maximum(runner_up, other))
        first = np.maximum(first, one)
    corner = cells.first_row // 2, cells.first_column // 2
    return _Cells(cells.side_m * 2.0, *corner, first, runner_up)


def _quads(cells: Heights, pad: tuple[tuple[int, int], ...]) -> list[Any]:
    """Return the four cells of each two by two, after adding empty rows and columns."""
    full = np.pad(cells, pad, constant_values=-np.inf) if np.any(pad) else cells
    return [full[::2, ::2], full[::2, 1::2], full[1::2, ::2], full[1::2, 1::2]]


@kernel
def _add(cells: _Cells, xyz: FloatArray) -> None:
    for i in range(len(xyz)):
        c = int(np.floor(xyz[i, 0] / cells.side_m)) - cells.first_column
        r = int(np.floor(xyz[i, 1] / cells.side_m)) - cells.first_row
        z = np.float32(xyz[i, 2])
        if z > cells.highest[r, c]:
            cells.second[r, c] = cells.highest[r, c]
            cells.highest[r, c] = z
        elif z > cells.second[r, c]:
            cells.second[r, c] = z


@kernel(allocates=True)
def _without_spikes(second: Heights) -> Heights:
    """Return heights that no cell has alone; NaN where there is none, or none beside it."""
    rows, columns = second.shape
    height = np.full((rows, columns), np.float32(np.nan))
    for r in range(rows):
        for c in range(columns):
            beside = -np.float32(np.inf)
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, columns)):
                    if i != r or j != c:
                        beside = max(beside, second[i, j])
            lower = min(second[r, c], beside)
            if lower > -np.inf:
                height[r, c] = lower
    return height


@kernel(allocates=True)
def _tops(height: Heights, side: int) -> Heights:
    """Return the highest of each block, minus infinity where no height is known."""
    rows, columns = height.shape
    tops = np.full(((rows + side - 1) // side, (columns + side - 1) // side), -np.float32(np.inf))
    for r in range(rows):
        for c in range(columns):
            if height[r, c] > tops[r // side, c // side]:  # not so for NaN
                tops[r // side, c // side] = height[r, c]
    return tops


def _margins(highest: Heights, second: Heights) -> Heights:
    """Return by how much a ray must pass below the surface, metres, for each block."""
    gaps, counts = _wide_gaps(highest, second)
    known = counts >= FEWEST_CELLS
    apart = np.isfinite(second)
    everywhere = np.quantile(highest[apart] - second[apart], WIDE_GAP) if apart.any() else 0.0
    return np.where(known, gaps, everywhere).astype(np.float32) * np.float32(GAPS_TO_MARGIN)


@kernel(allocates=True)
def _wide_gaps(highest: Heights, second: Heights) -> tuple[Heights, npt.NDArray[np.int64]]:
    """Return the upper quartile of the gaps of each block, and of how many cells."""
    side = MARGIN_BLOCK
    rows, columns = (highest.shape[0] + side - 1) // side, (highest.shape[1] + side - 1) // side
    found = np.zeros((rows, columns), np.float32)
    counts = np.zeros((rows, columns), np.int64)
    gaps = np.empty(side * side, np.float32)
    for r in range(rows):
        for c in range(columns):
            k = 0
            for i in range(r * side, min((r + 1) * side, highest.shape[0])):
                for j in range(c * side, min((c + 1) * side, highest.shape[1])):
                    if second[i, j] > -np.inf:
                        gaps[k] = highest[i, j] - second[i, j]
                        k += 1
            counts[r, c] = k
            if k:
                found[r, c] = np.sort(gaps[:k])[int(WIDE_GAP * (k - 1))]
    return found, counts


OBLIQUE_DEG = 15.0
"""An image whose axis is farther off the nadir is an oblique. The axes of stabilised nadir blocks
stay within a few degrees; obliques are flown at 20 and more."""


def wants_occlusion(cameras: Cameras, settings: ScienceOptions) -> bool:
    """Return whether cameras are to be left out to which the cloud hides the point.

    As the settings say; auto: where the axis of some camera is more than `OBLIQUE_DEG` off the
    nadir. Cameras without angles count as nadir.
    """
    if settings.occlusion != "auto":
        return settings.occlusion == "on"
    if cameras.rotations is None:
        return False
    # the third row of a rotation is the axis in the world frame; straight down it is (0, 0, -1)
    down = -cameras.rotations[:, 2, 2]
    return bool((down < np.cos(np.radians(OBLIQUE_DEG))).any())


def occluder_of(xyz: FloatArray, classes: npt.NDArray[np.uint8] | None = None) -> Occluder | None:
    """Return the surface of points that are the whole cloud.

    Parameters
    ----------
    xyz, classes
        As of `OccluderBuilder.add`.
    """
    if not len(xyz):
        return None
    builder = OccluderBuilder(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), len(xyz))
    builder.add(xyz, classes)
    return builder.build()
