"""BlocksExchange XML: ContextCapture, iTwin Capture Modeler, DJI Terra.

A block has photogroups, each with one lens and its photos. A rotation takes world axes to camera
axes. `CameraOrientation` names the directions of x and y in the image (XRightYDown, the default, is
x right, y down, z forward). The rotation is a matrix M_ij by rows, or omega, phi, kappa with
M = (Rx Ry Rz)^T in those same camera axes. Yaw, pitch, roll (or heading) are refused, as their
definition could not be checked against a file. Component 1 is the block; photos of another one
are in a frame of their own.

Pixels start at the centre of the first pixel, so half a pixel is added to principal point and
measurements. The focal length is in mm with the largest side of the sensor, or in pixels; the
focal length down the image is `AspectRatio` times that, `Skew` is in pixels. P1 and P2 are in
Brown's order, x' = ... + P1 (r^2 + 2 x^2) + 2 P2 x y. A fisheye has a matrix and a polynomial
P0 + P1 q + P2 q^2 + ... of q = 2 theta / pi; without the matrix, it is pi / 2 times the focal
length.

Software ignores poses where ManualPose is false, and lenses where ManualOpticalParams is. The cloud
was not computed from these, so they are not read.

GNSS positions are in Pose/Metadata, or in the GPS of ExifData. Tie points can be in another file,
and either file in a zip archive (.xmlz).

References: Bentley, ContextCapture User Guide, "BlocksExchange XML/XMLZ format", "Perspective
camera model", "Fisheye camera model"; Bentley developer documentation, "CC Orientations". The
order of P1 and P2 and the factor pi / 2 follow converters that cite those pages.
"""

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
from pcfix.io.cameras.checks import Source, lens_by_name, number, read_xml, text_of
from pcfix.io.crs import Topocentric
from pcfix.lens.rotations import from_omega_phi_kappa, from_photogrammetric
from pcfix.model import Cameras, FloatArray, Lens, TiePoints

CONTENT = "<BlocksExchange"
TIE_POINTS = re.compile(rb"<TiePoints>(.*?)</TiePoints>", re.DOTALL)
CENTRE = [f"Center/{axis}" for axis in "xyz"]
DEGREES = ["Longitude", "Latitude", "Altitude"]
MATRIX = [f"Rotation/M_{row}{column}" for row in range(3) for column in range(3)]
ANGLES = [f"Rotation/{angle}" for angle in ("Omega", "Phi", "Kappa")]
EXIF = "EPSG:4326"  # of positions in ExifData
FIRST_PIXEL = 0.5  # its centre, seen from its corner
DIRECTIONS = {"Right": (1, 0, 0), "Left": (-1, 0, 0), "Down": (0, 1, 0), "Up": (0, -1, 0)}


class Photo(NamedTuple):
    """A photo with at least a position; `key` is its block and id, `prior` its GNSS position."""

    is_main: bool  # in the main component
    key: tuple[int, str]
    label: str
    lens: Lens | None
    centre: FloatArray
    rotation: FloatArray | None
    srs: str
    prior: tuple[str, FloatArray] | None


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the block."""
    path = source.path
    root = read_xml(path, TIE_POINTS.sub(b"", _read_bytes(path)))
    photos, unposed = _photos(path, root)
    labels, centres = tuple(photo.label for photo in photos), [photo.centre for photo in photos]
    turns = [photo.rotation for photo in photos if photo.rotation is not None]
    lenses = tuple(photo.lens for photo in photos if photo.lens is not None and turns)
    known = lenses if len(lenses) == len(photos) else None
    priors = {i: photo.prior for i, photo in enumerate(photos) if photo.prior is not None}
    gnss_srs = next(iter(priors.values()), ("",))[0]  # positions of other systems are skipped
    places = {i: (xyz, [np.nan] * 3) for i, (srs, xyz) in priors.items() if srs == gnss_srs}
    crs, gnss_crs = (_crs_of(path, root, srs) for srs in (photos[0].srs, gnss_srs))
    gnss = checks.measured(range(len(photos)), places, gnss_crs)
    rotations = np.array(turns) if turns else None
    return Cameras(labels, np.array(centres), rotations, known, crs, gnss=gnss, unposed=unposed)


def _read_bytes(path: Path) -> bytes:
    """Return the document in a file or archive without comments."""
    return re.sub(rb"<!--.*?-->", b"", checks.read_document(path), flags=re.DOTALL)


def _photos(path: Path, root: Element) -> tuple[list[Photo], tuple[str, ...]]:
    """Read the photos of the main component, if possible with rotations; and all other labels."""
    listed, unposed = list[Photo](), list[str]()
    for i, block in enumerate(root.iter("Block")):
        for group in block.iter("Photogroup"):
            axes, lens = _photogroup(path, group)
            is_ignored = text_of(group, "ManualPose").lower() == "false"
            srs = text_of(group, "SRSId") or text_of(block, "SRSId")
            for element in group.iterfind("Photo"):
                label, pose = _label(element), element.find("Pose")
                if is_ignored or pose is None or pose.find("Center") is None:
                    unposed.append(label)
                    continue
                key, where = (i, text_of(element, "Id")), f"image {label}"
                centre = _numbers(path, where, pose, CENTRE)
                turn: FloatArray | None = None  # world to x right, y down, z forward
                if pose.find(MATRIX[0]) is not None:
                    turn = axes @ _numbers(path, where, pose, MATRIX).reshape(3, 3)
                elif pose.find(ANGLES[0]) is not None:
                    angles = _numbers(path, where, pose, ANGLES).reshape(3, 1)
                    turn = axes @ from_photogrammetric(from_omega_phi_kappa(*angles))[0]
                elif pose.find("Rotation/Pitch") is not None:
                    what = f"the rotation of {label} by yaw (or heading), pitch and roll"
                    remedy = "Export rotations as matrices"
                    raise checks.unsupported(path, what, remedy, image=label)
                metadata, gps, prior = pose.find("Metadata"), element.find("ExifData/GPS"), None
                if metadata is not None and metadata.find("Center") is not None:
                    place = _numbers(path, f"{where}, Metadata", metadata, CENTRE)
                    prior = text_of(metadata, "SRSId") or srs, place
                elif gps is not None and all(gps.findtext(name) for name in DEGREES):
                    prior = EXIF, _numbers(path, f"{where}, GPS", gps, DEGREES)
                is_main = text_of(element, "Component") in ("", "1")
                listed.append(Photo(is_main, key, label, lens, centre, turn, srs, prior))
        unposed += [_label(element) for element in block.iterfind("BulkPhotos/Photo")]
    main = [photo for photo in listed if photo.is_main] or listed
    photos = [photo for photo in main if photo.rotation is not None] or main
    if not photos:
        raise checks.no_pose(path)
    if len({(photo.key[0], photo.srs) for photo in photos}) > 1:
        sentence = "has several blocks or SRS. Export only the block of the cloud, in one SRS."
        raise bad_file(path, "cameras.several_blocks", sentence)
    chosen = {photo.key for photo in photos}
    unposed += [photo.label for photo in listed if photo.key not in chosen]
    return photos, tuple(unposed)


def _crs_of(path: Path, root: Element, srs_id: str) -> str:
    """Return the CRS of an id as `Cameras` has it; without an id the frame is local."""
    if srs_id in ("", EXIF):
        return srs_id or "local"
    definitions = {text_of(srs, "Id"): srs.findtext("Definition") or "" for srs in root.iter("SRS")}
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


def _photogroup(path: Path, element: Element) -> tuple[FloatArray, Lens | None]:
    """Return the axes and the lens of a group, which needs a frame and a focal length.

    The matrix takes camera axes to x right, y down, z forward.
    """
    name = text_of(element, "Name") or "without a name"

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
    if text_of(element, "ManualOpticalParams").lower() == "false":
        return axes, None
    kind = text_of(element, "CameraModelType") or "Perspective"
    if kind not in ("Perspective", "Fisheye"):
        raise refused(f"camera model {kind}")
    for tag in (str(child.tag) for child in element):
        if "Distortion" in tag and tag not in ("Distortion", "FisheyeDistortion"):
            raise refused(f"distortion {tag}")
    width, height = (value(f"ImageDimensions/{side}") for side in ("Width", "Height"))
    pixel_mm = value("PixelSize") or (value("SensorSize") / max(width, height) if width else 0.0)
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
    if min(width, height) <= 0.0 or math.isnan(given["fx"]):
        return axes, None
    if text_of(element, "PrincipalPoint/x") and text_of(element, "PrincipalPoint/y"):
        given |= {f"c{side}": value(f"PrincipalPoint/{side}") + FIRST_PIXEL for side in "xy"}
    elif pixel_mm > 0.0:  # from the centre, in the axes of the camera
        mm = np.array([value("PrincipalPoint/xmm"), value("PrincipalPoint/ymm")])
        given |= zip(("dx", "dy"), axes[:2, :2] @ mm / pixel_mm, strict=True)
    return axes, lens_by_name(given, width, height, sensor=name, **more)


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points that a posed photo saw; those of another CRS lose their coordinates."""
    from defusedxml.ElementTree import iterparse  # one by one: no tree holds millions of them

    path, data = source.path, _read_bytes(source.path)
    root = read_xml(path, TIE_POINTS.sub(b"", data))  # a tree of all points would take minutes
    photos, blocks = _photos(path, root)[0], list(root.iter("Block"))
    row_of = {photo.key: row for row, photo in enumerate(photos)}
    xyz: list[list[float]] = []
    point, camera, uv = [], [], []
    for match in TIE_POINTS.finditer(data):
        i = data.count(b"<Block>", 0, match.start()) - 1
        where, inside = path, match[1]
        if other := re.search(rb"<Path>\s*([^<]*?)\s*</Path>", inside):  # in a file of their own
            plain = other[1].decode(errors="replace").replace("\\", "/")
            places = (path.parent / plain, path.parent / PureWindowsPath(plain).name)
            where = next((place for place in places if place.is_file()), places[0])
            inside = re.sub(rb"<\?xml.*?\?>", b"", _read_bytes(where))
        of_all = inside[: inside.find(b"<TiePoint>")]
        head = re.search(rb"<SRSId>\s*([^<]*?)\s*</SRSId>", of_all)
        srs_of_all = text_of(blocks[i], "SRSId") if head is None else head[1].decode()
        with checks.reading(where):
            for _, element in iterparse(io.BytesIO(b"<All>" + inside + b"</All>")):
                if element.tag != "TiePoint":
                    continue
                marks = element.findall("Measurement")
                rows = [row_of.get((i, text_of(mark, "PhotoId")), -1) for mark in marks]
                if max(rows, default=-1) >= 0:
                    place, srs = element.find("Position"), text_of(element, "SRSId") or srs_of_all
                    is_known = place is not None and srs == photos[0].srs
                    point += [len(xyz)] * len(rows)
                    camera += rows
                    uv += [[float(text_of(mark, axis)) for axis in "xy"] for mark in marks]
                    axes = [text_of(place, a) for a in "xyz"] if is_known else ["nan"] * 3
                    xyz.append([float(text) for text in axes])
                element.clear()
    if not xyz:
        raise checks.no_tie_points(path, f"none was seen by one of its {len(cameras)} photos")
    uv_px = np.array(uv) + FIRST_PIXEL
    found = checks.Observations(np.array(xyz), np.array(point), np.array(camera), uv_px)
    return checks.tie_points(found)
