"""The sensors of a chunk: their calibrations, and where the slaves of a rig sit.

Convention. With (x, y) the direction, (X, Y) / Z for a frame camera, and r its length:

    x' = x (1 + k1 r^2 + ... + k4 r^8) + (p1 (r^2 + 2 x^2) + 2 p2 x y) (1 + p3 r^2 + p4 r^4)
    u = width / 2 + cx + x' f + x' b1 + y' b2        v = height / 2 + cy + y' f

y' with p1 and p2 exchanged. Pixels start at the corner of the image. A fisheye is equidistant,
r = theta, and since version 2.3 can be equisolid, r = 2 sin(theta / 2); both get the same
distortion. Files of PhotoScan up to 1.2 can have fx and fy instead of f; there cx and cy count
from the corner, and p1 and p2 change places. Decisive is the element, as the version of the
document is not.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import number, numbers, read_xml
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import documents
from pcfix.model import FloatArray, Lens, Projection

RADIAL = ("k1", "k2", "k3", "k4")
PARAMETERS = {"f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", *RADIAL, "p1", "p2", "p3", "p4"}
PROJECTIONS: dict[str, Projection] = {
    "frame": "perspective",
    "fisheye": "equidistant",
    "equidistant_fisheye": "equidistant",
    "equisolid_fisheye": "equisolid",
}


_OFF = ("", "0", "false", "disabled", "none")


def read_calibration(path: Path) -> Lens:
    """Read a calibration that Metashape saved on its own (root element ``calibration``).

    Returns
    -------
    Lens
        In pixels.
    """
    root = read_xml(path)
    if root.tag != "calibration":
        raise InputError(
            f"{path}: is not a Metashape calibration (its root is {root.tag}, not calibration);"
            " save it from Tools, Camera Calibration."
        )
    kind = (root.findtext("projection") or "frame").strip()
    if kind not in PROJECTIONS:
        raise InputError(
            f"{path}: the projection '{kind}' has no lens in pcfix; it knows"
            f" {', '.join(PROJECTIONS)}."
        )
    width, height = (number(path, side, root.findtext(side)) for side in ("width", "height"))
    return lens_of_calibration(path, path.stem, kind, root, (width, height))


def lens_of_calibration(
    path: Path, sensor: str, kind: str, calibration: Element, size: tuple[float, float]
) -> Lens:
    """Return the lens of a calibration of a known kind, for an image of a size in pixels."""
    given = {
        entry.tag: number(path, f"sensor {sensor}, {entry.tag}", entry.text)
        for entry in calibration
        if entry.tag in PARAMETERS
    }
    if not given.keys() & {"f", "fx", "fy"}:
        raise InputError(
            f"{path}: sensor {sensor}: its calibration has no focal length (f); export it again."
        )
    numbers = _old(given, size) if "f" not in given else _new(given, size)
    radial = _short([given.get(name, 0.0) for name in RADIAL])
    found = Lens(
        focal=numbers["focal"],
        width=size[0],
        height=size[1],
        principal_x=numbers["x"],
        principal_y=numbers["y"],
        b1=numbers["b1"],
        b2=numbers["b2"],
        projection=PROJECTIONS[kind],
        radial=radial,
        tangential=_short(
            [numbers["p1"], numbers["p2"], given.get("p3", 0.0), given.get("p4", 0.0)]
        ),
        sensor=sensor,
    )
    return checks.lens(path, sensor, found)


def _new(given: dict[str, float], size: tuple[float, float]) -> dict[str, float]:
    return {
        "focal": given["f"],
        "x": size[0] / 2.0 + given.get("cx", 0.0),
        "y": size[1] / 2.0 + given.get("cy", 0.0),
        **{name: given.get(name, 0.0) for name in ("b1", "b2", "p1", "p2")},
    }


def _old(given: dict[str, float], size: tuple[float, float]) -> dict[str, float]:
    focal = given.get("fy", given.get("fx", 0.0))
    return {
        "focal": focal,
        "x": given.get("cx", size[0] / 2.0),
        "y": given.get("cy", size[1] / 2.0),
        "b1": given.get("fx", focal) - focal,
        "b2": given.get("skew", 0.0),
        "p1": given.get("p2", 0.0),
        "p2": given.get("p1", 0.0),
    }


def _short(values: list[float]) -> tuple[float, ...]:
    """Return the values up to the last that is not zero."""
    while values and values[-1] == 0.0:
        values = values[:-1]
    return tuple(values)


def name_of(sensor: Element) -> str:
    """Return the label of a sensor, or its number."""
    return sensor.get("label") or f"number {sensor.get('id')}"


def kind_of(sensor: Element) -> str:
    """Return the type of a sensor, which may be one that no lens can describe."""
    found = _calibration(sensor)
    return (found is not None and found.get("type")) or sensor.get("type") or "frame"


def is_central(sensor: Element) -> bool:
    """Whether it is a frame camera or a fisheye, not spherical, cylindrical or RPC."""
    return kind_of(sensor) in PROJECTIONS


def lens_of(path: Path, sensor: Element, image: str) -> Lens:
    """Return the adjusted calibration of a sensor, else the initial one, else its data sheet."""
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
    lens = lens_of_calibration(path, label, kind_of(sensor), found, size)
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
    properties = {p.get("name") or "": p.get("value") or "" for p in sensor.iterfind("property")}
    if any(
        name.startswith("rolling_shutter") and value.lower() not in _OFF
        for name, value in properties.items()
    ):
        notes.append(
            f"{path}: sensor {label}: its rolling shutter compensation is left out; each image"
            " has one pose."
        )
    return tuple(notes)


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
    projection = PROJECTIONS[kind_of(sensor)]
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


DISTORTION = ("k1", "k2", "k3", "p1", "p2")


def given_lenses(path: Path) -> dict[str, Lens]:
    """Return the calibrations that were given, by the name of the sensor; none of other software.

    The calibration of class ``initial`` counts if it has distortion. Without, it is the focal
    length that the images' EXIF states, which says little.
    """
    source = Source(path, None, None)
    if not documents.recognises(source):
        return {}
    found: dict[str, Lens] = {}
    for sensor in documents.open_chunk(path).element.iterfind("sensors/sensor"):
        given = [one for one in sensor.findall("calibration") if one.get("class") == "initial"]
        size = None if not given else given[-1].find("resolution")
        if size is None or kind_of(sensor) not in PROJECTIONS:
            continue
        if not any((given[-1].findtext(name) or "0").strip(" 0.-") for name in DISTORTION):
            continue
        label = name_of(sensor)
        where = f"sensor {label}, resolution"
        pixels = (number(path, where, size.get("width")), number(path, where, size.get("height")))
        found[label] = lens_of_calibration(path, label, kind_of(sensor), given[-1], pixels)
    return found
