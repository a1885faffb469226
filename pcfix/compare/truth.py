"""Errors of a cloud whose truth is known row by row."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import FloatArray


class TruthErrors(NamedTuple):
    """Errors in metres."""

    mean_z_m: float
    rmse_z_m: float
    rmse_xy_m: float


def errors_against_truth(xyz: FloatArray, true_xyz: FloatArray) -> TruthErrors:
    """Return the errors of points, both arrays of shape (n, 3), metres, same frame.

    The error in plan is the root mean square length of the horizontal difference.
    """
    error = xyz - true_xyz
    return TruthErrors(
        float(error[:, 2].mean()),
        float(np.sqrt((error[:, 2] ** 2).mean())),
        float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
    )
