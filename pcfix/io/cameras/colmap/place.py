"""Where a COLMAP model lies: ``georeference.json``, which pcfix writes beside its files.

COLMAP's own files name no CRS, and large coordinates are usual only minus an offset. The file has
``crs`` (text or null), ``offset_m`` (three numbers to add to every position) and ``written_by``.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.files import read_json

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import FloatArray

FILE = "georeference.json"
WRITER = "pcfix"


class Place(NamedTuple):
    """What is added to the positions of a model, shape (3,), metres, and the CRS they then have."""

    offset_m: FloatArray
    crs: str | None


def read_place(folder: Path) -> Place | None:
    """Return what the file beside a model says; None where there is none by pcfix.

    Raises
    ------
    InputError
        If it is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        found = read_json(path)
        if not isinstance(found, dict) or found.get("written_by") != WRITER:
            return None
        offset = np.array(found["offset_m"], np.float64)
        crs = found["crs"]
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise InputError(f"{path}: is damaged ({error}); write the model again.") from error
    if offset.shape != (3,) or not np.isfinite(offset).all() or not isinstance(crs, str | None):
        raise InputError(
            f"{path}: needs offset_m, three numbers, and crs, a text or null; write the model"
            " again."
        )
    return Place(offset, _checked(path, crs))


def _checked(path: Path, crs: str | None) -> str | None:
    return crs if crs is None or crs.upper().startswith("ENU:") else checks.crs(path, crs)


def place_text(offset_m: FloatArray, crs: str | None) -> str:
    """Return the content of the file."""
    place = {"crs": crs, "offset_m": [float(value) for value in offset_m], "written_by": WRITER}
    return json.dumps(place, indent=2) + "\n"
