"""What a plan predicts is what the correction of such a block says, and what its errors are."""

import numpy as np
import pytest

import pcfix
from pcfix.errors import SettingError

DEPTH_M = 4.0
FLIGHT = {"height": 50.0, "overlap": 0.75, "area": (60.0, 40.0)}
SIGMAS = {"sigma_waves": 0.5, "sigma_level": 0.01, "sigma_centre": 0.01}


@pytest.fixture(scope="module")
def plan():
    return pcfix.plan_flight(**FLIGHT, depth=(1.0, DEPTH_M), **SIGMAS)


def block(noise_px):
    """Return a cloud of a block that is flown as planned, with other points."""
    return pcfix.simulate_scene(
        3000, flying_height_m=50.0, forward_overlap=0.75, area_m=(60.0, 40.0), water=0.0,
        bed="flat", greatest_depth_m=DEPTH_M, image_noise=noise_px,
    )  # fmt: skip


def test_parts(plan):
    for one in plan.depths:
        total = np.sqrt(sum(part**2 for part in one.parts_m.values()))
        assert one.sigma_m == pytest.approx(total, rel=1e-6)
    shallow, deep = plan.depths
    assert deep.parts_m["index"] == pytest.approx(4.0 * shallow.parts_m["index"], rel=0.05)
    assert deep.parts_m["waves"] > 3.0 * shallow.parts_m["waves"]
    assert plan.gsd_m == pytest.approx(50.0 / 8.8 * 13.2 / 5472)


@pytest.mark.parametrize(("noise_px", "most"), [(0.0, 1.01), (0.5, 1.1)])
def test_correction_agrees(plan, noise_px, most):
    """Of other points; a noisy cloud itself tells of up to 10 % more."""
    scene = block(noise_px)
    found = pcfix.correct_points(
        scene.apparent_xyz, scene.cameras, 0.0, views=scene.views, **SIGMAS
    )
    predicted = np.sqrt(np.mean(found.sigma_z_m[found.corrected] ** 2))
    assert 0.99 < predicted / plan.depths[-1].sigma_m < most
    # of 3,000 points with true level, index, poses: 1.3 % for one sigma
    off = (found.xyz - scene.true_xyz)[found.corrected, 2]
    expected = plan.depths[-1].parts_m["image"] if noise_px else 0.0
    assert np.sqrt(np.mean(off**2)) == pytest.approx(expected, rel=0.05, abs=1e-4)


@pytest.mark.parametrize(
    ("given", "code"),
    [
        ({"lens": "8.8,13.2"}, None),
        ({"depth": "0"}, None),
        ({"sidelap": 0.0, "overlap": 0.3}, "plan.overlap"),
        ({"height": 3.0, "depth": (8.0,)}, "scene.too_low"),
    ],
)
def test_refused(given, code):
    with pytest.raises(SettingError) as caught:
        pcfix.plan_flight(**given)
    assert code in (None, caught.value.code)
