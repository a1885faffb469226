"""The frame of one lens in its camera frame: what lies around it, and how its image moves.

The border of the image is sent out through the lens, densely; where all of it is there, what it
encloses is the frame, as a lens is used only where it is one to one.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.lens.imaging import coefficients, project, unproject
from pcfix.lens.places import DISC, LARGEST_ANGLE
from pcfix.lens.projections import angle

if TYPE_CHECKING:
    from pcfix.model import FloatArray, Lens


class FrameShape(NamedTuple):
    """The frame of one lens, camera frame; see `Frames`."""

    planes: FloatArray
    distorted: bool
    widest: float
    reach: tuple[float, float]


@lru_cache(maxsize=8192)
def frame_shape(lens: Lens) -> FrameShape:
    """Return the frame of a lens."""
    if _is_a_pyramid(lens):
        return FrameShape(_frame_planes(lens), distorted=False, widest=np.pi, reach=(np.inf, 0.0))
    border = unproject(lens, _border(lens))
    return FrameShape(
        _planes_around(border),
        distorted=True,
        widest=_widest_angle(lens, border),
        reach=_reach(lens) if np.isfinite(border).all() else (np.inf, 0.0),
    )


def _is_a_pyramid(lens: Lens) -> bool:
    """Whether straight lines stay straight."""
    brown = (*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism)
    return lens.projection == "perspective" and not any(brown)


def _frame_planes(lens: Lens) -> FloatArray:
    """Return the inward normals of the frame of a lens without distortion, shape (4, 3)."""
    width, height = lens.width - lens.principal_x, lens.height - lens.principal_y
    return np.array([
        (lens.focal + lens.b1, lens.b2, lens.principal_x),
        (-(lens.focal + lens.b1), -lens.b2, width),
        (lens.b3, lens.focal, lens.principal_y),
        (-lens.b3, -lens.focal, height),
    ])  # fmt: skip


BORDER = 400
"""Points along each side of a frame; between neighbours it is taken to be nearly straight."""

STEEPEST = np.cos(np.radians(80.0))
"""A pyramid with flatter sides would be too long to be of use."""


def _border(lens: Lens) -> FloatArray:
    """Return points around the image, the first one again at the end."""
    w, h = lens.width, lens.height
    corners = np.array([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h), (0.0, 0.0)])
    share = np.linspace(0.0, 1.0, BORDER, endpoint=False)[:, None]
    sides = [(1.0 - share) * corners[i] + share * corners[i + 1] for i in range(4)]
    return np.vstack([*sides, corners[:1]])


def _widest_step(points: FloatArray) -> float:
    """Return the largest distance between neighbours; a curve strays less from its points."""
    return float(np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=1).max()))


def _planes_around(border: FloatArray) -> FloatArray:
    """Return a pyramid around the directions of the border, shape (4, 3)."""
    if not (border[:, 2] > STEEPEST).all():
        return np.zeros((4, 3))
    flat = border[:, :2] / border[:, 2:]
    step = _widest_step(flat)
    (left, top), (right, bottom) = flat.min(axis=0) - step, flat.max(axis=0) + step
    return np.array([
        (1.0, 0.0, -left), (-1.0, 0.0, right), (0.0, 1.0, -top), (0.0, -1.0, bottom),
    ])  # fmt: skip


def _widest_angle(lens: Lens, border: FloatArray) -> float:
    """Return an angle from the axis that no direction in the frame exceeds, radians."""
    if np.isfinite(border).all():
        widest = float(np.arccos(np.clip(border[:, 2].min(), -1.0, 1.0)))
        return widest + 2.0 * _widest_step(border)
    c = coefficients(lens)
    widest = float(angle(c, c[DISC] + np.hypot(*lens.distortion_centre)))
    if lens.inverse or np.isnan(widest):
        widest = float(c[LARGEST_ANGLE])
    return widest + 1e-6


MARGIN = 0.1
"""Of the longer side of the image."""

_GRID = 41
_SAFETY = 1.1  # the scale is smooth, and known at a grid of places


def _reach(lens: Lens) -> tuple[float, float]:
    """Return scale and margin; the margin is zero where part of it is beyond the fold."""
    margin = MARGIN * max(lens.width, lens.height)
    scale = _largest_scale(lens, margin)
    if np.isfinite(scale):
        return _SAFETY * scale, margin
    return _SAFETY * _largest_scale(lens, 0.0), 0.0


def _largest_scale(lens: Lens, margin: float) -> float:
    """Return the largest derivative of the image by an angle; infinite if a place has none."""
    u = np.linspace(-margin, lens.width + margin, _GRID)
    v = np.linspace(-margin, lens.height + margin, _GRID)
    d = unproject(lens, np.column_stack([np.repeat(u, _GRID), np.tile(v, _GRID)]))
    side = np.cross(d, np.where(np.abs(d[:, :1]) < 0.6, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    turn = 1e-6
    by_side, by_other = (
        (project(lens, d + turn * t) - project(lens, d - turn * t)) / (2.0 * turn)
        for t in (side, np.cross(d, side))
    )
    squares = (by_side**2 + by_other**2).sum(axis=1)
    det = by_side[:, 0] * by_other[:, 1] - by_side[:, 1] * by_other[:, 0]
    longest = np.sqrt(0.5 * (squares + np.sqrt(np.maximum(squares**2 - 4.0 * det**2, 0.0))))
    return np.inf if np.isnan(longest).any() else float(longest.max())
