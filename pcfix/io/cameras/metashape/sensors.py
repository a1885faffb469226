"""The sensors of a chunk: their lenses, and where the slaves of a rig sit."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.metashape import calibration
from pcfix.io.cameras.xml import number, numbers
from pcfix.model import Lens

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.model import FloatArray


def name_of(sensor: Element) -> str:
    """Return the label of a sensor, or its number."""
    return sensor.get("label") or f"number {sensor.get('id')}"


def kind_of(sensor: Element) -> str:
    """Return the type of a sensor, which may be one that no lens can describe."""
    found = _calibration(sensor)
    return (found is not None and found.get("type")) or sensor.get("type") or "frame"


def is_central(sensor: Element) -> bool:
    """Whether it is a frame camera or a fisheye, not spherical, cylindrical or RPC."""
    return kind_of(sensor) in calibration.PROJECTIONS


def lens_of(path: Path, sensor: Element, image: str) -> Lens:
    """Return the adjusted calibration of a sensor, else the initial one, else its data sheet.

    Raises
    ------
    InputError
        If there is none; the message names `image`, the first that needs it.
    """
    label = name_of(sensor)
    found = _calibration(sensor)
    if found is None:
        return _nominal(path, sensor, image)
    size = _resolution(path, label, found) or _resolution(path, label, sensor)
    if size is None:
        raise InputError(
            f"{path}: image {image}: its sensor {label} has no resolution; export the cameras"
            " again."
        )
    lens = calibration.lens(path, label, kind_of(sensor), found, size)
    return replace(lens, pixel_size_mm=_property(path, sensor, "pixel_width"))


def offset_of(path: Path, sensor: Element) -> FloatArray:
    """Return where a slave is in the frame of its master, a 4x4 matrix in the chunk's unit."""
    label = name_of(sensor)
    offset = np.eye(4)
    if rotation := (sensor.findtext("rotation") or "").strip():
        matrix = numbers(path, f"sensor {label}, rotation", rotation, 9).reshape(3, 3)
        offset[:3, :3] = checks.rotation(path, f"of the sensor {label}", matrix)
    if location := (sensor.findtext("location") or "").strip():
        offset[:3, 3] = numbers(path, f"sensor {label}, location", location, 3)
    return offset


def notes_on(path: Path, sensor: Element) -> tuple[str, ...]:
    """Return what a sensor has and its lens has not."""
    label = name_of(sensor)
    found = _calibration(sensor)
    notes = []
    if found is None:
        notes.append(
            f"{path}: sensor {label} has no calibration: its focal length is that of the data"
            " sheet, without distortion."
        )
    elif coefficients := found.findtext("corrections/coeffs"):
        where = f"sensor {label}, corrections"
        values = numbers(path, where, coefficients, len(coefficients.split()))
        notes.append(
            f"{path}: sensor {label}: its additional corrections,"
            f" {np.sqrt((values**2).sum() / 2.0):.2f} px rms, are left out."
        )
    if any(_is_on(p) for p in sensor.iterfind("property") if _is_of_shutter(p)):
        notes.append(
            f"{path}: sensor {label}: its rolling shutter compensation is left out; each image"
            " has one pose."
        )
    return tuple(notes)


def _is_of_shutter(entry: Element) -> bool:
    return (entry.get("name") or "").startswith("rolling_shutter")


def _is_on(entry: Element) -> bool:
    return (entry.get("value") or "").lower() not in ("", "0", "false", "disabled", "none")


def _calibration(sensor: Element) -> Element | None:
    """Return the last adjusted calibration, else the last one."""
    found = sensor.findall("calibration")
    adjusted = [one for one in found if one.get("class") == "adjusted"]
    chosen = adjusted or found
    return chosen[-1] if chosen else None


def _resolution(path: Path, label: str, element: Element) -> tuple[float, float] | None:
    found = element.find("resolution")
    if found is None:
        return None
    where = f"sensor {label}, resolution"
    return number(path, where, found.get("width")), number(path, where, found.get("height"))


def _nominal(path: Path, sensor: Element, image: str) -> Lens:
    """Return what Metashape itself starts from: the data sheet, no distortion."""
    label = name_of(sensor)
    size = _resolution(path, label, sensor)
    focal_mm, pixel_mm = (_property(path, sensor, n) for n in ("focal_length", "pixel_width"))
    if size is None or focal_mm is None or pixel_mm is None:
        raise InputError(
            f"{path}: image {image}: its sensor {label} has no calibration; align or optimise the"
            " cameras in Metashape and export them again."
        )
    width, height = size
    projection = calibration.PROJECTIONS[kind_of(sensor)]
    lens = Lens(focal_mm / pixel_mm, width, height, width / 2.0, height / 2.0, sensor=label)
    checks.lens(path, label, lens)
    return replace(lens, projection=projection, pixel_size_mm=pixel_mm)


def _property(path: Path, sensor: Element, name: str) -> float | None:
    """Return a positive property of a sensor, or None."""
    for entry in sensor.iterfind("property"):
        if entry.get("name") == name:
            value = number(path, f"sensor {name_of(sensor)}, {name}", entry.get("value"))
            return value if value > 0.0 else None
    return None
