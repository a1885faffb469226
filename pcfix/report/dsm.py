"""A DSM in a few lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.report.text import share

if TYPE_CHECKING:
    from pcfix.grid.model import DsmSummary


def dsm_text(summary: DsmSummary) -> str:
    """Return what a person wants to know of a DSM."""
    s = summary
    left, bottom, right, top = s.bounds_m
    total = s.width * s.height
    wanted = {"all": "land and bed", "bed": "bed, class 40"}[s.settings["surface"]]
    lines = [
        f"{s.input} -> {s.output}",
        f"points       {s.points_used:,} of {s.points:,} ({wanted}) in {s.seconds:.1f} s",
        f"raster       {s.width:,} x {s.height:,} cells of {s.settings['resolution_m']:g} m,"
        f" {s.settings['method']}",
        f"bounds       x {left:.10g} to {right:.10g}, y {bottom:.10g} to {top:.10g} m",
        f"CRS          {s.crs or 'the cloud states none'}",
        f"with points  {s.cells:,} cells ({share(s.cells, total)}),"
        f" {s.points_per_cell:.1f} points each",
    ]
    if s.hole_m is not None:
        lines.append(
            f"bridged      {s.filled:,} cells ({share(s.filled, total)}),"
            f" across holes up to {s.hole_m:.3g} m"
        )
    lines.append(f"empty        {s.empty:,} cells ({share(s.empty, total)})")
    if s.uncertainty_m is not None:
        sigma = s.uncertainty_m
        lines.append(
            f"uncertainty  of the bed's cells, formal, standard: mean {sigma['mean']:.3f} m,"
            f" largest {sigma['max']:.3f} m (band 4)"
        )
    if s.hillshade is not None:
        lines.append(f"hillshade    {s.hillshade}")
    return "\n".join(lines)
