"""An adjustment in words: the summary of a run, and what the page says in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pcfix.report.text import share

Plain = dict[str, Any]

MOST_LISTED = 12
"""Surveyed points in the summary; the page has them all."""

WHERE = (("land", "on land"), ("water", "under water"))


def summary_lines(d: Plain) -> list[str]:
    """Return what a person wants to know of an adjustment, of the values of `adjustment_dict`."""
    return [
        f"images       {images_words(d)}",
        f"points       {points_words(d)}",
        f"observations {observations_words(d)}",
        f"sigma0       {fixed(d['sigma0'], 3)}, redundancy {d['redundancy']:,};"
        f" {rounds_words(d)}{engine_words(d)}",
        *_residual_lines(d),
        *(f"{label:<12} {words}" for label, words in found_rows(d)),
        *_surveyed_lines(d),
        *(f"note         {note}" for note in all_notes(d)),
    ]


def all_notes(d: Plain) -> list[str]:
    """Return notes and doubts, each once."""
    doubts = d["precision"]["doubts"] if d["precision"] is not None else []
    return list(dict.fromkeys(note[:1].upper() + note[1:] for note in [*d["notes"], *doubts]))


def fixed(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number with so many digits; a dash where it is not known."""
    if value is None:
        return "-"
    # a zero has no minus sign
    return f"{value if abs(value) >= 0.5 * 10.0**-digits else 0.0:{sign}.{digits}f}"


def listed(values: Sequence[float | None] | None, digits: int = 3, sign: str = "") -> str:
    """Return numbers with commas between them; a dash where none is known."""
    return "-" if values is None else ", ".join(fixed(value, digits, sign) for value in values)


def short(value: float, sigma: float | None, sign: str = "") -> str:
    """Return a number with the digits that its standard error leaves, three at least."""
    if sigma is None or not sigma > 0.0:
        return f"{value:{sign}.6g}"
    digits = 2
    while digits < 9 and sigma < 2.0 * 10.0**-digits:
        digits += 1
    return f"{value:{sign}.{digits}f}"


def images_words(d: Plain) -> str:
    """Return how many images there are and what their poses could do."""
    kept = d["images_fixed"]
    poses = {
        "free": "poses free" + (f", {kept:,} of them fixed" if kept else ""),
        "fixed": "poses fixed",
        "similarity": "moved, turned and scaled together",
    }
    return f"{d['images']:,}, {poses[d['poses_are']]}"


def points_words(d: Plain) -> str:
    """Return how many points there are of each kind."""
    n = d["points"]
    return (
        f"{n['all']:,}: {n['land']:,} on land, {n['water']:,} under water"
        + (f"; {n['left_out']:,} left out" if n["left_out"] else "")
        + (f"; {n['control']:,} control" if n["control"] else "")
        + (f"; {n['check']:,} check" if n["check"] else "")
    )


def observations_words(d: Plain) -> str:
    """Return how many observations were used, and which they are."""
    n = d["observations"]
    kinds = {"tie points": "measured tie points", "cloud": "points of the cloud in its old images"}
    return (
        f"{n['used']:,} used, {n['left_out']:,} left out"
        f" ({share(n['left_out'], n['used'] + n['left_out'])}); {kinds[d['source']]}"
        + (f"; {n['out_of_sight']:,} out of sight" if n["out_of_sight"] else "")
    )


def engine_words(d: Plain) -> str:
    """Return how the poses were found, where no tie points tell."""
    if d["engine"] != "unaware":
        return ""
    return "; the poses are those that an adjustment without water turns into the old ones"


def rounds_words(d: Plain) -> str:
    """Return how many rounds and steps it took."""
    rounds, steps = len(d["rounds"]), sum(row["steps"] for row in d["rounds"])
    return f"{rounds} round{'' if rounds == 1 else 's'}, {steps} step{'' if steps == 1 else 's'}"


def _residual_lines(d: Plain) -> list[str]:
    unit, kinds = d["image_unit"], d["residuals"]
    head = f"{'residuals':<13}{'points':>9}{'observations':>14}"
    head += f"{f'before, {unit}':>12}{f'rms, {unit}':>9}{f'x / y, {unit}':>15}{'rms, m':>9}"
    has_sigma = any(kinds[key]["sigma_xyz_m"] for key, _ in WHERE)
    lines = [head + ("   standard errors X, Y, Z, m" if has_sigma else "")]
    for r, where in ((kinds[key], where) for key, where in WHERE if kinds[key]["points"]):
        line = f"  {where:<11}{r['points']:>9,}{r['observations']:>14,}"
        line += f"{fixed(r['rms_before_px'], 3):>12}{fixed(r['rms_px'], 3):>9}"
        line += f"{xy_words(r):>15}{fixed(r['rms_m'], 4):>9}"
        lines.append(line + (f"   {listed(r['sigma_xyz_m'], 4)}" if r["sigma_xyz_m"] else ""))
    return lines


def xy_words(row: Plain) -> str:
    """Return the residuals of x' and y' apart, as Mulsow 2024 has them."""
    return " / ".join(fixed(value, 3) for value in row["rms_xy_px"])


def found_rows(d: Plain) -> list[tuple[str, str]]:
    """Return what was found, as pairs of a label and words."""
    rows = [(lens_label(row), _lens_words(row, d)) for row in d["lens"]] or [("lens", "fixed")]
    rows += _water_rows(d)
    rows += [("on " + one["surface"], _surface_words(one, d)) for one in d["on_surfaces"]]
    rows += _pose_rows(d)
    if d["gnss"] is not None:
        rows.append(("GNSS", _gnss_words(d["gnss"])))
    return rows


_LENS = {"f": "focal length", "cx": "principal x", "cy": "principal y"}


def lens_label(row: Plain) -> str:
    """Return what a surveyor calls a parameter of a lens."""
    return str(_LENS.get(row["name"], row["name"]))


def lens_unit(row: Plain, d: Plain) -> str:
    """Return the unit of a parameter of a lens; empty where it has none."""
    return str(d["image_unit"]) if row["name"] in ("f", "cx", "cy", "b1", "b2") else ""


def has_many_sensors(d: Plain) -> bool:
    """Whether parameters of several sensors were free."""
    return len({row["sensor"] for row in d["lens"]}) > 1


def before_after_change(row: Plain) -> tuple[str, str, str]:
    """Return a value before and after, and the difference."""
    before, after, sigma = row["before"], row["after"], row["sigma"]
    return short(before, sigma), short(after, sigma), short(after - before, sigma, "+")


def _found(row: Plain, unit: str) -> str:
    before, after, change = before_after_change(row)
    sigma = row["sigma"]
    error = "" if sigma is None else f", standard error {sigma:.2g}"
    return f"{before} -> {after}{unit} ({change}{error})"


def _lens_words(row: Plain, d: Plain) -> str:
    sensor = f"; {row['sensor']}, {row['images']:,} images" if has_many_sensors(d) else ""
    several = f"; first of {row['lenses']} lenses" if row["lenses"] > 1 else ""
    return _found(row, f" {lens_unit(row, d)}".rstrip()) + sensor + several


WATER_WORDS = {
    "level": ("water level", " m"), "tilt_x": ("tilt east", ""), "tilt_y": ("tilt north", ""),
    "index": ("index", ""),
    "shape_xx": ("shape x^2", " /m"), "shape_xy": ("shape x y", " /m"),
    "shape_yy": ("shape y^2", " /m"),
    "distance": ("port's distance", " m"), "centre_x": ("dome's centre x", " m"),
    "centre_y": ("dome's centre y", " m"), "centre_z": ("dome's centre z", " m"),
}  # fmt: skip


def _water_rows(d: Plain) -> list[tuple[str, str]]:
    water, port = d["water"], d["port_found"]
    rows = []
    if water is None:
        rows = [("water", "none; the light bends at a housing port" if d["port"] else "none")]
        if port is not None and len(port) > 1:
            rows.append(("port", f"--port {port['port']}"))
    for key, (label, unit) in WATER_WORDS.items():
        v = (water or port or {}).get(key)
        if v is None or (key.startswith("tilt") and not v["free"] and v["after"] == 0.0):
            continue
        rows.append((label, _found(v, unit) if v["free"] else f"{v['after']:.6g}{unit}, fixed"))
    return rows


def _surface_words(one: Plain, d: Plain) -> str:
    parallel = d["unknowns"]["parallel"]
    others = [name for name in parallel if name != one["surface"] and one["surface"] in parallel]
    return (
        f"{one['points']:,} marked points, {fixed(one['rms_m'], 4)} m off it (rms; given"
        f" {one['sigma_m']:g} m), {one['largest_point']} most, {fixed(one['largest_m'], 4)} m"
        + (f"; parallel to {', '.join(others)}" if others else "")
    )


def _pose_rows(d: Plain) -> list[tuple[str, str]]:
    poses, precision = d["poses"], d["precision"]
    if d["poses_are"] == "fixed":
        return []
    moved = (
        f"centres moved {fixed(poses['moved_rms_m'], 3)} m (rms), mean east, north, up"
        f" {listed(poses['moved_mean_m'], 3, '+')} m; largest"
        f" {fixed(poses['moved_largest_m'], 3)} m ({poses['moved_largest_image']}); turned"
        f" {fixed(poses['turned_rms_deg'], 4)} degrees (rms)"
    )
    if precision is None or not precision["images"]:
        return [("poses", moved)]
    errors = (
        f"standard errors of centres X, Y, Z: mean {listed(precision['centre_mean_m'], 4)}"
        f" m, largest {listed(precision['centre_largest_m'], 4)} m; of angles: mean"
        f" {listed(precision['angle_mean_deg'], 4)} degrees"
    )
    return [("poses", moved), ("  precision", errors)]


def _gnss_words(g: Plain) -> str:
    return (
        f"{g['images']:,} images; adjusted minus GNSS east, north, up: mean"
        f" {listed(g['mean_m'], 3, '+')} m, rms {listed(g['rms_m'])} m; largest"
        f" {fixed(g['largest_m'], 3)} m ({g['largest_image']})"
    )


def surveyed_words(one: Plain, unit: str) -> str:
    """Return how surveyed points fit as a whole."""
    n = len(one["points"])
    return (
        f"{n} point{'' if n == 1 else 's'}; adjusted minus surveyed X, Y, Z: mean"
        f" {listed(one['mean_m'], 3, '+')} m, rms {listed(one['rms_m'])} m,"
        f" {fixed(one['rms_px'], 2)} {unit}"
    )


def _surveyed_lines(d: Plain) -> list[str]:
    lines, unit = [], d["image_unit"]
    for role in ("control", "check"):
        one = d[role]
        if one is None:
            continue
        lines.append(f"{role:<12} {surveyed_words(one, unit)}")
        for row in one["points"][:MOST_LISTED]:
            off = "".join(f"{fixed(row[key], 3, '+'):>9}" for key in ("dx_m", "dy_m", "dz_m"))
            lines.append(
                f"  {row['name']:<11}{off} m {fixed(row['rms_px'], 2):>7} {unit},"
                f" {row['images']} images"
            )
        more = len(one["points"]) - MOST_LISTED
        if more > 0:
            lines.append(f"             and {more} more")
    return lines
