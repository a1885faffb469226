"""What a comparison with a reference adds to a report: pictures and tables.

It works on the plain values of `Comparison.as_dict`, so that a run that resumes can draw what an
earlier one measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.report.figures import (
    AFTER,
    BEFORE,
    REFERENCE,
    WATER,
    new_figure,
    raster_figure,
)
from pcfix.report.page import Picture, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.model import FloatArray

Plain = dict[str, Any]
_TIMES = (("before", "as it came", BEFORE), ("after", "corrected", AFTER))


def evaluation(
    compared: Plain,
    sections: list[Plain],
    dod: tuple[FloatArray, tuple[float, float, float, float]] | None = None,
) -> tuple[list[Picture], list[Table]]:
    """Return pictures and tables.

    Parameters
    ----------
    compared : dict
        `Comparison.as_dict`.
    sections : list of dict
        With ``distance_m`` and ``heights_m`` as lists, None where nothing is known.
    dod : pair, optional
        Difference of the surfaces, shape (rows, columns), metres, and its west, east, south and
        north.
    """
    pictures = [*_histograms(compared), *_by_depth(compared), *_sections(sections)]
    if dod is not None:
        pictures.insert(2, _difference(*dod))
    return pictures, [_statistics(compared), *_bins(compared)]


def _difference(values: FloatArray, extent_m: tuple[float, float, float, float]) -> Picture:
    reach = float(np.nanpercentile(np.abs(values), 98.0))
    alt = (
        "Map of the corrected surface minus the reference surface; blue where the cloud is lower."
        f" 98 % of the cells differ by less than {reach:.2f} m."
    )
    figure = raster_figure(values, extent_m, "Cloud minus reference (m)", reach)
    return Picture("dod", "Difference of the surfaces (DoD)", alt, figure)


def in_a_sentence(compared: Plain) -> str:
    """Return what the correction came to against the reference; empty where it is not known."""
    pair = compared["vertical"]
    if pair is None or pair["before"] is None:
        return ""
    before, after = (pair[when]["statistics"] for when, _, _ in _TIMES)
    name = compared["reference"].rsplit("/", 1)[-1]
    return (
        f" Against {name} the vertical error fell from {before['rmse_m']:.3f} to"
        f" {after['rmse_m']:.3f} m (RMSE of {after['count']:,} points); what is left has a bias of"
        f" {after['mean_m']:+.3f} m."
    )


def _histograms(compared: Plain) -> list[Picture]:
    kinds = (
        ("vertical", "Vertical error", "Cloud minus reference, Z (m)"),
        ("c2c", "Distance to the reference (C2C)", "Distance to the nearest point (m)"),
    )
    pictures = []
    for key, title, label in kinds:
        if compared[key] is not None:
            bells = " with fitted Gaussians" if key == "vertical" else ""
            alt = f"{title}: histograms{bells}. {_in_words(compared[key])}"
            figure = _histogram(compared[key], label, bell=key == "vertical")
            pictures.append(Picture(f"histogram_{key}", title, alt, figure))
    return pictures


def _in_words(pair: Plain) -> str:
    return " ".join(
        f"{name.capitalize()}: mean {s['mean_m']:.3f} m, standard deviation {s['sd_m']:.3f} m."
        for when, name, _ in _TIMES
        if pair[when] is not None and (s := pair[when]["statistics"])
    )


def _histogram(pair: Plain, label: str, *, bell: bool) -> Figure:
    known = [(when, name, colour) for when, name, colour in _TIMES if pair[when] is not None]
    figure, panels = new_figure(8.0, 2.4 * len(known) + 0.4, nrows=len(known), squeeze=False)
    for axes, (when, name, colour) in zip(panels[:, 0], known, strict=True):
        s, h = pair[when]["statistics"], pair[when]["histogram"]
        edges, counts = np.array(h["edges_m"]), np.array(h["counts"], float)
        density = counts / (s["count"] * np.diff(edges))
        text = f"{name}: mean {s['mean_m']:.3f}, sd {s['sd_m']:.3f} m"
        axes.stairs(density, edges, fill=True, color=colour, alpha=0.55, label=text)
        if bell and s["sd_m"] > 0.0:
            x = np.linspace(edges[0], edges[-1], 200)
            y = np.exp(-0.5 * ((x - s["mean_m"]) / s["sd_m"]) ** 2)
            axes.plot(x, y / (s["sd_m"] * np.sqrt(2.0 * np.pi)), color=colour)
        axes.set_ylabel("Density")
        axes.legend(loc="upper right")
    panels[-1, 0].set_xlabel(label)
    return figure


def _by_depth(compared: Plain) -> list[Picture]:
    kinds = (
        ("depth_bins", "Error against depth", "Reference depth (m)"),
        ("shore_bins", "Error against distance from shore", "Distance from the shore (m)"),
    )
    return [
        Picture(
            key, title,
            f"{title}: mean and standard deviation of the vertical error in {len(compared[key])}"
            " classes, before and after the correction.",
            _errors(compared[key], label),
        )
        for key, title, label in kinds
        if compared[key]
    ]  # fmt: skip


def _errors(bins: list[Plain], label: str) -> Figure:
    figure, axes = new_figure()
    axes.axhline(0.0, color="0.5", linewidth=0.8)
    for when, name, colour in _TIMES:
        known = [b for b in bins if b[when] is not None]
        if known:
            middle = [(b["from_m"] + b["to_m"]) / 2.0 for b in known]
            mean, sd = ([b[when][key] for b in known] for key in ("mean_m", "sd_m"))
            axes.errorbar(middle, mean, sd, fmt="o-", color=colour, capsize=3, label=name)
    axes.set_xlabel(label)
    axes.set_ylabel("Cloud minus reference, Z (m)")
    axes.legend(loc="best")
    return figure


def _sections(sections: list[Plain]) -> list[Picture]:
    return [
        Picture(
            f"section_{number}", f"Cross-section {number}",
            f"Heights along a line of {section['distance_m'][-1]:.0f} m: water surface, the cloud"
            " as it came, corrected, and the reference.",
            _section(section),
        )
        for number, section in enumerate(sections, start=1)
    ]  # fmt: skip


def _section(section: Plain) -> Figure:
    figure, axes = new_figure(8.0, 4.0)
    looks: dict[str, dict[str, Any]] = {
        "water": {"color": WATER, "linewidth": 1.2},
        "reference": {"color": REFERENCE, "linewidth": 2.5, "alpha": 0.45},
        "apparent": {"color": BEFORE, "linestyle": "--"},
        "corrected": {"color": AFTER},
    }
    names = {"apparent": "as it came"}
    for key, look in looks.items():
        if key in section["heights_m"]:
            heights = np.array(section["heights_m"][key], float)
            axes.plot(section["distance_m"], heights, label=names.get(key, key), **look)
    _label(axes)
    return figure


def _label(axes: Axes) -> None:
    axes.set_xlabel("Distance along the line (m)")
    axes.set_ylabel("Height (m)")
    axes.legend(loc="best")


def _statistics(compared: Plain) -> Table:
    header = ["", "points", "mean", "sd", "RMSE", "NMAD", "median", "95 %"]
    rows = []
    kinds = (("vertical", "Vertical error"), ("m3c2", "M3C2 distance"), ("c2c", "C2C distance"))
    for key, kind in kinds:
        for when, name, _ in _TIMES:
            if compared[key] is not None and compared[key][when] is not None:
                s = compared[key][when]["statistics"]
                names = ("mean_m", "sd_m", "rmse_m", "nmad_m", "median_m")
                figures = [f"{s[n]:.3f}" for n in names] + [f"{s['percentiles_m']['p95']:.3f}"]
                rows.append([f"{kind}, {name}", f"{s['count']:,}", *figures])
    title = f"Against {compared['reference'].rsplit('/', 1)[-1]} (m)"
    return Table(title, header, rows)


def _bins(compared: Plain) -> list[Table]:
    tables = []
    if compared["depth"] is not None:
        rows = [
            [name, f"{fit['slope']:.4f}", f"{fit['intercept_m']:.3f}", f"{fit['r2']:.4f}"]
            for when, name, _ in _TIMES
            if (fit := compared["depth"][when]) is not None
        ]
        header = ["", "slope", "intercept (m)", "r²"]
        tables.append(Table("Depth against reference depth", header, rows))
    if compared["depth_bins"]:
        header = ["Depth (m)", "points"]
        header += [
            f"{n}, {w}" for w in ("as it came", "corrected") for n in ("bias", "RMSE", "NMAD")
        ]
        tables.append(Table("By depth (m)", header, [_bin(b) for b in compared["depth_bins"]]))
    return tables


def _bin(one: Plain) -> list[str]:
    figures = [
        "" if one[when] is None else f"{one[when][key]:.3f}"
        for when, _, _ in _TIMES
        for key in ("mean_m", "rmse_m", "nmad_m")
    ]
    return [f"{one['from_m']:g} to {one['to_m']:g}", f"{one['after']['count']:,}", *figures]
