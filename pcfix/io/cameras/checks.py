"""Rules that the numbers of every camera file must keep; each message names file and image."""

from __future__ import annotations

from collections import Counter
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
    """Return the proper rotation next to a 3x3 matrix that is one but for its rounding.

    Raises
    ------
    InputError
        If it is not orthonormal, or mirrors.
    """
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
    """Return the rotation matrix of a unit quaternion, the scalar first.

    Raises
    ------
    InputError
        If its length is not 1.
    """
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
    """Return the lens when its numbers can be those of a camera.

    Raises
    ------
    InputError
        If focal length or frame are not positive, or a number is not finite.
    """
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
    """Return what a file says of its CRS: ``local``, or a definition that PROJ understands.

    Raises
    ------
    InputError
        If PROJ does not understand it.
    """
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
