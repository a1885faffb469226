"""Clouds corrected with other cameras than a dense matcher made them with."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.model import Outcome, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Learned, OriginalModel
from pcfix.refract.fusion import Bed
from pcfix.refract.methods import correct, on_land, shift_of_land
from pcfix.water.surface import surface_above
from tests.refract.test_depth_maps import (
    CAMERAS,
    MIXED,
    N_WATER,
    NADIR,
    PARTNERS,
    TOLERANCE,
    listed,
)
from tests.refract.test_depth_maps import FUSED as OTHERS
from tests.refract.test_depth_maps import matcher as plain_matcher
from tests.utils.batches import batch_of
from tests.utils.depth_map_twin import LENS, fused_slowly

WATER = WaterPlane(0.3, 0.004, -0.003)


def absorbed():
    """Return cameras as an adjustment without water may leave them.

    The block turned and stretched, 0.4 % off in focal length, and 5 cm and 0.01 degrees (1 px) off
    in each image.
    """
    rng = np.random.default_rng(8)
    turns = Rotation.from_rotvec(np.radians(rng.normal(0.0, 0.01, (8, 3)))).as_matrix()
    block = Rotation.from_rotvec([0.006, -0.004, 0.01]).as_matrix()
    lens = replace(LENS, focal=1.004 * LENS.focal, principal_x=LENS.principal_x + 6.0)
    centres = 1.004 * CAMERAS.centres @ block.T + [0.3, -0.2, 0.1]
    return replace(
        CAMERAS,
        centres=centres + rng.normal(0.0, 0.05, (8, 3)),
        rotations=turns @ CAMERAS.rotations @ block.T,
        lenses=(lens,) * 8,
    )


def matcher(cameras, averages=False):
    averaged = OTHERS[:, :8].copy() if averages else None
    focal = np.array([lens.focal for lens in cameras.lenses])
    return plain_matcher(cameras, averaged=averaged, fused=OTHERS)._replace(focal_px=focal)


def run(xyz, views, learned, original_model, kind="depth-maps"):
    settings = ScienceOptions(method="consistent", index=N_WATER, dimensions="none", matcher=kind)
    given = surface_above(WATER, xyz), WATER, CAMERAS, settings, views
    return correct(batch_of(xyz, *given, learned=learned, original_model=original_model))


@pytest.mark.parametrize(
    ("maps", "metric"), [((5,), "angles"), (NADIR, "angles"), (MIXED, "angles"), (MIXED, "pixels")]
)
def test_maps_of_original_model(maps, metric):
    """Fused by a slow twin that traces light in one geometry and matches in the other."""
    original = absorbed()
    weights = 1.0 / ((original.centres[list(maps)] - [3.0, 4.0, -4.0]) ** 2).sum(axis=1)
    planes = [(WATER.a, WATER.b, WATER.c)] * 8
    apparent, true = fused_slowly(
        np.array([3.0, 4.0, -4.3]), maps, weights, CAMERAS, PARTNERS, planes, (-6.0, 0.0, 0.0),
        N_WATER, TOLERANCE, metric, original,
    )  # fmt: skip
    views = replace(listed([maps]), weight=(weights / weights.sum()).astype(np.float32))
    learned = Learned(matcher=matcher(original))
    # the place it is counted from does not matter
    for start in (apparent, apparent + np.array([0.3, -0.2, 0.4])):
        result = run(start[None], views, learned, OriginalModel(apparent[None], original))
        assert result.outcome.tolist() == [Outcome.CORRECTED]
        # ways are balanced as shares of the distances, and angles stand for pixels, so that other
        # pairs are the best ones: as of one set of cameras, with residuals of some pixels
        assert start + result.shift_m[0] == pytest.approx(true, abs=0.01)
    wrong = run(apparent[None], views, learned, None)
    assert np.abs(apparent + wrong.shift_m[0] - true).max() > 0.1


SCALE, SHIFT = 1.03, np.array([5.0, -3.0, 2.0])


@pytest.mark.parametrize("kind", ["list", "no list", "pairs"])
def test_transformed_block(kind):
    """Turned and stretched as a whole, a matcher finds the same places in the images.

    Not turned where medians of x, y and z are taken.
    """
    turn = [0.0] * 3 if kind == "pairs" else [0.02, -0.015, 0.3]
    turned = Rotation.from_rotvec(turn).as_matrix()

    def elsewhere(xyz):
        return SCALE * xyz @ turned.T + SHIFT

    original = replace(
        CAMERAS, centres=elsewhere(CAMERAS.centres), rotations=CAMERAS.rotations @ turned.T
    )
    rng = np.random.default_rng(9)
    xyz = np.column_stack([rng.uniform(-12, 12, (60, 2)), rng.uniform(-6, 0.0, 60)])
    views = listed([MIXED] * 60) if kind == "list" else None
    matching = "pairs" if kind == "pairs" else "depth-maps"
    bed = Bed(np.full((1, 1), -5.0), -20.0, -20.0, 50.0)
    one = run(xyz, views, Learned(matcher=matcher(CAMERAS, True), bed=bed), None, matching)
    other = run(
        xyz, views, Learned(matcher=matcher(original, True), bed=bed),
        OriginalModel(elsewhere(xyz), original), matching,
    )  # fmt: skip
    assert (one.outcome == Outcome.CORRECTED).all()
    assert np.array_equal(one.outcome, other.outcome)
    assert np.abs(one.shift_m[:, 2]).max() > 1.0
    # rounds end within 2 mm, mended in a straight line; where other weights put the vertical apart
    assert other.shift_m == pytest.approx(one.shift_m, abs=2e-3)


@pytest.mark.parametrize("with_list", [True, False], ids=["list", "no list"])
def test_land(with_list):
    """A twin fuses land, that is, a bed in water that does not refract."""
    original, maps = absorbed(), MIXED if with_list else (0,)
    weights = 1.0 / ((original.centres[list(maps)] - [3.0, 4.0, 2.0]) ** 2).sum(axis=1)
    apparent, true = fused_slowly(
        np.array([3.0, 4.0, 2.2]), maps, weights, CAMERAS, PARTNERS, [(50.0, 0.0, 0.0)] * 8,
        (2.0, 0.0, 0.0), 1.0, TOLERANCE, "angles", original,
    )  # fmt: skip
    settings = ScienceOptions(method="consistent", index=N_WATER)
    alone = matcher(original)._replace(fused=np.full((8, 12), -1))
    views = listed([maps]) if with_list else None
    batch = batch_of(
        apparent[None], surface_above(WATER, apparent[None]), WATER, CAMERAS, settings, views,
        learned=Learned(matcher=alone), original_model=OriginalModel(apparent[None], original),
    )  # fmt: skip
    shift = shift_of_land(batch)
    if with_list:
        assert apparent + shift[0] == pytest.approx(true, abs=0.01)
    else:  # each image alone may have made it
        assert np.isfinite(shift).all() and np.abs(shift).max() > 0.1
    tracks = replace(listed([MIXED]), kind="tracks")
    assert not shift_of_land(replace(batch, views=tracks)).any()
    # a formula for the bed leaves land to how the cloud was made
    formula = replace(batch.survey, settings=replace(settings, method="snell", camera_set="all"))
    assert not shift_of_land(replace(batch, survey=formula, views=None)).any()
    land = formula.learned._replace(land=on_land(batch.survey))
    told = replace(batch, survey=replace(formula, learned=land))
    assert np.array_equal(shift_of_land(told), shift)
