"""The report of an adjustment: summary, values, pictures, tables and page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.values import (
    Before,
    adjustment_dict,
    before_of,
    carried_by,
    depth_of,
)
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.model import FloatArray
from pcfix.report.adjustment_figures import pictures_of
from pcfix.report.adjustment_text import (
    WATER_WORDS,
    WHERE,
    all_notes,
    fixed,
    found_rows,
    images_words,
    lens_label,
    observations_words,
    points_words,
    rounds_words,
    short,
    summary_lines,
    surveyed_words,
)
from pcfix.report.page import Layer, Picture, Report, Table, render

if TYPE_CHECKING:
    from pcfix.adjust.result import Adjusted


__all__ = [
    "Before",
    "adjustment_dict",
    "adjustment_figures",
    "adjustment_page",
    "adjustment_text",
    "before_of",
]


def adjustment_text(adjusted: Adjusted, before: Before | None = None) -> str:
    """Return what a person wants to know of an adjustment.

    Parameters
    ----------
    adjusted : Adjusted
    before : Before, optional
        Of `before_of`, for the residuals before.
    """
    return "\n".join(summary_lines(adjustment_dict(adjusted, before)))


def adjustment_figures(adjusted: Adjusted, before: Before | None = None) -> list[Picture]:
    """Return the pictures of an adjustment: block, residuals, section and rounds.

    Those that there is nothing for are left out.
    """
    return pictures_of(adjustment_dict(adjusted, before), adjusted, before)


def adjustment_page(
    adjusted: Adjusted,
    before: Before | None = None,
    *,
    title: str = "Refractive bundle adjustment",
    pictures: Sequence[Picture] | None = None,
    provenance: Sequence[Table] = (),
) -> str:
    """Return the report of an adjustment as one HTML page with everything inside.

    Parameters
    ----------
    adjusted : Adjusted
    before : Before, optional
        Of `before_of`; then residuals and points before stand beside those after.
    title : str
    pictures : sequence of Picture, optional
        Of `adjustment_figures`, where they are at hand.
    provenance : sequence of Table
        ScienceOptions, files and versions; a table of what was free goes before them.
    """
    d = adjustment_dict(adjusted, before)
    if pictures is None:
        pictures = pictures_of(d, adjusted, before)
    maps, layers = _map(adjusted, before)
    report = Report(
        title=title,
        lead=_lead(d),
        facts=_facts(d),
        warnings=all_notes(d),
        maps=maps,
        layers=layers,
        pictures=list(pictures),
        tables=adjustment_tables(d),
        provenance=[what_was_free(d), *provenance],
    )
    return render(report)


def _lead(d: Plain) -> str:
    n, unit = d["observations"], d["image_unit"]
    rest = [
        f"{fixed(d['residuals'][key]['rms_px'], 2)} {unit} {where}"
        for key, where in (("land", "on land"), ("water", "under water"))
        if d["residuals"][key]["rms_px"] is not None
    ]
    bends = "with straight rays" if d["water"] is None else "with light that bends at the water"
    if d["port"]:
        bends = "with light that bends at the housing port"
    return (
        f"{d['images']:,} images and {d['points']['all']:,} points were adjusted together, {bends};"
        f" {n['used']:,} observations fit within {' and '.join(rest)} (rms of a coordinate)."
    )


def _facts(d: Plain) -> Table:
    rows = [
        ["Images", images_words(d)],
        ["Points", points_words(d)],
        ["Data", observations_words(d)],
        [
            "Sigma0",
            f"{fixed(d['sigma0'], 3)} (1 where the given standard deviations are right),"
            f" redundancy {d['redundancy']:,}; {rounds_words(d)}, engine {d['engine']}",
        ],
    ]
    if d["water"] is not None and not d["water"]["surface"].startswith("level"):
        rows.append(["Water", d["water"]["surface"]])
    rows += [[_capital(label.strip()), text] for label, text in found_rows(d)]
    for role in ("control", "check"):
        if d[role] is not None:
            name = f"{_capital(role)} points"
            rows.append([name, surveyed_words(d[role], d["image_unit"])])
    return Table("In short", [], rows)


def _capital(text: str) -> str:
    return text if text[:1] in "bkp" and text[1:].isdigit() else text[:1].upper() + text[1:]


def _map(a: Adjusted, before: Before | None) -> tuple[Maps, list[Layer]]:
    """Return the means of the points cell by cell."""
    heights = _means(a, a.xyz[:, 2])
    layers = [Layer("Height", "m", heights.height_m)]
    depth = depth_of(a)
    if depth is not None and a.is_wet.any():
        under = np.where(a.is_wet, depth, np.nan)
        layers.append(Layer("Depth", "m", _means(a, under).height_m))
    if before is not None:
        higher = a.xyz[:, 2] - before.xyz[:, 2]
        layers.append(Layer("Change in height", "m", _means(a, higher).height_m))
    layers.append(Layer("Residual", _unit(a), np.sqrt(_means(a, _mean_squares(a)).height_m)))
    images = np.bincount(a.block.owner[a.used], minlength=len(a.xyz)).astype(np.float64)
    layers.append(Layer("Images", "", _means(a, images).height_m))
    return heights, layers


def _unit(a: Adjusted) -> str:
    return (a.block.cameras.lenses or ())[0].unit


def _means(a: Adjusted, values: FloatArray) -> Maps:
    """Return maps whose heights are the means of some values of the points."""
    carried = carried_by(a)
    plan = a.xyz[carried, :2]
    builder = MapsBuilder(plan.min(axis=0), plan.max(axis=0), len(plan))
    known = np.isfinite(values) & carried
    n = int(known.sum())
    builder.add(
        np.column_stack([a.xyz[known, :2], values[known]]),
        np.zeros(n), np.zeros((n, 3)), np.zeros(n, np.int64), np.zeros(n, np.bool_),
    )  # fmt: skip
    return builder.maps()


def _mean_squares(a: Adjusted) -> FloatArray:
    """Return the mean square residual of a coordinate of each point, NaN where none is known."""
    rows = a.used & np.isfinite(a.residual_px).all(axis=1)
    owner, m = a.block.owner[rows], len(a.xyz)
    squares = np.bincount(owner, (a.residual_px[rows] ** 2).mean(axis=1), m)
    count = np.bincount(owner, minlength=m)
    return np.where(count > 0, squares / np.maximum(count, 1), np.nan)


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
