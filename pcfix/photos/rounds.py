"""The rounds of Fig 10 of Skarlatos & Agrafiotis 2018: what each changed, and when to stop.

Their rule is that the differences of a DSM from the one before are "below a certain threshold
(i.e., ground pixel size)". Here it is the mean difference under water that counts: single cells
differ by what the matcher scatters, however often it is asked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import BoolArray, FloatArray

PAPER_ROUNDS = 3
"""After so many the mapping by eq 12 has come near to where it goes, not to the bed."""


@dataclass(frozen=True)
class Round:
    """What a round changed.

    Attributes
    ----------
    cloud, dsm : str
        Its files.
    cells : int
        Under water, or all where none are, with a height before and after.
    mean_m, sd_m : float
        Of the DSM minus that before.
    within_gsd : float
        Share of the cells that moved by no more than a ground pixel.
    """

    cloud: str
    dsm: str
    cells: int
    mean_m: float
    sd_m: float
    within_gsd: float


@dataclass(frozen=True)
class RebuildSummary:
    """What `pcfix.rebuild_rounds` did.

    Attributes
    ----------
    rounds : tuple of Round
    done_before : int
        Rounds that an earlier call had finished.
    settled : bool
        Whether the last one moved the bed by less than asked for.
    gsd_m, threshold_m, seconds : float
    mapping, rebuild : str
    compare : str
        The command that compares all clouds with a reference.
    compared : str or None
        The folder with what it gave, where a reference was named.
    notes : tuple of str
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
    notes: tuple[str, ...]


def round_of(
    files: tuple[str, str], difference_m: FloatArray, wet: BoolArray, gsd_m: float
) -> Round:
    """Return what a round changed.

    Parameters
    ----------
    files : tuple of str
        Its cloud and its DSM.
    difference_m : array, shape (rows, columns)
        The DSM minus that before, NaN where either has no height.
    wet : array of bool, shape (rows, columns)
    gsd_m : float

    Raises
    ------
    GeometryError
        If no cell has both heights.
    """
    known = np.isfinite(difference_m)
    moved = difference_m[known & wet] if (known & wet).any() else difference_m[known]
    if not len(moved):
        raise GeometryError(f"{files[0]}: lies beside the DSM before; check its CRS.")
    within = float((np.abs(moved) <= gsd_m).mean())
    mean, sd = float(moved.mean()), float(moved.std())
    return Round(*files, len(moved), round(mean, 5), round(sd, 5), round(within, 5))


def paper_excess(refractive_index: float) -> float:
    """Return by which share of the depth eq 12 comes out too deep, near nadir, in the end.

    A round makes h0 + (n - 1) h of a depth h, which tends to h0 / (2 - n) instead of n h0.
    """
    return 1.0 / (refractive_index * (2.0 - refractive_index)) - 1.0
