"""The report of an adjustment: its summary as text, and a page of tables.

All text is derived from the plain values of `adjustment_dict`, which a resumed run has, too.
"""

import math

from pcfix.adjust.parameters import words_of
from pcfix.adjust.result import Plain
from pcfix.report.page import Report, Table, render
from pcfix.report.text import Rows, RowTable, filled, share, wrapped

WHERE = (("land", "on land"), ("water", "under water"))
_FACTS: RowTable = (
    ("Water", "{water}", "water"),
    ("Port", "--port {port}", "port"),
    ("Poses", "{poses_words}", "images"),
    ("", "centres moved by {poses[moved_rms_m]:.3f} m, rotated by {poses[turned_rms_deg]:.4f} deg"
     " (RMS)", "moved"),
    ("", "centres known to {precision[centre_mean_m]:z.4f} m (X, Y, Z), angles to"
     " {precision[angle_mean_deg]:z.4f} deg (mean standard errors)", "is_precise"),
    ("Bed", "heights known to {bed_m:.3f} m (standard error, RMS{bed_if})", "bed_m"),
    ("Observations", "{o[used]:,} {kind} used, {o[excluded]:,} excluded ({o_share})", "o"),
    ("Fit", "sigma0 {sigma0:.3f}, redundancy {redundancy:,}", "images"),
    ("GNSS", "{gnss[images]:,} images. Centres minus GNSS (east, north, up): mean"
     " {gnss[mean_m]:+z.3f} m, RMS {gnss[rms_m]:z.3f} m", "gnss"),
    ("{role} points", "{count}. Adjusted minus surveyed (X, Y, Z): mean {mean_m:+z.3f} m, RMS"
     " {rms_m:z.3f} m, {rms_px:z.2f} {image_unit}", "*surveyed"),
)  # fmt: skip


def fixed(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number with a fixed number of digits; a dash if it is unknown."""
    return "-" if value is None else f"{value:{sign}z.{digits}f}"  # z: a zero has no minus sign


def all_notes(d: Plain) -> list[str]:
    """Return the messages of all warnings."""
    return [note["message"][:1].upper() + note["message"][1:] for note in d["notes"]]


def adjustment_sentence(d: Plain) -> str:
    """Return an adjustment in a line."""
    lengths = [row for name, row in d["shared"].items() if name.partition(" ")[0] == "f"]
    facts = [f"focal length {row['before']:.6g} -> {row['after']:.6g}" for row in lengths]
    moved = f"centres moved by {d['poses']['moved_rms_m']:.3f} m (RMS)"
    return "; ".join([*facts, moved, f"residuals: {_residuals(d)}"])


def adjustment_text(d: Plain) -> str:
    """Return the summary of an adjustment as text."""
    lines = [_head(d), *_change_table(d).lines()]
    lines += [wrapped(f"  {label:<29} ", words) for label, words in _facts(d)]
    if (surveyed := _survey_table(d)).rows:
        lines += surveyed.lines()[:13]  # a header and twelve points; the page has all of them
    return "\n".join([*lines, *(wrapped("", f"Note: {note}") for note in all_notes(d))])


def adjustment_page(d: Plain) -> str:
    """Return the report of an adjustment as one self-contained HTML page."""
    how = "without refraction" if d["water"] is None else "with refraction at the water"
    how = "with refraction at the housing port" if d["port"] else how
    lead = f"{_head(d)}, {how}. Residuals: {_residuals(d)} (RMS of a coordinate)."
    head = Table("In short", [], _facts(d))
    tables = [_change_table(d), _residual_table(d), _survey_table(d)]
    tables = [table for table in tables if table.rows]
    return render(Report("Refractive bundle adjustment", lead, head, all_notes(d), tables))


def _head(d: Plain) -> str:
    points = d["points"]
    return (
        f"Adjusted {d['images']:,} images and {points['all']:,} points ({points['land']:,} on land,"
        f" {points['water']:,} under water)"
    )


def _residuals(d: Plain) -> str:
    """Return the RMS residuals on land and under water; empty without any."""
    known = [(where, d["residuals"][key]["rms_px"]) for key, where in WHERE]
    unit = d["image_unit"]
    return " and ".join(f"{rms:.2f} {unit} {where}" for where, rms in known if rms is not None)


# Facts


def _facts(d: Plain) -> Rows:
    """Return labels and values of what the table of changes does not have."""
    o, is_free = d["observations"], d["unknowns"]["poses"] == "free"
    kinds = {"tie points": "measured tie points", "cloud": "points of the cloud in original images"}
    network = ", a free network" if d["unknowns"]["free_network"] else ""
    return filled(_FACTS, d | {
        "poses_words": f"free{network}" if is_free else "fixed", "o": o, "kind": kinds[d["source"]],
        "o_share": share(o["excluded"], o["used"] + o["excluded"]),
        "moved": is_free and d["poses"]["moved_rms_m"], "is_precise": is_free,
        "bed_if": "" if is_free else "; if the fixed poses are right",
        "bed_m": (d["residuals"]["water"]["sigma_xyz_m"] or [None])[-1],
        "surveyed": [
            {"role": role.capitalize(), "count": len(d[role]["points"]), **d[role]}
            for role in ("control", "check") if d[role] is not None
        ],
    })  # fmt: skip


# Tables


def _change_table(d: Plain) -> Table:
    """Return lens, water, residuals and centres before and after."""
    unit, rows = d["image_unit"], list[list[str]]()
    for name, row in d["shared"].items():
        label, of_unit = words_of(name)
        in_image = name.partition(" ")[0] in ("f", "cx", "cy", "b1", "b2")
        of_unit = unit if in_image else of_unit.strip()
        label = label[:1].upper() + label[1:] + (f" ({of_unit})" if of_unit else "")
        before, after = f"{row['before']:.6g}", f"{row['after']:.6g}"
        rows.append([label, before, after, f"{row['sigma']:.2g}"])
    for key, where in WHERE:
        r = d["residuals"][key]
        if r["points"]:
            before, after = fixed(r["rms_before_px"], 3), fixed(r["rms_px"], 3)
            rows.append([f"Residuals {where} ({unit})", before, after, ""])
    if (gnss := d["gnss"]) is not None:  # the lengths of vectors, of their known components
        lengths = (math.hypot(*filter(None, gnss[name])) for name in ("rms_before_m", "rms_m"))
        rows.append(["Centres minus GNSS (m)", *(fixed(one, 3) for one in lengths), ""])
    return Table("Before and after", ["", "before", "after", "standard error"], rows)


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
