r"""One ray's part in how a corrected point moves with whatever it was made from.

Picture one ray in the frame of the surface above the apparent point P: N is up, the other two axes
lie in the surface. From P to the projection centre is e, of length L, with the height H above P
and d = e - H N, of length rho, across. The surface is h above P; the true point Q lies y below it.
With r = 1 / n and kappa = sqrt(L^2 - r^2 rho^2) the refracted ray is t = -(r d + kappa N) / L, and
at depth y it is m d away from P, with

    m = h / H - y r / kappa.

All that can be wrong moves this place, at a fixed y, by some delta across:

=====================  ========================================================================
by                     delta
=====================  ========================================================================
P across, p            D p = (1 - m) p + beta (d.p) d,  beta = -y r (1 - r^2) / kappa^3
P up                   -D d / H
h                      (1 / H - r / kappa) d
n                      y r^2 L^2 / kappa^3 d
slope, N + tau         -y (1 - r H / kappa) tau + (gamma + m r / kappa) (d.tau) d,
                       gamma = y r^3 H / kappa^3 - h / H^2 (about the place above P)
=====================  ========================================================================

What a delta of each ray does to Q depends on what Q is the least of.

*In space* (`snell`) that is the squared distances from the refracted rays, eq 11 of Skarlatos &
Agrafiotis 2018. With M = I - t t'

    dQ = (sum M)^-1 sum M delta,    M d = E = (kappa^2 d - r kappa rho^2 N) / L^2.

*In images* (`consistent`) the residuals are those at P: sum J' (x(Q) - pi(P)) = 0. A Q that is off
its ray, by T Q = Q - (N.Q) (N + (r / kappa) d) at its own depth, is seen where P would be after a
move of D^-1 T Q. With W = J'J and S = W D^-1, D^-1 across as in the table,

    dQ = (sum S T)^-1 sum S delta,    S d = -H W N / (1 - m + beta rho^2)

as W e = 0. Q does not depend on P but through pi(P): dQ / dP = (sum S T)^-1 sum W.

What is left out is the turn of M, and of J, times the residual, which is of second order.

The functions hold arithmetic only, see `pcfix.refract.rays`; all sums are in the world frame.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Symmetric, Vector, beyond, dot, minus, plus, product, row_of, scaled
from pcfix.model import FloatArray, IntArray, SingleArray
from pcfix.refract.choice import Rig, Rule
from pcfix.refract.rays import refracted
from pcfix.refract.tiling import TILE

Sight: TypeAlias = tuple[Vector, float, float]
"""Optical axis, squared focal length (px), 1 / n."""
Seen: TypeAlias = tuple[float, Vector, Vector, float, float, float, float, float]


class Budget(NamedTuple):
    """Standard deviations, angles in radians; the place about which the water tilts.

    `in_images` says which residuals the correction makes least.
    """

    image_px: float
    refractive_index: float
    tilt: float
    waves: float
    centre_m: float
    attitude: float
    pivot_x: float
    pivot_y: float
    in_images: bool


# Runs of `TILE` numbers in the room of a tile. Matrices of nine row by row.
RAYS = 0
BY_LEVEL = 1  # three: M delta or S delta
BY_N = 4
SIGHT = 7  # six: W
BY_Q = 13  # nine of S T, or six of M
BY_P = 22  # nine of M delta
BY_TILT = 31  # nine, to be multiplied by tau
NOISE = 40  # six
SUMS = 46
# What the rays of one camera have: N and y - h of the points; how often they count, e and h.
_NORMAL, _BELOW, _COUNT, _AWAY, _HEIGHT = SUMS, 49, 50, 51, 54
ROOM = 55

# A number of a program has double precision, and would make doubles of what it is added to.
_ZERO, _HALF, _ONE, _TWO = np.array([0.0, 0.5, 1.0, 2.0], np.float32)
_single: Any = np.float32


@device(allocates=True)
def room_of(tile: FloatArray, shift: FloatArray, rows: IntArray) -> SingleArray:
    """Return room for the sums of a tile, and how far below P the true points lie, along N.

    It is of single precision, in which the processor works on twice as many rays at once. A
    standard error is off by 5e-6 of it where the cameras are 0.4 heights apart, by 5e-5 at 0.1 and
    by 4 % at 0.003, below which rays are parallel.
    """
    # the sums start at zero; the runs of the rays are filled in by `add_rays`
    room = np.zeros(ROOM * TILE, np.float32)
    for j in range(rows.size):
        normal = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        room[_NORMAL * TILE + j] = normal[0]
        room[(_NORMAL + 1) * TILE + j] = normal[1]
        room[(_NORMAL + 2) * TILE + j] = normal[2]
        room[_BELOW * TILE + j] = -dot(normal, row_of(shift, rows[j]))
    return room


@device
def add_rays(
    room: SingleArray, tile: FloatArray, marks: FloatArray, rig: Rig, c: int, rule: Rule
) -> None:
    """Set what the rays of one camera have: how often they count, as their marks say, e and h.

    In double precision up to there, for whichever tile a point is in it is the same to the bit. A
    ray that is not used gets a height that does no harm.
    """
    centre, offset, least_cosine2 = row_of(rig.centres, c), rig.offset[c], rule.least_cosine2
    for j in range(marks.size):
        z = tile[2 * TILE + j]
        e = minus(centre, (tile[j], tile[TILE + j], z))
        normal = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        height = dot(normal, e)
        h = normal[2] * (tile[3 * TILE + j] - (z - offset))
        # the camera is above the water, the ray marked and within the limit of incidence
        use = (marks[j] > 0.0) & (height > h) & (height * height >= least_cosine2 * dot(e, e))
        room[_COUNT * TILE + j] = marks[j] if use else 0.0
        # straight up, where it is not used
        room[_AWAY * TILE + j] = e[0] if use else normal[0]
        room[(_AWAY + 1) * TILE + j] = e[1] if use else normal[1]
        room[(_AWAY + 2) * TILE + j] = e[2] if use else normal[2]
        room[_HEIGHT * TILE + j] = h


@device
def lens_of(rig: Rig, c: int, rule: Rule) -> Sight:
    """Return a camera as plain numbers, which stay in registers, for the loops over points."""
    x, y, z = row_of(rig.axes, c)
    axis = _single(x), _single(y), _single(z)
    return axis, _single(rig.focal_px[c] * rig.focal_px[c]), _single(rule.bend)


@device
def _seen(room: SingleArray, j: int, bend: float) -> Seen:
    """Return how often a ray counts; e, N, H, L^2, h, y and r where the light bends."""
    at = _AWAY * TILE + j
    e = room[at], room[at + TILE], room[at + 2 * TILE]
    at = _NORMAL * TILE + j
    normal = room[at], room[at + TILE], room[at + 2 * TILE]
    h = room[_HEIGHT * TILE + j]
    # light of a point above the water goes straight
    bend = bend if h > _ZERO else _ONE
    # y: depth of the true point below the surface
    y = h + room[_BELOW * TILE + j]
    return room[_COUNT * TILE + j], e, normal, dot(normal, e), dot(e, e), h, y, bend


@device
def _bent(
    height: float, length2: float, h: float, y: float, bend: float
) -> tuple[float, float, float, float, float, float, float]:
    """Return kappa, 1 / H, 1 / L^2, r / kappa, 1 - m, beta, and delta by n over d."""
    kappa = np.sqrt(length2 - bend * bend * (length2 - height * height))
    share = _ONE / (length2 * height * kappa)  # one division for three
    inv_k, inv_h, inv2 = share * length2 * height, share * length2 * kappa, share * height * kappa
    # r / kappa, the tangent in water for each metre across in air
    lean = bend * inv_k
    fall = y * lean * inv_k * inv_k
    by_n = fall * bend * length2 if bend < _ONE else _ZERO
    return (
        kappa, inv_h, inv2, lean, _ONE - h * inv_h + y * lean, fall * (bend * bend - _ONE), by_n
    )  # fmt: skip


@device
def _weight(one: float, e: Vector, length2: float, axis: Vector, square: float) -> Symmetric:
    """Return J'J of a camera whose squared focal length (px) is `square`, at P.

    With the optical axis z and Z = -z.e it is (f / Z)^2 (I + x z' + z x'), x = e / Z +
    L^2 / (2 Z^2) z; without an axis (zeros), of angles, (f / L)^2 (I - e e' / L^2).
    """
    # cameras without an axis, such as fisheyes, have equal angles per pixel
    flat = axis[0] != _ZERO or axis[1] != _ZERO or axis[2] != _ZERO
    # depth along the axis, or the squared distance
    deep = -dot(axis, e) if flat else length2
    inv = _ONE / deep if one > _ZERO else _ZERO
    # (f / Z)^2 or (f / L)^2; 0 for rays that do not count
    w = one * square * (inv * inv if flat else inv)
    a = inv if flat else -_HALF * inv
    b = _HALF * length2 * inv * inv if flat else _ZERO
    zx, zy, zz = axis[0] if flat else e[0], axis[1] if flat else e[1], axis[2] if flat else e[2]
    x, y, z = scaled(w, beyond(scaled(a, e), b, (zx, zy, zz)))
    return (
        w + _TWO * x * zx, x * zy + zx * y, x * zz + zx * z,
        w + _TWO * y * zy, y * zz + zy * z, w + _TWO * z * zz,
    )  # fmt: skip


@device
def _add_three(sums: FloatArray, at: int, c: float, a: Vector) -> None:
    """Add c a."""
    sums[at] += c * a[0]
    sums[at + TILE] += c * a[1]
    sums[at + 2 * TILE] += c * a[2]


@device
def _add_six(sums: FloatArray, at: int, m: Symmetric) -> None:
    sums[at] += m[0]
    sums[at + TILE] += m[1]
    sums[at + 2 * TILE] += m[2]
    sums[at + 3 * TILE] += m[3]
    sums[at + 4 * TILE] += m[4]
    sums[at + 5 * TILE] += m[5]


@device
def _add_nine(sums: FloatArray, at: int, c: float, m: Symmetric, g: Vector, q: Vector) -> None:
    """Add c m + g q'."""
    sums[at] += c * m[0] + g[0] * q[0]
    sums[at + TILE] += c * m[1] + g[0] * q[1]
    sums[at + 2 * TILE] += c * m[2] + g[0] * q[2]
    sums[at + 3 * TILE] += c * m[1] + g[1] * q[0]
    sums[at + 4 * TILE] += c * m[3] + g[1] * q[1]
    sums[at + 5 * TILE] += c * m[4] + g[1] * q[2]
    sums[at + 6 * TILE] += c * m[2] + g[2] * q[0]
    sums[at + 7 * TILE] += c * m[4] + g[2] * q[1]
    sums[at + 8 * TILE] += c * m[5] + g[2] * q[2]


@device
def _in_space(
    one: float, e: Vector, normal: Vector, height: float, length2: float, bend: float,
    kappa: float, inv2: float,
) -> tuple[Symmetric, Vector]:  # fmt: skip
    """Return M and E."""
    dx, dy, dz = refracted(e, length2, normal, height, bend)
    one = one * inv2
    tx, ty, tz = one * dx, one * dy, one * dz
    # E = (kappa^2 d - r kappa rho^2 N) / L^2, with d = e - H N
    along = kappa * kappa * one
    up = along * height + bend * kappa * (length2 - height * height) * one
    # M = I - t t', with the diagonal from t.t = 1
    xx, yy, zz = dx * tx, dy * ty, dz * tz
    m = yy + zz, -dx * ty, -dx * tz, zz + xx, -dy * tz, xx + yy  # t.t is one
    return m, minus(scaled(along, e), scaled(up, normal))


@device
def add_in_space(room: SingleArray, count: int, sight: Sight) -> None:
    """Add one camera's rays to the sums of a tile's points, of so many."""
    axis, square, bend_of = sight
    for j in range(count):
        one, e, normal, height, length2, h, y, bend = _seen(room, j, bend_of)
        kappa, inv_h, inv2, lean, away, beta, by_n = _bent(height, length2, h, y, bend)
        m, g = _in_space(one, e, normal, height, length2, bend, kappa, inv2)
        # M D (p - (N.p) e / H), where M e = (1 - r H / kappa) E
        up = (away * (lean * height - _ONE) - beta * length2) * inv_h
        # sums of M, M D, M delta by level and by n, and W
        room[RAYS * TILE + j] += one
        _add_six(room, BY_Q * TILE + j, m)
        q = plus(scaled(up, normal), scaled(beta, e))
        _add_nine(room, BY_P * TILE + j, away, m, g, q)
        _add_three(room, BY_LEVEL * TILE + j, inv_h - lean, g)
        _add_three(room, BY_N * TILE + j, by_n, g)
        _add_six(room, SIGHT * TILE + j, _weight(one, e, length2, axis, square))


@device
def add_in_images(room: SingleArray, count: int, sight: Sight) -> None:
    """Add one camera's rays to the sums of a tile's points, of so many.

    S T = W / (1 - m) + W N (u N + v e)', with c = 1 - m + beta rho^2, v = H beta / ((1 - m) c) and
    u = (r H / kappa) / c - 1 / (1 - m) - H v.
    """
    axis, square, bend_of = sight
    for j in range(count):
        one, e, normal, height, length2, h, y, bend = _seen(room, j, bend_of)
        _, inv_h, _, lean, away, beta, by_n = _bent(height, length2, h, y, bend)
        w = _weight(one, e, length2, axis, square)
        g = product(w, normal)
        # D^-1 across d and along it; see the docstring for u and v
        inner, outer = _inverse(height, length2, away, beta)
        v = height * beta * inner * outer
        u = lean * height * outer - inner - height * v
        q = plus(scaled(u, normal), scaled(v, e))
        room[RAYS * TILE + j] += one
        _add_nine(room, BY_Q * TILE + j, inner, w, g, q)
        # S d = -H W N / c
        scale = -height * outer
        _add_three(room, BY_LEVEL * TILE + j, scale * (inv_h - lean), g)
        _add_three(room, BY_N * TILE + j, scale * by_n, g)
        _add_six(room, SIGHT * TILE + j, w)


@device
def _inverse(height: float, length2: float, away: float, beta: float) -> tuple[float, float]:
    """Return what D^-1 does to p across d, and along it."""
    # 1 - m + beta rho^2
    outer = away + beta * (length2 - height * height)
    share = _ONE / (away * outer)
    return share * outer, share * away


@device
def add_tilt(room: SingleArray, count: int, sight: Sight, in_images: bool) -> None:
    """Add how the slope of the water moves each of one camera's rays, M delta or S delta.

    S delta = (a W + (a beta - (1 - m) b) H / c W N d') / (1 - m) tau, c as above, for delta =
    a tau + b (d.tau) d; d.tau = e.tau.
    """
    axis, square, bend_of = sight
    for j in range(count):
        one, e, normal, height, length2, h, y, bend = _seen(room, j, bend_of)
        kappa, inv_h, inv2, lean, away, beta, _ = _bent(height, length2, h, y, bend)
        # delta by the slope is turn (tau) + along (d.tau) d, along = gamma + m r / kappa
        inv_k, turn = _ONE / kappa, -y * (_ONE - height * lean)
        along = y * bend * bend * lean * height * inv_k * inv_k
        along += (h * inv_h - y * lean) * lean - h * inv_h * inv_h
        if in_images:
            w = _weight(one, e, length2, axis, square)
            g = product(w, normal)
            inner, outer = _inverse(height, length2, away, beta)
            # both parts through D^-1
            along = (turn * beta * inner - along) * height * outer
            turn *= inner
        else:
            w, g = _in_space(one, e, normal, height, length2, bend, kappa, inv2)
        _add_nine(room, BY_TILT * TILE + j, turn, w, g, scaled(along, e))


@device
def add_noise(room: SingleArray, count: int, sight: Sight, budget: Budget) -> None:
    """Add the noise of one camera's rays to the normal equations of the straight rays.

    An error that moves the straight ray at P by z, of covariance C, moves its image by J z and
    adds W C W. A turned camera has C = attitude^2 L^2 times what is across the ray, a moved one
    centre_m^2. A wave of slope tau at the piercing point moves the refracted ray at depth y by
    -y (1 - r H / kappa) (tau + r^2 / kappa^2 d (d.tau)); D^-1 of that is what moves P, by c_t
    across d and c_r along.
    """
    axis, square, bend_of = sight
    image_px, centre_m = _single(budget.image_px), _single(budget.centre_m)
    attitude, waves = _single(budget.attitude), _single(budget.waves)
    for j in range(count):
        one, e, normal, height, length2, h, y, bend = _seen(room, j, bend_of)
        kappa, _, _, lean, away, beta, _ = _bent(height, length2, h, y, bend)
        w = _weight(one, e, length2, axis, square)
        g = product(w, normal)
        inner, outer = _inverse(height, length2, away, beta)
        # a slope of the wave moves the refracted ray by this across d
        across = waves * y * (_ONE - height * lean)
        # and by the factor 1 + bow rho^2 along d
        bow = bend * bend / (kappa * kappa)
        c_t = across * inner
        c_r = across * outer * (_ONE + bow * (length2 - height * height))
        # (c_r^2 - c_t^2) / rho^2, also straight down; W d = -H W N
        more = across * outer * (bow - beta * inner) * (c_r + c_t)
        # variance of the place of P from attitude, centre and waves, with C isotropic
        by_place = attitude * attitude * length2 + centre_m * centre_m + c_t * c_t
        by_normal = more * height * height - c_t * c_t
        # W C W for an isotropic C is a multiple of W^2
        ww = _squared(w)
        noise = (
            image_px * image_px * w[0] + by_place * ww[0] + by_normal * g[0] * g[0],
            image_px * image_px * w[1] + by_place * ww[1] + by_normal * g[0] * g[1],
            image_px * image_px * w[2] + by_place * ww[2] + by_normal * g[0] * g[2],
            image_px * image_px * w[3] + by_place * ww[3] + by_normal * g[1] * g[1],
            image_px * image_px * w[4] + by_place * ww[4] + by_normal * g[1] * g[2],
            image_px * image_px * w[5] + by_place * ww[5] + by_normal * g[2] * g[2],
        )
        _add_six(room, NOISE * TILE + j, noise)


@device
def _squared(m: Symmetric) -> Symmetric:
    """Return the square of a symmetric matrix."""
    xx, xy, xz, yy, yz, zz = m
    return (
        xx * xx + xy * xy + xz * xz,
        xx * xy + xy * yy + xz * yz,
        xx * xz + xy * yz + xz * zz,
        xy * xy + yy * yy + yz * yz,
        xy * xz + yy * yz + yz * zz,
        xz * xz + yz * yz + zz * zz,
    )
