"""The simulated lens against Brown's formula, term by term."""

import numpy as np
import pytest

from pcfix.simulate.settings import SceneSettings
from tests.utils.twins import image_slowly

REAL = (-0.08, 0.03, -0.006, 0.0007, -0.0005)


def test_brown():
    optics = SceneSettings(distortion=REAL).optics
    rng = np.random.default_rng(0)
    ideal = rng.uniform(0, 1, (200, 2)) * [5472, 3648]
    image = optics.to_image(ideal)
    for i in range(200):
        plane = (ideal[i] - [2736, 1824]) / optics.lens.focal
        slow = image_slowly(optics.lens, np.array([*plane, 1.0]))
        assert image[i] == pytest.approx(slow, abs=1e-8)  # pixels
    assert np.abs(image - ideal).max() > 20.0
    assert optics.to_ideal(image) == pytest.approx(ideal, abs=1e-8)
