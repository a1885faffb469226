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


def test_positions_are_not_said_to_lie_off_for_a_lens_that_was_held(strip):
    """They lie right; with the principal point held they seemed 2 m below the centres."""
    found, true = strip
    assert not any("the projection centres" in note for note in found.notes)
    off = (found.cameras.centres - true.centres) / found.precision.centre_sigma_m
    # rms of 42 normalised errors: 1 with a standard deviation of a tenth, more as neighbours agree
    assert np.sqrt((off**2).mean()) < 1.3


def test_the_tilt_across_the_strip_is_said_to_be_unknown(strip):
    found, _ = strip
    note = next(note for note in found.notes if note.startswith("the heights of the bed"))
    assert "positions lie in a line, so the tilt across it is known to" in note
