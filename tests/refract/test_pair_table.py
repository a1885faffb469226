"""Stereo pairs undone by polynomials: as each point by itself."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from pcfix.kernels import threads
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Learned, Survey
from pcfix.refract.matcher import matcher_of
from pcfix.refract.methods import correct
from pcfix.refract.pair_table import LEAST_POINTS
from pcfix.water.surface import is_submerged, surface_above
from tests.utils.nightly import mostly_nightly
from tests.utils.simulated import simulated

AREA_M = (60.0, 40.0)
BLOCKS = {"nadir": {}, "half oblique": {"obliques_deg": 30.0}}


@lru_cache(maxsize=2)
def batch(block):
    how = BLOCKS[block] | {"cloud": "pairs", "area_m": AREA_M}
    scene = simulated(12_000, seed=1, lidar_per_m2=0.0, **how)
    settings = ScienceOptions(
        method="consistent", matcher="pairs", camera_set="mvs", dimensions="none"
    )
    learned = Learned(matcher=matcher_of(scene.cameras, scene.apparent_xyz[::3]))
    survey = Survey(scene.water, scene.cameras, settings, learned=learned)
    whole = Batch(scene.apparent_xyz, surface_above(scene.water, scene.apparent_xyz), survey)
    rows = np.flatnonzero(is_submerged(whole.xyz[:, 2], whole.surface))
    return whole.take(rows), scene.gsd_m


def alone(part):
    settings = replace(part.survey.settings, exact=True)
    return correct(replace(part, survey=replace(part.survey, settings=settings)))


@pytest.mark.parametrize("block", mostly_nightly(BLOCKS, "half oblique"))
def test_pairs_of_neighbours_are_as_alone(block):
    part, gsd_m = batch(block)
    quick, each = correct(part), alone(part)
    apart_px = np.linalg.norm(quick.shift_m - each.shift_m, axis=1) / gsd_m
    # twice what polynomials may lack at the corners of a cell, as depths grow by 1.3 to 2
    assert apart_px.max() < 0.05
    np.testing.assert_array_equal(quick.outcome, each.outcome)
    np.testing.assert_array_equal(quick.ray_count, each.ray_count)
    assert (quick.shift_m != each.shift_m).any(axis=1).mean() > 0.3  # polynomials were used


def test_the_number_of_threads_changes_nothing():
    part, _ = batch("half oblique")
    with threads(1):
        one = correct(part)
    with threads(3):
        three = correct(part)
    np.testing.assert_array_equal(one.shift_m, three.shift_m)


def test_few_points_are_asked_one_by_one():
    part, _ = batch("half oblique")
    few = part.take(np.arange(LEAST_POINTS - 1))
    np.testing.assert_array_equal(correct(few).shift_m, alone(few).shift_m)
