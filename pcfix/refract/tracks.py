r"""Find the true point from which SfM software would have made the apparent one (tracks).

Software that ignores water intersects straight rays: from the image points x_i of a true point Q it
computes the point P with the least squared residuals in the images,

    F(Q) = argmin_P  sum_i \|x_i(Q) - pi_i(P)\|^2

with pi_i the projection of camera i, distortion included, and x_i(Q) = pi_i(A_i) the image of the
point where the light from Q to that camera leaves the water (`pcfix.refract.rays`). P is known
and Q is unknown, so that nothing is triangulated: at the minimum the derivative is zero,

    g(Q) = sum_i J_i' (x_i(Q) - pi_i(P)) = 0,    J_i = d pi_i / d P

three equations for the three unknowns of Q. `snell` intersects the refracted rays of P in space,
with equal weights; here the residuals are those that made P.

At the solution the direction w_i of the light is that of P but for the residuals, some pixels of
thousands. P is seen in the direction -e_i, and w_i is scaled to one along the normal N, so that

    d x_i / d Q = (N.e_i) J_i d w_i / d Q

is known to about a thousandth. From `snell`'s solution each step with the inverse of the sum gains
about three digits, and two or three steps are enough.

The inner loops over the points of a tile are vectorised for the usual lens and a plane of water.
"""

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import beyond, dot, minus, row_of, scaled
from pcfix.lens.formulas import PLAIN
from pcfix.lens.imaging import Plain, image_and_slopes, image_of, plain_image, plain_lens
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Chosen, Optics, Rig
from pcfix.refract.rays import light_near, settle
from pcfix.refract.tiling import TILE, add_three, inverse_of, nine, product_of, put, slots, three
from pcfix.water.surface import Field, Tin, field_of

# Two or three are usual. A point that is not found by then starts again, and may need many.
STEPS, MOST_STEPS = 4, 60

CLOSE_M = 1e-7  # estimated distance from the solution, from the last two steps

# Runs of `TILE` numbers for the rays of one camera: the gradients of the image by P, the image of
# P, and the plane of the water (N, h), which moves under waves.
_BY_U, _BY_V, _IMAGE, _PLANE, RAY_RUNS = slots(3, 3, 2, 4)

# Runs for the points: Q, g, d g / d Q, the last step squared, the state, and the light to one
# camera: k, S, the depth D and s, as of `light_near`.
Q, _G, _BY_Q, _STEP2, STATE, _LIGHT, POINT_RUNS = slots(3, 3, 9, 1, 1, 6)
SEARCHED, FOUND, LOST = 0.0, 1.0, 2.0


@device
def search_tile(
    room: FloatArray, rays: FloatArray, tile: FloatArray, marks: FloatArray, near: IntArray,
    points: Chosen, optics: Optics, tin: Tin | None, fields: Field | None,
) -> None:  # fmt: skip
    """Move Q from the start in `room` to where g is zero; its state shows success.

    `marks`, a row for each of the cameras `near`, say how often each ray counts. A point that is
    found, or lost, stays where it is, so that the others of its tile do not matter.
    """
    count, rig, n = marks.shape[1], points.rig, points.n
    for step in range(STEPS + MOST_STEPS):
        # under waves a search may alternate between two planes: it starts again where it is
        if step == 0 or step == STEPS:
            room[_STEP2 * TILE : STATE * TILE] = 0.0
            for k in range(near.size):
                lens = optics.lenses[optics.row[near[k]]]
                if lens[PLAIN] != 0.0:
                    _set_rays(rays[k], tile, marks[k], rig, near[k], optics, plain_lens(lens))
                else:
                    _set_rays(rays[k], tile, marks[k], rig, near[k], optics, None)
        # g and its derivative at the places so far, camera by camera
        room[_G * TILE : _STEP2 * TILE] = 0.0
        for k in range(near.size):
            c, lens = near[k], optics.lenses[optics.row[near[k]]]
            if tin is not None or fields is not None:
                _settle(rays[k], room, tile, marks[k], rig, c, n, tin, fields)
            _find_light(room, rays[k], tile, marks[k], rig, c, n)
            # numba compiles a version of `_add` for each kind of argument
            if lens[PLAIN] != 0.0:
                _add(room, rays[k], tile, marks[k], rig, c, optics, plain_lens(lens), n)
            else:
                _add(room, rays[k], tile, marks[k], rig, c, optics, None, n)
        if not _step(room, count):
            break


@device
def _step(room: FloatArray, count: int) -> bool:
    """Move the points that are searched by -(d g / d Q)^-1 g; return whether any goes on."""
    searched = False
    for j in range(count):
        if room[STATE * TILE + j] != SEARCHED:
            continue
        _, inverse = inverse_of(nine(room, _BY_Q * TILE + j))
        t = product_of(inverse, three(room, _G * TILE + j))
        size2, before = dot(t, t), room[_STEP2 * TILE + j]
        put(room, Q * TILE + j, minus(three(room, Q * TILE + j), t))
        room[_STEP2 * TILE + j] = size2
        # NaN: some camera has no image of Q
        if not size2 < np.inf:
            room[STATE * TILE + j] = LOST
        # steps shrink at least as fast as the last one did: the rest is about size^2 / before
        elif size2 <= CLOSE_M * max(CLOSE_M, np.sqrt(before)):
            room[STATE * TILE + j] = FOUND
        else:
            searched = True
    return searched


@device(forceinline=True)
def _set_rays(
    ray: FloatArray, tile: FloatArray, marks: FloatArray, rig: Rig, c: int, optics: Optics,
    plain: Plain | None,
) -> None:  # fmt: skip
    """Set the image of each point in a camera, its gradients by P (world frame), and the plane."""
    centre, offset, lens = row_of(rig.centres, c), rig.offset[c], optics.lenses[optics.row[c]]
    for j in range(marks.size):
        p, normal = three(tile, j), three(tile, 4 * TILE + j)
        u, v, by_u, by_v = image_and_slopes(lens, plain, optics.rotations[c], minus(p, centre))
        ray[_IMAGE * TILE + j], ray[(_IMAGE + 1) * TILE + j] = u, v
        put(ray, _BY_U * TILE + j, by_u)
        put(ray, _BY_V * TILE + j, by_v)
        put(ray, _PLANE * TILE + j, normal)
        # water that stood higher for this image: the point is lowered instead
        ray[(_PLANE + 3) * TILE + j] = normal[2] * (tile[3 * TILE + j] - (p[2] - offset))


@device
def _settle(
    ray: FloatArray, room: FloatArray, tile: FloatArray, marks: FloatArray, rig: Rig, c: int,
    n: float, tin: Tin | None, fields: Field | None,
) -> None:  # fmt: skip
    """Move the planes of the rays of one camera to where the light leaves a mesh or raster."""
    temporary = room[_LIGHT * TILE :]
    plane, origin = temporary[:4], temporary[4:7]
    for j in range(marks.size):
        if not marks[j] > 0.0 or room[STATE * TILE + j] != SEARCHED:
            continue
        origin[0], origin[1] = tile[j], tile[TILE + j]
        origin[2] = tile[2 * TILE + j] - rig.offset[c]
        for i in range(4):
            plane[i] = ray[(_PLANE + i) * TILE + j]
        e = minus(row_of(rig.centres, c), three(tile, j))
        settle(plane, tin, field_of(fields, c), origin, three(room, Q * TILE + j), e, n)
        for i in range(4):
            ray[(_PLANE + i) * TILE + j] = plane[i]


@device(forceinline=True)
def _find_light(
    room: FloatArray, ray: FloatArray, tile: FloatArray, marks: FloatArray, rig: Rig, c: int,
    n: float,
) -> None:  # fmt: skip
    """Set the light from each Q to one camera.

    In a short loop the processor works on the roots and divisions of several points at once; in the
    long one of `_add` each would wait for the one before. That saves a quarter of the kernel.
    """
    centre = row_of(rig.centres, c)
    for j in range(marks.size):
        normal, h = three(ray, _PLANE * TILE + j), ray[(_PLANE + 3) * TILE + j]
        e, q = minus(centre, three(tile, j)), three(room, Q * TILE + j)
        k, root, depth, _, s = light_near(q, e, normal, h, n)
        put(room, _LIGHT * TILE + j, (k, root, depth))
        put(room, (_LIGHT + 3) * TILE + j, s)


@device(forceinline=True)
def _add(
    room: FloatArray, ray: FloatArray, tile: FloatArray, marks: FloatArray, rig: Rig, c: int,
    optics: Optics, plain: Plain | None, n: float,
) -> None:  # fmt: skip
    """Add the residuals of one camera's rays to g(Q), and their part of d g / d Q."""
    centre, lens, r = row_of(rig.centres, c), optics.lenses[optics.row[c]], optics.rotations[c]
    right, down, ahead = row_of(r, 0), row_of(r, 1), row_of(r, 2)
    for j in range(marks.size):
        e, normal = minus(centre, three(tile, j)), three(ray, _PLANE * TILE + j)
        h, (k, root, depth) = ray[(_PLANE + 3) * TILE + j], three(room, _LIGHT * TILE + j)
        s, m2 = three(room, (_LIGHT + 3) * TILE + j), n * n if depth > 0.0 else 1.0
        w = minus(scaled(k, s), normal)
        w = dot(right, w), dot(down, w), dot(ahead, w)
        if plain is None:
            u, v = image_of(lens, w[0], w[1], w[2])
        else:
            u, v, _ = plain_image(plain, w)
        # the residual in pixels; a ray that does not count may have none
        times = marks[j]
        du = times * (u - ray[_IMAGE * TILE + j]) if times > 0.0 else 0.0
        dv = times * (v - ray[(_IMAGE + 1) * TILE + j]) if times > 0.0 else 0.0
        by_u, by_v = three(ray, _BY_U * TILE + j), three(ray, _BY_V * TILE + j)
        add_three(room, _G * TILE + j, 1.0, beyond(scaled(du, by_u), dv, by_v))
        # d w / d Q = k (I - N N') + s (grad k)', with G(k, D, s.s) = 0 implicitly:
        # grad k = (k / S N + D k^3 (n^2 - 1) / S^3 s) / (H + D n^2 / S^3)
        across = dot(normal, e)
        cube = root * root * root
        below = 1.0 / (across - h + depth * m2 / cube)
        aside = below * depth * k * k * k * (m2 - 1.0) / cube
        by_k = beyond(scaled(below * k / root, normal), aside, s)
        times = times * across if times > 0.0 else 0.0
        du_q = beyond(scaled(k, minus(by_u, scaled(dot(by_u, normal), normal))), dot(by_u, s), by_k)
        dv_q = beyond(scaled(k, minus(by_v, scaled(dot(by_v, normal), normal))), dot(by_v, s), by_k)
        du_q, dv_q, at = scaled(times, du_q), scaled(times, dv_q), _BY_Q * TILE + j
        add_three(room, at, 1.0, beyond(scaled(by_u[0], du_q), by_v[0], dv_q))
        add_three(room, at + 3 * TILE, 1.0, beyond(scaled(by_u[1], du_q), by_v[1], dv_q))
        add_three(room, at + 6 * TILE, 1.0, beyond(scaled(by_u[2], du_q), by_v[2], dv_q))
