"""Surveyed points that no adjustment can fit: mixed up, of another place, or wrongly marked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.adjust.fixed_poses import intersect_fixed, plain_block
from pcfix.errors import GeometryError

if TYPE_CHECKING:
    from pcfix.adjust.result import Adjusted
    from pcfix.model import BoolArray, Cameras, GroundControl

GROSS_SIGMAS, GROSS_PX = 20.0, 10.0
"""A control point that is off by more than both was not measured badly but mixed up."""

ELSEWHERE = 0.1
"""Of the flying height: no block is bent so far that a control point is off by as much."""

_REMEDY = (
    "Check its name, its coordinates and its marks; names that are swapped look like this. A point"
    " with the role check does not count."
)


def check_marks(
    control: GroundControl, cameras: Cameras, name: str, *, is_placed: bool = False
) -> None:
    """Refuse control points whose marks are somewhere else altogether, before any adjustment.

    Each point is intersected from the cameras as they came, with straight rays. All may lie off
    alike, as the block may where nothing else places it; one that lies elsewhere than the others
    was mixed up.

    Parameters
    ----------
    control : GroundControl
    cameras : Cameras
    name : str
        Of the file.
    is_placed : bool
        Whether GNSS positions say already where the block is.

    Raises
    ------
    GeometryError
        Naming the point that is farthest off.
    """
    order = np.argsort(control.point, kind="stable")
    start = np.searchsorted(control.point[order], np.arange(len(control.names) + 1))
    camera, marks = control.camera[order], control.image_xy[order]
    wet = np.zeros(len(control.names), np.bool_)
    found = intersect_fixed(plain_block(cameras, control.xyz, start, camera, marks, None, 1.0, wet))
    met = np.isfinite(found.squares) & (np.diff(start) >= 2) & ~control.is_check
    if met.sum() < 3:
        return
    off = found.xyz - control.xyz
    apart = np.linalg.norm(off - np.median(off[met], axis=0), axis=1)
    height = float(np.median(cameras.centres[:, 2]) - np.median(control.xyz[:, 2]))
    middle = np.median(off[met], axis=0)
    if is_placed and np.abs(middle).max() > ELSEWHERE * height > 0.0:
        x, y, z = (-middle).tolist()
        raise GeometryError(
            f"{name}: the control points lie {x:.1f}, {y:.1f}, {z:.1f} m (x, y, z; the median) from"
            " where their marks meet, but the GNSS positions say that the block lies right: one of"
            " the two is in another CRS or height datum; name it with --gcps-crs or --gnss-crs."
        )
    worst = int(np.argmax(np.where(met, apart, 0.0)))
    if not apart[worst] > ELSEWHERE * height > 0.0:
        return
    raise GeometryError(
        f"{name}: control point {control.names[worst]} does not fit: its marks meet"
        f" {apart[worst]:.1f} m from its coordinates, the other points taken as right. {_REMEDY}"
    )


def check_control(found: Adjusted, name: str) -> None:
    """Refuse control points that are off by far more than they were measured to.

    The adjustment shares a gross error out between the place of the point and its marks, so that
    both count: the place as it shows in the images.

    Raises
    ------
    GeometryError
        Naming the point that is farthest off.
    """
    block = found.block
    first = len(block.xyz) - len(block.control_names)
    rows = np.flatnonzero(block.is_surveyed[first:])
    if len(rows) == 0:
        return
    px, sigmas = (
        np.array(v) for v in zip(*(_off(found, first + int(i)) for i in rows), strict=True)
    )
    gross = (px > GROSS_PX) & (sigmas > GROSS_SIGMAS)
    if not gross.any():
        return
    worst = int(np.argmax(np.where(gross, px, 0.0)))
    others = int(gross.sum()) - 1
    more = f" ({others} more are off as well)" if others else ""
    raise GeometryError(
        f"{name}: control point {block.control_names[rows[worst]]} does not fit: it is off by"
        f" {px[worst]:.0f} px, {sigmas[worst]:.0f} standard deviations{more}. {_REMEDY}"
    )


def _off(found: Adjusted, point: int) -> tuple[float, float]:
    """Return by how much a control point is off in the images, and in standard deviations."""
    block = found.block
    mine = slice(block.start[point], block.start[point + 1])
    sigma_px = block.sigma_px[mine]
    seen = np.isfinite(found.residual_px[mine]).all(axis=1) & np.isfinite(sigma_px)
    if not seen.any():
        return 0.0, 0.0
    marks = np.linalg.norm(found.residual_px[mine][seen], axis=1)
    moved = found.xyz[point] - block.surveyed_xyz[point]
    known = np.isfinite(block.surveyed_sigma_m[point])
    place = np.where(known, moved, 0.0)
    px = float(marks.max() + np.linalg.norm(place) * _px_per_metre(found, point, mine, seen))
    of_place = np.abs(place[known] / block.surveyed_sigma_m[point][known]).max(initial=0.0)
    return px, float(max((marks / sigma_px[seen]).max(), of_place))


def _px_per_metre(found: Adjusted, point: int, mine: slice, seen: BoolArray) -> float:
    camera = found.block.camera[mine][seen]
    away = np.linalg.norm(found.cameras.centres[camera] - found.xyz[point], axis=1)
    focal = np.array([lens.focal for lens in found.cameras.lenses or ()])[camera]
    return float(np.median(focal / away))
