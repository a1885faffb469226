"""The report of an adjustment: summary, values, pictures and page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.grid.maps import MapsBuilder
from pcfix.report import adjustment_text as words
from pcfix.report.adjustment_figures import pictures_of
from pcfix.report.adjustment_tables import adjustment_tables, what_was_free
from pcfix.report.adjustment_values import (
    Before,
    adjustment_dict,
    before_of,
    carried_by,
    depth_of,
)
from pcfix.report.page import Layer, Picture, Report, Table, render

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pcfix.adjust.result import Adjusted
    from pcfix.grid.maps import Maps
    from pcfix.model import FloatArray

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
    return "\n".join(words.summary_lines(adjustment_dict(adjusted, before)))


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
        Settings, files and versions; a table of what was free goes before them.
    """
    d = adjustment_dict(adjusted, before)
    if pictures is None:
        pictures = pictures_of(d, adjusted, before)
    maps, layers = _map(adjusted, before)
    report = Report(
        title=title,
        lead=_lead(d),
        facts=_facts(d),
        warnings=words.all_notes(d),
        maps=maps,
        layers=layers,
        pictures=list(pictures),
        tables=adjustment_tables(d),
        provenance=[what_was_free(d), *provenance],
    )
    return render(report)


def _lead(d: words.Plain) -> str:
    n, unit = d["observations"], d["image_unit"]
    rest = [
        f"{words.fixed(d['residuals'][key]['rms_px'], 2)} {unit} {where}"
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


def _facts(d: words.Plain) -> Table:
    rows = [
        ["Images", words.images_words(d)],
        ["Points", words.points_words(d)],
        ["Data", words.observations_words(d)],
        [
            "Sigma0",
            f"{words.fixed(d['sigma0'], 3)} (1 where the given standard deviations are right),"
            f" redundancy {d['redundancy']:,}; {words.rounds_words(d)}, engine {d['engine']}",
        ],
    ]
    if d["water"] is not None and not d["water"]["surface"].startswith("level"):
        rows.append(["Water", d["water"]["surface"]])
    rows += [[_capital(label.strip()), said] for label, said in words.found_rows(d)]
    for role in ("control", "check"):
        if d[role] is not None:
            name = f"{_capital(role)} points"
            rows.append([name, words.surveyed_words(d[role], d["image_unit"])])
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
