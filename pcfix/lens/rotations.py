"""World to camera rotations from the angles of photogrammetry and of navigation.

Every function gives rotations of the project: from world axes (east, north, up) to camera axes x
right, y down, z forward. The *photogrammetric* camera has x right, y up and z backward instead.
All angles are in degrees, one per image; Rx, Ry, Rz are right-handed turns about those axes.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import TypeAlias

import numpy as np

from pcfix.model import FloatArray

Quaternions: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""x, y, z and w, each of shape (k,)."""

UP_BACK_TO_DOWN_FORWARD = np.diag([1.0, -1.0, -1.0])


def from_rotation_vectors(vectors_rad: FloatArray) -> FloatArray:
    """Return rotations, shape (k, 3, 3), from axes times angles, shape (k, 3), world to camera."""
    from scipy.spatial.transform import Rotation  # not quick to load

    return np.asarray(Rotation.from_rotvec(vectors_rad).as_matrix())


def from_photogrammetric(world_to_camera: FloatArray) -> FloatArray:
    """Return rotations from those to the photogrammetric camera, shape (k, 3, 3) both."""
    return np.asarray(UP_BACK_TO_DOWN_FORWARD @ world_to_camera)


def from_omega_phi_kappa(
    omega_deg: FloatArray, phi_deg: FloatArray, kappa_deg: FloatArray
) -> FloatArray:
    """Return rotations, shape (k, 3, 3), from the angles of photogrammetry.

    Photogrammetric camera axes go to the world by Rx(omega) Ry(phi) Rz(kappa). With all angles
    zero the camera looks straight down and the top of the image is north.
    """
    return _from_camera_to_world("XYZ", omega_deg, phi_deg, kappa_deg)


def from_yaw_pitch_roll(
    yaw_deg: FloatArray, pitch_deg: FloatArray, roll_deg: FloatArray
) -> FloatArray:
    """Return rotations, shape (k, 3, 3), from angles that are zero for a view straight down.

    With all angles zero the top of the image is north. Photogrammetric camera axes go to the
    world by Rz(-yaw) Rx(pitch) Ry(roll): yaw turns clockwise seen from above, pitch lifts the
    view towards the top of the image, roll lowers the right side.
    """
    return _from_camera_to_world("ZXY", -yaw_deg, pitch_deg, roll_deg)


def from_aircraft(yaw_deg: FloatArray, pitch_deg: FloatArray, roll_deg: FloatArray) -> FloatArray:
    """Return rotations, shape (k, 3, 3), from angles that are zero for a level view north.

    Yaw is the direction of the optical axis, clockwise from north; pitch its angle above the
    horizon, so that -90 is straight down with the top of the image towards yaw; roll turns about
    the axis, positive when the right side goes down. Photogrammetric camera axes go to the world
    by Rz(-yaw) Rx(90 + pitch) Rz(-roll).
    """
    return _from_camera_to_world("ZXZ", -yaw_deg, 90.0 + pitch_deg, -roll_deg)


def _from_camera_to_world(axes: str, *angles_deg: FloatArray) -> FloatArray:
    """Return rotations from turns about axes that go along with them.

    To the bit what scipy's ``Rotation.from_euler`` has, which takes a quarter of a second to load.
    """
    turns = [_about(axis, angles) for axis, angles in zip(axes, angles_deg, strict=True)]
    x, y, z, w = reduce(_then, turns)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, zw, xz, yw, yz, xw = x * y, z * w, x * z, y * w, y * z, x * w
    rows = (
        (xx - yy - zz + ww, 2.0 * (xy - zw), 2.0 * (xz + yw)),
        (2.0 * (xy + zw), -xx + yy - zz + ww, 2.0 * (yz - xw)),
        (2.0 * (xz - yw), 2.0 * (yz + xw), -xx - yy + zz + ww),
    )
    camera_to_world = np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
    return from_photogrammetric(camera_to_world.transpose(0, 2, 1))


def _about(axis: str, angles_deg: FloatArray) -> Quaternions:
    """Return turns about one axis; sine and cosine are those of C, not of numpy."""
    half = [angle * (math.pi / 180.0) / 2.0 for angle in np.asarray(angles_deg).tolist()]
    zero = np.zeros(len(half))
    sine, cosine = (
        np.array([f(one) if math.isfinite(one) else math.nan for one in half])
        for f in (math.sin, math.cos)
    )
    x, y, z = (sine if axis == name else zero for name in "XYZ")
    return x, y, z, cosine


def _then(p: Quaternions, q: Quaternions) -> Quaternions:
    """Return the product of quaternions."""
    (px, py, pz, pw), (qx, qy, qz, qw) = p, q
    return (
        pw * qx + qw * px + (py * qz - pz * qy),
        pw * qy + qw * py + (pz * qx - px * qz),
        pw * qz + qw * pz + (px * qy - py * qx),
        pw * qw - px * qx - py * qy - pz * qz,
    )
