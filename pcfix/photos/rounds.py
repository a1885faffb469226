"""The rounds of Fig 10 of Skarlatos & Agrafiotis 2018: how far the bed moved, and when to stop.

Their rule is that a DSM differs from the one before by less than a threshold (a ground pixel). Here
the mean difference under water counts: single cells scatter by the noise of the matcher.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning
from pcfix.model import BoolArray, FloatArray

PAPER_ROUNDS = 3
"""After so many, the mapping by eq 12 is close to its fixed point, which is not the bed."""


@dataclass(frozen=True)
class Round:
    """The change in a round: DSM minus the one before, over submerged cells (all if none are).

    `within_gsd` is the share of the cells that moved by at most a ground pixel.
    """

    cloud: str
    dsm: str
    cells: int
    mean_m: float
    sd_m: float
    within_gsd: float


@dataclass(frozen=True)
class RebuildSummary:
    """The result of `pcfix.rebuild_rounds`.

    Attributes
    ----------
    done_before : int
        Rounds that an earlier call finished.
    settled : bool
        Whether the last round moved the bed by less than the threshold.
    compare : str
        The command that compares all clouds with a reference.
    compared : str or None
        The folder with its results, where a reference was given.
    """

    rounds: tuple[Round, ...]
    done_before: int
    settled: bool
    gsd_m: float
    threshold_m: float
    seconds: float
    mapping: str
    rebuild: str
    compare: str
    compared: str | None
    notes: tuple[PcfixWarning, ...]


def round_of(
    files: tuple[str, str], difference_m: FloatArray, wet: BoolArray, gsd_m: float
) -> Round:
    """Return the change in a round.

    Parameters
    ----------
    files : tuple of str
        Its cloud and its DSM.
    difference_m : array, shape (rows, columns)
        DSM minus the one before, NaN where either has no height.
    wet : array of bool, shape (rows, columns)

    Raises
    ------
    GeometryError
        ``cloud.no_overlap``.
    """
    known = np.isfinite(difference_m)
    moved = difference_m[known & wet] if (known & wet).any() else difference_m[known]
    if not len(moved):
        raise GeometryError(
            "cloud.no_overlap",
            f"{files[0]}: does not overlap the DSM of the round before. Check its CRS.",
            path=files[0],
        )
    within = float((np.abs(moved) <= gsd_m).mean())
    mean, sd = float(moved.mean()), float(moved.std())
    return Round(*files, len(moved), round(mean, 5), round(sd, 5), round(within, 5))


def paper_excess(refractive_index: float) -> float:
    """Return the share of the depth by which eq 12 ends too deep near nadir: h0 / (2 - n)."""
    return 1.0 / (refractive_index * (2.0 - refractive_index)) - 1.0
