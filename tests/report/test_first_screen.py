"""The first screen of a page: measured or predicted accuracy, and a bias."""

from types import SimpleNamespace

import numpy as np
import pytest

from pcfix.compare.statistics import statistics_of
from pcfix.report.run import accuracy_tile, notes_of


def summary(sigma=0.05, **more):
    settings = {"sigma_level": None, "index": 1.34}
    given = {
        "uncertainty": {"sigma_z_m": {"mean": sigma}, "tvu_95_m": {"mean": 1.96 * sigma}},
        "settings": settings, "poses": None, "cameras": 2, "uncorrected": {}, "warnings": [],
        "water_unknown": 0, "water": "level 0.37 m", "water_fit": None,
    }  # fmt: skip
    return SimpleNamespace(**{**given, **more})


def compared(bias, scatter):
    """Return a comparison whose bed has such errors."""
    s = statistics_of(bias + scatter * np.array([-1.0, 1.0] * 50))
    pair = {"after": s.as_dict(), "before": None}
    return {"bed": pair, "land": None, "reference": "/far/away/lidar.laz"}


@pytest.mark.parametrize(
    ("bias", "scatter", "words"),
    [(0.0, 0.05, []), (0.04, 0.05, []), (-0.09, 0.05, ["too low by 0.090 m"])],
)
def test_bias(bias, scatter, words):
    notes = notes_of(summary(), "a datum", compared(bias, scatter))
    assert all(word in note for word, note in zip(words, notes, strict=True))


def test_tags():
    measured, predicted = (accuracy_tile(summary(), of) for of in (compared(0.01, 0.05), {}))
    assert (measured.tag, predicted.tag) == ("measured", "predicted")
    assert measured.figures[:2] == [("bias", "+0.010 m"), ("RMSE", "0.051 m")]
    assert ("bias", "not known") in predicted.figures
    assert "lidar.laz" in measured.notes[0] and "/far" not in measured.notes[0]
    nothing = accuracy_tile(summary(uncertainty=None), {})
    assert (nothing.tag, nothing.figures) == ("predicted", [("RMSE", "not known")])
    assert len(notes_of(summary(), "", {})) == 2  # no reference, no vertical datum
