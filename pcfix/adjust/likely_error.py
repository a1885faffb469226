"""What poses that absorbed the refraction are likely to cost, in metres."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.adjust.block import Unknowns
from pcfix.adjust.fixed_poses import intersect_fixed, plain_block
from pcfix.adjust.solve import prepare, solved_cameras
from pcfix.adjust.unaware import solve_unaware, straight_columns
from pcfix.errors import GeometryError
from pcfix.lens.imaging import project
from pcfix.refract.choice import views_in_frame
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from pcfix.adjust.block import Block
    from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Lens, WaterSurface

SIGMA_PX = 0.25
"""Of a place in the image; small, so that the centres only decide where the block lies."""
OWN_SIGMA_M = 1.0
"""Of a projection centre, which holds the block as a whole where it is."""
LEAST_VIEWS, LEAST_POINTS, LEAST_IMAGES = 3, 10, 5


class Mended(NamedTuple):
    """What the poses would be if they had absorbed the refraction, and what that changes.

    cameras : Cameras
        Those of the images that enough points lie in.
    row : shape (k,), of each of them among all.
    land_m, bed_m : shape (m,) and (w,)
        By how much land and bed lie too low now, the bed after its correction with the poses as
        they are.
    """

    cameras: Cameras
    row: IntArray
    land_m: FloatArray
    bed_m: FloatArray


def images_of(
    xyz: FloatArray, cameras: Cameras, least: int = 2
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Return which points lie in frames, and where straight rays image them.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Metres, world frame.
    cameras : Cameras
        With angles and lenses.
    least : int
        Frames that must hold a point.

    Returns
    -------
    rows, start, camera, image_xy
        Of the points; the other three as of `pcfix.adjust.block.Block`.
    """
    rotations = np.asarray(cameras.rotations)
    views = views_in_frame(xyz, cameras)
    rows = np.flatnonzero(np.diff(views.start) >= least)
    views = views.take(rows)
    owner = np.repeat(rows, np.diff(views.start))
    local = xyz[owner] - cameras.centres[views.camera]
    local = np.einsum("oij,oj->oi", rotations[views.camera], local)
    image_xy = np.empty((len(owner), 2))
    by_lens: dict[Lens, list[int]] = {}
    for row, lens in enumerate(cameras.lenses or ()):
        by_lens.setdefault(lens, []).append(row)
    for lens, mine in by_lens.items():
        of_lens = np.isin(views.camera, mine)
        image_xy[of_lens] = project(lens, local[of_lens])
    return rows, views.start, views.camera, image_xy


def mended(
    xyz: FloatArray, cameras: Cameras, water: WaterSurface, refractive_index: float
) -> Mended:
    """Return the poses as an adjustment that knows of the water would have them.

    The block stays as a whole where its cameras are.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Points of the apparent cloud, or tie points, spread over it; a thousand or two.
    cameras : Cameras
        With angles and lenses.
    water : WaterPlane, WaterMesh or WaterRaster
    refractive_index : float

    Raises
    ------
    GeometryError
        If the cloud does not determine the poses.
    """
    row = _well_covered(xyz, cameras)
    cameras = some_of(cameras, row)
    block, apparent = _block_of(xyz, cameras, water, refractive_index)
    problem, begin = prepare(block, Unknowns(lens=("f",)))
    tests = straight_columns(problem, begin, apparent - problem.origin)
    found = solve_unaware(problem, begin, tests, np.ones(len(apparent), np.bool_))
    higher = found.state.xyz[:, 2] + problem.origin[2] - intersect_fixed(block).xyz[:, 2]
    known, wet = np.isfinite(higher), block.wet
    return Mended(solved_cameras(problem, found), row, higher[~wet & known], higher[wet & known])


def _well_covered(xyz: FloatArray, cameras: Cameras) -> IntArray:
    """Return the rows of the cameras that image enough points.

    Raises
    ------
    GeometryError
        If they are fewer than three.
    """
    _, _, camera, _ = images_of(xyz, cameras, LEAST_VIEWS)
    row = np.flatnonzero(np.bincount(camera, minlength=len(cameras)) >= LEAST_POINTS)
    if len(row) < LEAST_IMAGES:
        raise GeometryError(f"only {len(row)} images hold {LEAST_POINTS} points of the cloud.")
    return row


def some_of(cameras: Cameras, row: IntArray) -> Cameras:
    """Return some of the cameras, without their GNSS positions."""
    return replace(
        cameras,
        labels=tuple(cameras.labels[i] for i in row),
        centres=cameras.centres[row],
        rotations=np.asarray(cameras.rotations)[row],
        lenses=tuple((cameras.lenses or ())[i] for i in row),
        gnss=None,
    )


def _block_of(
    xyz: FloatArray, cameras: Cameras, water: WaterSurface, refractive_index: float
) -> tuple[Block, FloatArray]:
    """Return the block that the points and their straight images make, and the points in it."""
    rows, start, camera, image_xy = images_of(xyz, cameras, LEAST_VIEWS)
    apparent = xyz[rows]
    above = surface_above(water, apparent)
    wet = is_submerged(apparent[:, 2], above)
    if not wet.any():
        raise GeometryError("no point of the cloud under water lies in three images.")
    true = deeper(apparent, above.height_m, wet, refractive_index)
    own = cameras.centres, np.full((len(cameras), 3), OWN_SIGMA_M)
    block = plain_block(cameras, true, start, camera, image_xy, water, refractive_index, wet, own)
    return replace(block, sigma_px=np.full(len(camera), SIGMA_PX)), apparent


def deeper(
    apparent: FloatArray, level_m: FloatArray, wet: BoolArray, refractive_index: float
) -> FloatArray:
    """Return about where apparent points are: straight down the depth grows by the index."""
    true = apparent.copy()
    true[wet, 2] = level_m[wet] - refractive_index * (level_m - apparent[:, 2])[wet]
    return true
