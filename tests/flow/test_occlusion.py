"""The surface of a whole cloud that hides its points from cameras."""

import numpy as np
import pytest

from pcfix import Cameras
from pcfix.options.correct import ScienceOptions
from pcfix.refract.occlusion import OccluderBuilder, wants_occlusion
from tests.utils.clouds import occluder_of


def cameras(*tilts_deg):
    """Return cameras that look down, each tilted about its x axis."""
    turned = []
    for tilt in np.radians(tilts_deg):
        s, c = np.sin(tilt), np.cos(tilt)
        turned.append(np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ np.diag([1.0, -1.0, -1.0]))
    k = len(tilts_deg)
    return Cameras(tuple(map(str, range(k))), np.zeros((k, 3)), np.array(turned))


@pytest.mark.parametrize(
    ("tilts_deg", "wanted"),
    [((0.0, 3.0, -14.0), False), ((0.0, 16.0), True), ((0.0, -30.0), True), ((90.0,), True)],
)
def test_wanted(tilts_deg, wanted):
    """With auto if there are oblique images; cameras without angles count as nadir."""
    assert wants_occlusion(cameras(*tilts_deg), ScienceOptions()) is wanted
    no_angles = Cameras(("a",), np.zeros((1, 3)))
    assert wants_occlusion(no_angles, ScienceOptions()) is False
    for block in (cameras(*tilts_deg), no_angles):
        assert wants_occlusion(block, ScienceOptions(occlusion="on")) is True
        assert wants_occlusion(block, ScienceOptions(occlusion="off")) is False


def test_chunks():
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, [60.0, 40.0], (50_000, 2))
    z = 3.0 * np.sin(xy[:, 0] / 5.0) + rng.normal(0.0, 0.05, len(xy))
    xyz = np.column_stack([xy + np.array([512_345.678, 4_987_654.321]), z])
    whole = occluder_of(xyz)
    shuffled = xyz[np.random.default_rng(2).permutation(len(xyz))]
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    unknown = np.full(2, np.nan), np.full(2, np.nan)
    wrong = low + 5.0, low + 6.0
    for corners in ((low, high), unknown, wrong):
        builder = OccluderBuilder(*corners, len(xyz))
        for part in np.array_split(shuffled, 9):
            builder.add(part, np.ones(len(part), np.uint8))
        found = builder.build()
        assert found[1:5] == whole[1:5]
        for name in ("height", "margin", "block_top"):
            np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
