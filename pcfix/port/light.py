"""The light through the port of a housing: from a point to its image, and back out.

Everything is in the camera frame, with the projection centre as the origin: metres, x right, y
down, z forward. Two questions are answered for each kind of port:

`through_port`: a point in the water is given. In which direction w does its light come to the
projection centre? A lens images the point where it images w. With the derivatives by the point and
by the refractive index of the water, which a bundle adjustment needs.

`ray_through`: a direction is given that the lens looks to. Where does that ray leave the port, and
how does it go on through the water?

The two are solved apart, the first by an equation in one unknown, the second by Snell's law at one
face after the other, so that each proves the other right.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.port.dome import cosine_at_dome, ray_through_dome, through_dome
from pcfix.port.faces import dot, unit
from pcfix.port.flat import ray_through_flat, through_flat
from pcfix.port.shapes import DomePort, FlatPort

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.port.faces import Ray
    from pcfix.port.shapes import Port

KIND, X, Y, Z, SIZE, THICK, GLASS = range(7)
FLAT, DOME = 0.0, 1.0


def coefficients(port: Port) -> FloatArray:
    """Return a port as the flat array that the kernels take, shape (7,).

    Kind; x, y, z of the normal or of the centre; distance or radius; thickness; glass index.
    """
    match port:
        case FlatPort(distance, thickness, glass, normal):
            c = [FLAT, *normal, distance, thickness, glass]
        case DomePort(radius, thickness, glass, centre):
            c = [DOME, *centre, radius, thickness, glass]
    return np.array(c, np.float64)


@njit(cache=True, error_model="numpy", nogil=True)
def through_port(port: FloatArray, n: float, x: float, y: float, z: float, out: FloatArray) -> None:
    """Find in which direction the light of a point comes to the projection centre.

    Parameters
    ----------
    port : array, shape (7,)
        See `coefficients`.
    n : float
        Refractive index of the water relative to air, at least 1.
    x, y, z : float
        The point, in the water outside of the port; camera frame, metres.
    out : array, shape (3, 5)
        Filled. Column 0 is the direction w, camera frame, of any length; columns 1 to 3 are the
        derivatives of w by x, y, z; column 4 is that by n. NaN where the point is not outside of
        the port, or no light comes from it.
    """
    where = port[X], port[Y], port[Z]
    size, thickness, glass = port[SIZE], port[THICK], port[GLASS]
    if port[KIND] == FLAT:
        through_flat(where, size, thickness, glass, n, (x, y, z), out)
    else:
        through_dome(where, size, thickness, glass, n, (x, y, z), out)


@njit(cache=True, error_model="numpy", nogil=True)
def ray_through(port: FloatArray, n: float, dx: float, dy: float, dz: float) -> Ray:
    """Return how a ray from the projection centre goes on in the water.

    Parameters
    ----------
    port, n
        As of `through_port`.
    dx, dy, dz : float
        Direction at the projection centre, camera frame, of any length.

    Returns
    -------
    Ray
        Where the ray leaves the outer face (metres) and its unit direction in the water, camera
        frame; NaN where it does not meet the port.
    """
    where = port[X], port[Y], port[Z]
    size, thickness, glass = port[SIZE], port[THICK], port[GLASS]
    if port[KIND] == FLAT:
        return ray_through_flat(where, size, thickness, glass, n, (dx, dy, dz))
    return ray_through_dome(where, size, thickness, glass, n, (dx, dy, dz))


@njit(cache=True, error_model="numpy", nogil=True)
def cosine_at_port(port: FloatArray, dx: float, dy: float, dz: float) -> float:
    """Return the cosine of the angle of incidence in air at the inner face.

    The parameters are those of `ray_through`.
    """
    where = port[X], port[Y], port[Z]
    if port[KIND] == FLAT:
        return dot(where, unit((dx, dy, dz)))
    return cosine_at_dome(where, port[SIZE], (dx, dy, dz))
