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
        there = [role for role in kind if columns.has(role)]
        missing = [role for role in kind if not columns.has(role)]
        if there and missing:
            raise InputError(
                f"{columns.path}: the header has {', '.join(there)} but lacks {', '.join(missing)}."
            )
    if columns.has("alpha") or columns.has("nu"):
        raise InputError(
            f"{columns.path}: has the angles alpha, nu, kappa, which pcfix does not read; export"
            " omega, phi, kappa."
        )
    if angles is not None:
        roles = opk if angles == "omega-phi-kappa" else ypr
        if not columns.has(*roles):
            raise InputError(
                f"{columns.path}: has no columns {', '.join(roles)}, which --angles {angles} needs."
            )
        return FROM_ANGLES[angles](*columns.of(roles).T)
    if columns.has(*opk):
        return _from_omega_phi_kappa(columns, opk)
    if columns.has(*QUATERNION):
        rows = zip(columns.labels, columns.of(QUATERNION), strict=True)
        return np.array([checks.quaternion(columns.path, label, row) for label, row in rows])
    if columns.has(*MATRIX):
        return _from_matrix(columns)
    return _from_yaw_pitch_roll(columns, ypr) if columns.has(*ypr) else None


FROM_ANGLES = {
    "omega-phi-kappa": rotations.from_omega_phi_kappa,
    "yaw-pitch-roll": rotations.from_yaw_pitch_roll,
    "aircraft": rotations.from_aircraft,
}


FROM_ANGLES = {
    "omega-phi-kappa": rotations.from_omega_phi_kappa,
    "yaw-pitch-roll": rotations.from_yaw_pitch_roll,
    "aircraft": rotations.from_aircraft,
}


def _from_omega_phi_kappa(columns: Columns, opk: Sequence[str]) -> FloatArray:
    """Return rotations from the angles; a matrix beside them must be the same turn."""
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
        half_chord = np.linalg.norm(found - _from_matrix(columns), axis=(1, 2)) / np.sqrt(8.0)
        apart_deg = np.degrees(2.0 * np.arcsin(np.minimum(half_chord, 1.0)))
        worst = int(np.argmax(apart_deg))
        if apart_deg[worst] > AGREEMENT_DEG:
            raise InputError(
                f"{columns.where(worst)}: omega, phi, kappa and r11 to r33 are"
                f" {apart_deg[worst]:.3g} degrees apart; export the table again."
            )
    return found


def _from_matrix(columns: Columns) -> FloatArray:
    """Return rotations from r11 ... r33, to axes either y up, z back or y down, z forward.

    Both turn world to camera. Which one it is shows where the cameras look: at the ground.
    """
    matrices = columns.of(MATRIX).reshape(-1, 3, 3)
    found = checks.rotations(columns.path, columns.labels, matrices)
    back_is_up = found[:, 2, 2] > 0.0
    if back_is_up.all():
        return rotations.from_photogrammetric(found)
    if back_is_up.any():
        raise InputError(
            f"{columns.where(int(np.argmax(back_is_up)))}: r33 has another sign than elsewhere, so"
            " the axes of the camera are not clear; give omega, phi, kappa."
        )
    return found


def _from_yaw_pitch_roll(columns: Columns, ypr: Sequence[str]) -> FloatArray:
    """Return rotations from angles of the view; what the header cannot say, the view must.

    Refused are angles that are more likely those of a gimbal, which are -90 straight down.
    """
    values = columns.of(ypr).T
    aircraft = rotations.from_aircraft(*values)
    if columns.name(ypr[0]).startswith("gimbal"):
        return aircraft
    found = rotations.from_yaw_pitch_roll(*values)
    if columns.after_hash and columns.name(ypr[0]) == "heading":  # RealityCapture's
        return found
    tilt, other = (  # the angles between the views and straight down
        np.degrees(np.arctan2(np.hypot(each[:, 2, 0], each[:, 2, 1]), -each[:, 2, 2]))
        for each in (found, aircraft)
    )
    if other.max() < LOOKS_DOWN_DEG and np.median(other) < np.median(tilt):
        raise InputError(
            f"{columns.path}: with yaw, pitch, roll that are 0 straight down the cameras look"
            f" {np.median(tilt):.0f} degrees away from the vertical, with those of a gimbal (-90"
            f" straight down) {np.median(other):.0f}; say which by --angles yaw-pitch-roll or"
            " --angles aircraft."
        )
    return found
