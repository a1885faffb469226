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

Software ignores poses where ManualPose is false, and lenses where ManualOpticalParams is: what
stands there did not make the cloud, and is not read.

Where the GNSS said that a photo was taken is in Pose/Metadata, or in the GPS of ExifData. Tie
points can be in a file of their own, and either file in a zip archive (.xmlz).

References: Bentley, ContextCapture User Guide, "BlocksExchange XML/XMLZ format", "Perspective
camera model", "Fisheye camera model"; Bentley developer documentation, "CC Orientations". The
order of P1 and P2 and the factor pi / 2 follow converters that cite those pages.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PureWindowsPath
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.blocksexchange import document
from pcfix.io.cameras.checks import number
from pcfix.io.cameras.formats import Source
from pcfix.lens.rotations import from_omega_phi_kappa, from_photogrammetric
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, TiePoints

__all__ = ["read", "recognises", "tie_points"]


def recognises(source: Source) -> bool:
    """Whether the root element is BlocksExchange, in a plain file or a zip archive."""
    return "<BlocksExchange" in source.text or document.is_archive_of_block(source)


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the block."""
    return read_photos(source.path, document.read_document(source.path)[0])[0]


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of the block; those of a CRS of their own lose their coordinates."""
    root, texts = document.read_document(source.path)
    return document.read_ties(source.path, texts, cameras, read_photos(source.path, root)[1])


EXIF_CRS = "EPSG:4326"
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


def read_photos(path: Path, root: Element) -> tuple[Cameras, document.Rows]:
    """Read all photos of a document."""
    blocks = list(root.iter("Block"))
    photos: list[Photo] = []
    unposed: list[str] = []
    groups: dict[tuple[int, str], document.Photogroup] = {}
    for number_of_block, block in enumerate(blocks):
        for element in block.iter("Photogroup"):
            group = document.Photogroup(path, element)
            srs = document.text_of(element, "SRSId") or document.text_of(block, "SRSId")
            found, without = _of_group(path, number_of_block, group, srs)
            photos += found
            unposed += without
            groups.update({photo.key: group for photo in found})
        unposed += [_label(element) for element in block.iterfind("BulkPhotos/Photo")]
    photos, others, notes = _of_one_frame(path, photos, _ignored(path, root))
    srs = photos[0].srs
    rotations = [photo.rotation for photo in photos if photo.rotation is not None]
    lenses = [photo.lens for photo in photos if photo.lens is not None]
    cameras = Cameras(
        labels=tuple(photo.label for photo in photos),
        centres=np.array([photo.centre for photo in photos]),
        rotations=np.array(rotations) if rotations else None,
        lenses=tuple(lenses) if rotations and len(lenses) == len(photos) else None,
        crs=document.crs_of(path, root, srs),
        notes=notes,
        gnss=_gnss(path, root, photos),
        unposed=tuple(unposed + others),
        source="BlocksExchange",
    )
    row_of = {photo.key: row for row, photo in enumerate(photos)}
    return cameras, document.Rows(
        row_of, groups, srs, [document.text_of(block, "SRSId") for block in blocks]
    )


def _of_group(
    path: Path, block: int, group: document.Photogroup, srs: str
) -> tuple[list[Photo], list[str]]:
    """Return the photos of a group that have a position, and the names of the others."""
    lens, axes = group.lens(), group.axes()
    found, without, posed = [], [], group.is_used("ManualPose")
    for element in group.element.iterfind("Photo"):
        label = _label(element)
        centre = element.find("Pose/Center")
        if centre is None or not posed:
            without.append(label)
            continue
        photo = Photo(
            key=(block, document.text_of(element, "Id")),
            label=label,
            centre=_numbers(path, f"image {label}, Center", centre, "xyz"),
            rotation=_rotation(path, label, element.find("Pose/Rotation"), axes),
            lens=lens,
            srs=srs,
            component=document.text_of(element, "Component") or MAIN_COMPONENT,
            prior=_prior(path, label, element, srs),
        )
        found.append(photo)
    return found, without


def _ignored(path: Path, root: Element) -> tuple[str, ...]:
    """Return what is said of photogroups with poses that software ignores."""
    groups = [document.Photogroup(path, element) for element in root.iter("Photogroup")]
    names = [group.name for group in groups if not group.is_used("ManualPose")]
    if not names:
        return ()
    return (
        f"{path}: the poses of photogroup {', '.join(names[:10])} are not those of the block"
        " (ManualPose is false): its photos are left out.",
    )


def _of_one_frame(
    path: Path, photos: list[Photo], notes: tuple[str, ...]
) -> tuple[list[Photo], list[str], tuple[str, ...]]:
    """Return the photos that belong together, the names of the others, and what to tell."""
    whole = [photo for photo in photos if photo.component == MAIN_COMPONENT] or photos
    turned = [photo for photo in whole if photo.rotation is not None]
    kept = turned or whole
    if not kept:
        raise InputError(
            f"{path}: no photo has a pose"
            + (" of the block (ManualPose is false)" if notes else "")
            + "; export the block after the aerotriangulation."
        )
    boundless = next((photo.label for photo in kept if photo.lens is None), None)
    if not turned:
        notes += (f"{path}: no photo has a rotation, only positions are read.",)
    elif boundless is not None:
        notes += (
            f"{path}: image {boundless}: its photogroup has no frame or focal length; frames are"
            " taken as boundless.",
        )
    block_of: dict[str, int] = {}
    for photo in kept:
        if block_of.setdefault(photo.label, photo.key[0]) != photo.key[0]:
            raise InputError(
                f"{path}: image {photo.label} is in several blocks of the file; export the one"
                " block that the cloud was made from."
            )
    systems = sorted({photo.srs for photo in kept})
    if len(systems) > 1:
        raise InputError(
            f"{path}: the positions are in several spatial reference systems (ids"
            f" {', '.join(i or 'local' for i in systems)}); export the block in one."
        )
    ids = {photo.key for photo in kept}
    return kept, [photo.label for photo in photos if photo.key not in ids], notes


def _rotation(
    path: Path, label: str, element: Element | None, axes: FloatArray
) -> FloatArray | None:
    """Return world to x right, y down, z forward; None where there is no rotation."""
    if element is None or len(element) == 0:
        return None
    where = f"image {label}"
    if element.find("M_00") is not None:
        names = [f"M_{row}{column}" for row in range(3) for column in range(3)]
        matrix = _named_numbers(path, where, element, names).reshape(3, 3)
    elif element.find("Omega") is not None:
        angles = _named_numbers(path, where, element, ["Omega", "Phi", "Kappa"])
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
        own = document.text_of(element, "Pose/Metadata/SRSId")
        return own or srs, _numbers(path, f"image {label}, Metadata", centre, "xyz")
    gps = element.find("ExifData/GPS")
    names = ["Longitude", "Latitude", "Altitude"]
    if gps is not None and all(gps.findtext(name) for name in names):
        return "exif", _named_numbers(path, f"image {label}, GPS", gps, names)
    return None


def _gnss(path: Path, root: Element, photos: list[Photo]) -> GnssPositions | None:
    """Return one row per photo; positions in the CRS that the first of them has."""
    srs = next((photo.prior[0] for photo in photos if photo.prior is not None), None)
    if srs is None:
        return None
    xyz = np.full((len(photos), 3), np.nan)
    for row, photo in enumerate(photos):
        if photo.prior is not None and photo.prior[0] == srs:
            xyz[row] = photo.prior[1]
    crs = EXIF_CRS if srs == "exif" else document.crs_of(path, root, srs)
    return GnssPositions(xyz, np.full_like(xyz, np.nan), crs)


def _numbers(path: Path, where: str, element: Element, names: Iterable[str]) -> FloatArray:
    return np.array([number(path, where, element.findtext(name)) for name in names])


def _named_numbers(path: Path, where: str, element: Element, names: list[str]) -> FloatArray:
    return np.array([number(path, f"{where}, {name}", element.findtext(name)) for name in names])


def _label(element: Element) -> str:
    """Return the name of the image file, or the id of a photo without one."""
    name = PureWindowsPath(document.text_of(element, "ImagePath")).name
    return name or f"photo {document.text_of(element, 'Id')}"
