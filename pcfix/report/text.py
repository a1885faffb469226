"""A run in a dozen lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcfix.model import Summary


def summary_text(summary: Summary) -> str:
    """Return what a person wants to know of a run."""
    s = summary
    lines = [
        f"{s.input} -> {s.output}",
        f"points       {s.points:,} in {s.seconds:.1f} s ({s.points_per_s:,.0f} points/s)",
        f"submerged    {s.submerged:,} ({share(s.submerged, s.points)} of the points)",
        f"corrected    {s.corrected:,} ({share(s.corrected, s.submerged)} of the submerged)",
    ]
    fate = {"withhold": "unmoved, withheld", "keep": "unmoved", "drop": "dropped"}
    for reason, count in s.uncorrected.items():
        if count:
            lines.append(f"  not        {count:,}: {reason} ({fate[s.settings['uncorrected']]})")
    if s.water_unknown:
        lines.append(f"no surface   {s.water_unknown:,} points have no known water above them")
    if s.depth_m:
        depth, shift = s.depth_m, s.shift_z_m
        lines += [
            f"depth        {depth['min']:.2f} to {depth['max']:.2f} m, mean {depth['mean']:.2f} m",
            f"shift in Z   mean {shift['mean']:.3f} m, 5 % {shift['p5']:.3f} m,"
            f" 95 % {shift['p95']:.3f} m",
        ]
    unused = len(s.cameras_unused)
    names = ", ".join(s.cameras_unused[:5]) + (", ..." if unused > 5 else "")
    lines += [
        f"cameras      {s.cameras_used} of {s.cameras} used"
        + (f"; {unused} see no corrected point: {names}" if unused else ""),
        f"rays         {s.rays:,} ({s.rays / max(s.corrected, 1):.1f} a point)",
        f"water        {s.water}, refractive index {s.settings['refractive_index']:g}",
    ]
    return "\n".join(lines)


def share(part: int, whole: int) -> str:
    """Return a percentage, with a digit more where it is small."""
    percent = 100.0 * part / max(whole, 1)
    return f"{percent:.0f} %" if percent >= 10 or percent == 0 else f"{percent:.1f} %"
