"""The report of an adjustment: its summary as text, and its page with tables and pictures.

All words are made of the plain values of `adjustment_dict`, so that a resumed run has them too.
"""

from __future__ import annotations

import numpy as np

from pcfix.adjust.block import MOTIONS
from pcfix.adjust.problem import Intersected
from pcfix.adjust.result import Adjusted, Plain, adjustment_dict, before_of
from pcfix.grid.colours import DEPTH, DIFFERENCE, RAYS, UNCERTAINTY
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.model import FloatArray
from pcfix.report.adjustment_figures import pictures_of
from pcfix.report.map_data import Layer
from pcfix.report.page import Report, Table, render
from pcfix.report.text import Rows, filled, share

__all__ = ["adjustment_dict", "adjustment_page", "adjustment_text", "before_of"]

WHERE = (("land", "on land"), ("water", "under water"))
MOST_LISTED = 12
"""Surveyed points in the text; the page has all of them."""
_LENS = {"f": "focal length", "cx": "principal x", "cy": "principal y"}
_WATER = {
    "level": ("water level", "m"), "tilt_x": ("tilt east", ""), "tilt_y": ("tilt north", ""),
    "index": ("index", ""), "shape_xx": ("shape x^2", "/m"), "shape_xy": ("shape x y", "/m"),
    "shape_yy": ("shape y^2", "/m"), "distance": ("port distance", "m"),
    "centre_x": ("dome centre x", "m"), "centre_y": ("dome centre y", "m"),
    "centre_z": ("dome centre z", "m"),
}  # fmt: skip
_COUNTS = (
    ("images", "{images:,}, {poses_words}", "images"),
    ("points", "{points[all]:,}: {points[land]:,} on land, {points[water]:,} under water{counted}",
     "points"),
    ("observations", "{o[used]:,} {kind} used, {o[left_out]:,} left out ({o_share}){outside}", "o"),
    ("sigma0", "{sigma0_words}, redundancy {redundancy:,}, {rounds_count} rounds, {steps}"
     " steps{undone}", "images"),
    ("water", "{water[surface]}", "has_shape"),
)  # fmt: skip
_ACCURACY = (
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


# Numbers and words


def fixed(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number with a fixed number of digits; a dash if it is unknown."""
    return "-" if value is None else f"{value:{sign}z.{digits}f}"  # z: a zero has no minus sign


def short(value: float, sigma: float | None, sign: str = "") -> str:
    """Return a number with the digits that its standard error justifies, two at least."""
    if sigma is None or not sigma > 0.0:
        return f"{value:{sign}.6g}"
    digits = int(np.clip(np.ceil(np.log10(2.0 / sigma)), 2, 9))
    return f"{value:{sign}.{digits}f}"


def all_notes(d: Plain) -> list[str]:
    """Return the messages of all warnings."""
    return [note["message"][:1].upper() + note["message"][1:] for note in d["notes"]]


def _residuals(d: Plain) -> str:
    """Return the RMS residuals on land and under water; empty without any."""
    known = [(where, d["residuals"][key]["rms_px"]) for key, where in WHERE]
    unit = d["image_unit"]
    return " and ".join(
        f"{fixed(rms, 2)} {unit} {where}" for where, rms in known if rms is not None
    )


def adjustment_sentence(d: Plain) -> str:
    """Return an adjustment in half a line."""
    row = next((one for one in d["lens"][:1] if one["name"] == "f"), None)
    parts = [f"centres moved {fixed(d['poses']['moved_rms_m'], 3)} m (rms)"]
    if row is not None:
        before, after, _ = _change(row)
        parts.insert(0, f"focal length {before} -> {after} {d['image_unit']}")
    residuals = _residuals(d)
    return ", ".join([*parts, *([f"residuals {residuals}"] if residuals else [])])


def adjustment_text(adjusted: Adjusted, before: Intersected | None = None) -> str:
    """Return the summary of an adjustment as text.

    `before` is of `before_of`, for the residuals before.
    """
    d = adjustment_dict(adjusted, before)
    surveyed = _survey_table(d)
    lines = [f"{label:<14} {words}" for label, words in _facts(d)] + _residual_table(d).lines()
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
    report = Report(
        title="Refractive bundle adjustment",
        lead=lead,
        head=_fact_table(d),
        warnings=all_notes(d),
        maps=maps,
        layers=layers,
        pictures=pictures_of(d, adjusted, before),
        tables=_tables(d),
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


def _poses_are(d: Plain) -> str:
    held = f", {d['images_fixed']:,} of them fixed" if d["images_fixed"] else ""
    network = ", a free network" if d["unknowns"]["free_network"] else ""
    return {
        "free": f"poses free{held}{network}", "fixed": "poses fixed",
        "similarity": "shifted, turned and scaled together",
    }[d["poses_are"]]  # fmt: skip


def _facts(d: Plain) -> Rows:
    """Return labels and values of the summary."""
    n, o, rounds, precision = d["points"], d["observations"], d["rounds"], d["precision"]
    counts = [(n[key], key.replace("_", " ")) for key in ("left_out", "control", "check")]
    kinds = {"tie points": "measured tie points", "cloud": "points of the cloud in original images"}
    outside = f", {o['out_of_sight']:,} outside their image" if o["out_of_sight"] else ""
    has_shape = d["water"] is not None and not d["water"]["surface"].startswith("level")
    rows = filled(_COUNTS, d | {
        "poses_words": _poses_are(d), "o": o, "kind": kinds[d["source"]], "outside": outside,
        "counted": "".join(f", {count:,} {key}" for count, key in counts if count),
        "o_share": share(o["left_out"], o["used"] + o["left_out"]),
        "sigma0_words": fixed(d["sigma0"], 3), "rounds_count": len(rounds),
        "steps": sum(row["steps"] for row in rounds), "has_shape": has_shape,
        "undone": "; adjustment without water undone" if d["source"] == "cloud" else "",
    })  # fmt: skip
    rows += [] if d["lens"] else [("lens", "fixed")]
    for label, row, unit in _unknowns(d):
        unit = f" {unit}" if unit else ""
        error = "" if row["sigma"] is None else f"standard error {row['sigma']:.2g}"
        if "added" in row:
            rows.append((label, f"{short(row['added'], row['sigma'], '+')}{unit} ({error})"))
            continue
        before, after, change = _change(row)
        change += f", {error}" if error else ""
        rows.append((label, f"{before} -> {after}{unit} ({change})"))
    if d["water"] is None:
        rows.append(("water", "none, a housing port refracts" if d["port"] else "none"))
        if len(d["port_found"] or {}) > 1:
            rows.append(("port", f"--port {d['port_found']['port']}"))
    for key, (label, unit) in _WATER.items():  # a level surface has no tilt to show
        v = (d["water"] or d["port_found"] or {}).get(key)
        if v is not None and not v["free"] and not (key.startswith("tilt") and v["after"] == 0.0):
            rows.append((label, f"{v['after']:.6g}{f' {unit}' if unit else ''}, fixed"))
    parallel, is_free = d["unknowns"]["parallel"], d["poses_are"] != "fixed"
    others = {name: ", ".join(one for one in parallel if one != name) for name in parallel}
    return rows + filled(_ACCURACY, d | {
        "on_surfaces": [
            one | {"parallel_to": f"; parallel to {others[name]}" if others.get(name) else ""}
            for one in d["on_surfaces"] for name in [one["surface"]]
        ],
        "moved": is_free and d["poses"]["moved_rms_m"],
        "is_precise": is_free and precision is not None and precision["images"],
        "surveyed": [
            {"role": role, "count": len(d[role]["points"]), **d[role]}
            for role in ("control", "check") if d[role] is not None
        ],
    })  # fmt: skip


def _fact_table(d: Plain) -> Table:
    rows = [
        # k1 and the other coefficients keep their small letters
        [label if label[1:].isdigit() else label[:1].upper() + label[1:], words]
        for label, words in _facts(d)
    ]
    return Table("In short", [], rows)


def _change(row: Plain) -> list[str]:
    """Return a value before and after, and the difference."""
    before, after, sigma = row["before"], row["after"], row["sigma"]
    return [short(before, sigma), short(after, sigma), short(after - before, sigma, "+")]


def _unknowns(d: Plain) -> list[tuple[str, Plain, str]]:
    """Return label, values and unit of what was free of lens, water, port and similarity."""
    several = len({row["sensor"] for row in d["lens"]}) > 1
    rows = []
    for row in d["lens"]:
        label = str(_LENS.get(row["name"], row["name"]))
        label += f", {row['sensor']}, {row['images']:,} images" if several else ""
        label += f", first of {row['lenses']} lenses" if row["lenses"] > 1 else ""
        in_pixels = row["name"] in ("f", "cx", "cy", "b1", "b2")
        rows.append((label, row, str(d["image_unit"]) if in_pixels else ""))
    found = d["water"] or d["port_found"] or {}
    for key, (label, unit) in _WATER.items():
        if (value := found.get(key)) is not None and value["free"]:
            rows.append((label, value, unit))
    if d["poses_are"] == "similarity" and d["precision"] is not None:
        shared = {row["name"]: row for row in d["precision"]["shared"]}
        units = {"shift": "m", "turn": "rad", "scale": ""}
        rows += [(name, shared[name], units[name.partition(" ")[0]]) for name in MOTIONS]
    return rows


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


def _tables(d: Plain) -> list[Table]:
    """Return the tables that have rows, residuals first."""
    unit, p = d["image_unit"], d["precision"]
    tables = [_residual_table(d), _survey_table(d)]
    shared = [] if p is None else [row["name"].replace("_", " ") for row in p["shared"]]
    if len(shared) > 1:
        rows = [
            [name, *(fixed(value, 3, "+") for value in row)]
            for name, row in zip(shared, p["correlation"], strict=True)
        ]
        tables.append(Table("Correlations of the shared unknowns", ["", *shared], rows))

    rows = [
        [
            str(row["round"]), str(row["steps"]), f"{row['observations']:,}",
            fixed(row["cost"], 1), fixed(row["rms_px"], 4),
        ]
        for row in d["rounds"]
    ]  # fmt: skip
    header = ["round", "steps", "observations", "cost", f"RMS ({unit})"]
    return [table for table in [*tables, Table("Rounds", header, rows)] if table.rows]


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
