"""A comparison with a reference: its summary, and the pictures and tables for the report page.

Everything works on the plain values of `Comparison.as_dict`, so that a resumed run can draw what an
earlier one measured. The terminal and the page show the same tables.
"""

from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.grid.lattice import Lattice
from pcfix.grid.maps import DIFFERENCE
from pcfix.model import FloatArray
from pcfix.options.steps import LAYERS
from pcfix.report.page import AFTER, BEFORE, WATER, Picture, Table, map_figure, name_of, new_figure
from pcfix.report.text import Plain, RowTable, aligned, filled, wrapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TIMES = (("before", "uncorrected", BEFORE), ("after", "corrected", AFTER))
FURTHER = ("#6a3d9a", "#33804d", "#c51b7d", "#8c6d1f", "#5f6b73")  # of further clouds, in turn
# The errors of a comparison, and their titles.
KINDS = {
    "vertical": "Vertical error",
    "bed": "Bed, vertical error",
    "land": "Land, vertical error",
    "m3c2": "M3C2 distance",
    "c2c": "C2C to reference",
    "c2c_from_reference": "C2C from reference",
}
MOMENTS = {
    "mean": "mean_m", "sd": "sd_m", "RMSE": "rmse_m", "NMAD": "nmad_m", "median": "median_m",
}  # fmt: skip


class Errors(NamedTuple):
    """One kind of error of one cloud."""

    title: str  # with the name of the cloud
    colour: str
    found: Plain  # statistics, with a histogram where there is one


def errors_of(compared: Plain, *kinds: str) -> list[Errors]:
    """Return the errors of some of `KINDS`, one kind after the other."""
    rows = []
    for kind in kinds:
        title = KINDS[kind]
        if kind == "c2c" and compared["measured_at"] == "reference":
            title = "C2C from check points"
        pair = compared[kind] or {}
        for when, cloud, colour in TIMES:
            if (found := pair.get(when)) is not None:
                name = cloud if pair["before"] else "cloud"
                rows.append(Errors(f"{title}, {name}", colour, found))
        for one, colour in zip(compared["also"], cycle(FURTHER), strict=False):
            if one.get(kind) is not None:
                rows.append(Errors(f"{title}, {one['name']}", colour, one[kind]))
    return rows


# Words

_FACTS: RowTable = (
    ("Compared", "{counts[compared]:,} {is_checks:?check points|points}"
     " ({counts[compared]:of in_all})", ""),
    ("", "{counts[cloud_excluded]:,} ignored: withheld or noise", "counts[cloud_excluded]"),
    ("", "{counts[not_submerged]:,} ignored: not submerged", "counts[not_submerged]"),
    ("", "{counts[outside_overlap]:,} ignored: outside the overlap", "counts[outside_overlap]"),
    ("C2C from", "{counts[reference_compared]:,} points of the reference"
     " ({counts[reference_compared]:of in_reference})", "counts[reference_compared]"),
    ("M3C2", "{m3c2[after][statistics][count]:,} of {m3c2[after][core_points]:,} core points,"
     " normals {m3c2[after][normal_radius_m]:.2f} m, cylinder {m3c2[after][cylinder_radius_m]:.2f}"
     " m; mean level of detection {m3c2[after][mean_level_of_detection_m]:.3f} m,"
     " {m3c2[after][significant_share]:.0f %} of the distances beyond it", "m3c2"),
)  # fmt: skip


def comparison_text(compared: Plain) -> str:
    """Return the summary of a comparison; metres throughout."""
    counts, is_checks = compared["counts"], compared["measured_at"] == "reference"
    in_reference = counts["reference"] - counts["reference_excluded"]
    rows = filled(_FACTS, compared | {
        "is_checks": is_checks, "in_reference": in_reference,
        "in_all": in_reference if is_checks else counts["cloud"],
    })  # fmt: skip
    head = "Compared {cloud} with {reference} in {seconds:.1f} s".format_map(compared)
    tables = [line for table in _tables(compared) for line in ("", *table.lines())]
    notes = [wrapped("", f"Note: {note['message']}") for note in compared["notes"]]
    return "\n".join([aligned(head, rows), *tables, *notes])


# Tables


def _tables(compared: Plain) -> list[Table]:
    """Return the tables for terminal and page; those without rows are omitted."""
    rows = []
    for one in errors_of(compared, *KINDS):
        s = one.found.get("statistics", one.found)
        marks = s["percentiles_m"]
        values = [*(s[key] for key in MOMENTS.values()), marks["p5"], marks["p95"], s["max_m"]]
        rows.append([one.title, f"{s['count']:,}", *(f"{value:z.3f}" for value in values)])
    title = f"Against {name_of(compared['reference'])} (m)"
    tables = [Table(title, ["", "points", *MOMENTS, "5 %", "95 %", "max"], rows)]

    header, rows = [""], []
    for one in errors_of(compared, "c2c", "c2c_from_reference"):
        if bands := one.found["shares"]:
            header = ["", *(f"{band['low_m']:g} to {band['high_m']:g} m" for band in bands)]
            rows.append([one.title, *(f"{100 * band['share']:.1f} %" for band in bands)])
    tables.append(Table("Shares of the distances", header, rows))

    rows = [
        [name, f"{fit['slope']:.4f}", f"{fit['intercept_m']:+z.3f}", f"{fit['r2']:.4f}"]
        for when, name, _ in TIMES
        if (fit := (compared["depth"] or {}).get(when)) is not None
    ]
    header = ["", "slope", "intercept (m)", "r²"]
    tables.append(Table("Depth against reference depth", header, rows))

    header, rows = ["", "points"], []
    for _, name, _ in TIMES:
        header += [f"{name}: bias", "sd", "RMSE", "NMAD"]
    for one in compared["depth_bins"]:
        row = [f"{one['from_m']:g} to {one['to_m']:g}", f"{one['after']['count']:,}"]
        for when, _, _ in TIMES:
            keys, s = ("mean_m", "sd_m", "rmse_m", "nmad_m"), one[when]
            row += ["" if s is None else f"{s[key]:z.3f}" for key in keys]
        rows.append(row)
    tables.append(Table("By depth (m)", header, rows))
    return [table for table in tables if table.rows]


# Pictures


def evaluation(
    compared: Plain, sections: list[Plain], lattice: Lattice, difference_m: FloatArray | None
) -> tuple[list[Picture], list[Table]]:
    """Return pictures and tables of a `Comparison.as_dict`.

    `sections` have ``distance_m`` and ``heights_m`` as lists, None where nothing is known; the
    difference of the surfaces has the shape (rows, columns) of the cells of the lattice.
    """
    pictures, words = [], "histograms with fitted Gaussians; the table has their figures."
    if vertical := errors_of(compared, "vertical"):
        figure = _histograms([vertical], "Cloud minus reference, Z (m)", sharex=False)
        title = "Vertical error"
        pictures.append(Picture("histogram_vertical", title, f"{title}: {words}", figure))
    title = "Distance to the nearest point (C2C)"
    pictures.append(Picture("histogram_c2c", title, f"{title}: {words}", c2c_figure(compared)))
    if difference_m is not None:
        reach = float(np.nanpercentile(np.abs(difference_m), 98.0))
        alt = (
            "Map of the corrected surface minus the reference surface; blue where the cloud is"
            f" lower. 98 % of the cells differ by less than {reach:.2f} m."
        )
        look: dict[str, Any] = {"cmap": DIFFERENCE, "vmin": -reach, "vmax": reach}
        figure = map_figure(difference_m, lattice, "Cloud minus reference (m)", **look)
        pictures.append(Picture("dod", "Difference of the surfaces (DoD)", alt, figure))
    if bins := compared["depth_bins"]:
        alt = (
            f"Error against depth: mean and standard deviation of the vertical error in {len(bins)}"
            " classes, before and after the correction."
        )
        figure, axes = new_figure()
        axes.axhline(0.0, color="0.5", linewidth=0.8)
        for when, name, colour in TIMES:
            if known := [b for b in bins if b[when] is not None]:
                middle = [(b["from_m"] + b["to_m"]) / 2.0 for b in known]
                mean, sd = ([b[when][key] for b in known] for key in ("mean_m", "sd_m"))
                axes.errorbar(middle, mean, sd, fmt="o-", color=colour, capsize=3, label=name)
        axes.set(xlabel="Reference depth (m)", ylabel="Cloud minus reference, Z (m)")
        axes.legend(loc="best")
        pictures.append(Picture("depth_bins", "Error against depth", alt, figure))
    pictures += [_section(number, one) for number, one in enumerate(sections, start=1)]
    return pictures, _tables(compared)


def c2c_figure(compared: Plain) -> "Figure":
    """Draw the histograms of all C2C: a column a direction, a row a cloud, one axis."""
    both = (errors_of(compared, kind) for kind in ("c2c", "c2c_from_reference"))
    columns = [one for one in both if one]
    figure = _histograms(columns, "Distance to the nearest point (m)", sharex=True)
    # nearly all distances, but not the outliers
    ends = [one.found["statistics"]["percentiles_m"]["p95"] for some in columns for one in some]
    figure.axes[0].set_xlim(0.0, 1.25 * max(*ends, 1e-6))
    return figure


def _histograms(columns: list[list[Errors]], label: str, *, sharex: bool) -> "Figure":
    """Draw distributions with the normal distributions of their means and standard deviations."""
    from scipy.stats import norm

    rows = len(columns[0])  # each direction has the same clouds
    size = 7.5 * len(columns) + 0.5, 2.4 * rows + 0.4
    grid: dict[str, Any] = {"nrows": rows, "ncols": len(columns), "squeeze": False}
    figure, panels = new_figure(*size, sharex=sharex, **grid)
    for axes, one in zip(panels.T.flat, (one for some in columns for one in some), strict=True):
        s, histogram = one.found["statistics"], one.found["histogram"]
        edges, counts, mean, sd = histogram["edges_m"], histogram["counts"], s["mean_m"], s["sd_m"]
        name = f"{one.title}; {s['min_m']:.3f} to {s['max_m']:.3f} m"
        axes.stairs(counts, edges, fill=True, alpha=0.55, color=one.colour, label=name)
        if sd > 1e-12 * abs(mean):
            x = np.linspace(edges[0], edges[-1], 2000)
            axes.plot(x, s["count"] * (edges[1] - edges[0]) * norm.pdf(x, mean, sd), color="0.15")
        axes.set_ylabel("Count")
        axes.legend(loc="upper right")
        # in CloudCompare's words
        words = f"Gauss: mean = {mean:.6f} / std.dev. = {sd:.6f} [{len(counts)} classes]"
        axes.set_title(words, fontsize="medium")
    for axes in panels[-1]:
        axes.set_xlabel(label)
    return figure


def _section(number: int, section: Plain) -> Picture:
    """Draw the heights along a line."""
    figure, axes = new_figure(8.0, 4.0)
    heights, further = section["heights_m"], [n for n in section["heights_m"] if n not in LAYERS]
    colours = {"water": WATER, "reference": "0.65", "apparent": BEFORE, "corrected": AFTER}
    colours |= dict(zip(further, cycle(FURTHER), strict=False))
    for name, colour in colours.items():
        if name in heights:
            line = np.array(heights[name], float)
            label = "uncorrected" if name == "apparent" else name
            width = 2.5 if name == "reference" else 1.2  # it lies under the others
            axes.plot(section["distance_m"], line, color=colour, linewidth=width, label=label)
    axes.set(xlabel="Distance along the line (m)", ylabel="Height (m)")
    axes.legend(loc="best")
    alt = (
        f"Heights along a line of {section['distance_m'][-1]:.0f} m: water surface, the cloud"
        f" before and after, reference{''.join(f', {name}' for name in further)}."
    )
    return Picture(f"section_{number}", f"Cross-section {number}", alt, figure)
