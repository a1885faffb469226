"""What a page says first: of a bed that was measured, or predicted, and what contradicts what."""

from __future__ import annotations

from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from pcfix.compare.statistics import own_of, statistics_of
from pcfix.report.first_screen import Survey, accuracy_tile, notes_of, water_words

KNOWN = Survey("", "", "a CRS", "a datum")


def summary(sigma=0.05, **more):
    settings = {"sigma_level": None, "index": 1.34, "uncorrected": "keep"}
    given = {
        "uncertainty": {"sigma_z_m": {"mean": sigma}, "tvu_95_m": {"mean": 1.96 * sigma}},
        "settings": settings, "poses": None, "cameras": 2, "uncorrected": {}, "warnings": [],
        "water_unknown": 0, "water": "level 0.37 m", "water_fit": None,
    }  # fmt: skip
    return SimpleNamespace(**{**given, **more})


def compared(bias, scatter, count=100):
    """Return a comparison whose bed has such errors, without noise of the reference."""
    s = statistics_of(bias + scatter * np.array([-1.0, 1.0] * (count // 2)))
    own = asdict(own_of(s, "bed", 0.0, "cloud"))
    pair = {"after": asdict(s), "before": None}
    return {"own": own, "bed": pair, "land": None, "reference": "/far/away/lidar.laz"}


@pytest.mark.parametrize(
    ("scatter", "said"), [(0.05, ""), (0.07, ""), (0.1, "larger"), (0.02, "smaller")]
)
def test_a_measured_error_that_contradicts_the_predicted_one_is_said_to(scatter, said):
    notes = " ".join(notes_of(summary(), KNOWN, compared(0.0, scatter)))
    assert ("are larger than the predicted" in notes) == (said == "larger")
    assert ("are smaller than the predicted" in notes) == (said == "smaller")
    few = notes_of(summary(), KNOWN, compared(0.0, scatter, 50))
    assert few == []  # too few to say


def test_a_bias_beyond_the_scatter_is_said():
    assert notes_of(summary(0.08), KNOWN, compared(0.04, 0.05)) == []
    notes = notes_of(summary(0.1), KNOWN, compared(-0.09, 0.05))
    assert len(notes) == 1 and "too low as a whole by 0.090 m" in notes[0]


def test_measured_and_predicted_are_called_so():
    measured, predicted = (accuracy_tile(summary(), of) for of in (compared(0.01, 0.05), {}))
    assert (measured.tag, predicted.tag) == ("measured", "predicted")
    assert measured.figures[:2] == [("bias", "+0.010 m"), ("RMSE", "0.051 m")]
    assert ("bias", "not known") in predicted.figures
    assert "lidar.laz" in measured.notes[0] and "/far" not in measured.notes[0]
    nothing = accuracy_tile(summary(uncertainty=None), {})
    assert (nothing.tag, nothing.figures) == ("predicted", [("RMSE", "not known")])


def test_what_is_not_known_is_said():
    notes = notes_of(summary(), Survey(), {})
    assert [note.split(":")[0] for note in notes] == [
        "No reference", "The vertical datum is not known",
    ]  # fmt: skip
    assert "vertical datum not known" in Survey().place


def test_the_origin_of_the_water_is_said():
    fit = {"model": "level", "level_m": 0.3694, "sigma_level_m": 0.012, "tilt_percent": 0.0}
    points = {"accepted": 30, "points": 32}
    assert "as given; standard error 0.020 m (assumed)" in water_words(summary())
    fitted = water_words(summary(water_fit={**fit, **points}))
    assert fitted.startswith("level 0.369 m, fitted to 30 of 32 points; standard error 0.012 m")
    found = water_words(summary(water_fit={**fit, "model": "auto"}))
    assert "found in the cloud" in found
    stated = {**summary().settings, "sigma_level": 0.05}
    assert "0.050 m (as stated)" in water_words(summary(water_fit=fit, settings=stated))
