"""Of a large cloud points in squares tell what all of them would, whatever its chunks are."""

import numpy as np
import pytest

from pcfix.model import WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract import patches
from pcfix.refract.batch import Batch, Survey
from pcfix.water.surface import surface_above
from tests.utils.simulated import simulated

WIDTH_M, MOST = 2.0, 5000


def in_squares(xyz, cameras, size):
    water, squares = WaterPlane(0.0), patches.Squares(WIDTH_M)
    for start in range(0, len(xyz), size):
        some = xyz[start : start + size]
        squares.add(
            Batch(some, surface_above(water, some), Survey(water, cameras, ScienceOptions()))
        )
    return squares.all().xyz


@pytest.fixture
def some(monkeypatch):
    monkeypatch.setattr(patches, "MOST_IN_SQUARES", MOST)
    xyz = np.random.default_rng(3).uniform(
        [456_000, 5_432_000, -3], [456_300, 5_432_200, -1], (40_000, 3)
    )
    return xyz, simulated(2000, seed=1).cameras


def test_squares_do_not_depend_on_chunks(some):
    xyz, cameras = some
    whole = in_squares(xyz, cameras, len(xyz))
    assert MOST / 4 < len(whole) <= MOST
    for size in (1000, 7777):
        np.testing.assert_array_equal(in_squares(xyz, cameras, size), whole)


def test_points_in_squares_have_all_their_neighbours(some):
    xyz, cameras = some
    found = in_squares(xyz, cameras, 9000)
    square_m = patches.SQUARE_PATCHES * WIDTH_M
    squares = np.unique(np.floor(found[:, :2] / square_m), axis=0)
    everyone = np.floor(xyz[:, :2] / square_m)
    inside = (everyone[:, None] == squares).all(axis=2).any(axis=1)
    assert inside.sum() == len(found)
    whole = np.unique(everyone, axis=0)
    # spread as by chance: the mean of their places within four standard errors of that of all
    error = whole.std(axis=0) / np.sqrt(len(squares))
    assert (np.abs(squares.mean(axis=0) - whole.mean(axis=0)) < 4.0 * error).all()
