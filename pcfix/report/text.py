"""The summaries of the commands, as tables of rows.

A row is (label, format, needs). Label and format take values by name, as `str.format` does, with
three more ways to write a value: ``of NAME`` (the share that it is of another value), a format that
ends in `` %`` or `` cm`` (a hundred times the value), and ``?YES|NO`` (one of two texts).

A row is omitted if the value that it needs is missing, zero or empty; with ``!`` before the name,
unless it is known and zero or empty. With a star before the name the row is repeated, for each dict
of values in a list, each text in a list, or each count in a dict that is not zero. Terminal and
report page use the same rows.
"""

from collections.abc import Iterable
from string import Formatter
from textwrap import fill
from typing import Any

import numpy as np

from pcfix.options.correct import LEVEL_M
from pcfix.refract.tally import ORDERS
from pcfix.sums import Figures

Plain = dict[str, Any]
Rows = list[tuple[str, str]]
RowTable = tuple[tuple[str, str, str], ...]

# Differences of which all keep an order before 95 % of all are likely to: 0.95^59 is 0.05.
FEWEST = 59
WIDTH = 100  # columns of a printed line

_NO_SURFACE = ("No surface", "{water_unknown:,} points have no water surface", "water_unknown")
_LABELLING: RowTable = (
    ("Mask", "{labelling[outside_mask]:,} points below the surface are outside of it and count as"
     " land", "labelling[water_mask]"),
    ("Classes", "{labelling[respected]:,} points below the surface count as land"
     " (--respect-classes)", "labelling[respected]"),
    ("Pools", "{labelling[separate][points]:,} points in {labelling[separate][pools]:,} separate"
     " pools count as land", "labelling[separate][pools]"),
    ("Pools", "no pool is separate from the water", "!labelling[separate][pools]"),
)  # fmt: skip
_CORRECTED: RowTable = (
    ("Transferred", "{transfer[points]:,} points ({transfer[land]:,} on land) to the adjusted"
     " poses: {transfer[shift_m][rms]:.3f} m rms, mean Z"
     " {transfer[shift_m][mean_z]:+.3f} m", "transfer"),
    ("", "{transfer[not_transferred]:,} not transferred: fewer than two original cameras image them"
     " (not moved, withheld)", "transfer[not_transferred]"),
    ("Submerged", "{submerged:,} points ({submerged:of points}), {corrected_words}", ""),
    ("", "{count:,} not corrected: {name} (not moved, withheld)", "*uncorrected"),
    _NO_SURFACE,
    ("Depth", "{depth_m[min]:.2f} to {depth_m[max]:.2f} m, mean {depth_m[mean]:.2f} m", "depth_m"),
    ("Z shift", "mean {shift_z_m[mean]:.3f} m (5th to 95th percentile {shift_z_m[p5]:.3f} to"
     " {shift_z_m[p95]:.3f} m)", "shift_z_m"),
    ("Method", "{method}", ""),
    ("Cameras", "{cameras_used} of {cameras} used, {rays_per_point:.1f} rays per point, incidence"
     " angles up to {incidence_deg:.0f} deg", "cameras"),
    ("Cameras", "none; ray counts of 1 and incidence angles of 0 are placeholders", "!cameras"),
    ("Water", "{water}, refractive index {settings[index]:.6g}", ""),
    ("", "fitted {water_fit[model]}, standard error {water_fit[sigma_level_m]:.3f} m",
     "water_fit"),
    ("", "accepted {water_fit[accepted]} of {water_fit[points]} points", "water_fit[points]"),
    ("Uncertainty", "{uncertainty[tvu_95_m][mean]:.3f} m at 95 % (predicted)", "uncertainty"),
    ("Measured", "{measured[tvu_95_m]:.3f} m at 95 %, at {measured[count]:,} points of the bed",
     "measured"),
    ("IHO S-44", "{order}", "order"),
    ("Check", "{check}", "check"),
    ("Poses", "{poses[words]}", "poses"),
    *_LABELLING,
)  # fmt: skip
# By command: the line that says what was done, and the rows below it.
_TABLES: dict[str, tuple[str, RowTable]] = {
    "correct": ("Corrected {input} -> {output}      {points:,} points in {seconds:.1f} s",
                _CORRECTED),
    "label": ("Labelled {input} -> {output}      {points:,} points in {seconds:.1f} s", (
        ("Class 40", "{submerged:,} points ({submerged:of points})", ""),
        ("Formerly", "{stale:,} points of class 40 are not submerged; their class stays", "stale"),
        _NO_SURFACE,
        *_LABELLING,
        ("Water", "{water}", ""),
    )),
    "clean": ("Cleaned {input} -> {output}      {points:,} points in {seconds:.1f} s", (
        ("Noise", "{noise:,} points ({noise:of points}), {dropped:?dropped|class 7, withheld}", ""),
        ("", "{count:,} {name}", "*reasons"),
        ("Ignored", "{set_aside:,} points were withheld or noise before", "set_aside"),
        ("Bed", "{submerged:,} submerged points were tested against it", "submerged"),
        ("Neighbours", "mean distance {neighbour_distance_m[mean]:.3f} m, standard deviation"
         " {neighbour_distance_m[sd]:.3f} m, limit {neighbour_distance_m[limit]:.3f} m",
         "neighbour_distance_m"),
        ("Not run", "{text}", "*not_run"),
    )),
    "dsm": ("Gridded {input} -> {output}      {points_used:,} of {points:,} points"
            " ({is_bed:?bed, class 40|land and bed}) in {seconds:.1f} s", (
        ("Raster", "{width:,} x {height:,} cells of {settings[resolution]:g} m"
         " ({settings[method]})", ""),
        ("Values", "{what} {values[min]:.4g} to {values[max]:.4g}, mean {values[mean]:.4g}"
         "{is_tvu:? m at 95 % (predicted)|}", "values"),
        ("Bounds", "x {bounds_m[0]:.10g} to {bounds_m[2]:.10g}, y {bounds_m[1]:.10g} to"
         " {bounds_m[3]:.10g} m", ""),
        ("CRS", "{crs_name}; heights: {heights_name}", ""),
        ("Cells", "{cells:,} with points ({cells:of all}), {points_per_cell:.1f} points each", ""),
        ("", "{filled:,} interpolated ({filled:of all}), across holes up to {hole_m:.3g} m",
         "hole_m"),
        ("", "{empty:,} empty ({empty:of all})", ""),
        ("Counts", "{counts}", "counts"),
    )),
    "calm": ("Combined {input} -> {output}      {frames} frames of {columns:,} x {rows:,} pixels in"
             " {seconds:.1f} s", (
        ("Aligned", "by {corners:,} corners with a median scatter of {scatter_px:.2f} px; the"
         " camera moved by up to {moved_px:.1f} px", "corners"),
        ("Aligned", "no: the camera did not move (--still)", "!corners"),
        ("Spread", "median {spread:.1f} grey values: {spread_file}", ""),
        ("Water", "{water[waves]} waves; slopes {water[slope_deg]:.2f} deg rms,"
         " {water[explained]:.0f %} of them explained", "water"),
        ("", "heights {water[height_m]:.1f cm} rms, standard error {water[sigma_m]:.1f cm}:"
         " {water[folder]}", "water"),
    )),
    "photos": ("Mapped {images:,} images in {seconds:.1f} s", (
        ("Pixels", "{megapixels:.1f} million", "megapixels"),
        ("Mapping", "{mapping}, nodes every {spacing_px} px, largest shift"
         " {largest_shift_px:.1f} px", ""),
        ("Black", "{black_share:.1f %} of the pixels: no ground, occluded, or outside the image",
         ""),
        ("Ground", "{dsm}", ""),
        ("Water", "{water}, refractive index {refractive_index:g}", ""),
    )),
    "rebuild": ("Rebuilt in {count} rounds", (
        ("Result", "{converged:?converged|not converged}: the last round moved the bed by"
         " {converged:?less|more} than {threshold_m:.3f} m on average", ""),
        ("Cloud", "{last[cloud]}", ""),
    )),
    "ortho": ("Orthophoto {output} in {seconds:.1f} s", (
        ("Raster", "{width:,} x {height:,} cells of {resolution_m:g} m", ""),
        ("Covered", "{covered_share:.1f %} of the DSM {dsm}", ""),
        ("Images", "{images}, traced through water {water}", "water"),
        ("Images", "{images}, without refraction", "is_dry"),
    )),
}  # fmt: skip


class Summary(Figures):
    """The results of a correction by name; `as_dict` is what ``--summary`` writes."""

    @property
    def absorbed(self) -> bool | None:
        """Whether the poses have absorbed the refraction; None if that is unknown."""
        return None if self.poses is None else self.poses["absorbed"]

    @property
    def why_no_order(self) -> str:
        """Why no order of S-44 is claimed, as the whole bed may be off; empty if one is."""
        found = self.reconstruction or {}
        if self.settings["method"] == "regression":  # measured depths hold the bed
            return ""
        is_sure = found.get("sure", bool(found.get("views_are")))
        if found.get("method") != "consistent" or not is_sure:
            return "the reconstruction type is uncertain, or the method assumes another one"
        return {
            True: "the poses have absorbed the refraction",
            None: "the poses were not checked for absorbed refraction",
            False: "",
        }[self.absorbed]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; optional parts only if there are any."""
        optional = ("labelling", "transfer", "poses", "fit")
        values = {
            name: value for name, value in vars(self).items()
            if name != "notes" and not (name in optional and value is None)
        }  # fmt: skip
        if self.uncertainty is not None and self.why_no_order:
            no_order = {"s44": None, "why_no_order": self.why_no_order}
            values["uncertainty"] = {**self.uncertainty, **no_order}
        return values


class _Words(Formatter):
    """Formats texts with values by name, see the docstring of the module."""

    def __init__(self, values: Plain) -> None:
        self.values = values

    def known(self, name: str) -> Any:
        """Return a value by name, such as ``transfer[points]``; None if it is not known."""
        try:
            return self.get_field(name, (), self.values)[0] if name else True
        except (KeyError, TypeError):
            return None

    def written(self, text: str, more: Plain) -> str:
        """Return a text with all its values, and `more` of them."""
        return self.vformat(text, (), self.values | more)

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value as text: a dash for None, and the numbers of a list one by one."""
        if format_spec.startswith("?"):
            return format_spec[1:].split("|")[0 if value else 1]
        if isinstance(value, list | tuple):
            return ", ".join(self.format_field(one, format_spec) for one in value)
        if value is None:
            return "-"
        if format_spec.startswith("of "):
            return share(value, self.values[format_spec[3:]])
        number, space, unit = format_spec.partition(" ")
        return str(format(100.0 * value if unit else value, number)) + space + unit


def filled(table: RowTable, values: Plain) -> Rows:
    """Return labels and texts of the rows of a table whose values are known."""
    words, rows = _Words(values), Rows()
    for label, text, needs in table:
        needed = words.known(needs.lstrip("*!"))
        repeats: list[Plain]  # the further values of each time that the row is shown
        if not needs.startswith("*"):
            repeats = [{}] if needed is not None and bool(needed) != needs.startswith("!") else []
        elif isinstance(needed, dict):
            counts = {name.replace("_", " "): count for name, count in needed.items() if count}
            repeats = [{"name": name, "count": count} for name, count in counts.items()]
        else:
            repeats = [one if isinstance(one, dict) else {"text": one} for one in needed or ()]
        rows += [(words.written(label, one), words.written(text, one)) for one in repeats]
    return rows


def aligned(head: str, rows: Iterable[tuple[str, str]], notes: Iterable[object] = ()) -> str:
    """Return a summary: a headline, labelled rows, and notes.

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
    return fill(
        text, WIDTH, initial_indent=start, subsequent_indent=" " * len(start),
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def share(part: int, total: int) -> str:
    """Return a percentage, with a digit more where it is small; 100 % only where it is all."""
    percent = 100.0 * part / max(total, 1)
    if percent >= 99.5 and part < total:
        return f"all but {total - part:,}"
    return f"{percent:.0f} %" if percent >= 10 or percent == 0 else f"{percent:.1f} %"


def text_of(command: str, found: Figures) -> str:
    """Return the summary of a command as text."""
    head, rows = _TABLES[command]
    if isinstance(found, Summary):
        return aligned(_Words(vars(found)).written(head, {}), summary_rows(found), found.notes)
    s = found.as_dict()
    if command == "dsm":
        s |= {
            "all": s["width"] * s["height"], "is_bed": s["settings"]["surface"] == "bed",
            "is_tvu": s["what"] == "uncertainty",
            "crs_name": s["crs"] or "the cloud states none",
            "heights_name": s["heights"] or "the cloud states no vertical datum",
        }  # fmt: skip
    elif command == "rebuild":
        s |= {"count": len(s["rounds"]), "last": s["rounds"][-1]}
    elif command == "ortho":
        s["is_dry"] = s["water"] is None
    return aligned(_Words(s).written(head, {}), filled(rows, s))


def summary_rows(s: Summary, measured: Plain | None = None) -> Rows:
    """Return the facts of a correction, for the terminal and the report page.

    `measured` is the vertical uncertainty against a reference, `Comparison.tvu` in plain values.
    """
    detected, check = s.reconstruction, ""
    method = str(s.settings["method"])
    if detected is not None and detected.get("type", "") not in ("", method):
        how = "detected" if method == "auto" else "set by the user"
        sure = f"{how}, confidence {100.0 * detected['confidence']:.0f} %"
        method = f"{detected['method']}, {detected['type']} ({sure})"
    elif detected is not None and "type" not in detected:
        method = f"{detected['method']}. {detected['because']}"
    if s.fit is not None and s.cameras:
        check = "cameras match the cloud"
        if s.fit["problems"]:
            check = "cameras may not match the cloud; see the warnings"
        elif not s.fit["fits"]:
            check = "cameras and cloud could not be tested"
    corrected = f"{s.corrected:,} corrected ({share(s.corrected, s.submerged)})"
    return filled(_CORRECTED, vars(s) | {
        "corrected_words": "all corrected" if s.corrected == s.submerged else corrected,
        "method": method,
        "rays_per_point": s.rays / max(s.corrected, 1),
        "measured": measured,
        "order": order_sentence(s, measured),
        "check": check,
    })  # fmt: skip


# Of the standard deviations of a budget.
_UNITS = {"image": " px", "index": "", "waves": " deg", "centre": " m", "attitude": " deg"}


def formal_words(s: Summary) -> str:
    """Return what the standard errors of a run rest on, as ``image 0.5 px, level 0.020 m`` ...

    Where the user stated no standard deviation of the level, it is that of a fit, if there was one.
    """
    if s.settings["method"] == "regression":
        return "the scatter of check depths about the line, where it was not fitted to them"
    level, source = s.settings["sigma_level"], ""
    if level is None:
        fitted = (s.water_fit or {}).get("sigma_level_m")
        is_fitted = fitted is not None and np.isfinite(fitted)
        level, source = (fitted, " (fitted)") if is_fitted else (LEVEL_M, " (assumed)")
    words = f"Assumed standard deviations: level {level:.3f} m{source}"
    for name, unit in _UNITS.items():
        if value := s.settings[f"sigma_{name}"]:
            words += f", {name} {value:g}{unit}"
    known = s.uncertainty or {}
    if (found := known.get("of_cloud")) is not None:
        words += (
            f". Estimated from the cloud: matching noise {found['scatter_m']:.3f} m, model"
            f" uncertainty {100.0 * found['per_depth']:.1f} % of depth"
        )
    poses_m = known.get("poses_m")
    return words if poses_m is None else f"{words}. Adjusted poses: {poses_m:.3f} m"


def details_text(s: Summary) -> str:
    """Return the evidence for the reconstruction type, and the error budget."""
    found = [] if s.reconstruction is None else [s.reconstruction["because"]]
    found += [] if s.uncertainty is None else [f"{formal_words(s)}."]
    return "\n".join(wrapped("", one) for one in found)


def order_sentence(s: Summary, measured: Plain | None = None) -> str:
    """Return which order of S-44 the errors of a run allow, or why none is claimed.

    `measured` is `Comparison.tvu` in plain values; without it the standard errors decide. Empty
    where neither is known.
    """
    if measured is not None and measured["count"] < FEWEST:
        return f"fewer than {FEWEST} points were measured, too few for an order"
    if measured is None and s.uncertainty is not None and s.why_no_order:
        return f"no order claimed: {s.why_no_order}"
    known = measured or s.uncertainty
    return "" if known is None else tvu_sentence(known)


def tvu_sentence(uncertainty: Plain) -> str:
    """Return the strictest order of S-44 whose TVU 95 % of the points keep, in words."""
    shares = uncertainty["s44"]
    order = next((one.name for one in ORDERS if shares[one.name] >= 0.95), None)
    if order is None:
        within = 100.0 * shares[ORDERS[-1].name]
        return f"no order: {within:.0f} % of the points are within the TVU of order 2"
    name = f"Order {order}" if order[0].isdigit() else f"{order} Order"
    return f"{name} ({100.0 * shares[order]:.4g} % of the points are within its TVU)"
