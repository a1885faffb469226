"""Where one stereo pair places a point of the bed: by its two images of it, their straight rays.

All is relative to an apparent point P, and in rows of numbers, one for each image; see
`pcfix.refract.stereo_pairs`.
"""

from __future__ import annotations

from typing import NamedTuple

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, beyond, dot, minus, plus, row_of, scaled, solved, vector
from pcfix.lens.formulas import KIND, PERSPECTIVE
from pcfix.lens.imaging import image_in_world
from pcfix.model import FloatArray
from pcfix.refract.batch import Chosen, Images, Optics, to_original
from pcfix.refract.rays import direction, light_path

# Columns of a ray: e, the height of its water over P, e as the matcher had it, how its scale
# changes (g of `meet`), and of the image of Q G'G (xx, xy, xz, yy, yz, zz), G'G e, |G e|^2.
ABOVE, _MADE, _BY_PLACE, _SQUARE, _RIGHT, RAY_WIDTH = 3, 4, 7, 10, 16, 20


class PairImages(NamedTuple):
    """Those of the matcher; `both` has them as they were and as they are now; n."""

    optics: Optics
    both: Images
    n: float


@device
def begin(ray: FloatArray, points: Chosen, i: int, c: int, images: PairImages) -> None:
    """Fill in where a ray comes from, and how its scale changes with the place.

    The distance that the scale of an image goes by, in terms of P's, is in perspective that along
    the axis, in other projections that from the centre.
    """
    e = minus(row_of(points.centres, c), row_of(points.xyz, i))
    ray[ABOVE] = points.normals[i, 2] * (points.height[i] - points.xyz[i, 2] + points.offset[c])
    made, optics = e, images.optics
    if len(images.both.centres):
        made = minus(row_of(images.both.centres, c), row_of(points.original_xyz, i))
    axis, size2 = row_of(optics.rotations[c], 2), dot(made, made)
    ahead = -dot(axis, made)
    flat = optics.lenses[optics.row[c], KIND] == PERSPECTIVE and ahead > 0.0
    for j in range(3):
        ray[j], ray[_MADE + j] = e[j], made[j]
        ray[_BY_PLACE + j] = axis[j] / ahead if flat else -made[j] / size2


@device
def see(ray: FloatArray, q: Vector, c: int, normal: Vector, images: PairImages) -> None:
    """Write what the image of Q says about places: G'G, G'G e and |G e|^2.

    w, as the matcher had it, is scaled to be as far away as P, so that G is that of there.
    """
    path = light_path(q, vector(ray), normal, ray[ABOVE], images.n)
    w = to_original(images.both, c, direction(path, normal))
    w = scaled(1.0 / dot(w, vector(ray, _BY_PLACE)), w)
    optics, e = images.optics, vector(ray, _MADE)
    _, _, by_u, by_v = image_in_world(optics.lenses[optics.row[c]], optics.rotations[c], w)
    ray[_SQUARE:] = 0.0
    for g in (by_u, by_v):
        (x, y, z), off = g, dot(g, e)
        terms = (x * x, x * y, x * z, y * y, y * z, z * z, off * x, off * y, off * z, off * off)
        for i in range(10):
            ray[_SQUARE + i] += terms[i]


@device
def meet(a: FloatArray, b: FloatArray) -> Vector:
    """Return where two straight rays have the least squared residuals in their images.

    At X the residual of a camera is G (X - e) / t, t = 1 + g.X how far away X is in terms of P. The
    first round takes t as one. The second has it, and that it changes with X: at the least

        sum_c G'G (X - e) / t^2 - r^2 / t^3 g = 0,    r^2 = |G (X - e)|^2

    which tells in narrow pairs of rays that miss each other.
    """
    place = _solve_two(a, b, 1.0, 1.0, 0.0, 0.0)
    t, r2 = _residual(place, a)
    t_b, r2_b = _residual(place, b)
    return _solve_two(a, b, 1.0 / (t * t), 1.0 / (t_b * t_b), r2 / t**3, r2_b / t_b**3)


@device
def _residual(place: Vector, ray: FloatArray) -> tuple[float, float]:
    """Return t and r^2 of a place."""
    (x, y, z), s = place, ray[_SQUARE:]
    t = 1.0 + x * ray[_BY_PLACE] + y * ray[_BY_PLACE + 1] + z * ray[_BY_PLACE + 2]
    twice = x * (s[1] * y + s[2] * z) + s[4] * y * z - (s[6] * x + s[7] * y + s[8] * z)
    return t, s[0] * x * x + s[3] * y * y + s[5] * z * z + 2.0 * twice + s[9]


@device
def _solve_two(
    a: FloatArray, b: FloatArray, of_a: float, of_b: float, g_a: float, g_b: float
) -> Vector:
    """Solve the normal equations of two rays."""
    x, y, z = beyond(
        beyond(_sum(a, b, of_a, of_b, _RIGHT), g_a, vector(a, _BY_PLACE)), g_b, vector(b, _BY_PLACE)
    )
    xx, xy, xz = _sum(a, b, of_a, of_b, _SQUARE)
    yy, yz, zz = _sum(a, b, of_a, of_b, _SQUARE + 3)
    return solved((xx, xy, xz, yy, yz, zz), (x, y, z))[1]


@device
def _sum(a: FloatArray, b: FloatArray, of_a: float, of_b: float, at: int) -> Vector:
    """Return so many times three columns of one ray and of the other."""
    return plus(scaled(of_a, vector(a, at)), scaled(of_b, vector(b, at)))
