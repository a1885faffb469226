"""Where the colour of each pixel of a photograph without water comes from in the photograph taken.

Both mappings work on the nodes of a grid over the photograph, as section 2.3 of Skarlatos &
Agrafiotis 2018 has it, and what they give is a shift for each node: its colour lies in the
photograph taken at node plus shift.

*Exact*: the straight ray of a node, the lens undone, meets the true bed at P. The light from P
reached the camera through the surface: backward tracing gives its path, the lens its pixel.
Nothing is approximate, and nothing is iterated, if the bed is the true one; it is what the
paper's iterations are on their way to.

*Paper*: their eq 12 and Fig 9 on the apparent bed. A ray of which the share P_w runs in water is
given the focal length c' = (P_air + P_w n) c, and its pixel a is put where c/c' of its way from
the principal point ends. The fixed point of the iteration is not the true depth: near nadir, h
looking like h0 through water, a round makes of the depth h(k) the depth h0 + (n - 1) h(k), which
tends to h0 / (2 - n), 1.515 h0 for n = 1.34, where n h0 would be right. Each step is n - 1 = 0.34
of the one before, as the steps of their Figs 15 and 17 are (0.30, 0.32, 0.34; 0.33, 0.35, 0.35).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcfix.lens.imaging import project, unproject
from pcfix.libraries import photo_library
from pcfix.model import BoolArray, FloatArray, Lens, WaterMesh, WaterPlane, WaterRaster
from pcfix.photos.ground import Ground
from pcfix.refract.tracing import trace
from pcfix.water.surface import surface_above

OCCLUSION_CELLS = 1.5
"""Light that meets the ground nearer to the water than its point by more cells is hidden."""
INVERSION_STEPS = 6
"""Of the paper's mapping, which goes from the photograph taken to the one without water; each
leaves a tenth of the error, and fewer than 0.01 px are left of 50."""


class Photo(NamedTuple):
    """One image: where it was taken, and with what lens (in pixels)."""

    label: str
    centre: FloatArray
    rotation: FloatArray
    lens: Lens


@dataclass(frozen=True, eq=False)
class Scene:
    """What the images see: ground, water surface and refractive index."""

    ground: Ground
    water: WaterPlane | WaterMesh | WaterRaster
    refractive_index: float


class Shifts(NamedTuple):
    """What a mapping found at the nodes of a grid.

    Attributes
    ----------
    step_px : int
        Between nodes. The first node is half a step outside the upper left corner of the image,
        so that the nodes surround it.
    shift_px : array of float32, shape (rows, columns, 2)
        From the pixel to where its colour comes from, in u and v; exactly 0 on land.
    known : array of bool, shape (rows, columns)
        Whether there is ground under the node, and it is in sight.
    """

    step_px: int
    shift_px: FloatArray
    known: BoolArray


def nodes_of(lens: Lens, step_px: int) -> tuple[FloatArray, tuple[int, int]]:
    """Return the nodes of a grid that surrounds an image, shape (n, 2), and rows and columns."""
    columns = int(np.ceil(lens.width / step_px)) + 2
    rows = int(np.ceil(lens.height / step_px)) + 2
    u = (np.arange(columns) - 0.5) * step_px
    v = (np.arange(rows) - 0.5) * step_px
    return np.column_stack([np.tile(u, rows), np.repeat(v, columns)]), (rows, columns)


def exact(photo: Photo, scene: Scene, step_px: int) -> Shifts:
    """Map by the true bed: straight out through the lens, back as the light came.

    Parameters
    ----------
    photo : Photo
    scene : Scene
        With the true ground: bed where it is, not where it appears.
    step_px : int
    """
    nodes, shape = nodes_of(photo.lens, step_px)
    seen = _ground_seen(photo, scene, nodes)
    shift = np.zeros((len(nodes), 2))
    known = seen.known.copy()
    wet = np.flatnonzero(seen.wet)
    path = trace(photo.centre, seen.xyz[wet], scene.water, refractive_index=scene.refractive_index)
    camera = (path.piercing_xyz - photo.centre) @ photo.rotation.T
    place = project(photo.lens, camera)
    free = path.converged & np.isfinite(place).all(axis=1)
    free[free] = ~hidden(scene.ground, path.piercing_xyz[free], seen.xyz[wet[free]])
    shift[wet[free]] = place[free] - nodes[wet[free]]
    known[wet[~free]] = False
    return _as_grid(step_px, shift, known, shape)


def paper(photo: Photo, scene: Scene, step_px: int) -> Shifts:
    """Map by eq 12 of Skarlatos & Agrafiotis 2018, their Fig 9, on the ground as it appears.

    Parameters
    ----------
    photo : Photo
    scene : Scene
        With the apparent ground, or that of the round before.
    step_px : int

    Notes
    -----
    The paper moves the pixel of the photograph taken; what is wanted here is the other way round,
    and found by repeated substitution.
    """
    nodes, shape = nodes_of(photo.lens, step_px)
    seen = _ground_seen(photo, scene, nodes)
    shift = np.zeros((len(nodes), 2))
    wet = np.flatnonzero(seen.wet)
    share = seen.depth_m[wet] / (photo.centre[2] - seen.xyz[wet, 2])  # P_w of a straight path
    mixed = (1.0 - share) + share * scene.refractive_index  # c' / c
    camera = (seen.xyz[wet] - photo.centre) @ photo.rotation.T
    camera[:, :2] /= mixed[:, None]
    shift[wet] = project(photo.lens, camera) - nodes[wet]
    known = seen.known & np.isfinite(shift).all(axis=1)
    shift[~known] = 0.0
    forward = _as_grid(step_px, shift, known, shape)
    return forward._replace(shift_px=_inverse(forward))


class _Seen(NamedTuple):
    """What straight rays meet: places, depth under water, whether anything, whether wet."""

    xyz: FloatArray
    depth_m: FloatArray
    known: BoolArray
    wet: BoolArray


def _ground_seen(photo: Photo, scene: Scene, nodes: FloatArray) -> _Seen:
    direction = unproject(photo.lens, nodes) @ photo.rotation
    usable = np.isfinite(direction).all(axis=1)
    direction[~usable] = 0.0, 0.0, 1.0
    far = scene.ground.hit(photo.centre, direction)
    known = usable & np.isfinite(far)
    xyz = np.where(known[:, None], photo.centre + np.where(known, far, 0.0)[:, None] * direction, 0)
    depth = np.zeros(len(nodes))
    depth[known] = surface_above(scene.water, xyz[known]).height_m - xyz[known, 2]
    depth = np.nan_to_num(depth, nan=0.0)  # no water over it
    return _Seen(xyz, depth, known, known & (depth > 0.0))


def hidden(ground: Ground, start: FloatArray, end: FloatArray) -> BoolArray:
    """Return whether the ground stands between places, shapes (n, 3), and others beyond."""
    way = end - start
    length = np.linalg.norm(way, axis=1)
    apart = length > 0.0
    found = np.zeros(len(way), bool)
    hit = ground.hit(start[apart], way[apart] / length[apart, None])
    found[apart] = hit < length[apart] - OCCLUSION_CELLS * ground.cell_m
    return found


def _as_grid(step_px: int, shift: FloatArray, known: BoolArray, shape: tuple[int, int]) -> Shifts:
    return Shifts(step_px, shift.reshape(*shape, 2).astype(np.float32), known.reshape(shape))


def _inverse(forward: Shifts) -> FloatArray:
    """Return for each node q the p - q with p + shift(p) = q."""
    cv2 = photo_library("cv2")

    rows, columns = forward.known.shape
    here = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=2).astype(np.float32)
    back = np.zeros_like(forward.shift_px)
    for _ in range(INVERSION_STEPS):
        place = here + back / forward.step_px
        back = -cv2.remap(
            forward.shift_px, place[..., 0], place[..., 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
    return back
