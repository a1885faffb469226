"""The report of an adjustment: its summary as text, and its page with tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pcfix.adjust.result import Adjusted, Before, Plain, adjustment_dict, before_of
from pcfix.grid.colours import DEPTH, DIFFERENCE, RAYS, UNCERTAINTY
from pcfix.grid.maps import Maps, MapsBuilder
from pcfix.model import FloatArray
from pcfix.report.adjustment_figures import pictures_of
from pcfix.report.adjustment_text import (
    WHERE,
    all_notes,
    fixed,
    has_many_sensors,
    lens_label,
    listed,
    short,
)
from pcfix.report.map_data import Layer
from pcfix.report.page import Report, Table, render
from pcfix.report.text import share

__all__ = ["Before", "adjustment_dict", "adjustment_page", "adjustment_text", "before_of"]

MOST_LISTED = 12
"""Surveyed points in the text; the page has all of them."""

WATER_WORDS = {
    "level": ("water level", "m"), "tilt_x": ("tilt east", ""), "tilt_y": ("tilt north", ""),
    "index": ("index", ""), "shape_xx": ("shape x^2", "/m"), "shape_xy": ("shape x y", "/m"),
    "shape_yy": ("shape y^2", "/m"), "distance": ("port distance", "m"),
    "centre_x": ("dome centre x", "m"), "centre_y": ("dome centre y", "m"),
    "centre_z": ("dome centre z", "m"),
}  # fmt: skip


def adjustment_text(adjusted: Adjusted, before: Before | None = None) -> str:
    """Return the summary of an adjustment as text.

    Parameters
    ----------
    adjusted : Adjusted
    before : Before, optional
        Of `before_of`, for the residuals before.
    """
    d = adjustment_dict(adjusted, before)
    lines = [f"{label:<14} {words}" for label, words in _facts(d)]
    residuals = _residual_table(d)
    lines += _aligned([residuals.header, *residuals.rows])
    for role in ("control", "check"):
        points = (d[role] or {"points": []})["points"]
        for row in points[:MOST_LISTED]:
            off = listed([row[key] for key in ("dx_m", "dy_m", "dz_m")], 3, "+")
            pixels = f"{fixed(row['rms_px'], 2)} {d['image_unit']}"
            lines.append(f"  {row['name']:<12} {off} m, {pixels}, {row['images']} images")
        more = len(points) - MOST_LISTED
        lines += [f"  and {more} more"] if more > 0 else []
    return "\n".join([*lines, *(f"Note: {note}" for note in all_notes(d))])


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, with its columns aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([f"  {row[0]:<{widths[0]}}", *map(str.rjust, row[1:], widths[1:])])
        for row in rows
    ]


def adjustment_page(adjusted: Adjusted, before: Before | None = None) -> str:
    """Return the report of an adjustment as one self-contained HTML page.

    Parameters
    ----------
    adjusted : Adjusted
    before : Before, optional
        Of `before_of`; then residuals and points before are shown too.
    """
    d = adjustment_dict(adjusted, before)
    maps, layers = _map(adjusted, before)
    unit, surface = d["image_unit"], "at the housing port" if d["port"] else "at the water"
    rest = [
        f"{fixed(d['residuals'][key]['rms_px'], 2)} {unit} {where}"
        for key, where in WHERE
        if d["residuals"][key]["rms_px"] is not None
    ]
    is_straight = d["water"] is None and not d["port"]
    lead = (
        f"{d['images']:,} images and {d['points']['all']:,} points were adjusted"
        f" {'without refraction' if is_straight else f'with refraction {surface}'};"
        f" {d['observations']['used']:,} observations fit within {' and '.join(rest)} (RMS of a"
        " coordinate)."
    )
    report = Report(
        title="Refractive bundle adjustment",
        lead=lead,
        head=Table("In short", [], [[_capital(label), words] for label, words in _facts(d)]),
        warnings=all_notes(d),
        maps=maps,
        layers=layers,
        pictures=pictures_of(d, adjusted, before),
        tables=_tables(d),
        provenance=[_what_was_free(d)],
    )
    return render(report)


def _capital(text: str) -> str:
    return text if text[:1] in "bkp" and text[1:].isdigit() else text[:1].upper() + text[1:]


# Facts


def _facts(d: Plain) -> list[tuple[str, str]]:
    """Return labels and values of the summary."""
    n, o, kept, rounds = d["points"], d["observations"], d["images_fixed"], d["rounds"]
    poses = {
        "free": "poses free" + (f", {kept:,} of them fixed" if kept else ""),
        "fixed": "poses fixed",
        "similarity": "shifted, turned and scaled together",
    }[d["poses_are"]]
    kinds = {"tie points": "measured tie points", "cloud": "points of the cloud in original images"}
    counts = [(n[key], key.replace("_", " ")) for key in ("left_out", "control", "check")]
    counted = "".join(f", {count:,} {key}" for count, key in counts if count)
    steps = sum(row["steps"] for row in rounds)
    how = "; adjustment without water undone" if d["engine"] == "unaware" else ""
    rows = [
        ("images", f"{d['images']:,}, {poses}"),
        ("points", f"{n['all']:,}: {n['land']:,} on land, {n['water']:,} under water{counted}"),
        (
            "observations",
            f"{o['used']:,} {kinds[d['source']]} used, {o['left_out']:,} left out"
            f" ({share(o['left_out'], o['used'] + o['left_out'])})"
            + (f", {o['out_of_sight']:,} outside their image" if o["out_of_sight"] else ""),
        ),
        (
            "sigma0",
            f"{fixed(d['sigma0'], 3)}, redundancy {d['redundancy']:,}, {len(rounds)} rounds,"
            f" {steps} steps{how}",
        ),
    ]
    if d["water"] is not None and not d["water"]["surface"].startswith("level"):
        rows.append(("water", d["water"]["surface"]))
    rows += [(lens_label(row), _lens_words(row, d)) for row in d["lens"]] or [("lens", "fixed")]
    rows += _water_rows(d)
    rows += [(f"on {one['surface']}", _surface_words(one, d)) for one in d["on_surfaces"]]
    rows += _pose_facts(d)
    if d["gnss"] is not None:
        g = d["gnss"]
        words = (
            f"{g['images']:,} images, adjusted minus GNSS east, north, up: mean"
            f" {listed(g['mean_m'], 3, '+')} m, RMS {listed(g['rms_m'])} m, largest"
            f" {fixed(g['largest_m'], 3)} m ({g['largest_image']})"
        )
        rows.append(("GNSS", words))
    for role in ("control", "check"):
        if (one := d[role]) is not None:
            words = (
                f"{len(one['points'])}, adjusted minus surveyed X, Y, Z: mean"
                f" {listed(one['mean_m'], 3, '+')} m, RMS {listed(one['rms_m'])} m,"
                f" {fixed(one['rms_px'], 2)} {d['image_unit']}"
            )
            rows.append((f"{role} points", words))
    return rows


def _change(row: Plain) -> list[str]:
    """Return a value before and after, the difference, and its standard error."""
    before, after, sigma = row["before"], row["after"], row["sigma"]
    change = short(after - before, sigma, "+")
    return [short(before, sigma), short(after, sigma), change, _error(sigma)]


def _error(sigma: float | None) -> str:
    return "-" if sigma is None else f"{sigma:.2g}"


def _change_words(row: Plain, unit: str) -> str:
    before, after, change, error = _change(row)
    error = "" if row["sigma"] is None else f", standard error {error}"
    return f"{before} -> {after}{f' {unit}' if unit else ''} ({change}{error})"


def _lens_unit(row: Plain, d: Plain) -> str:
    return str(d["image_unit"]) if row["name"] in ("f", "cx", "cy", "b1", "b2") else ""


def _lens_words(row: Plain, d: Plain) -> str:
    sensor = f"; {row['sensor']}, {row['images']:,} images" if has_many_sensors(d) else ""
    several = f"; first of {row['lenses']} lenses" if row["lenses"] > 1 else ""
    return _change_words(row, _lens_unit(row, d)) + sensor + several


def _water_rows(d: Plain) -> list[tuple[str, str]]:
    water, port = d["water"], d["port_found"]
    rows = []
    if water is None:
        rows = [("water", "none, a housing port refracts" if d["port"] else "none")]
        if port is not None and len(port) > 1:
            rows.append(("port", f"--port {port['port']}"))
    for key, (label, unit) in WATER_WORDS.items():
        v = (water or port or {}).get(key)
        if v is None or (key.startswith("tilt") and not v["free"] and v["after"] == 0.0):
            continue
        value = f"{v['after']:.6g}{f' {unit}' if unit else ''}, fixed"
        rows.append((label, _change_words(v, unit) if v["free"] else value))
    return rows


def _surface_words(one: Plain, d: Plain) -> str:
    parallel = d["unknowns"]["parallel"]
    others = [name for name in parallel if name != one["surface"] and one["surface"] in parallel]
    return (
        f"{one['points']:,} marked points, distance RMS {fixed(one['rms_m'], 4)} m (given"
        f" {one['sigma_m']:g} m), largest {fixed(one['largest_m'], 4)} m ({one['largest_point']})"
        + (f"; parallel to {', '.join(others)}" if others else "")
    )


def _pose_facts(d: Plain) -> list[tuple[str, str]]:
    p, precision = d["poses"], d["precision"]
    if d["poses_are"] == "fixed":
        return []
    moved = (
        f"centres moved {fixed(p['moved_rms_m'], 3)} m (RMS), mean east, north, up"
        f" {listed(p['moved_mean_m'], 3, '+')} m, largest {fixed(p['moved_largest_m'], 3)} m"
        f" ({p['moved_largest_image']}); turned {fixed(p['turned_rms_deg'], 4)} deg (RMS)"
    )
    if precision is None or not precision["images"]:
        return [("poses", moved)]
    errors = (
        f"standard errors of centres X, Y, Z: mean {listed(precision['centre_mean_m'], 4)} m,"
        f" largest {listed(precision['centre_largest_m'], 4)} m; of angles: mean"
        f" {listed(precision['angle_mean_deg'], 4)} deg"
    )
    return [("poses", moved), ("precision", errors)]


# Maps


def _map(a: Adjusted, before: Before | None) -> tuple[Maps, list[Layer]]:
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
    count = np.bincount(owner, minlength=m).astype(np.float64)
    squares = np.bincount(owner, (a.residual_px[rows] ** 2).mean(axis=1), m)
    squares = np.where(count > 0, squares / np.maximum(count, 1), np.nan)
    residual = np.sqrt(_means(a, np.asarray(squares, np.float64)).height_m)
    layers.append(Layer("Residual", unit, residual, UNCERTAINTY))
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
    """Return the tables that have rows, and those of residuals and rounds."""
    unit, p, g = d["image_unit"], d["precision"], d["gnss"]
    header = ["", "before", "after", "change", "standard error", "unit"]
    tables = [Table("Lens and water", header, _unknown_rows(d))]
    shared = [] if p is None else [row["name"].replace("_", " ") for row in p["shared"]]
    if len(shared) > 1:
        rows = [_row(*row, 3, "+") for row in zip(shared, p["correlation"], strict=True)]
        tables.append(Table("Correlations of the shared unknowns", ["", *shared], rows))
    if p is not None and p["images"]:
        kinds = (("centre", "m", "centre (m)"), ("angle", "deg", "angle, camera axes (deg)"))
        rows = [
            _row(f"{label}, {which}", p[f"{name}_{which}_{unit}"], 4)
            for name, unit, label in kinds
            for which in ("mean", "largest")
        ]
        title = f"Standard errors of {p['images']:,} poses"
        tables.append(Table(title, ["", "X", "Y", "Z"], rows))
    if g is not None:
        rows = [_row("mean", g["mean_m"], 3, "+"), _row("RMS", g["rms_m"], 3)]
        title = f"Adjusted minus GNSS, {g['images']:,} images"
        tables.append(Table(title, ["", "east (m)", "north (m)", "up (m)"], rows))
    header = ["", "role", "dX (m)", "dY (m)", "dZ (m)", f"RMS ({unit})", "images"]
    title = "Control and check points, adjusted minus surveyed"
    tables.append(Table(title, header, _surveyed_rows(d)))
    rounds = [
        [
            str(row["round"]), str(row["steps"]), f"{row['observations']:,}",
            fixed(row["cost"], 1), fixed(row["rms_px"], 4),
        ]
        for row in d["rounds"]
    ]  # fmt: skip
    header = ["round", "steps", "observations", "cost", f"RMS ({unit})"]
    known = [table for table in tables if table.rows]
    return [_residual_table(d), *known, Table("Rounds", header, rounds)]


def _row(label: str, values: Sequence[float | None], digits: int, sign: str = "") -> list[str]:
    return [label, *(fixed(value, digits, sign) for value in values)]


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


def _unknown_rows(d: Plain) -> list[list[str]]:
    """Return lens and water before and after, as far as they were free."""
    rows = []
    for row in d["lens"]:
        label = lens_label(row) + (f", {row['sensor']}" if has_many_sensors(d) else "")
        rows.append([label, *_change(row), _lens_unit(row, d)])
    for key, (label, unit) in WATER_WORDS.items():
        value = (d["water"] or d["port_found"] or {}).get(key)
        if value is not None and value["free"]:
            rows.append([label, *_change(value), unit])
    if d["poses_are"] == "similarity" and d["precision"] is not None:
        units = {"shift": "m", "turn": "rad", "scale": ""}
        for row in d["precision"]["shared"]:
            name, by, sigma = row["name"], row["added"], row["sigma"]
            if (kind := name.partition(" ")[0]) in units:
                rows.append([name, "", "", short(by, sigma, "+"), _error(sigma), units[kind]])
    return rows


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
            rows.append([f"RMS, {role}", role, *off, fixed(one["rms_px"], 2), ""])
    return rows


def _what_was_free(d: Plain) -> Table:
    """Return what was free, and with which standard deviations."""
    u = d["unknowns"]

    def how(sigma: float | None, unit: str = "") -> str:
        if sigma is None:
            return "free"
        return f"free, standard deviation {sigma:g}{unit}" if sigma else "fixed"

    held = [f"{name} {how(sigma)}" for name, sigma in u["lens_sigma"].items() if name in u["lens"]]
    lens = ", ".join(u["lens"]) + (f" ({'; '.join(held)})" if held else "")
    datum = "free network" if u["free_network"] else "of GNSS, control points or fixed poses"
    rows: list[list[Any]] = [
        ["poses", _facts(d)[0][1].partition(", ")[2].removeprefix("poses ")],
        ["datum", datum],
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
