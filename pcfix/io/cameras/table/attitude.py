"""How the images of a table are turned: from angles, quaternions or matrices to rotations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.formats import Angles
from pcfix.io.cameras.table.columns import Columns
from pcfix.lens import rotations
from pcfix.model import FloatArray

OMEGA_PHI_KAPPA = ("omega", "phi", "kappa")
YAW_PITCH_ROLL = ("yaw", "pitch", "roll")
QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{i}{j}" for i in "123" for j in "123")
AGREEMENT_DEG = 0.05
"""Of angles with the matrix beside them; angles with two decimals pass."""
LOOKS_DOWN_DEG = 80.0
"""Largest tilt from the vertical of a camera that looks at the ground."""


def read_rotations(columns: Columns, angles: Angles | None, suffix: str = "") -> FloatArray | None:
    """Return world to camera rotations, or None where the table has nothing that turns.

    `angles` is what the user says that they are, `suffix` is ``_est`` for adjusted values.
    """
    opk, ypr = (tuple(a + suffix for a in kind) for kind in (OMEGA_PHI_KAPPA, YAW_PITCH_ROLL))
    for kind in (opk, ypr, QUATERNION, MATRIX):
        _refuse_part(columns, kind)
    if columns.has("alpha") or columns.has("nu"):
        raise InputError(
            f"{columns.path}: has the angles alpha, nu, kappa, which pcfix does not read; export"
            " omega, phi, kappa."
        )
    if angles is not None:
        return _as_the_user_says(columns, angles, opk, ypr)
    if columns.has(*opk):
        return _from_omega_phi_kappa(columns, opk)
    if columns.has(*QUATERNION):
        return _from_quaternion(columns)
    if columns.has(*MATRIX):
        return _from_matrix(columns)
    return _from_yaw_pitch_roll(columns, ypr) if columns.has(*ypr) else None


def _refuse_part(columns: Columns, kind: Sequence[str]) -> None:
    there = [role for role in kind if columns.has(role)]
    missing = [role for role in kind if not columns.has(role)]
    if there and missing:
        raise InputError(
            f"{columns.path}: the header has {', '.join(there)} but lacks {', '.join(missing)}."
        )


def _as_the_user_says(
    columns: Columns, angles: Angles, opk: Sequence[str], ypr: Sequence[str]
) -> FloatArray:
    wanted = opk if angles == "omega-phi-kappa" else ypr
    if not columns.has(*wanted):
        raise InputError(
            f"{columns.path}: has no columns {', '.join(wanted)}, which --angles {angles} needs."
        )
    values = columns.of(wanted).T
    if angles == "omega-phi-kappa":
        return rotations.from_omega_phi_kappa(*values)
    if angles == "aircraft":
        return rotations.from_aircraft(*values)
    return rotations.from_yaw_pitch_roll(*values)


def _from_omega_phi_kappa(columns: Columns, opk: Sequence[str]) -> FloatArray:
    place = columns.place
    reality_capture = columns.after_hash and columns.name("label") == "name"
    if place[opk[1]] < place[opk[0]] or reality_capture:
        raise InputError(
            f"{columns.path}: omega, phi, kappa may be turns in another order here"
            f" ({'RealityCapture' if reality_capture else 'phi comes first'}); export heading,"
            " pitch, roll, or give --angles omega-phi-kappa if you know that omega is the first"
            " turn."
        )
    found = rotations.from_omega_phi_kappa(*columns.of(opk).T)
    if columns.has(*MATRIX) and opk == OMEGA_PHI_KAPPA:
        _refuse_disagreement(columns, found, _from_matrix(columns))
    return found


def _refuse_disagreement(columns: Columns, one: FloatArray, other: FloatArray) -> None:
    """Refuse rows whose matrix and angles are different turns."""
    half_chord = np.linalg.norm(one - other, axis=(1, 2)) / np.sqrt(8.0)
    apart_deg = np.degrees(2.0 * np.arcsin(np.minimum(half_chord, 1.0)))
    worst = int(np.argmax(apart_deg))
    if apart_deg[worst] > AGREEMENT_DEG:
        raise InputError(
            f"{columns.where(worst)}: omega, phi, kappa and r11 to r33 are"
            f" {apart_deg[worst]:.3g} degrees apart; export the table again."
        )


def _from_matrix(columns: Columns) -> FloatArray:
    """Return rotations from r11 ... r33, to axes either y up, z back or y down, z forward.

    Both turn world to camera. Which one it is shows where the cameras look: at the ground.
    """
    rows = zip(columns.labels, columns.of(MATRIX), strict=True)
    found = np.array(
        [checks.rotation(columns.path, label, row.reshape(3, 3)) for label, row in rows]
    )
    back_is_up = found[:, 2, 2] > 0.0
    if back_is_up.all():
        return rotations.from_photogrammetric(found)
    if back_is_up.any():
        raise InputError(
            f"{columns.where(int(np.argmax(back_is_up)))}: r33 has another sign than elsewhere, so"
            " the axes of the camera are not clear; give omega, phi, kappa."
        )
    return found


def _from_quaternion(columns: Columns) -> FloatArray:
    rows = zip(columns.labels, columns.of(QUATERNION), strict=True)
    return np.array([checks.quaternion(columns.path, label, row) for label, row in rows])


def _from_yaw_pitch_roll(columns: Columns, ypr: Sequence[str]) -> FloatArray:
    """Return rotations from angles of the view; what the header cannot say, the view must."""
    values = columns.of(ypr).T
    if columns.name(ypr[0]).startswith("gimbal"):
        return rotations.from_aircraft(*values)
    found = rotations.from_yaw_pitch_roll(*values)
    if not (columns.after_hash and columns.name(ypr[0]) == "heading"):  # RealityCapture's
        _refuse_what_aircraft_explains(columns, found, rotations.from_aircraft(*values))
    return found


def _refuse_what_aircraft_explains(
    columns: Columns, found: FloatArray, aircraft: FloatArray
) -> None:
    """Refuse angles that are more likely those of a gimbal, which are -90 straight down."""
    tilt, other = (_tilt_deg(each) for each in (found, aircraft))
    if other.max() < LOOKS_DOWN_DEG and np.median(other) < np.median(tilt):
        raise InputError(
            f"{columns.path}: with yaw, pitch, roll that are 0 straight down the cameras look"
            f" {np.median(tilt):.0f} degrees away from the vertical, with those of a gimbal (-90"
            f" straight down) {np.median(other):.0f}; say which by --angles yaw-pitch-roll or"
            " --angles aircraft."
        )


def _tilt_deg(found: FloatArray) -> FloatArray:
    """Return the angles between the views and straight down."""
    return np.degrees(np.arctan2(np.hypot(found[:, 2, 0], found[:, 2, 1]), -found[:, 2, 2]))
