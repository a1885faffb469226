"""What a command did, in a dozen lines: of correct, label, clean and dsm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.options.correct import LEVEL_M
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.refract.tally import ORDERS, Summary

if TYPE_CHECKING:
    from pcfix.clean.points import CleanSummary
    from pcfix.grid.model import DsmSummary
    from pcfix.label.labelling import LabelSummary
    from pcfix.photos.calm import CalmSummary

BELOW = "\n" + 13 * " "
FEWEST = 59
"""Differences of which all keep an order before 95 % of all are likely to: 0.95^59 is 0.05."""
BED_PER_LEVEL = 0.44
"""How far a bed moves with the level, measured over whole blocks; straight down it is n - 1."""


def summary_text(summary: Summary) -> str:
    """Return what a person wants to know of a run."""
    s = summary
    lines = [
        *_head(s),
        f"submerged    {s.submerged:,} ({share(s.submerged, s.points)} of the points)",
        f"corrected    {s.corrected:,} ({share(s.corrected, s.submerged)} of the submerged)",
    ]
    lines[2:2] = _carried(s)
    if 2 * s.corrected < s.submerged:
        lines[:0] = [
            f"WARNING      only {s.corrected:,} of {s.submerged:,} submerged points were corrected"
            f" ({share(s.corrected, s.submerged)}): see below why"
        ]
    for reason, count in s.uncorrected.items():
        if count:
            lines.append(f"  not        {count:,}: {reason} ({_FATE[s.settings['uncorrected']]})")
    if s.unsure is not None:
        lines.append(
            f"unsure       {s.unsure:,} ({share(s.unsure, s.corrected)} of the corrected): seen by"
            " flat obliques alone, withheld"
        )
    lines += _no_surface(s)
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
    if s.made:
        lines.append(f"method       {s.made['method']}. {s.made['because']}")
    elif s.told:
        lines.append(f"method       {s.settings['method']}")
    lines += [f"  note       {note}" for note in s.told]
    lines += [
        *_cameras(s),
        f"water        {s.water}, refractive index {s.settings['index']:.6g}",
        *_index(s),
        *_water_fit(s),
        *shoreline_lines(s.shoreline),
        *([] if s.fit is None or not s.cameras else [f"fit          {s.fit['words']}"]),
        *([] if s.poses is None else [f"poses        {s.poses['words']}"]),
        *_uncertainty(s),
    ]
    return "\n".join([*lines, *left_out_lines(s.labelling)])


def _cameras(s: Summary) -> list[str]:
    if not s.cameras:
        return [
            "cameras      none: a corrected point has a ray count of 1 and an incidence of 0, and"
            " which images made it, or were hidden, is not known"
        ]
    left_out = [name for names in s.cameras_left_out.values() for name in names]
    blind = [name for name in s.cameras_unused if name not in left_out]
    unused = {f"see the bed {why}": names for why, names in s.cameras_left_out.items()}
    unused |= {"see no corrected point": blind} if blind else {}
    return [
        f"cameras      {s.cameras_used} of {s.cameras} used"
        + "".join(
            f"; {len(names)} {why}: {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}"
            for why, names in unused.items()
        ),
        f"rays         {s.rays:,} ({s.rays / max(s.corrected, 1):.1f} a point, incidence up to"
        f" {s.incidence_deg:.0f} degrees)",
    ]


def _head(s: Summary | LabelSummary | CleanSummary) -> list[str]:
    rate = s.points / max(s.seconds, 1e-9)
    return [
        f"{s.input} -> {s.output}",
        f"points       {s.points:,}{_of_whole(getattr(s, 'part', None))} in {s.seconds:.1f} s"
        f" ({rate:,.0f} points/s)",
    ]


def _of_whole(part: dict[str, Any] | None) -> str:
    """Say of how many points a part was read, and which."""
    if part is None:
        return ""
    box, step = part["bounds"], part["read_resolution"]
    words = [] if box is None else ["within " + ",".join(f"{one:.12g}" for one in box)]
    words += [] if step is None else [f"at a resolution of {step:g} m"]
    return f" of {part['of']:,}, those {' '.join(words)},"


def shoreline_lines(found: dict[str, Any] | None) -> list[str]:
    """Say how long and how well known a shoreline is, where one was written."""
    if found is None:
        return []
    if not found["lines"]:
        return [f"shoreline    nowhere does the water meet the cloud: {found['path']} is empty"]
    return [
        f"shoreline    {found['lines']} lines, {found['length_m']:.1f} m, standard error in plan"
        f" {found['sigma_m']:.2f} m: {found['path']}"
    ]


def _no_surface(s: Summary | LabelSummary) -> list[str]:
    if not s.water_unknown:
        return []
    return [f"no surface   {s.water_unknown:,} points have no known water above them"]


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
    if not settings["index_from"] or not s.depth_m:
        return []
    change = 1.0 - DEFAULT_REFRACTIVE_INDEX / settings["index"]
    mean, most = (100.0 * change * s.depth_m[name] for name in ("mean", "max"))
    way = "deeper" if change > 0.0 else "shallower"
    return [
        f"  index      of {settings['index_from']}; against"
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
    if found is None and s.settings["dimensions"] == "all" and not s.cameras:
        return ["uncertainty  not known: no rays to propagate errors along; SigmaZ is 0"]
    if found is None:
        return []
    sigma, tvu = found["sigma_z_m"], found["tvu_95_m"]
    return [
        f"uncertainty  predicted standard error of Z mean {sigma['mean']:.3f} m, 95 % of the points"
        f" below {sigma['p95']:.3f} m; TVU at 95 % mean {tvu['mean']:.3f} m",
        f"  IHO S-44   {order_sentence(s)}",
        f"  formal     {formal_words(s, BELOW)}; S-44 asks for more than the TVU",
    ]


def formal_words(s: Summary, apart: str = " ") -> str:
    """Return what the standard errors of a run rest on; `apart` stands between its two parts."""
    if s.settings["method"] == "regression":
        return "it is how far the line misses check depths that it was not fitted to"
    fitted = None if s.water_fit is None else s.water_fit["sigma_level_m"]
    errors = budget_words(s.settings, fitted)
    return f"it assumes {errors} (standard deviations),{apart}and {of_cloud(s)}"


def of_cloud(s: Summary) -> str:
    """Return what the standard errors have beyond the budget, in words."""
    known = s.uncertainty or {}
    found, poses_m = known.get("of_cloud"), known.get("poses_m")
    poses = "" if poses_m is None else f"; poses as adjusted: {poses_m:.3f} m"
    if found is None:
        return f"no mismatches{poses}"
    return (
        f"has from the cloud itself {found['scatter_m']:.3f} m of scatter and"
        f" {100.0 * found['per_depth']:.1f} % of the depth{poses}"
    )


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
    """Return a percentage, with a digit more where it is small; 100 % only where it is all."""
    percent = 100.0 * part / max(whole, 1)
    if percent >= 99.5 and part < whole:
        return f"all but {whole - part:,}"
    return f"{percent:.0f} %" if percent >= 10 or percent == 0 else f"{percent:.1f} %"


def strictest_order(uncertainty: dict[str, Any]) -> str | None:
    """Return the strictest order whose TVU 95 % of the points keep, if any."""
    for order in ORDERS:
        if uncertainty["s44"][order.name] >= 0.95:
            return order.name
    return None


def budget_words(errors: dict[str, Any], level_from_fit: float | None = None) -> str:
    """Return the standard deviations that were assumed, as ``image 0.5 px, level 0.020 m``.

    Parameters
    ----------
    errors : dict
        The settings of a summary, with the options ``sigma_...``.
    level_from_fit : float, optional
        Standard error of the level that a fit gave, where the user stated none.
    """
    level = errors["sigma_level"]
    source = ""
    if level is None:
        level, source = LEVEL_M, " (assumed)"
        if level_from_fit is not None and np.isfinite(level_from_fit):
            level, source = level_from_fit, " (fitted)"
    parts = [f"image {errors['sigma_image']:g} px", f"level {level:.3f} m{source}"]
    parts.append(f"index {errors['sigma_index']:g}")
    more = (
        ("tilt", "sigma_tilt", "deg"),
        ("waves", "sigma_waves", "deg"),
        ("camera positions", "sigma_centre", "m"),
        ("attitude", "sigma_attitude", "deg"),
    )
    parts += [f"{name} {errors[key]:g} {unit}" for name, key, unit in more if errors[key] > 0.0]
    return ", ".join(parts)


def order_sentence(s: Summary) -> str:
    """Return which order of S-44 the standard errors allow, or why none is claimed."""
    if s.uncertainty is None or s.why_no_order:
        return f"no order is claimed: {s.why_no_order}"
    return tvu_sentence(s.uncertainty)


def tvu_sentence(uncertainty: dict[str, Any]) -> str:
    """Return which order of S-44 the standard errors would allow, in words."""
    order = strictest_order(uncertainty)
    if order is None:
        within = uncertainty["s44"][ORDERS[-1].name]
        return f"fewer than 95 % of the points keep any order of IHO S-44 ({within:.0%} order 2)"
    within = uncertainty["s44"][order]
    number = "order" if order[0].isdigit() else ""
    name = f"{number} {order}".strip() + ("" if number else " Order")
    return f"{100.0 * within:.4g} % of the points are within the TVU of IHO S-44 {name}"


def uncertainty_sentence(s: Summary, measured: dict[str, Any] | None = None) -> str:
    """Return TVU and order of S-44 of a run: as `measured` against a reference, else as predicted.

    `measured` is `Comparison.tvu` in plain values. Empty where neither is known.
    """
    mean = "" if s.uncertainty is None else f"{s.uncertainty['tvu_95_m']['mean']:.3f} m on average"
    if measured is None:
        return f"TVU at 95 % {mean}, formal; {order_sentence(s)}" if mean else ""
    few = f"fewer than {FEWEST} points claim no order of IHO S-44"
    return (
        f"TVU at 95 %{f' predicted {mean},' if mean else ''} measured"
        f" {measured['tvu_95_m']:.3f} m at {measured['count']:,} points of the bed;"
        f" {few if measured['count'] < FEWEST else tvu_sentence(measured)}"
    )


def labelling_text(summary: LabelSummary) -> str:
    """Return what a person wants to know of a labelling."""
    s = summary
    lines = [
        *_head(s),
        f"class 40     {s.submerged:,} ({share(s.submerged, s.points)} of the points)",
    ]
    if s.settings["band"]:
        lines.append(f"class 41     {s.water_surface:,} within {s.settings['band']:g} m")
    if s.stale:
        fate = "now class 1" if s.settings["reset"] else "left so; --reset makes them class 1"
        lines.append(f"class before {s.stale:,} came as class 40 or 41 and are neither: {fate}")
    lines += _no_surface(s)
    return "\n".join([*lines, *left_out_lines(s.labelling), f"water        {s.water}"])


def cleaning_text(summary: CleanSummary) -> str:
    """Return what a person wants to know of a cleaning."""
    s = summary
    fate = "dropped" if s.dropped else "class 7, withheld"
    lines = [
        *_head(s),
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


def dsm_text(summary: DsmSummary) -> str:
    """Return what a person wants to know of a DSM."""
    s = summary
    left, bottom, right, top = s.bounds_m
    total = s.width * s.height
    wanted = {"all": "land and bed", "bed": "bed, class 40"}[s.settings["surface"]]
    low, mean, high = (s.values.get(name, np.nan) for name in ("min", "mean", "max"))
    chosen = ", chosen for 2 to 4 points each" if s.resolution_is == "chosen" else ""
    lines = [
        f"{s.input} -> {s.output}",
        f"points       {s.points_used:,} of {s.points:,}{_of_whole(s.part)} ({wanted}) in"
        f" {s.seconds:.1f} s",
        f"raster       {s.width:,} x {s.height:,} cells of {s.settings['resolution']:g} m{chosen},"
        f" {s.settings['method']}",
        f"{s.what:<12} {low:.4g} to {high:.4g}, mean {mean:.4g}"
        f"{' m at 95 %, formal' if s.what == 'uncertainty' else ''}",
        f"bounds       x {left:.10g} to {right:.10g}, y {bottom:.10g} to {top:.10g} m",
        f"CRS          {s.crs or 'the cloud states none'}; heights:"
        f" {s.heights or 'the cloud states no vertical datum'}",
        f"with points  {s.cells:,} cells ({share(s.cells, total)}),"
        f" {s.points_per_cell:.1f} points each",
    ]
    if s.hole_m is not None:
        lines.append(
            f"bridged      {s.filled:,} cells ({share(s.filled, total)}),"
            f" across holes up to {s.hole_m:.3g} m"
        )
    lines.append(f"empty        {s.empty:,} cells ({share(s.empty, total)})")
    also = {"hillshade": s.hillshade, "counts": s.counts}
    lines += [f"{name:<12} {path}" for name, path in also.items() if path is not None]
    return "\n".join(lines)


def calm_text(summary: CalmSummary) -> str:
    """Return what a person wants to know of an image through calm water."""
    s = summary
    lines = [
        f"{s.input} -> {s.output}",
        f"frames       {s.frames} of {s.columns:,} x {s.rows:,} pixels in {s.seconds:.1f} s",
        f"registered   by {s.corners:,} corners, of which half scatter by less than"
        f" {s.scatter_px:.2f} px; the camera moved by up to {s.moved_px:.1f} px"
        if s.corners
        else "registered   not at all: the camera stood still",
        f"spread       median {s.spread:.1f} grey values: {s.spread_file}",
    ]
    if s.water is not None:
        w = s.water
        lines.append(
            f"water        {w.waves} waves, slopes of {w.slope_deg:.2f} deg rms, heights of"
            f" {100 * w.height_m:.1f} cm rms with a standard error of {100 * w.sigma_m:.1f} cm,"
            f" {100 * w.explained:.0f} % of the slopes explained: {w.folder}"
        )
    return "\n".join(lines)
