"""A labelling in a few lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.report.text import left_out_lines, share

if TYPE_CHECKING:
    from pcfix.flow.label import LabelSummary


def labelling_text(summary: LabelSummary) -> str:
    """Return what a person wants to know of a labelling."""
    s = summary
    rate = s.points / max(s.seconds, 1e-9)
    lines = [
        f"{s.input} -> {s.output}",
        f"points       {s.points:,} in {s.seconds:.1f} s ({rate:,.0f} points/s)",
        f"class 40     {s.submerged:,} ({share(s.submerged, s.points)} of the points)",
    ]
    if s.settings["band_m"]:
        lines.append(f"class 41     {s.water_surface:,} within {s.settings['band_m']:g} m")
    if s.stale:
        fate = "now class 1" if s.settings["reset"] else "left so; --reset makes them class 1"
        lines.append(f"class before {s.stale:,} came as class 40 or 41 and are neither: {fate}")
    if s.water_unknown:
        lines.append(f"no surface   {s.water_unknown:,} points have no known water above them")
    return "\n".join([*lines, *left_out_lines(s.labelling), f"water        {s.water}"])
