"""A single strip: what its lens had taken up goes back, and what stays unknown is said."""

from __future__ import annotations

import numpy as np
import pytest

import pcfix
from pcfix.kernels import threads
from tests.utils.block_kinds import write_kind


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    """An adjusted strip whose unaware adjustment had a full lens, and its true cameras."""
    folder = tmp_path_factory.mktemp("strip")
    write_kind(folder, "single strip", 4, points=700, cloud=10)
    with threads(1):  # a second thread takes longer to wake than the block
        found = pcfix.adjust_cameras(folder / "model", water=0.0, gnss=folder / "gnss.csv")
    return found, pcfix.read_cameras(folder / "true")


def test_a_principal_point_that_was_bent_goes_back(strip):
    """It is hardly determined, but held where it was it had bent the bed by 20 ground pixels."""
    found, true = strip
    before, after, truth = (c.lenses[0] for c in (found.block.cameras, found.cameras, true))
    assert abs(before.principal_y - truth.principal_y) > 20.0
    # standard errors: four of a normal distribution, which chance exceeds once in 16,000
    for name in ("principal_x", "principal_y", "focal"):
        sigma = found.precision.sigma_of({"focal": "f"}.get(name, f"c{name[-1]}"))
        assert abs(getattr(after, name) - getattr(truth, name)) < 4.0 * sigma
    assert not any("does not determine" in note for note in found.notes)


def test_centres_are_true_within_their_standard_errors(strip):
    found, true = strip
    off = (found.cameras.centres - true.centres) / found.precision.centre_sigma_m
    # of 42 normalised errors, neighbours alike; with the principal point held it is 2.4
    assert np.sqrt((off**2).mean()) < 1.5


def test_the_tilt_across_the_strip_is_said_to_be_unknown(strip):
    found, _ = strip
    note = next(note for note in found.notes if note.startswith("the heights of the bed"))
    assert "positions lie in a line, so the tilt across it is known to" in note
