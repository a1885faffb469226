"""What a water surface is, and how well it is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.flow.surfaces import CloudView, FoundSurface, WaterWords, find_surface, view_of
from pcfix.io.files import check_input, check_output, write_bytes
from pcfix.model import WaterDimension
from pcfix.water.fit import WaterFit
from pcfix.water.river import RiverFit
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from os import PathLike

    from pcfix.model import FloatArray

    AnyPath = str | PathLike[str]

SAMPLE_POINTS = 200_000


@dataclass(frozen=True, eq=False)
class WaterReport:
    """What ``pcfix water`` says.

    Attributes
    ----------
    spec : str
    found : FoundSurface
    cloud : str or None
    below, unknown : float or None
        Share of the cloud's points below the surface, and of those without a surface above them.
    sample_xyz : array, shape (m, 3)
        Points of the cloud, evenly spread, for a picture.
    """

    spec: str
    found: FoundSurface
    cloud: str | None
    below: float | None
    unknown: float | None
    sample_xyz: FloatArray

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "water": self.spec,
            "surface": str(self.found.surface),
            "fit": self.found.as_dict(),
            "points": self._points(),
            "cloud": self.cloud,
            "share_below": self.below,
            "share_unknown": self.unknown,
            "notes": list(self.found.notes),
        }

    def _points(self) -> list[dict[str, Any]] | None:
        """Return each fitted point with its residual, None where it has no height."""
        found = self.found
        if found.points is None or not isinstance(found.evidence, WaterFit | RiverFit):
            return None
        fit = found.evidence
        rows = zip(found.points, fit.residual_m, fit.accepted, strict=True)
        return [
            {
                "xyz": [float(v) if np.isfinite(v) else None for v in xyz],
                "residual_m": float(residual) if np.isfinite(residual) else None,
                "accepted": bool(accepted),
            }
            for xyz, residual, accepted in rows
        ]


def check_water(
    words: WaterWords,
    cloud: AnyPath | None = None,
    *,
    plot: AnyPath | None = None,
    overwrite: bool = False,
) -> WaterReport:
    """Read, fit or find a water surface, and say what it is; ``pcfix water``.

    Parameters
    ----------
    words : WaterWords
    cloud : path, optional
        LAS or LAZ cloud under it.
    plot : path, optional
        PNG of points, residuals or evidence.
    overwrite : bool
        Replace a picture that exists.

    Raises
    ------
    PcfixError
        With one sentence on what to mend.
    """
    if plot is not None:
        check_output(plot, overwrite=overwrite, inputs=[] if cloud is None else [cloud])
    view = None if cloud is None else view_of(check_input(cloud))
    found = find_surface(words, view)
    sample = np.zeros((0, 3)) if view is None else _sample(view)
    below = unknown = None
    if view is not None and not isinstance(found.surface, WaterDimension):
        height = surface_above(found.surface, sample, None).height_m
        unknown = float(np.mean(~np.isfinite(height)))
        below = float(np.mean(sample[:, 2] < height))
    spec = str(words.water)
    report = WaterReport(spec, found, None if view is None else view.name, below, unknown, sample)
    if plot is not None:
        from pcfix.report.figures import png_of
        from pcfix.report.water import water_figure

        write_bytes(Path(plot), png_of(water_figure(report)), overwrite=overwrite)
    return report


def _sample(view: CloudView) -> FloatArray:
    every = max(1, view.points // SAMPLE_POINTS)
    return np.vstack([seen.xyz[::every] for seen in view.chunks()])
