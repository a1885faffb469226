"""A cleaning in a few lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.report.text import share

if TYPE_CHECKING:
    from pcfix.clean.settings import CleanSummary


def cleaning_text(summary: CleanSummary) -> str:
    """Return what a person wants to know of a cleaning."""
    s = summary
    rate = s.points / max(s.seconds, 1e-9)
    fate = "dropped" if s.dropped else "class 7, withheld"
    lines = [
        f"{s.input} -> {s.output}",
        f"points       {s.points:,} in {s.seconds:.1f} s ({rate:,.0f} points/s)",
        f"set aside    {s.set_aside:,} withheld or noise already",
        f"noise        {s.noise:,} ({share(s.noise, s.points)} of the points; {fate})",
    ]
    for reason, count in s.reasons.items():
        if count:
            lines.append(f"  {reason.replace('_', ' '):<13}{count:,}")
    lines += [f"not run      {test}" for test in s.not_run]
    if s.submerged:
        lines.append(f"bed          {s.submerged:,} submerged points tested against it")
    if s.neighbour_distance_m:
        near = s.neighbour_distance_m
        lines.append(
            f"neighbours   mean distance {near['mean']:.3f} m, sd {near['sd']:.3f} m,"
            f" limit {near['limit']:.3f} m"
        )
    return "\n".join(lines)
