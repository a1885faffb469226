"""The file beside an adjusted model that has the members of its joint covariance."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np

from pcfix.errors import InputError
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pcfix.adjust.members import Members

FILE = "ensemble.npz"


def write_members(folder: Path, members: Members) -> None:
    """Write members into a folder, as the arrays of `Members`, for ``numpy.load``."""
    np.savez_compressed(
        folder / FILE, **{one.name: getattr(members, one.name) for one in fields(members)}
    )


def find_members(cameras: File) -> tuple[Path, Members] | None:
    """Return the members beside a camera file and where they stand; None where there are none.

    They stand in the folder of the adjustment: a model's own folder, or one of the two above it.

    Raises
    ------
    InputError
        If the file is none of an adjustment.
    """
    path = Path(cameras).resolve()
    found = next((at / FILE for at in (path, *path.parents[:2]) if (at / FILE).is_file()), None)
    if found is None:
        return None
    from pcfix.adjust.members import Members  # not quick to load

    try:
        with np.load(found) as arrays:
            values = {one.name: arrays[one.name] for one in fields(Members)}
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise InputError(
            f"{found}: is no ensemble of an adjustment; adjust anew, or take the file away."
        ) from error
    for name in ("labels", "lens_names"):
        values[name] = tuple(values[name].tolist())
    return found, Members(**values)
