"""Find the cameras whose view of a point is occluded by the cloud itself.

The surface of the cloud is a grid of heights. From the apparent point P the straight ray to the
projection centre climbs over the cells; where it is still below the surface as it leaves a cell,
the camera did not see the point. Straight rays and the apparent surface belong together: software
that ignores water puts every submerged object on the straight ray on which an image shows it. For
points of several images this is an approximation, as their straight rays pass each other.

Everything below the surface counts as solid. Within `NEAR_CELLS` of P nothing is tested: a cell has
one height, which on a cliff is the upper edge.

A cell has the height of its second highest point, and at most that of the highest of its eight
neighbours, so that neither a single flying point nor a single cell counts.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import NOISE_CLASSES, BoolArray, Cameras, FloatArray, IntArray, Views
from pcfix.options.correct import ScienceOptions
from pcfix.sums import MOST_CELLS, Cells, Layer

Heights = npt.NDArray[np.float32]

NEAR_CELLS = 2.0  # distance from the point, in plan, within which nothing occludes it
# Cells along the side of the blocks whose highest cell is known, to pass them at once. Without the
# larger ones rays take half as long again.
BLOCK, LARGE_BLOCK = 8, 64
MARGIN_BLOCK = 16
_ONWARD = 1e-6  # step past the edge of a cell into the next one, in cells
CELLS_A_POINT = 16  # most cells per point at first; a cloud may fill a sixteenth of its box
WIDE_GAP = 0.75
# The margin is 4.5 times the upper quartile, over the cells of a block, of the gap between the
# highest two points of a cell: four standard deviations of noise, without walls.
GAPS_TO_MARGIN = 4.5
FEWEST_CELLS = 9  # with heights, in a block with a margin of its own
# An image whose axis is farther off the nadir is an oblique. The axes of stabilised nadir blocks
# stay within a few degrees; obliques are flown at 20 and more.
OBLIQUE_DEG = 15.0


class Occluder(NamedTuple):
    """The surface of a cloud, which occludes points; metres, world frame."""

    height: Heights  # southern row first; NaN where it is not known, which occludes nothing
    left_m: float
    bottom_m: float  # south-west corner of the grid
    cell_m: float
    highest_m: float  # of all heights; minus infinity where none is known
    margin: Heights  # of each `BLOCK`: a ray must pass below the surface by more (noise)
    block_top: Heights  # the highest of each `BLOCK`; minus infinity where none is known
    large_block_top: Heights


def occluded(xyz: FloatArray, centres: FloatArray, views: Views, occluder: Occluder) -> BoolArray:
    """Return for each entry of ``views.camera`` whether the cloud occludes its point.

    Points beside the grid, and cameras below their point, are never occluded. The cells on the way
    are found as by Amanatides & Woo 1987, "A fast voxel traversal algorithm for ray tracing".
    """
    found = np.zeros(len(views.camera), np.bool_)
    in_tiles(
        _occlude, len(xyz), np.ascontiguousarray(xyz), np.ascontiguousarray(centres),
        views.start, views.camera, occluder, found,
    )  # fmt: skip
    return found


def visible_cameras(
    xyz: FloatArray, centres: FloatArray, views: Views, occluder: Occluder
) -> Views:
    """Return the views without occluded ones; see `occluded`.

    A point that would keep fewer than two cameras keeps them all: as it is in the cloud, two
    cameras saw it, and the grid is too coarse to show how.
    """
    stays = ~occluded(xyz, centres, views, occluder)
    left = np.diff(np.concatenate([[0], np.cumsum(stays)])[views.start])
    stays |= np.repeat(left < 2, np.diff(views.start))
    start = np.concatenate([[0], np.cumsum(stays)])[views.start]
    weight = None if views.weight is None else views.weight[stays]
    return Views(start, views.camera[stays], weight, views.kind)


@kernel
def _occlude(
    span: Span, xyz: FloatArray, centres: FloatArray, start: IntArray, camera: IntArray,
    o: Occluder, found: BoolArray,
) -> None:  # fmt: skip
    """Test every ray; distances in plan are in cells."""
    for i in range(*span):
        u, v, z = (xyz[i, 0] - o.left_m) / o.cell_m, (xyz[i, 1] - o.bottom_m) / o.cell_m, xyz[i, 2]
        if not _inside(o.height, u, v):
            continue
        # the noise of the points here
        slack = float(o.margin[int(v) // MARGIN_BLOCK, int(u) // MARGIN_BLOCK])
        # nothing in the cloud is higher
        if z + slack >= o.highest_m:
            continue
        for entry in range(start[i], start[i + 1]):
            c = camera[entry]
            du, dv = (centres[c, 0] - xyz[i, 0]) / o.cell_m, (centres[c, 1] - xyz[i, 1]) / o.cell_m
            up, run = centres[c, 2] - z, np.sqrt(du * du + dv * dv)
            # below the point, or straight above it
            if up <= 0.0 or run < _ONWARD:
                continue
            # unit steps in plan, and the rise of the ray for each
            du, dv, rise = du / run, dv / run, up / run
            found[entry] = _meets(o, u, v, z, du, dv, rise, run, slack)


@device
def _inside(height: Heights, u: float, v: float) -> bool:
    return 0.0 <= u < height.shape[1] and 0.0 <= v < height.shape[0]


@device
def _to_edge(x: float, dx: float, side: int) -> float:
    """Return the distance at which the ray leaves its block along one axis."""
    if dx == 0.0:
        return np.inf
    edge = np.floor(x / side) * side + (side if dx > 0.0 else 0)
    return (edge - x) / dx


@device
def _meets(
    o: Occluder, u: float, v: float, z: float, du: float, dv: float, rise: float, run: float,
    slack: float,
) -> bool:  # fmt: skip
    """Whether the ray leaves a cell below its height, by more than the margin `slack`."""
    t = NEAR_CELLS
    while t < run:
        x, y, low = u + t * du, v + t * dv, z + t * rise
        if not _inside(o.height, x, y):
            return False
        if low + slack >= o.highest_m:
            return False
        row, column, side = int(y), int(x), 1
        # pass a block whose highest cell is below the ray
        if low + slack >= o.large_block_top[row // LARGE_BLOCK, column // LARGE_BLOCK]:
            side = LARGE_BLOCK
        elif low + slack >= o.block_top[row // BLOCK, column // BLOCK]:
            side = BLOCK
        # on to the edge of the cell or block
        t = min(t + min(_to_edge(x, du, side), _to_edge(y, dv, side)), run)
        if side == 1 and z + t * rise + slack < o.height[row, column]:
            return True
        t += _ONWARD
    return False


def _highest_two(one: Heights, other: Heights) -> Heights:
    """Return the highest and the second highest point of two cells, shape (2, ...)."""
    second = np.maximum(np.minimum(one[0], other[0]), np.maximum(one[1], other[1]))
    return np.stack([np.maximum(one[0], other[0]), second])


class OccluderBuilder:
    """Builds the surface of a cloud from its chunks.

    `points` is their number; `low` and `high`, shape (2,), are the corners of the cloud in metres,
    if they are known.
    """

    def __init__(self, low: FloatArray, high: FloatArray, points: int) -> None:
        top = Layer(np.full(2, -np.inf, np.float32), _highest_two)
        most = min(MOST_CELLS, CELLS_A_POINT * max(points, 1))
        self._cells, self._points = Cells(low, high, top, most=most), 0

    def add(self, xyz: FloatArray, classes: npt.NDArray[np.uint8] | None = None) -> None:
        """Add a chunk of apparent points, shape (n, 3); noise (classes 7 and 18) is ignored."""
        if classes is not None:
            xyz = xyz[~np.isin(classes, NOISE_CLASSES)]
        if len(xyz):
            self._points += len(xyz)
            self._cells.cover(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0))
            _add(*self._cells.frame, self._cells.values[0], np.ascontiguousarray(xyz))

    def build(self) -> Occluder | None:
        """Return the surface; None without points."""
        from scipy.ndimage import maximum_filter

        cells = self._cells
        if not self._points:
            return None
        cells.coarsen(self._points, lambda top: np.isfinite(top[0]))
        (highest, second), (side, row, column) = cells.values[0], cells.frame
        # without spikes: a cell is at most as high as the highest of its eight neighbours
        around = np.ones((3, 3), np.bool_)
        around[1, 1] = False
        neighbour = maximum_filter(second, footprint=around, mode="constant", cval=-np.inf)
        known = np.minimum(second, neighbour)
        return Occluder(
            height=np.where(known > -np.inf, known, np.float32(np.nan)),
            left_m=column * side,
            bottom_m=row * side,
            cell_m=side,
            highest_m=float(known.max()),
            margin=_margins(highest, second),
            block_top=_tops(known, BLOCK),
            large_block_top=_tops(known, LARGE_BLOCK),
        )


@kernel
def _add(side_m: float, first_row: int, first_column: int, top: Heights, xyz: FloatArray) -> None:
    """Raise the highest and the second highest of the cells by points."""
    for i in range(len(xyz)):
        c = int(np.floor(xyz[i, 0] / side_m)) - first_column
        r = int(np.floor(xyz[i, 1] / side_m)) - first_row
        z = np.float32(xyz[i, 2])
        if z > top[0, r, c]:
            top[1, r, c], top[0, r, c] = top[0, r, c], z
        elif z > top[1, r, c]:
            top[1, r, c] = z


def _tops(known: Heights, side: int) -> Heights:
    """Return the highest of each block."""
    rows, columns = (np.arange(0, n, side) for n in known.shape)
    return np.maximum.reduceat(np.maximum.reduceat(known, rows, axis=0), columns, axis=1)


def _margins(highest: Heights, second: Heights) -> Heights:
    """Return the margin of each block, metres; blocks with few gaps have the quartile of all."""
    known = np.isfinite(second)
    gap = highest[known] - second[known]
    everywhere = np.quantile(gap, WIDE_GAP) if known.any() else 0.0
    rows, columns = (-(-n // MARGIN_BLOCK) for n in second.shape)
    gaps = np.full((rows * MARGIN_BLOCK, columns * MARGIN_BLOCK), np.inf, np.float32)
    gaps[: len(second), : second.shape[1]][known] = gap
    blocks = gaps.reshape(rows, MARGIN_BLOCK, columns, MARGIN_BLOCK).swapaxes(1, 2)
    blocks = np.sort(blocks.reshape(rows, columns, -1), axis=2)
    count = np.isfinite(blocks).sum(axis=2)
    place = (WIDE_GAP * np.maximum(count - 1, 0)).astype(np.int64)
    quartile = np.take_along_axis(blocks, place[..., None], axis=2)[..., 0]
    margin = np.where(count >= FEWEST_CELLS, quartile, everywhere)
    return margin.astype(np.float32) * np.float32(GAPS_TO_MARGIN)


def wants_occlusion(cameras: Cameras, settings: ScienceOptions) -> bool:
    """Return whether to exclude occluded cameras; with auto, if one is oblique."""
    if settings.occlusion != "auto" or cameras.rotations is None:
        return settings.occlusion == "on"
    # the third row of a rotation is the axis in the world frame; straight down it is (0, 0, -1)
    return bool((-cameras.rotations[:, 2, 2] < np.cos(np.radians(OBLIQUE_DEG))).any())
