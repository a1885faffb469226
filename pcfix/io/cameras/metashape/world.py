"""From the frame of a chunk to the world: components, scale, and the CRS of the result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.checks import ROUNDING
from pcfix.io.cameras.xml import number, numbers
from pcfix.io.crs import METRES, crs_text, is_local, parse_crs, shortened, unbound

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any
    from xml.etree.ElementTree import Element

    from pyproj import CRS

    from pcfix.model import FloatArray


@dataclass(frozen=True)
class World:
    """The frame of the centres, and the CRS of the chunk where that is another."""

    crs: str
    project_crs: str | None = None


@dataclass(frozen=True, eq=False)
class Similarity:
    """world = scale rotation X + translation."""

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def points(self, xyz: FloatArray) -> FloatArray:
        """Return points of the chunk, shape (n, 3), in the world."""
        return np.asarray(self.scale * xyz @ self.rotation.T + self.translation)


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


class Placements:
    """Where each component of a chunk goes.

    Every component has a frame of its own. One with a transform has a place in the world; one
    without has that of the chunk when it is the active or only one, as the chunk's transform is
    that of its active component.
    """

    def __init__(self, path: Path, chunk: Element) -> None:
        parent = chunk.find("components")
        components = [] if parent is None else parent.findall("component")
        ids = [component.get("id") for component in components]
        active = None if parent is None else parent.get("active_id")
        self._main = active if active in ids or not ids else ids[0]
        self._chunk = _similarity(path, chunk.find("transform"))
        self._own = {c.get("id"): _similarity(path, c.find("transform")) for c in components}

    def is_main(self, component: str | None) -> bool:
        """Whether images of this component are in the frame of the chunk."""
        return component is None or component == self._main or component not in self._own

    def of(self, component: str | None) -> Similarity | None:
        """Return the way to the world, or None where the component has no place in it."""
        own = self._own.get(component)
        if own is not None:
            return own
        return self._chunk if self.is_main(component) else None


def _similarity(path: Path, element: Element | None) -> Similarity | None:
    """Return a transform of three parts, or of one 4x4 matrix that holds the scale too."""
    if element is None:
        return None
    where = "transform of the chunk"
    if (element.text or "").strip():
        matrix = numbers(path, where, element.text, 16).reshape(4, 4)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return _checked(path, scale, matrix[:3, :3] / (scale or 1.0), matrix[:3, 3])
    rotation, translation, scale_of = (
        element.find(n) for n in ("rotation", "translation", "scale")
    )
    if rotation is None and translation is None and scale_of is None:
        return None
    return _checked(
        path,
        1.0 if scale_of is None else number(path, where, scale_of.text),
        np.eye(3) if rotation is None else numbers(path, where, rotation.text, 9).reshape(3, 3),
        np.zeros(3) if translation is None else numbers(path, where, translation.text, 3),
    )


def _checked(path: Path, scale: float, rotation: FloatArray, translation: FloatArray) -> Similarity:
    """Return the transform with the rotation next to the given one."""
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (scale > 0.0 and off <= ROUNDING and np.linalg.det(rotation) > 0.0):
        raise InputError(
            f"{path}: the transform of the chunk is not a rotation with one positive scale (scale"
            f" {scale:g}); export the cameras again."
        )
    u, _, v = np.linalg.svd(rotation)
    return Similarity(scale, u @ v, translation)


def world_of(path: Path, chunk: Element) -> tuple[World, tuple[str, ...]]:
    """Return the world that the transforms of a chunk lead to, and notes on it.

    Raises
    ------
    InputError
        If the CRS is not one that PROJ knows.
    """
    text = (chunk.findtext("reference") or "").strip()
    if not text or text.upper() == "LOCAL":
        return World("local"), ()
    crs = parse_crs(text, str(path))
    if is_local(crs):
        return World("local"), _unit_notes(path, crs)
    base = None if crs.geodetic_crs is None else unbound(crs.geodetic_crs)
    if base is None:
        raise InputError(
            f"{path}: the CRS of the chunk, {shortened(text)}, has no datum; set it again in"
            " Metashape's reference settings."
        )
    frame = crs_text(type(crs).from_json_dict(_geocentric(base.to_json_dict())))
    return World(frame, frame if crs.is_geocentric else text), ()


def _geocentric(base: dict[str, Any]) -> dict[str, Any]:
    """Return the geocentric CRS, as PROJJSON, on the datum of another."""
    axes = [
        {"name": f"Geocentric {a}", "abbreviation": a, "direction": f"geocentric{a}"} for a in "XYZ"
    ]
    return {
        "$schema": base["$schema"],
        "type": "GeodeticCRS",
        "name": base["name"],
        **{key: base[key] for key in ("datum", "datum_ensemble") if key in base},
        "coordinate_system": {
            "subtype": "Cartesian",
            "axis": [{**axis, "unit": "metre"} for axis in axes],
        },
    }


def _unit_notes(path: Path, crs: CRS) -> tuple[str, ...]:
    unit = crs.axis_info[0].unit_name
    if unit in METRES:
        return ()
    return (
        f"{path}: the local coordinates of the chunk are in {unit}; its transform is in metres, so"
        " that a cloud exported in that unit has to be scaled.",
    )
