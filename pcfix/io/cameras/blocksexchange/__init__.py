"""BlocksExchange XML: ContextCapture, iTwin Capture Modeler, DJI Terra.

A block has photogroups, each with one lens and its photos. A rotation takes world axes to camera
axes, which `CameraOrientation` names by where x and y point in the image (XRightYDown, the
default, is x right, y down, z forward); it is a matrix M_ij by rows, or omega, phi, kappa with
M = (Rx Ry Rz)^T in those same camera axes. Yaw, pitch, roll (or heading) are refused, as their
definition could not be checked against a file. Component 1 is the block; photos of another one
are in a frame of their own.

Pixels start at the centre of the first pixel, so half a pixel is added to principal point and
measurements. The focal length is in mm with the largest side of the sensor, or in pixels; the
focal length down the image is `AspectRatio` times that, `Skew` is in pixels. P1 and P2 are in
Brown's order, x' = ... + P1 (r^2 + 2 x^2) + 2 P2 x y. A fisheye has a matrix and a polynomial
P0 + P1 q + P2 q^2 + ... of q = 2 theta / pi; without the matrix, it is pi / 2 times the focal
length. Places in mm (xmm, ymm) are in the camera axes, from the centre of the sensor for the
principal point and from the principal point for measurements.

Where the GNSS said that a photo was taken is in Pose/Metadata, or in the GPS of ExifData. Tie
points can be in a file of their own, and either file in a zip archive (.xmlz).

References: Bentley, ContextCapture User Guide, "BlocksExchange XML/XMLZ format", "Perspective
camera model", "Fisheye camera model"; Bentley developer documentation, "CC Orientations". The
order of P1 and P2 and the factor pi / 2 follow converters that cite those pages.
"""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.blocksexchange.document import (
    Photogroup,
    ReferenceSystems,
    Rows,
    is_archive_of_block,
    read_document,
    read_ties,
)
from pcfix.io.cameras.checks import number
from pcfix.io.cameras.formats import Source
from pcfix.lens.rotations import from_omega_phi_kappa, from_photogrammetric
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, TiePoints

__all__ = ["read", "recognises", "tie_points"]


def recognises(source: Source) -> bool:
    """Whether the root element is BlocksExchange, in a plain file or a zip archive."""
    return "<BlocksExchange" in source.text or is_archive_of_block(source)


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the block."""
    return read_photos(source.path, read_document(source.path)[0])[0]


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of the block; those of a CRS of their own lose their coordinates."""
    root, texts = read_document(source.path)
    return read_ties(source.path, texts, cameras, read_photos(source.path, root)[1])


EXIF_CRS = "EPSG:4326"
AXES = ("x", "y", "z")
MAIN_COMPONENT = "1"


class Photo(NamedTuple):
    """A photo with at least a position; `key` is its block and id."""

    key: tuple[int, str]
    label: str
    centre: FloatArray
    rotation: FloatArray | None
    lens: Lens | None
    srs: str
    component: str
    prior: tuple[str, FloatArray] | None


def read_photos(path: Path, root: Element) -> tuple[Cameras, Rows]:
    """Read all photos of a document."""
    systems = ReferenceSystems(path, root)
    blocks = list(root.iter("Block"))
    photos: list[Photo] = []
    unposed: list[str] = []
    groups: dict[tuple[int, str], Photogroup] = {}
    for number_of_block, block in enumerate(blocks):
        for element in block.iter("Photogroup"):
            group = Photogroup(path, element)
            srs = _text(element, "SRSId") or _text(block, "SRSId")
            found, without = _of_group(path, number_of_block, group, srs)
            photos += found
            unposed += without
            groups.update({photo.key: group for photo in found})
        for element in block.iterfind("BulkPhotos/Photo"):
            unposed.append(_label(element))
    photos, others, notes = _of_one_frame(path, photos)
    _refuse_copies(path, photos, len(blocks))
    srs = _one_srs(path, photos)
    crs = systems.of(srs)
    row_of = {photo.key: row for row, photo in enumerate(photos)}
    rows = Rows(row_of, groups, srs, [_text(block, "SRSId") for block in blocks])
    return _cameras(photos, systems, crs, tuple(unposed + others), notes), rows


def _cameras(
    photos: list[Photo],
    systems: ReferenceSystems,
    crs: str,
    unposed: tuple[str, ...],
    notes: tuple[str, ...],
) -> Cameras:
    rotations = [photo.rotation for photo in photos if photo.rotation is not None]
    lenses = [photo.lens for photo in photos if photo.lens is not None]
    return Cameras(
        labels=tuple(photo.label for photo in photos),
        centres=np.array([photo.centre for photo in photos]),
        rotations=np.array(rotations) if rotations else None,
        lenses=tuple(lenses) if rotations and len(lenses) == len(photos) else None,
        crs=crs,
        notes=notes,
        gnss=_gnss(photos, systems),
        unposed=unposed,
        source="BlocksExchange",
    )


def _of_group(path: Path, block: int, group: Photogroup, srs: str) -> tuple[list[Photo], list[str]]:
    """Return the photos of a group that have a position, and the names of the others."""
    lens, axes = group.lens(), group.axes()
    found, without = [], []
    for element in group.element.iterfind("Photo"):
        label = _label(element)
        centre = element.find("Pose/Center")
        if centre is None:
            without.append(label)
            continue
        photo = Photo(
            key=(block, _text(element, "Id")),
            label=label,
            centre=_position(path, f"image {label}, Center", centre),
            rotation=_rotation(path, label, element.find("Pose/Rotation"), axes),
            lens=lens,
            srs=srs,
            component=_text(element, "Component") or MAIN_COMPONENT,
            prior=_prior(path, label, element, srs),
        )
        found.append(photo)
    return found, without


def _of_one_frame(
    path: Path, photos: list[Photo]
) -> tuple[list[Photo], list[str], tuple[str, ...]]:
    """Return the photos that belong together, the names of the others, and what to tell."""
    main = [photo for photo in photos if photo.component == MAIN_COMPONENT]
    whole = main or photos
    turned = [photo for photo in whole if photo.rotation is not None]
    kept = turned or whole
    if not kept:
        raise InputError(
            f"{path}: no photo has a pose; export the block after the aerotriangulation."
        )
    ids = {photo.key for photo in kept}
    notes = []
    if not turned:
        notes.append(f"{path}: no photo has a rotation, only positions are read.")
    elif any(photo.lens is None for photo in kept):
        name = next(photo.label for photo in kept if photo.lens is None)
        notes.append(
            f"{path}: image {name}: its photogroup has no frame or focal length; frames are taken"
            " as boundless."
        )
    return kept, [photo.label for photo in photos if photo.key not in ids], tuple(notes)


def _refuse_copies(path: Path, photos: list[Photo], blocks: int) -> None:
    """Refuse a photo that is in two blocks, as only one of its poses can be the one."""
    if blocks > 1:
        seen: dict[str, int] = {}
        for photo in photos:
            if seen.setdefault(photo.label, photo.key[0]) != photo.key[0]:
                raise InputError(
                    f"{path}: image {photo.label} is in several blocks of the file; export the one"
                    " block that the cloud was made from."
                )


def _one_srs(path: Path, photos: list[Photo]) -> str:
    ids = sorted({photo.srs for photo in photos})
    if len(ids) > 1:
        raise InputError(
            f"{path}: the positions are in several spatial reference systems (ids"
            f" {', '.join(i or 'local' for i in ids)}); export the block in one."
        )
    return ids[0]


def _rotation(
    path: Path, label: str, element: Element | None, axes: FloatArray
) -> FloatArray | None:
    """Return world to x right, y down, z forward; None where there is no rotation."""
    if element is None or len(element) == 0:
        return None
    names = [f"M_{row}{column}" for row in range(3) for column in range(3)]
    if element.find("M_00") is not None:
        matrix = _numbers(path, label, element, names).reshape(3, 3)
    elif element.find("Omega") is not None:
        angles = _numbers(path, label, element, ["Omega", "Phi", "Kappa"])
        matrix = from_photogrammetric(from_omega_phi_kappa(*angles.reshape(3, 1)))[0]
    elif element.find("Pitch") is not None:
        raise InputError(
            f"{path}: image {label}: its rotation is in yaw (or heading), pitch and roll, which"
            " are not supported; export rotations as matrices or omega, phi, kappa."
        )
    else:
        return None
    return checks.rotation(path, label, axes @ matrix)


def _prior(path: Path, label: str, element: Element, srs: str) -> tuple[str, FloatArray] | None:
    """Return the SRS id ("exif" for that of EXIF) and position before the adjustment."""
    centre = element.find("Pose/Metadata/Center")
    if centre is not None:
        own = _text(element, "Pose/Metadata/SRSId")
        return own or srs, _position(path, f"image {label}, Metadata", centre)
    gps = element.find("ExifData/GPS")
    names = ["Longitude", "Latitude", "Altitude"]
    if gps is not None and all(gps.findtext(name) for name in names):
        return "exif", _numbers(path, f"{label}, GPS", gps, names)
    return None


def _gnss(photos: list[Photo], systems: ReferenceSystems) -> GnssPositions | None:
    """Return one row per photo; positions in the CRS that the first of them has."""
    srs = next((photo.prior[0] for photo in photos if photo.prior is not None), None)
    if srs is None:
        return None
    xyz = np.full((len(photos), 3), np.nan)
    for row, photo in enumerate(photos):
        if photo.prior is not None and photo.prior[0] == srs:
            xyz[row] = photo.prior[1]
    crs = EXIF_CRS if srs == "exif" else systems.of(srs)
    return GnssPositions(xyz, np.full_like(xyz, np.nan), crs)


def _position(path: Path, where: str, element: Element) -> FloatArray:
    return np.array([number(path, where, element.findtext(axis)) for axis in AXES])


def _numbers(path: Path, label: str, element: Element, names: list[str]) -> FloatArray:
    return np.array(
        [number(path, f"image {label}, {name}", element.findtext(name)) for name in names]
    )


def _label(element: Element) -> str:
    """Return the name of the image file, or the id of a photo without one."""
    name = PureWindowsPath(_text(element, "ImagePath")).name
    return name or f"photo {_text(element, 'Id')}"


def _text(element: Element, name: str) -> str:
    return (element.findtext(name) or "").strip()
