"""Images of a ground with a texture, with and without water over it, pixel by pixel.

Its own geometry: rays go forward from the camera, bend at a level surface by the sines of their
angles, and march to a bilinear ground. Nothing of it is shared with the mapping of photographs.
"""

from typing import NamedTuple

import numpy as np


class Texture:
    """A sum of waves in plan, in octaves down to a shortest length; 0 to 1."""

    def __init__(self, shortest_m: float, longest_m: float, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        lengths = np.geomspace(shortest_m, longest_m, 48)
        turn = rng.uniform(0.0, 2.0 * np.pi, 48)
        self.number = 2.0 * np.pi / lengths[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 48)

    def __call__(self, xy):
        waves = sum(np.cos(xy @ k + p) for k, p in zip(self.number, self.phase, strict=True))
        return np.clip(0.5 + waves / (4.0 * np.sqrt(24.0)), 0.0, 1.0)


class Relief(NamedTuple):
    """A raster of heights, its upper left corner and cell."""

    height_m: np.ndarray
    left_m: float
    top_m: float
    cell_m: float

    def at(self, xy):
        """Return heights between the centres of cells, held at the border."""
        column = np.clip(
            (xy[:, 0] - self.left_m) / self.cell_m - 0.5, 0, self.height_m.shape[1] - 1.001
        )
        row = np.clip(
            (self.top_m - xy[:, 1]) / self.cell_m - 0.5, 0, self.height_m.shape[0] - 1.001
        )
        j, i = column.astype(int), row.astype(int)
        u, v = column - j, row - i
        h = self.height_m
        upper = h[i, j] * (1 - u) + h[i, j + 1] * u
        return upper * (1 - v) + (h[i + 1, j] * (1 - u) + h[i + 1, j + 1] * u) * v


def rendered(photo, relief, texture, water_m=None, n=1.34):
    """Return an image of a pinhole camera, uint8, and the place of the ground in each pixel."""
    lens = photo.lens
    u, v = np.meshgrid(np.arange(int(lens.width)) + 0.5, np.arange(int(lens.height)) + 0.5)
    direction = np.column_stack(
        [
            (u.ravel() - lens.principal_x) / lens.focal,
            (v.ravel() - lens.principal_y) / lens.focal,
            np.ones(u.size),
        ]
    )
    direction = direction @ photo.rotation
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    place = _marched(np.broadcast_to(photo.centre, direction.shape), direction, relief)
    if water_m is not None:
        wet = place[:, 2] < water_m
        far = (water_m - photo.centre[2]) / direction[wet, 2]
        pierced = photo.centre + far[:, None] * direction[wet]
        sine = np.hypot(direction[wet, 0], direction[wet, 1]) / n
        aside = direction[wet, :2] / np.maximum(n * sine, 1e-12)[:, None]
        refracted = np.column_stack([aside * sine[:, None], -np.sqrt(1.0 - sine**2)])
        place[wet] = _marched(pierced, refracted, relief)
    grey = np.rint(255.0 * texture(place[:, :2])).astype(np.uint8)
    return grey.reshape(u.shape), place.reshape(*u.shape, 3)


def _marched(start, direction, relief, step_m=0.05):
    """Return where rays that go down meet the ground first, to a tenth of a millimetre."""
    top = float(relief.height_m.max())
    far = np.maximum((top - start[:, 2]) / direction[:, 2], 0.0)
    step = step_m / -direction[:, 2]
    above = np.ones(len(start), bool)
    while above.any():
        rows = np.flatnonzero(above)
        far[rows] += step[rows]
        place = start[rows] + far[rows, None] * direction[rows]
        above[rows] = place[:, 2] > relief.at(place[:, :2])
    low, high = far - step, far
    for _ in range(10):
        middle = 0.5 * (low + high)
        place = start + middle[:, None] * direction
        over = place[:, 2] > relief.at(place[:, :2])
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    return start + high[:, None] * direction
