"""The unknowns of an adjustment that many observations share: lens, water and housing port.

They have codes or positions for the kernels, and names for users.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pcfix.model import FloatArray, IntArray, Lens

# Parameters of the refracting surface: of the water, then of a housing port.
#
# The water is z = a + b x + c y + d x^2 + e x y + f y^2 about the origin of the block; a mesh or
# raster stays where it is.
WATER_NAMES = (
    *("level", "tilt_x", "tilt_y", "index", "shape_xx", "shape_xy", "shape_yy"),
    *("distance", "centre_x", "centre_y", "centre_z"),
)
# Positions of the index, of d, e, f, of the port's parameters, and of planes of control points.
INDEX, SHAPE, PORT, PLANES = 3, 4, 7, 11

# What a surveyor calls the shared unknowns.
WORDS = {
    "f": "focal length", "cx": "principal point x", "cy": "principal point y", "b1": "affinity b1",
    "b2": "skew b2", "level": "water level", "tilt_x": "water tilt along x",
    "tilt_y": "water tilt along y", "index": "refractive index", "shape_xx": "water shape x^2",
    "shape_xy": "water shape x y", "shape_yy": "water shape y^2", "distance": "port distance",
    "centre_x": "dome centre x", "centre_y": "dome centre y", "centre_z": "dome centre z",
    **{one: f"distortion {one}" for one in ("p1", "p2", *(f"k{i}" for i in range(1, 9)))},
}  # fmt: skip

# By the first word of a name.
UNITS = {"level": " m", "tilt": " m/m", "shape": " /m", "distance": " m", "centre": " m"}


def words_of(name: str) -> tuple[str, str]:
    """Return what a surveyor calls a shared unknown, and its unit; that of a lens is not known."""
    base, of, sensor = name.partition(" of sensor ")
    first = name.replace("_", " ").split()[0]
    return WORDS.get(base, base) + of + sensor, UNITS.get(first, "")


@dataclass(frozen=True)
class Unknowns:
    """What is estimated: a standard deviation of zero fixes a parameter, infinity frees it."""

    poses: Literal["free", "fixed"] = "free"
    lens: tuple[str, ...] = ("f",)  # free of each sensor: f, cx, cy, b1, b2, k1 ... k8, p1, p2
    # of level (m), tilt, index, shape (1/m), distance (m) and centre (m); others are fixed
    surface: Mapping[str, float] = field(default_factory=dict)
    free_network: bool = False  # mean position, direction and scale of the centres stay

    @property
    def water_sigma(self) -> tuple[float, ...]:
        """Standard deviations in the order of `WATER_NAMES`."""
        return tuple(self.surface.get(name.partition("_")[0], 0.0) for name in WATER_NAMES)


def similarity_gradients(d: FloatArray) -> FloatArray:
    """Return how places d from the pivot move with shift, turn and scale, shape (k, 3, 7)."""
    by = np.zeros((len(d), 3, 7))
    by[:, :, :3] = np.eye(3)
    by[:, :, 3:6] = np.cross(np.eye(3), d[:, None]).transpose(0, 2, 1)  # about axis i: e_i x d
    by[:, :, 6] = d
    return by


# Lens parameters


FOCAL, CX, CY, B1, B2, P1, P2, K1 = range(8)  # codes of lens parameters; k2, k3, ... follow `K1`

NAMES = ("f", "cx", "cy", "b1", "b2", "p1", "p2", *(f"k{i}" for i in range(1, 9)))
CODES = {name: code for code, name in enumerate(NAMES)}
_FIELDS = ("focal", "principal_x", "principal_y", "b1", "b2")

FEW_IMAGES = 5.0  # images per lens below which the lenses of a sensor share their corrections


def sensor_groups(lenses: tuple[Lens, ...]) -> IntArray:
    """Return the number of the sensor of each of k lenses, in the order in which they appear.

    Images that have a calibration each, but one sensor and frame, share the corrections.
    """
    sensors = [(one.sensor, one.width, one.height, one.projection, one.inverse) for one in lenses]
    distinct = len(set(lenses))
    # several lenses of one sensor, each with enough images for its own corrections
    is_own = distinct > len(set(sensors)) and len(lenses) / distinct >= FEW_IMAGES
    keys: Sequence[object] = lenses if is_own else sensors
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([number[key] for key in keys], np.int64)


def usable_codes(lens: Lens, names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the codes of those parameters that the model of a lens has."""
    codes = tuple(CODES[name] for name in names)
    return tuple(code for code in codes if code < P1) if lens.in_turn else codes


def default_lens(lenses: tuple[Lens, ...]) -> tuple[str, ...]:
    """Return the lens parameters that are free by default: those that the lenses have."""
    more = ("b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    pairs = [(lens, code) for lens in lenses for code in usable_codes(lens, more)]
    used = {NAMES[code] for lens, code in pairs if lens_parameter(lens, code)}
    return ("f", "cx", "cy", *(name for name in more if name in used))


def lens_parameter(lens: Lens, code: int) -> float:
    """Return a parameter of a lens; zero for terms that its polynomial does not have."""
    if code < P1:
        return float(getattr(lens, _FIELDS[code]))
    values, place = (lens.radial, code - K1) if code >= K1 else (lens.tangential, code - P1)
    return float(values[place]) if place < len(values) else 0.0


def moved_lens(lens: Lens, codes: Sequence[int], by: FloatArray) -> Lens:
    """Return a lens with corrections added to some of its parameters."""
    changes: dict[str, Any] = {}
    radial, tangential = [*lens.radial], [*lens.tangential]
    for code, step in zip(codes, by.tolist(), strict=True):
        if code < P1:
            changes[_FIELDS[code]] = getattr(lens, _FIELDS[code]) + step
            continue
        terms, at, least = (radial, code - K1, 0) if code >= K1 else (tangential, code - P1, 2)
        terms += [0.0] * (max(at + 1, least) - len(terms))
        terms[at] += step
    return replace(lens, radial=tuple(radial), tangential=tuple(tangential), **changes)


def effect_at_corner(lens: Lens, code: int) -> float:
    """Return the image movement at the corner of the frame per unit of a lens parameter."""
    r = 0.5 * np.hypot(lens.width, lens.height) / lens.focal
    if code in (CX, CY):
        return 1.0
    if code >= K1:
        return float(lens.focal * r ** (2 * (code - K1) + 3))
    return float(3.0 * lens.focal * r * r if code in (P1, P2) else r)
