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
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, bad_file
from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.checks import ZIP_MAGIC, Source, damaged, note, number, read_xml, text_of
from pcfix.lens.rotations import from_omega_phi_kappa, from_photogrammetric
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, TiePoints

COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
TIE_POINTS = re.compile(rb"<TiePoints>(.*?)</TiePoints>", re.DOTALL)
EXTERNAL = re.compile(rb"<Path>\s*([^<]*?)\s*</Path>")
DECLARATION = re.compile(rb"<\?xml.*?\?>")
SRS_OF_ALL = re.compile(rb"<SRSId>\s*([^<]*?)\s*</SRSId>")
LARGEST_RATIO = 200
"""Of an archive: XML packs 10 to 30 times smaller, a bomb a thousand times."""
MAIN_COMPONENT = "1"
CENTRE = [f"Pose/Center/{axis}" for axis in "xyz"]
DEGREES = ["Longitude", "Latitude", "Altitude"]
FIRST_PIXEL = 0.5
"""The centre of the first pixel, seen from its corner."""
DIRECTIONS = {"Right": (1, 0, 0), "Left": (-1, 0, 0), "Down": (0, 1, 0), "Up": (0, -1, 0)}


def recognises(source: Source) -> bool:
    """Whether the root element is BlocksExchange, in a plain file or a zip archive."""
    if source.head.startswith(ZIP_MAGIC):
        return b"<BlocksExchange" in _read_bytes(source.path)[:4096]
    return "<BlocksExchange" in source.text


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the block."""
    return _read_block(source.path)[0]


def _read_bytes(path: Path) -> bytes:
    """Return a file, or the XML document in a zip archive, without comments."""
    data = path.read_bytes()
    if data.startswith(ZIP_MAGIC):
        with checks.reading(path), zipfile.ZipFile(path) as archive:
            found = [e for e in archive.infolist() if e.filename.lower().endswith(".xml")]
            if not found:
                raise damaged(path, "the archive has no XML document")
            entry = found[0]
            if entry.file_size > LARGEST_RATIO * (entry.compress_size + 1):
                raise damaged(path, "the archive unpacks to far too much")
            data = archive.read(entry)
    return COMMENT.sub(b"", data)


class Photo(NamedTuple):
    """A photo with at least a position; `key` is its block and id, `prior` its GNSS position."""

    key: tuple[int, str]
    label: str
    group: Photogroup
    centre: FloatArray
    rotation: FloatArray | None
    srs: str
    prior: tuple[str, FloatArray] | None


def _read_block(path: Path) -> tuple[Cameras, list[Photo], list[tuple[int, str, bytes]]]:
    """Read all photos of a document, and the texts of its tie points.

    The texts have the number and the SRS id of their block: a tree of elements for millions of
    measurements would take minutes.
    """
    data = _read_bytes(path)
    root = read_xml(path, io.BytesIO(TIE_POINTS.sub(b"", data)))
    posed: list[Photo] = []
    outside: list[Photo] = []
    unposed: list[str] = []
    ignored: list[str] = []
    blocks = list(root.iter("Block"))
    for i, block in enumerate(blocks):
        for element in block.iter("Photogroup"):
            group = Photogroup(path, element)
            is_used = group.is_used("ManualPose")
            ignored += [] if is_used else [group.name]
            for photo in element.iterfind("Photo"):
                if not is_used or photo.find("Pose/Center") is None:
                    unposed.append(_label(photo))
                    continue
                is_main = text_of(photo, "Component") in ("", MAIN_COMPONENT)
                srs = text_of(element, "SRSId") or text_of(block, "SRSId")
                label, key = _label(photo), (i, text_of(photo, "Id"))
                centre = _numbers(path, f"image {label}", photo, CENTRE)
                turn = _rotation(path, label, photo.find("Pose/Rotation"), group.axes)
                prior = _prior(path, label, photo, srs)
                one = Photo(key, label, group, centre, turn, srs, prior)
                (posed if is_main else outside).append(one)
        unposed += [_label(element) for element in block.iterfind("BulkPhotos/Photo")]
    everything = posed + outside
    in_block = posed or outside
    turned = [photo for photo in in_block if photo.rotation is not None]
    photos = turned or in_block
    if not photos:
        why = " of the block (ManualPose is false)" if ignored else ""
        raise checks.no_pose(path, f"no photo has a pose{why}")
    block_of: dict[str, int] = {}
    twice = [p.label for p in photos if block_of.setdefault(p.label, p.key[0]) != p.key[0]]
    if twice or len({photo.srs for photo in photos}) > 1:
        why = f"image {twice[0]} is in several blocks" if twice else "it has several SRS"
        sentence = f"{why}. Export the one block that the cloud was made from, in one SRS."
        raise bad_file(path, "cameras.several_blocks", sentence)
    lenses = [photo.group.lens for photo in photos if photo.group.lens is not None]
    gnss, nothing = None, np.full(3, np.nan)
    of = next((photo.prior[0] for photo in photos if photo.prior is not None), None)
    if of is not None:  # positions in the CRS that the first of them has
        xyz = np.array([p.prior[1] if p.prior and p.prior[0] == of else nothing for p in photos])
        crs = "EPSG:4326" if of == "exif" else _crs_of(path, root, of)
        gnss = GnssPositions(xyz, np.full_like(xyz, np.nan), crs)
    notes = []
    if ignored:
        sentence = f"photogroup {', '.join(ignored[:10])} is skipped (its ManualPose is false)."
        notes.append(note(path, "cameras.poses_ignored", sentence, photogroups=ignored))
    if not turned:
        notes.append(note(path, "cameras.no_rotations", "no photo has a rotation, only positions."))
    elif (bare := next((p for p in photos if p.group.lens is None), None)) is not None:
        why = f"the photogroup of {bare.label} has no frame or focal length"
        notes.append(checks.without_lens(path, why))
    chosen = {photo.key for photo in photos}
    cameras = Cameras(
        labels=tuple(photo.label for photo in photos),
        centres=np.array([photo.centre for photo in photos]),
        rotations=np.array([photo.rotation for photo in photos]) if turned else None,
        lenses=tuple(lenses) if turned and len(lenses) == len(photos) else None,
        crs=_crs_of(path, root, photos[0].srs),
        notes=tuple(notes),
        gnss=gnss,
        unposed=(*unposed, *(photo.label for photo in everything if photo.key not in chosen)),
        source="BlocksExchange",
    )
    texts = []
    for match in TIE_POINTS.finditer(data):
        i = data.count(b"<Block>", 0, match.start()) - 1
        texts.append((i, text_of(blocks[i], "SRSId"), match[1]))
    return cameras, photos, texts


def _prior(path: Path, label: str, photo: Element, srs: str) -> tuple[str, FloatArray] | None:
    """Return the GNSS position of a photo, and its SRS id, which is "exif" for WGS 84."""
    metadata, gps = photo.find("Pose/Metadata"), photo.find("ExifData/GPS")
    if metadata is not None and metadata.find("Center") is not None:
        place = _numbers(path, f"image {label}, Metadata", metadata, [f"Center/{a}" for a in "xyz"])
        return text_of(metadata, "SRSId") or srs, place
    if gps is not None and all(gps.findtext(name) for name in DEGREES):
        return "exif", _numbers(path, f"image {label}, GPS", gps, DEGREES)
    return None


def _rotation(
    path: Path, label: str, element: Element | None, axes: FloatArray
) -> FloatArray | None:
    """Return world to x right, y down, z forward; None where there is no rotation."""
    if element is None:
        return None
    where = f"image {label}"
    if element.find("M_00") is not None:
        names = [f"M_{row}{column}" for row in range(3) for column in range(3)]
        return axes @ _numbers(path, where, element, names).reshape(3, 3)
    if element.find("Omega") is not None:
        angles = _numbers(path, where, element, ["Omega", "Phi", "Kappa"])
        matrix = from_photogrammetric(from_omega_phi_kappa(*angles.reshape(3, 1)))[0]
        return np.asarray(axes @ matrix)
    if element.find("Pitch") is not None:
        what = f"the rotation of {label} by yaw (or heading), pitch and roll"
        raise checks.unsupported(path, what, "Export rotations as matrices", image=label)
    return None


def _crs_of(path: Path, root: Element, srs_id: str) -> str:
    """Return the CRS of an id as `Cameras` has it; without an id the frame is local."""
    if not srs_id:
        return "local"
    definitions = {text_of(srs, "Id"): srs.findtext("Definition") or "" for srs in root.iter("SRS")}
    if srs_id not in definitions:
        raise damaged(path, f"there is no spatial reference system with the id {srs_id}")
    definition = definitions[srs_id].strip()
    if not definition.upper().startswith("ENU:"):
        return checks.crs(path, definition)
    words = [word.strip() for word in [*definition[4:].split(","), "0"][:3]]
    latitude, longitude, _ = map(float, words)
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
        raise damaged(path, f"'{definition[:80]}' is not ENU:latitude,longitude in degrees")
    return "ENU:" + ",".join(words)


def _numbers(path: Path, where: str, element: Element, names: Sequence[str]) -> FloatArray:
    return np.array([number(path, f"{where}, {name}", element.findtext(name)) for name in names])


def _label(element: Element) -> str:
    """Return the name of the image file, or the id of a photo without one."""
    name = PureWindowsPath(text_of(element, "ImagePath")).name
    return name or f"photo {text_of(element, 'Id')}"


class Photogroup:
    """What the photos of a group share: camera axes, frame, pixel size and lens, None if unknown.

    `axes` is the matrix from camera axes to x right, y down, z forward.
    """

    def __init__(self, path: Path, element: Element) -> None:
        self.path, self.element = path, element
        self.name = (element.findtext("Name") or "without a name").strip()
        orientation = text_of(element, "CameraOrientation") or "XRightYDown"
        words = re.fullmatch("X(Right|Left|Up|Down)Y(Right|Left|Up|Down)", orientation)
        x, y = (DIRECTIONS[word] for word in words.groups()) if words else ((0, 0, 0), (0, 0, 0))
        self.axes = np.column_stack([x, y, np.cross(x, y)]).astype(np.float64)
        if not self.axes[:, 2].any():
            raise self._unsupported(f"camera orientation {orientation}")
        self.width, self.height = self.numbers("ImageDimensions", ("Width", "Height"))
        pixel, sensor = self.number("PixelSize"), self.number("SensorSize")
        if pixel is None and sensor is not None and self.width > 0.0:
            pixel = sensor / max(self.width, self.height)
        self.pixel_size_mm = pixel if pixel is not None and pixel > 0.0 else None
        self.lens = self._lens() if self.is_used("ManualOpticalParams") else None

    def number(self, name: str) -> float | None:
        """Return the number of an element, or None where the group has no such element."""
        text = text_of(self.element, name)
        return number(self.path, f"photogroup {self.name}, {name}", text) if text else None

    def numbers(self, parent: str, names: Sequence[str]) -> list[float]:
        """Return numbers below an element, 0 for those that are not there."""
        return [self.number(f"{parent}/{name}") or 0.0 for name in names]

    def is_used(self, name: str) -> bool:
        """Whether software uses what the group has: `ManualPose`, `ManualOpticalParams`."""
        return text_of(self.element, name).lower() != "false"

    def principal_point(self) -> FloatArray:
        """Return the principal point in pixels from the corner; the centre where none is given."""
        x, y = self.number("PrincipalPoint/x"), self.number("PrincipalPoint/y")
        if x is not None and y is not None:
            return np.array([x, y]) + FIRST_PIXEL
        middle = np.array([self.width, self.height]) / 2.0
        if self.pixel_size_mm is None:
            return middle
        mm = self.numbers("PrincipalPoint", ("xmm", "ymm"))
        return middle + self.axes[:2, :2] @ mm / self.pixel_size_mm

    def place(self, mark: Element) -> FloatArray:
        """Return u, v in pixels from the corner, of a measurement in pixels or in mm."""
        if mark.find("x") is not None and mark.find("y") is not None:
            return np.array([float(text_of(mark, axis)) for axis in "xy"]) + FIRST_PIXEL
        if self.pixel_size_mm is None:
            raise ValueError("a measurement is in mm, but its photogroup has no pixel size")
        mm = np.array([float(text_of(mark, name)) for name in ("xmm", "ymm")])
        return self.principal_point() + self.axes[:2, :2] @ mm / self.pixel_size_mm

    def _unsupported(self, what: str) -> InputError:
        what, remedy = f"the {what} of photogroup {self.name}", "Export undistorted photos"
        return checks.unsupported(self.path, what, remedy, photogroup=self.name)

    def _lens(self) -> Lens | None:
        """Return the lens, or None where the group lacks frame or focal length."""
        kind = text_of(self.element, "CameraModelType") or "Perspective"
        if kind not in ("Perspective", "Fisheye"):
            raise self._unsupported(f"camera model {kind}")
        for tag in (str(child.tag) for child in self.element):
            if "Distortion" in tag and tag not in ("Distortion", "FisheyeDistortion"):
                raise self._unsupported(f"distortion {tag}")
        focal, focal_mm = self.number("FocalLengthPixels"), self.number("FocalLength")
        if focal is None and focal_mm is not None and self.pixel_size_mm is not None:
            focal = focal_mm / self.pixel_size_mm
        matrix = None  # focal lengths and skews, by rows
        if kind == "Fisheye" and self.element.find("FisheyeFocalMatrix") is not None:
            matrix = self.numbers("FisheyeFocalMatrix", ("M_00", "M_01", "M_10", "M_11"))
        elif focal is not None and kind == "Fisheye":
            matrix = [math.pi / 2.0 * focal, 0.0, 0.0, math.pi / 2.0 * focal]
        elif focal is not None:
            aspect = self.number("AspectRatio")
            down = focal if aspect is None else focal * aspect
            matrix = [focal, self.number("Skew") or 0.0, 0.0, down]
        if matrix is None or not min(self.width, self.height) > 0.0:
            return None
        m00, m01, m10, m11 = matrix
        x, y = self.principal_point().tolist()
        lens = Lens(
            *(m11, self.width, self.height, x, y, m00 - m11, m01, m10),
            pixel_size_mm=self.pixel_size_mm,
            sensor=self.name,
        )
        if kind == "Perspective":
            radial = self.numbers("Distortion", ("K1", "K2", "K3"))
            tangential = self.numbers("Distortion", ("P1", "P2"))
            return replace(lens, radial=tuple(radial), tangential=tuple(tangential))
        shape = [0.0, 1.0, 0.0, 0.0, 0.0]
        if self.element.find("FisheyeDistortion") is not None:
            shape = self.numbers("FisheyeDistortion", ("P0", "P1", "P2", "P3", "P4"))
        return replace(lens, projection="polynomial", shape=tuple(shape))


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points that a posed photo saw; those of another CRS lose their coordinates."""
    from defusedxml.ElementTree import iterparse  # one by one: no tree holds millions of them

    path = source.path
    _, photos, texts = _read_block(path)
    row_of = {photo.key: row for row, photo in enumerate(photos)}
    xyz: list[list[float]] = []
    point, camera, uv = [], [], []
    for i, srs_of_block, text in texts:
        where, inside = path, text
        if (other := EXTERNAL.search(text)) is not None:  # the points are in a file of their own
            plain = other[1].decode(errors="replace").replace("\\", "/")
            places = (path.parent / plain, path.parent / PureWindowsPath(plain).name)
            where = next((place for place in places if place.is_file()), places[0])
            if not where.is_file():
                raise checks.missing(where, "Keep the file of the tie points beside the block")
            inside = DECLARATION.sub(b"", _read_bytes(where))
        head = SRS_OF_ALL.search(inside[: inside.find(b"<TiePoint>")])
        srs_of_all = srs_of_block if head is None else head[1].decode()
        with checks.reading(where):
            for _, element in iterparse(io.BytesIO(b"<All>" + inside + b"</All>")):
                if element.tag != "TiePoint":
                    continue
                seen = [
                    (row_of[key], mark)
                    for mark in element.iterfind("Measurement")
                    if (key := (i, text_of(mark, "PhotoId"))) in row_of
                ]
                if not seen:
                    element.clear()
                    continue
                for row, mark in seen:
                    point.append(len(xyz))
                    camera.append(row)
                    uv.append(photos[row].group.place(mark))
                place, srs = element.find("Position"), text_of(element, "SRSId") or srs_of_all
                known = place is not None and srs == photos[0].srs
                axes = [text_of(place, a) for a in "xyz"] if place is not None and known else ()
                xyz.append([float(text) for text in axes] or [math.nan] * 3)
                element.clear()
    if not xyz:
        raise tracks.no_tie_points(path, f"none was seen by one of its {len(cameras)} photos")
    seen_all = tracks.Seen(np.array(xyz), np.array(point), np.array(camera), np.array(uv))
    return tracks.tie_points(seen_all)
