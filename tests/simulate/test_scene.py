"""The simulated scene: its own physics, and what the correction makes of it."""

import numpy as np
import pytest

import pcfix


@pytest.fixture(scope="module")
def nadir():
    return pcfix.simulate_scene(4000, seed=11)


def test_scene(nadir):
    depth = nadir.water_level_m - nadir.true_xyz[:, 2]
    assert depth.min() < -2.0
    assert 11.0 < depth.max() <= 12.0 + 1e-9
    assert np.diff(nadir.views.start).min() >= 3
    dry = depth < -0.01
    # on land nothing refracts; what is left is half a pixel of noise in a dozen images
    assert np.abs((nadir.apparent_xyz - nadir.true_xyz)[dry]).max() < 5 * nadir.gsd_m
    deep = depth > 5.0
    ratio = ((nadir.water_level_m - nadir.apparent_xyz[:, 2]) / depth)[deep]
    assert 0.6 < ratio.min() < ratio.max() < 0.76
