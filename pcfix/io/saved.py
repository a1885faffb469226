"""Files that one command leaves for another: the line of a regression, the ensemble of a block.

The line of a depth regression corrects other clouds too. JSON, metres: `format`, `version` and
`unit`; `intercept`, `slope`, their standard errors `intercept_se`, `slope_se` and their
`covariance`; `count` of the check depths, `shallowest` and `deepest` of their apparent depths;
`r2`, `rmse`, `cv_rmse` (cross-validated; null if unknown); `source`, where the line comes from, in
words; `pcfix`, the version that wrote it.
"""

from __future__ import annotations

import json
import math
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.files import check_input, read_json, refusing, write_text
from pcfix.options.declare import File
from pcfix.refract.regression import LEAST_COUNT, DepthRegression, notes_of
from pcfix.version import __version__

if TYPE_CHECKING:
    from pcfix.adjust.precision import Members

HEADER = {"format": "pcfix depth regression", "version": 1, "unit": "m"}
_FIELDS = {
    "intercept": "intercept_m", "slope": "slope", "intercept_se": "intercept_se_m",
    "slope_se": "slope_se", "covariance": "covariance_m", "count": "count",
    "shallowest": "shallowest_m", "deepest": "deepest_m", "r2": "r2", "rmse": "rmse_m",
    "cv_rmse": "cv_rmse_m",
}  # fmt: skip
"""Names in the file, and those of `DepthRegression`."""
_REMEDY = "Give the file that --save-regression wrote."
_NOT_NEGATIVE = ("intercept_se", "slope_se", "shallowest", "rmse", "cv_rmse")


def write_regression(path: File, line: DepthRegression, *, overwrite: bool) -> None:
    """Write a line."""
    values = {name: getattr(line, field) for name, field in _FIELDS.items()}
    content = {**HEADER, **values, "source": line.source, "pcfix": __version__}
    write_text(path, json.dumps(content, indent=2) + "\n", overwrite=overwrite)


def read_regression(path: File) -> DepthRegression:
    """Read a line that `write_regression` wrote, with every digit."""
    found = check_input(path)
    with refusing(found, "regression.not_one", f"is not a depth regression ({{}}). {_REMEDY}"):
        content = read_json(found)
        if not isinstance(content, dict) or content.get("format") != HEADER["format"]:
            raise ValueError(f"its format is not {HEADER['format']}")
    for name in ("version", "unit"):
        if content.get(name) != HEADER[name]:
            sentence = f"its {name} is {content.get(name)!r}, not {HEADER[name]!r}. Fit it again."
            raise bad_file(found, "regression.version", sentence, value=content.get(name))

    def check(name: str, rule: str, holds: bool) -> None:
        if not holds:
            value = content.get(name)
            sentence = f"{name} is {value!r} and must be {rule}. {_REMEDY}"
            raise bad_file(found, "regression.value", sentence, name=name, value=value)

    for name in _FIELDS:
        value: Any = content.get(name)
        if name != "cv_rmse" or value is not None or name not in content:
            check(name, "a finite number", type(value) in (int, float) and math.isfinite(value))
            check(name, "at least 0", name not in _NOT_NEGATIVE or value >= 0.0)
    count = content["count"]
    whole = count >= LEAST_COUNT and count == int(count)
    check("slope", "above 0", content["slope"] > 0.0)
    check("count", f"a whole number of at least {LEAST_COUNT}", whole)
    check("deepest", "above shallowest", content["deepest"] > content["shallowest"])
    values = {field: content[name] for name, field in _FIELDS.items()}
    source = str(content.get("source", ""))
    return DepthRegression(**values, source=source, notes=notes_of(count, content["slope"]))


ENSEMBLE = "ensemble.npz"
"""The file beside an adjusted model with the members of its ensemble."""


def write_members(folder: Path, members: Members) -> None:
    """Write members into a folder, as the arrays of `Members`, for ``numpy.load``."""
    np.savez_compressed(folder / ENSEMBLE, **vars(members))


def find_members(cameras: File) -> tuple[Path, Members] | None:
    """Return the members beside a camera file, and their file; None if there is none.

    It is in the folder of the adjustment: a model's own folder, or one of the two above it.
    """
    path = Path(cameras).resolve()
    places = (at / ENSEMBLE for at in (path, *path.parents[:2]))
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        return None
    from pcfix.adjust.precision import Members  # not quick to load

    sentence = "is not an ensemble of an adjustment. Adjust again, or remove the file."
    with refusing(found, "ensemble.damaged", sentence):
        with np.load(found) as arrays:
            values = {one.name: np.asarray(arrays[one.name]) for one in fields(Members)}
        labels, lens_names = (tuple(values.pop(n).tolist()) for n in ("labels", "lens_names"))
        m, k, p = len(values["turn"]), len(labels), len(lens_names)
        shapes = {
            **{"focal": (k,), "turn": (m, k, 3), "shift_m": (m, k, 3)},
            **{"lens": (m, k, p), "water": (m, 7)},
        }
        for name, shape in shapes.items():
            if values[name].shape != shape or not np.isfinite(values[name]).all():
                raise ValueError(name)
    return found, Members(labels=labels, lens_names=lens_names, **values)
