"""A comparison with a reference: its summary, and the pictures and tables for the report page.

Everything works on the plain values of `Comparison.as_dict`, so that a resumed run can draw what an
earlier one measured. The terminal and the page show the same tables.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.colours import DIFFERENCE
from pcfix.model import FloatArray
from pcfix.options.steps import LAYERS
from pcfix.report.page import (
    AFTER,
    BEFORE,
    REFERENCE,
    WATER,
    Picture,
    Table,
    map_figure,
    name_of,
    new_figure,
)
from pcfix.report.text import aligned, share, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.compare.figures import Comparison

Plain = dict[str, Any]
TIMES = (("before", "uncorrected", BEFORE), ("after", "corrected", AFTER))
SIGNED = {
    "vertical": ("dZ", "Vertical error"),
    "bed": ("dZ bed", "Bed, vertical error"),
    "land": ("dZ land", "Land, vertical error"),
    "m3c2": ("M3C2", "M3C2 distance"),
}
"""Errors with a sign: their names in the tables of Python and of the page."""
MOMENTS = {
    "mean": "mean_m", "sd": "sd_m", "RMSE": "rmse_m", "NMAD": "nmad_m", "median": "median_m",
}  # fmt: skip
BINS = {
    "depth_bins": ("By depth (m)", "Error against depth", "Reference depth (m)"),
    "shore_bins": (
        "By distance from shore (m)", "Error against distance from shore",
        "Distance from the shore (m)",
    ),
}  # fmt: skip
"""Their titles as a table and as a picture, and the label of the axis."""
_SHOWN = 0.995
"""The share of the distances of each histogram up to which the axis reaches at least."""


# Numbers


def signed_statistics(compared: Plain) -> list[tuple[str, str, Plain]]:
    """Return every error that has a sign: its titles in Python and on the page, and statistics."""
    found = []
    for key, (short, title) in SIGNED.items():
        for when, name, _ in TIMES:
            if (one := (compared.get(key) or {}).get(when)) is not None:
                label = f"{short} {when}" if compared[key]["before"] else short
                found.append((label, f"{title}, {name}", one.get("statistics", one)))
    return found


def c2c_rows(compared: Plain) -> list[tuple[str, str, str, Plain]]:
    """Return direction, cloud, colour and distribution of all C2C, a direction after the other."""
    rows = []
    for key, way in (("c2c", "to reference"), ("c2c_from_reference", "from reference")):
        pair = compared.get(key) or {}
        if key == "c2c" and compared["measured_at"] == "reference":
            way = "from check points"
        for when, name, colour in TIMES:
            if pair.get(when) is not None:
                rows.append((way, "cloud" if pair["before"] is None else name, colour, pair[when]))
        for number, one in enumerate(compared.get("also", ())):
            if one[key] is not None:
                rows.append((way, one["name"], further_colour(number), one[key]))
    return rows


def raw_of(compared: Plain) -> Plain:
    """Return the statistics that the cloud's own errors were taken from, before and after."""
    if compared["own"]["of"] == "bed":
        return dict(compared["bed"])
    return {when: of and of["statistics"] for when, of in compared["vertical"].items()}


# Words


def comparison_text(c: Comparison) -> str:
    """Return the summary of a comparison; metres throughout."""
    plain, n = c.as_dict(), c.counts
    checks = c.measured_at == "reference"
    in_reference = n.reference - n.reference_left_out
    compared = share(n.compared, in_reference if checks else n.cloud)
    rows = [("Compared", f"{n.compared:,} {'check points' if checks else 'points'} ({compared})")]
    ignored = {
        "withheld or noise": n.cloud_left_out,
        "not submerged": n.not_submerged,
        "outside the overlap": n.outside_overlap,
    }
    rows += [("", f"{count:,} ignored: {why}") for why, count in ignored.items() if count]
    if n.reference_compared:
        of = share(n.reference_compared, in_reference)
        rows.append(("C2C from", f"{n.reference_compared:,} points of the reference ({of})"))
    if c.own is not None:
        own, noise = plain["own"], noise_sentence(plain["own"], raw_of(plain)["after"])
        if own["rmse_m"] is not None:
            noise = f"RMSE {own['rmse_m']:.3f} m, 95 % within {own['within_95_m']:.3f} m, {noise}"
        rows.append(("Bed" if own["of"] == "bed" else "Cloud", noise))
    if c.m3c2 is not None:
        m = c.m3c2.after
        rows.append(("M3C2", f"{m.statistics.count:,} of {m.core_points:,} core points, normals"
                     f" {m.normal_radius_m:.2f} m, cylinder {m.cylinder_radius_m:.2f} m; mean level"
                     f" of detection {m.mean_level_of_detection_m:.3f} m,"
                     f" {100 * m.significant_share:.0f} % of the distances beyond it"))  # fmt: skip
    head = f"Compared {c.cloud} with {c.reference} in {c.seconds:.1f} s"
    tables = [line for table in _tables(plain) for line in ("", *table.lines())]
    notes = [wrapped("", f"Note: {note}") for note in c.notes]
    return "\n".join([aligned(head, rows), *tables, *notes])


def noise_sentence(own: Plain, raw: Plain) -> str:
    """Return how the noise of the reference changes the errors of the cloud."""
    source = "assumed" if own["is_assumed"] else "stated"
    noise = f"the noise of the reference ({own['sigma_reference_m']:.3f} m, {source})"
    if own["rmse_m"] is None:
        return f"the differences scatter no more than {noise}, so the cloud's error is not known."
    return (
        f"without {noise}; with it RMSE {raw['rmse_m']:.3f} m, 95 % within"
        f" {raw['within_95_m']:.3f} m."
    )


def signed(value_m: float) -> str:
    """Return metres with their sign, which is plus for what rounds to zero."""
    return f"{round(value_m, 3) + 0.0:+.3f} m"


def gauss(of: Plain) -> str:
    """Return the normal distribution fitted to distances, in CloudCompare's words."""
    s, classes = of["statistics"], len(of["histogram"]["counts"])
    return f"Gauss: mean = {s['mean_m']:.6f} / std.dev. = {s['sd_m']:.6f} [{classes} classes]"


# Tables


def _tables(compared: Plain) -> list[Table]:
    """Return the tables for terminal and page; those without rows are omitted."""
    names = {when: name for when, name, _ in TIMES}
    c2c = c2c_rows(compared)
    found = [(title, s) for _, title, s in signed_statistics(compared)]
    found += [(f"C2C {way}, {name}", of["statistics"]) for way, name, _, of in c2c]
    rows = []
    for title, s in found:
        marks = s["percentiles_m"]
        values = [*(s[key] for key in MOMENTS.values()), marks["p5"], marks["p95"], s["max_m"]]
        rows.append([title, f"{s['count']:,}", *(f"{value:z.3f}" for value in values)])
    title = f"Against {name_of(compared['reference'])} (m)"
    tables = [Table(title, ["", "points", *MOMENTS, "5 %", "95 %", "max"], rows)]

    bands = c2c[0][-1].get("shares", ()) if c2c else ()
    header = ["", "mean (m)", "std.dev. (m)", "classes"]
    header += [f"{one['low_m']:g} to {one['high_m']:g} m" for one in bands]
    rows = [
        [
            f"{way}, {name}", f"{of['statistics']['mean_m']:.6f}",
            f"{of['statistics']['sd_m']:.6f}", str(len(of["histogram"]["counts"])),
            *(f"{100 * one['share']:.1f} %" for one in of.get("shares", ())),
        ]
        for way, name, _, of in c2c
    ]  # fmt: skip
    tables.append(Table("C2C, normal distribution", header, rows))

    lines = [(name, (compared["depth"] or {}).get(when)) for when, name, _ in TIMES]
    rows = [
        [name, f"{fit['slope']:.4f}", f"{fit['intercept_m']:+z.3f}", f"{fit['r2']:.4f}"]
        for name, fit in lines
        if fit is not None
    ]
    header = ["", "slope", "intercept (m)", "r²"]
    tables.append(Table("Depth against reference depth", header, rows))

    # of each class of depth or of distance from the shore
    figures = {"bias": "mean_m", "sd": "sd_m", "RMSE": "rmse_m", "NMAD": "nmad_m"}
    first, *others = figures
    header = ["", "points", *(one for n in names.values() for one in (f"{n}: {first}", *others))]
    for key, (title, _, _) in BINS.items():
        rows = []
        for one in compared[key]:
            both = [one[when] for when in names]
            cells = ["" if s is None else f"{s[of]:z.3f}" for s in both for of in figures.values()]
            name = f"{one['from_m']:g} to {one['to_m']:g}"
            rows.append([name, f"{one['after']['count']:,}", *cells])
        tables.append(Table(title, header, rows))
    return [table for table in tables if table.rows]


# Pictures


def evaluation(
    compared: Plain,
    sections: list[Plain],
    dod: tuple[FloatArray, tuple[float, float, float, float]] | None = None,
) -> tuple[list[Picture], list[Table]]:
    """Return pictures and tables of a `Comparison.as_dict`.

    `sections` have ``distance_m`` and ``heights_m`` as lists, None where nothing is known; `dod` is
    the difference of the surfaces, shape (rows, columns), metres, and its west, east, south, north.
    """
    pictures, pair = [], compared["vertical"]
    if pair is not None:
        times = [(name, colour, pair[when]) for when, name, colour in TIMES if pair[when]]
        figure, panels = new_figure(8.0, 2.4 * len(times) + 0.4, nrows=len(times), squeeze=False)
        for axes, (name, colour, of) in zip(panels[:, 0], times, strict=True):
            s = of["statistics"]
            label = f"{name}: mean {s['mean_m']:.3f}, sd {s['sd_m']:.3f} m"
            _histogram(axes, of, color=colour, label=label)
        panels[-1, 0].set_xlabel("Cloud minus reference, Z (m)")
        alt = "Vertical error: histograms with fitted Gaussians; the table has their figures."
        pictures.append(Picture("histogram_vertical", "Vertical error", alt, figure))
    title = "Distance to the nearest point (C2C)"
    alt = f"{title}: histograms with fitted Gaussians; the table has their figures."
    sparse = ("cloud.sparse", "reference.sparse")
    alt += "".join(f" {one['message']}" for one in compared["notes"] if one["code"] in sparse)
    pictures.append(Picture("histogram_c2c", title, alt, c2c_figure(compared)))
    if dod is not None:
        reach = float(np.nanpercentile(np.abs(dod[0]), 98.0))
        alt = (
            "Map of the corrected surface minus the reference surface; blue where the cloud is"
            f" lower. 98 % of the cells differ by less than {reach:.2f} m."
        )
        figure = map_figure(*dod, "Cloud minus reference (m)", cmap=DIFFERENCE, vmin=-reach,
                            vmax=reach)  # fmt: skip
        pictures.append(Picture("dod", "Difference of the surfaces (DoD)", alt, figure))
    pictures += [
        Picture(
            key, title,
            f"{title}: mean and standard deviation of the vertical error in {len(compared[key])}"
            " classes, before and after the correction.",
            _errors(compared[key], label),
        )
        for key, (_, title, label) in BINS.items() if compared[key]
    ]  # fmt: skip
    pictures += [_section(number, one) for number, one in enumerate(sections, start=1)]
    return pictures, _tables(compared)


def c2c_figure(compared: Plain) -> Figure:
    """Draw all histograms with their Gauss: a column a direction, a row a cloud, one axis."""
    rows = c2c_rows(compared)
    ways = list(dict.fromkeys(way for way, *_ in rows))
    count = len(rows) // len(ways)  # each direction has the same clouds
    figure, panels = new_figure(
        7.5 * len(ways) + 0.5, 2.4 * count + 0.4, nrows=count, ncols=len(ways), sharex=True,
        squeeze=False,
    )  # fmt: skip
    reach = 0.0
    for axes, (way, name, colour, of) in zip(panels.T.flat, rows, strict=True):
        label = f"{name}, {way}; largest {of['statistics']['max_m']:.3f} m"
        _histogram(axes, of, color=colour, label=label)
        axes.set_title(gauss(of), fontsize="medium")
        # the upper edge of the class in which the last of the distances shown lies
        up_to = np.cumsum(of["histogram"]["counts"])
        last = int(np.searchsorted(up_to, _SHOWN * up_to[-1]))
        reach = max(reach, of["histogram"]["edges_m"][1 + last])
    panels[0, 0].set_xlim(0.0, reach)
    for axes in panels[-1]:
        axes.set_xlabel("Distance to the nearest point (m)")
    return figure


def _histogram(axes: Axes, of: Plain, **look: Any) -> None:
    """Draw a distribution, and the normal distribution of its mean and standard deviation."""
    from scipy.stats import norm

    edges, counts = (np.array(of["histogram"][key]) for key in ("edges_m", "counts"))
    axes.stairs(counts, edges, fill=True, alpha=0.55, **look)
    mean, sd = of["statistics"]["mean_m"], of["statistics"]["sd_m"]
    if sd > 1e-12 * abs(mean):
        x = np.linspace(edges[0], edges[-1], 2000)
        area = of["statistics"]["count"] * (edges[1] - edges[0])
        axes.plot(x, area * norm.pdf(x, mean, sd), color="0.15")
    axes.set_ylabel("Count")
    axes.legend(loc="upper right")


def _errors(bins: list[Plain], label: str) -> Figure:
    figure, axes = new_figure()
    axes.axhline(0.0, color="0.5", linewidth=0.8)
    for when, name, colour in TIMES:
        known = [b for b in bins if b[when] is not None]
        if known:
            middle = [(b["from_m"] + b["to_m"]) / 2.0 for b in known]
            mean, sd = ([b[when][key] for b in known] for key in ("mean_m", "sd_m"))
            axes.errorbar(middle, mean, sd, fmt="o-", color=colour, capsize=3, label=name)
    axes.set(xlabel=label, ylabel="Cloud minus reference, Z (m)")
    axes.legend(loc="best")
    return figure


def further_colour(number: int) -> str:
    """Return the colour of a further cloud, by its number from 0."""
    return ("#6a3d9a", "#33804d", "#c51b7d", "#8c6d1f", "#5f6b73")[number % 5]


def _section(number: int, section: Plain) -> Picture:
    figure, axes = new_figure(8.0, 4.0)
    further = [name for name in section["heights_m"] if name not in LAYERS]
    looks: dict[str, dict[str, Any]] = {
        "water": {"color": WATER, "linewidth": 1.2},
        "reference": {"color": REFERENCE, "linewidth": 2.5, "alpha": 0.45},
        "apparent": {"color": BEFORE, "linestyle": "--", "label": "uncorrected"},
        "corrected": {"color": AFTER},
    }
    looks |= {
        name: {"color": further_colour(i), "linewidth": 1.0} for i, name in enumerate(further)
    }
    for key, look in looks.items():
        if key in section["heights_m"]:
            heights = np.array(section["heights_m"][key], float)
            axes.plot(section["distance_m"], heights, **{"label": key} | look)
    axes.set(xlabel="Distance along the line (m)", ylabel="Height (m)")
    axes.legend(loc="best")
    alt = (
        f"Heights along a line of {section['distance_m'][-1]:.0f} m: water surface, the cloud"
        f" before and after, reference{''.join(f', {name}' for name in further)}."
    )
    return Picture(f"section_{number}", f"Cross-section {number}", alt, figure)
