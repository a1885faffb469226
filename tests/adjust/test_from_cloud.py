"""What an adjustment did that knew of no water is undone from its points alone."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pcfix.adjust.block import NO_CONTROL, block_of, ties_of_cloud
from pcfix.adjust.from_cloud import adjust_cloud
from pcfix.adjust.from_ties import adjust_ties
from pcfix.adjust.parameters import Unknowns
from pcfix.model import GnssPositions
from tests.utils.tie_points import simulate_tie_points
from tests.utils.unaware_blocks import unaware

SMALL = {"area_m": (50, 40), "greatest_depth_m": 5, "position_noise_m": 0.5,
         "attitude_noise_deg": 0.3}  # fmt: skip

HOME_M = 1e-6  # exact data: Newton's steps end below 1e-7 m


@cache
def block(points=150, exact=True, **settings):
    return unaware(simulate_tie_points(points, **(SMALL | settings)), exact=exact)


def cloud_block(data, *, gnss=True, control=NO_CONTROL, exact=True):
    """Return the apparent points as the only thing that is known of the images."""
    scene, old = data.scene, data.cameras
    ties = ties_of_cloud(data.ties.xyz, data.ties.views, old)
    whole = block_of(old, ties, scene.water, scene.refractive_index, control=control)
    if gnss:
        place = scene.true_cameras.centres if exact else scene.cameras.gnss.xyz
        whole = replace(whole, gnss=GnssPositions(place, scene.cameras.gnss.sigma_m, None))
    return whole, old, np.vstack([ties.xyz, control.xyz])


def centre_error_m(data, cameras):
    return np.abs(cameras.centres - data.scene.true_cameras.centres).max()


@pytest.mark.parametrize(
    "settings",
    [{}, {"tilt_percent": 2.0}, {"obliques_deg": 30, "oblique_directions": 2}],
    ids=["nadir", "tilted water", "obliques"],
)
def test_comes_home(settings):
    data = block(**settings)
    assert centre_error_m(data, data.cameras) > 0.1
    found = adjust_cloud(*cloud_block(data), Unknowns())
    assert centre_error_m(data, found.cameras) < HOME_M
    # px; a micrometre of 50 m is that of 3648 px in the focal length
    assert abs(found.cameras.lenses[0].focal - data.scene.true_cameras.lenses[0].focal) < 1e-4
    assert np.abs(found.xyz - data.scene.truth).max() < 10 * HOME_M  # seen from 50 m apart
    assert found.source == "cloud"


def test_control_points():
    data = block()
    control = replace(
        data.scene.control, xyz=data.scene.control_truth, image_xy=data.scene.control_exact_xy
    )
    found = adjust_cloud(*cloud_block(data, gnss=False, control=control), Unknowns())
    assert centre_error_m(data, found.cameras) < 10 * HOME_M  # four points hold six strips
    assert {row.role for row in found.control} == {"control", "check"}
    for row in found.control:
        assert max(abs(row.dx_m), abs(row.dy_m), abs(row.dz_m)) < 10 * HOME_M
        assert row.rms_px < 1e-3


def test_noise():
    """As the old columns are nearly those of light through the water, so are the estimates."""
    data = block(400, exact=False)
    scene = data.scene
    mended = adjust_cloud(*cloud_block(data, exact=False), Unknowns())
    whole = block_of(scene.cameras, scene.ties, scene.water, scene.refractive_index)
    aware = adjust_ties(replace(whole, gnss=scene.cameras.gnss), Unknowns(lens=("f",)))
    sigma_m = aware.precision.centre_sigma_m
    away = np.abs(mended.cameras.centres - scene.true_cameras.centres)
    distance = np.abs(mended.cameras.centres - aware.cameras.centres)
    # 1.4 and 0.6 of the standard errors of tie points, which are 16 mm
    assert np.sqrt(np.mean((away / sigma_m) ** 2)) < 2.0
    assert np.sqrt(np.mean((distance / sigma_m) ** 2)) < 1.0
