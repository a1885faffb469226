"""The report of an adjustment: summary, values, pictures, tables and page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcfix.adjust.result import Adjusted
from pcfix.adjust.values import Before, Plain, adjustment_dict, before_of, carried_by, depth_of
from pcfix.grid.colours import DEPTH, DIFFERENCE, RAYS, UNCERTAINTY
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.model import FloatArray
from pcfix.report.adjustment_figures import pictures_of
from pcfix.report.adjustment_text import (
    WATER_WORDS,
    WHERE,
    all_notes,
    before_after_change,
    engine_words,
    fixed,
    found_rows,
    has_many_sensors,
    images_words,
    lens_label,
    lens_unit,
    observations_words,
    points_words,
    rounds_words,
    short,
    summary_lines,
    surveyed_words,
    xy_words,
)
from pcfix.report.map_data import Layer
from pcfix.report.page import Report, Table, render

__all__ = ["Before", "adjustment_dict", "adjustment_page", "adjustment_text", "before_of"]


def adjustment_text(adjusted: Adjusted, before: Before | None = None) -> str:
    """Return what a person wants to know of an adjustment.

    Parameters
    ----------
    adjusted : Adjusted
    before : Before, optional
        Of `before_of`, for the residuals before.
    """
    return "\n".join(summary_lines(adjustment_dict(adjusted, before)))


def adjustment_page(adjusted: Adjusted, before: Before | None = None) -> str:
    """Return the report of an adjustment as one HTML page with everything inside.

    Parameters
    ----------
    adjusted : Adjusted
    before : Before, optional
        Of `before_of`; then residuals and points before stand beside those after.
    """
    d = adjustment_dict(adjusted, before)
    maps, layers = _map(adjusted, before)
    report = Report(
        title="Refractive bundle adjustment",
        lead=_lead(d),
        head=_facts(d),
        warnings=all_notes(d),
        maps=maps,
        layers=layers,
        pictures=pictures_of(d, adjusted, before),
        tables=adjustment_tables(d),
        provenance=[what_was_free(d)],
    )
    return render(report)


def _lead(d: Plain) -> str:
    n, unit = d["observations"], d["image_unit"]
    rest = [
        f"{fixed(d['residuals'][key]['rms_px'], 2)} {unit} {where}"
        for key, where in WHERE
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
            f" redundancy {d['redundancy']:,}; {rounds_words(d)}{engine_words(d)}",
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
    unit = (a.block.cameras.lenses or ())[0].unit
    heights, depth = _means(a, a.xyz[:, 2]), depth_of(a)
    layers = [Layer("Height", "m", heights.height_m)]
    if depth is not None and a.is_wet.any():
        under = np.where(a.is_wet, depth, np.nan)
        layers.append(Layer("Depth", "m", _means(a, under).height_m, DEPTH))
    if before is not None:
        higher = a.xyz[:, 2] - before.xyz[:, 2]
        layers.append(
            Layer("Change in height", "m", _means(a, higher).height_m, DIFFERENCE, is_centred=True)
        )
    residual = np.sqrt(_means(a, _mean_squares(a)).height_m)
    layers.append(Layer("Residual", unit, residual, UNCERTAINTY))
    images = np.bincount(a.block.owner[a.used], minlength=len(a.xyz)).astype(np.float64)
    return heights, [*layers, Layer("Images", "", _means(a, images).height_m, RAYS)]


def _means(a: Adjusted, values: FloatArray) -> Maps:
    """Return maps whose heights are the means of some values of the points."""
    carried = carried_by(a)
    plan = a.xyz[carried, :2]
    builder = MapsBuilder(plan.min(axis=0), plan.max(axis=0), len(plan))
    known = np.isfinite(values) & carried
    builder.add(np.column_stack([a.xyz[known, :2], values[known]]))
    return builder.maps()


def _mean_squares(a: Adjusted) -> FloatArray:
    """Return the mean square residual of a coordinate of each point, NaN where none is known."""
    rows = a.used & np.isfinite(a.residual_px).all(axis=1)
    owner, m = a.block.owner[rows], len(a.xyz)
    squares = np.bincount(owner, (a.residual_px[rows] ** 2).mean(axis=1), m)
    count = np.bincount(owner, minlength=m)
    return np.where(count > 0, squares / np.maximum(count, 1), np.nan)


def adjustment_tables(d: Plain) -> list[Table]:
    """Return the tables of results that have rows, residuals and rounds in any case."""
    unit, p, g = d["image_unit"], d["precision"], d["gnss"]
    shared = [] if p is None else [row["name"].replace("_", " ") for row in p["shared"]]
    tables = [
        Table(
            "Lens and water",
            ["", "before", "after", "change", "standard error", "unit"],
            _unknown_rows(d),
        )
    ]
    if len(shared) > 1:
        rows = [_row(*row, 3, "+") for row in zip(shared, p["correlation"], strict=True)]
        tables.append(Table("Correlations of the shared unknowns", ["", *shared], rows))
    if p is not None:
        title = f"Standard errors of {p['images']:,} poses"
        tables.append(Table(title, ["", "X", "Y", "Z"], _pose_rows(p)))
    if g is not None:
        rows = [_row("mean", g["mean_m"], 3, "+"), _row("rms", g["rms_m"], 3)]
        title = f"Adjusted minus GNSS, {g['images']:,} images"
        tables.append(Table(title, ["", "east (m)", "north (m)", "up (m)"], rows))
    tables.append(
        Table(
            "Control and check points, adjusted minus surveyed",
            ["", "role", "dX (m)", "dY (m)", "dZ (m)", f"rms ({unit})", "images"],
            _surveyed_rows(d),
        )
    )
    return [_residual_table(d), *(table for table in tables if table.rows), _round_table(d)]


def _row(label: str, values: Sequence[float | None], digits: int, sign: str = "") -> list[str]:
    return [label, *(fixed(value, digits, sign) for value in values)]


def _residual_table(d: Plain) -> Table:
    """Return residuals and precision on land and under water, as Mulsow 2024 tells them."""
    unit = d["image_unit"]
    header = [
        "", "points", "observations", f"rms before ({unit})", f"rms ({unit})",
        f"rms x' / y' ({unit})", "rms (m)",
        "sigma X (m)", "sigma Y (m)", "sigma Z (m)",
    ]  # fmt: skip
    rows = [
        [
            where, f"{r['points']:,}", f"{r['observations']:,}",
            fixed(r["rms_before_px"], 3), fixed(r["rms_px"], 3), xy_words(r), fixed(r["rms_m"], 4),
            *(fixed(value, 4) for value in r["sigma_xyz_m"] or [None] * 3),
        ]
        for key, where in WHERE
        if (r := d["residuals"][key])["points"]
    ]  # fmt: skip
    return Table("Residuals and precision on land and under water", header, rows)


def _round_table(d: Plain) -> Table:
    rows = [
        [
            str(row["round"]), str(row["steps"]), f"{row['observations']:,}",
            fixed(row["cost"], 1), fixed(row["rms_px"], 4),
        ]
        for row in d["rounds"]
    ]  # fmt: skip
    header = ["round", "steps", "observations", "cost", f"rms ({d['image_unit']})"]
    return Table("Rounds", header, rows)


def _unknown_rows(d: Plain) -> list[list[str]]:
    """Return lens and water before and after, where something of them was free."""
    rows = []
    for row in d["lens"]:
        label = lens_label(row) + (f", {row['sensor']}" if has_many_sensors(d) else "")
        rows.append([label, *_unknown(row), lens_unit(row, d)])
    for key, (label, unit) in WATER_WORDS.items():
        value = (d["water"] or d["port_found"] or {}).get(key)
        if value is not None and value["free"]:
            rows.append([label, *_unknown(value), unit.strip()])
    if d["poses_are"] == "similarity" and d["precision"] is not None:
        units = {"shift": "m", "turn": "rad", "scale": ""}
        for row in d["precision"]["shared"]:
            name, by, sigma = row["name"], row["added"], row["sigma"]
            if (kind := name.partition(" ")[0]) in units:
                rows.append([name, "", "", short(by, sigma, "+"), f"{sigma:.2g}", units[kind]])
    return rows


def _unknown(row: Plain) -> list[str]:
    sigma = row["sigma"]
    return [*before_after_change(row), "-" if sigma is None else f"{sigma:.2g}"]


def _pose_rows(p: Plain) -> list[list[str]]:
    """Return the standard errors of the poses that moved."""
    kinds = (
        ("centre", "m", "centre (m)"),
        ("angle", "deg", "turn about the camera's axes (degrees)"),
    )
    return [
        _row(f"{label}, {which}", p[f"{name}_{which}_{unit}"], 4)
        for name, unit, label in kinds
        for which in ("mean", "largest")
        if p["images"]
    ]


def _surveyed_rows(d: Plain) -> list[list[str]]:
    """Return every control and check point."""
    rows = []
    for role in ("control", "check"):
        one = d[role] or {"points": []}
        for row in one["points"]:
            off = [fixed(row[key], 3, "+") for key in ("dx_m", "dy_m", "dz_m")]
            rows.append([row["name"], role, *off, fixed(row["rms_px"], 2), str(row["images"])])
        if one["points"]:
            off = [fixed(value, 3) for value in one["rms_m"]]
            rows.append([f"rms, {role}", role, *off, fixed(one["rms_px"], 2), ""])
    return rows


def what_was_free(d: Plain) -> Table:
    """Return what could move, and within what."""
    u = d["unknowns"]

    def how(sigma: float | None, unit: str = "") -> str:
        if sigma is None:
            return "free"
        return f"free, standard deviation {sigma:g}{unit}" if sigma else "fixed"

    held = [f"{name} {how(sigma)}" for name, sigma in u["lens_sigma"].items() if name in u["lens"]]
    lens = ", ".join(u["lens"]) + (f" ({'; '.join(held)})" if held else "")
    network = u["free_network"]
    rows = [
        ["poses", images_words(d).partition(", ")[2].removeprefix("poses ")],
        ["datum", "free network" if network else "of GNSS, control points or fixed poses"],
        ["lens", lens or "fixed"],
        ["water level", how(u["level_sigma_m"], " m")],
        ["water tilt", how(u["tilt_sigma"])],
        ["refractive index", how(u["index_sigma"])],
    ]
    more = {
        "water shape": "shape_sigma", "distance of the port": "distance_sigma_m",
        "centre of the dome": "centre_sigma_m",
    }  # fmt: skip
    rows += [[name, "free"] for name, key in more.items() if u[key] is None]
    return Table("What was free", ["unknown", ""], rows)
