"""The water surface from points that were classified as such."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pcfix.water.auto.proposal import EvidenceCurves, WaterProposal
from pcfix.water.fit import fit_water

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.water.auto.samples import Samples

WATER_CLASSES = (9, 41)
"""ASPRS: water, and water surface of the topo-bathy profile."""
MOST_POINTS = 2_000


def from_classes(water: FloatArray, samples: Samples) -> WaterProposal:
    """Fit the points of the water classes.

    Parameters
    ----------
    water : array, shape (w, 3)
        Metres, world frame.
    samples : Samples
        Of the whole cloud.

    Raises
    ------
    GeometryError
        If they do not make a level or a plane.
    """
    thinned = water[:: math.ceil(len(water) / MOST_POINTS)]
    fit = fit_water(thinned)
    accepted = thinned[fit.accepted]
    figures = {
        "classified points": float(len(water)),
        "sigma of a point": fit.sigma_m,
        "share accepted": float(fit.accepted.mean()),
    }
    counts, edges = np.histogram(thinned[:, 2], 60)
    said = (
        f"{len(water):,} points are classified as water and scatter by {fit.sigma_m:.3f} m",
        *fit.notes,
    )
    return WaterProposal(
        surface=fit.surface,
        sigma_level_m=fit.sigma_level_m,
        centre_xy=fit.centre_xy,
        level_m=fit.level_m,
        tilt=fit.tilt,
        sigma_tilt=fit.sigma_tilt_percent / 100.0,
        confidence=float(fit.accepted.mean()),
        evidence=figures,
        reasons=said,
        shoreline=accepted,
        curves=EvidenceCurves((edges[1:] + edges[:-1]) / 2.0, {"classified points": counts + 0.0}),
        ground=samples.xyz + samples.origin,
    )
