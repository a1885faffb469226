"""The equations of the papers, each in a few lines of numpy from its text, against the doors.

S is Skarlatos & Agrafiotis 2018 and M is Mulsow 2024; those of Hsu & Wang stand in
`tests.refract.test_literature`.
"""

import math

import numpy as np
import pytest

import pcfix

N = 1.34
CENTRES = np.array([[-12.0, 4.0, 80.0], [14.0, -3.0, 82.0]])
CAMERAS = pcfix.Cameras(("O1", "O2"), CENTRES, np.array([np.diag([1.0, -1.0, -1.0])] * 2))
APPARENT = np.array([[1.0, 2.0, -3.0], [-6.0, 9.0, -0.5], [20.0, -14.0, -11.0], [0.0, 0.0, -7.0]])


def pierced(point, centre):
    """S eq 8: the line of the image point meets the surface, where Z is 0."""
    return centre + (point - centre) * centre[2] / (centre[2] - point[2])


def refracted(v1, normal, n1, n2):
    """S eq 10, as printed, for unit vectors."""
    across = np.cross(normal, v1)
    root = math.sqrt(1.0 - (n1 / n2) ** 2 * (across @ across))
    return n1 / n2 * np.cross(normal, np.cross(-normal, v1)) - normal * root


@pytest.mark.parametrize("rays", [2, 5])
def test_s_eqs_8_to_11_are_method_snell(rays):
    """Eq 11: A = A1 + t1 v2 = A2 + t2 v2', in least squares, here for any number of rays."""
    rng = np.random.default_rng(4)
    centres = np.vstack([CENTRES, rng.normal([0, 0, 80], [15, 15, 2], (3, 3))])[:rays]
    cameras = pcfix.Cameras(tuple("abcde"[:rays]), centres)
    found = pcfix.correct_points(APPARENT, cameras, 0.0, index=N, method="snell", max_angle=None)
    for i, point in enumerate(APPARENT):
        system, right = np.zeros((3 * rays, 3 + rays)), np.zeros(3 * rays)
        for j, centre in enumerate(centres):
            a = pierced(point, centre)
            v1 = (point - centre) / np.linalg.norm(point - centre)
            rows = slice(3 * j, 3 * j + 3)
            system[rows, :3] = np.eye(3)
            system[rows, 3 + j] = -refracted(v1, np.array([0.0, 0.0, 1.0]), 1.0, N)
            right[rows] = a
        expected = np.linalg.lstsq(system, right, rcond=None)[0][:3]
        # m: the worst of these pairs multiplies rounding of 1e-14 by a hundred
        assert found.xyz[i] == pytest.approx(expected, abs=1e-10)


def test_s_eqs_1_to_7_are_method_shan():
    """Eq 3 with Z / s for each image (eqs 2 and 7, with their root), s by eqs 6 and 7 in turn."""
    found = pcfix.correct_points(APPARENT, CAMERAS, 0.0, index=N, method="shan", max_angle=None)
    for i, point in enumerate(APPARENT):
        x_y = (point - CENTRES)[:, :2] / (point - CENTRES)[:, 2:]  # image coordinates over -f
        s, ground = np.ones(2), point
        for _ in range(60):
            # X - X_S = x (Z / s - Z_S), and its like in Y
            system = np.array([[*np.eye(2)[k], -x_y[j, k] / s[j]] for j in (0, 1) for k in (0, 1)])
            right = [CENTRES[j, k] - x_y[j, k] * CENTRES[j, 2] for j in (0, 1) for k in (0, 1)]
            ground = np.linalg.lstsq(system, np.array(right), rcond=None)[0]
            r = np.hypot(*(ground[:2] - CENTRES[:, :2]).T)
            tan_a = r / (CENTRES[:, 2] - ground[2] / s)  # eq 6
            s = np.sqrt(N**2 + (N**2 - 1.0) * tan_a**2)  # eq 7
        # m: the door stops where tan a moves by less than 1e-9, some 1e-8 m in weak pairs
        assert found.xyz[i] == pytest.approx(ground, abs=5e-8)


def test_s_eq_1_is_the_depth_of_one_image():
    """Z' = Z [n2 + (n2 - 1) tan2 a]^-1/2: one image alone, which H's eq 1 turns round."""
    one = pcfix.Cameras(("O1",), CENTRES[:1])
    found = pcfix.correct_points(APPARENT, one, 0.0, index=N, method="butler")
    tan_a = np.hypot(*(APPARENT - CENTRES[0])[:, :2].T) / (CENTRES[0, 2] - APPARENT[:, 2])
    back = found.xyz[:, 2] * (N**2 + (N**2 - 1.0) * tan_a**2) ** -0.5
    assert back == pytest.approx(APPARENT[:, 2], abs=1e-12)
