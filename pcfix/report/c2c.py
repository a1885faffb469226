"""C2C in a report: every direction and cloud, with the Gauss that CloudCompare writes.

All works on the plain values of `Comparison.as_dict`, as `pcfix.report.comparison` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.model import FloatArray
from pcfix.report.page import AFTER, BEFORE, Table, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Plain = dict[str, Any]
TIMES = (("before", "as it came", BEFORE), ("after", "corrected", AFTER))
_SHOWN = 0.995
"""The share of the distances of each histogram up to which the axis reaches at least."""


def c2c_rows(compared: Plain) -> list[tuple[str, str, str, Plain]]:
    """Return direction, cloud, colour and distribution of all C2C, a direction after the other."""
    rows = []
    for key, way in (("c2c", "to reference"), ("c2c_from_reference", "from reference")):
        pair = compared.get(key) or {}
        if key == "c2c" and compared["measured_at"] == "reference":
            way = "from check points"
        for when, name, colour in TIMES:
            if pair.get(when) is not None:
                alone = pair["before"] is None
                rows.append((way, "as it is" if alone else name, colour, pair[when]))
        # comparisons from before there were further clouds do without
        for number, one in enumerate(compared.get("also", ())):
            if one[key] is not None:
                rows.append((way, one["name"], further_colour(number), one[key]))
    return rows


def further_colour(number: int) -> str:
    """Return the colour of a further cloud, by its number from 0."""
    return ("#6a3d9a", "#33804d", "#c51b7d", "#8c6d1f", "#5f6b73")[number % 5]


def gauss(of: Plain) -> str:
    """Return the normal distribution fitted to distances, in CloudCompare's words."""
    normal, classes = of["normal"], len(of["histogram"]["counts"])
    return (
        f"Gauss: mean = {normal['mu_m']:.6f} / std.dev. = {normal['sigma_m']:.6f}"
        f" [{classes} classes]"
    )


def _shares(of: Plain) -> list[tuple[str, str]]:
    """Return each band with the share of distances in it."""
    return [
        (f"{one['low_m']:g} to {one['high_m']:g} m", f"{100 * one['share']:.1f} %")
        for one in of.get("shares", ())
    ]


def c2c_lines(compared: Plain) -> list[str]:
    """Return Gauss and shares of all distances as lines of text."""
    lines = []
    for way, name, _, of in c2c_rows(compared):
        lines.append(f"C2C {way}, {name}: {gauss(of)}")
        shares = ", ".join(f"{share} are {band} away" for band, share in _shares(of))
        lines += [f"  of {of['statistics']['count']:,} points {shares}"] if shares else []
    return lines


def c2c_table(compared: Plain) -> Table:
    """Return Gauss and shares of all distances as a table."""
    rows = c2c_rows(compared)
    header = ["", "mean (m)", "std.dev. (m)", "classes", *(b for b, _ in _shares(rows[0][-1]))]
    cells = [
        [
            f"{way}, {name}", f"{of['normal']['mu_m']:.6f}", f"{of['normal']['sigma_m']:.6f}",
            str(len(of["histogram"]["counts"])), *(share for _, share in _shares(of)),
        ]
        for way, name, _, of in rows
    ]  # fmt: skip
    return Table("C2C: Gauss as CloudCompare fits it", header, cells)


def c2c_figure(compared: Plain) -> Figure:
    """Draw all histograms with their Gauss: a column a direction, a row a cloud, one axis."""
    rows = c2c_rows(compared)
    ways = list(dict.fromkeys(way for way, *_ in rows))
    count = len(rows) // len(ways)  # each direction has the same clouds
    figure, panels = new_figure(
        7.5 * len(ways) + 0.5, 2.4 * count + 0.4, nrows=count, ncols=len(ways), sharex=True,
        squeeze=False,
    )  # fmt: skip
    for axes, (way, name, colour, of) in zip(panels.T.flat, rows, strict=True):
        histogram, normal = of["histogram"], of["normal"]
        edges, counts = np.array(histogram["edges_m"]), np.array(histogram["counts"])
        label = f"{name}, {way}; largest {of['statistics']['max_m']:.3f} m"
        axes.stairs(counts, edges, fill=True, color=colour, alpha=0.55, label=label)
        if normal["sigma_m"] > 0.0:
            x = np.linspace(0.0, edges[-1], 2000)
            area = counts.sum() * (edges[1] - edges[0])
            axes.plot(x, area * bell(x, normal["mu_m"], normal["sigma_m"]), color="0.15")
        axes.set_title(gauss(of), fontsize="medium")
        axes.set_ylabel("Count")
        axes.legend(loc="upper right")
    panels[0, 0].set_xlim(0.0, max(_reach(of["histogram"]) for *_, of in rows))
    for axes in panels[-1]:
        axes.set_xlabel("Distance to the nearest point (m)")
    return figure


def _reach(histogram: Plain) -> float:
    """Return the upper edge of the class in which the last of the distances shown lies."""
    up_to = np.cumsum(histogram["counts"])
    return float(histogram["edges_m"][1 + int(np.searchsorted(up_to, _SHOWN * up_to[-1]))])


def bell(x: FloatArray, mean: float, sd: float) -> FloatArray:
    """Return the density of a normal distribution."""
    return np.asarray(np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi)))
