"""Rules that the numbers of every camera file must keep, and whether two lenses are one."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

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


def repeated(path: Path, labels: Sequence[str], dropped: int = 0) -> tuple[str, ...]:
    """Return a note where labels repeat: they are no key, and their images are kept apart."""
    names = [label for label, count in Counter(labels).items() if count > 1]
    if not names:
        return ()
    listed = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
    return (
        f"{path}: {len(names)} labels occur more than once ({listed}); cameras at different"
        f" positions are kept as different images, {dropped} exact copies dropped.",
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
    numbers = (
        *(given.focal, given.width, given.height, given.principal_x, given.principal_y),
        *(given.b1, given.b2, given.b3, *given.shape, *given.radial, *given.denominator),
        *(*given.tangential, *given.thin_prism, *given.distortion_centre),
    )
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
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    text = definition.strip()
    if text.lower() == "local" or text.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return "local"
    try:
        CRS.from_user_input(text)
    except CRSError as error:
        raise InputError(
            f"{path}: the CRS '{text[:80]}' is not one that PROJ knows; export the poses in a CRS"
            " with an EPSG code."
        ) from error
    return text


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
    first, second = _plain(one), _plain(other)
    if (first.projection, first.unit) != (second.projection, second.unit):
        return False
    if (first.inverse, first.in_turn) != (second.inverse, second.in_turn):
        return False
    lengths = np.array([_lengths(lens) for lens in (first, second)])
    if np.abs(lengths[0] - lengths[1]).max() > TOLERANCE * first.focal * 10.0:
        return False
    pairs = ((first.shape, second.shape), (first.distortion_centre, second.distortion_centre))
    lists = ((_series(first)[i], _series(second)[i]) for i in range(4))
    return all(_are_close(a, b) for a, b in (*pairs, *lists))


def _plain(lens: Lens) -> Lens:
    """Return the lens without switches that switch nothing."""
    radial, denominator, tangential, prism = _series(lens)
    bent = bool(radial or denominator or tangential or prism)
    return replace(
        lens,
        inverse=lens.inverse and bent,
        in_turn=lens.in_turn and bool(tangential or prism),
        distortion_centre=lens.distortion_centre if bent else (0.0, 0.0),
    )


def _lengths(lens: Lens) -> tuple[float, ...]:
    frame = (lens.focal, lens.width, lens.height, lens.principal_x, lens.principal_y)
    return (*frame, lens.b1, lens.b2, lens.b3)


def _series(lens: Lens) -> tuple[tuple[float, ...], ...]:
    lists = (lens.radial, lens.denominator, lens.tangential, lens.thin_prism)
    return tuple(_without_zeros(each) for each in lists)


def _without_zeros(values: Sequence[float]) -> tuple[float, ...]:
    last = max((i for i, value in enumerate(values) if value != 0.0), default=-1)
    return tuple(values[: last + 1])


def _are_close(one: Sequence[float], other: Sequence[float]) -> bool:
    return len(one) == len(other) and bool(
        np.allclose(np.array(one, float), np.array(other, float), rtol=TOLERANCE, atol=0.0)
    )
