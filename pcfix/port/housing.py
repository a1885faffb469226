"""The port of an underwater housing: its shape, its text form, and refraction there.

A port is fixed to the camera. So the surface of refraction moves with each image, while its place
in the camera frame is the same for all of them: Mulsow calls it a bundle-invariant interface.
Inside is air, then comes the glass, then the water.

Refraction is computed in the camera frame, with the projection centre as the origin: metres, x
right, y down, z forward. `ray_through` applies Snell's law at one face after the other, for a
window of any kind; `light_through` searches the ray that passes a point, and `through_port` adds
the derivatives for intersections and for the bundle adjustment.
"""

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from pcfix.errors import SettingError
from pcfix.kernels import device
from pcfix.lens.algebra import Vector, beyond, cross, dot, minus, plus, scaled, unit
from pcfix.model import FloatArray
from pcfix.refract.rays import refracted

ACRYLIC_INDEX = 1.49  # refractive index of acrylic glass (PMMA), the material of most ports


@dataclass(frozen=True, slots=True)
class FlatPort:
    """A plane window."""

    distance_m: float  # from the projection centre to the inner face, along the normal
    thickness_m: float = 0.0  # of the glass; 0 for a thin port
    glass_index: float = ACRYLIC_INDEX  # refractive index of the glass relative to air
    # Normal of the faces, towards the water, camera frame; made a unit vector.
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        length = math.hypot(*self.normal)
        _check(
            self,
            ("distance", self.distance_m, 0.0 <= self.distance_m < math.inf,
             "must not be negative. Give metres from the projection centre to the inner face."),
            ("normal", self.normal, math.isfinite(length) and self.normal[2] > 0.0,
             "must point out of the camera. Give its x (right), y (down) and z (forward)."),
        )  # fmt: skip
        x, y, z = (part / length for part in self.normal)
        object.__setattr__(self, "normal", (x, y, z))

    def __str__(self) -> str:
        """Return a text for `port_of`, to 0.1 um."""
        glass = f"thickness={self.thickness_m:.7g},glass={self.glass_index:.7g}"
        nx, ny, _ = self.normal
        tilt = f",nx={nx:.9g},ny={ny:.9g}" if nx or ny else ""
        return f"flat:distance={self.distance_m:.7f},{glass}{tilt}"


@dataclass(frozen=True, slots=True)
class DomePort:
    """A window between two concentric spheres."""

    radius_m: float  # of the inner face
    thickness_m: float = 0.0  # of the glass; 0 for a thin port
    glass_index: float = ACRYLIC_INDEX  # refractive index of the glass relative to air
    # Centre of the spheres relative to the projection centre, camera frame.
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        _check(
            self,
            ("radius", self.radius_m, 0.0 < self.radius_m < math.inf,
             "must be positive. Give that of the inner face in metres."),
            ("centre", self.centre_m, math.hypot(*self.centre_m) < self.radius_m,
             f"is farther from the projection centre than the radius {self.radius_m:g}, so that the"
             " camera is outside. Give x, y and z in metres, in the camera frame."),
        )  # fmt: skip

    def __str__(self) -> str:
        """Return a text for `port_of`, to 0.1 um."""
        glass = f"thickness={self.thickness_m:.7g},glass={self.glass_index:.7g}"
        x, y, z = self.centre_m
        return f"dome:radius={self.radius_m:.7g},{glass},x={x:.7f},y={y:.7f},z={z:.7f}"


Port: TypeAlias = FlatPort | DomePort


_NUMBERS = {
    "flat": ("distance", "thickness", "glass", "nx", "ny"),
    "dome": ("radius", "thickness", "glass", "x", "y", "z"),
}
_EXAMPLES = {
    "flat": "flat:distance=0.02,thickness=0.008,glass=1.49",
    "dome": "dome:radius=0.05,thickness=0.004,glass=1.49,z=-0.01",
}


def port_of(text: str) -> Port:
    """Return the port of ``flat:distance=0.02,thickness=0.008`` or ``dome:radius=0.05,z=-0.01``.

    A flat port has ``distance`` (m) and optionally ``thickness`` (m, 0), ``glass`` (refractive
    index, 1.49) and ``nx``, ``ny`` (of the unit normal in the camera frame, 0). A dome has
    ``radius`` (m) and optionally ``thickness``, ``glass`` and ``x``, ``y``, ``z`` (of its centre
    relative to the projection centre in the camera frame, m, 0).
    """
    kind, _, rest = text.partition(":")
    kind = kind.strip().lower()
    if kind not in _EXAMPLES:
        raise _bad(text, f"the kind '{kind}' is not flat or dome", _EXAMPLES["flat"])
    known, values = _NUMBERS[kind], dict[str, float]()
    for part in rest.split(",") if rest.strip() else []:
        word, _, number = (piece.strip() for piece in part.partition("="))
        if word not in known or word in values:
            why = "is given twice" if word in values else f"is not one of {', '.join(known)}"
            raise _bad(text, f"'{word}' {why}", _EXAMPLES[kind])
        with suppress(ValueError):
            values[word] = float(number)
        if not math.isfinite(values.get(word, math.nan)):
            raise _bad(text, f"{word} is not a number: '{number}'", _EXAMPLES[kind])
    if known[0] not in values:
        raise _bad(text, f"{known[0]} is missing", _EXAMPLES[kind])
    values = {"glass": ACRYLIC_INDEX} | values
    size, thickness, glass, x, y, *z = (values.get(name, 0.0) for name in known)
    if kind == "dome":
        return DomePort(size, thickness, glass, (x, y, z[0]))
    z_normal = math.sqrt(max(1.0 - x * x - y * y, 0.0))  # 0 of a vector that is too long is refused
    return FlatPort(size, thickness, glass, (x, y, z_normal))


def _bad(text: str, why: str, example: str) -> SettingError:
    return SettingError(
        "port.text", f"port '{text}': {why}. Give a text such as {example}.", value=text
    )


def _check(port: Port, *rules: tuple[str, object, bool, str]) -> None:
    """Check rules (name, value, whether it is right, sentence) and those of the glass."""
    thickness, glass = port.thickness_m, port.glass_index
    for name, value, is_right, rule in (
        *rules,
        ("thickness", thickness, 0.0 <= thickness < math.inf,
         "must not be negative. Give metres of glass, or 0 for a thin port."),
        ("glass", glass, 1.0 <= glass < math.inf,
         "must be at least 1: the refractive index of the glass, 1.49 for acrylic."),
    ):  # fmt: skip
        if not is_right:
            text = f"port: {name} {value} {rule}"
            raise SettingError("port.range", text, option=name, value=value)


# Refraction


NO_PORT, FLAT, DOME = range(3)
NOWHERE: Vector = (np.nan, np.nan, np.nan)


class Window(NamedTuple):
    """A port for the kernels."""

    kind: int
    where: Vector  # unit normal of a flat port, or centre of a dome
    size: float  # distance or radius of the inner face, metres
    thickness: float  # metres
    glass: float  # refractive index


def window_of(port: Port | None) -> Window:
    """Return a port, or none, for the kernels."""
    match port:
        case FlatPort(size, thickness, glass, where):
            kind = FLAT
        case DomePort(size, thickness, glass, where):
            kind = DOME
        case _:
            kind, size, thickness, glass, where = NO_PORT, 0.0, 0.0, 1.0, (0.0, 0.0, 0.0)
    x, y, z = map(float, where)  # numba would compile another version for integers
    return Window(kind, (x, y, z), float(size), float(thickness), float(glass))


@device
def _at_face(window: Window, depth: float, start: Vector, s: Vector) -> tuple[Vector, Vector]:
    """Return where a ray leaves a face, and the normal there, towards the water.

    The face lies `depth` behind the inner one. NaN if the ray does not meet it.
    """
    where, size = window.where, window.size + depth
    if window.kind == FLAT:
        steep = dot(where, s)
        if not steep > 0.0:
            return NOWHERE, NOWHERE
        return beyond(start, (size - dot(where, start)) / steep, s), where
    # |start + f s| = size, from the inside: the positive root
    start = minus(start, where)
    along = dot(start, s)
    f = -along + np.sqrt(along * along + max(size * size - dot(start, start), 0.0))
    from_centre = beyond(start, f, s)
    return plus(from_centre, where), unit(from_centre)


@device
def ray_through(window: Window, n: float, direction: Vector) -> tuple[Vector, Vector]:
    """Return where a ray from the projection centre leaves the port, and its unit direction there.

    The direction in air may have any length; n is the refractive index of the water relative to
    air, at least 1. NaN is returned if the ray misses the port.
    """
    s, glass = unit(direction), window.glass
    # `refracted` takes the ray backwards and the normal against the light
    inner, normal = _at_face(window, 0.0, (0.0, 0.0, 0.0), s)
    inside = refracted(scaled(-1.0, s), 1.0, scaled(-1.0, normal), dot(normal, s), 1.0 / glass)
    outer, normal = _at_face(window, window.thickness, inner, inside)
    back, inward = scaled(-1.0, inside), scaled(-1.0, normal)
    return outer, refracted(back, 1.0, inward, dot(normal, inside), glass / n)


@device
def cosine_at_port(window: Window, direction: Vector) -> float:
    """Return the cosine of the incidence angle in air at the inner face; see `ray_through`."""
    s = unit(direction)
    return dot(s, _at_face(window, 0.0, (0.0, 0.0, 0.0), s)[1])


STEPS, CLOSE = 100, 1e-13  # most steps of the search; its last step as a share of its interval


@device
def light_through(window: Window, n: float, point: Vector) -> Vector:
    """Return the unit direction in which the light of a point reaches the projection centre.

    n is the refractive index of the water relative to air, at least 1; the point is in the camera
    frame, metres; NaN if it is not in the water.

    Seen from the point, the place on the inner face that is nearest to it is its foot. The light
    stays in the plane of foot, point and projection centre, and crosses the face between the foot
    and the straight line: for refractive indices of at least 1 there is exactly one such ray. The
    secant method finds the one that passes the point, with bisection if a step leaves the bracket.
    """
    where, size = window.where, window.size
    if window.kind == FLAT:
        depth = dot(where, point) - size
        foot = beyond(point, -depth, where)
    else:
        outward = minus(point, where)
        depth = np.sqrt(dot(outward, outward)) - size
        foot = beyond(where, size, unit(outward))
    if not depth > window.thickness:
        return NOWHERE
    straight, foot = unit(point), unit(foot)
    across = cross(straight, foot)
    low, high, last, share = 0.0, 1.0, 0.0, 0.5
    before = _signed_miss(window, n, straight, point, across)
    for _ in range(STEPS):
        # directions between straight (share 0) and foot (1), all in the plane
        w = beyond(scaled(1.0 - share, straight), share, foot)
        miss = _signed_miss(window, n, w, point, across)
        if miss > 0.0:  # it passes the point on the side of the foot
            high = share
        else:
            low = share
        then = share - miss * (share - last) / (miss - before)
        if not low < then < high:
            then = 0.5 * (low + high)
        last, before, share = share, miss, then
        if abs(share - last) <= CLOSE:
            break
    return unit(beyond(scaled(1.0 - share, straight), share, foot))


@device
def _signed_miss(window: Window, n: float, w: Vector, point: Vector, across: Vector) -> float:
    """Return how far a ray passes a point on the side of the foot, in any unit."""
    place, t = ray_through(window, n, w)
    return dot(across, cross(minus(point, place), t))


BY_PORT = 5  # first column of the derivatives by the position of the port, of `through_port`
# Steps of central differences: radians, refractive index, and a share of the size of the port. They
# leave relative errors of about 1e-8.
BY_DIRECTION, BY_INDEX, BY_PLACE, LEAST_SIZE_M = 3e-5, 3e-4, 3e-5, 0.01


@device
def through_port(window: Window, n: float, point: Vector, out: FloatArray) -> None:
    """Fill in the direction w of `light_through` and its derivatives.

    Column 0 of `out`, shape (3, 5) or (3, 8), gets w, columns 1 to 3 the derivatives of w by x, y,
    z, column 4 that by n. Of eight columns, 5 gets that by the distance of a flat port, or 5 to 7
    those by the centre of a dome. NaN if no light comes from the point.

    Let the spot be where the ray of a direction w crosses the plane through the point X, across the
    ray. As it has to stay in X, dw = M^-1 (dX - d spot / d p dp), with M = d spot / d w and p the
    refractive index or a number of the port. The derivatives of the spot are differences.
    """
    w = light_through(window, n, point)
    t = ray_through(window, n, w)[1]
    # w and the spot move across w and t: two numbers each, along e1, e2 and p1, p2
    (e1, e2), (p1, p2) = _two_across(w), _two_across(t)
    by_1 = _difference(window, n, window, n, e1, w, point, t, BY_DIRECTION)
    by_2 = _difference(window, n, window, n, e2, w, point, t, BY_DIRECTION)
    a, b, c, d = dot(p1, by_1), dot(p1, by_2), dot(p2, by_1), dot(p2, by_2)
    det = a * d - b * c
    # a, b, c, d is M in these axes; the rows of M^-1 give the parts of dw along e1 and e2
    g1 = scaled(1.0 / det, minus(scaled(d, p1), scaled(b, p2)))
    g2 = scaled(1.0 / det, minus(scaled(a, p2), scaled(c, p1)))
    for i in range(3):
        out[i, 0] = w[i]
        _set_column(out, 1 + i, e1, e2, g1[i], g2[i])
    still = (0.0, 0.0, 0.0)
    spot = _difference(window, n + BY_INDEX, window, n - BY_INDEX, still, w, point, t, BY_INDEX)
    _set_column(out, 4, e1, e2, -dot(g1, spot), -dot(g2, spot))
    if out.shape[1] <= BY_PORT:
        return
    kind, where, size, thickness, glass = window
    step = BY_PLACE * max(size, LEAST_SIZE_M)
    for i in range(1 if kind == FLAT else 3):
        if kind == FLAT:
            more = Window(kind, where, size + step, thickness, glass)
            less = Window(kind, where, size - step, thickness, glass)
        else:
            move = (step * (i == 0), step * (i == 1), step * (i == 2))
            more = Window(kind, plus(where, move), size, thickness, glass)
            less = Window(kind, minus(where, move), size, thickness, glass)
        spot = _difference(more, n, less, n, still, w, point, t, step)
        _set_column(out, BY_PORT + i, e1, e2, -dot(g1, spot), -dot(g2, spot))


@device
def _two_across(v: Vector) -> tuple[Vector, Vector]:
    """Return two unit vectors across a unit vector and each other."""
    a = unit(cross(v, (1.0, 0.0, 0.0) if abs(v[0]) < 0.6 else (0.0, 1.0, 0.0)))
    return a, cross(v, a)


@device
def _difference(
    more: Window, more_n: float, less: Window, less_n: float, turn: Vector, w: Vector,
    point: Vector, t: Vector, step: float,
) -> Vector:  # fmt: skip
    """Return the derivative of the spot, from its places a step further and a step back.

    The plane of the spot goes through the point, across t; w turns by `turn` times the step.
    """
    place, ray = ray_through(more, more_n, beyond(w, step, turn))
    further = beyond(place, dot(minus(point, place), t) / dot(ray, t), ray)
    place, ray = ray_through(less, less_n, beyond(w, -step, turn))
    back = beyond(place, dot(minus(point, place), t) / dot(ray, t), ray)
    return scaled(0.5 / step, minus(further, back))


@device
def _set_column(out: FloatArray, j: int, e1: Vector, e2: Vector, a: float, b: float) -> None:
    """Write a e1 + b e2 into a column."""
    for i in range(3):
        out[i, j] = a * e1[i] + b * e2[i]
