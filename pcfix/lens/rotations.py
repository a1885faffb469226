"""World to camera rotations from the angles of photogrammetry and of navigation.

Every function gives rotations of the project: from world axes (east, north, up) to camera axes x
right, y down, z forward. The *photogrammetric* camera has x right, y up and z backward instead.
All angles are in degrees, one per image; Rx, Ry, Rz are right-handed rotations about those axes.
"""

import numpy as np

from pcfix.model import FloatArray


def from_rotation_vectors(vectors_rad: FloatArray) -> FloatArray:
    """Return rotations, shape (k, 3, 3), from axes times angles, shape (k, 3), world to camera."""
    from scipy.spatial.transform import Rotation  # slow to import

    return np.asarray(Rotation.from_rotvec(vectors_rad).as_matrix())


def from_photogrammetric(world_to_camera: FloatArray) -> FloatArray:
    """Convert rotations to the photogrammetric camera, shape (k, 3, 3): y and z change sign."""
    return np.asarray(np.diag([1.0, -1.0, -1.0]) @ world_to_camera)


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
    """Return rotations from the product of turns about axes, camera to world."""
    from scipy.spatial.transform import Rotation  # slow to import

    camera_to_world = Rotation.from_euler(axes, np.column_stack(angles_deg), degrees=True)
    return from_photogrammetric(camera_to_world.as_matrix().transpose(0, 2, 1))
