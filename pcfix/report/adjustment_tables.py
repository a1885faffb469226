"""The tables of an adjustment's page, of the values of `adjustment_dict`."""

from __future__ import annotations

from typing import Any

from pcfix.report.adjustment_text import (
    WATER_WORDS,
    WHERE,
    fixed,
    images_words,
    lens_label,
    short,
)
from pcfix.report.page import Table

Plain = dict[str, Any]


def adjustment_tables(d: Plain) -> list[Table]:
    """Return all tables of results, in the order of the page."""
    return [
        residual_table(d),
        *unknown_table(d),
        *correlation_table(d),
        *pose_table(d),
        *gnss_table(d),
        *surveyed_table(d),
        round_table(d),
    ]


def residual_table(d: Plain) -> Table:
    """Return residuals and precision on land and under water, as Mulsow 2024 tells them."""
    unit = d["image_unit"]
    header = [
        "", "points", "observations", f"rms before ({unit})", f"rms ({unit})", "rms (m)",
        "sigma X (m)", "sigma Y (m)", "sigma Z (m)",
    ]  # fmt: skip
    rows = []
    for key, where in WHERE:
        r = d["residuals"][key]
        if not r["points"]:
            continue
        sigma = r["sigma_xyz_m"] or [None] * 3
        rows.append(
            [
                where, f"{r['points']:,}", f"{r['observations']:,}",
                fixed(r["rms_before_px"], 3), fixed(r["rms_px"], 3), fixed(r["rms_m"], 4),
                *(fixed(value, 4) for value in sigma),
            ]
        )  # fmt: skip
    return Table("Residuals and precision on land and under water", header, rows)


def gnss_table(d: Plain) -> list[Table]:
    """Return how the projection centres fit the GNSS."""
    g = d["gnss"]
    if g is None:
        return []
    rows = [
        ["mean", *(fixed(value, 3, "+") for value in g["mean_m"])],
        ["rms", *(fixed(value, 3) for value in g["rms_m"])],
    ]
    title = f"Adjusted minus GNSS, {g['images']:,} images"
    return [Table(title, ["", "east (m)", "north (m)", "up (m)"], rows)]


def surveyed_table(d: Plain) -> list[Table]:
    """Return every control and check point, where there are any."""
    rows = []
    for role in ("control", "check"):
        one = d[role]
        if one is None:
            continue
        for row in one["points"]:
            off = [fixed(row[key], 3, "+") for key in ("dx_m", "dy_m", "dz_m")]
            rows.append([row["name"], role, *off, fixed(row["rms_px"], 2), str(row["images"])])
        off = [fixed(value, 3) for value in one["rms_m"]]
        rows.append([f"rms, {role}", role, *off, fixed(one["rms_px"], 2), ""])
    header = ["", "role", "dX (m)", "dY (m)", "dZ (m)", f"rms ({d['image_unit']})", "images"]
    title = "Control and check points, adjusted minus surveyed"
    return [Table(title, header, rows)] if rows else []


def round_table(d: Plain) -> Table:
    """Return how the rounds went."""
    rows = [
        [
            str(row["round"]), str(row["steps"]), f"{row['observations']:,}",
            fixed(row["cost"], 1), fixed(row["rms_px"], 4),
        ]
        for row in d["rounds"]
    ]  # fmt: skip
    header = ["round", "steps", "observations", "cost", f"rms ({d['image_unit']})"]
    return Table("Rounds", header, rows)


def unknown_table(d: Plain) -> list[Table]:
    """Return lens and water before and after, where something of them was free."""
    rows = []
    for row in d["lens"]:
        label = lens_label(row)
        if len({other["sensor"] for other in d["lens"]}) > 1:
            label += f", {row['sensor']}"
        in_unit = row["name"] in ("f", "cx", "cy", "b1", "b2")
        rows.append(_unknown(label, row, d["image_unit"] if in_unit else ""))
    for key, (label, unit) in WATER_WORDS.items():
        value = (d["water"] or {}).get(key)
        if value is not None and value["free"]:
            rows.append(_unknown(label, value, unit.strip()))
    for row in _similarity(d):
        by, sigma = row["added"], row["sigma"]
        at = "m" if row["name"].startswith("shift") else ""
        at = "rad" if row["name"].startswith("turn") else at
        rows.append([row["name"], "", "", short(by, sigma, "+"), f"{sigma:.2g}", at])
    header = ["", "before", "after", "change", "standard error", "unit"]
    return [Table("Lens and water", header, rows)] if rows else []


def _similarity(d: Plain) -> list[Plain]:
    """Return shift, turn and scale of all poses together, where they were free."""
    if d["poses_are"] != "similarity" or d["precision"] is None:
        return []
    kinds = ("shift", "turn", "scale")
    return [row for row in d["precision"]["shared"] if row["name"].startswith(kinds)]


def _unknown(label: str, row: Plain, unit: str) -> list[str]:
    before, after, sigma = row["before"], row["after"], row["sigma"]
    return [
        label, short(before, sigma), short(after, sigma), short(after - before, sigma, "+"),
        "-" if sigma is None else f"{sigma:.2g}", unit,
    ]  # fmt: skip


def pose_table(d: Plain) -> list[Table]:
    """Return the standard errors of the poses that moved."""
    p = d["precision"]
    if p is None or not p["images"]:
        return []
    kinds = (
        ("centre", "m", "centre (m)"),
        ("angle", "deg", "turn about the camera's axes (degrees)"),
    )
    rows = [
        [f"{label}, {which}", *(fixed(v, 4) for v in p[f"{name}_{which}_{unit}"])]
        for name, unit, label in kinds
        for which in ("mean", "largest")
    ]
    title = f"Standard errors of {p['images']:,} poses"
    return [Table(title, ["", "X", "Y", "Z"], rows)]


def correlation_table(d: Plain) -> list[Table]:
    """Return the correlations of what all points share, where two or more are free."""
    p = d["precision"]
    if p is None or len(p["shared"]) < 2:
        return []
    names = [row["name"].replace("_", " ") for row in p["shared"]]
    rows = [
        [name, *(fixed(value, 3, "+") for value in row)]
        for name, row in zip(names, p["correlation"], strict=True)
    ]
    return [Table("Correlations of the shared unknowns", ["", *names], rows)]


def what_was_free(d: Plain) -> Table:
    """Return what could move, and within what."""
    u = d["unknowns"]

    def how(sigma: float | None, unit: str = "") -> str:
        if sigma is None:
            return "free"
        return f"free, standard deviation {sigma:g}{unit}" if sigma else "fixed"

    held = [f"{name} {how(sigma)}" for name, sigma in u["lens_sigma"].items() if name in u["lens"]]
    rows = [
        ["poses", images_words(d).partition(", ")[2].removeprefix("poses ")],
        [
            "datum",
            "free network" if u["free_network"] else "of GNSS, control points or fixed poses",
        ],
        ["lens", ", ".join(u["lens"]) + (f" ({'; '.join(held)})" if held else "") or "fixed"],
        ["water level", how(u["level_sigma_m"], " m")],
        ["water tilt", how(u["tilt_sigma"])],
        ["refractive index", how(u["index_sigma"])],
    ]
    return Table("What was free", ["unknown", ""], rows)
