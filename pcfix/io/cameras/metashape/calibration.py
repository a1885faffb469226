"""Calibrations, as formulas of `pcfix.model.Lens`.

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

from typing import TYPE_CHECKING

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.xml import number, read_xml
from pcfix.model import Lens

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.model import Projection

RADIAL = ("k1", "k2", "k3", "k4")
PARAMETERS = {"f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", *RADIAL, "p1", "p2", "p3", "p4"}
PROJECTIONS: dict[str, Projection] = {
    "frame": "perspective",
    "fisheye": "equidistant",
    "equidistant_fisheye": "equidistant",
    "equisolid_fisheye": "equisolid",
}


def read_calibration(path: Path) -> Lens:
    """Read a calibration that Metashape saved on its own (root element ``calibration``).

    Returns
    -------
    Lens
        In pixels.

    Raises
    ------
    InputError
        If it is not one, or of a projection without a lens (spherical, cylindrical, RPC).
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
    return lens(path, path.stem, kind, root, (width, height))


def lens(
    path: Path, sensor: str, kind: str, calibration: Element, size: tuple[float, float]
) -> Lens:
    """Return the lens of a calibration of a known kind, for an image of the given size in pixels.

    Raises
    ------
    InputError
        If it has no focal length, or its numbers cannot be those of a lens.
    """
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
