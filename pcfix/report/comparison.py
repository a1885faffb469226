"""A comparison with a reference: its summary, and the pictures and tables for the report page.

Everything works on the plain values of `Comparison.as_dict`, so that a resumed run can draw what an
earlier one measured.
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
    name_of,
    new_figure,
    new_map,
)
from pcfix.report.text import aligned, share

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pcfix.compare.figures import Comparison

Plain = dict[str, Any]
TIMES = (("before", "uncorrected", BEFORE), ("after", "corrected", AFTER))
SIGNED = (
    ("dZ", "Vertical error", "vertical"),
    ("dZ bed", "Bed, vertical error", "bed"),
    ("dZ land", "Land, vertical error", "land"),
    ("M3C2", "M3C2 distance", "m3c2"),
)
"""What has a sign: its name in tables of the terminal and of the page, and its key."""
MOMENTS = ("mean_m", "sd_m", "rmse_m", "nmad_m", "median_m")
_HEAD = ("mean", "sd", "rmse", "nmad", "median", "5 %", "95 %", "max")
_SHOWN = 0.995
"""The share of the distances of each histogram up to which the axis reaches at least."""


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
    if n.by_nearest:
        rows.append(("No plane", f"{n.by_nearest:,} points were compared with the nearest height"))
    if n.reference_compared:
        of = share(n.reference_compared, in_reference)
        rows.append(("C2C from", f"{n.reference_compared:,} points of the reference ({of})"))
    if c.own is not None:
        rows.append(_own_row(plain))
    for when, line in () if c.depth is None else (
        ("before", c.depth.before), ("after", c.depth.after),
    ):  # fmt: skip
        if line is not None:
            words = f"{line.intercept_m:+.3f} m + {line.slope:.4f} x reference depth"
            rows.append((f"Depth {when}", f"{words}, r2 {line.r2:.4f}"))
    if c.m3c2 is not None:
        m = c.m3c2.after
        rows.append(("M3C2", f"{m.statistics.count:,} of {m.core_points:,} core points, normals"
                     f" {m.normal_radius_m:.2f} m, cylinder {m.cylinder_radius_m:.2f} m; mean level"
                     f" of detection {m.mean_level_of_detection_m:.3f} m,"
                     f" {100 * m.significant_share:.0f} % of the distances beyond it"))  # fmt: skip
    rows += c2c_lines(plain)
    distances = [(f"C2C {way}, {name}", of["statistics"]) for way, name, _, of in c2c_rows(plain)]
    text = [
        aligned(f"Compared {c.cloud} with {c.reference} in {c.seconds:.1f} s", rows),
        *_table(signed_statistics(plain) + distances),
        *_bin_lines("depth", plain["depth_bins"]),
        *_bin_lines("from shore", plain["shore_bins"]),
        *(f"Note: {note}" for note in c.notes),
    ]
    return "\n".join(text)


def _own_row(plain: Plain) -> tuple[str, str]:
    """Return the cloud's own errors, without the noise of the reference."""
    own, raw = plain["own"], raw_of(plain)["after"]
    noise = noise_sentence(own, raw)
    if own["rmse_m"] is not None:
        noise = f"RMSE {own['rmse_m']:.3f} m, 95 % {own['within_95_m']:.3f} m, {noise}"
    return ("Bed" if own["of"] == "bed" else "Cloud"), noise


def raw_of(compared: Plain) -> Plain:
    """Return the statistics that the cloud's own errors were taken from, before and after."""
    if compared["own"]["of"] == "bed":
        return dict(compared["bed"])
    return {when: of and of["statistics"] for when, of in compared["vertical"].items()}


def noise_sentence(own: Plain, raw: Plain) -> str:
    """Return how the noise of the reference changes the errors of the cloud."""
    source = "assumed" if own["is_assumed"] else "stated"
    noise = f"the reference's noise ({own['sigma_reference_m']:.3f} m, {source})"
    if own["rmse_m"] is None:
        return f"the differences scatter no more than {noise}, so the cloud's error is not known."
    return f"without {noise}; with it RMSE {raw['rmse_m']:.3f} m, 95 % {raw['within_95_m']:.3f} m."


def signed_statistics(plain: Plain) -> list[tuple[str, Plain]]:
    """Return the statistics of all that has a sign, by title."""
    rows = []
    for title, _, key in SIGNED:
        pair = plain[key] or {"before": None, "after": None}
        if pair["before"] is not None:
            rows.append((f"{title} before", pair["before"].get("statistics", pair["before"])))
            title += " after"
        if pair["after"] is not None:
            rows.append((title, pair["after"].get("statistics", pair["after"])))
    return rows


def _table(rows: list[tuple[str, Plain]]) -> list[str]:
    """Return lines of statistics under a header; none where there are none."""
    if not rows:
        return []
    width = max(20, *(len(title) + 1 for title, _ in rows))
    lines = [f"{'m':<{width}}" + "".join(f"{name:>9}" for name in _HEAD)]
    for title, s in rows:
        marks = s["percentiles_m"]
        values = (*(s[name] for name in MOMENTS), marks["p5"], marks["p95"], s["max_m"])
        lines.append(f"{title:<{width}}" + "".join(f"{value:9.3f}" for value in values))
    return lines


def _bin_lines(title: str, bins: list[Plain] | tuple[Plain, ...]) -> list[str]:
    """Return lines with the errors of each class of depth or distance."""
    lines = [f"{title + ', m':<20}{'count':>9}" + "".join(f"{n:>9}" for n in _HEAD[:4])] * bool(
        bins
    )
    for one in bins:
        s, name = one["after"], f"{one['from_m']:g} to {one['to_m']:g}"
        values = "".join(f"{s[key]:9.3f}" for key in MOMENTS[:4])
        before = one["before"]
        more = "" if before is None else f"   before {before['mean_m']:.3f}, {before['rmse_m']:.3f}"
        lines.append(f"{name:<20}{s['count']:>9,}{values}{more}")
    return lines


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


def c2c_lines(compared: Plain) -> list[tuple[str, str]]:
    """Return Gauss and shares of all distances as rows of a summary."""
    rows = []
    for way, name, _, of in c2c_rows(compared):
        rows.append(("C2C", f"{way}, {name}: {gauss(of)}"))
        shares = ", ".join(f"{part} are {band} away" for band, part in _shares(of))
        rows += [("", f"of {of['statistics']['count']:,} points {shares}")] if shares else []
    return rows


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
    from scipy.stats import norm

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
            axes.plot(x, area * norm.pdf(x, normal["mu_m"], normal["sigma_m"]), color="0.15")
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
    return pictures, [_statistics(compared), c2c_table(compared), *_bins(compared)]


def _difference(values: FloatArray, extent_m: tuple[float, float, float, float]) -> Picture:
    reach = float(np.nanpercentile(np.abs(values), 98.0))
    alt = (
        "Map of the corrected surface minus the reference surface; blue where the cloud is lower."
        f" 98 % of the cells differ by less than {reach:.2f} m."
    )
    figure, axes = new_map(extent_m)
    image = axes.imshow(values, extent=extent_m, cmap=DIFFERENCE, vmin=-reach, vmax=reach)
    figure.colorbar(image, ax=axes, label="Cloud minus reference (m)", shrink=0.9)
    return Picture("dod", "Difference of the surfaces (DoD)", alt, figure)


def in_a_sentence(compared: Plain) -> str:
    """Return what the correction changed against the reference; empty where it is not known."""
    pair = compared["vertical"]
    if pair is None or pair["before"] is None:
        return ""
    bed, land = compared.get("bed"), compared.get("land")
    before, after = ((bed or pair)[when] for when, _, _ in TIMES)
    before, after = (one.get("statistics", one) for one in (before, after))
    way = "fell" if after["rmse_m"] <= before["rmse_m"] else "grew"
    twice = "".join(
        f" {n['message']}" for n in compared["notes"] if n["code"] == "cloud.corrected_twice"
    )
    of_land = "" if not bed or land is None else (
        f" Land: {land['before']['rmse_m']:.3f} to {land['after']['rmse_m']:.3f} m."
    )  # fmt: skip
    return (
        f" Against {name_of(compared['reference'])} the vertical error"
        f"{' of the bed' if bed else ''} {way} from {before['rmse_m']:.3f} to"
        f" {after['rmse_m']:.3f} m (RMSE of {after['count']:,}"
        f" points, the reference's noise included). The remaining bias is"
        f" {signed(after['mean_m'])}.{of_land}{twice}"
    )


def signed(value_m: float) -> str:
    """Return metres with their sign, which is plus for what rounds to zero."""
    return f"{round(value_m, 3) + 0.0:+.3f} m"


def _histograms(compared: Plain) -> list[Picture]:
    pictures = []
    if compared["vertical"] is not None:
        rows = [(name, compared["vertical"][when]) for when, name, _ in TIMES]
        alt = f"Vertical error: histograms with fitted Gaussians. {_moments(rows)}"
        figure = _histogram(compared["vertical"], "Cloud minus reference, Z (m)")
        pictures.append(Picture("histogram_vertical", "Vertical error", alt, figure))
    rows = [(f"{way}, {name}", of) for way, name, _, of in c2c_rows(compared)]
    title = "Distance to the nearest point (C2C)"
    alt = f"{title}: histograms with fitted Gaussians. {_moments(rows)}"
    alt += "".join(f" {n['message']}" for n in compared["notes"] if n["code"].endswith(".sparse"))
    return [*pictures, Picture("histogram_c2c", title, alt, c2c_figure(compared))]


def _moments(rows: list[tuple[str, Plain | None]]) -> str:
    return " ".join(
        f"{name[:1].upper() + name[1:]}: mean {of['statistics']['mean_m']:.3f} m, standard"
        f" deviation {of['statistics']['sd_m']:.3f} m."
        for name, of in rows
        if of is not None
    )


def _histogram(pair: Plain, label: str) -> Figure:
    from scipy.stats import norm

    known = [(when, name, colour) for when, name, colour in TIMES if pair[when] is not None]
    figure, panels = new_figure(8.0, 2.4 * len(known) + 0.4, nrows=len(known), squeeze=False)
    for axes, (when, name, colour) in zip(panels[:, 0], known, strict=True):
        s, h = pair[when]["statistics"], pair[when]["histogram"]
        edges, counts = np.array(h["edges_m"]), np.array(h["counts"], float)
        density = counts / (s["count"] * np.diff(edges))
        text = f"{name}: mean {s['mean_m']:.3f}, sd {s['sd_m']:.3f} m"
        axes.stairs(density, edges, fill=True, color=colour, alpha=0.55, label=text)
        if s["sd_m"] > 0.0:
            x = np.linspace(edges[0], edges[-1], 200)
            axes.plot(x, norm.pdf(x, s["mean_m"], s["sd_m"]), color=colour)
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
    for when, name, colour in TIMES:
        known = [b for b in bins if b[when] is not None]
        if known:
            middle = [(b["from_m"] + b["to_m"]) / 2.0 for b in known]
            mean, sd = ([b[when][key] for b in known] for key in ("mean_m", "sd_m"))
            axes.errorbar(middle, mean, sd, fmt="o-", color=colour, capsize=3, label=name)
    axes.set(xlabel=label, ylabel="Cloud minus reference, Z (m)")
    axes.legend(loc="best")
    return figure


def _sections(sections: list[Plain]) -> list[Picture]:
    return [
        Picture(
            f"section_{number}", f"Cross-section {number}",
            f"Heights along a line of {section['distance_m'][-1]:.0f} m: water surface, the cloud"
            f" before and after, reference{''.join(f', {n}' for n in _further(section))}.",
            _section(section),
        )
        for number, section in enumerate(sections, start=1)
    ]  # fmt: skip


def _further(section: Plain) -> list[str]:
    return [name for name in section["heights_m"] if name not in LAYERS]


def _section(section: Plain) -> Figure:
    figure, axes = new_figure(8.0, 4.0)
    looks: dict[str, dict[str, Any]] = {
        "water": {"color": WATER, "linewidth": 1.2},
        "reference": {"color": REFERENCE, "linewidth": 2.5, "alpha": 0.45},
        "apparent": {"color": BEFORE, "linestyle": "--"},
        "corrected": {"color": AFTER},
    }
    names = {"apparent": "uncorrected"}
    for number, name in enumerate(_further(section)):
        looks[name] = {"color": further_colour(number), "linewidth": 1.0}
    for key, look in looks.items():
        if key in section["heights_m"]:
            heights = np.array(section["heights_m"][key], float)
            axes.plot(section["distance_m"], heights, label=names.get(key, key), **look)
    axes.set(xlabel="Distance along the line (m)", ylabel="Height (m)")
    axes.legend(loc="best")
    return figure


def _statistics(compared: Plain) -> Table:
    header = ["", "points", "mean", "sd", "RMSE", "NMAD", "median", "95 %", "max"]
    found = [
        (f"{kind}, {name}", pair[when].get("statistics", pair[when]))
        for _, kind, key in SIGNED
        for when, name, _ in TIMES
        if (pair := compared.get(key)) is not None and pair[when] is not None
    ]
    found += [(f"C2C {way}, {name}", of["statistics"]) for way, name, _, of in c2c_rows(compared)]
    rows = []
    for title, s in found:
        values = [*(s[name] for name in MOMENTS), s["percentiles_m"]["p95"], s["max_m"]]
        rows.append([title, f"{s['count']:,}", *(f"{value:.3f}" for value in values)])
    return Table(f"Against {name_of(compared['reference'])} (m)", header, rows)


def _bins(compared: Plain) -> list[Table]:
    tables = []
    if compared["depth"] is not None:
        rows = [
            [name, f"{fit['slope']:.4f}", f"{fit['intercept_m']:.3f}", f"{fit['r2']:.4f}"]
            for when, name, _ in TIMES
            if (fit := compared["depth"][when]) is not None
        ]
        header = ["", "slope", "intercept (m)", "r²"]
        tables.append(Table("Depth against reference depth", header, rows))
    if compared["depth_bins"]:
        figures = ("bias", "mean_m"), ("RMSE", "rmse_m"), ("NMAD", "nmad_m")
        header = ["Depth (m)", "points"]
        header += [f"{figure}, {name}" for _, name, _ in TIMES for figure, _ in figures]
        rows = []
        for b in compared["depth_bins"]:
            both = [b[when] for when, _, _ in TIMES]
            cells = ["" if s is None else f"{s[key]:.3f}" for s in both for _, key in figures]
            name = f"{b['from_m']:g} to {b['to_m']:g}"
            rows.append([name, f"{b['after']['count']:,}", *cells])
        tables.append(Table("By depth (m)", header, rows))
    return tables
