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

Software ignores poses where ManualPose is false, and lenses where ManualOpticalParams is. The cloud
was not made with these, so they are not read.

GNSS positions are in Pose/Metadata, or in the GPS of ExifData. Tie
points can be in a file of their own, and either file in a zip archive (.xmlz).

References: Bentley, ContextCapture User Guide, "BlocksExchange XML/XMLZ format", "Perspective
camera model", "Fisheye camera model"; Bentley developer documentation, "CC Orientations". The
order of P1 and P2 and the factor pi / 2 follow converters that cite those pages.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, PcfixWarning, bad_file
from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.checks import damaged, number, read_xml
from pcfix.io.cameras.formats import Source
from pcfix.lens.rotations import from_omega_phi_kappa, from_photogrammetric
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, TiePoints

ZIP_MAGIC = b"PK\x03\x04"
COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
TIE_POINTS = re.compile(rb"<TiePoints>(.*?)</TiePoints>", re.DOTALL)
LARGEST_RATIO = 200
"""Of an archive: XML packs 10 to 30 times smaller, a bomb a thousand times."""
EXIF_CRS = "EPSG:4326"
MAIN_COMPONENT = "1"
FIRST_PIXEL = 0.5
"""The centre of the first pixel, seen from its corner."""
BROWN = (("K1", "K2", "K3"), ("P1", "P2"))
DIRECTIONS = {"Right": (1, 0), "Left": (-1, 0), "Down": (0, 1), "Up": (0, -1)}
ORIENTATIONS = {
    f"X{x}Y{y}": np.array([(*DIRECTIONS[x], 0.0), (*DIRECTIONS[y], 0.0)])
    for x in DIRECTIONS
    for y in DIRECTIONS
    if (x in ("Right", "Left")) != (y in ("Right", "Left"))
}


def recognises(source: Source) -> bool:
    """Whether the root element is BlocksExchange, in a plain file or a zip archive."""
    if source.head.startswith(ZIP_MAGIC):
        with zipfile.ZipFile(source.path) as archive:
            stream = archive.open(_document_name(source.path, archive))
            return b"<BlocksExchange" in stream.read(4096)
    return "<BlocksExchange" in source.text


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the block."""
    return _read_photos(source.path, _read_document(source.path)[0])[0]


def _read_document(path: Path) -> tuple[Element, list[tuple[int, bytes]]]:
    """Return the root element without its tie points, and those as text with their block's number.

    There can be millions of measurements, which a tree of elements would take minutes for.
    """
    data = _read_bytes(path)
    found = [
        (data.count(b"<Block>", 0, match.start()) - 1, match[1])
        for match in TIE_POINTS.finditer(data)
    ]
    return read_xml(path, io.BytesIO(TIE_POINTS.sub(b"", data))), found


def _read_bytes(path: Path) -> bytes:
    """Return a file, or the XML document in a zip archive, without comments."""
    data = path.read_bytes()
    if data.startswith(ZIP_MAGIC):
        with checks.reading(path), zipfile.ZipFile(path) as archive:
            data = archive.read(_document_name(path, archive))
    return COMMENT.sub(b"", data)


def _document_name(path: Path, archive: zipfile.ZipFile) -> str:
    for entry in archive.infolist():
        if entry.filename.lower().endswith(".xml"):
            if entry.file_size > LARGEST_RATIO * (entry.compress_size + 1):
                raise damaged(path, "the archive unpacks to far too much")
            return entry.filename
    raise damaged(path, "the archive has no XML document")


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


class Rows(NamedTuple):
    """For the tie points: row and group of each photo by block and id, and ids of the SRS."""

    of: dict[tuple[int, str], int]
    groups: dict[tuple[int, str], Photogroup]
    srs: str
    srs_of_blocks: list[str]


def _read_photos(path: Path, root: Element) -> tuple[Cameras, Rows]:
    """Read all photos of a document."""
    blocks = list(root.iter("Block"))
    everything: list[Photo] = []
    unposed: list[str] = []
    ignored: list[str] = []
    groups: dict[tuple[int, str], Photogroup] = {}
    for number_of_block, block in enumerate(blocks):
        for element in block.iter("Photogroup"):
            group = Photogroup(path, element)
            srs = _text(element, "SRSId") or _text(block, "SRSId")
            posed = group.is_used("ManualPose")
            ignored += [] if posed else [group.name]
            lens, axes = group.lens(), group.axes()
            for photo in element.iterfind("Photo"):
                if not posed or photo.find("Pose/Center") is None:
                    unposed.append(_label(photo))
                    continue
                everything.append(_photo(path, number_of_block, photo, lens, axes, srs))
                groups[everything[-1].key] = group
        unposed += [_label(element) for element in block.iterfind("BulkPhotos/Photo")]
    photos, notes = _of_one_frame(path, everything, ignored)
    keys, srs = {photo.key for photo in photos}, photos[0].srs
    rotations = [photo.rotation for photo in photos if photo.rotation is not None]
    lenses = [photo.lens for photo in photos if photo.lens is not None]
    cameras = Cameras(
        labels=tuple(photo.label for photo in photos),
        centres=np.array([photo.centre for photo in photos]),
        rotations=np.array(rotations) if rotations else None,
        lenses=tuple(lenses) if rotations and len(lenses) == len(photos) else None,
        crs=_crs_of(path, root, srs),
        notes=notes,
        gnss=_gnss(path, root, photos),
        unposed=(*unposed, *(photo.label for photo in everything if photo.key not in keys)),
        source="BlocksExchange",
    )
    row_of = {photo.key: row for row, photo in enumerate(photos)}
    return cameras, Rows(row_of, groups, srs, [_text(block, "SRSId") for block in blocks])


def _photo(
    path: Path, block: int, element: Element, lens: Lens | None, axes: FloatArray, srs: str
) -> Photo:
    """Return a photo that has a position."""
    label = _label(element)
    return Photo(
        key=(block, _text(element, "Id")),
        label=label,
        centre=_numbers(path, f"image {label}", element, [f"Pose/Center/{a}" for a in "xyz"]),
        rotation=_rotation(path, label, element.find("Pose/Rotation"), axes),
        lens=lens,
        srs=srs,
        component=_text(element, "Component") or MAIN_COMPONENT,
        prior=_prior(path, label, element, srs),
    )


def _of_one_frame(
    path: Path, photos: list[Photo], ignored: list[str]
) -> tuple[list[Photo], tuple[PcfixWarning, ...]]:
    """Return the photos that belong together, and notes on them."""
    in_block = [photo for photo in photos if photo.component == MAIN_COMPONENT] or photos
    turned = [photo for photo in in_block if photo.rotation is not None]
    kept = turned or in_block
    if not kept:
        why = " of the block (ManualPose is false)" if ignored else ""
        raise checks.no_pose(path, f"no photo has a pose{why}")
    notes = []
    if ignored:
        sentence = (
            f"{path}: the poses of photogroup {', '.join(ignored[:10])} are not those of the block"
            " (ManualPose is false). Its photos are left out."
        )
        notes.append(PcfixWarning("cameras.poses_ignored", sentence, photogroups=ignored))
    boundless = next((photo.label for photo in kept if photo.lens is None), None)
    if not turned:
        sentence = f"{path}: no photo has a rotation, only positions are read."
        notes.append(PcfixWarning("cameras.no_rotations", sentence))
    elif boundless is not None:
        why = f"the photogroup of {boundless} has no frame or focal length"
        notes.append(checks.without_lens(path, why))
    systems = {photo.srs for photo in kept}
    block_of: dict[str, int] = {}
    twice = [p.label for p in kept if block_of.setdefault(p.label, p.key[0]) != p.key[0]]
    if twice or len(systems) > 1:
        why = f"image {twice[0]} is in several blocks" if twice else "it has several SRS"
        sentence = f"{why}. Export the one block that the cloud was made from, in one SRS."
        raise bad_file(path, "cameras.several_blocks", sentence)
    return kept, tuple(notes)


def _rotation(
    path: Path, label: str, element: Element | None, axes: FloatArray
) -> FloatArray | None:
    """Return world to x right, y down, z forward; None where there is no rotation."""
    if element is None:
        return None
    if element.find("M_00") is not None:
        names = [f"M_{row}{column}" for row in range(3) for column in range(3)]
        return axes @ _numbers(path, f"image {label}", element, names).reshape(3, 3)
    if element.find("Omega") is not None:
        angles = _numbers(path, f"image {label}", element, ["Omega", "Phi", "Kappa"])
        matrix = from_photogrammetric(from_omega_phi_kappa(*angles.reshape(3, 1)))[0]
        return np.asarray(axes @ matrix)
    if element.find("Pitch") is not None:
        what = f"the rotation of {label} by yaw (or heading), pitch and roll"
        remedy = "Export rotations as matrices or omega, phi, kappa"
        raise checks.unsupported(path, what, remedy, image=label)
    return None


def _prior(path: Path, label: str, element: Element, srs: str) -> tuple[str, FloatArray] | None:
    """Return the SRS id ("exif" for that of EXIF) and position before the adjustment."""
    metadata, gps = element.find("Pose/Metadata"), element.find("ExifData/GPS")
    if metadata is not None and metadata.find("Center") is not None:
        names = [f"Center/{axis}" for axis in "xyz"]
        where = f"image {label}, Metadata"
        return _text(metadata, "SRSId") or srs, _numbers(path, where, metadata, names)
    names = ["Longitude", "Latitude", "Altitude"]
    if gps is not None and all(gps.findtext(name) for name in names):
        return "exif", _numbers(path, f"image {label}, GPS", gps, names)
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
    crs = EXIF_CRS if srs == "exif" else _crs_of(path, root, srs)
    return GnssPositions(xyz, np.full_like(xyz, np.nan), crs)


def _crs_of(path: Path, root: Element, srs_id: str) -> str:
    """Return the CRS of an id as `Cameras` has it; without an id the frame is local."""
    if not srs_id:
        return "local"
    definitions = {_text(srs, "Id"): _text(srs, "Definition") for srs in root.iter("SRS")}
    if srs_id not in definitions:
        raise damaged(path, f"there is no spatial reference system with the id {srs_id}")
    definition = definitions[srs_id]
    if not definition.upper().startswith("ENU:"):
        return checks.crs(path, definition)
    words = [*definition[4:].split(","), "0"][:3]
    latitude, longitude, _ = (float(word) for word in words)
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
        raise damaged(path, f"'{definition[:80]}' is not ENU:latitude,longitude in degrees")
    return "ENU:" + ",".join(word.strip() for word in words)


def _numbers(path: Path, where: str, element: Element, names: Sequence[str]) -> FloatArray:
    return np.array([number(path, f"{where}, {name}", element.findtext(name)) for name in names])


def _label(element: Element) -> str:
    """Return the name of the image file, or the id of a photo without one."""
    name = PureWindowsPath(_text(element, "ImagePath")).name
    return name or f"photo {_text(element, 'Id')}"


def _text(element: Element, name: str) -> str:
    """Return the text of an element inside another, empty where there is none."""
    return (element.findtext(name) or "").strip()


class Photogroup:
    """What the photos of a group share; its numbers are read with messages that name the group."""

    def __init__(self, path: Path, element: Element) -> None:
        self.path = path
        self.element = element
        self.name = (element.findtext("Name") or "without a name").strip()

    def number(self, name: str) -> float | None:
        """Return the number of an element, or None where the group has no such element."""
        text = self.element.findtext(name)
        where = f"photogroup {self.name}, {name}"
        return number(self.path, where, text) if text and text.strip() else None

    def numbers(self, parent: str, names: tuple[str, ...]) -> list[float]:
        """Return numbers below an element, 0 for those that are not there."""
        return [self.number(f"{parent}/{name}") or 0.0 for name in names]

    def is_used(self, name: str) -> bool:
        """Whether software uses what the group has: `ManualPose`, `ManualOpticalParams`."""
        return _text(self.element, name).lower() != "false"

    def axes(self) -> FloatArray:
        """Return the matrix from camera axes to x right, y down, z forward."""
        name = _text(self.element, "CameraOrientation") or "XRightYDown"
        if name not in ORIENTATIONS:
            raise self._unsupported(f"camera orientation {name}")
        x, y = ORIENTATIONS[name]
        return np.column_stack([x, y, np.cross(x, y)])

    def pixel_size_mm(self) -> float | None:
        """Return the size of a pixel, None where the group has none."""
        pixel, sensor = self.number("PixelSize"), self.number("SensorSize")
        if pixel is not None:
            return pixel if pixel > 0.0 else None
        largest = max(self.size())
        return sensor / largest if sensor is not None and sensor > 0.0 < largest else None

    def size(self) -> list[float]:
        """Return width and height in pixels, 0 where they are not there."""
        return self.numbers("ImageDimensions", ("Width", "Height"))

    def lens(self) -> Lens | None:
        """Return the lens, or None where the group lacks frame or focal length, or is not used."""
        if not self.is_used("ManualOpticalParams"):
            return None
        kind = _text(self.element, "CameraModelType") or "Perspective"
        if kind not in ("Perspective", "Fisheye"):
            raise self._unsupported(f"camera model {kind}")
        for tag in (str(child.tag) for child in self.element):
            if "Distortion" in tag and tag not in ("Distortion", "FisheyeDistortion"):
                raise self._unsupported(f"distortion {tag}")
        matrix, (width, height) = self._matrix(kind), self.size()
        if matrix is None or not min(width, height) > 0.0:
            return None
        m00, m01, m10, m11 = matrix
        u, v = self.principal_point()
        lens = Lens(
            *(m11, width, height, u, v, m00 - m11, m01, m10),
            pixel_size_mm=self.pixel_size_mm(),
            sensor=self.name,
        )
        if kind == "Perspective":
            radial, tangential = (self.numbers("Distortion", names) for names in BROWN)
            lens = replace(lens, radial=tuple(radial), tangential=tuple(tangential))
        else:
            shape = [0.0, 1.0, 0.0, 0.0, 0.0]
            if self.element.find("FisheyeDistortion") is not None:
                shape = self.numbers("FisheyeDistortion", ("P0", "P1", "P2", "P3", "P4"))
            lens = replace(lens, projection="polynomial", shape=tuple(shape))
        return lens

    def _unsupported(self, what: str) -> InputError:
        what, remedy = f"the {what} of photogroup {self.name}", "Export undistorted photos"
        return checks.unsupported(self.path, what, remedy, photogroup=self.name)

    def principal_point(self) -> tuple[float, float]:
        """Return the principal point in pixels from the corner; the centre where none is given."""
        x, y = self.number("PrincipalPoint/x"), self.number("PrincipalPoint/y")
        if x is not None and y is not None:
            return x + FIRST_PIXEL, y + FIRST_PIXEL
        u, v = np.array(self.size()) / 2.0
        if (pixel := self.pixel_size_mm()) is not None:
            mm = np.array(self.numbers("PrincipalPoint", ("xmm", "ymm")))
            u, v = (u, v) + self.axes()[:2, :2] @ mm / pixel
        return float(u), float(v)

    def _matrix(self, kind: str) -> list[float] | None:
        """Return the focal lengths and skews, a matrix by rows, or None where there are none."""
        if kind == "Fisheye" and self.element.find("FisheyeFocalMatrix") is not None:
            return self.numbers("FisheyeFocalMatrix", ("M_00", "M_01", "M_10", "M_11"))
        focal, focal_mm = self.number("FocalLengthPixels"), self.number("FocalLength")
        if focal is None and focal_mm is not None and (pixel := self.pixel_size_mm()) is not None:
            focal = focal_mm / pixel
        if focal is None:
            return None
        if kind == "Fisheye":
            return [math.pi / 2.0 * focal, 0.0, 0.0, math.pi / 2.0 * focal]
        aspect = self.number("AspectRatio")
        return [focal, self.number("Skew") or 0.0, 0.0, focal if aspect is None else focal * aspect]


EXTERNAL = re.compile(rb"<Path>\s*([^<]*?)\s*</Path>")
DECLARATION = re.compile(rb"<\?xml.*?\?>")
SRS_OF_ALL = re.compile(rb"<SRSId>\s*([^<]*?)\s*</SRSId>")


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points that a posed photo saw; those of another CRS lose their coordinates."""
    path = source.path
    root, texts = _read_document(path)
    rows = _read_photos(path, root)[1]
    xyz: list[list[float]] = []
    point, camera, uv = [], [], []
    for block, text in texts:
        where, inside = _inside(path, text)
        head = SRS_OF_ALL.search(inside[: inside.find(b"<TiePoint>")])
        srs_of_all = rows.srs_of_blocks[block] if head is None else head[1].decode()
        with checks.reading(where):
            for element in _elements(inside):
                keys = [(block, _text(m, "PhotoId")) for m in element.iterfind("Measurement")]
                pairs = zip(keys, element.iterfind("Measurement"), strict=True)
                seen = [(key, mark) for key, mark in pairs if key in rows.of]
                for key, mark in seen:
                    point.append(len(xyz))
                    camera.append(rows.of[key])
                    uv.append(_place(mark, rows.groups[key]))
                place = element.find("Position")
                is_here = (_text(element, "SRSId") or srs_of_all) == rows.srs
                if seen and place is not None and is_here:
                    xyz.append([float(_text(place, axis)) for axis in "xyz"])
                elif seen:
                    xyz.append([math.nan] * 3)
    if not xyz:
        raise tracks.no_tie_points(path, f"none was seen by one of its {len(cameras)} photos")
    return tracks.tie_points(
        tracks.Seen(np.array(xyz), np.array(point), np.array(camera), np.array(uv))
    )


def _inside(path: Path, text: bytes) -> tuple[Path, bytes]:
    """Return the text itself, or that of the file beside the document that it names."""
    other = EXTERNAL.search(text)
    if other is None:
        return path, text
    plain = other[1].decode(errors="replace").replace("\\", "/")
    for place in (path.parent / plain, path.parent / PureWindowsPath(plain).name):
        if place.is_file():
            return place, DECLARATION.sub(b"", _read_bytes(place))
    raise checks.missing(path.parent / plain, "Keep the file of the tie points beside the block")


def _elements(text: bytes) -> Iterator[Element]:
    """Yield the tie points of a text one by one, so that no tree holds millions of them."""
    from defusedxml.ElementTree import iterparse

    for _, element in iterparse(io.BytesIO(b"<All>" + text + b"</All>")):
        if element.tag == "TiePoint":
            yield element
            element.clear()


def _place(mark: Element, group: Photogroup) -> tuple[float, float]:
    """Return u, v in pixels from the corner, of a place in pixels or in mm."""
    if mark.find("x") is not None and mark.find("y") is not None:
        return float(_text(mark, "x")) + FIRST_PIXEL, float(_text(mark, "y")) + FIRST_PIXEL
    pixel = group.pixel_size_mm()
    if pixel is None:
        raise ValueError("a measurement is in mm, but its photogroup has no pixel size")
    mm = np.array([float(_text(mark, name)) for name in ("xmm", "ymm")])
    u, v = group.principal_point() + group.axes()[:2, :2] @ mm / pixel
    return float(u), float(v)
