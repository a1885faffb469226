"""The simulated port, by hand: Snell's angles at each face of the traced path."""

import math

import numpy as np
import pytest

from pcfix.port.shapes import DomePort, FlatPort
from tests.utils.port_scenes import fermat_directions


def test_flat_port_obeys_snell():
    # 30 degrees in air; the layers by their tangents; the path is found to 1e-13 m on 0.02 m
    sines = [math.sin(math.radians(30.0)) / index for index in (1.0, 1.49, 1.34)]
    x = sum(math.tan(math.asin(s)) * d for s, d in zip(sines, (0.02, 0.008, 2.0), strict=True))
    (w,) = fermat_directions(np.array([[x, 0.0, 2.028]]), FlatPort(0.02, 0.008, 1.49), 1.34)
    assert math.degrees(math.atan2(w[0], w[2])) == pytest.approx(30.0, abs=1e-9)


def test_thin_dome_obeys_snell():
    # a ray across from a point 0.03 m off the centre of a dome of 0.05 m meets it at asin(3/5) in
    # air; 1 m further on in the water is the point
    centre = np.array([0.0, 0.0, 0.03])
    at = np.array([0.04, 0.0, 0.0])  # 0.04 = sqrt(0.05^2 - 0.03^2)
    normal = (at - centre) / 0.05
    bent = math.asin(0.6 / 1.34)
    across = np.array([1.0, 0.0, 0.0]) - 0.8 * normal
    towards = math.cos(bent) * normal + math.sin(bent) * across / np.linalg.norm(across)
    port = DomePort(0.05, 0.0, 1.49, tuple(centre))
    (w,) = fermat_directions((at + towards)[None], port, 1.34)
    assert w == pytest.approx([1.0, 0.0, 0.0], abs=1e-10)
