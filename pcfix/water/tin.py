"""A triangulated height field, and which of its facets lies above a place.

The plan is covered by a grid of square cells; each cell lists the facets whose bounding box
touches it. Coordinates inside are relative to the mesh's lower left corner, so that nothing is
lost at UTM northings of five million.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

from pcfix.errors import GeometryError

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import FloatArray, IntArray, WaterMesh

EDGE_TOLERANCE = 1e-9  # of a barycentric coordinate: a point on an edge belongs to both sides
MIN_FACET_AREA_M2 = 1e-12  # in plan; below this a facet is vertical or a sliver, and has no height


class Tin(NamedTuple):
    """The arrays of the lookup; see `build_tin`."""

    origin_x: float
    origin_y: float
    cell_m: float
    columns: int
    rows: int
    cell_start: IntArray
    cell_facet: IntArray
    corners: FloatArray  # (t, 3, 2), relative to the origin
    planes: FloatArray  # (t, 3): z = a + b x + c y, relative to the origin


@lru_cache(maxsize=4)
def build_tin(mesh: WaterMesh) -> Tin:
    """Index the facets of a mesh by plan position.

    Raises
    ------
    GeometryError
        If no facet has an area in plan.
    """
    origin = mesh.vertices[:, :2].min(axis=0)
    xyz = (mesh.vertices - np.append(origin, 0.0))[mesh.triangles]
    edge1, edge2 = xyz[:, 1] - xyz[:, 0], xyz[:, 2] - xyz[:, 0]
    normal = np.cross(edge1, edge2)
    flat = np.abs(normal[:, 2]) > 2.0 * MIN_FACET_AREA_M2
    if not flat.any():
        raise GeometryError(f"The water surface {mesh.name} has no facet with an area in plan.")
    xyz, normal = xyz[flat], normal[flat]
    slope = -normal[:, :2] / normal[:, 2:]
    a = xyz[:, 0, 2] - (slope * xyz[:, 0, :2]).sum(axis=1)
    corners = np.ascontiguousarray(xyz[:, :, :2])
    grid = _index_cells(corners)
    return Tin(float(origin[0]), float(origin[1]), *grid, corners, np.column_stack([a, slope]))


def _index_cells(corners: FloatArray) -> tuple[float, int, int, IntArray, IntArray]:
    """Return cell size, columns, rows and the ragged table of facets per cell."""
    extent = corners.reshape(-1, 2).max(axis=0)
    cell = float(max(np.sqrt(extent.prod() / len(corners)), extent.max() / 4096, 1e-6))
    columns, rows = (np.floor(extent / cell).astype(int) + 1).tolist()
    low = np.floor(corners.min(axis=1) / cell).astype(np.int64)
    high = np.floor(corners.max(axis=1) / cell).astype(np.int64)
    width, height = (high - low + 1).T
    facet = np.repeat(np.arange(len(corners)), width * height)
    within = np.arange(len(facet)) - np.repeat(
        np.cumsum(width * height) - width * height, width * height
    )
    column = low[facet, 0] + within % width[facet]
    row = low[facet, 1] + within // width[facet]
    code = row * columns + column
    order = np.argsort(code, kind="stable")
    start = np.searchsorted(code[order], np.arange(rows * columns + 1))
    return cell, columns, rows, start.astype(np.int64), facet[order].astype(np.int64)


@njit(cache=True, error_model="numpy", nogil=True)
def locate(tin: Tin, x: float, y: float) -> int:
    """Return the facet above the plan position (world frame), or -1 outside the mesh."""
    u, v = x - tin.origin_x, y - tin.origin_y
    column, row = int(np.floor(u / tin.cell_m)), int(np.floor(v / tin.cell_m))
    if column < 0 or row < 0 or column >= tin.columns or row >= tin.rows:
        return -1
    cell = row * tin.columns + column
    for k in range(tin.cell_start[cell], tin.cell_start[cell + 1]):
        facet = tin.cell_facet[k]
        if _inside(tin.corners[facet], u, v):
            return int(facet)
    return -1


@njit(cache=True, error_model="numpy", nogil=True)
def _inside(corners: FloatArray, u: float, v: float) -> bool:
    """Whether a plan position lies in a triangle, edges included."""
    ax, ay = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1]
    bx, by = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
    px, py = u - corners[0, 0], v - corners[0, 1]
    area = ax * by - ay * bx
    s = (px * by - py * bx) / area
    t = (ax * py - ay * px) / area
    return bool(s >= -EDGE_TOLERANCE and t >= -EDGE_TOLERANCE and s + t <= 1.0 + EDGE_TOLERANCE)


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def facets_above(
    tin: Tin, x: FloatArray, y: FloatArray
) -> npt.NDArray[np.int64]:  # pragma: no cover - compiled
    """Return `locate` for n positions."""
    facet = np.empty(x.size, np.int64)
    for i in prange(x.size):
        facet[i] = locate(tin, x[i], y[i])
    return facet
