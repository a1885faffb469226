"""The window of an underwater housing: its shape, its place before the camera, and its words.

A port is fixed to the camera. So the surface at which the light bends moves with each image,
while its place in the camera frame is one and the same for all of them; Mulsow calls it a
bundle-invariant interface. Inside is air, then comes the glass, then the water.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

from pcfix.errors import SettingError

ACRYLIC_INDEX = 1.49
"""Refractive index of acrylic glass (PMMA), which most ports are made of."""


@dataclass(frozen=True, slots=True)
class FlatPort:
    """A plane window.

    Attributes
    ----------
    distance_m : float
        From the projection centre to the inner face, along the normal.
    thickness_m : float
        Of the glass; 0 for a thin port.
    glass_index : float
        Refractive index of the glass relative to air.
    normal : tuple of 3 float
        Of the faces, towards the water, camera frame; made a unit vector. (0, 0, 1) is a port
        square to the axis.
    """

    distance_m: float
    thickness_m: float = 0.0
    glass_index: float = ACRYLIC_INDEX
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        if not (math.isfinite(self.distance_m) and self.distance_m >= 0.0):
            raise SettingError(
                f"port: distance {self.distance_m:g} must not be negative: give metres from the"
                " projection centre forward to the inner face."
            )
        _check_glass(self.thickness_m, self.glass_index)
        length = math.hypot(*self.normal)
        if not (math.isfinite(length) and self.normal[2] > 0.0):
            raise SettingError(
                f"port: the normal {self.normal} must point forward, out of the camera: give its"
                " parts along the camera's x (right), y (down) and z (forward)."
            )
        x, y, z = (part / length for part in self.normal)
        object.__setattr__(self, "normal", (x, y, z))

    def __str__(self) -> str:
        tilt = math.degrees(math.atan2(math.hypot(*self.normal[:2]), self.normal[2]))
        return (
            f"flat port {1000.0 * self.distance_m:g} mm before the projection centre, "
            + _glass_words(self.thickness_m, self.glass_index)
            + (f", tilted by {tilt:.3g} degrees" if tilt else "")
        )


@dataclass(frozen=True, slots=True)
class DomePort:
    """A window between two spheres about one centre.

    Attributes
    ----------
    radius_m : float
        Of the inner face.
    thickness_m : float
        Of the glass; 0 for a thin port.
    glass_index : float
        Refractive index of the glass relative to air.
    centre_m : tuple of 3 float
        Of the spheres, seen from the projection centre, camera frame; (0, 0, 0) for a dome that
        is mounted without an error, which bends no ray.
    """

    radius_m: float
    thickness_m: float = 0.0
    glass_index: float = ACRYLIC_INDEX
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        if not (math.isfinite(self.radius_m) and self.radius_m > 0.0):
            raise SettingError(
                f"port: radius {self.radius_m:g} must be positive: give that of the inner face of"
                " the dome in metres."
            )
        _check_glass(self.thickness_m, self.glass_index)
        off = math.hypot(*self.centre_m)
        if not off < self.radius_m:
            raise SettingError(
                f"port: the centre of the dome lies {off:g} m from the projection centre, beyond"
                f" its radius {self.radius_m:g}, so that the camera would not be inside: give x, y"
                " and z in metres, in the camera frame."
            )

    def __str__(self) -> str:
        x, y, z = (1000.0 * part for part in self.centre_m)
        return (
            f"dome port of {1000.0 * self.radius_m:g} mm radius about ({x:g}, {y:g}, {z:g}) mm, "
            + _glass_words(self.thickness_m, self.glass_index)
        )


Port: TypeAlias = FlatPort | DomePort


def spec_of(port: Port) -> str:
    """Return the text from which `port_of` makes this port, to 0.1 um."""
    glass = f"thickness={port.thickness_m:.7g},glass={port.glass_index:.7g}"
    if isinstance(port, FlatPort):
        nx, ny, _ = port.normal
        tilt = f",nx={nx:.9g},ny={ny:.9g}" if nx or ny else ""
        return f"flat:distance={port.distance_m:.7f},{glass}{tilt}"
    x, y, z = port.centre_m
    return f"dome:radius={port.radius_m:.7g},{glass},x={x:.7f},y={y:.7f},z={z:.7f}"


_FLAT = ("distance", "thickness", "glass", "nx", "ny")
_DOME = ("radius", "thickness", "glass", "x", "y", "z")
_EXAMPLES = {
    "flat": "flat:distance=0.02,thickness=0.008,glass=1.49",
    "dome": "dome:radius=0.05,thickness=0.004,glass=1.49,z=-0.01",
}


def port_of(text: str) -> Port:
    """Return the port of ``flat:distance=0.02,thickness=0.008`` or ``dome:radius=0.05,z=-0.01``.

    Parameters
    ----------
    text : str
        Of a flat port: ``distance`` (m), and if wanted ``thickness`` (m, 0), ``glass`` (refractive
        index, 1.49) and ``nx``, ``ny`` (parts of the unit normal in the camera frame, 0). Of a
        dome: ``radius`` (m), and if wanted ``thickness``, ``glass`` and ``x``, ``y``, ``z`` (its
        centre seen from the projection centre in the camera frame, m, 0).

    Raises
    ------
    SettingError
        If the text is not of this form, or a value breaks its rule.
    """
    kind, _, rest = text.partition(":")
    kind = kind.strip().lower()
    if kind not in _EXAMPLES:
        raise SettingError(
            f"port '{text}': the kind '{kind}' is not flat or dome; give {_EXAMPLES['flat']} or"
            f" {_EXAMPLES['dome']}."
        )
    if kind == "flat":
        values = _values(text, kind, rest, _FLAT)
        nx, ny = values.get("nx", 0.0), values.get("ny", 0.0)
        if not nx * nx + ny * ny < 1.0:
            raise SettingError(
                f"port '{text}': nx and ny are parts of a unit vector, the sum of their squares"
                " must be less than 1; a port square to the camera's axis needs neither."
            )
        normal = nx, ny, math.sqrt(1.0 - nx * nx - ny * ny)
        return FlatPort(values["distance"], *_glass(values), normal)
    values = _values(text, kind, rest, _DOME)
    centre = values.get("x", 0.0), values.get("y", 0.0), values.get("z", 0.0)
    return DomePort(values["radius"], *_glass(values), centre)


def _values(text: str, kind: str, rest: str, known: tuple[str, ...]) -> dict[str, float]:
    """Return the numbers of ``word=number,word=number``; the first known word is needed."""
    values: dict[str, float] = {}
    for part in rest.split(",") if rest.strip() else []:
        word, _, number = (piece.strip() for piece in part.partition("="))
        if word not in known:
            raise SettingError(
                f"port '{text}': '{word}' is not a word of a {kind} port; those are"
                f" {', '.join(known)}."
            )
        if word in values:
            raise SettingError(f"port '{text}': {word} is given twice; give it once.")
        try:
            values[word] = float(number)
        except ValueError:
            values[word] = math.nan
        if not math.isfinite(values[word]):
            raise SettingError(
                f"port '{text}': {word} needs a number, not '{number}', as {_EXAMPLES[kind]}."
            )
    if known[0] not in values:
        raise SettingError(f"port '{text}': {known[0]} is missing, as in {_EXAMPLES[kind]}.")
    return values


def _glass(values: dict[str, float]) -> tuple[float, float]:
    return values.get("thickness", 0.0), values.get("glass", ACRYLIC_INDEX)


def _check_glass(thickness_m: float, index: float) -> None:
    if not (math.isfinite(thickness_m) and thickness_m >= 0.0):
        raise SettingError(
            f"port: thickness {thickness_m:g} must not be negative: give that of the glass in"
            " metres, or 0 for a thin port."
        )
    if not (math.isfinite(index) and index >= 1.0):
        raise SettingError(
            f"port: glass {index:g} is less than 1: give the refractive index of the glass"
            " relative to air, 1.49 for acrylic, 1.52 for crown glass."
        )


def _glass_words(thickness_m: float, index: float) -> str:
    if thickness_m == 0.0:
        return "thin"
    return f"{1000.0 * thickness_m:g} mm of glass with the index {index:g}"
