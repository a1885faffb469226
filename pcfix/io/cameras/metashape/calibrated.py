"""Calibrations that Metashape was given before it adjusted them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import calibration, documents, sensors
from pcfix.io.cameras.xml import number

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import Lens

DISTORTION = ("k1", "k2", "k3", "p1", "p2")


def given_lenses(path: Path) -> dict[str, Lens]:
    """Return the calibrations that were given, by the name of the sensor.

    Parameters
    ----------
    path : Path
        A camera file or folder of any software; there are none but in Metashape's.

    Notes
    -----
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
        if size is None or sensors.kind_of(sensor) not in calibration.PROJECTIONS:
            continue
        if not any((given[-1].findtext(name) or "0").strip(" 0.-") for name in DISTORTION):
            continue
        label = sensors.name_of(sensor)
        where = f"sensor {label}, resolution"
        pixels = (number(path, where, size.get("width")), number(path, where, size.get("height")))
        found[label] = calibration.lens(path, label, sensors.kind_of(sensor), given[-1], pixels)
    return found
