"""Rules for what stands in camera files: numbers, XML and JSON, rotations, lenses and CRS."""

from __future__ import annotations

import itertools
import lzma
import re
import sqlite3
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, PcfixError, PcfixWarning
from pcfix.io.cameras.formats import Source
from pcfix.io.files import check_output, parse_json, write_bytes
from pcfix.model import Cameras, FloatArray, Lens

ROUNDING = 1e-3
"""Of a rotation's elements: files with four decimals pass, a mirrored or scaled one does not."""

DAMAGES = (
    *(ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError),
    *(SyntaxError, TypeError, ValueError, lzma.LZMAError, sqlite3.Error, struct.error),
    *(zipfile.BadZipFile, zlib.error),
)
"""What readers run into where a file is cut off, or holds something else than it should."""


def wrong(path: object, code: str, sentence: str, /, **values: Any) -> InputError:
    """Return the error for a file: its path, what is wrong, and what to do."""
    return InputError(code, f"{path}: {sentence}", **{"path": path, **values})


def damaged(path: object, why: object, **values: Any) -> InputError:
    """Return the error for contents that no software writes."""
    sentence = f"{path}: is damaged or cut off ({why}). Export it again."
    return InputError("cameras.damaged", sentence, path=path, **values)


def no_pose(path: Path, why: str = "no image has a pose") -> InputError:
    """Return the error for a file without poses."""
    sentence = f"{path}: {why}. Align the images first, then export their poses."
    return InputError("cameras.no_pose", sentence, path=path)


def unsupported(path: Path, what: str, remedy: str, **values: Any) -> InputError:
    """Return the error for a lens, rotation or frame that pcfix has no model for."""
    sentence = f"{path}: {what} is not supported. {remedy}."
    return InputError("cameras.unsupported", sentence, path=path, **values)


def missing(path: Path, remedy: str = "Keep all files of the project together") -> InputError:
    """Return the error for a file of a project that is not there."""
    return wrong(path, "cameras.missing_file", f"is missing. {remedy}.")


def several(path: Path, count: int, images: int) -> PcfixWarning:
    """Return a note on models that are not connected, of which the largest is read."""
    return PcfixWarning(
        "cameras.several_models",
        f"{path}: has {count} models that are not connected. The largest is read, with {images}"
        " images; those of the others are left out.",
        models=count,
        images=images,
    )


def sensor_unused(source: Source, why: str) -> InputError:
    """Return the error for a sensor that the cameras have no use for."""
    sentence = f"{source.path}: has {why}, so --sensor {source.sensor} has no use. Leave it out."
    return InputError("cameras.sensor_unused", sentence, path=source.path, sensor=source.sensor)


NO_LENS = "cameras.no_lens"


def without_lens(path: Path, why: str) -> PcfixWarning:
    """Return a note on images without a frame."""
    return PcfixWarning(
        NO_LENS, f"{path}: {why}, so every point in front of a camera counts as inside its frame."
    )


@contextmanager
def reading(path: object) -> Iterator[None]:
    """Raise `InputError` for whatever damaged contents make the block run into."""
    try:
        with np.errstate(all="ignore"):
            yield
    except PcfixError:
        raise
    except KeyError as error:
        raise damaged(path, f"{error} is missing") from error
    except DAMAGES as error:
        raise damaged(path, error or type(error).__name__) from error


def rotations(path: Path, labels: Sequence[str], matrices: FloatArray) -> FloatArray:
    """Return the proper rotations closest to matrices, shape (k, 3, 3), rounded in their file."""
    matrices = np.asarray(matrices, np.float64).reshape(-1, 3, 3)
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = ~((off <= ROUNDING) & (np.linalg.det(np.nan_to_num(matrices, posinf=0.0)) > 0.0))
    if bad.any():
        label = labels[int(np.argmax(bad))]
        sentence = (
            f"the rotation of {label} is mirrored, or its axes are not at right angles. Export the"
            " poses again."
        )
        raise wrong(path, "cameras.rotation", sentence, image=label)
    for _ in range(2):  # Newton's iteration to the polar factor squares the rounding each time
        matrices = 1.5 * matrices - 0.5 * matrices @ matrices.transpose(0, 2, 1) @ matrices
    return matrices


def quaternions(path: Path, labels: Sequence[str], wxyz: FloatArray) -> FloatArray:
    """Return the rotations, shape (k, 3, 3), of unit quaternions (k, 4), the scalar first."""
    from scipy.spatial.transform import Rotation

    bad = ~(np.abs(np.linalg.norm(wxyz, axis=1) - 1.0) <= ROUNDING)
    if bad.any():
        label = labels[int(np.argmax(bad))]
        sentence = f"the quaternion of {label} has not the length 1. Export the poses again."
        raise wrong(path, "cameras.rotation", sentence, image=label)
    return np.asarray(Rotation.from_quat(np.roll(wxyz, -1, axis=1)).as_matrix())


def lens(path: Path, name: str, given: Lens) -> Lens:
    """Return the lens when its numbers can be those of a camera."""
    lists = (given.shape, given.radial, given.denominator, given.tangential, given.thin_prism)
    numbers = (*_lengths(given), *itertools.chain(*lists), *given.distortion_centre)
    positive = min(given.focal, given.focal + given.b1, given.width, given.height) > 0.0
    if not (positive and np.isfinite(numbers).all()):
        sentence = (
            f"the lens {name} has the focal length {given.focal:g} and the frame {given.width:g} x"
            f" {given.height:g}, or a number that is not finite. Export the calibration again."
        )
        raise wrong(path, "cameras.lens", sentence, lens=name)
    return given


def checked(path: Path, cameras: Cameras) -> Cameras:
    """Return cameras with proper rotations, after a look at their lenses too."""
    for given, label in dict(zip(cameras.lenses or (), cameras.labels, strict=False)).items():
        lens(path, given.sensor or f"of {label}", given)
    if cameras.rotations is not None:
        return replace(cameras, rotations=rotations(path, cameras.labels, cameras.rotations))
    return cameras


def repeated(path: Path, labels: Sequence[str], dropped: int = 0) -> tuple[PcfixWarning, ...]:
    """Return a note where labels repeat: they are no key, and their images are kept apart."""
    names = [label for label, count in Counter(labels).items() if count > 1]
    if not names:
        return ()
    copies = f"; {dropped} exact copies are dropped" if dropped else ""
    listed = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
    sentence = f"{path}: {len(names)} labels repeat ({listed}). Different positions stay{copies}."
    return (PcfixWarning("cameras.repeated", sentence, labels=names, dropped=dropped),)


def crs(path: Path, definition: str) -> str:
    """Return what a file says of its CRS: ``local``, or a definition that PROJ understands."""
    text = definition.strip()
    if text.lower() == "local" or text.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return "local"
    if not names_crs(text):
        sentence = (
            f"PROJ does not know the CRS '{text[:80]}'. Export the poses in a CRS with an EPSG"
            " code."
        )
        raise wrong(path, "cameras.crs", sentence, crs=text)
    return text


def names_crs(text: str) -> bool:
    """Whether PROJ understands a text as a CRS."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        CRS.from_user_input(text)
    except CRSError:
        return False
    return True


def utm_as_code(text: str) -> str:
    """Return ODM's "WGS84 UTM 16N" as an EPSG code, any other text as it is."""
    utm = re.match(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", text, re.IGNORECASE)
    return f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}" if utm else text


TOLERANCE = 1e-12
"""Of every number, relative to the focal length where it is a length."""


def is_same_lens(one: Lens, other: Lens) -> bool:
    """Whether two lenses take every direction to the same place, but for rounding.

    Zeros at the end of a list of coefficients do not count, nor does the name of the lens.
    """
    (kind, lists), (other_kind, other_lists) = _coefficients(one), _coefficients(other)
    off = np.abs(np.subtract(_lengths(one), _lengths(other))).max()
    if kind != other_kind or off > TOLERANCE * one.focal * 10.0:
        return False
    return all(
        len(a) == len(b) and np.allclose(a, b, rtol=TOLERANCE, atol=0.0)
        for a, b in zip(lists, other_lists, strict=True)
    )


def _coefficients(lens: Lens) -> tuple[tuple[object, ...], tuple[tuple[float, ...], ...]]:
    """Return the kind of a lens, without switches that switch nothing, and its coefficients."""
    lists = (lens.radial, lens.denominator, lens.tangential, lens.thin_prism)
    radial, denominator, tangential, prism = map(without_zeros, lists)
    turns = bool(tangential or prism)
    bent = bool(radial or denominator or turns)
    kind = (lens.projection, lens.unit, lens.inverse and bent, lens.in_turn and turns)
    centre = lens.distortion_centre if bent else (0.0, 0.0)
    return kind, (lens.shape, centre, radial, denominator, tangential, prism)


def _lengths(lens: Lens) -> tuple[float, ...]:
    frame = (lens.focal, lens.width, lens.height, lens.principal_x, lens.principal_y)
    return (*frame, lens.b1, lens.b2, lens.b3)


def without_zeros(values: Sequence[float]) -> tuple[float, ...]:
    """Return the values up to the last that is not zero."""
    last = max((i for i, value in enumerate(values) if value != 0.0), default=-1)
    return tuple(values[: last + 1])


def read_xml(path: Path, stream: IO[bytes] | None = None) -> Element:
    """Return the root of a document, from `stream` where it lies in an archive."""
    from defusedxml.ElementTree import parse

    with reading(path):
        root: Element = parse(stream if stream is not None else path, forbid_dtd=False).getroot()
    return root


def load_json(path: Path) -> Any:
    """Return what a JSON file holds."""
    with reading(path):
        return parse_json(path.read_bytes())


def number(path: Path, where: str, text: str | None) -> float:
    """Return the number in a text; `where` is the image and element, for the message."""
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        shown = (text or "").strip()
        sentence = f"{where}: '{shown}' is not a number. Export it again."
        raise wrong(path, "cameras.number", sentence, where=where, value=shown)
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


def write_new(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files into a folder, made if need be; none where one of them exists."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in contents:
        check_output(folder / name, overwrite=False)
    for name, data in contents.items():
        write_bytes(folder / name, data, overwrite=False)


def needs_lenses(path: Path) -> InputError:
    """Return the error for cameras that cannot be written without rotations and lenses."""
    sentence = f"{path}: the cameras have no rotations or no lenses, so they cannot be written."
    return InputError("output.no_lenses", sentence, path=path)


def lens_not_held(path: Path, given: Lens) -> InputError:
    """Return the error for a lens that a format cannot hold exactly."""
    sentence = (
        f"{path}: the format cannot hold the lens {given.sensor or 'of the images'}"
        f" ({given.projection} in {given.unit}) exactly. Take another format."
    )
    return InputError("output.lens", sentence, path=path, lens=given.sensor)


def bad_label(path: Path, label: str) -> InputError:
    """Return the error for an image whose name cannot stand in a file."""
    sentence = f"{path}: the format cannot hold the image name {label!r}. Take another format."
    return InputError("output.label", sentence, path=path, image=label)
