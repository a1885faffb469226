"""The document, plain or zipped: reference systems, photogroups with their lenses, tie points."""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, NoTiePointsError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import number, read_xml
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.tracks import tie_points
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Lens, TiePoints

ZIP_MAGIC = b"PK\x03\x04"
COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
TIE_POINTS = re.compile(rb"<TiePoints>(.*?)</TiePoints>", re.DOTALL)
LARGEST_RATIO = 200
"""Of an archive: XML packs 10 to 30 times smaller, a bomb a thousand times."""


def is_archive_of_block(source: Source) -> bool:
    """Whether a file is a zip archive with a BlocksExchange document; never an error."""
    if not source.head.startswith(ZIP_MAGIC):
        return False
    try:
        with zipfile.ZipFile(source.path) as archive:
            stream = archive.open(_document_name(source.path, archive))
            return b"<BlocksExchange" in stream.read(4096)
    except (InputError, OSError, zipfile.BadZipFile, zlib.error, RuntimeError, ValueError):
        return False


def read_document(path: Path) -> tuple[Element, list[tuple[int, bytes]]]:
    """Return the root element without its tie points, and those as text with their block's number.

    There can be millions of measurements, which a tree of elements would take minutes for.
    """
    data = read_bytes(path)
    found = [
        (data.count(b"<Block>", 0, match.start()) - 1, match[1])
        for match in TIE_POINTS.finditer(data)
    ]
    return read_xml(path, io.BytesIO(TIE_POINTS.sub(b"", data))), found


def read_bytes(path: Path) -> bytes:
    """Return a file, or the XML document in a zip archive, without comments."""
    data = path.read_bytes()
    if data.startswith(ZIP_MAGIC):
        try:
            with zipfile.ZipFile(path) as archive:
                data = archive.read(_document_name(path, archive))
        except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, ValueError) as error:
            raise InputError(
                f"{path}: the archive is damaged ({error}); export it again."
            ) from error
    return COMMENT.sub(b"", data)


def _document_name(path: Path, archive: zipfile.ZipFile) -> str:
    for entry in archive.infolist():
        if entry.filename.lower().endswith(".xml"):
            if entry.file_size > LARGEST_RATIO * (entry.compress_size + 1):
                raise InputError(f"{path}: the archive unpacks to far too much; it is not read.")
            return entry.filename
    raise InputError(f"{path}: the archive has no XML document.")


def crs_of(path: Path, root: Element, srs_id: str) -> str:
    """Return the CRS of an id as `Cameras` has it; without an id the frame is local."""
    if not srs_id:
        return "local"
    definitions = {text_of(srs, "Id"): text_of(srs, "Definition") for srs in root.iter("SRS")}
    if srs_id not in definitions:
        raise InputError(
            f"{path}: there is no spatial reference system with the id {srs_id}; export the block"
            " again."
        )
    definition = definitions[srs_id]
    if not definition.upper().startswith("ENU:"):
        return checks.crs(path, definition)
    words = definition[4:].split(",")
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not abs(numbers[0]) <= 90 or not abs(numbers[1]) <= 360:
        raise InputError(f"{path}: '{definition[:80]}' is not ENU:latitude,longitude in degrees.")
    return "ENU:" + ",".join(word.strip() for word in [*words, "0"][:3])


def text_of(element: Element, name: str) -> str:
    """Return the text of an element inside another, empty where there is none."""
    return (element.findtext(name) or "").strip()


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
        return text_of(self.element, name).lower() != "false"

    def axes(self) -> FloatArray:
        """Return the matrix from camera axes to x right, y down, z forward."""
        name = text_of(self.element, "CameraOrientation") or "XRightYDown"
        if name not in ORIENTATIONS:
            raise InputError(
                f"{self.path}: photogroup {self.name}: the camera orientation '{name}' is not one"
                f" of {', '.join(ORIENTATIONS)}."
            )
        x, y = ORIENTATIONS[name]
        return np.column_stack([x, y, np.cross(x, y)])

    def pixel_size_mm(self) -> float | None:
        """Return the size of a pixel where the group tells it."""
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
        kind = text_of(self.element, "CameraModelType") or "Perspective"
        if kind not in ("Perspective", "Fisheye"):
            raise InputError(
                f"{self.path}: photogroup {self.name}: the camera model {kind} is not supported;"
                " export Perspective or Fisheye photos."
            )
        for tag in (str(child.tag) for child in self.element):
            if "Distortion" in tag and tag not in ("Distortion", "FisheyeDistortion"):
                raise InputError(
                    f"{self.path}: photogroup {self.name}: the distortion {tag} is not supported;"
                    " export BlocksExchange 3.2 or older, or undistorted photos."
                )
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
        return checks.lens(self.path, f"of photogroup {self.name}", lens)

    def principal_point(self) -> tuple[float, float]:
        """Return the principal point in pixels from the corner; the centre where none is given."""
        x, y = self.number("PrincipalPoint/x"), self.number("PrincipalPoint/y")
        if x is not None and y is not None:
            return x + FIRST_PIXEL, y + FIRST_PIXEL
        pixel = self.pixel_size_mm()
        offset = np.zeros(2)
        if pixel is not None:
            mm = np.array(self.numbers("PrincipalPoint", ("xmm", "ymm")))
            offset = self.axes()[:2, :2] @ mm / pixel
        u, v = np.array(self.size()) / 2.0 + offset
        return float(u), float(v)

    def _matrix(self, kind: str) -> list[float] | None:
        """Return the focal lengths and skews, a matrix by rows, or None where there are none."""
        if kind == "Fisheye" and self.element.find("FisheyeFocalMatrix") is not None:
            return self.numbers("FisheyeFocalMatrix", ("M_00", "M_01", "M_10", "M_11"))
        focal, focal_mm = self.number("FocalLengthPixels"), self.number("FocalLength")
        pixel = self.pixel_size_mm()
        if focal is None and focal_mm is not None and pixel is not None:
            focal = focal_mm / pixel
        if focal is None:
            return None
        if kind == "Fisheye":
            return [math.pi / 2.0 * focal, 0.0, 0.0, math.pi / 2.0 * focal]
        aspect = self.number("AspectRatio")
        return [focal, self.number("Skew") or 0.0, 0.0, focal if aspect is None else focal * aspect]


class Rows(NamedTuple):
    """For the tie points: row and group of each photo by block and id, and ids of the SRS."""

    of: dict[tuple[int, str], int]
    groups: dict[tuple[int, str], Photogroup]
    srs: str
    srs_of_blocks: list[str]


BEGINS = ("TiePoint", "Position", "Measurement")
NAMES = (*BEGINS, "x", "y", "z", "xmm", "ymm", "PhotoId", "SRSId")
CODES = {name: code for code, name in enumerate(NAMES)}
TOKEN = re.compile(f"<({'|'.join(NAMES)})>\\s*([^<]*)")
EXTERNAL = re.compile(rb"<Path>\s*([^<]*?)\s*</Path>")


class Tokens:
    """The tags of a text that count, with the number of the point and measurement each is in."""

    def __init__(self, path: Path, text: str) -> None:
        self.path = path
        found = TOKEN.findall(text)
        self.texts = [word for _, word in found]
        self.code = np.array([CODES[name] for name, _ in found], dtype=np.int8)
        self.point = np.cumsum(self.code == CODES["TiePoint"]) - 1
        self.measurement = np.cumsum(self.code == CODES["Measurement"]) - 1
        begun = np.where(self.code < len(BEGINS), np.arange(len(self.code)), 0)
        self.inside = self.code[np.maximum.accumulate(begun)] if len(begun) else self.code

    def numbers(self, names: tuple[str, ...], within: str) -> FloatArray:
        """Return one row per point (within Position) or measurement; NaN where there is none."""
        number = self.point if within == "Position" else self.measurement
        values = np.full((int(number[-1]) + 1 if len(number) else 0, len(names)), np.nan)
        inside = self.inside == CODES[within]
        for column, name in enumerate(names):
            rows = np.flatnonzero((self.code == CODES[name]) & inside)
            try:
                values[number[rows], column] = np.array([self.texts[row] for row in rows], float)
            except ValueError as error:
                raise InputError(
                    f"{self.path}: {name} of a tie point: {error}; the file is damaged, export it"
                    " again."
                ) from error
        return values

    def owned(self, name: str, number: IntArray, count: int) -> list[str]:
        """Return the text of a tag in each point or measurement, empty where there is none."""
        texts = [""] * count
        for row in np.flatnonzero((self.code == CODES[name]) & (number >= 0)):
            texts[number[row]] = self.texts[row].strip()
        return texts


def read_ties(
    path: Path, texts: list[tuple[int, bytes]], cameras: Cameras, rows: Rows
) -> TiePoints:
    """Read all tie points that a posed photo saw."""
    xyz, point, camera, uv = [np.empty((0, 3))], [], [], [np.empty((0, 2))]
    for block, text in texts:
        where, inside = _inside(path, text)
        tokens = Tokens(where, inside)
        positions = _positions(tokens, rows.srs_of_blocks[block], rows.srs)
        if len(positions):
            point.append(
                len(np.concatenate(xyz)) + tokens.point[tokens.code == CODES["Measurement"]]
            )
            xyz.append(positions)
            ids = tokens.owned("PhotoId", tokens.measurement, len(point[-1]))
            camera.append(np.array([rows.of.get((block, name), -1) for name in ids], np.int64))
            uv.append(_places(tokens, camera[-1], [rows.groups.get((block, n)) for n in ids], ids))
    cameras_of_all = np.concatenate([np.empty(0, np.int64), *camera])
    if not (cameras_of_all >= 0).any():
        raise NoTiePointsError(
            f"{path}: has no tie points that one of its {len(cameras)} photos saw."
        )
    points = np.concatenate(point)
    seen, points[cameras_of_all >= 0] = np.unique(points[cameras_of_all >= 0], return_inverse=True)
    return tie_points(np.concatenate(xyz)[seen], points, cameras_of_all, np.concatenate(uv))


def _inside(path: Path, text: bytes) -> tuple[Path, str]:
    """Return the text itself, or that of the file beside the document that it names."""
    other = EXTERNAL.search(text)
    if other is None:
        return path, text.decode(errors="replace")
    plain = other[1].decode(errors="replace").replace("\\", "/")
    for place in (path.parent / plain, path.parent / PureWindowsPath(plain).name):
        if place.is_file():
            data = read_bytes(place)
            if not data.rstrip().endswith((b"</TiePoint>", b"</TiePoints>")):
                raise InputError(f"{place}: is cut off; export it again.")
            return place, data.decode(errors="replace")
    raise InputError(f"{path}: its tie points are in {plain}, which is not beside it.")


def _positions(tokens: Tokens, srs_of_block: str, srs: str) -> FloatArray:
    """Return the points, NaN without a position or with one in another reference system."""
    xyz = tokens.numbers(("x", "y", "z"), "Position")
    before = (tokens.code == CODES["SRSId"]) & (tokens.point < 0)
    default = next((tokens.texts[row].strip() for row in np.flatnonzero(before)), srs_of_block)
    own = tokens.owned("SRSId", tokens.point, len(xyz))
    other = np.array([(name or default) != srs for name in own], dtype=bool)
    xyz[other] = np.nan
    return xyz


def _places(
    tokens: Tokens, camera: IntArray, groups: list[Photogroup | None], ids: list[str]
) -> FloatArray:
    """Return u, v in pixels from the corner, of places in pixels or in mm."""
    uv = tokens.numbers(("x", "y"), "Measurement") + FIRST_PIXEL
    missing: BoolArray = ~np.isfinite(uv).all(axis=1) & (camera >= 0)
    if not missing.any():
        return uv
    mm = tokens.numbers(("xmm", "ymm"), "Measurement")
    for row in np.flatnonzero(missing):
        group = groups[row]
        pixel = None if group is None else group.pixel_size_mm()
        if group is not None and pixel is not None:
            uv[row] = group.principal_point() + group.axes()[:2, :2] @ mm[row] / pixel
        if pixel is None or not np.isfinite(uv[row]).all():
            raise InputError(
                f"{tokens.path}: photo {ids[row]}: a measurement of a tie point has no x and y, or"
                " is in mm and the photogroup has no pixel size."
            )
    return uv
