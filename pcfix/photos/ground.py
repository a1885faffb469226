"""The ground under the images: a raster of heights, and where rays meet it."""

from __future__ import annotations

import numpy as np

from pcfix.errors import SettingError
from pcfix.libraries import load_open3d
from pcfix.model import FloatArray

MOST_CELLS = 6_000_000
"""Of the surface for ray casting (200 bytes each); a raster with more is averaged."""


class Ground:
    """A surface of land and bed, with heights at the centres of cells.

    Coordinates for ray casting count from its `middle`, so that single precision is enough.
    """

    def __init__(self, height_m: FloatArray, left_m: float, top_m: float, cell_m: float) -> None:
        """Build triangles from heights, shape (rows, columns), world frame, NaN where unknown.

        The first row is the northern one; the corner is that of the upper left cell.
        """
        self.height_m, self.left_m, self.top_m, self.cell_m = height_m, left_m, top_m, cell_m
        rows, columns = height_m.shape
        known = np.isfinite(height_m)
        if min(rows, columns) < 2 or not known.any():
            raise SettingError("dsm.empty", "The DSM has fewer than two rows or no heights.")
        middle = left_m + 0.5 * columns * cell_m, top_m - 0.5 * rows * cell_m
        self.middle = np.array([*middle, float(np.nanmean(height_m))])
        x = left_m + (np.arange(columns) + 0.5) * cell_m - self.middle[0]
        y = top_m - (np.arange(rows) + 0.5) * cell_m - self.middle[1]
        z = np.where(known, height_m - self.middle[2], 0.0)
        corners = np.column_stack([np.tile(x, rows), np.repeat(y, columns), z.ravel()])
        # two triangles for each square of four known heights
        whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
        one = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1))[whole]
        below, beside = one + columns, one + 1
        faces = np.vstack(
            [np.column_stack([one, below, beside]), np.column_stack([beside, below, below + 1])]
        )
        tensor = load_open3d("open3d.core").Tensor.from_numpy
        self._scene = load_open3d("open3d.t.geometry").RaycastingScene()
        self._scene.add_triangles(
            tensor(corners.astype(np.float32)), tensor(faces.astype(np.uint32))
        )

    def hit(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the distance along rays to the ground, metres; infinite where they miss it.

        Origins, shape (n, 3) or (3,), are in the world frame; directions, shape (n, 3), are unit
        vectors. Distances are good to 1e-7 of themselves.
        """
        rays = np.empty((len(direction), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin - self.middle, direction
        return np.asarray(self._scene.cast_rays(rays)["t_hit"].numpy(), np.float64)

    def heights_at(self, xy: FloatArray) -> FloatArray:
        """Interpolate heights between the centres of cells, shape (n,); NaN where unknown."""
        from scipy.ndimage import map_coordinates

        row = (self.top_m - xy[:, 1]) / self.cell_m - 0.5
        column = (xy[:, 0] - self.left_m) / self.cell_m - 0.5
        return np.asarray(
            map_coordinates(self.height_m, [row, column], order=1, mode="constant", cval=np.nan)
        )


def ground_of(height_m: FloatArray, left_m: float, top_m: float, cell_m: float) -> Ground:
    """Return a ground of at most `MOST_CELLS` cells, each the mean of cells of the raster."""
    step = int(np.ceil(np.sqrt(height_m.size / MOST_CELLS)))
    if step > 1:
        rows, columns = (side // step * step for side in height_m.shape)
        blocks = height_m[:rows, :columns].reshape(rows // step, step, columns // step, step)
        height_m, cell_m = blocks.mean(axis=(1, 3)), cell_m * step
    return Ground(height_m, left_m, top_m, cell_m)
