"""The file of a depth regression: every digit comes back, and what is wrong has a sentence."""

import json
import re

import numpy as np
import pytest

from pcfix.errors import InputError, SettingError
from pcfix.io.regressions import read_regression, write_regression
from pcfix.refract.regression import fit_depths


@pytest.fixture
def line():
    rng = np.random.default_rng(4)
    x = rng.uniform(0.2, 5.0, 20)
    return fit_depths(x, 0.05 + 1.4 * x + rng.normal(0, 0.1, 20))


def test_every_digit_comes_back(tmp_path, line):
    write_regression(tmp_path / "line.json", line, overwrite=False)
    assert read_regression(tmp_path / "line.json") == line
    with pytest.raises(SettingError, match="the output exists"):
        write_regression(tmp_path / "line.json", line, overwrite=False)


def test_covariance_is_that_of_least_squares():
    rng = np.random.default_rng(6)
    x = rng.uniform(0.2, 5.0, 20)
    y = 0.05 + 1.4 * x + rng.normal(0, 0.1, 20)
    found, (_, covariance) = fit_depths(x, y), np.polyfit(x, y, 1, cov=True)
    assert found.covariance_m == pytest.approx(covariance[0, 1])
    assert [found.slope_se**2, found.intercept_se_m**2] == pytest.approx(np.diag(covariance))


def test_a_slope_that_refraction_cannot_explain_is_said_not_refused(tmp_path, line):
    write_regression(tmp_path / "line.json", line, overwrite=False)
    content = json.loads((tmp_path / "line.json").read_text())
    # that of Hsu & Wang, who count heights from an origin at 190 mm
    content.update(slope=0.9895, intercept=-0.0083428, r2=0.79, count=16)
    (tmp_path / "line.json").write_text(json.dumps(content))
    (note,) = read_regression(tmp_path / "line.json").notes
    assert note.startswith("the regression's slope 0.990 is not what refraction does")


BAD = {
    "no JSON": ("slope = 1.4", "is not JSON (Expecting value"),
    "a list": ("[1]", "is not a depth regression; give what --save-regression wrote."),
    "another file": ('{"version": 1}', "is not a depth regression"),
    "a version": ({"version": 2}, "is of version 2, and pcfix"),
    "a unit": ({"unit": "mm"}, "is in the unit 'mm', and clouds are in m"),
    "no slope": ({"slope": ...}, "has no slope; give what"),
    "no error": ({"cv_rmse": ...}, "has no cv_rmse; give what"),
    "a word": ({"slope": "1.4"}, "slope '1.4' must be a finite number"),
    "true": ({"rmse": True}, "rmse True must be a finite number"),
    "nan": ({"intercept": float("nan")}, "intercept nan must be a finite number"),
    "flat": ({"slope": 0}, "slope 0 must be above 0: depths grow with those of the cloud"),
    "falling": ({"slope": -1.4}, "slope -1.4 must be above 0"),
    "an error": ({"slope_se": -0.1}, "slope_se -0.1 must be at least 0"),
    "few": ({"count": 2}, "count 2 must be a whole number of at least 3"),
    "no range": ({"deepest": 0.0}, "deepest 0.0 must be above shallowest"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_has_a_sentence(tmp_path, line, case):
    change, sentence = BAD[case]
    path = tmp_path / "line.json"
    write_regression(path, line, overwrite=False)
    if isinstance(change, str):
        path.write_text(change)
    else:
        content = {**json.loads(path.read_text()), **change}
        path.write_text(json.dumps({k: v for k, v in content.items() if v is not ...}))
    with pytest.raises(InputError, match=f"line.json: {re.escape(sentence)}"):
        read_regression(path)
    with pytest.raises(InputError, match="there is no such file"):
        read_regression(tmp_path / "none.json")
