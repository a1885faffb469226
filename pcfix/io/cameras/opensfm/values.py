"""Values out of JSON that may be anything; each message names file and place."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from pcfix.model import FloatArray


def load(path: Path) -> Any:
    """Return what a JSON file holds.

    Raises
    ------
    InputError
        If it cannot be read, or is cut off or no JSON at all.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: the JSON is damaged or cut off ({error}); copy it again from the project."
        ) from error


def mapping(path: Path, where: str, value: Any) -> dict[str, Any]:
    """Return a value that is a JSON object."""
    if not isinstance(value, dict):
        raise InputError(f"{path}: {where} is not an object with names but {_shown(value)}.")
    return value


def number(path: Path, where: str, value: Any) -> float:
    """Return a finite number."""
    return float(vector(path, where, [value], 1)[0])


def vector(path: Path, where: str, value: Any, count: int) -> FloatArray:
    """Return `count` finite numbers."""
    return np.asarray(rows(path, where, [value], count)[0])


def rows(path: Path, where: str, values: Collection[Any], count: int) -> FloatArray:
    """Return rows of `count` finite numbers each, shape (len(values), count)."""
    try:
        found = np.array(list(values), dtype=np.float64).reshape(len(values), -1)
    except (TypeError, ValueError, OverflowError):
        found = np.empty((len(values), 0))
    if len(values) and (found.shape[1] != count or not np.isfinite(found).all()):
        shown = next((v for v in values if not _is_row(v, count)), values)
        raise InputError(f"{path}: {where}: {_shown(shown)} is not {count} finite number(s).")
    return found.reshape(len(values), count)


def _is_row(value: Any, count: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == count
        and all(isinstance(v, int | float) and abs(v) < np.inf for v in value)
    )


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
