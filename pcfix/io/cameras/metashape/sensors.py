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
from pcfix.io.cameras.checks import damaged, number, numbers, read_xml, without_zeros
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
    """Read a calibration that Metashape saved on its own (root element ``calibration``), pixels."""
    root = read_xml(path)
    if root.tag != "calibration":
        sentence = (
            f"is not a calibration of Metashape ({root.tag}). Save it from Tools, Camera"
            " Calibration."
        )
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
    value = defaultdict(float, given)
    width, height = size
    if "f" in given:
        focal, x, y = value["f"], width / 2.0 + value["cx"], height / 2.0 + value["cy"]
        b1, b2, p1, p2 = (value[name] for name in ("b1", "b2", "p1", "p2"))
    else:
        focal = given.get("fy", value["fx"])
        x, y = given.get("cx", width / 2.0), given.get("cy", height / 2.0)
        b1, b2, p1, p2 = given.get("fx", focal) - focal, value["skew"], value["p2"], value["p1"]
    return Lens(
        *(focal, width, height, x, y, b1, b2),
        projection=PROJECTIONS[kind],
        radial=without_zeros([value[name] for name in RADIAL]),
        tangential=without_zeros([p1, p2, value["p3"], value["p4"]]),
        sensor=sensor,
    )


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
    label, kind = name_of(sensor), kind_of(sensor)
    found = _calibration(sensor)
    size = None if found is None else _resolution(path, label, found)
    size = size or _resolution(path, label, sensor)
    pixel_mm = _property(path, sensor, "pixel_width")
    if found is not None and size is not None:
        lens = _lens_of_calibration(path, label, kind, found, size)
        return replace(lens, pixel_size_mm=pixel_mm)
    focal_mm = _property(path, sensor, "focal_length")
    if found is not None or size is None or focal_mm is None or pixel_mm is None:
        sentence = (
            f"the sensor {label} of image {image} has no calibration, or no size. Align the images"
            " in Metashape and export the cameras again."
        )
        raise bad_file(path, "cameras.no_calibration", sentence, sensor=label)
    width, height = size
    return Lens(  # what Metashape itself starts from: the data sheet, no distortion
        *(focal_mm / pixel_mm, width, height, width / 2.0, height / 2.0),
        projection=PROJECTIONS[kind],
        pixel_size_mm=pixel_mm,
        sensor=label,
    )


def offset_of(path: Path, sensor: Element) -> FloatArray:
    """Return where a slave is in the frame of its master, a 4x4 matrix in the chunk's unit."""
    label = name_of(sensor)
    offset = np.eye(4)
    if rotation := (sensor.findtext("rotation") or "").strip():
        matrix = numbers(path, f"sensor {label}, rotation", rotation, 9).reshape(3, 3)
        offset[:3, :3] = checks.rotations(path, [f"sensor {label}"], matrix)[0]
    if location := (sensor.findtext("location") or "").strip():
        offset[:3, 3] = numbers(path, f"sensor {label}, location", location, 3)
    return offset


def notes_on(path: Path, sensor: Element) -> tuple[PcfixWarning, ...]:
    """Return notes on what the lens of a sensor does not have."""
    label = name_of(sensor)
    found = _calibration(sensor)
    notes = []
    if found is None:
        sentence = (
            f"{path}: sensor {label} has no calibration. Its focal length is that of the data"
            " sheet, without distortion."
        )
        notes.append(PcfixWarning("cameras.data_sheet_lens", sentence, sensor=label))
    elif coefficients := found.findtext("corrections/coeffs"):
        where = f"sensor {label}, corrections"
        values = numbers(path, where, coefficients, len(coefficients.split()))
        rms_px = float(np.sqrt((values**2).sum() / 2.0))
        sentence = f"{path}: the additional corrections of sensor {label} are ignored"
        sentence += f" ({rms_px:.2f} px rms)."
        notes.append(PcfixWarning("cameras.corrections", sentence, sensor=label, rms_px=rms_px))
    if any(
        entry.get("name") == "rolling_shutter"  # rolling_shutter_flags say which model
        and (entry.get("value") or "").lower() not in _OFF
        for entry in sensor.iterfind("property")
    ):
        sentence = (
            f"{path}: the rolling shutter compensation of sensor {label} is ignored, each image has"
            " one pose. At 5 m/s and 30 ms that is 0.15 m; fly slower where it matters."
        )
        notes.append(PcfixWarning("cameras.rolling_shutter", sentence, sensor=label))
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


def _property(path: Path, sensor: Element, name: str) -> float | None:
    """Return a positive property of a sensor, or None."""
    text = next((p.get("value") for p in sensor.iterfind("property") if p.get("name") == name), "0")
    value = number(path, f"sensor {name_of(sensor)}, {name}", text)
    return value if value > 0.0 else None


DISTORTION = ("k1", "k2", "k3", "p1", "p2")


def given_lenses(path: Path) -> dict[str, Lens]:
    """Return the calibrations that were given, by the name of the sensor; none of other software.

    The calibration of class ``initial`` counts if it has distortion. Without, it is the focal
    length that the images' EXIF states, which says little.
    """
    if not documents.recognises(Source(path)):
        return {}
    found: dict[str, Lens] = {}
    for sensor in documents.open_chunk(path).element.iterfind("sensors/sensor"):
        given = [one for one in sensor.findall("calibration") if one.get("class") == "initial"]
        if not given or not is_central(sensor):
            continue
        label = name_of(sensor)
        size = _resolution(path, label, given[-1])
        if size and any((given[-1].findtext(k) or "0").strip(" 0.-") for k in DISTORTION):
            lens = _lens_of_calibration(path, label, kind_of(sensor), given[-1], size)
            found[label] = checks.lens(path, label, lens)
    return found
