"""The line of a depth regression in a file, so that another cloud can be corrected with it.

JSON, metres: `format`, `version` and `unit`; `intercept`, `slope`, their standard errors
`intercept_se`, `slope_se` and their `covariance`; `count` of the check depths, `shallowest` and
`deepest` of their apparent depths; `r2`, `rmse`, `cv_rmse` (cross-validated; null where that
cannot be told); `source`, where the line came from, in words; `pcfix`, the version that wrote it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from pcfix.errors import InputError
from pcfix.io.files import check_input, read_json, write_text
from pcfix.options.declare import File
from pcfix.refract.regression import LEAST_COUNT, DepthRegression, notes_of
from pcfix.version import __version__

FORMAT, VERSION, UNIT = "pcfix depth regression", 1, "m"
_FIELDS = {
    "intercept": "intercept_m", "slope": "slope", "intercept_se": "intercept_se_m",
    "slope_se": "slope_se", "covariance": "covariance_m", "count": "count",
    "shallowest": "shallowest_m", "deepest": "deepest_m", "r2": "r2", "rmse": "rmse_m",
    "cv_rmse": "cv_rmse_m",
}  # fmt: skip
"""Names in the file, and those of `DepthRegression`."""
_NOT_NEGATIVE = ("intercept_se", "slope_se", "shallowest", "rmse", "cv_rmse")


def write_regression(path: File, line: DepthRegression, *, overwrite: bool) -> None:
    """Write a line, whole or not at all.

    Raises
    ------
    PcfixError
        If the file exists without `overwrite`, or cannot be written.
    """
    content = {
        "format": FORMAT,
        "version": VERSION,
        "unit": UNIT,
        **{name: getattr(line, field) for name, field in _FIELDS.items()},
        "source": line.source,
        "pcfix": __version__,
    }
    write_text(path, json.dumps(content, indent=2) + "\n", overwrite=overwrite)


def read_regression(path: File) -> DepthRegression:
    """Read a line that `write_regression` wrote, with every digit.

    Raises
    ------
    InputError
        If the file is missing, no such JSON, of another version or unit, or a number is missing
        or none that such a line can have.
    """
    found = check_input(path)
    content = _content(found)
    values = {field: _number(found, content, name) for name, field in _FIELDS.items()}
    line = DepthRegression(**values, source=str(content.get("source", "")))
    if not line.slope > 0.0:
        raise _wrong(found, "slope", line.slope, "above 0: depths grow with those of the cloud")
    if line.count < LEAST_COUNT or line.count != int(line.count):
        raise _wrong(found, "count", line.count, f"a whole number of at least {LEAST_COUNT}")
    if line.deepest_m <= line.shallowest_m:
        raise _wrong(found, "deepest", line.deepest_m, f"above shallowest, {line.shallowest_m:g}")
    return DepthRegression(**{**vars(line), "notes": notes_of(line.count, line.slope)})


def _content(path: Path) -> dict[str, Any]:
    """Return the JSON of a file that says it is a line, in the version and unit of today."""
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: is not JSON ({error}); give what --save-regression wrote."
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path}: is not a depth regression; give what --save-regression wrote.")
    if content.get("version") != VERSION:
        raise InputError(
            f"{path}: is of version {content.get('version')}, and pcfix {__version__} reads version"
            f" {VERSION}; fit the line again with --check-depths and --save-regression."
        )
    if content.get("unit") != UNIT:
        raise InputError(
            f"{path}: is in the unit '{content.get('unit')}', and clouds are in {UNIT}; fit the"
            " line again to depths in metres."
        )
    return content


def _number(path: Path, content: dict[str, Any], name: str) -> Any:
    """Return a finite number of the file; cv_rmse may be null."""
    if name not in content:
        raise InputError(f"{path}: has no {name}; give what --save-regression wrote.")
    value = content[name]
    if value is None and name == "cv_rmse":
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _wrong(path, name, value, "a finite number")
    if value < 0.0 and name in _NOT_NEGATIVE:
        raise _wrong(path, name, value, "at least 0")
    return value


def _wrong(path: Path, name: str, value: Any, rule: str) -> InputError:
    return InputError(
        f"{path}: {name} {value!r} must be {rule}; give what --save-regression wrote."
    )
