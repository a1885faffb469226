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
was not computed from these, so they are not read.

GNSS positions are in Pose/Metadata, or in the GPS of ExifData. Tie points can be in another file,
and either file in a zip archive (.xmlz).

References: Bentley, ContextCapture User Guide, "BlocksExchange XML/XMLZ format", "Perspective
camera model", "Fisheye camera model"; Bentley developer documentation, "CC Orientations". The
order of P1 and P2 and the factor pi / 2 follow converters that cite those pages.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Source, damaged, note, number, read_xml, text_of
from pcfix.io.cameras.lenses import lens_by_name
from pcfix.io.crs import Topocentric
from pcfix.lens.rotations import from_omega_phi_kappa, from_photogrammetric
from pcfix.model import Cameras, FloatArray, Lens, TiePoints

CONTENT = "<BlocksExchange"
COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
TIE_POINTS = re.compile(rb"<TiePoints>(.*?)</TiePoints>", re.DOTALL)
EXTERNAL = re.compile(rb"<Path>\s*([^<]*?)\s*</Path>")
DECLARATION = re.compile(rb"<\?xml.*?\?>")
SRS_OF_ALL = re.compile(rb"<SRSId>\s*([^<]*?)\s*</SRSId>")
MAIN_COMPONENT = "1"
CENTRE = [f"Center/{axis}" for axis in "xyz"]
DEGREES = ["Longitude", "Latitude", "Altitude"]
EXIF = "EPSG:4326"
"""The CRS of positions in ExifData."""
FIRST_PIXEL = 0.5
"""The centre of the first pixel, seen from its corner."""
DIRECTIONS = {"Right": (1, 0, 0), "Left": (-1, 0, 0), "Down": (0, 1, 0), "Up": (0, -1, 0)}


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the block."""
    return _read_block(source.path)[0]


def _read_bytes(path: Path) -> bytes:
    """Return the document in a file or archive without comments."""
    return COMMENT.sub(b"", checks.read_document(path))


class Photogroup(NamedTuple):
    """What the photos of a group share.

    `axes` is the matrix from camera axes to x right, y down, z forward; `middle` the principal
    point in pixels from the corner. A `pixel_mm` of 0 and a `lens` of None are
    unknown.
    """

    name: str
    has_poses: bool
    axes: FloatArray
    middle: FloatArray
    pixel_mm: float
    lens: Lens | None

    def place(self, mark: Element) -> FloatArray:
        """Return u, v in pixels from the corner, of a measurement in pixels or in mm."""
        if mark.find("x") is not None and mark.find("y") is not None:
            return np.array([float(text_of(mark, axis)) for axis in "xy"]) + FIRST_PIXEL
        if not self.pixel_mm > 0.0:
            raise ValueError("a measurement is in mm, but its photogroup has no pixel size")
        mm = np.array([float(text_of(mark, name)) for name in ("xmm", "ymm")])
        return self.middle + self.axes[:2, :2] @ mm / self.pixel_mm


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
    root = read_xml(path, TIE_POINTS.sub(b"", data))
    main, outside = list[Photo](), list[Photo]()  # outside of the main component
    unposed, ignored = list[str](), list[str]()
    blocks = list(root.iter("Block"))
    for i, block in enumerate(blocks):
        for element in block.iter("Photogroup"):
            group = _photogroup(path, element)
            ignored += [] if group.has_poses else [group.name]
            srs = text_of(element, "SRSId") or text_of(block, "SRSId")
            for photo in element.iterfind("Photo"):
                label, pose = _label(photo), photo.find("Pose")
                if not group.has_poses or pose is None or pose.find("Center") is None:
                    unposed.append(label)
                    continue
                centre = _numbers(path, f"image {label}", pose, CENTRE)
                turn = _rotation(path, label, pose.find("Rotation"), group.axes)
                metadata, gps, prior = pose.find("Metadata"), photo.find("ExifData/GPS"), None
                if metadata is not None and metadata.find("Center") is not None:
                    place = _numbers(path, f"image {label}, Metadata", metadata, CENTRE)
                    prior = text_of(metadata, "SRSId") or srs, place
                elif gps is not None and all(gps.findtext(name) for name in DEGREES):
                    prior = EXIF, _numbers(path, f"image {label}, GPS", gps, DEGREES)
                one = Photo((i, text_of(photo, "Id")), label, group, centre, turn, srs, prior)
                is_main = text_of(photo, "Component") in ("", MAIN_COMPONENT)
                (main if is_main else outside).append(one)
        unposed += [_label(element) for element in block.iterfind("BulkPhotos/Photo")]
    turned = [photo for photo in main or outside if photo.rotation is not None]
    photos = turned or main or outside
    if not photos:
        why = " of the block (ManualPose is false)" if ignored else ""
        raise checks.no_pose(path, f"no photo has a pose{why}")
    block_of: dict[str, int] = {}
    twice = [p.label for p in photos if block_of.setdefault(p.label, p.key[0]) != p.key[0]]
    if twice or len({photo.srs for photo in photos}) > 1:
        why = f"image {twice[0]} is in several blocks" if twice else "it has several SRS"
        sentence = f"{why}. Export only the block of the cloud, in one SRS."
        raise bad_file(path, "cameras.several_blocks", sentence)
    gnss = None
    priors = {photo.key: photo.prior for photo in photos if photo.prior is not None}
    if priors:  # positions in the CRS that the first of them has
        of = next(iter(priors.values()))[0]
        places = {k: (xyz, np.full(3, np.nan)) for k, (srs, xyz) in priors.items() if srs == of}
        gnss = checks.measured([photo.key for photo in photos], places, _crs_of(path, root, of))
    lenses = [photo.group.lens for photo in photos if photo.group.lens is not None]
    has_lenses, notes = bool(turned) and len(lenses) == len(photos), []
    if ignored:
        sentence = f"photogroup {', '.join(ignored[:10])} is skipped (its ManualPose is false)."
        notes.append(note(path, "cameras.poses_ignored", sentence, photogroups=ignored))
    chosen = {photo.key for photo in photos}
    cameras = Cameras(
        labels=tuple(photo.label for photo in photos),
        centres=np.array([photo.centre for photo in photos]),
        rotations=np.array([photo.rotation for photo in photos]) if turned else None,
        lenses=tuple(lenses) if has_lenses else None,
        crs=_crs_of(path, root, photos[0].srs),
        notes=tuple(notes),
        gnss=gnss,
        unposed=(*unposed, *(one.label for one in main + outside if one.key not in chosen)),
        source="BlocksExchange",
    )
    texts = []
    for match in TIE_POINTS.finditer(data):
        i = data.count(b"<Block>", 0, match.start()) - 1
        texts.append((i, text_of(blocks[i], "SRSId"), match[1]))
    return cameras, photos, texts


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
    if srs_id in ("", EXIF):
        return srs_id or "local"
    definitions = {text_of(srs, "Id"): srs.findtext("Definition") or "" for srs in root.iter("SRS")}
    if srs_id not in definitions:
        raise damaged(path, f"there is no spatial reference system with the id {srs_id}")
    definition = definitions[srs_id].strip()
    if not definition.upper().startswith("ENU:"):
        return checks.crs(path, definition)
    Topocentric.from_text(definition, str(path))  # checks it
    return "ENU:" + ",".join(word.strip() for word in [*definition[4:].split(","), "0"][:3])


def _numbers(path: Path, where: str, element: Element, names: Sequence[str]) -> FloatArray:
    return np.array([number(path, f"{where}, {name}", element.findtext(name)) for name in names])


def _label(element: Element) -> str:
    """Return the name of the image file, or the id of a photo without one."""
    name = PureWindowsPath(text_of(element, "ImagePath")).name
    return name or f"photo {text_of(element, 'Id')}"


def _photogroup(path: Path, element: Element) -> Photogroup:
    """Read what the photos of a group share; without frame or focal length there is no lens."""
    name = (element.findtext("Name") or "without a name").strip()

    def value(tag: str, default: float = 0.0) -> float:
        text = text_of(element, tag)
        return number(path, f"photogroup {name}, {tag}", text) if text else default

    def refused(what: str) -> InputError:
        what, remedy = f"the {what} of photogroup {name}", "Export undistorted photos"
        return checks.unsupported(path, what, remedy, photogroup=name)

    orientation = text_of(element, "CameraOrientation") or "XRightYDown"
    words = re.fullmatch("X(Right|Left|Up|Down)Y(Right|Left|Up|Down)", orientation)
    x, y = (DIRECTIONS[word] for word in words.groups()) if words else ((0, 0, 0), (0, 0, 0))
    axes = np.column_stack([x, y, np.cross(x, y)]).astype(np.float64)
    if not axes[:, 2].any():
        raise refused(f"camera orientation {orientation}")
    width, height = (value(f"ImageDimensions/{side}") for side in ("Width", "Height"))
    pixel_mm = value("PixelSize") or (value("SensorSize") / max(width, height) if width else 0.0)
    middle = np.array([width, height]) / 2.0
    if text_of(element, "PrincipalPoint/x") and text_of(element, "PrincipalPoint/y"):
        middle = np.array([value("PrincipalPoint/x"), value("PrincipalPoint/y")]) + FIRST_PIXEL
    elif pixel_mm > 0.0:
        mm = [value("PrincipalPoint/xmm"), value("PrincipalPoint/ymm")]
        middle = middle + axes[:2, :2] @ mm / pixel_mm
    is_used = text_of(element, "ManualOpticalParams").lower() != "false"
    kind = text_of(element, "CameraModelType") or "Perspective"
    if is_used and kind not in ("Perspective", "Fisheye"):
        raise refused(f"camera model {kind}")
    for tag in (str(child.tag) for child in element) if is_used else ():
        if "Distortion" in tag and tag not in ("Distortion", "FisheyeDistortion"):
            raise refused(f"distortion {tag}")
    focal, more = value("FocalLengthPixels", math.nan), dict[str, Any]()
    if math.isnan(focal) and pixel_mm > 0.0:
        focal = value("FocalLength", math.nan) / pixel_mm
    if kind == "Fisheye":
        given = {"fx": math.pi / 2.0 * focal, "fy": math.pi / 2.0 * focal}
        if element.find("FisheyeFocalMatrix") is not None:
            names = {"fx": "M_00", "skew": "M_01", "b3": "M_10", "fy": "M_11"}
            given = {key: value(f"FisheyeFocalMatrix/{one}") for key, one in names.items()}
        has_shape = element.find("FisheyeDistortion") is not None
        shape = [value(f"FisheyeDistortion/P{i}") for i in range(5)] if has_shape else [0.0, 1.0]
        more = {"projection": "polynomial", "shape": tuple(shape)}
    else:
        given = {"fx": focal, "fy": focal * value("AspectRatio", 1.0), "skew": value("Skew")}
        given |= {k.lower(): value(f"Distortion/{k}") for k in ("K1", "K2", "K3", "P1", "P2")}
    lens, (cx, cy) = None, middle.tolist()
    if is_used and min(width, height) > 0.0 and not math.isnan(given["fx"]):
        lens = lens_by_name(given | {"cx": cx, "cy": cy}, width, height, sensor=name, **more)
    has_poses = text_of(element, "ManualPose").lower() != "false"
    return Photogroup(name, has_poses, axes, middle, pixel_mm, lens)


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
            inside = DECLARATION.sub(b"", _read_bytes(where))
        head = SRS_OF_ALL.search(inside[: inside.find(b"<TiePoint>")])
        srs_of_all = srs_of_block if head is None else head[1].decode()
        with checks.reading(where):
            for _, element in iterparse(io.BytesIO(b"<All>" + inside + b"</All>")):
                if element.tag != "TiePoint":
                    continue
                marks = element.findall("Measurement")
                rows = [row_of.get((i, text_of(mark, "PhotoId")), -1) for mark in marks]
                if max(rows, default=-1) >= 0:
                    place, srs = element.find("Position"), text_of(element, "SRSId") or srs_of_all
                    is_known = place is not None and srs == photos[0].srs
                    for row, mark in zip(rows, marks, strict=True):
                        if row >= 0:
                            point.append(len(xyz))
                            camera.append(row)
                            uv.append(photos[row].group.place(mark))
                    axes = [text_of(place, a) for a in "xyz"] if is_known else ["nan"] * 3
                    xyz.append([float(text) for text in axes])
                element.clear()
    if not xyz:
        raise checks.no_tie_points(path, f"none was seen by one of its {len(cameras)} photos")
    seen_all = checks.Seen(np.array(xyz), np.array(point), np.array(camera), np.array(uv))
    return checks.tie_points(seen_all)
