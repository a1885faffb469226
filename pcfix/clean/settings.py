"""Why a point is noise, and the numbers of a run."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import Any


class Reason(IntFlag):
    """Why a point is noise; one point may have several reasons, one bit each."""

    STATISTICAL = 1
    RADIUS = 2
    FEW_RAYS = 4
    RAY_MISS = 8
    INCIDENCE = 16
    BELOW_BED = 32
    FLOATING = 64


@dataclass(frozen=True)
class CleanSummary:
    """What a cleaning did, in numbers; `as_dict` is what ``--summary`` writes.

    Attributes
    ----------
    input, output, pcfix : str
        The files and the version.
    points : int
        Points read.
    set_aside : int
        Points that came withheld or as noise (class 7 or 18): neither tested nor a neighbour.
    submerged : int
        Points that were tested against the bed.
    noise : int
        Points flagged.
    reasons : dict
        Points for each `Reason`; a point may count under several.
    dropped : int
        Points left out of the output.
    neighbour_distance_m : dict
        Of the statistical test: mean, sd and limit of the mean distances to the neighbours.
    not_run : list of str
        Tests that were asked for and could not be run, and why.
    water : str or None
    settings : dict
    seconds : float
    """

    input: str
    output: str
    pcfix: str
    points: int
    set_aside: int
    submerged: int
    noise: int
    reasons: dict[str, int]
    dropped: int
    neighbour_distance_m: dict[str, float]
    not_run: list[str]
    water: str | None
    settings: dict[str, Any]
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(vars(self))
