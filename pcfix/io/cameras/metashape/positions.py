"""Where the GNSS put the cameras: their ``reference``, in the CRS of the cameras or the chunk."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from pcfix.io.cameras.xml import number, numbers
from pcfix.io.crs import is_local, parse_crs
from pcfix.model import GnssPositions

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.io.cameras.metashape.block import Block, Image
    from pcfix.io.cameras.metashape.documents import Chunk
    from pcfix.model import FloatArray

Spreads: TypeAlias = tuple[tuple[str, tuple[int, ...]], ...]
"""Names of statements and the axes that they speak of."""

SPREADS: Spreads = (
    *(("sxyz", (0, 1, 2)), ("sxy", (0, 1))),
    *(("sx", (0,)), ("sy", (1,)), ("sz", (2,))),
)
DEFAULTS: Spreads = (
    ("accuracy_cameras", (0, 1, 2)),
    ("accuracy_cameras_xy", (0, 1)),
    ("accuracy_cameras_z", (2,)),
)
LOCAL = "LOCAL"


def gnss_positions(chunk: Chunk, block: Block) -> tuple[GnssPositions | None, tuple[str, ...]]:
    """Return the reference positions of the images of a block, and notes on them.

    Positions that the user unticked are no measurement and left out, unless all are, as is usual
    when control points alone hold the block.
    """
    path = chunk.path
    given = [image.element.find("reference") for image in block.images]
    ticked = [None if r is None or r.get("enabled") == "false" else r for r in given]
    used = given if all(reference is None for reference in ticked) else ticked
    xyz = np.array([_xyz(path, i, r) for i, r in zip(block.images, used, strict=True)])
    if not np.isfinite(xyz[:, :2]).all(axis=1).any():
        return None, ()
    start = _defaults(path, chunk.element)
    rows = [_sigma(path, i, r, start) for i, r in zip(block.images, used, strict=True)]
    sigma = np.where(np.isfinite(xyz), np.array(rows), np.nan)
    crs, notes = _crs(path, chunk.element, xyz)
    return GnssPositions(xyz, sigma, crs), (*notes, *_antenna_notes(path, block))


def _xyz(path: Path, image: Image, reference: Element | None) -> list[float]:
    if reference is None:
        return [np.nan] * 3
    where = f"image {image.label}, reference"
    words = (reference.get(axis) for axis in "xyz")
    return [np.nan if word is None else number(path, where, word) for word in words]


def _sigma(path: Path, image: Image, reference: Element | None, start: FloatArray) -> FloatArray:
    """Return the stated standard deviations, from the widest statement to the narrowest."""
    stated = {} if reference is None else reference.attrib
    sigma = _stated(path, f"image {image.label}, reference", stated, SPREADS, start)
    return np.where(sigma > 0.0, sigma, np.nan)


def _defaults(path: Path, chunk: Element) -> FloatArray:
    """Return what the settings of the chunk state for every camera."""
    settings = {
        (entry.get("name") or "").replace("/", "_"): entry.get("value") or ""
        for entry in chunk.iterfind("settings/property")
    }
    return _stated(path, "settings of the chunk", settings, DEFAULTS, np.full(3, np.nan))


def _stated(
    path: Path, where: str, given: dict[str, str], spreads: Spreads, start: FloatArray
) -> FloatArray:
    """Return `start` with what is given: one number for its axes, or one for each."""
    sigma = start.copy()
    for name, axes in spreads:
        if text := given.get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            sigma[list(axes)] = numbers(path, f"{where}, {name}", text, count)
    return sigma


def _crs(path: Path, chunk: Element, xyz: FloatArray) -> tuple[str, tuple[str, ...]]:
    """Return the CRS of the positions; that of the cameras may differ from that of the chunk."""
    own = (chunk.findtext("camera_reference") or "").strip()
    text = own or (chunk.findtext("reference") or "").strip() or LOCAL
    if text.upper() == LOCAL or is_local(crs := parse_crs(text, str(path))):
        return "local", ()
    if not own and not crs.is_geographic and _are_degrees(xyz):
        return "EPSG:4979", (
            f"{path}: the reference positions of the cameras are degrees, although the CRS of the"
            " chunk is in metres; taken as WGS 84.",
        )
    return text, ()


def _are_degrees(xyz: FloatArray) -> bool:
    return bool(np.nanmax(np.abs(xyz[:, 0])) <= 180.0 and np.nanmax(np.abs(xyz[:, 1])) <= 90.0)


def _antenna_notes(path: Path, block: Block) -> tuple[str, ...]:
    found = {id(image.sensor): image.sensor for image in block.images}
    return tuple(
        f"{path}: sensor {sensor.get('label')}: its GNSS antenna has an offset from the camera; the"
        " GNSS positions are those of the antenna."
        for sensor in found.values()
        if sensor is not None and _has_antenna_offset(path, sensor)
    )


def _has_antenna_offset(path: Path, sensor: Element) -> bool:
    antenna = sensor.find("antenna")
    if antenna is None:
        return False
    reference = antenna.find("reference")
    words = (antenna.findtext("location") or "").split()
    if reference is not None:
        words += [reference.get(axis) or "0" for axis in "xyz"]
        words += (reference.get("location") or "").split()
    return any(number(path, "GNSS antenna", word) != 0.0 for word in words)
