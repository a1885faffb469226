"""The report of an adjustment: its summary as text, and its page with tables and pictures.

All words are made of the plain values of `adjustment_dict`, so that a resumed run has them too.
"""

from __future__ import annotations

import numpy as np

from pcfix.adjust.block import words_of
from pcfix.adjust.problem import Intersected
from pcfix.adjust.result import Adjusted, Plain, adjustment_dict
from pcfix.grid.colours import DIFFERENCE, UNCERTAINTY
from pcfix.grid.lattice import Lattice, lattice_over
from pcfix.model import FloatArray
from pcfix.report.page import Layer, Picture, Report, Table, label_plan, new_figure, render
from pcfix.report.text import Rows, RowTable, filled, share
from pcfix.sums import nice_step

MOST_POINTS = 6000
MOST_CELLS, POINTS_A_CELL = 360, 6.0
"""Of the longer side of the map, and of a cell at least: a sparse block has larger cells."""
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
    ("{label}", "{before:.6g} -> {after:.6g}{unit} ({added:+.3g}, standard error {sigma:.2g})",
     "*unknowns"),
    ("{label}", "{added:+.3g}{unit} (standard error {sigma:.2g})", "*motions"),
    ("water", "none", "no_water"),
    ("port", "--port {port_found[port]}", "port"),
    ("{label}", "{after:.6g}{unit}, fixed", "*held"),
    ("on {surface}", "{points:,} marked points, distance RMS {rms_m:z.4f} m (given {sigma_m:g} m)",
     "*on_surfaces"),
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
    """Return an adjustment in a line."""
    facts = [f"{label}: {text}" for label, text in _facts(d) if label in ("focal length", "poses")]
    return "; ".join([*facts, f"residuals: {_residuals(d)}"])


def adjustment_text(d: Plain) -> str:
    """Return the summary of an adjustment as text."""
    residuals, surveyed, _ = _tables(d)
    lines = [f"{label:<18} {words}" for label, words in _facts(d)] + residuals.lines()
    lines += surveyed.lines()[: 1 + MOST_LISTED] if surveyed.rows else []
    return "\n".join([*lines, *(f"Note: {note}" for note in all_notes(d))])


def adjustment_page(adjusted: Adjusted, before: Intersected) -> str:
    """Return the report of an adjustment as one self-contained HTML page.

    `before` are residuals and points before, of `before_of`.
    """
    d = adjustment_dict(adjusted, before)
    (lattice, layers), picture = _map(adjusted, before), block_picture(d, adjusted)
    how = "without refraction" if d["water"] is None else "with refraction at the water"
    lead = (
        f"{d['images']:,} images and {d['points']['all']:,} points were adjusted"
        f" {'with refraction at the housing port' if d['port'] else how};"
        f" {d['observations']['used']:,} observations fit within {_residuals(d)} (RMS of a"
        " coordinate)."
    )
    facts = [[label[:1].upper() + label[1:], words] for label, words in _facts(d)]
    report = Report(
        title="Refractive bundle adjustment",
        lead=lead,
        head=Table("In short", [], facts),
        warnings=all_notes(d),
        lattice=lattice,
        height_m=layers[0].values,
        layers=layers,
        pictures=[] if picture is None else [picture],
        tables=[table for table in _tables(d) if table.rows],
    )
    return render(report)


# Facts


def _facts(d: Plain) -> Rows:
    """Return labels and values of the summary."""
    o, water, is_free = d["observations"], d["water"], d["poses_are"] != "fixed"
    kinds = {"tie points": "measured tie points", "cloud": "points of the cloud in original images"}
    unknowns, held = [_lens_row(d, row) for row in d["lens"]], []
    for name, row in (water or d["port_found"] or {}).items():
        if isinstance(row, dict):
            named = _named(name) | row | {"added": row["after"] - row["before"]}
            # a level surface has no tilt to show
            if row["free"]:
                unknowns.append(named)
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
    return row | {"label": label, "unit": unit, "added": row["after"] - row["before"]}


# Map


def _map(a: Adjusted, before: Intersected) -> tuple[Lattice, list[Layer]]:
    """Return the heights of the points and what changed, averaged in cells."""
    low, high = (end(a.xyz[a.is_observed, :2], axis=0) for end in (np.min, np.max))
    size = np.maximum(high - low, 1e-3)
    sparse_m = np.sqrt(POINTS_A_CELL * size.prod() / np.count_nonzero(a.is_observed))
    lattice = lattice_over(low, high, float(max(size.max() / MOST_CELLS, sparse_m)), "the points")

    def means(values: FloatArray) -> FloatArray:
        """Return the means of some values of the points in each cell."""
        known = np.isfinite(values) & a.is_observed
        column, row = lattice.cells(a.xyz[known]).T
        cell, cells = row * lattice.width + column, lattice.width * lattice.height
        count, total = (np.bincount(cell, w, cells) for w in (None, values[known]))
        mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        return np.asarray(mean.reshape(lattice.height, lattice.width))

    # mean squared residual of a coordinate of each point
    rows = a.used & np.isfinite(a.residual_px).all(axis=1)
    owner, square = a.block.owner[rows], (a.residual_px[rows] ** 2).mean(axis=1)
    count, total = (np.bincount(owner, w, len(a.xyz)) for w in (None, square))
    squares = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    unit, higher = (a.block.cameras.lenses or ())[0].unit, a.xyz[:, 2] - before.xyz[:, 2]
    return lattice, [
        Layer("Height", "m", means(a.xyz[:, 2])),
        Layer("Change in height", "m", means(higher), DIFFERENCE, is_centred=True),
        Layer("Residual", unit, np.sqrt(means(squares)), UNCERTAINTY),
    ]


def _tables(d: Plain) -> tuple[Table, Table, Table]:
    """Return residuals and precision, surveyed points, and correlations, each maybe without rows.

    The first is for land and water, as in Mulsow 2024; the second is adjusted minus surveyed.
    """
    unit, precision = d["image_unit"], d["precision"]
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
    residuals = Table("Residuals and precision on land and under water", header, rows)
    header = ["surveyed points", "role", "dX (m)", "dY (m)", "dZ (m)", f"RMS ({unit})", "images"]
    rows = [
        [
            row["name"], role, *(fixed(row[key], 3, "+") for key in ("dx_m", "dy_m", "dz_m")),
            fixed(row["rms_px"], 2), str(row["images"]),
        ]
        for role in ("control", "check")
        for row in (d[role] or {"points": []})["points"]
    ]  # fmt: skip
    surveyed = Table("Control and check points", header, rows)
    names = [row["name"].replace("_", " ") for row in precision["shared"]]
    rows = [
        [name, *(fixed(value, 3, "+") for value in row)]
        for name, row in zip(names, precision["correlation"], strict=True)
    ]
    rows = rows if len(rows) > 1 else []
    return residuals, surveyed, Table("Correlations of the shared unknowns", ["", *names], rows)


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
