"""Shared by the readers: input, errors, numbers, XML, JSON, rotations, lenses, CRS, tie points.

Lenses are made of parameters by name, as all packages have the same few. Here they are called
``f``, or ``fx`` across and ``fy`` down the image; ``cx``, ``cy``, the principal point from the
upper left corner of the image, or ``dx``, ``dy`` from its centre; ``skew`` and ``b3``, the affine
terms off the diagonal; ``k1``, ... radial and ``d1``, ... in the denominator; ``p1``, ``p2``, ...
in Brown's order, so OpenCV's p1 is ``p2``; ``s1``, ... of thin prisms; and the parameters of a
projection, see `SHAPES`. `pcfix.model.Lens` has the formulas.
"""

import re
import warnings
import zipfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from pathlib import Path, PureWindowsPath
from typing import Any, Literal, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, NoTiePointsError, PcfixWarning, bad_file
from pcfix.io import tables
from pcfix.io.files import check_input, check_output, parse_json, write_bytes
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    GnssPositions,
    IntArray,
    Lens,
    Projection,
    TiePoints,
    Views,
)

ZIP_MAGIC = b"PK\x03\x04"
ROUNDING = 1e-3  # of a rotation's elements: four decimals pass, mirrored or scaled ones do not

Angles = Literal["omega-phi-kappa", "yaw-pitch-roll", "aircraft"]

_HEAD_BYTES = 4096


@dataclass(frozen=True)
class Source:
    """A file or folder that may have cameras, and the settings of the user for it.

    `sensor` is the ``--sensor`` file, `angles` the kind of angles of a table whose header does not
    name it.
    """

    path: Path
    sensor: Path | None = None
    angles: Angles | None = None

    @cached_property
    def head(self) -> bytes:
        """The first bytes of a file; nothing of a folder."""
        if self.path.is_dir():
            return b""
        with check_input(self.path).open("rb") as stream:
            return stream.read(_HEAD_BYTES)

    @cached_property
    def text(self) -> str:
        """The first bytes as text, without a byte order mark; of an archive those of its XML."""
        is_archive = self.head.startswith(ZIP_MAGIC)
        return tables.decoded(read_document(self.path)[:_HEAD_BYTES] if is_archive else self.head)


def recognises(form: Any, source: Source) -> bool:
    """Whether a format knows a file or folder: by a rule of its own, or by patterns.

    These are ``CONTENT`` of the first bytes of a file, and ``INSIDE`` of a name in a folder.
    """
    if hasattr(form, "recognises"):
        return bool(form.recognises(source))
    if source.path.is_dir():
        pattern = re.compile(getattr(form, "INSIDE", ""))
        return any(pattern.fullmatch(inside.name) for inside in source.path.iterdir())
    return re.search(form.CONTENT, source.text) is not None


def damaged(path: object, why: object) -> InputError:
    """Return the error for contents that no software writes."""
    return bad_file(path, "cameras.damaged", f"is damaged or cut off ({why}). Export it again.")


def no_pose(path: Path, why: str = "no image has a pose") -> InputError:
    """Return the error for a file without poses."""
    sentence = f"{why}. Align the images first, then export their poses."
    return bad_file(path, "cameras.no_pose", sentence)


def unsupported(path: Path, what: str, remedy: str, **values: Any) -> InputError:
    """Return the error for a lens, rotation or frame that pcfix has no model for."""
    return bad_file(path, "cameras.unsupported", f"{what} is not supported. {remedy}.", **values)


def warn(path: object, code: str, sentence: str, **values: Any) -> None:
    """Warn about a camera file; `pcfix.read_cameras` also returns the warning in `notes`."""
    note = PcfixWarning(code, f"{path}: {sentence}", path=path, **values)
    warnings.warn(note, stacklevel=3)


def warn_several(path: Path, count: int, images: int) -> None:
    """Warn if a file has several models that are not connected, of which the largest is read."""
    if count > 1:
        sentence = f"has {count} separate models. Only the largest is read, with {images} images."
        warn(path, "cameras.several_models", sentence, models=count, images=images)


@contextmanager
def reading(path: object) -> Iterator[None]:
    """Raise `InputError` for whatever damaged contents make the block run into."""
    try:
        with np.errstate(all="ignore"):
            yield
    except InputError:
        raise
    except FileNotFoundError as error:
        sentence = "is missing. Keep all files of the project together."
        raise bad_file(error.filename or path, "cameras.missing_file", sentence) from error
    except KeyError as error:
        raise damaged(path, f"{error} is missing") from error
    except Exception as error:  # whatever a reader runs into where a file is cut off
        raise damaged(path, str(error).rstrip(".") or type(error).__name__) from error


def read_document(path: Path) -> bytes:
    """Return a file, or of an archive its ``doc.xml`` or else the first XML document."""
    with reading(path):
        with path.open("rb") as stream:
            is_archive = stream.read(len(ZIP_MAGIC)) == ZIP_MAGIC
        if not is_archive:
            return path.read_bytes()
        with zipfile.ZipFile(path) as archive:
            listed = [name for name in archive.namelist() if name.lower().endswith(".xml")]
            return archive.read("doc.xml" if "doc.xml" in listed else [*listed, "XML"][0])


def read_xml(path: Path, data: bytes | None = None) -> Element:
    """Return the root of a document, which may be in an archive, or already read."""
    from defusedxml.ElementTree import fromstring

    with reading(path):
        data = read_document(path) if data is None else data
        root: Element = fromstring(data, forbid_dtd=False)
    return root


def text_of(element: Element, name: str) -> str:
    """Return the text of an element inside another, empty where there is none."""
    return (element.findtext(name) or "").strip().strip('"')


def load_json(path: Path) -> Any:
    """Return the contents of a JSON file."""
    with reading(path):
        return parse_json(path.read_bytes())


def number(path: Path, where: str, text: str | None) -> float:
    """Return the number in a text; `where` is the image and element, for the message."""
    value = tables.number(text or "")
    if not np.isfinite(value):
        shown = (text or "").strip()
        sentence = f"{where}: '{shown}' is not a number. Export it again."
        raise bad_file(path, "cameras.number", sentence, where=where, value=shown)
    return value


def numbers(path: Path, where: str, text: str | None, count: int) -> FloatArray:
    """Return `count` numbers separated by white space or commas."""
    words = (text or "").replace(",", " ").split()
    if len(words) != count:
        raise damaged(path, f"{where}: {len(words)} numbers instead of {count}")
    return np.array([number(path, where, word) for word in words])


def triple(value: Any) -> FloatArray:
    """Return the three numbers of a list in a JSON file."""
    return np.array(value, np.float64).reshape(3)


def rotations(path: Path, labels: Sequence[str], matrices: FloatArray) -> FloatArray:
    """Return the proper rotations closest to matrices, shape (k, 3, 3), rounded in their file."""
    matrices = np.asarray(matrices, np.float64).reshape(-1, 3, 3)
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    good = (off <= ROUNDING) & (np.linalg.det(np.nan_to_num(matrices, posinf=0.0)) > 0.0)
    _check_rotations(path, labels, good)
    for _ in range(2):  # Newton's iteration to the polar factor squares the rounding each time
        matrices = 1.5 * matrices - 0.5 * matrices @ matrices.transpose(0, 2, 1) @ matrices
    return matrices


def quaternions(path: Path, labels: Sequence[str], wxyz: FloatArray) -> FloatArray:
    """Return the rotations, shape (k, 3, 3), of unit quaternions (k, 4), the scalar first."""
    from scipy.spatial.transform import Rotation

    good = np.abs(np.linalg.norm(wxyz, axis=1) - 1.0) <= ROUNDING
    _check_rotations(path, labels, good)
    return np.asarray(Rotation.from_quat(np.roll(wxyz, -1, axis=1)).as_matrix())


def _check_rotations(path: Path, labels: Sequence[str], good: BoolArray) -> None:
    if not good.all():
        label = labels[int(np.argmin(good))]
        sentence = f"the rotation of {label} is mirrored, skewed or scaled. Export the poses again."
        raise bad_file(path, "cameras.rotation", sentence, image=label)


def centres(rotations: FloatArray, translations: FloatArray) -> FloatArray:
    """Return the projection centres -R't of poses x_camera = R x + t."""
    return -np.einsum("kji,kj->ki", rotations, translations)


def lens(path: Path, name: str, given: Lens) -> Lens:
    """Return the lens if its numbers can be those of a camera."""
    positive = min(given.focal, given.focal + given.b1, given.width, given.height) > 0.0
    every = np.hstack([v for v in astuple(given) if isinstance(v, float | tuple)])
    if not (positive and np.isfinite(every).all()):
        frame = f"focal length {given.focal:g}, frame {given.width:g} x {given.height:g}"
        raise bad_file(path, "cameras.lens", f"the lens {name} is damaged ({frame}).", lens=name)
    return given


def checked(path: Path, cameras: Cameras) -> Cameras:
    """Return cameras with proper rotations and with one object for each different lens."""
    if cameras.rotations is not None:
        turns = rotations(path, cameras.labels, cameras.rotations)
        cameras = replace(cameras, rotations=turns)
    if cameras.lenses is None:
        return cameras
    of = dict(zip(cameras.lenses, cameras.labels, strict=True))
    same = {one: lens(path, one.sensor or f"of {label}", one) for one, label in of.items()}
    return replace(cameras, lenses=tuple(same[one] for one in cameras.lenses))


def measured(
    keys: Sequence[Any], places: Mapping[Any, tuple[Any, Any]], crs: str | None
) -> GnssPositions | None:
    """Return the GNSS positions of images by their keys, with their standard deviations.

    Numbers that are not finite are unknown; a position may lack its height only. None if no image
    has a position.
    """
    unknown = np.full((2, 3), np.nan)
    rows = [places.get(key, unknown) for key in keys]
    xyz, sigma = np.array(rows, np.float64).reshape(-1, 2, 3).transpose(1, 0, 2)
    xyz[~np.isfinite(xyz)] = np.nan
    xyz[np.isnan(xyz[:, :2]).any(axis=1)] = np.nan
    return None if np.isnan(xyz).all() else GnssPositions(xyz, sigma, crs)


def crs(path: Path, definition: str) -> str:
    """Return the CRS that a file states: ``local``, or a definition that PROJ understands."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    text = definition.strip()
    if text.lower() == "local" or text.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return "local"
    if utm := re.match(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", text, re.IGNORECASE):  # ODM's
        text = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    try:
        CRS.from_user_input(text)
    except CRSError as error:
        sentence = f"PROJ does not know the CRS '{text[:80]}'. Export in a CRS with an EPSG code."
        raise bad_file(path, "cameras.crs", sentence, crs=text) from error
    return text


class AffineFrame(NamedTuple):
    """The affine map from the frame of a file to `crs`: p -> matrix p + shift."""

    matrix: FloatArray
    shift: FloatArray
    crs: str | None
    project_crs: str | None = None

    def points(self, xyz: FloatArray) -> FloatArray:
        """Return points in `crs`."""
        return np.asarray(xyz @ self.matrix.T + self.shift)


# ---- lenses ----


SHAPES = {"fov": "omega", "division": "k", "eucm": "alpha beta", "dual": "transition"}
LETTERS = {"radial": "k", "denominator": "d", "tangential": "p", "thin_prism": "s"}


class LensModel(NamedTuple):
    """A model of a package: the names of its parameters, in the order of its files."""

    names: str
    projection: Projection = "perspective"
    in_turn: bool = False

    def lens(self, given: Mapping[str, float], width: float, height: float, **more: Any) -> Lens:
        """Return the lens with the given parameters, see `lens_by_name`."""
        more |= {"projection": self.projection, "in_turn": self.in_turn}
        return lens_by_name(given, width, height, **more)


def lens_by_name(
    given: Mapping[str, float], width: float, height: float, *, relative: bool = False, **more: Any
) -> Lens:
    """Return the lens with the given parameters; `more` are other fields of a `Lens`.

    With `relative`, the focal lengths, ``dx``, ``dy`` and ``skew`` are in units of the larger side
    of the frame. Without a principal point it is in the middle of the frame.
    """
    size = max(width, height) if relative else 1.0
    value = defaultdict(float, given)
    focal = given.get("fy", value["f"])
    # k1, k2, ... up to the highest order of any term, without zeros at the end
    most = max((int(name[1:]) for name in given if name[1:].isdecimal()), default=0)
    orders = range(1, most + 1)
    terms = {
        field: tuple(np.trim_zeros([given.get(f"{letter}{i}", 0.0) for i in orders], "b"))
        for field, letter in LETTERS.items()
    }
    shape = tuple(value[name] for name in SHAPES.get(more.get("projection", ""), "").split())
    x = given.get("cx", width / 2.0 + value["dx"] * size)
    y = given.get("cy", height / 2.0 + value["dy"] * size)
    affine = (given.get("fx", focal) - focal) * size, value["skew"] * size, value["b3"] * size
    return Lens(focal * size, width, height, x, y, *affine, **{"shape": shape} | terms | more)


def model_of(
    path: Path, lens: Lens, models: Mapping[str, LensModel], *, integer: bool = False
) -> tuple[str, dict[str, float]]:
    """Return the simplest model that is exactly this lens, and its parameters in their order.

    With `integer` the frame must be whole pixels. An `InputError` if there is no model for `path`.
    """
    from pcfix.lens.imaging import project

    values = {
        f"{letter}{i}": value
        for field, letter in LETTERS.items()
        for i, value in enumerate(getattr(lens, field), start=1)
    }
    values |= {"f": lens.focal, "fx": lens.focal + lens.b1, "fy": lens.focal}
    values |= {"cx": lens.principal_x, "cy": lens.principal_y, "skew": lens.b2, "b3": lens.b3}
    values |= dict(zip(SHAPES.get(lens.projection, "").split(), lens.shape, strict=False))
    # a model fits if it images rays all over the frame as the lens does
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, 8) * side for side in (lens.width, lens.height)))
    rays = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, lens.focal)])
    exact = project(lens, rays)
    fits = not integer or (lens.unit == "px" and lens.width % 1.0 == lens.height % 1.0 == 0.0)
    alike = [one for one in models if models[one].projection == lens.projection] if fits else []
    for name in sorted(alike, key=lambda one: models[one].names.count(" ")):
        given = {one: values.get(one, 0.0) for one in models[name].names.split()}
        held = project(models[name].lens(given, lens.width, lens.height), rays)
        if np.allclose(held, exact, rtol=0.0, atol=1e-11 * lens.focal, equal_nan=True):
            return name, given
    kind = f"{lens.sensor or 'of the images'} ({lens.projection} in {lens.unit})"
    sentence = f"the format cannot hold the lens {kind} exactly. Use another format."
    raise bad_file(path, "output.lens", sentence, lens=lens.sensor)


# ---- tie points ----


def no_tie_points(path: Path, why: str) -> NoTiePointsError:
    """Return the error for a file without tie points."""
    sentence = f"{path}: has no tie points, as {why}."
    return NoTiePointsError("cameras.no_tie_points", sentence, path=path)


class Observations(NamedTuple):
    """Points, and observations of them in any order: row of the point and camera, u and v.

    The camera -1 has no pose, and the point -1 is not in the file.
    """

    xyz: FloatArray
    point: IntArray
    camera: IntArray
    uv: FloatArray


def rows_of(wanted: IntArray, identifiers: IntArray) -> IntArray:
    """Return the first row of each wanted one in a list of identifiers, -1 if it is not there."""
    if not len(identifiers):
        return np.full(len(wanted), -1)
    order = np.argsort(identifiers, kind="stable")
    place = np.searchsorted(identifiers, wanted, sorter=order)
    row = order[np.minimum(place, len(order) - 1)]
    return np.where(identifiers[row] == wanted, row, -1)


def tie_points(*parts: Observations) -> TiePoints:
    """Join points and sort their observations by point, without those of a camera or point -1.

    An observation that is not finite is skipped, and such a position is unknown.
    """
    xyz, point, camera, uv = (np.concatenate(column) for column in zip(*parts, strict=True))
    is_there = (camera >= 0) & (point >= 0) & np.isfinite(uv).all(axis=1)
    counts = [len(part.xyz) for part in parts]
    point += np.repeat(np.cumsum([0, *counts[:-1]]), [len(part.point) for part in parts])
    xyz[~np.isfinite(xyz).all(axis=1)] = np.nan
    used = np.flatnonzero(is_there)
    used = used[np.argsort(point[used], kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(point[used], minlength=len(xyz)))])
    return TiePoints(xyz, Views(start, camera[used]), uv[used])


def image_size(folder: Path, name: str) -> tuple[int, int] | None:
    """Return width and height of an image; None if it is missing or cannot be opened.

    It can be in the folder, one folder up, or in ``images``.
    """
    from PIL import Image

    plain = name.replace("\\", "/")
    file = PureWindowsPath(name).name
    for place in (folder / plain, folder / file, folder.parent / plain, folder / "images" / file):
        with suppress(Exception), Image.open(place) as image:
            return image.size
    return None


# ---- shared by the writers ----


def block_to_write(path: Path, cameras: Cameras) -> tuple[FloatArray, tuple[Lens, ...]]:
    """Return the rotations as unit quaternions, shape (k, 4), scalar first, and the lenses."""
    from scipy.spatial.transform import Rotation

    if cameras.rotations is None or cameras.lenses is None:
        sentence = "the cameras have no rotations or no lenses, so they cannot be written."
        raise bad_file(path, "output.no_lenses", sentence)
    wxyz = np.roll(Rotation.from_matrix(cameras.rotations).as_quat(canonical=True), 1, axis=1)
    return wxyz, cameras.lenses


def write_new(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files into a folder, which need not exist; none where one of them exists."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in contents:
        check_output(folder / name, overwrite=False)
    for name, data in contents.items():
        write_bytes(folder / name, data, overwrite=False)
