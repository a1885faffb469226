"""Photographs without water: the pixel that each pixel takes its colour from, and the resampling.

Both mappings give a shift at the nodes of a grid over the image, as in section 2.3 of Skarlatos &
Agrafiotis 2018: the colour of a node lies in the original image at node plus shift.

*Exact*: the straight ray of a node meets the true bed at P. Backward ray tracing gives the path of
the light from P through the surface to the camera, and the lens gives its pixel. There is no
approximation and no iteration if the bed is the true one.

*Paper*: their eq 12 and Fig 9 on the apparent bed. A ray with the share P_w in water gets the focal
length c' = (P_air + P_w n) c, so its pixel moves to c/c' of the distance from the principal point.
The fixed point of the iteration is not the true depth: near nadir, with apparent depth h0, a round
makes of the depth h the depth h0 + (n - 1) h, which tends to h0 / (2 - n) and not to n h0 (1.515
against 1.34 for n = 1.34). Each step is n - 1 = 0.34 of the one before, as in their Figs 15 and 17
(0.30 to 0.35).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError, load_open3d, photo_library
from pcfix.lens.imaging import project, unproject
from pcfix.model import BoolArray, FloatArray, Lens, WaterMesh, WaterPlane, WaterRaster
from pcfix.refract.tracing import trace
from pcfix.water.surface import surface_above

# Of the surface for ray casting (200 bytes each); finer rasters are averaged.
MOST_CELLS = 6_000_000
STRIP_ROWS = 512  # rows resampled at once, so that the places stay in the processor's cache
BANDS_AT_ONCE = 4  # OpenCV's limit


class Ground:
    """A surface of land and bed, with heights at the centres of cells.

    Coordinates for ray casting count from its `middle`, so that single precision is enough.
    """

    def __init__(self, height_m: FloatArray, left_m: float, top_m: float, cell_m: float) -> None:
        """Build triangles from heights, shape (rows, columns), world frame, NaN where unknown.

        The first row is the northern one; the corner is that of the upper left cell. Cells of
        rasters with more than `MOST_CELLS` are averaged.
        """
        step = int(np.ceil(np.sqrt(height_m.size / MOST_CELLS)))
        if step > 1:
            rows, columns = (side // step * step for side in height_m.shape)
            blocks = height_m[:rows, :columns].reshape(rows // step, step, columns // step, step)
            height_m, cell_m = blocks.mean(axis=(1, 3)), cell_m * step
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
        complete = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
        one = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1))[complete]
        below, right = one + columns, one + 1
        faces = np.vstack(
            [np.column_stack([one, below, right]), np.column_stack([right, below, below + 1])]
        )
        tensor = load_open3d("open3d.core").Tensor.from_numpy
        triangles = tensor(corners.astype(np.float32)), tensor(faces.astype(np.uint32))
        self._scene = load_open3d("open3d.t.geometry").RaycastingScene()
        self._scene.add_triangles(*triangles)

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


class Photo(NamedTuple):
    """One image: its exterior orientation, and its lens in pixels."""

    label: str
    centre: FloatArray
    rotation: FloatArray
    lens: Lens

    def pixels(self, xyz: FloatArray) -> FloatArray:
        """Return the pixels that straight rays from places, shape (n, 3), meet, shape (n, 2)."""
        return project(self.lens, (xyz - self.centre) @ self.rotation.T)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Return the unit vectors of the rays of pixels, world frame, shape (n, 3)."""
        return np.asarray(unproject(self.lens, pixels) @ self.rotation)


@dataclass(frozen=True, eq=False)
class Scene:
    """Ground, water surface and refractive index."""

    ground: Ground
    water: WaterPlane | WaterMesh | WaterRaster
    refractive_index: float


class Shifts(NamedTuple):
    """The mapping at the nodes of a grid.

    The first node is half a step outside the upper left corner of the image, so that the nodes
    surround it.
    """

    step_px: int  # between nodes
    shift_px: FloatArray  # (rows, columns, 2), float32, to the source of the colour; 0 on land
    known: BoolArray  # (rows, columns), whether there is ground under the node, not occluded


def nodes_of(lens: Lens, step_px: int) -> tuple[FloatArray, tuple[int, int]]:
    """Return the nodes of a grid that surrounds an image, shape (n, 2), and rows and columns."""
    columns = int(np.ceil(lens.width / step_px)) + 2
    rows = int(np.ceil(lens.height / step_px)) + 2
    u = (np.arange(columns) - 0.5) * step_px
    v = (np.arange(rows) - 0.5) * step_px
    return np.column_stack([np.tile(u, rows), np.repeat(v, columns)]), (rows, columns)


def exact(photo: Photo, scene: Scene, step_px: int) -> Shifts:
    """Map by the true bed in `scene`: out by a straight ray, back along the refracted one."""
    nodes, shape = nodes_of(photo.lens, step_px)
    xyz, depth, known = ground_seen(photo, scene, nodes)
    shift = np.zeros((len(nodes), 2))
    wet = np.flatnonzero(depth > 0.0)
    n = scene.refractive_index
    pierced = trace(photo.centre, xyz[wet], scene.water, refractive_index=n).piercing_xyz
    place = photo.pixels(pierced)  # NaN where no path was found
    free = np.asarray(np.isfinite(place).all(axis=1))
    free[free] = ~occluded(scene.ground, pierced[free], xyz[wet[free]])
    shift[wet[free]] = place[free] - nodes[wet[free]]
    known[wet[~free]] = False
    return Shifts(step_px, shift.reshape(*shape, 2).astype(np.float32), known.reshape(shape))


def paper(photo: Photo, scene: Scene, step_px: int) -> Shifts:
    """Map by eq 12 of Skarlatos & Agrafiotis 2018 on the apparent ground, or that of a round.

    The paper moves pixels of the original image; the inverse, which is needed here, is found by
    repeated substitution.
    """
    nodes, shape = nodes_of(photo.lens, step_px)
    xyz, depth, known = ground_seen(photo, scene, nodes)
    shift = np.zeros((len(nodes), 2))
    wet = np.flatnonzero(depth > 0.0)
    share = depth[wet] / (photo.centre[2] - xyz[wet, 2])  # P_w of a straight path
    camera = (xyz[wet] - photo.centre) @ photo.rotation.T
    camera[:, :2] /= ((1.0 - share) + share * scene.refractive_index)[:, None]  # c' / c
    shift[wet] = project(photo.lens, camera) - nodes[wet]
    known &= np.isfinite(shift).all(axis=1)
    shift[~known] = 0.0
    forward = shift.reshape(*shape, 2).astype(np.float32)
    # the inverse: p - q for each node q, where p + shift(p) = q
    cv2 = photo_library("cv2")
    rows, columns = shape
    here = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=2).astype(np.float32)
    edge: Any = cv2.BORDER_REPLICATE
    back: Any = np.zeros_like(forward)
    for _ in range(6):  # each leaves a tenth of the error, 0.01 px of 50 in the end
        u, v = np.moveaxis(here + back / step_px, 2, 0)
        back = -cv2.remap(forward, u, v, cv2.INTER_LINEAR, borderMode=edge)
    return Shifts(step_px, back, known.reshape(shape))


def ground_seen(
    photo: Photo, scene: Scene, nodes: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return where straight rays meet the ground, its depth (0 on land), and whether they do."""
    direction = photo.rays(nodes)
    usable = np.isfinite(direction).all(axis=1)
    direction[~usable] = 0.0, 0.0, 1.0
    far = scene.ground.hit(photo.centre, direction)
    known = usable & np.isfinite(far)
    xyz = np.where(known[:, None], photo.centre + np.where(known, far, 0.0)[:, None] * direction, 0)
    depth = np.zeros(len(nodes))
    depth[known] = surface_above(scene.water, xyz[known]).height_m - xyz[known, 2]
    return xyz, np.maximum(np.nan_to_num(depth, nan=0.0), 0.0), known  # NaN: no water above


def occluded(ground: Ground, start: FloatArray, end: FloatArray) -> BoolArray:
    """Return whether the ground is between start and end, both of shape (n, 3)."""
    ray = end - start
    length = np.linalg.norm(ray, axis=1)
    distinct = length > 0.0
    found = np.zeros(len(ray), bool)
    hit = ground.hit(start[distinct], ray[distinct] / length[distinct, None])
    found[distinct] = hit < length[distinct] - 1.5 * ground.cell_m  # not by its own cell
    return found


def by_bands(
    function: Callable[[npt.NDArray[Any]], npt.NDArray[Any]], image: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """Apply a function of OpenCV to an image, (rows, columns, bands), a few bands at a time."""
    groups = range(0, image.shape[2], BANDS_AT_ONCE)
    some = (np.ascontiguousarray(image[..., k : k + BANDS_AT_ONCE]) for k in groups)
    return np.dstack([function(one) for one in some])


def resample(image: npt.NDArray[Any], shifts: Shifts) -> tuple[npt.NDArray[Any], BoolArray, int]:
    """Resample an image, shape (rows, columns, bands), by bicubic interpolation.

    Pixels without a shift are copied bit by bit; pixels whose source is not known become black.
    Returns the image, the pixels that changed, shape (rows, columns), and how many are black.
    """
    cv2 = photo_library("cv2")
    rows, columns, _ = image.shape
    out, touched, black = image.copy(), np.empty((rows, columns), bool), 0
    how: Any = {"interpolation": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REPLICATE}
    for top in range(0, rows, STRIP_ROWS):
        bottom = min(top + STRIP_ROWS, rows)
        shift, lost = _strip(shifts, top, bottom, columns)
        moved = (shift[..., 0] != 0.0) | (shift[..., 1] != 0.0)
        part = out[top:bottom]
        if moved.any():
            u = np.arange(columns, dtype=np.float32)[None, :] + shift[..., 0]
            v = np.arange(top, bottom, dtype=np.float32)[:, None] + shift[..., 1]
            found = by_bands(partial(cv2.remap, map1=u, map2=v, **how), image)
            np.copyto(part, found, where=moved[..., np.newaxis])
            lost |= (u < -0.5) | (u > columns - 0.5) | (v < -0.5) | (v > rows - 0.5)
        if lost.any():
            part[lost] = 0
        touched[top:bottom] = moved | lost
        black += int(np.count_nonzero(lost))
    return out, touched, black


def _strip(shifts: Shifts, top: int, bottom: int, columns: int) -> tuple[Any, BoolArray]:
    """Interpolate the shifts of some rows, and whether they are unknown, from the nodes."""
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
