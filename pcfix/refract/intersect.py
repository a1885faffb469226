"""Send each point's rays through the surface and re-intersect them.

Two kernels do the same sum. `_all_in_frame` takes every camera whose frame holds the point; its
inner loop runs over the points of a tile, so that the processor works on several points at
once. `_chosen` takes a list of cameras per point (view lists, or the steepest few) or bends the
rays at a mesh or raster, and goes point by point. Both add the same terms in the order of the
cameras, so that they agree to the bit wherever both apply.

Each camera may have had its own water level, the surface shifted along the vertical. The point is
lowered by the shift instead, where only its distance from the surface counts. A camera whose own
water lay below the apparent point saw it through air; its ray goes straight on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from pcfix.lens.frames import (
    ALL,
    NOT_DISTORTED,
    NOTHING,
    SOME,
    frames_of,
    in_frame,
    judge,
    mark,
    may_hold,
    no_frames,
    pyramid,
)
from pcfix.model import Outcome, WaterMesh, WaterRaster
from pcfix.refract.choice import (
    ANY_NUMBER,
    TILE,
    choose,
    gather,
    least_cosine2,
    near_cameras,
    spatial_order,
)
from pcfix.refract.piercing import pierce_mesh, pierce_raster
from pcfix.refract.rays import line_terms, nearest_point, refracted
from pcfix.refract.result import Intersection
from pcfix.threads import one_caller
from pcfix.water.surface import build_field, build_tin, locate

if TYPE_CHECKING:
    from pcfix.lens.frames import Frames, Pyramid
    from pcfix.model import (
        BoolArray,
        Cameras,
        FloatArray,
        IntArray,
        Views,
        WaterSurface,
    )
    from pcfix.options import Settings
    from pcfix.water.surface import Field, SurfaceAbove, Tin

_NO_CAMERA, _ONE_CAMERA = int(Outcome.NO_CAMERA), int(Outcome.ONE_CAMERA)
_PARALLEL, _CORRECTED = int(Outcome.PARALLEL_RAYS), int(Outcome.CORRECTED)


def intersect(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    views: Views | None = None,
    level_offset_m: FloatArray | None = None,
) -> Intersection:
    """Re-intersect the refracted rays of submerged points.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Apparent points below the surface, metres, world frame.
    surface : SurfaceAbove
        The water surface above each of them.
    water : WaterSurface
        Needed for its shape where it is a mesh or raster.
    cameras : Cameras
        Projection centres and frames, world frame.
    settings : Settings
        Refractive index, largest angle, most cameras.
    views : Views, optional
        The cameras of each point; without it, every camera whose frame holds the point.
    level_offset_m : array, shape (k,), optional
        How much higher than `surface` the water stood when each camera took its image.

    Returns
    -------
    Intersection
        One row per input point, in the same order.

    Notes
    -----
    Skarlatos & Agrafiotis 2018, eqs 10 and 11, for any number of rays with equal weight. The
    frame test is for the apparent point, as that is where the SfM software projected it.
    """
    order = spatial_order(xyz)
    result = np.zeros((len(xyz), 8))
    used = np.zeros(len(cameras), np.bool_)
    tested = np.zeros((len(xyz) + TILE - 1) // TILE, np.int64)
    common = (
        order,
        np.ascontiguousarray(xyz),
        np.ascontiguousarray(surface.height_m),
        np.ascontiguousarray(surface.slope),
        np.ascontiguousarray(cameras.centres),
        np.zeros(len(cameras)) if level_offset_m is None else level_offset_m,
        frames_of(cameras) if views is None else no_frames(len(cameras)),
        least_cosine2(settings, cameras),
        1.0 / settings.refractive_index,
        result,
        used,
        tested,
    )
    with one_caller():
        tin = build_tin(water) if isinstance(water, WaterMesh) else None
        field = build_field(water) if isinstance(water, WaterRaster) else None
        if views is None and settings.max_cameras is None and tin is None and field is None:
            _all_in_frame(*common)
        else:
            rows = None if views is None else (views.start, views.camera)
            _chosen(*common, tin, field, rows, settings.max_cameras or ANY_NUMBER)
    return Intersection(
        shift_m=result[:, :3],
        outcome=result[:, _OUTCOME].astype(np.uint8),
        ray_count=result[:, _COUNT].astype(np.int32),
        ray_miss_m=result[:, _MISS],
        sigma_z_m=result[:, _SIGMA_Z],
        incidence_deg=result[:, _INCIDENCE],
        camera_used=used,
        pairs_tested=int(tested.sum()),
    )


# Rows of the result, one line of cache per point, as they are written in scattered order.
_MISS, _SIGMA_Z, _INCIDENCE, _COUNT, _OUTCOME = 3, 4, 5, 6, 7


@njit(cache=True, error_model="numpy", nogil=True)
def _usable(
    g: Pyramid | None, marked: float, ex: float, ey: float, ez: float, h: float, height: float,
    length2: float, least_cosine2: float,
) -> bool:  # fmt: skip
    """Whether a camera above the water has the point in its frame, steeply enough.

    The frame is a pyramid, or it was tested before and left a mark.
    """
    steep = (height > h) & (height * height >= least_cosine2 * length2)
    if g is None:
        return (marked > 0.0) & steep
    return in_frame(g, ex, ey, ez) & steep


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(
    row: FloatArray, k: float, xx: float, xy: float, xz: float, yy: float, yz: float,
    bx: float, by: float, bz: float, s: float, cosine2: float,
) -> None:  # fmt: skip
    """Solve one point and write its row; a point without a solution keeps a shift of zero."""
    if k < 2.0:
        row[_OUTCOME] = _ONE_CAMERA if k == 1.0 else _NO_CAMERA
        return
    solved, qx, qy, qz, miss, sigma_z = nearest_point(k, xx, xy, xz, yy, yz, bx, by, bz, s)
    if not solved:
        row[_OUTCOME] = _PARALLEL
        return
    row[0], row[1], row[2] = qx, qy, qz
    row[_MISS], row[_SIGMA_Z] = miss, sigma_z
    row[_INCIDENCE] = np.degrees(np.arccos(np.sqrt(min(cosine2, 1.0))))
    row[_COUNT], row[_OUTCOME] = k, _CORRECTED


@njit(cache=True, error_model="numpy", nogil=True)
def _add_camera(
    sums: FloatArray, tile: FloatArray, marks: FloatArray,
    centre: FloatArray, offset: float, g: Pyramid | None, least_cosine2: float, r: float,
) -> int:  # fmt: skip
    """Add one camera's rays to the sums of a tile; return how many it gave.

    `sums` and `tile` hold runs of `TILE` numbers in one array each: with one base address and
    fixed distances the compiler sees that the runs cannot overlap, and vectorises.
    """
    cx, cy, cz = centre[0], centre[1], centre[2]
    rays = 0
    for j in range(marks.size):
        z = tile[2 * TILE + j]
        ex, ey, ez = cx - tile[j], cy - tile[TILE + j], cz - z
        nx, ny, nz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        height = nx * ex + ny * ey + nz * ez
        h = nz * (tile[3 * TILE + j] - (z - offset))
        length2 = ex * ex + ey * ey + ez * ez
        marked = marks[j]
        use = _usable(g, marked, ex, ey, ez, h, height, length2, least_cosine2)
        # one division for two; a ray that is not used adds zeros
        q = 1.0 / (length2 * height)
        f = h * length2 * q if use and h > 0.0 else 0.0
        inv = height * q if use else 0.0
        bend = r if h > 0.0 else 1.0
        dx, dy, dz = refracted(ex, ey, ez, length2, nx, ny, nz, height, bend)
        xx, xy, xz, yy, yz, bx, by, bz, s = line_terms(f * ex, f * ey, f * ez, dx, dy, dz, inv)
        sums[j] += xx
        sums[TILE + j] += xy
        sums[2 * TILE + j] += xz
        sums[3 * TILE + j] += yy
        sums[4 * TILE + j] += yz
        sums[5 * TILE + j] += bx
        sums[6 * TILE + j] += by
        sums[7 * TILE + j] += bz
        sums[8 * TILE + j] += s
        sums[9 * TILE + j] += 1.0 if use else 0.0
        cosine2 = height * height * inv
        sums[10 * TILE + j] = min(sums[10 * TILE + j], cosine2 if use else 1.0)
        rays += 1 if use else 0
    return rays


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _all_in_frame(
    order: IntArray, xyz: FloatArray, surface: FloatArray, slope: FloatArray,
    centres: FloatArray, offset: FloatArray, frames: Frames, least_cosine2: float, r: float,
    result: FloatArray, used: BoolArray, tested: IntArray,
) -> None:  # fmt: skip
    """Every camera whose frame holds the point; the surface above it is a plane."""
    planes, row = frames.planes, frames.row
    for t in prange(tested.size):
        rows = order[t * TILE : (t + 1) * TILE]
        tile, marks = np.empty(7 * TILE), np.empty(rows.size)
        low, high = gather(tile, rows, xyz, surface, slope)
        sums = np.zeros(11 * TILE)
        sums[10 * TILE :] = 1.0
        x, y, z = (
            tile[: rows.size],
            tile[TILE : TILE + rows.size],
            tile[2 * TILE : 2 * TILE + rows.size],
        )
        for c in range(len(centres)):
            if not may_hold(planes[c], centres[c], low, high):
                continue
            if row[c] == NOT_DISTORTED:
                frame = pyramid(planes[c])
                rays = _add_camera(
                    sums, tile, marks, centres[c], offset[c], frame, least_cosine2, r
                )
            else:
                held = judge(frames, c, centres[c], low, high)
                if held == SOME and not mark(marks, x, y, z, centres[c], frames, c):
                    held = NOTHING
                if held == NOTHING:
                    continue
                if held == ALL:
                    marks[:] = 1.0
                rays = _add_camera(sums, tile, marks, centres[c], offset[c], None, least_cosine2, r)
            tested[t] += rows.size
            if rays:
                used[c] = True  # threads may write it at once: always the same value
        for j in range(rows.size):
            _solve(
                result[rows[j]], sums[9 * TILE + j], sums[j], sums[TILE + j],
                sums[2 * TILE + j], sums[3 * TILE + j], sums[4 * TILE + j], sums[5 * TILE + j],
                sums[6 * TILE + j], sums[7 * TILE + j], sums[8 * TILE + j], sums[10 * TILE + j],
            )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _chosen(
    order: IntArray, xyz: FloatArray, surface: FloatArray, slope: FloatArray,
    centres: FloatArray, offset: FloatArray, frames: Frames, least_cosine2: float, r: float,
    result: FloatArray, used: BoolArray, tested: IntArray,
    tin: Tin | None, field: Field | None, views: tuple[IntArray, IntArray] | None, most: int,
) -> None:  # fmt: skip
    """Chosen cameras per point, or rays that bend at a mesh or raster."""
    for t in prange(tested.size):
        rows = order[t * TILE : (t + 1) * TILE]
        tile = np.empty(7 * TILE)
        low, high = gather(tile, rows, xyz, surface, slope)
        near = near_cameras(frames, centres, low, high)
        for j in range(rows.size):
            facet = -1 if tin is None else locate(tin, tile[j], tile[TILE + j])
            candidates = near
            if views is not None:
                candidates = views[1][views[0][rows[j]] : views[0][rows[j] + 1]]
            kept = choose(
                candidates, tile, j, centres, offset, frames, least_cosine2, most, tin, field, facet
            )
            tested[t] += candidates.size
            row = result[rows[j]]
            _intersect_one(
                row, candidates[kept], tile, j, centres, offset, r, used, tin, field, facet
            )


@njit(cache=True, error_model="numpy", nogil=True)
def _intersect_one(
    row: FloatArray, cameras: IntArray, tile: FloatArray, j: int, centres: FloatArray,
    offset: FloatArray, r: float, used: BoolArray,
    tin: Tin | None, field: Field | None, facet: int,
) -> None:  # fmt: skip
    """Intersect the rays of one point with its own cameras."""
    px, py, pz = tile[j], tile[TILE + j], tile[2 * TILE + j]
    ux, uy, uz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
    sums = np.zeros(9)
    least = 1.0
    for c in cameras:
        used[c] = True
        ex, ey, ez = centres[c, 0] - px, centres[c, 1] - py, centres[c, 2] - pz
        length2 = ex * ex + ey * ey + ez * ez
        lowered = pz - offset[c]
        h = uz * (tile[3 * TILE + j] - lowered)
        f, bend, nx, ny, nz = 0.0, 1.0, ux, uy, uz
        if h > 0.0:
            bend = r
            if tin is not None:
                f, nx, ny, nz = pierce_mesh(tin, px, py, lowered, ex, ey, ez, facet)
            if field is not None:
                f, nx, ny, nz = pierce_raster(field, px, py, lowered, ex, ey, ez, h, ux, uy, uz)
        height = nx * ex + ny * ey + nz * ez
        q = 1.0 / (length2 * height)
        if h > 0.0 and tin is None and field is None:
            f = h * length2 * q
        inv = height * q
        dx, dy, dz = refracted(ex, ey, ez, length2, nx, ny, nz, height, bend)
        terms = line_terms(f * ex, f * ey, f * ez, dx, dy, dz, inv)
        for i in range(9):
            sums[i] += terms[i]
        least = min(least, height * height * inv)
    _solve(
        row, float(cameras.size), sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6],
        sums[7], sums[8], least,
    )  # fmt: skip
