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

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import PcfixWarning, bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import damaged, note, number, numbers, read_xml, terms
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import documents
from pcfix.model import FloatArray, Lens, Projection

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
PARAMETERS = {"f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", *DISTORTION}
PROJECTIONS: dict[str, Projection] = {
    "frame": "perspective",
    "fisheye": "equidistant",
    "equidistant_fisheye": "equidistant",
    "equisolid_fisheye": "equisolid",
}
"""Kinds of sensors that a lens can describe: not spherical, cylindrical or RPC."""


def read_calibration(path: Path) -> Lens:
    """Read a calibration that Metashape saved on its own (root element ``calibration``), pixels."""
    root = read_xml(path)
    if root.tag != "calibration":
        sentence = f"is not a calibration of Metashape ({root.tag}). Save one from its Tools menu."
        raise bad_file(path, "cameras.no_calibration", sentence)
    kind = (root.findtext("projection") or "frame").strip()
    if kind not in PROJECTIONS:
        remedy = f"Use a lens of type {', '.join(PROJECTIONS)}"
        raise checks.unsupported(path, f"the projection '{kind}'", remedy, model=kind)
    width, height = (number(path, side, root.findtext(side)) for side in ("width", "height"))
    lens = _lens_of_calibration(path, path.stem, kind, root, (width, height))
    return checks.lens(path, path.stem, lens)


def _lens_of_calibration(
    path: Path, sensor: str, kind: str, calibration: Element, size: tuple[float, float]
) -> Lens:
    """Return the lens of a calibration of a known kind, for an image of a size in pixels."""
    given = {
        entry.tag: number(path, f"sensor {sensor}, {entry.tag}", entry.text)
        for entry in calibration
        if entry.tag in PARAMETERS
    }
    if not given.keys() & {"f", "fx", "fy"}:
        raise damaged(path, f"the calibration of sensor {sensor} has no focal length")
    width, height = size
    value = defaultdict(float, given)
    focal, x, y = value["f"], width / 2.0 + value["cx"], height / 2.0 + value["cy"]
    b1, b2, tangential = value["b1"], value["b2"], "p1 p2 p3 p4"
    if "f" not in given:
        focal = given.get("fy", value["fx"])
        x, y = given.get("cx", width / 2.0), given.get("cy", height / 2.0)
        b1, b2, tangential = given.get("fx", focal) - focal, value["skew"], "p2 p1 p3 p4"
    return Lens(
        *(focal, width, height, x, y, b1, b2),
        projection=PROJECTIONS[kind],
        radial=terms(given, "k1 k2 k3 k4"),
        tangential=terms(given, tangential),
        sensor=sensor,
    )


def name_of(sensor: Element) -> str:
    """Return the label of a sensor, or its number."""
    return sensor.get("label") or f"number {sensor.get('id')}"


def kind_of(sensor: Element) -> str:
    """Return the type of a sensor, which may be none of `PROJECTIONS`."""
    found = _calibration(sensor)
    return (found is not None and found.get("type")) or sensor.get("type") or "frame"


def lens_of(path: Path, sensor: Element, image: str) -> tuple[Lens, tuple[PcfixWarning, ...]]:
    """Return the adjusted calibration, else the initial one, else the data sheet; and notes."""
    label, found = name_of(sensor), _calibration(sensor)
    size = None if found is None else _resolution(path, label, found)
    size = size or _resolution(path, label, sensor)
    pixel_mm, focal_mm = (_property(path, sensor, n) for n in ("pixel_width", "focal_length"))
    notes = []
    if found is not None and size is not None:
        lens = _lens_of_calibration(path, label, kind_of(sensor), found, size)
        lens = replace(lens, pixel_size_mm=pixel_mm)
        if coefficients := found.findtext("corrections/coeffs"):
            where, count = f"sensor {label}, corrections", len(coefficients.split())
            rms_px = float(np.linalg.norm(numbers(path, where, coefficients, count)) / 2.0**0.5)
            sentence = f"the additional corrections of {label} are ignored ({rms_px:.2f} px rms)."
            notes.append(note(path, "cameras.corrections", sentence, sensor=label, rms_px=rms_px))
    elif found is None and size is not None and focal_mm is not None and pixel_mm is not None:
        lens = Lens(  # what Metashape itself starts from
            *(focal_mm / pixel_mm, *size, size[0] / 2.0, size[1] / 2.0),
            projection=PROJECTIONS[kind_of(sensor)],
            pixel_size_mm=pixel_mm,
            sensor=label,
        )
        sentence = f"sensor {label} has no calibration; the lens of its data sheet is used."
        notes.append(note(path, "cameras.data_sheet_lens", sentence, sensor=label))
    else:
        sentence = f"sensor {label} of {image} has no calibration or no size. Align the images."
        raise bad_file(path, "cameras.no_calibration", sentence, sensor=label)
    shutter = [p for p in sensor.iterfind("property") if p.get("name") == "rolling_shutter"]
    if any((p.get("value") or "0").lower() not in ("0", "false", "disabled") for p in shutter):
        sentence = f"the rolling shutter of sensor {label} is ignored; each image has one pose."
        notes.append(note(path, "cameras.rolling_shutter", sentence, sensor=label))
    return lens, tuple(notes)


def offset_of(path: Path, sensor: Element) -> FloatArray:
    """Return where a slave is in the frame of its master, a 4x4 matrix in the chunk's unit."""
    label = name_of(sensor)
    offset = np.eye(4)
    if rotation := checks.text_of(sensor, "rotation"):
        matrix = numbers(path, f"sensor {label}, rotation", rotation, 9)
        offset[:3, :3] = checks.rotations(path, [f"sensor {label}"], matrix)[0]
    if location := checks.text_of(sensor, "location"):
        offset[:3, 3] = numbers(path, f"sensor {label}, location", location, 3)
    return offset


def _calibration(sensor: Element) -> Element | None:
    """Return the last adjusted calibration, else the last one."""
    found = sensor.findall("calibration")
    chosen = [one for one in found if one.get("class") == "adjusted"] or found
    return chosen[-1] if chosen else None


def _resolution(path: Path, label: str, element: Element) -> tuple[float, float] | None:
    found = element.find("resolution")
    if found is None:
        return None
    where = f"sensor {label}, resolution"
    return number(path, where, found.get("width")), number(path, where, found.get("height"))


def _property(path: Path, sensor: Element, name: str) -> float | None:
    """Return a positive property of a sensor, or None."""
    text = next((p.get("value") for p in sensor.iterfind("property") if p.get("name") == name), "0")
    value = number(path, f"sensor {name_of(sensor)}, {name}", text)
    return value if value > 0.0 else None


def given_lenses(path: Path) -> dict[str, Lens]:
    """Return the calibrations that were given, by the name of the sensor; none of other software.

    The calibration of class ``initial`` counts if it has distortion. Without, it is the focal
    length that the images' EXIF states, which says little.
    """
    if not documents.recognises(Source(path)):
        return {}
    found: dict[str, Lens] = {}
    for sensor in documents.open_chunk(path).element.iterfind("sensors/sensor"):
        label, kind = name_of(sensor), kind_of(sensor)
        given = [one for one in sensor.findall("calibration") if one.get("class") == "initial"]
        size = _resolution(path, label, given[-1]) if given else None
        if size is not None and kind in PROJECTIONS:
            lens = _lens_of_calibration(path, label, kind, given[-1], size)
            if lens.radial or lens.tangential:
                found[label] = checks.lens(path, label, lens)
    return found
