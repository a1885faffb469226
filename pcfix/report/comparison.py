"""A comparison with a reference: its text, and the pictures and tables that it adds to a page.

Pictures and tables work on the plain values of `Comparison.as_dict`, so that a run that resumes
can draw what an earlier one measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.colours import DIFFERENCE
from pcfix.model import FloatArray
from pcfix.options.steps import LAYERS
from pcfix.report.c2c import (
    TIMES,
    Plain,
    bell,
    c2c_figure,
    c2c_lines,
    c2c_rows,
    c2c_table,
    further_colour,
)
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
from pcfix.report.text import share

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pcfix.compare.figures import Comparison
    from pcfix.compare.statistics import Bin

_HEAD = ("mean", "sd", "rmse", "nmad", "median", "5 %", "95 %", "max")


def comparison_text(comparison: Comparison) -> str:
    """Return what a person wants to know of a comparison; metres throughout."""
    c, n = comparison, comparison.counts
    kind = "check points" if c.measured_at == "reference" else "points"
    whole = n.reference - n.reference_left_out if kind == "check points" else n.cloud
    lines = [
        f"{c.cloud} against {c.reference}, {c.seconds:.1f} s",
        f"compared     {n.compared:,} {kind} ({share(n.compared, whole)})",
    ]
    left = {
        "withheld or noise": n.cloud_left_out,
        "not submerged": n.not_submerged,
        "outside the overlap": n.outside_overlap,
    }
    lines += [f"  not        {count:,}: {reason}" for reason, count in left.items() if count]
    if n.by_nearest:
        lines.append(f"  no plane   {n.by_nearest:,}: the nearest point's height was taken")
    if n.reference_compared:
        whole = n.reference - n.reference_left_out
        lines.append(
            f"  C2C from   {n.reference_compared:,} points of the reference"
            f" ({share(n.reference_compared, whole)}): those about the cloud"
            f"{' and under water' if c.settings.submerged else ''}"
        )
    plain = c.as_dict()
    distances = [(f"C2C {way}, {name}", of["statistics"]) for way, name, _, of in c2c_rows(plain)]
    for table in (
        [*_table(signed_statistics(plain)), *_normal(c)],
        _table(distances) + c2c_lines(plain),
    ):
        lines += ["", *table] if table else []
    if c.own is not None:
        lines += ["", *_own(plain)]
    if c.depth is not None:
        lines += [
            "",
            *(
                f"depth fit {when:<7} depth = {line.intercept_m:+.3f} m + {line.slope:.4f} x"
                f" reference depth, r2 {line.r2:.4f}"
                for when, line in (("before", c.depth.before), ("after", c.depth.after))
                if line is not None
            ),
        ]
    for title, bins in (("depth", c.depth_bins), ("from shore", c.shore_bins)):
        lines += _bin_lines(title, bins)
    if c.m3c2 is not None:
        m = c.m3c2.after
        lines += [
            "",
            f"M3C2: {m.statistics.count:,} of {m.core_points:,} core points, normals"
            f" {m.normal_radius_m:.2f} m, cylinder {m.cylinder_radius_m:.2f} m; mean level of"
            f" detection {m.mean_level_of_detection_m:.3f} m,"
            f" {100 * m.significant_share:.0f} % of the distances beyond it",
        ]
    return "\n".join([*lines, *(f"note: {note}" for note in c.notes)])


def _own(plain: Plain) -> list[str]:
    """Return the cloud's own errors, and what was taken out for them."""
    own, title = plain["own"], "bed" if plain["own"]["of"] == "bed" else "cloud"
    raw = raw_of(plain)["after"]
    if own["rmse_m"] is None:
        return [f"of the {title} alone: {noise_sentence(own, raw)}"]
    return [
        f"of the {title} alone: RMSE {own['rmse_m']:.3f} m, 95 % {own['within_95_m']:.3f} m,"
        f" {noise_sentence(own, raw)}"
    ]


def raw_of(compared: Plain) -> Plain:
    """Return the statistics that the cloud's own errors were taken from, before and after."""
    if compared["own"]["of"] == "bed":
        return dict(compared["bed"])
    return {when: of and of["statistics"] for when, of in compared["vertical"].items()}


def noise_sentence(own: Plain, raw: Plain) -> str:
    """Say what the noise of the reference has to do with the errors of the cloud."""
    source = "assumed" if own["is_assumed"] else "stated"
    noise = f"the reference's noise ({own['sigma_reference_m']:.3f} m, {source})"
    if own["rmse_m"] is None:
        return f"the differences scatter no more than {noise}, so its own part is not known."
    return f"without {noise}; with it RMSE {raw['rmse_m']:.3f} m, 95 % {raw['within_95_m']:.3f} m."


def signed_statistics(plain: Plain) -> list[tuple[str, Plain]]:
    """Return the statistics of all that has a sign, by title."""
    rows = []
    kinds = (("dZ", "vertical"), ("dZ bed", "bed"), ("dZ land", "land"), ("M3C2", "m3c2"))
    for title, key in kinds:
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
    head = f"{'m':<{width}}" + "".join(f"{name:>9}" for name in _HEAD)
    return [head, *(f"{title:<{width}}{_figures(of)}" for title, of in rows)]


def _figures(s: Plain) -> str:
    names = ("mean_m", "sd_m", "rmse_m", "nmad_m", "median_m")
    marks = s["percentiles_m"]
    values = (*(s[name] for name in names), marks["p5"], marks["p95"], s["max_m"])
    return "".join(f"{value:9.3f}" for value in values)


def _normal(c: Comparison) -> list[str]:
    if c.vertical is None:
        return []
    normal = c.vertical.after.normal
    if normal.histogram_mu_m is None:
        return [f"note: dZ: {normal.note}"]
    return [
        f"normal fit to the histogram of dZ: mu {normal.histogram_mu_m:.3f},"
        f" sigma {normal.histogram_sigma_m:.3f}"
    ]


def _bin_lines(title: str, bins: tuple[Bin, ...]) -> list[str]:
    if not bins:
        return []
    both = bins[0].before is not None
    head = f"{title + ', m':<20}{'count':>9}{'bias':>9}{'sd':>9}{'rmse':>9}{'nmad':>9}"
    lines = ["", head + (f"{'bias':>11}{'rmse':>9}  before" if both else "")]
    for one in bins:
        s, b = one.after, one.before
        lines.append(
            f"{f'{one.from_m:g} to {one.to_m:g}':<20}{s.count:>9,}"
            + "".join(f"{value:9.3f}" for value in (s.mean_m, s.sd_m, s.rmse_m, s.nmad_m))
            + (f"{b.mean_m:11.3f}{b.rmse_m:9.3f}" if b is not None else "")
        )
    return lines


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
    """Return what the correction came to against the reference; empty where it is not known."""
    pair = compared["vertical"]
    if pair is None or pair["before"] is None:
        return ""
    is_of_bed = compared.get("bed") is not None
    if is_of_bed:
        pair = compared["bed"]
    before, after = (pair[when].get("statistics", pair[when]) for when, _, _ in TIMES)
    name = name_of(compared["reference"])
    way = "fell" if after["rmse_m"] <= before["rmse_m"] else "grew"
    twice = "".join(
        f" {n['message']}" for n in compared["notes"] if n["code"] == "cloud.corrected_twice"
    )
    return (
        f" Against {name} the vertical error{' of the bed' if is_of_bed else ''} {way} from"
        f" {before['rmse_m']:.3f} to {after['rmse_m']:.3f} m (RMSE of {after['count']:,} points,"
        f" the reference's noise included); what is left has a bias of"
        f" {signed(after['mean_m'])}.{_of_land(compared)}{twice}"
    )


def signed(value_m: float) -> str:
    """Return metres with their sign, which is plus for what rounds to zero."""
    return f"{round(value_m, 3) + 0.0:+.3f} m"


def _of_land(compared: Plain) -> str:
    """Return how land changed, where there is a bed too."""
    land = compared.get("land")
    if land is None or compared["bed"] is None:
        return ""
    return f" Land: {land['before']['rmse_m']:.3f} to {land['after']['rmse_m']:.3f} m."


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
            axes.plot(x, bell(x, s["mean_m"], s["sd_m"]), color=colour)
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
            f" as it came, corrected, the reference{''.join(f', {n}' for n in _further(section))}.",
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
    names = {"apparent": "as it came"}
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
    rows = []
    kinds = (
        ("vertical", "Vertical error"), ("bed", "Bed, vertical error"),
        ("land", "Land, vertical error"), ("m3c2", "M3C2 distance"),
    )  # fmt: skip
    for key, kind in kinds:
        for when, name, _ in TIMES:
            # comparisons from before there were bed and land do without
            if (pair := compared.get(key)) is not None and pair[when] is not None:
                s = pair[when].get("statistics", pair[when])
                rows.append([f"{kind}, {name}", *_cells(s)])
    rows += [
        [f"C2C {way}, {name}", *_cells(of["statistics"])] for way, name, _, of in c2c_rows(compared)
    ]
    title = f"Against {compared['reference'].rsplit('/', 1)[-1]} (m)"
    return Table(title, header, rows)


def _cells(s: Plain) -> list[str]:
    """Return the cells of a sample under the header of `_statistics`."""
    values = [s[n] for n in ("mean_m", "sd_m", "rmse_m", "nmad_m", "median_m")]
    values += [s["percentiles_m"]["p95"], s["max_m"]]
    return [f"{s['count']:,}", *(f"{value:.3f}" for value in values)]


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
        header = ["Depth (m)", "points"]
        header += [
            f"{n}, {w}" for w in ("as it came", "corrected") for n in ("bias", "RMSE", "NMAD")
        ]
        rows = [
            [f"{b['from_m']:g} to {b['to_m']:g}", f"{b['after']['count']:,}"]
            + [
                "" if b[when] is None else f"{b[when][key]:.3f}"
                for when, _, _ in TIMES
                for key in ("mean_m", "rmse_m", "nmad_m")
            ]
            for b in compared["depth_bins"]
        ]
        tables.append(Table("By depth (m)", header, rows))
    return tables
