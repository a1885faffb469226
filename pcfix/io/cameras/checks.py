"""Rules for what stands in camera files: numbers, XML and JSON, rotations, lenses and CRS."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_output, parse_json, write_bytes
from pcfix.model import FloatArray, Lens

ROUNDING = 1e-3
"""Of a rotation's elements: files with four decimals pass, a mirrored or scaled one does not."""


def rotation(path: Path, label: str, matrix: FloatArray) -> FloatArray:
    """Return the proper rotation next to a 3x3 matrix that is one but for its rounding."""
    if not (np.abs(matrix) < 2.0).all() or np.abs(matrix @ matrix.T - np.eye(3)).max() > ROUNDING:
        raise InputError(
            f"{path}: image {label}: the rotation matrix is not orthonormal; export it again."
        )
    if np.linalg.det(matrix) < 0.0:
        raise InputError(
            f"{path}: image {label}: the rotation matrix mirrors (determinant -1); its axes are"
            " left-handed, export it again."
        )
    for _ in range(2):  # Newton's iteration to the polar factor; the rounding is squared each time
        matrix = 1.5 * matrix - 0.5 * matrix @ matrix.T @ matrix
    return matrix


def rotations(path: Path, labels: Sequence[str], matrices: Iterable[FloatArray]) -> FloatArray:
    """Return the proper rotations next to those of images, shape (k, 3, 3)."""
    pairs = zip(labels, matrices, strict=True)
    return np.array([rotation(path, label, matrix) for label, matrix in pairs])


def repeated(path: Path, labels: Sequence[str], dropped: int = 0) -> tuple[str, ...]:
    """Return a note where labels repeat: they are no key, and their images are kept apart."""
    names = [label for label, count in Counter(labels).items() if count > 1]
    if not names:
        return ()
    copies = f"; {dropped} exact copies are dropped" if dropped else ""
    listed = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
    return (
        f"{path}: {len(names)} labels occur more than once ({listed}); cameras at different"
        f" positions are kept as different images{copies}.",
    )


def quaternion(path: Path, label: str, wxyz: FloatArray) -> FloatArray:
    """Return the rotation matrix of a unit quaternion, the scalar first."""
    from scipy.spatial.transform import Rotation

    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(wxyz))
    if not abs(length - 1.0) <= ROUNDING:
        raise InputError(
            f"{path}: image {label}: the quaternion has length {length:g} instead of 1; export"
            " the poses again."
        )
    return np.asarray(Rotation.from_quat(np.roll(wxyz, -1)).as_matrix())


def lens(path: Path, name: str, given: Lens) -> Lens:
    """Return the lens when its numbers can be those of a camera."""
    lists = (given.shape, given.radial, given.denominator, given.tangential, given.thin_prism)
    numbers = (*_lengths(given), *itertools.chain(*lists), *given.distortion_centre)
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: camera {name}: its calibration has a number that is not finite.")
    if not min(given.focal, given.width, given.height) > 0.0:
        raise InputError(
            f"{path}: camera {name}: focal length {given.focal:g} and frame {given.width:g} x"
            f" {given.height:g} must be positive; export the calibration again."
        )
    return given


def crs(path: Path, definition: str) -> str:
    """Return what a file says of its CRS: ``local``, or a definition that PROJ understands."""
    text = definition.strip()
    if text.lower() == "local" or text.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return "local"
    if not names_crs(text):
        raise InputError(
            f"{path}: the CRS '{text[:80]}' is not one that PROJ knows; export the poses in a CRS"
            " with an EPSG code."
        )
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

    Zeros at the end of a list of coefficients count for nothing, nor does what the lens is called.
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
    """Return the root of a document.

    Parameters
    ----------
    path : Path
        The file; only for messages when `stream` is given.
    stream : binary file, optional
        Read this instead, for documents inside an archive.
    """
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import parse

    try:
        root: Element = parse(stream if stream is not None else path, forbid_dtd=False).getroot()
    except DefusedXmlException as error:
        raise InputError(
            f"{path}: the XML declares entities, which no camera file needs; it is not read."
        ) from error
    except (ParseError, LookupError, ValueError) as error:
        raise InputError(
            f"{path}: the XML is damaged or cut off ({error}); export it again."
        ) from error
    return root


def number(path: Path, where: str, text: str | None) -> float:
    """Return the number in a text; `where` is the image and element, for the message."""
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: {where}: '{(text or '').strip()}' is not a number.")
    return value


def numbers(path: Path, where: str, text: str | None, count: int) -> FloatArray:
    """Return `count` numbers separated by white space or commas."""
    words: list[Any] = (text or "").replace(",", " ").split()
    if len(words) != count:
        raise InputError(f"{path}: {where}: has {len(words)} numbers instead of {count}.")
    return np.array([number(path, where, word) for word in words])


def load_json(path: Path) -> Any:
    """Return what a JSON file holds."""
    try:
        return parse_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except ValueError as error:
        raise InputError(
            f"{path}: the JSON is damaged or cut off ({error}); copy it again from the project."
        ) from error


def write_new(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files into a folder, made if need be; none where one of them exists."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in contents:
        check_output(folder / name, overwrite=False)
    for name, data in contents.items():
        write_bytes(folder / name, data, overwrite=False)


def mapping(path: Path, where: str, value: Any) -> dict[str, Any]:
    """Return a value that is a JSON object."""
    if not isinstance(value, dict):
        raise InputError(f"{path}: {where} is not an object with names but {_shown(value)}.")
    return value


def json_number(path: Path, where: str, value: Any) -> float:
    """Return a finite number."""
    return float(vector(path, where, [value], 1)[0])


def vector(path: Path, where: str, value: Any, count: int) -> FloatArray:
    """Return `count` finite numbers."""
    return np.asarray(rows(path, where, [value], count)[0])


def rows(path: Path, where: str, values: Collection[Any], count: int) -> FloatArray:
    """Return rows of `count` finite numbers each, shape (len(values), count)."""
    try:
        found = np.array(list(values), dtype=np.float64).reshape(len(values), -1)
    except (TypeError, ValueError, OverflowError):
        found = np.empty((len(values), 0))
    if len(values) and (found.shape[1] != count or not np.isfinite(found).all()):
        shown = next((v for v in values if not _is_row(v, count)), values)
        raise InputError(f"{path}: {where}: {_shown(shown)} is not {count} finite number(s).")
    return found.reshape(len(values), count)


def _is_row(value: Any, count: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == count
        and all(isinstance(v, int | float) and abs(v) < np.inf for v in value)
    )


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
