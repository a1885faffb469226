"""A run in a dozen lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pcfix.options import DEFAULT_REFRACTIVE_INDEX
from pcfix.report.tvu import budget_words, tvu_sentence

if TYPE_CHECKING:
    from pcfix.model import Summary

BED_PER_LEVEL = 0.44
"""How far a bed moves with the level, measured over whole blocks; straight down it is n - 1."""


def summary_text(summary: Summary) -> str:
    """Return what a person wants to know of a run."""
    s = summary
    lines = [
        f"{s.input} -> {s.output}",
        f"points       {s.points:,} in {s.seconds:.1f} s ({s.points_per_s:,.0f} points/s)",
        f"submerged    {s.submerged:,} ({share(s.submerged, s.points)} of the points)",
        f"corrected    {s.corrected:,} ({share(s.corrected, s.submerged)} of the submerged)",
    ]
    lines[2:2] = _carried(s)
    for reason, count in s.uncorrected.items():
        if count:
            lines.append(f"  not        {count:,}: {reason} ({_FATE[s.settings['uncorrected']]})")
    if s.water_unknown:
        lines.append(f"no surface   {s.water_unknown:,} points have no known water above them")
    if s.depth_m:
        depth = s.depth_m
        lines.append(
            f"depth        {depth['min']:.2f} to {depth['max']:.2f} m, mean {depth['mean']:.2f} m"
        )
    if s.shift_z_m:
        shift = s.shift_z_m
        lines.append(
            f"shift in Z   mean {shift['mean']:.3f} m, 5 % {shift['p5']:.3f} m,"
            f" 95 % {shift['p95']:.3f} m"
        )
    unused = len(s.cameras_unused)
    names = ", ".join(s.cameras_unused[:5]) + (", ..." if unused > 5 else "")
    lines += [
        f"cameras      {s.cameras_used} of {s.cameras} used"
        + (f"; {unused} see no corrected point: {names}" if unused else ""),
        f"rays         {s.rays:,} ({s.rays / max(s.corrected, 1):.1f} a point)",
        f"water        {s.water}, refractive index {s.settings['refractive_index']:.6g}",
        *_index(s),
        *_water_fit(s),
        *_uncertainty(s),
    ]
    return "\n".join([*lines, *left_out_lines(s.labelling)])


_FATE = {"withhold": "unmoved, withheld", "keep": "unmoved", "drop": "dropped"}


def _carried(s: Summary) -> list[str]:
    """Say that land moved too, and how far."""
    found = s.carried
    if found is None:
        return []
    shift = found["shift_m"]
    lines = [
        f"carried      {found['points']:,} ({share(found['points'], s.points)} of the points),"
        f" {found['land']:,} of them land, from the old cameras to the adjusted ones: by"
        f" {shift['rms']:.3f} m rms, {shift['max']:.3f} m at most, mean in Z"
        f" {shift['mean_z']:+.3f} m; shifts below count from before it"
    ]
    if found["not_carried"]:
        lines.append(
            f"  not        {found['not_carried']:,}: {found['not_carried_reason']}"
            f" ({_FATE[s.settings['uncorrected']]})"
        )
    return lines


def _index(s: Summary) -> list[str]:
    """Say what a water's own index changes: straight down, depth is in proportion to it."""
    settings = s.settings
    if not settings["refractive_index_from"] or not s.depth_m:
        return []
    change = 1.0 - DEFAULT_REFRACTIVE_INDEX / settings["refractive_index"]
    mean, most = (100.0 * change * s.depth_m[name] for name in ("mean", "max"))
    way = "deeper" if change > 0.0 else "shallower"
    return [
        f"  index      of {settings['refractive_index_from']}; against"
        f" {DEFAULT_REFRACTIVE_INDEX:g} the bed is {abs(mean):.1f} cm {way} on average,"
        f" {abs(most):.1f} cm at most"
    ]


def _water_fit(s: Summary) -> list[str]:
    """Say how well a fitted water level is known, and what that does to the bed."""
    fit = s.water_fit
    if fit is None:
        return []
    sigma = fit["sigma_level_m"]
    used = f", {fit['accepted']} of {fit['points']} points" if "points" in fit else ""
    return [
        f"  fitted     {fit['model']}{used}; standard error of the level {sigma:.3f} m, of the bed"
        f" by it {BED_PER_LEVEL * sigma:.3f} m"
    ]


def _uncertainty(s: Summary) -> list[str]:
    """Say how good the heights are, if the budget is right and nothing else is wrong."""
    found = s.uncertainty
    if found is None:
        return []
    sigma, tvu = found["sigma_z_m"], found["tvu_95_m"]
    return [
        f"uncertainty  standard error of Z mean {sigma['mean']:.3f} m, 95 % of the points below"
        f" {sigma['p95']:.3f} m; TVU at 95 % mean {tvu['mean']:.3f} m",
        f"  IHO S-44   {tvu_sentence(found)}",
        f"  formal     it assumes {errors_of(s)} (standard deviations)",
        "             and no mismatches; S-44 asks for more than the TVU",
    ]


def errors_of(s: Summary) -> str:
    """Return the budget of a run in words."""
    fitted = None if s.water_fit is None else s.water_fit["sigma_level_m"]
    return budget_words(s.settings["errors"], fitted)


def left_out_lines(labelling: dict[str, Any] | None) -> list[str]:
    """Return what was left as land although it lies below the surface."""
    if labelling is None:
        return []
    lines = []
    if labelling["water_mask"] is not None:
        lines.append(f"mask         {labelling['outside_mask']:,} points below lie outside: land")
    if labelling["respected"]:
        lines.append(f"respected    {labelling['respected']:,} points below keep their class")
    apart = labelling["separate"]
    if apart is not None and apart["pools"]:
        most = apart["largest"]
        lines.append(
            f"separate     {apart['points']:,} points in {apart['pools']:,} pools apart from the"
            f" water were left as land; the largest, {most['area_m2']:,.1f} m2 with"
            f" {most['points']:,} points, is at {most['x']:.1f}, {most['y']:.1f}"
        )
    elif apart is not None:
        lines.append("separate     no pools apart from the water")
    return lines


def share(part: int, whole: int) -> str:
    """Return a percentage, with a digit more where it is small."""
    percent = 100.0 * part / max(whole, 1)
    return f"{percent:.0f} %" if percent >= 10 or percent == 0 else f"{percent:.1f} %"
