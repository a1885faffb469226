r"""Find the true point behind a port from which software would have made the apparent one.

As `pcfix.refract.consistent` does it at a water surface: software that knows nothing of the port
makes of the image points x_i of a true point Q the point P with the least squared residuals in the
images, over straight rays. There the derivative by P is zero,

    g(Q) = sum_i J_i' (x_i(Q) - pi_i(P)) = 0,    J_i = d pi_i / d P

with pi_i the projection of camera i, three equations for the three unknowns of Q. Here x_i(Q) is
the image of the direction in which the light of Q comes through the port, and

    d g / d Q = sum_i J_i' K_i R_i,    K_i = d x_i / d w  d w / d X

comes with it from `pcfix.port.light.through_port`: Newton's method.

The covariance of Q is that of an adjustment of the images through the port,

    Cov Q = H^-1 (sum_i L_i' Cov(x_i) L_i) H^-1,    L_i = K_i R_i,  H = sum_i L_i' L_i

and a column for the refractive index, whose error all rays have in common.
"""

from __future__ import annotations

import warnings

import numpy as np
from numba import njit, prange

from pcfix.errors import PcfixWarning
from pcfix.lens.imaging import image_and_gradients, lens_table
from pcfix.model import (
    NOMINAL_FOCAL_PX,
    NOMINAL_WIDTH_PX,
    BoolArray,
    Cameras,
    FloatArray,
    IntArray,
    Lens,
    Outcome,
    Views,
)
from pcfix.options.correct import ScienceOptions
from pcfix.port.intersection import in_camera
from pcfix.port.light import coefficients, through_port
from pcfix.port.shapes import Port
from pcfix.refract.batch import Intersection
from pcfix.refract.consistent import check_consistent
from pcfix.threads import one_caller

MAX_STEPS = 30
CLOSE_M = 1e-7
"""Of a step; as each squares the error, the next would be below a nanometre."""


def consistent_through_port(
    xyz: FloatArray,
    views: Views,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    start: Intersection,
) -> Intersection:
    """Move points so that straight rays to the true ones' images meet in the apparent ones.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Apparent points, metres, world frame.
    views : Views
        Their cameras.
    cameras, port, settings
        As of `pcfix.port.methods.intersect_through_port`.
    start : Intersection
        What `snell` makes of them, from where the search begins.

    Returns
    -------
    Intersection
        `start` with other shifts.

    Raises
    ------
    SettingError
        If the cameras have no angles or no lenses.

    Warns
    -----
    PcfixWarning
        Of points for which no true point was found; they get the solution of `snell`.
    """
    check_consistent(cameras)
    moved = np.flatnonzero(start.outcome == Outcome.CORRECTED)
    shift, found = start.shift_m.copy(), np.zeros(len(moved), np.bool_)
    with one_caller():
        _search_all(
            moved,
            np.ascontiguousarray(xyz),
            *_rows(views),
            *_block(cameras),
            coefficients(port),
            settings.refractive_index,
            shift,
            found,
        )
    if not found.all():
        warnings.warn(
            f"method consistent found no solution behind the port for {int((~found).sum()):,} of"
            f" {len(moved):,} points; they have that of snell.",
            PcfixWarning,
            stacklevel=3,
        )
    return start._replace(shift_m=shift)


def port_covariances(
    true_xyz: FloatArray, views: Views, cameras: Cameras, port: Port, settings: ScienceOptions
) -> FloatArray:
    """Return the covariance of points behind a port.

    Parameters
    ----------
    true_xyz : array, shape (m, 3)
        Metres, world frame.
    views, cameras, port, settings
        As of `consistent_through_port`; of the standard deviations those of the images, the
        refractive index, the projection centres and the attitudes count. There is no surface to
        err.

    Returns
    -------
    array, shape (m, 6)
        xx, xy, xz, yy, yz, zz in metres squared, world frame; zeros where fewer than two rays
        meet. Cameras without a lens stand in with that of a survey drone.
    """
    result = np.zeros((len(true_xyz), 6))
    with one_caller():
        _covariances(
            np.ascontiguousarray(true_xyz),
            *_rows(views),
            *_block(cameras),
            coefficients(port),
            settings.refractive_index,
            settings.sigma_image * _pixels(cameras),
            settings.sigma_index,
            settings.sigma_centre,
            float(np.radians(settings.sigma_attitude)),
            result,
        )
    return result


def _rows(views: Views) -> tuple[IntArray, IntArray]:
    start = np.ascontiguousarray(views.start, np.int64)
    return start, np.ascontiguousarray(views.camera, np.int64)


_NOMINAL = Lens(NOMINAL_FOCAL_PX, NOMINAL_WIDTH_PX, NOMINAL_WIDTH_PX, 0.0, 0.0)


def _lenses(cameras: Cameras) -> tuple[Lens, ...]:
    return cameras.lenses or (_NOMINAL,) * len(cameras)


def _block(cameras: Cameras) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
    """Return centres, rotations, and the lens of each camera with the table of them."""
    centres = np.ascontiguousarray(cameras.centres)
    return centres, np.ascontiguousarray(cameras.rotations), *lens_table(_lenses(cameras))


def _pixels(cameras: Cameras) -> FloatArray:
    """Return how long a pixel is in the unit of each camera's lens, shape (k,)."""
    return np.array([lens.pixel_size for lens in _lenses(cameras)])


@njit(cache=True, error_model="numpy", nogil=True)
def _image_through(
    x: float, y: float, z: float, r: FloatArray, lens: FloatArray, port: FloatArray, n: float,
    out: FloatArray, image: FloatArray,
) -> None:  # fmt: skip
    """Fill in where a camera images what lies at C + (x, y, z) through the port.

    `image`, shape (2, 8): the place, its derivatives by the point in the world and in the frame of
    the camera, and by n.
    """
    through_port(port, n, *in_camera(r, x, y, z), out)
    u, v, g = image_and_gradients(lens, out[0, 0], out[1, 0], out[2, 0])
    image[0, 0], image[1, 0] = u, v
    for a in range(2):
        gx, gy, gz = g[3 * a], g[3 * a + 1], g[3 * a + 2]
        for j in range(1, 5):
            image[a, 3 + j] = gx * out[0, j] + gy * out[1, j] + gz * out[2, j]
        for axis in range(3):
            image[a, 1 + axis] = (
                image[a, 4] * r[0, axis] + image[a, 5] * r[1, axis] + image[a, 6] * r[2, axis]
            )


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _search_all(
    moved: IntArray, xyz: FloatArray, start: IntArray, camera: IntArray, centres: FloatArray,
    rotations: FloatArray, row: IntArray, lenses: FloatArray, port: FloatArray, n: float,
    shift: FloatArray, found: BoolArray,
) -> None:  # fmt: skip
    """Search each point; one that is not found keeps its shift."""
    for m in prange(moved.size):
        i = moved[m]
        mine = camera[start[i] : start[i + 1]]
        found[m] = _search(shift[i], xyz[i], mine, centres, rotations, row, lenses, port, n)


@njit(cache=True, error_model="numpy", nogil=True)
def _search(
    shift: FloatArray, point: FloatArray, mine: IntArray, centres: FloatArray,
    rotations: FloatArray, row: IntArray, lenses: FloatArray, port: FloatArray, n: float,
) -> bool:  # fmt: skip
    """Move a point to where g is zero; whether it was reached."""
    q = shift.copy()
    out, image, g, slope = np.empty((3, 5)), np.empty((2, 8)), np.empty(3), np.empty((3, 3))
    for _ in range(MAX_STEPS):
        g[:], slope[:] = 0.0, 0.0
        for c in mine:
            r, lens = rotations[c], lenses[row[c]]
            x, y, z = point[0] - centres[c, 0], point[1] - centres[c, 1], point[2] - centres[c, 2]
            u, v, (ux, uy, uz, vx, vy, vz) = image_and_gradients(lens, *in_camera(r, x, y, z))
            _image_through(x + q[0], y + q[1], z + q[2], r, lens, port, n, out, image)
            du, dv = image[0, 0] - u, image[1, 0] - v
            for a in range(3):
                ju = ux * r[0, a] + uy * r[1, a] + uz * r[2, a]
                jv = vx * r[0, a] + vy * r[1, a] + vz * r[2, a]
                g[a] += ju * du + jv * dv
                for b in range(3):
                    slope[a, b] += ju * image[0, 1 + b] + jv * image[1, 1 + b]
        if not (np.isfinite(g).all() and np.linalg.det(slope) != 0.0):
            return False
        step = np.linalg.solve(slope, g)
        q -= step
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        if size <= CLOSE_M:
            shift[:] = q
            return True
    return False


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _covariances(
    xyz: FloatArray, start: IntArray, camera: IntArray, centres: FloatArray, rotations: FloatArray,
    row: IntArray, lenses: FloatArray, port: FloatArray, n: float, sigma_image: FloatArray,
    sigma_n: float, sigma_centre: float, sigma_attitude: float, result: FloatArray,
) -> None:  # fmt: skip
    """Sum up H, the noise and the column of n over the rays of each point, and solve."""
    for i in prange(len(xyz)):
        mine = camera[start[i] : start[i + 1]]
        out, image, w = np.empty((3, 5)), np.empty((2, 8)), np.empty((2, 2))
        h, noise, by_n = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
        for c in mine:
            x, y, z = (
                xyz[i, 0] - centres[c, 0],
                xyz[i, 1] - centres[c, 1],
                xyz[i, 2] - centres[c, 2],
            )
            _image_through(x, y, z, rotations[c], lenses[row[c]], port, n, out, image)
            _image_noise(
                w, image, in_camera(rotations[c], x, y, z), sigma_image[c], sigma_centre,
                sigma_attitude,
            )  # fmt: skip
            for a in range(3):
                ju, jv = image[0, 1 + a], image[1, 1 + a]
                by_n[a] += ju * image[0, 7] + jv * image[1, 7]
                for b in range(3):
                    u, v = image[0, 1 + b], image[1, 1 + b]
                    h[a, b] += ju * u + jv * v
                    noise[a, b] += ju * (w[0, 0] * u + w[0, 1] * v) + jv * (
                        w[1, 0] * u + w[1, 1] * v
                    )
        if mine.size < 2 or not (np.isfinite(h).all() and np.linalg.det(h) > 0.0):
            continue
        inverse = np.linalg.inv(h)
        column = sigma_n * (inverse @ by_n)
        full = inverse @ noise @ inverse
        at = 0
        for a in range(3):
            for b in range(a, 3):
                result[i, at] = full[a, b] + column[a] * column[b]
                at += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _image_noise(
    w: FloatArray, image: FloatArray, seen: tuple[float, float, float], sigma_image: float,
    sigma_centre: float, sigma_attitude: float,
) -> None:  # fmt: skip
    """Fill in the covariance of one image place: its own, and that of what the pose errs.

    A camera that moves sees the point move the other way; one that turns about its centre takes
    the port along, and sees the point X move by X x omega.
    """
    x, y, z = seen
    for a in range(2):
        for b in range(2):
            gx, gy, gz, kx, ky, kz = (
                image[a, 4], image[a, 5], image[a, 6], image[b, 4], image[b, 5], image[b, 6]
            )  # fmt: skip
            moving = gx * kx + gy * ky + gz * kz
            turning = (
                (gy * z - gz * y) * (ky * z - kz * y)
                + (gz * x - gx * z) * (kz * x - kx * z)
                + (gx * y - gy * x) * (kx * y - ky * x)
            )
            w[a, b] = sigma_centre**2 * moving + sigma_attitude**2 * turning
        w[a, a] += sigma_image**2
