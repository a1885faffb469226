"""The ensemble of an adjusted block, which a correction with its cameras reads."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.io.files import refusing
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pcfix.adjust.precision import Members

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
            **{"centres": (k, 3), "focal": (k,), "turn": (m, k, 3), "shift_m": (m, k, 3)},
            **{"lens": (m, k, p), "water": (m, 7)},
        }
        for name, shape in shapes.items():
            if values[name].shape != shape or not np.isfinite(values[name]).all():
                raise ValueError(name)
    return found, Members(labels=labels, lens_names=lens_names, **values)
