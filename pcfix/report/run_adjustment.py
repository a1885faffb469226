"""What a run says of the adjustment that it began with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pcfix.report.adjustment_text import WHERE, fixed, lens_label, listed, short
from pcfix.report.page import Table

if TYPE_CHECKING:
    from collections.abc import Iterator

Plain = dict[str, Any]
TITLE = "Refractive bundle adjustment"


def adjustment_sentence(d: Plain) -> str:
    """Return an adjustment in half a line, of the values of `adjustment_dict`."""
    unit = d["image_unit"]
    parts = [
        f"focal length {short(row['before'], row['sigma'])} -> {short(row['after'], row['sigma'])}"
        f" {unit}"
        for row in d["lens"][:1]
        if row["name"] == "f"
    ]
    parts.append(f"centres moved {fixed(d['poses']['moved_rms_m'], 3)} m (rms)")
    residuals = [
        f"{fixed(d['residuals'][key]['rms_px'], 2)} {unit} {where}"
        for key, where in WHERE
        if d["residuals"][key]["rms_px"] is not None
    ]
    if residuals:
        parts.append(f"residuals {' and '.join(residuals)}")
    return ", ".join(parts)


def adjustment_table(d: Plain, page: str) -> Table:
    """Return what the adjustment changed, with a link to its own page.

    Parameters
    ----------
    d : dict
        Of `pcfix.adjust.values.adjustment_dict`.
    page : str
        Address of its report, relative to that of the run.
    """
    from markupsafe import Markup

    link = Markup('<a href="{0}">{0}</a>').format(page)
    rows = [*_lens(d), *_residuals(d), *_poses(d), *_surveyed(d), ["All of it", "", link]]
    return Table(TITLE, ["", "before", "after"], rows)


def reason_sentence(adjusted: bool, why: str) -> str:
    """Return why a run adjusted or did not, for the head of its page."""
    if adjusted:
        return f" The cameras were adjusted first, as {why}."
    return f" The cameras were not adjusted: {why}."


def _lens(d: Plain) -> Iterator[list[str]]:
    many = len({row["sensor"] for row in d["lens"]}) > 1
    for row in d["lens"]:
        of = f" of {row['sensor']}" if many else ""
        unit = f" {d['image_unit']}" if row["name"] in ("f", "cx", "cy", "b1", "b2") else ""
        name = lens_label(row) + of
        yield [
            name[:1].upper() + name[1:] if len(name) > 2 else name,
            short(row["before"], row["sigma"]) + unit,
            short(row["after"], row["sigma"]) + _sigma(row["sigma"]) + unit,
        ]


def _sigma(sigma: float | None) -> str:
    return "" if sigma is None else f" ± {sigma:.2g}"


def _residuals(d: Plain) -> Iterator[list[str]]:
    unit = d["image_unit"]
    for key, where in WHERE:
        r = d["residuals"][key]
        if r["points"]:
            yield [
                f"Residuals {where} (rms)",
                f"{fixed(r['rms_before_px'], 3)} {unit}",
                f"{fixed(r['rms_px'], 3)} {unit}, {fixed(r['rms_m'], 4)} m",
            ]


def _poses(d: Plain) -> Iterator[list[str]]:
    yield ["Projection centres moved (rms)", "", f"{fixed(d['poses']['moved_rms_m'], 3)} m"]
    if d["gnss"] is not None:
        rms = listed(d["gnss"]["rms_m"])
        yield ["Centres minus GNSS, east, north, up (rms)", "", f"{rms} m"]


def _surveyed(d: Plain) -> Iterator[list[str]]:
    for role in ("control", "check"):
        if d[role] is not None:
            one = d[role]
            yield [
                f"{role.capitalize()} points, X, Y, Z ({len(one['points'])}, rms)", "",
                f"{listed(one['rms_m'])} m, {fixed(one['rms_px'], 2)} {d['image_unit']}",
            ]  # fmt: skip
