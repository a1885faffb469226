"""The report of an adjustment: its summary as text, and its page with tables and pictures.

All words are made of the plain values of `adjustment_dict`, so that a resumed run has them too.
"""

from __future__ import annotations

import numpy as np

from pcfix.adjust.block import words_of
from pcfix.adjust.problem import Intersected
from pcfix.adjust.result import Adjusted, Plain, adjustment_dict, before_of
from pcfix.grid.colours import DEPTH, DIFFERENCE, RAYS, UNCERTAINTY
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.model import FloatArray
from pcfix.report.adjustment_figures import pictures_of
from pcfix.report.map_data import Layer
from pcfix.report.page import Report, Table, render
from pcfix.report.text import Rows, RowTable, filled, share

__all__ = ["adjustment_dict", "adjustment_page", "adjustment_text", "before_of"]

WHERE = (("land", "on land"), ("water", "under water"))
MOST_LISTED = 12
"""Surveyed points in the text; the page has all of them."""
_FACTS: RowTable = (
    ("images", "{images:,}, {poses_words}", "images"),
    ("points", "{points[all]:,}: {points[land]:,} on land, {points[water]:,} under water{counted}",
     "points"),
    ("observations", "{o[used]:,} {kind} used, {o[left_out]:,} left out ({o_share}){outside}", "o"),
    ("sigma0", "{sigma0:.3f}, redundancy {redundancy:,}, {rounds} rounds, {steps} steps{undone}",
     "images"),
    ("water", "{water[surface]}", "has_shape"),
    ("lens", "fixed", "lens_is_fixed"),
    ("{label}", "{before:.6g} -> {after:.6g}{unit} ({added:+.3g}, standard error {sigma:.2g})",
     "*unknowns"),
    ("{label}", "{added:+.3g}{unit} (standard error {sigma:.2g})", "*motions"),
    ("water", "none{refracts}", "no_water"),
    ("port", "--port {port_found[port]}", "has_port_unknowns"),
    ("{label}", "{after:.6g}{unit}, fixed", "*held"),
    ("on {surface}", "{points:,} marked points, distance RMS {rms_m:z.4f} m (given {sigma_m:g} m),"
     " largest {largest_m:z.4f} m ({largest_point}){parallel_to}", "*on_surfaces"),
    ("poses", "RMS movement of the centres {poses[moved_rms_m]:.3f} m", "moved"),
    ("", "mean east, north, up {poses[moved_mean_m]:+z.3f} m, largest"
     " {poses[moved_largest_m]:.3f} m ({poses[moved_largest_image]}); RMS rotation"
     " {poses[turned_rms_deg]:.4f} deg", "moved"),
    ("precision", "standard errors of centres X, Y, Z: mean {precision[centre_mean_m]:z.4f} m,"
     " largest {precision[centre_largest_m]:z.4f} m; of angles: mean"
     " {precision[angle_mean_deg]:z.4f} deg, largest {precision[angle_largest_deg]:z.4f} deg",
     "is_precise"),
    ("GNSS", "{gnss[images]:,} images. Centres minus GNSS east, north, up: mean"
     " {gnss[mean_m]:+z.3f} m, RMS {gnss[rms_m]:z.3f} m, largest {gnss[largest_m]:z.3f} m"
     " ({gnss[largest_image]}); RMS before {gnss[rms_before_m]:z.3f} m", "gnss"),
    ("{role} points", "{count}, adjusted minus surveyed X, Y, Z: mean {mean_m:+z.3f} m, RMS"
     " {rms_m:z.3f} m, {rms_px:z.2f} {image_unit}", "*surveyed"),
)  # fmt: skip


def fixed(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number with a fixed number of digits; a dash if it is unknown."""
    return "-" if value is None else f"{value:{sign}z.{digits}f}"  # z: a zero has no minus sign


def all_notes(d: Plain) -> list[str]:
    """Return the messages of all warnings."""
    return [note["message"][:1].upper() + note["message"][1:] for note in d["notes"]]


def _residuals(d: Plain) -> str:
    """Return the RMS residuals on land and under water; empty without any."""
    known = [(where, d["residuals"][key]["rms_px"]) for key, where in WHERE]
    unit = d["image_unit"]
    return " and ".join(f"{rms:.2f} {unit} {where}" for where, rms in known if rms is not None)


def adjustment_sentence(d: Plain) -> str:
    """Return an adjustment in half a line."""
    residuals = _residuals(d)
    parts = [f"centres moved {fixed(d['poses']['moved_rms_m'], 3)} m (rms)"]
    parts += [f"residuals {residuals}"] if residuals else []
    for row in d["lens"][:1]:
        if row["name"] == "f":
            words = f"focal length {row['before']:.6g} -> {row['after']:.6g} {d['image_unit']}"
            parts.insert(0, words)
    return ", ".join(parts)


def adjustment_text(adjusted: Adjusted, before: Intersected | None = None) -> str:
    """Return the summary of an adjustment as text.

    `before` is of `before_of`, for the residuals before.
    """
    d = adjustment_dict(adjusted, before)
    surveyed = _survey_table(d)
    lines = [f"{label:<18} {words}" for label, words in _facts(d)] + _residual_table(d).lines()
    lines += surveyed.lines()[: 1 + MOST_LISTED] if surveyed.rows else []
    return "\n".join([*lines, *(f"Note: {note}" for note in all_notes(d))])


def adjustment_page(adjusted: Adjusted, before: Intersected | None = None) -> str:
    """Return the report of an adjustment as one self-contained HTML page.

    With `before`, of `before_of`, residuals and points before are shown too.
    """
    d = adjustment_dict(adjusted, before)
    maps, layers = _map(adjusted, before)
    how = "without refraction" if d["water"] is None else "with refraction at the water"
    lead = (
        f"{d['images']:,} images and {d['points']['all']:,} points were adjusted"
        f" {'with refraction at the housing port' if d['port'] else how};"
        f" {d['observations']['used']:,} observations fit within {_residuals(d)} (RMS of a"
        " coordinate)."
    )
    tables = [_residual_table(d), _survey_table(d), _correlation_table(d)]
    report = Report(
        title="Refractive bundle adjustment",
        lead=lead,
        head=_fact_table(d),
        warnings=all_notes(d),
        maps=maps,
        layers=layers,
        pictures=pictures_of(d, adjusted, before),
        tables=[table for table in tables if table.rows],
    )
    return render(report)


def adjustment_tables(d: Plain, page: str) -> list[Table]:
    """Return what an adjustment changed, for the page of a run, with a link to its own page."""
    from markupsafe import Markup

    facts = _fact_table(d)
    rows: list[list[str]] = [["Note", note] for note in all_notes(d)]
    rows.append(["All of it", Markup('<a href="{0}">{0}</a>').format(page)])
    title = "Refractive bundle adjustment"
    return [Table(title, [], [*facts.rows, *rows]), _residual_table(d)]


# Facts


def _facts(d: Plain) -> Rows:
    """Return labels and values of the summary."""
    n, o, water, port = d["points"], d["observations"], d["water"], d["port_found"] or {}
    counts = [(n[key], key.replace("_", " ")) for key in ("left_out", "control", "check")]
    kinds = {"tie points": "measured tie points", "cloud": "points of the cloud in original images"}
    outside = f", {o['out_of_sight']:,} outside their image" if o["out_of_sight"] else ""
    unknowns, held = [_lens_row(d, row) for row in d["lens"]], []
    for name, row in (water or port).items():
        if isinstance(row, dict):
            named = _named(name) | row | {"added": row["after"] - row["before"]}
            # a level surface has no tilt to show
            if row["free"]:
                unknowns.append(named)
            elif not (name.startswith("tilt") and row["after"] == 0.0):
                held.append(named)
    motions = []
    if d["poses_are"] == "similarity" and d["precision"] is not None:
        motions = [_named(row["name"]) | row for row in d["precision"]["shared"][-7:]]
    parallel, is_free = d["unknowns"]["parallel"], d["poses_are"] != "fixed"
    surfaces = []
    for one in d["on_surfaces"]:
        others = ", ".join(name for name in parallel if name != one["surface"])
        is_parallel = one["surface"] in parallel
        surfaces.append(one | {"parallel_to": f"; parallel to {others}" if is_parallel else ""})
    return filled(_FACTS, d | {
        "poses_words": _poses_words(d), "o": o, "kind": kinds[d["source"]], "outside": outside,
        "counted": "".join(f", {count:,} {key}" for count, key in counts if count),
        "o_share": share(o["left_out"], o["used"] + o["left_out"]),
        "undone": "; adjustment without water undone" if d["source"] == "cloud" else "",
        "has_shape": water is not None and not water["surface"].startswith("level"),
        "lens_is_fixed": not d["lens"], "unknowns": unknowns, "motions": motions, "held": held,
        "no_water": water is None, "has_port_unknowns": len(port) > 1,
        "refracts": ", a housing port refracts" if d["port"] else "",
        "on_surfaces": surfaces,
        "moved": is_free and d["poses"]["moved_rms_m"],
        "is_precise": is_free and d["precision"] is not None and d["precision"]["images"],
        "surveyed": [
            {"role": role, "count": len(d[role]["points"]), **d[role]}
            for role in ("control", "check") if d[role] is not None
        ],
    })  # fmt: skip


def _poses_words(d: Plain) -> str:
    held = f", {d['images_fixed']:,} of them fixed" if d["images_fixed"] else ""
    network = ", a free network" if d["unknowns"]["free_network"] else ""
    return {
        "free": f"poses free{held}{network}", "fixed": "poses fixed",
        "similarity": "shifted, turned and scaled together",
    }[d["poses_are"]]  # fmt: skip


def _named(name: str) -> Plain:
    """Return label and unit of a shared unknown."""
    return dict(zip(("label", "unit"), words_of(name), strict=True))


def _lens_row(d: Plain, row: Plain) -> Plain:
    """Return a free parameter of a lens with its label and unit."""
    label, _ = words_of(row["name"])
    if len({one["sensor"] for one in d["lens"]}) > 1:
        label += f", {row['sensor']}, {row['images']:,} images"
    label += f", first of {row['lenses']} lenses" if row["lenses"] > 1 else ""
    is_in_pixels = row["name"] in ("f", "cx", "cy", "b1", "b2")
    unit = f" {d['image_unit']}" if is_in_pixels else ""
    return row | {"label": label, "unit": unit, "added": row["after"] - row["before"]}


def _fact_table(d: Plain) -> Table:
    rows = [[label[:1].upper() + label[1:], words] for label, words in _facts(d)]
    return Table("In short", [], rows)


# Maps


def _map(a: Adjusted, before: Intersected | None) -> tuple[Maps, list[Layer]]:
    """Return maps of the points, averaged in cells."""
    unit = (a.block.cameras.lenses or ())[0].unit
    heights, depth = _means(a, a.xyz[:, 2]), a.depth_m()
    layers = [Layer("Height", "m", heights.height_m)]
    if depth is not None and a.is_wet.any():
        under = np.where(a.is_wet, depth, np.nan)
        layers.append(Layer("Depth", "m", _means(a, under).height_m, DEPTH))
    if before is not None:
        higher = _means(a, a.xyz[:, 2] - before.xyz[:, 2]).height_m
        layers.append(Layer("Change in height", "m", higher, DIFFERENCE, is_centred=True))
    # mean squared residual of a coordinate of each point
    rows = a.used & np.isfinite(a.residual_px).all(axis=1)
    owner, m = a.block.owner[rows], len(a.xyz)
    count = np.bincount(owner, minlength=m)
    total = np.bincount(owner, (a.residual_px[rows] ** 2).mean(axis=1), m)
    squares: FloatArray = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    layers.append(Layer("Residual", unit, np.sqrt(_means(a, squares).height_m), UNCERTAINTY))
    images = np.bincount(a.block.owner[a.used], minlength=m).astype(np.float64)
    return heights, [*layers, Layer("Images", "", _means(a, images).height_m, RAYS)]


def _means(a: Adjusted, values: FloatArray) -> Maps:
    """Return maps whose heights are means of some values of the points."""
    plan = a.xyz[a.is_observed, :2]
    builder = MapsBuilder(plan.min(axis=0), plan.max(axis=0), len(plan))
    known = np.isfinite(values) & a.is_observed
    builder.add(np.column_stack([a.xyz[known, :2], values[known]]))
    return builder.maps()


# Tables


def _correlation_table(d: Plain) -> Table:
    p = d["precision"] or {"shared": [], "correlation": []}
    names = [row["name"].replace("_", " ") for row in p["shared"]]
    rows = [
        [name, *(fixed(value, 3, "+") for value in row)]
        for name, row in zip(names, p["correlation"], strict=True)
    ]
    return Table("Correlations of the shared unknowns", ["", *names], rows if len(rows) > 1 else [])


def _survey_table(d: Plain) -> Table:
    """Return surveyed points, adjusted minus surveyed."""
    header = ["surveyed points", "role", "dX (m)", "dY (m)", "dZ (m)", f"RMS ({d['image_unit']})"]
    rows = [
        [
            row["name"], role, *(fixed(row[key], 3, "+") for key in ("dx_m", "dy_m", "dz_m")),
            fixed(row["rms_px"], 2), str(row["images"]),
        ]
        for role in ("control", "check")
        for row in (d[role] or {"points": []})["points"]
    ]  # fmt: skip
    return Table("Control and check points", [*header, "images"], rows)


def _residual_table(d: Plain) -> Table:
    """Return residuals and precision on land and under water, as in Mulsow 2024."""
    unit = d["image_unit"]
    header = [
        "residuals", "points", "observations", f"before ({unit})", f"RMS ({unit})",
        f"x / y ({unit})", "RMS (m)", "sigma X (m)", "sigma Y (m)", "sigma Z (m)",
    ]  # fmt: skip
    rows = [
        [
            where, f"{r['points']:,}", f"{r['observations']:,}",
            fixed(r["rms_before_px"], 3), fixed(r["rms_px"], 3),
            " / ".join(fixed(value, 3) for value in r["rms_xy_px"]), fixed(r["rms_m"], 4),
            *(fixed(value, 4) for value in r["sigma_xyz_m"] or [None] * 3),
        ]
        for key, where in WHERE
        if (r := d["residuals"][key])["points"]
    ]  # fmt: skip
    return Table("Residuals and precision on land and under water", header, rows)
