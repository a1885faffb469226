r"""One ray's part in how a corrected point moves with whatever it was made from.

Picture one ray in the frame of the surface above the point: N is up, the other two axes lie in
the surface. From the apparent point P to the projection centre is e, of length L, with the height
H above P and (a, b), of length rho, across. The surface is h above P; the true point lies y below
it. With r = 1 / n and kappa = sqrt(L^2 - r^2 (L^2 - H^2)) the refracted ray is t = -(r a, r b,
kappa) / L, and at depth y it is m (a, b) away from P, with

    m = h / H - y r / kappa.

All that can be wrong moves this place, at a fixed y, by some delta. The intersection of eq 11 of
Skarlatos & Agrafiotis 2018 then moves by (sum M)^-1 sum M delta, with M = I - t t'. Differentiated
(E = M (a, b, 0) throughout):

=================  ============================================================================
by                 M delta
=================  ============================================================================
P across, p        (1 - m) M p + beta ((a, b).p) E,  beta = -y r (1 - r^2) / kappa^3
P up               alpha E,  alpha = -(1 - h/H) / H - y r H / kappa^3
h                  (1 / H - r / kappa) E
n                  y r^2 L^2 / kappa^3 E
slope, N + tau     -y (1 - r H / kappa) M tau + (gamma + m r / kappa) ((a, b).tau) E,
                   gamma = y r^3 H / kappa^3 - h / H^2 (about the place above P)
=================  ============================================================================

What is left out is the turn of M times the distance of a ray from the point, which is of second
order.

The functions hold arithmetic only, see `pcfix.refract.rays`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.refract.choice import TILE

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray

# Runs of `TILE` numbers in `tile`: those of `pcfix.refract.choice.gather`, then these.
UX, UZ, VX, VY, VZ, BELOW = range(7, 13)
RUNS = 13

# Runs of `TILE` numbers in `sums`.
RAYS = 0
TT = 1  # xx, xy, xz, yy, yz of t t'
BY_P = 6  # three columns
BY_N = 15
BY_LEVEL = 18
SIGHT = 21  # xx, xy, xz, yy, yz, zz of the normal matrix of the straight rays, world frame
BY_TILT = 27  # two columns
NOISE = 33  # six, world frame
SUMS = 39


@njit(cache=True, error_model="numpy", nogil=True)
def add_frames(tile: FloatArray, shift: FloatArray, rows: IntArray) -> None:
    """Add to a tile the axes in the surface, and how far below P the true point lies."""
    for j in range(rows.size):
        nx, ny, nz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        scale = 1.0 / np.sqrt(nx * nx + nz * nz)
        ux, uz = nz * scale, -nx * scale
        tile[UX * TILE + j], tile[UZ * TILE + j] = ux, uz
        tile[VX * TILE + j] = ny * uz
        tile[VY * TILE + j] = nz * ux - nx * uz
        tile[VZ * TILE + j] = -ny * ux
        i = rows[j]
        tile[BELOW * TILE + j] = -(nx * shift[i, 0] + ny * shift[i, 1] + nz * shift[i, 2])


@njit(cache=True, error_model="numpy", nogil=True)
def add_rays(
    sums: FloatArray, tile: FloatArray, marks: FloatArray,
    centre: FloatArray, axis: FloatArray, focal_px: float, offset: float,
    least_cosine2: float, r: float,
) -> None:  # fmt: skip
    """Add one camera's rays to the sums of a tile's points with a mark above zero.

    The normal matrix of a straight ray is that of a central projection with the optical axis z,
    J'J = (f / Z)^2 (I + (z e' + e z') / Z + L^2 / Z^2 z z') with Z = -z.e; without an axis
    (zeros) it is that of angles, (f / L)^2 (I - e e' / L^2).
    """
    cx, cy, cz = centre[0], centre[1], centre[2]
    zx, zy, zz = axis[0], axis[1], axis[2]
    flat = zx != 0.0 or zy != 0.0 or zz != 0.0
    square = focal_px * focal_px
    for j in range(marks.size):
        z = tile[2 * TILE + j]
        ex, ey, ez = cx - tile[j], cy - tile[TILE + j], cz - z
        nx, ny, nz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        height = nx * ex + ny * ey + nz * ez
        h = nz * (tile[3 * TILE + j] - (z - offset))
        length2 = ex * ex + ey * ey + ez * ez
        use = (marks[j] > 0.0) & (height > h) & (height * height >= least_cosine2 * length2)
        one = 1.0 if use else 0.0
        # a ray that is not used adds zeros
        height = height if use else 1.0
        length2 = length2 if use else 1.0
        a = tile[UX * TILE + j] * ex + tile[UZ * TILE + j] * ez
        b = tile[VX * TILE + j] * ex + tile[VY * TILE + j] * ey + tile[VZ * TILE + j] * ez
        a, b = a * one, b * one
        y = h + tile[BELOW * TILE + j]
        bend = r if h > 0.0 else 1.0
        rho2 = a * a + b * b
        kappa2 = height * height + (1.0 - bend * bend) * rho2
        inv2 = 1.0 / length2
        inv_h = 1.0 / height
        inv_k2 = 1.0 / kappa2
        inv_k = np.sqrt(inv_k2)
        f = h * inv_h
        lean = bend * inv_k
        m = f - y * lean
        ta, tb = bend * a * inv2, bend * b * inv2
        kappa = kappa2 * inv_k
        across_x, across_y, across_z = (
            kappa2 * a * inv2,
            kappa2 * b * inv2,
            -kappa * ta * a - kappa * tb * b,
        )
        xx, xy, xz = bend * a * ta, bend * a * tb, kappa * ta
        yy, yz = bend * b * tb, kappa * tb
        beta = -y * lean * (1.0 - bend * bend) * inv_k2
        alpha = -(1.0 - f) * inv_h - y * lean * height * inv_k2
        by_n = y * bend * lean * length2 * inv_k2 if h > 0.0 else 0.0
        by_level = inv_h - lean
        away = (1.0 - m) * one
        sums[RAYS * TILE + j] += one
        sums[TT * TILE + j] += xx
        sums[(TT + 1) * TILE + j] += xy
        sums[(TT + 2) * TILE + j] += xz
        sums[(TT + 3) * TILE + j] += yy
        sums[(TT + 4) * TILE + j] += yz
        sums[BY_P * TILE + j] += away * (1.0 - xx) + beta * a * across_x
        sums[(BY_P + 1) * TILE + j] += beta * a * across_y - away * xy
        sums[(BY_P + 2) * TILE + j] += beta * a * across_z - away * xz
        sums[(BY_P + 3) * TILE + j] += beta * b * across_x - away * xy
        sums[(BY_P + 4) * TILE + j] += away * (1.0 - yy) + beta * b * across_y
        sums[(BY_P + 5) * TILE + j] += beta * b * across_z - away * yz
        sums[(BY_P + 6) * TILE + j] += alpha * across_x
        sums[(BY_P + 7) * TILE + j] += alpha * across_y
        sums[(BY_P + 8) * TILE + j] += alpha * across_z
        sums[BY_N * TILE + j] += by_n * across_x
        sums[(BY_N + 1) * TILE + j] += by_n * across_y
        sums[(BY_N + 2) * TILE + j] += by_n * across_z
        sums[BY_LEVEL * TILE + j] += by_level * across_x
        sums[(BY_LEVEL + 1) * TILE + j] += by_level * across_y
        sums[(BY_LEVEL + 2) * TILE + j] += by_level * across_z
        forward = zx * ex + zy * ey + zz * ez if use and flat else -1.0
        inv_z = -1.0 / forward if flat else 0.0
        w0 = square * (inv_z * inv_z if flat else inv2) * one
        w1 = w0 * inv_z
        w2 = w1 * inv_z * length2
        w3 = 0.0 if flat else -w0 * inv2
        sums[SIGHT * TILE + j] += w0 + 2.0 * w1 * zx * ex + w2 * zx * zx + w3 * ex * ex
        sums[(SIGHT + 1) * TILE + j] += w1 * (zx * ey + zy * ex) + w2 * zx * zy + w3 * ex * ey
        sums[(SIGHT + 2) * TILE + j] += w1 * (zx * ez + zz * ex) + w2 * zx * zz + w3 * ex * ez
        sums[(SIGHT + 3) * TILE + j] += w0 + 2.0 * w1 * zy * ey + w2 * zy * zy + w3 * ey * ey
        sums[(SIGHT + 4) * TILE + j] += w1 * (zy * ez + zz * ey) + w2 * zy * zz + w3 * ey * ez
        sums[(SIGHT + 5) * TILE + j] += w0 + 2.0 * w1 * zz * ez + w2 * zz * zz + w3 * ez * ez


@njit(cache=True, error_model="numpy", nogil=True)
def add_rare(
    sums: FloatArray, tile: FloatArray, marks: FloatArray,
    centre: FloatArray, axis: FloatArray, focal_px: float, offset: float,
    least_cosine2: float, r: float,
    centre_m: float, attitude: float, waves: float, image_px: float,
) -> None:  # fmt: skip
    """Add what only a budget with tilt, waves or errors of pose needs.

    An error that moves the straight ray at P by z, of covariance S, moves its image by J z and
    adds W S W to the noise of the normal equations, W = J'J. A turned camera has S = attitude^2
    L^2 times what is across the ray, a moved one centre_m^2. A wave of slope tau at the piercing
    point moves the refracted ray at depth y by -c (tau + r^2 / kappa^2 (a, b) ((a, b).tau)), with
    c = y (1 - r H / kappa); back at P, which moves the refracted ray by (1 - m) and beta as in the
    table above, that is c_t across (a, b) and c_r along.
    """
    cx, cy, cz = centre[0], centre[1], centre[2]
    zx, zy, zz = axis[0], axis[1], axis[2]
    flat = zx != 0.0 or zy != 0.0 or zz != 0.0
    square = focal_px * focal_px
    for j in range(marks.size):
        z = tile[2 * TILE + j]
        ex, ey, ez = cx - tile[j], cy - tile[TILE + j], cz - z
        nx, ny, nz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        height = nx * ex + ny * ey + nz * ez
        h = nz * (tile[3 * TILE + j] - (z - offset))
        length2 = ex * ex + ey * ey + ez * ez
        if not ((marks[j] > 0.0) & (height > h) & (height * height >= least_cosine2 * length2)):
            continue
        a = tile[UX * TILE + j] * ex + tile[UZ * TILE + j] * ez
        b = tile[VX * TILE + j] * ex + tile[VY * TILE + j] * ey + tile[VZ * TILE + j] * ez
        y = h + tile[BELOW * TILE + j]
        bend = r if h > 0.0 else 1.0
        rho2 = a * a + b * b
        kappa2 = height * height + (1.0 - bend * bend) * rho2
        kappa = np.sqrt(kappa2)
        lean = bend / kappa
        m = h / height - y * lean
        inv2 = 1.0 / length2
        ta, tb = bend * a * inv2, bend * b * inv2
        across_x, across_y = kappa2 * a * inv2, kappa2 * b * inv2
        across_z = -kappa * (ta * a + tb * b)
        turn = -y * (1.0 - height * lean)
        along = y * bend * bend * lean * height / kappa2 - h / (height * height) + m * lean
        sums[BY_TILT * TILE + j] += turn * (1.0 - bend * a * ta) + along * a * across_x
        sums[(BY_TILT + 1) * TILE + j] += along * a * across_y - turn * bend * a * tb
        sums[(BY_TILT + 2) * TILE + j] += along * a * across_z - turn * kappa * ta
        sums[(BY_TILT + 3) * TILE + j] += along * b * across_x - turn * bend * a * tb
        sums[(BY_TILT + 4) * TILE + j] += turn * (1.0 - bend * b * tb) + along * b * across_y
        sums[(BY_TILT + 5) * TILE + j] += along * b * across_z - turn * kappa * tb

        inv_z = -1.0 / (zx * ex + zy * ey + zz * ez) if flat else 0.0
        w0 = square * (inv_z * inv_z if flat else inv2)
        w1 = w0 * inv_z
        w2 = w1 * inv_z * length2
        w3 = 0.0 if flat else -w0 * inv2
        xx = w0 + 2.0 * w1 * zx * ex + w2 * zx * zx + w3 * ex * ex
        xy = w1 * (zx * ey + zy * ex) + w2 * zx * zy + w3 * ex * ey
        xz = w1 * (zx * ez + zz * ex) + w2 * zx * zz + w3 * ex * ez
        yy = w0 + 2.0 * w1 * zy * ey + w2 * zy * zy + w3 * ey * ey
        yz = w1 * (zy * ez + zz * ey) + w2 * zy * zz + w3 * ey * ez
        wz = w0 + 2.0 * w1 * zz * ez + w2 * zz * zz + w3 * ez * ez
        beta = -y * lean * (1.0 - bend * bend) / kappa2
        c_t = turn / (1.0 - m)
        c_r = c_t * (1.0 + bend * bend * rho2 / kappa2) / (1.0 + beta * rho2 / (1.0 - m))
        c_t, c_r = waves * waves * c_t * c_t, waves * waves * c_r * c_r
        g0 = image_px * image_px
        g1 = attitude * attitude * length2 + centre_m * centre_m + c_t
        # W (a, b) = -H W N, as W e = 0; straight down there is no along
        g2 = (c_r - c_t) * height * height / rho2 - c_t if rho2 > 1e-12 * length2 else -c_t
        ux, uy, uz = (
            xx * nx + xy * ny + xz * nz,
            xy * nx + yy * ny + yz * nz,
            xz * nx + yz * ny + wz * nz,
        )
        sums[NOISE * TILE + j] += g0 * xx + g1 * (xx * xx + xy * xy + xz * xz) + g2 * ux * ux
        sums[(NOISE + 1) * TILE + j] += g0 * xy + g1 * (xx * xy + xy * yy + xz * yz) + g2 * ux * uy
        sums[(NOISE + 2) * TILE + j] += g0 * xz + g1 * (xx * xz + xy * yz + xz * wz) + g2 * ux * uz
        sums[(NOISE + 3) * TILE + j] += g0 * yy + g1 * (xy * xy + yy * yy + yz * yz) + g2 * uy * uy
        sums[(NOISE + 4) * TILE + j] += g0 * yz + g1 * (xy * xz + yy * yz + yz * wz) + g2 * uy * uz
        sums[(NOISE + 5) * TILE + j] += g0 * wz + g1 * (xz * xz + yz * yz + wz * wz) + g2 * uz * uz
