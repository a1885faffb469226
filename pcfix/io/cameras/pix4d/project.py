"""Where the GNSS said that the images were taken, from the project file (.p4d)."""

from __future__ import annotations

from collections import defaultdict
from pathlib import PureWindowsPath
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.io.cameras import checks
from pcfix.io.cameras.xml import number, read_xml
from pcfix.model import GnssPositions

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.model import FloatArray

GEOGRAPHIC = "EPSG:4326"


class Prior(NamedTuple):
    """What the project says of one image; `kind` is the element that has the position."""

    kind: str
    xyz: FloatArray
    sigma_m: FloatArray


def read_project(
    path: Path, labels: tuple[str, ...]
) -> tuple[GnssPositions | None, tuple[str, ...]]:
    """Read the initial positions of images, and the names of enabled images without a pose."""
    root = read_xml(path)
    priors: dict[str, list[Prior | None]] = defaultdict(list)
    for image in root.iter("image"):
        if image.get("path") and image.get("enabled", "true").lower() != "false":
            name = PureWindowsPath(image.get("path", "")).name
            priors[name].append(_prior(path, name, image))
    found = [priors[label].pop(0) if priors.get(label) else None for label in labels]
    others = tuple(name for name, rest in priors.items() for _ in rest)
    return _positions(path, root, found), others


def _prior(path: Path, name: str, image: Element) -> Prior | None:
    """Return the position: `xyz` in the CRS of the images, or `gps` in WGS 84."""
    for kind, axes in (("xyz", ("x", "y", "z")), ("gps", ("lng", "lat", "alt"))):
        position = image.find(kind)
        if position is not None:
            where = f"image {name}, {kind}"
            xyz = np.array([number(path, where, position.get(axis)) for axis in axes])
            plan, height = (_tolerance(path, name, image, axis) for axis in ("XY", "Z"))
            return Prior(kind, xyz, np.array([plan, plan, height]))
    return None


def _tolerance(path: Path, name: str, image: Element, axis: str) -> float:
    element = image.find(f"tolerance{axis}")
    if element is None:
        return np.nan
    return number(path, f"image {name}, tolerance{axis}", element.get("value"))


def _positions(path: Path, root: Element, found: list[Prior | None]) -> GnssPositions | None:
    """Return one row per camera; positions of the kind that the first image has."""
    kinds = [prior.kind for prior in found if prior is not None]
    if not kinds:
        return None
    xyz, sigma_m = np.full((len(found), 3), np.nan), np.full((len(found), 3), np.nan)
    for i, prior in enumerate(found):
        if prior is not None and prior.kind == kinds[0]:
            xyz[i], sigma_m[i] = prior.xyz, prior.sigma_m
    crs = GEOGRAPHIC if kinds[0] == "gps" else _crs_of_images(path, root)
    return GnssPositions(xyz, sigma_m, crs)


def _crs_of_images(path: Path, root: Element) -> str | None:
    for element in root.iter():
        if isinstance(element.tag, str) and element.tag.lower() in ("wktimage", "wktimages"):
            text = element.get("value") or element.text or ""
            return checks.crs(path, text) if text.strip() else None
    return None
