"""The port of an underwater housing: its shape, its place before the camera, and its text form.

A port is fixed to the camera. So the surface of refraction moves with each image, while its place
in the camera frame is the same for all of them: Mulsow calls it a bundle-invariant interface.
Inside is air, then comes the glass, then the water.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeAlias

from pcfix.errors import SettingError

ACRYLIC_INDEX = 1.49  # refractive index of acrylic glass (PMMA), the material of most ports


@dataclass(frozen=True, slots=True)
class FlatPort:
    """A plane window."""

    distance_m: float  # from the projection centre to the inner face, along the normal
    thickness_m: float = 0.0  # of the glass; 0 for a thin port
    glass_index: float = ACRYLIC_INDEX  # refractive index of the glass relative to air
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Normal of the faces, towards the water, camera frame; made a unit vector."""

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
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the spheres relative to the projection centre, camera frame."""

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
