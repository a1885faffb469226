"""Rotations from angles are those of scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.lens import rotations

CASES = (
    (rotations.from_omega_phi_kappa, "XYZ", (1.0, 1.0, 1.0), 0.0),
    (rotations.from_yaw_pitch_roll, "ZXY", (-1.0, 1.0, 1.0), 0.0),
    (rotations.from_aircraft, "ZXZ", (-1.0, 1.0, -1.0), 90.0),
)


@pytest.mark.parametrize(("function", "axes", "signs", "pitch_deg"), CASES)
def test_rotations(function, axes, signs, pitch_deg):
    steps = np.linspace(-360.0, 360.0, 9)
    angles = np.vstack([
        np.random.default_rng(8).uniform(-400.0, 400.0, (2000, 3)),
        np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3),
    ])  # fmt: skip
    turned = signs * angles + [0.0, pitch_deg, 0.0]
    camera_to_world = Rotation.from_euler(axes, turned, degrees=True).as_matrix()
    expected = rotations.from_photogrammetric(camera_to_world.transpose(0, 2, 1))
    np.testing.assert_allclose(function(*angles.T), expected, rtol=0, atol=1e-14)


def test_not_finite():
    found = rotations.from_omega_phi_kappa(*np.array([[0.0, np.inf, np.nan], [0.0] * 3, [0.0] * 3]))
    assert np.isfinite(found).all(axis=(1, 2)).tolist() == [True, False, False]
