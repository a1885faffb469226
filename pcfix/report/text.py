"""The summaries of the commands, as tables of rows.

A row is (label, format, needs): label and format take values by name, and the row is omitted if the
value that it needs is missing or zero. With a star before it, the value is a list, and the row is
repeated with the values by name of each. Terminal and report page use the same rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from string import Formatter
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.options.correct import LEVEL_M
from pcfix.refract.tally import ORDERS
from pcfix.report.summary import Summary

if TYPE_CHECKING:
    from pcfix.sums import Figures

Plain = dict[str, Any]
Rows = list[tuple[str, str]]
RowTable = tuple[tuple[str, str, str], ...]

FEWEST = 59
"""Differences of which all keep an order before 95 % of all are likely to: 0.95^59 is 0.05."""
SHOWN_NAMES = 5
WIDTH = 100
"""Columns of a printed line."""
UNIT = re.compile(r"(?<=\d) (?=(?:m|cm|px|deg|%)(?:\W|$))")
"""The space between a number and its unit."""

_PART = ("Read", "{part_words}", "part_words")
_NO_SURFACE = ("No surface", "{water_unknown:,} points have no water surface", "water_unknown")
_SHORELINE: RowTable = (
    ("Shoreline", "{lines} lines, {length_m:.1f} m, standard error in plan {sigma_m:.2f} m: {path}",
     "lines"),
    ("Shoreline", "none: the water does not intersect the cloud; {path} is empty", "is_empty"),
)  # fmt: skip
_LABELLING: RowTable = (
    ("Mask", "{outside_mask:,} points below the surface are outside of it and count as land",
     "water_mask"),
    ("Classes", "{respected:,} points below the surface count as land (--respect-classes)",
     "respected"),
    ("Pools", "{pools[points]:,} points in {pools[pools]:,} separate pools count as land", "pools"),
    ("Pools", "no pool is separate from the water", "no_pools"),
)  # fmt: skip
_CORRECTED: RowTable = (
    _PART,
    ("Transferred", "{transfer[points]:,} points ({transfer[land]:,} on land) to the adjusted"
     " poses: {transfer[shift_m][rms]:.3f} m rms, at most {transfer[shift_m][max]:.3f} m, mean Z"
     " {transfer[shift_m][mean_z]:+.3f} m", "transfer"),
    ("", "{not_transferred:,} not transferred: {transfer[not_transferred_reason]} ({fate})",
     "not_transferred"),
    ("Submerged", "{submerged:,} points ({submerged_share}), {corrected_words}", "points"),
    ("", "{count:,} not corrected: {reason} ({fate})", "*not_corrected"),
    _NO_SURFACE,
    ("Withheld", "{unsure:,} corrected points ({unsure_share}) are visible at large incidence"
     " angles only", "unsure"),
    ("Depth", "{depth_m[min]:.2f} to {depth_m[max]:.2f} m, mean {depth_m[mean]:.2f} m", "depth_m"),
    ("Z shift", "mean {shift_z_m[mean]:.3f} m (5th to 95th percentile {shift_z_m[p5]:.3f} to"
     " {shift_z_m[p95]:.3f} m)", "shift_z_m"),
    ("Method", "{method}", "method"),
    ("Cameras", "{cameras_used} of {cameras} used, {rays_per_point:.1f} rays per point, incidence"
     " angles up to {incidence_deg:.0f} deg", "cameras"),
    ("Cameras", "none; ray counts of 1 and incidence angles of 0 are placeholders", "no_cameras"),
    ("Unused", "{unused_count} cameras without corrected points: {unused}", "unused"),
    ("Water", "{water}, refractive index {settings[index]:.6g}", "water"),
    ("", "fitted {water_fit[model]}{fit_points}, standard error {water_fit[sigma_level_m]:.3f} m",
     "water_fit"),
)  # fmt: skip
_UNCERTAINTY: RowTable = (
    ("Uncertainty", "{uncertainty[tvu_95_m][mean]:.3f} m at 95 % (predicted)", "uncertainty"),
    ("Uncertainty", "not known: without cameras there are no rays", "no_uncertainty"),
    ("IHO S-44", "{order}", "uncertainty"),
    ("Check", "{check}", "check"),
    ("Poses", "{poses[words]}", "poses"),
)  # fmt: skip
_LABELLED: RowTable = (
    _PART,
    ("Class 40", "{submerged:,} points ({submerged_share})", "points"),
    ("Class 41", "{water_surface:,} points within {settings[band]:g} m of the surface", "has_band"),
    ("Formerly", "{stale:,} points of class 40 or 41 are in neither class now: {stale_fate}",
     "stale"),
    _NO_SURFACE,
)  # fmt: skip
_CLEANED: RowTable = (
    ("Noise", "{noise:,} points ({noise_share}), {fate}", "points"),
    ("", "{count:,} {reason}", "*flagged"),
    ("Ignored", "{set_aside:,} points were withheld or noise before", "set_aside"),
    ("Bed", "{submerged:,} submerged points were tested against it", "submerged"),
    ("Neighbours", "mean distance {near[mean]:.3f} m, standard deviation {near[sd]:.3f} m, limit"
     " {near[limit]:.3f} m", "near"),
    ("Not run", "{test}", "*tests_not_run"),
)  # fmt: skip
_GRIDDED: RowTable = (
    _PART,
    ("Raster", "{width:,} x {height:,} cells of {settings[resolution]:g} m{chosen},"
     " {settings[method]}", "width"),
    ("Values", "{what} {low:.4g} to {high:.4g}, mean {mean:.4g}{unit}", "what"),
    ("Bounds", "x {bounds_m[0]:.10g} to {bounds_m[2]:.10g}, y {bounds_m[1]:.10g} to"
     " {bounds_m[3]:.10g} m", "width"),
    ("CRS", "{crs_name}; heights: {heights_name}", "width"),
    ("Cells", "{cells:,} with points ({cells_share}), {points_per_cell:.1f} points each", "width"),
    ("", "{filled:,} interpolated ({filled_share}), across holes up to {hole_m:.3g} m", "hole_m"),
    ("", "{empty:,} empty ({empty_share})", "width"),
    ("Hillshade", "{hillshade}", "hillshade"),
    ("Counts", "{counts}", "counts"),
)  # fmt: skip
_CALMED: RowTable = (
    ("Aligned", "by {corners:,} corners with a median scatter of {scatter_px:.2f} px; the camera"
     " moved by up to {moved_px:.1f} px", "corners"),
    ("Aligned", "no: the camera did not move (--still)", "is_still"),
    ("Spread", "median {spread:.1f} grey values: {spread_file}", "frames"),
    ("Water", "{found.waves} waves; slopes {found.slope_deg:.2f} deg rms, {percent:.0f} % of them"
     " explained", "found"),
    ("", "heights {height_cm:.1f} cm rms, standard error {sigma_cm:.1f} cm: {found.folder}",
     "found"),
)  # fmt: skip
_MAPPED: RowTable = (
    ("Mapping", "{mapping}, nodes every {spacing_px} px, largest shift {largest_shift_px:.1f} px",
     "images"),
    ("Black", "{black_percent:.1f} % of the pixels: no ground, occluded, or outside the image",
     "images"),
    ("Skipped", "{done_before:,} images, already done", "done_before"),
    ("Ground", "{dsm}", "dsm"),
    ("Water", "{water}, refractive index {refractive_index:g}", "water"),
)  # fmt: skip
_REBUILT: RowTable = (
    ("Result", "{verdict}: the last round moved the bed by {less} than {threshold_m:.3f} m on"
     " average", "rebuild"),
    ("Cloud", "{cloud}", "cloud"),
    ("Compared", "{compared}", "compared"),
)  # fmt: skip
_ORTHO: RowTable = (
    ("Raster", "{width:,} x {height:,} cells of {resolution_m:g} m", "width"),
    ("Covered", "{covered:.1f} % of the DSM {dsm}", "width"),
    ("Images", "{images}, {traced}", "images"),
)  # fmt: skip
_FATE = {"withhold": "not moved, withheld", "keep": "not moved", "drop": "dropped"}


def aligned(head: str, rows: Iterable[tuple[str, str]], notes: Iterable[object] = ()) -> str:
    """Return a summary: a line that says what was done, labelled rows, and notes.

    Long texts are wrapped, except for commands, so that these can be copied.
    """
    rows = list(rows)
    width = max([13, *(len(label) for label, _ in rows)])
    lines = [(f"  {label:<{width}} ", text) for label, text in rows]
    lines += [("", f"Note: {note}") for note in notes]
    return "\n".join([head, *(wrapped(start, text) for start, text in lines)])


def wrapped(start: str, text: str) -> str:
    """Return a text in lines of `WIDTH` with a hanging indent, unless it has a command."""
    if "pcfix " in text:
        return start + text
    text = UNIT.sub("\xa0", text)  # a number and its unit stay together
    lines = fill(
        text, WIDTH, initial_indent=start, subsequent_indent=" " * len(start),
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
    return lines.replace("\xa0", " ")


class _Numbers(Formatter):
    """Formats None as a dash, and the numbers of a list one by one."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value as text."""
        if isinstance(value, list):
            return ", ".join(self.format_field(one, format_spec) for one in value)
        return "-" if value is None else str(format(value, format_spec))


def filled(table: RowTable, values: Plain) -> Rows:
    """Return labels and texts of the rows of a table whose values are known."""
    rows: Rows = []
    for label, text, needs in table:
        needed = values.get(needs)
        once: list[Plain] = [{}] if needed not in (None, 0, "", {}, ()) else []
        for one in values[needs[1:]] if needs.startswith("*") else once:
            row = (_Numbers().vformat(words, (), values | one) for words in (label, text))
            rows.append((next(row), next(row)))
    return rows


def summary_text(summary: Summary) -> str:
    """Return the summary of a correction."""
    return aligned(_head("Corrected", summary), summary_rows(summary), summary.notes)


def summary_rows(s: Summary) -> Rows:
    """Return the facts of a correction, for the terminal and the report page."""
    fit, found = s.water_fit or {}, s.reconstruction
    method = str(s.settings["method"])
    if found is not None and found.get("type", "") not in ("", method):
        sure = f"detected, confidence {100.0 * found['confidence']:.0f} %"
        method = f"{found['method']}, {found['type']} ({sure})"
    elif found is not None and "type" not in found:
        method = f"{found['method']}. {found['because']}"
    check = ""
    if s.fit is not None and s.cameras:
        check = "cameras match the cloud"
        if s.fit["problems"]:
            check = "cameras may not match the cloud; see the warnings"
        elif not s.fit["fits"]:
            check = "cameras and cloud could not be tested"
    values = vars(s) | {
        "part_words": _part_words(s.part),
        "fate": _FATE[s.settings["uncorrected"]],
        "not_transferred": (s.transfer or {}).get("not_transferred"),
        "submerged_share": share(s.submerged, s.points),
        "corrected_words": "all corrected" if s.corrected == s.submerged
        else f"{s.corrected:,} corrected ({share(s.corrected, s.submerged)})",
        "not_corrected": [{"reason": why, "count": n} for why, n in s.uncorrected.items() if n],
        "unsure_share": share(s.unsure or 0, s.corrected),
        "method": method,
        "rays_per_point": s.rays / max(s.corrected, 1),
        "no_cameras": not s.cameras,
        "unused_count": len(s.cameras_unused),
        "unused": ", ".join(s.cameras_unused[:SHOWN_NAMES])
        + (", ..." if len(s.cameras_unused) > SHOWN_NAMES else ""),
        "fit_points": ", {accepted} of {points} points".format(**fit) if "points" in fit else "",
        "no_uncertainty": s.uncertainty is None and s.settings["dimensions"] == "all"
        and not s.cameras,
        "order": _order_words(s),
        "check": check,
    }  # fmt: skip
    rows = filled(_CORRECTED, values) + shoreline_rows(s.shoreline)
    return [*rows, *filled(_UNCERTAINTY, values), *_labelling_rows(s.labelling)]


def _head(verb: str, s: Any, points: str = "") -> str:
    points = points or f"{s.points:,}"
    return f"{verb} {s.input} -> {s.output}      {points} points in {s.seconds:.1f} s"


def _part_words(part: Plain | None) -> str:
    """Return which part of the points was read, and by which bounds."""
    if part is None:
        return ""
    box, step = part["bounds"], part["read_resolution"]
    words = "" if box is None else " within " + ",".join(f"{one:.12g}" for one in box)
    words += "" if step is None else f" at a resolution of {step:g} m"
    return f"a part of {part['of']:,} points,{words}"


def shoreline_rows(found: Plain | None) -> Rows:
    """Return the length and the standard error of a shoreline, where one was written."""
    return [] if found is None else filled(_SHORELINE, found | {"is_empty": not found["lines"]})


def _labelling_rows(labelling: Plain | None) -> Rows:
    """Return what stays land although it lies below the surface."""
    if labelling is None:
        return []
    pools = labelling["separate"] or {}
    values = {"pools": pools if pools.get("pools") else None, "no_pools": pools.get("pools") == 0}
    return filled(_LABELLING, labelling | values)


def share(part: int, whole: int) -> str:
    """Return a percentage, with a digit more where it is small; 100 % only where it is all."""
    percent = 100.0 * part / max(whole, 1)
    if percent >= 99.5 and part < whole:
        return f"all but {whole - part:,}"
    return f"{percent:.0f} %" if percent >= 10 or percent == 0 else f"{percent:.1f} %"


def formal_words(s: Summary) -> str:
    """Return what the standard errors of a run rest on."""
    if s.settings["method"] == "regression":
        return "the scatter of check depths about the line, where it was not fitted to them"
    fitted = None if s.water_fit is None else s.water_fit["sigma_level_m"]
    known = s.uncertainty or {}
    found, poses_m = known.get("of_cloud"), known.get("poses_m")
    cloud = "" if found is None else (
        f". Estimated from the cloud: matching noise {found['scatter_m']:.3f} m, model uncertainty"
        f" {100.0 * found['per_depth']:.1f} % of depth"
    )  # fmt: skip
    poses = "" if poses_m is None else f". Adjusted poses: {poses_m:.3f} m"
    return f"Assumed standard deviations: {budget_words(s.settings, fitted)}{cloud}{poses}"


_BUDGET: RowTable = (
    ("image", "{sigma_image:g} px", "settings"),
    ("level", "{level:.3f} m{source}", "settings"),
    ("index", "{sigma_index:g}", "settings"),
    ("tilt", "{sigma_tilt:g} deg", "sigma_tilt"),
    ("waves", "{sigma_waves:g} deg", "sigma_waves"),
    ("camera positions", "{sigma_centre:g} m", "sigma_centre"),
    ("attitude", "{sigma_attitude:g} deg", "sigma_attitude"),
)  # fmt: skip


def budget_words(errors: Plain, level_from_fit: float | None = None) -> str:
    """Return the standard deviations that were assumed, as ``image 0.5 px, level 0.020 m``.

    `errors` are the settings of a summary. Where the user stated none for the level, it is that of
    a fit, if there was one.
    """
    level, source = errors["sigma_level"], ""
    if level is None:
        level, source = LEVEL_M, " (assumed)"
        if level_from_fit is not None and np.isfinite(level_from_fit):
            level, source = level_from_fit, " (fitted)"
    values = errors | {"level": level, "source": source, "settings": True}
    return ", ".join(f"{name} {text}" for name, text in filled(_BUDGET, values))


def order_sentence(s: Summary) -> str:
    """Return which order of S-44 the standard errors allow, or why none is claimed."""
    if s.uncertainty is None or s.why_no_order:
        return f"no order is claimed: {s.why_no_order}"
    return tvu_sentence(s.uncertainty)


def tvu_sentence(uncertainty: Plain) -> str:
    """Return the strictest order of S-44 whose TVU 95 % of the points keep, in words."""
    shares = uncertainty["s44"]
    name, percent = _order(shares)
    if not name:
        within = shares[ORDERS[-1].name]
        return f"fewer than 95 % of the points meet any order of IHO S-44 ({within:.0%} order 2)"
    return f"{percent:.4g} % of the points are within the TVU of IHO S-44 {name}"


def _order(shares: Plain) -> tuple[str, float]:
    """Return the strictest order that 95 % of the points keep, empty if none, and their percent."""
    order = next((one.name for one in ORDERS if shares[one.name] >= 0.95), None)
    if order is None:
        return "", 0.0
    return f"order {order}" if order[0].isdigit() else f"{order} Order", 100.0 * shares[order]


def _order_words(s: Summary) -> str:
    """Return the order of S-44 for the summary, or why none is claimed."""
    if s.uncertainty is None or s.why_no_order:
        return f"no order claimed: {s.why_no_order}"
    name, percent = _order(s.uncertainty["s44"])
    if not name:
        return "no order: fewer than 95 % of the points are within the TVU of order 2"
    return f"{name} ({percent:.4g} % of the points are within its TVU)"


def uncertainty_sentence(s: Summary, measured: Plain | None = None) -> str:
    """Return TVU and order of S-44 of a run: as `measured` against a reference, else as predicted.

    `measured` is `Comparison.tvu` in plain values. Empty where neither is known.
    """
    mean = "" if s.uncertainty is None else f"{s.uncertainty['tvu_95_m']['mean']:.3f} m on average"
    if measured is None:
        return f"TVU at 95 % {mean}, predicted; {order_sentence(s)}" if mean else ""
    few = f"fewer than {FEWEST} points, too few for an order of IHO S-44"
    return (
        f"TVU at 95 %{f' predicted {mean},' if mean else ''} measured"
        f" {measured['tvu_95_m']:.3f} m at {measured['count']:,} points of the bed;"
        f" {few if measured['count'] < FEWEST else tvu_sentence(measured)}"
    )


def labelling_text(s: Figures) -> str:
    """Return the summary of a labelling."""
    values = vars(s) | {
        "part_words": _part_words(s.part),
        "submerged_share": share(s.submerged, s.points),
        "has_band": s.settings["band"] > 0.0,
        "stale_fate": "class 1 now" if s.settings["reset"] else "unchanged; --reset sets class 1",
    }
    rows = [*filled(_LABELLED, values), *_labelling_rows(s.labelling), ("Water", s.water)]
    return aligned(_head("Labelled", s), rows)


def cleaning_text(s: Figures) -> str:
    """Return the summary of a cleaning."""
    values = vars(s) | {
        "noise_share": share(s.noise, s.points),
        "fate": "dropped" if s.dropped else "class 7, withheld",
        "near": s.neighbour_distance_m,
        "flagged": [{"reason": k.replace("_", " "), "count": n} for k, n in s.reasons.items() if n],
        "tests_not_run": [{"test": test} for test in s.not_run],
    }
    return aligned(_head("Cleaned", s), filled(_CLEANED, values))


def dsm_text(s: Figures) -> str:
    """Return the summary of a DSM."""
    total = s.width * s.height
    low, mean, high = (s.values.get(name, np.nan) for name in ("min", "mean", "max"))
    values = s.as_dict() | {
        "part_words": _part_words(s.part),
        "low": low, "mean": mean, "high": high,
        "chosen": ", chosen for 2 to 4 points each" if s.resolution_is == "chosen" else "",
        "unit": " m at 95 % (predicted)" if s.what == "uncertainty" else "",
        "crs_name": s.crs or "the cloud states none",
        "heights_name": s.heights or "the cloud states no vertical datum",
        "cells_share": share(s.cells, total),
        "filled_share": share(s.filled, total),
        "empty_share": share(s.empty, total),
    }  # fmt: skip
    surface = {"all": "land and bed", "bed": "bed, class 40"}[s.settings["surface"]]
    points = f"{s.points_used:,} of {s.points:,} ({surface})"
    return aligned(_head("Gridded", s, points), filled(_GRIDDED, values))


def calm_text(s: Figures) -> str:
    """Return the summary of an image through calm water."""
    values = vars(s) | {"is_still": not s.corners, "found": s.water}
    if s.water is not None:
        values |= {"percent": 100 * s.water.explained, "height_cm": 100 * s.water.height_m,
                   "sigma_cm": 100 * s.water.sigma_m}  # fmt: skip
    head = (
        f"Combined {s.input} -> {s.output}      {s.frames} frames of {s.columns:,} x {s.rows:,}"
        f" pixels in {s.seconds:.1f} s"
    )
    return aligned(head, filled(_CALMED, values))


def photos_text(s: Figures) -> str:
    """Return the summary of photographs without water."""
    head = f"Mapped {s.images - s.done_before:,} images in {s.seconds:.1f} s"
    if s.seconds and s.images > s.done_before:
        head += f" ({s.megapixels / s.seconds:.1f} Mpx/s)"
    return aligned(head, filled(_MAPPED, vars(s) | {"black_percent": 100.0 * s.black_share}))


def rounds_text(s: Figures) -> str:
    """Return why the rounds ended, and where their clouds and the comparison are."""
    values = vars(s) | {
        "verdict": "settled" if s.settled else "not settled",
        "less": "less" if s.settled else "more",
        "cloud": s.rounds[-1].cloud,
    }
    return aligned(f"Rebuilt in {len(s.rounds)} rounds", filled(_REBUILT, values))


def ortho_text(s: Figures) -> str:
    """Return the summary of an orthophoto."""
    traced = "without refraction" if s.water is None else f"traced through water {s.water}"
    values = vars(s) | {"covered": 100 * s.covered_share, "traced": traced}
    return aligned(f"Orthophoto {s.output} in {s.seconds:.1f} s", filled(_ORTHO, values))
