"""From a direction in the camera frame to a place in the image, and back.

The formulas are those of `pcfix.model.Lens`. Both ways are used only where they are one to one:
a direction beyond the fold of the distortion, which would be bent back into the image, has no
place in it, and a place beyond the image of the fold has no direction. What is not there is NaN.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.lens import places
from pcfix.lens.brown import distorted, largest_disc, undistorted
from pcfix.lens.projections import CODES, angle, largest_angle, largest_radius, radius

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray, Lens

_KIND, _LARGEST_ANGLE, _INVERSE = places.KIND, places.LARGEST_ANGLE, places.INVERSE
_CENTRE_X, _CENTRE_Y = places.CENTRE_X, places.CENTRE_Y
_FOCAL_X, _B2, _B3, _FOCAL_Y = places.FOCAL_X, places.B2, places.B3, places.FOCAL_Y
_PRINCIPAL_X, _PRINCIPAL_Y = places.PRINCIPAL_X, places.PRINCIPAL_Y
_PERSPECTIVE = CODES["perspective"]


def project(lens: Lens, directions: FloatArray) -> FloatArray:
    """Return where directions meet the image.

    Parameters
    ----------
    lens : Lens
    directions : array, shape (n, 3)
        Camera frame, any length.

    Returns
    -------
    array, shape (n, 2)
        u, v in the unit of the lens, inside the frame or not; NaN where the lens has no image,
        as behind a perspective camera or beyond the fold of the distortion.
    """
    rows = np.ascontiguousarray(directions, np.float64).reshape(-1, 3)
    return _project(coefficients(lens), rows)


def unproject(lens: Lens, image_xy: FloatArray) -> FloatArray:
    """Return the directions that places in the image look to.

    Parameters
    ----------
    lens : Lens
    image_xy : array, shape (n, 2)
        u, v in the unit of the lens.

    Returns
    -------
    array, shape (n, 3)
        Unit vectors in the camera frame; NaN where nothing is imaged.
    """
    rows = np.ascontiguousarray(image_xy, np.float64).reshape(-1, 2)
    return _unproject(coefficients(lens), rows)


@lru_cache(maxsize=8192)
def coefficients(lens: Lens) -> FloatArray:
    """Return a lens as the flat array that the kernels take, see `pcfix.lens.places`."""
    c = np.zeros(places.TAIL)
    c[_KIND] = CODES[lens.projection]
    c[places.TANGENTIAL : places.TANGENTIAL + 4] = _filled(lens.tangential, 4)[:4]
    c[places.THIN_PRISM : places.THIN_PRISM + 4] = _filled(lens.thin_prism, 4)[:4]
    c[places.IN_TURN], c[_INVERSE] = lens.in_turn, lens.inverse
    c[_CENTRE_X : _CENTRE_Y + 1] = lens.distortion_centre
    c[_FOCAL_X : _FOCAL_Y + 1] = lens.focal + lens.b1, lens.b2, lens.b3, lens.focal
    c[_PRINCIPAL_X : _PRINCIPAL_Y + 1] = lens.principal_x, lens.principal_y
    c[places.WIDTH : places.HEIGHT + 1] = lens.width, lens.height
    c[places.PLAIN] = _is_plain(lens)
    c = _with_tail(c, lens)
    c[_LARGEST_ANGLE] = largest_angle(lens)
    c[places.LARGEST_RADIUS] = largest_radius(c)
    c[places.DISC] = largest_disc(lens, c)
    c.setflags(write=False)
    return c


def lens_table(lenses: tuple[Lens, ...]) -> tuple[IntArray, FloatArray]:
    """Return the coefficients of k lenses for kernels, equal lenses once.

    Returns
    -------
    row : array, shape (k,)
        Where the lens of each camera is in the table.
    table : array, shape (l, ...)
        See `pcfix.lens.places`; padded with zeros.
    """
    rows: dict[Lens, int] = {}
    row = np.array([rows.setdefault(lens, len(rows)) for lens in lenses])
    each = [coefficients(lens) for lens in rows]
    table = np.zeros((len(each), max(map(len, each))))
    for i, numbers in enumerate(each):
        table[i, : len(numbers)] = numbers
    return row, table


def _with_tail(c: FloatArray, lens: Lens) -> FloatArray:
    """Return the array with what has no fixed length at its end."""
    radial = _filled(lens.radial, places.LEAST_RADIALS)
    shape = _filled(lens.shape, places.LEAST_SHAPES)
    counts = len(radial), len(lens.denominator), len(shape)
    c[places.RADIALS : places.SHAPES + 1] = counts
    c[places.SHAPE] = places.TAIL + counts[0] + counts[1]
    return np.concatenate([c, radial, lens.denominator, shape])


def _filled(numbers: tuple[float, ...], least: int) -> tuple[float, ...]:
    """Return the numbers, with zeros up to the least length."""
    return (*numbers, *(0.0,) * (least - len(numbers)))


def _is_plain(lens: Lens) -> bool:
    beyond = (*lens.radial[4:], *lens.denominator, *lens.tangential[2:], *lens.thin_prism)
    return lens.projection == "perspective" and not (lens.inverse or lens.in_turn or any(beyond))


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def in_plane(c: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the plane coordinates of a direction, before distortion."""
    if c[_KIND] == _PERSPECTIVE:
        return (x / z, y / z) if z > 0.0 else (np.nan, np.nan)
    across = np.sqrt(x * x + y * y)
    theta = np.arctan2(across, z)
    if not theta <= c[_LARGEST_ANGLE]:
        return np.nan, np.nan
    if across == 0.0:
        return (0.0, 0.0) if z > 0.0 else (np.nan, np.nan)
    scale = radius(c, theta) / across
    return scale * x, scale * y


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def image_of(c: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Return u, v of one direction."""
    px, py = in_plane(c, x, y, z)
    cx, cy = c[_CENTRE_X], c[_CENTRE_Y]
    if c[_INVERSE] != 0.0:
        dx, dy = undistorted(c, px - cx, py - cy)
    else:
        dx, dy = distorted(c, px - cx, py - cy)
    dx, dy = dx + cx, dy + cy
    u = c[_PRINCIPAL_X] + c[_FOCAL_X] * dx + c[_B2] * dy
    return u, c[_PRINCIPAL_Y] + c[_FOCAL_Y] * dy + c[_B3] * dx


@njit(cache=True, error_model="numpy", nogil=True)
def direction_of(c: FloatArray, u: float, v: float) -> tuple[float, float, float]:
    """Return the unit direction of one place in the image."""
    cx, cy = c[_CENTRE_X], c[_CENTRE_Y]
    u, v = u - c[_PRINCIPAL_X], v - c[_PRINCIPAL_Y]
    det = c[_FOCAL_X] * c[_FOCAL_Y] - c[_B2] * c[_B3]
    dx = (c[_FOCAL_Y] * u - c[_B2] * v) / det - cx
    dy = (c[_FOCAL_X] * v - c[_B3] * u) / det - cy
    if c[_INVERSE] != 0.0:
        px, py = distorted(c, dx, dy)
    else:
        px, py = undistorted(c, dx, dy)
    px, py = px + cx, py + cy
    rho = np.sqrt(px * px + py * py)
    theta = angle(c, rho)
    scale = np.sin(theta) / rho if rho > 0.0 else 1.0
    return scale * px, scale * py, np.cos(theta)


@njit(cache=True, error_model="numpy", nogil=True)
def _project(c: FloatArray, directions: FloatArray) -> FloatArray:
    image = np.empty((len(directions), 2))
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        image[i, 0], image[i, 1] = image_of(c, x, y, z)
    return image


@njit(cache=True, error_model="numpy", nogil=True)
def _unproject(c: FloatArray, image: FloatArray) -> FloatArray:
    directions = np.empty((len(image), 3))
    for i in range(len(image)):
        x, y, z = direction_of(c, image[i, 0], image[i, 1])
        directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
    return directions
