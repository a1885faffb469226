"""Height and slope of the water surface above points.

A raster is bilinear between the centres of four cells, z = z00 + s dx + t dy + k s t with s and t
from 0 to 1; its slope is the gradient of that. An unknown cell is NaN, and so are the four patches
around it. Over a mesh lies a grid of square cells in plan, each with the facets whose bounding box
touches it. Coordinates inside are relative to the raster's upper left cell, or the mesh's lower
left corner, so that UTM northings of five million lose no digits.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import (
    BoolArray,
    FloatArray,
    IntArray,
    WaterDimension,
    WaterMesh,
    WaterPlane,
    WaterRaster,
    WaterSurface,
)


@dataclass(frozen=True, eq=False)
class FoundSurface:
    """A water surface that was given; its subclasses are fitted, or found in a cloud."""

    surface: WaterSurface
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any] | None:
        """Return the figures of a fit as plain values; None without a fit."""
        return None

    def sigma_at(self, xy: FloatArray) -> FloatArray | None:
        """Return the standard error (m) of the height at places (m, 2), if there is a fit."""
        return None


class SurfaceAbove(NamedTuple):
    """The plane of the water surface above each of n points."""

    height_m: FloatArray  # (n,), world Z of the surface; NaN if unknown
    slope: FloatArray  # (n, 2), dz/dx and dz/dy


def surface_above(
    water: WaterSurface, xyz: FloatArray, dimension: npt.ArrayLike | None = None
) -> SurfaceAbove:
    """Return the water surface above (or below) points, shape (n, 3), metres, world frame.

    A `WaterDimension` needs the values of the cloud's dimension, shape (n,).
    """
    match water:
        case WaterPlane(a, b, c):
            # in this order of summation, a level is returned exactly
            height = a + (b * xyz[:, 0] + c * xyz[:, 1])
            return SurfaceAbove(height, np.broadcast_to([b, c], (len(xyz), 2)))
        case WaterDimension(name):
            height = np.asarray([] if dimension is None else dimension, dtype=np.float64)
            if height.shape != (len(xyz),):
                raise SettingError(
                    "option.shape",
                    f"The water surface is the dimension {name}. Give one height per point, shape"
                    f" ({len(xyz)},), not {height.shape}.",
                    option="water", shape=height.shape,
                )  # fmt: skip
            return SurfaceAbove(
                np.where(np.isfinite(height), height, np.nan), np.zeros((len(xyz), 2))
            )
        case WaterMesh() | WaterRaster():
            x, y = np.ascontiguousarray(xyz[:, :2].T)
            tin = build_tin(water) if isinstance(water, WaterMesh) else None
            field = build_fields({}, 1, water) if isinstance(water, WaterRaster) else None
            height, slope = np.empty(x.size), np.empty((x.size, 2))
            in_tiles(_set_heights, x.size, tin, field, x, y, height, slope)
            return SurfaceAbove(height, slope)


def is_submerged(z: FloatArray, surface: SurfaceAbove) -> BoolArray:
    """Return which points lie below the water surface; not where it is unknown."""
    return np.asarray(z < surface.height_m)


class Field(NamedTuple):
    """One of k rasters for the kernels; see `build_fields`."""

    heights: FloatArray  # (cells,), metres, of all rasters, row by row, northern row first
    shape: IntArray  # (k, 3), first cell, rows and columns of each raster
    frame: FloatArray  # (k, 4), x and y of the upper left cell centre, cell width and height, m
    which: int  # the raster


@device
def field_of(fields: Field | None, which: int) -> Field | None:
    """Return another one of the same rasters; None where there are none.

    Not for functions that make arrays: those count references, and here none is counted.
    """
    if fields is None:
        return None
    return Field(fields.heights, fields.shape, fields.frame, which)


def build_fields(
    rasters: Mapping[int, WaterRaster], k: int, common: WaterRaster | None = None
) -> Field:
    """Return the rasters of some of k images, by index, and the common one of the others.

    The frame of an image without a raster is NaN.
    """
    shape, frame = np.zeros((k, 3), np.int64), np.full((k, 4), np.nan)
    cells, count = list[FloatArray](), 0
    for raster in dict.fromkeys([*rasters.values(), common]):
        if raster is not None:
            images = [c for c in range(k) if rasters.get(c, common) is raster]
            width, height = (float(side) for side in raster.cell_m)
            west, north = raster.left_m + width / 2.0, raster.top_m - height / 2.0
            shape[images] = count, *raster.height_m.shape
            frame[images] = west, north, width, height
            cells.append(np.ascontiguousarray(raster.height_m, np.float64).ravel())
            count += raster.height_m.size
    heights = cells[0] if len(cells) == 1 else np.concatenate([np.zeros(0), *cells])
    return Field(heights, shape, frame, 0)


@device
def height_at(field: Field, x: float, y: float) -> tuple[float, float, float]:
    """Return height, dz/dx and dz/dy at a plan position (world frame); NaN if unknown.

    The outermost patch is extended over the outer half of the cells at the edge.
    """
    k, shape, frame = field.which, field.shape, field.frame
    first, rows, columns = shape[k, 0], shape[k, 1], shape[k, 2]
    # columns east and rows south of the upper left centre; the comparison refuses NaN too
    u, v = (x - frame[k, 0]) / frame[k, 2], (frame[k, 1] - y) / frame[k, 3]
    if not (-0.5 <= u <= columns - 0.5 and -0.5 <= v <= rows - 0.5):
        return np.nan, 0.0, 0.0
    column = min(max(int(np.floor(u)), 0), columns - 2)
    row = min(max(int(np.floor(v)), 0), rows - 2)
    # the patch between the centres `at`, east and south of it, and the place in it
    at, s, t = first + row * columns + column, u - column, v - row
    z = field.heights[at]
    east, south = field.heights[at + 1] - z, field.heights[at + columns] - z
    twist = field.heights[at + columns + 1] - z - east - south
    height = z + s * east + t * south + s * t * twist
    return height, (east + t * twist) / frame[k, 2], -(south + s * twist) / frame[k, 3]


EDGE_TOLERANCE = 1e-9  # of a barycentric coordinate: a point on an edge belongs to both sides
MIN_FACET_AREA_M2 = 1e-12  # in plan; below this a facet is vertical or a sliver, and has no height
FARTHEST_M = 1e9  # no coordinate on Earth is as large


class Tin(NamedTuple):
    """A mesh for the kernels; see `build_tin`."""

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
    """Index the facets of a mesh by plan position."""
    if not np.abs(mesh.vertices).max(initial=0.0) < FARTHEST_M:
        raise GeometryError(
            "water.mesh",
            f"{mesh.name}: the water surface has a vertex at {np.abs(mesh.vertices).max():.3g} m,"
            " which is not on Earth. Export it again.",
            path=mesh.name,
        )
    origin = mesh.vertices[:, :2].min(axis=0)
    xyz = (mesh.vertices - np.append(origin, 0.0))[mesh.triangles]
    edge1, edge2 = xyz[:, 1] - xyz[:, 0], xyz[:, 2] - xyz[:, 0]
    normal = np.cross(edge1, edge2)
    flat = np.abs(normal[:, 2]) > 2.0 * MIN_FACET_AREA_M2
    if not flat.any():
        text = f"{mesh.name}: the water surface has no facet with an area in plan. Export it again."
        raise GeometryError("water.mesh", text, path=mesh.name)
    xyz, normal = xyz[flat], normal[flat]
    # normal . (x - corner) = 0, solved for z
    slope = -normal[:, :2] / normal[:, 2:]
    a = xyz[:, 0, 2] - (slope * xyz[:, 0, :2]).sum(axis=1)
    corners = np.ascontiguousarray(xyz[:, :, :2])
    # the grid of square cells, about one for each facet
    extent = corners.reshape(-1, 2).max(axis=0)
    cell = float(max(np.sqrt(extent.prod() / len(corners)), extent.max() / 4096, 1e-6))
    columns, rows = (np.floor(extent / cell).astype(int) + 1).tolist()
    low = np.floor(corners.min(axis=1) / cell).astype(np.int64)
    width, height = (np.floor(corners.max(axis=1) / cell).astype(np.int64) - low + 1).T
    # a row for each cell of each facet's bounding box, and which of these it is
    size = width * height
    facet = np.repeat(np.arange(len(corners)), size)
    within = np.arange(len(facet)) - np.repeat(np.cumsum(size) - size, size)
    code = (low[facet, 1] + within // width[facet]) * columns
    code += low[facet, 0] + within % width[facet]
    order = np.argsort(code, kind="stable")
    start = np.searchsorted(code[order], np.arange(rows * columns + 1))
    x, y = origin.tolist()
    planes = np.column_stack([a, slope])
    return Tin(x, y, cell, columns, rows, start, facet[order], corners, planes)


@device
def locate(tin: Tin, x: float, y: float) -> int:
    """Return the facet above the plan position (world frame), or -1 outside the mesh."""
    u, v = x - tin.origin_x, y - tin.origin_y
    column, row = int(np.floor(u / tin.cell_m)), int(np.floor(v / tin.cell_m))
    if column < 0 or row < 0 or column >= tin.columns or row >= tin.rows:
        return -1
    cell = row * tin.columns + column
    for k in range(tin.cell_start[cell], tin.cell_start[cell + 1]):
        facet = tin.cell_facet[k]
        corners = tin.corners[facet]
        ax, ay = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1]
        bx, by = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
        px, py = u - corners[0, 0], v - corners[0, 1]
        # the place is the first corner + s a + t b
        area = ax * by - ay * bx
        s, t = (px * by - py * bx) / area, (ax * py - ay * px) / area
        if s >= -EDGE_TOLERANCE and t >= -EDGE_TOLERANCE and s + t <= 1.0 + EDGE_TOLERANCE:
            return int(facet)
    return -1


@device
def surface_at(
    tin: Tin | None, field: Field | None, x: float, y: float
) -> tuple[float, float, float]:
    """Return height, dz/dx and dz/dy of a mesh or raster at a plan position; NaN if unknown."""
    if field is not None:
        return height_at(field, x, y)
    if tin is not None:
        facet = locate(tin, x, y)
        if facet >= 0:
            b, c = tin.planes[facet, 1], tin.planes[facet, 2]
            return tin.planes[facet, 0] + b * (x - tin.origin_x) + c * (y - tin.origin_y), b, c
    return np.nan, 0.0, 0.0


@kernel
def _set_heights(
    span: Span, tin: Tin | None, field: Field | None, x: FloatArray, y: FloatArray,
    height: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    for i in range(*span):
        height[i], slope[i, 0], slope[i, 1] = surface_at(tin, field, x[i], y[i])


SHEET_DISTANCE_M = 0.01  # overlapping facets are harmless if their heights differ by less


def in_two_sheets(tin: Tin) -> tuple[BoolArray, FloatArray]:
    """Return which facets have another above or below their centre, and all plan areas, m2.

    A height field has one height above each place, so that its mesh must be one sheet.
    """
    import shapely

    triangles, centres = shapely.polygons(tin.corners), tin.corners.mean(axis=1)
    tree = shapely.STRtree(triangles)
    facet, other = tree.query(shapely.points(centres), predicate="intersects")
    a, b, c = (tin.planes[other] - tin.planes[facet]).T
    u, v = centres[facet].T
    double = np.zeros(len(centres), np.bool_)
    double[facet[np.abs(a + (b * u + c * v)) > SHEET_DISTANCE_M]] = True
    return double, shapely.area(triangles)
