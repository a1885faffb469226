"""The report of an adjustment: its summary as text, and its page with tables and pictures.

All words are made of the plain values of `adjustment_dict`, so that a resumed run has them too.
"""

from __future__ import annotations

import math

import numpy as np

from pcfix.adjust.block import words_of
from pcfix.adjust.problem import Intersected
from pcfix.adjust.result import Adjusted, Plain, adjustment_dict
from pcfix.grid.colours import DIFFERENCE, UNCERTAINTY
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.model import FloatArray
from pcfix.report.page import Layer, Picture, Report, Table, label_plan, new_figure, render
from pcfix.report.text import Rows, RowTable, aligned, filled, share, wrapped
from pcfix.sums import nice_step

MOST_POINTS = 6000
ARROW = 0.07
"""Length of a large arrow, as a share of the longer side of the block."""

WHERE = (("land", "on land"), ("water", "under water"))
MOST_LISTED = 12
"""Surveyed points in the text; the page has all of them."""
_FACTS: RowTable = (
    ("images", "{images:,}, {poses_words}", "images"),
    ("points", "{points[all]:,}: {points[land]:,} on land, {points[water]:,} under water",
     "points"),
    ("observations", "{o[used]:,} {kind} used, {o[left_out]:,} excluded ({o_share})", "o"),
    ("sigma0", "{sigma0:.3f}, redundancy {redundancy:,}, {rounds} rounds, {steps} steps", "images"),
    ("water", "{water[surface]}", "has_shape"),
    ("lens", "fixed", "lens_is_fixed"),
    ("{label}", "{before} -> {after}{unit} ({added}, standard error {sigma:.2g})", "*unknowns"),
    ("{label}", "{added:+.3g}{unit} (standard error {sigma:.2g})", "*motions"),
    ("water", "none", "no_water"),
    ("port", "--port {port_found[port]}", "port"),
    ("{label}", "{after:.6g}{unit}, fixed", "*held"),
    ("on {surface}", "{points:,} marked points, distance RMS {rms_m:z.4f} m (given {sigma_m:g} m)",
     "*on_surfaces"),
    ("poses", "centres moved by {poses[moved_rms_m]:.3f} m RMS", "moved"),
    ("", "mean (east, north, up) {poses[moved_mean_m]:+z.3f} m, largest"
     " {poses[moved_largest_m]:.3f} m ({poses[moved_largest_image]}); images rotated by"
     " {poses[turned_rms_deg]:.4f} deg RMS", "moved"),
    ("standard errors", "of centres (X, Y, Z): mean {precision[centre_mean_m]:z.4f} m, largest"
     " {precision[centre_largest_m]:z.4f} m", "is_precise"),
    ("", "of angles (about x, y, z of the camera): mean {precision[angle_mean_deg]:z.4f} deg,"
     " largest {precision[angle_largest_deg]:z.4f} deg", "is_precise"),
    ("GNSS", "{gnss[images]:,} images. Centres minus GNSS (east, north, up): mean"
     " {gnss[mean_m]:+z.3f} m, RMS {gnss[rms_m]:z.3f} m (before {gnss[rms_before_m]:z.3f} m);"
     " largest distance {gnss[largest_m]:z.3f} m ({gnss[largest_image]})", "gnss"),
    ("{role} points", "{count}. Adjusted minus surveyed (X, Y, Z): mean {mean_m:+z.3f} m, RMS"
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
    """Return an adjustment in a line."""
    facts = [f"{label}: {text}" for label, text in _facts(d) if label in ("focal length", "poses")]
    return "; ".join([*facts, f"residuals: {_residuals(d)}"])


def adjustment_text(d: Plain) -> str:
    """Return the summary of an adjustment as text."""
    surveyed = _survey_table(d)
    rows = [(label[:1].upper() + label[1:], words) for label, words in _facts(d)]
    lines = [aligned("Refractive bundle adjustment", rows), "", *_residual_table(d).lines()]
    lines += ["", *surveyed.lines()[: 1 + MOST_LISTED]] if surveyed.rows else []
    return "\n".join([*lines, *(wrapped("", f"Note: {note}") for note in all_notes(d))])


def adjustment_page(adjusted: Adjusted, before: Intersected) -> str:
    """Return the report of an adjustment as one self-contained HTML page.

    `before` are residuals and points before, of `before_of`.
    """
    d = adjustment_dict(adjusted, before)
    (maps, layers), picture = _map(adjusted, before), block_picture(d, adjusted)
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
        pictures=[] if picture is None else [picture],
        tables=[table for table in tables if table.rows],
    )
    return render(report)


def adjustment_tables(d: Plain, page: str) -> list[Table]:
    """Return what an adjustment changed, for the page of a run, with a link to its own page."""
    from markupsafe import Markup

    facts = _fact_table(d)
    rows: list[list[str]] = [["Note", note] for note in all_notes(d)]
    rows.append(["Full report", Markup('<a href="{0}">{0}</a>').format(page)])
    title = "Refractive bundle adjustment"
    return [Table(title, [], [*facts.rows, *rows]), _residual_table(d)]


# Facts


def _facts(d: Plain) -> Rows:
    """Return labels and values of the summary."""
    o, water, is_free = d["observations"], d["water"], d["poses_are"] != "fixed"
    kinds = {"tie points": "measured tie points", "cloud": "points of the cloud in original images"}
    unknowns, held = [_lens_row(d, row) for row in d["lens"]], []
    for name, row in (water or d["port_found"] or {}).items():
        if isinstance(row, dict):
            named = _named(name) | row
            # a level surface has no tilt to show
            if row["free"]:
                unknowns.append(named | _change(row))
            elif not (name.startswith("tilt") and row["after"] == 0.0):
                held.append(named)
    motions = []
    if d["poses_are"] == "similarity":
        motions = [_named(row["name"]) | row for row in d["precision"]["shared"][-7:]]
    return filled(_FACTS, d | {
        "poses_words": _poses_words(d), "o": o, "kind": kinds[d["source"]],
        "o_share": share(o["left_out"], o["used"] + o["left_out"]),
        "has_shape": water is not None and not water["surface"].startswith("level"),
        "lens_is_fixed": not d["lens"], "unknowns": unknowns, "motions": motions, "held": held,
        "no_water": water is None,
        "moved": is_free and d["poses"]["moved_rms_m"],
        "is_precise": is_free and d["precision"]["images"],
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
        "similarity": "poses shifted, rotated and scaled together",
    }[d["poses_are"]]  # fmt: skip


def _named(name: str) -> Plain:
    """Return label and unit of a shared unknown."""
    return dict(zip(("label", "unit"), words_of(name), strict=True))


def _lens_row(d: Plain, row: Plain) -> Plain:
    """Return a free parameter of a lens with its label and unit."""
    label, _ = words_of(row["name"])
    if len({one["sensor"] for one in d["lens"]}) > 1:
        label += f", {row['sensor']}"
    unit = f" {d['image_unit']}" if row["name"] in ("f", "cx", "cy", "b1", "b2") else ""
    return row | {"label": label, "unit": unit} | _change(row)


def _change(row: Plain) -> Plain:
    """Return an unknown before and after and its change, to two digits of its standard error."""
    before, after, sigma = row["before"], row["after"], row["sigma"]
    values = {"before": (before, ""), "after": (after, ""), "added": (after - before, "+")}
    if not sigma:
        return {name: f"{value:{sign}.6g}" for name, (value, sign) in values.items()}
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return {name: fixed(value, digits, sign) for name, (value, sign) in values.items()}


def _fact_table(d: Plain) -> Table:
    rows = [[label[:1].upper() + label[1:], words] for label, words in _facts(d)]
    return Table("In short", [], rows)


# Map


def _map(a: Adjusted, before: Intersected) -> tuple[Maps, list[Layer]]:
    """Return the heights of the points and what changed, averaged in cells."""
    plan = a.xyz[a.is_observed, :2]

    def means(values: FloatArray) -> Maps:
        """Return maps whose heights are means of some values of the points."""
        builder = MapsBuilder(plan.min(axis=0), plan.max(axis=0), len(plan))
        known = np.isfinite(values) & a.is_observed
        builder.add(np.column_stack([a.xyz[known, :2], values[known]]))
        return builder.maps()

    # mean squared residual of a coordinate of each point
    rows, heights = a.used & np.isfinite(a.residual_px).all(axis=1), means(a.xyz[:, 2])
    owner, square = a.block.owner[rows], (a.residual_px[rows] ** 2).mean(axis=1)
    count, total = (np.bincount(owner, w, len(a.xyz)) for w in (None, square))
    squares = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    unit, higher = (a.block.cameras.lenses or ())[0].unit, a.xyz[:, 2] - before.xyz[:, 2]
    return heights, [
        Layer("Height", "m", heights.height_m),
        Layer("Change in height", "m", means(higher).height_m, DIFFERENCE, is_centred=True),
        Layer("Residual", unit, np.sqrt(means(squares).height_m), UNCERTAINTY),
    ]


# Tables


def _correlation_table(d: Plain) -> Table:
    p = d["precision"]
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


# Picture


def block_picture(d: Plain, a: Adjusted) -> Picture | None:
    """Draw how far the projection centres moved, and their differences from GNSS, as arrows."""
    moved, off = a.cameras.centres - a.block.cameras.centres, a.gnss_residual_m
    shown: list[tuple[str, FloatArray]] = []
    if d["poses_are"] != "fixed":
        shown.append(("Movement of the projection centres", moved))
    if np.isfinite(off).any():
        shown.append(("Adjusted minus GNSS", off))
    if not shown:
        return None
    size, n = np.ptp(a.block.cameras.centres[:, :2], axis=0), len(shown)
    share = float(np.clip(size[1] / max(size[0], 1e-9), 0.25, 1.2))
    figure, panels = new_figure(8.0, n * (5.2 * share + 1.4), nrows=n, squeeze=False)
    xyz = a.xyz[a.is_observed]
    xyz = xyz[:: max(1, len(xyz) // MOST_POINTS)]
    side = float(max(np.ptp(a.cameras.centres[:, :2], axis=0).max(), 1e-3))
    for axes, (title, vectors) in zip(panels.ravel(), shown, strict=True):
        # in plan as arrows, in height as colour
        axes.plot(*xyz[:, :2].T, ".", color="0.85", markersize=1.5, zorder=1)
        rows = np.isfinite(vectors).any(axis=1)
        (x, y, _), (dx, dy, up) = a.cameras.centres[rows].T, np.nan_to_num(vectors[rows]).T
        key = nice_step(max(float(np.percentile(np.hypot(dx, dy), 95.0)), 1e-6) / 2.0)
        longer, reach = ARROW * side / key, max(float(np.abs(up).max()), 1e-6)
        arrows = axes.quiver(
            x, y, dx, dy, up, cmap=DIFFERENCE, scale=1.0 / longer, clim=(-reach, reach),
            edgecolor="0.3", linewidth=0.5, width=0.007, angles="xy", scale_units="xy", zorder=3,
        )  # fmt: skip
        axes.plot(x, y, "o", color="0.2", markersize=1.5, zorder=2)
        figure.colorbar(arrows, ax=axes, label="Up (m)", shrink=0.8)
        axes.quiverkey(arrows, 0.85, 1.05, key, f"{key:g} m", labelpos="E")
        axes.update_datalim(np.column_stack([x + longer * dx, y + longer * dy]))
        axes.margins(0.05)
        axes.autoscale_view()
        label_plan(axes)
        axes.set_title(title, loc="left", pad=12.0)
    alt = (
        "The block in plan. Enlarged arrows show how far each projection centre moved, and its"
        " difference from the GNSS position; their colour shows the vertical part."
    )
    return Picture("block", "Projection centres", alt, figure)
