"""The ground under the photographs: a raster of heights, and where rays meet it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pcfix.errors import SettingError
from pcfix.libraries import load_open3d
from pcfix.model import FloatArray

MOST_CELLS = 6_000_000
"""Of the surface that rays are sent at; a raster with more is thinned. Memory is 200 bytes each."""


@dataclass(frozen=True, eq=False)
class Ground:
    """A surface of land and bed, its heights at the centres of cells.

    Attributes
    ----------
    height_m : array, shape (rows, columns)
        World frame, NaN where there is none; the first row is the northern one.
    left_m, top_m : float
        Upper left corner of the upper left cell.
    cell_m : float
    """

    height_m: FloatArray
    left_m: float
    top_m: float
    cell_m: float
    _scene: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the surface of triangles; its coordinates are from the raster's middle."""
        rows, columns = self.height_m.shape
        if min(rows, columns) < 2 or not np.isfinite(self.height_m).any():
            raise SettingError("a ground needs two rows and columns, and heights.")
        object.__setattr__(self, "_scene", self._built())

    @property
    def middle(self) -> FloatArray:
        """What the coordinates of rays are taken from, so that single precision is enough."""
        rows, columns = self.height_m.shape
        return np.array(
            [
                self.left_m + 0.5 * columns * self.cell_m,
                self.top_m - 0.5 * rows * self.cell_m,
                float(np.nanmean(self.height_m)),
            ]
        )

    def _built(self) -> Any:
        rows, columns = self.height_m.shape
        x = self.left_m + (np.arange(columns) + 0.5) * self.cell_m - self.middle[0]
        y = self.top_m - (np.arange(rows) + 0.5) * self.cell_m - self.middle[1]
        z = self.height_m - self.middle[2]
        known = np.isfinite(z)
        corners = np.column_stack(
            [np.tile(x, rows), np.repeat(y, columns), np.where(known, z, 0.0).ravel()]
        ).astype(np.float32)
        one = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        whole = (known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]).ravel()
        one = one[whole]
        below, right = one + columns, one + 1
        faces = np.vstack(
            [np.column_stack([one, below, right]), np.column_stack([right, below, below + 1])]
        ).astype(np.uint32)
        tensor = load_open3d("open3d.core").Tensor.from_numpy
        scene = load_open3d("open3d.t.geometry").RaycastingScene()
        scene.add_triangles(tensor(corners), tensor(faces))
        return scene

    def hit(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """Return how far along rays the ground is first met.

        Parameters
        ----------
        origin : array, shape (n, 3) or (3,)
            Metres, world frame.
        direction : array, shape (n, 3)
            Unit vectors.

        Returns
        -------
        array, shape (n,)
            Metres, good to 1e-7 of the distance; infinite where a ray meets nothing.
        """
        rays = np.empty((len(direction), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin - self.middle, direction
        return self._scene.cast_rays(rays)["t_hit"].numpy().astype(np.float64)

    def heights_at(self, xy: FloatArray) -> FloatArray:
        """Return heights between the centres of cells, shape (n,); NaN where there is none."""
        from scipy.ndimage import map_coordinates

        row = (self.top_m - xy[:, 1]) / self.cell_m - 0.5
        column = (xy[:, 0] - self.left_m) / self.cell_m - 0.5
        return np.asarray(
            map_coordinates(self.height_m, [row, column], order=1, mode="constant", cval=np.nan)
        )


def ground_of(height_m: FloatArray, left_m: float, top_m: float, cell_m: float) -> Ground:
    """Return a ground of no more than `MOST_CELLS` cells, means of the raster's own."""
    step = int(np.ceil(np.sqrt(height_m.size / MOST_CELLS)))
    if step > 1:
        rows, columns = (side // step * step for side in height_m.shape)
        blocks = height_m[:rows, :columns].reshape(rows // step, step, columns // step, step)
        height_m, cell_m = blocks.mean(axis=(1, 3)), cell_m * step
    return Ground(height_m, left_m, top_m, cell_m)
