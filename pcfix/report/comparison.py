"""A comparison with a reference: its text, and the pictures and tables that it adds to a page.

Pictures and tables work on the plain values of `Comparison.as_dict`, so that a run that resumes
can draw what an earlier one measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.compare.figures import CORRECTED_BEFORE
from pcfix.compare.statistics import Statistics
from pcfix.model import FloatArray
from pcfix.report.page import AFTER, BEFORE, REFERENCE, WATER, Picture, Table, new_figure, new_map
from pcfix.report.text import share

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pcfix.compare.figures import Comparison
    from pcfix.compare.m3c2 import M3c2
    from pcfix.compare.statistics import Bin, Distribution

Plain = dict[str, Any]
_TIMES = (("before", "as it came", BEFORE), ("after", "corrected", AFTER))
HEAD = f"{'m':<20}{'mean':>9}{'sd':>9}{'rmse':>9}{'nmad':>9}{'median':>9}{'5 %':>9}{'95 %':>9}"


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
    lines += ["", HEAD, *_rows(c), *_normal(c)]
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


def _rows(c: Comparison) -> list[str]:
    rows = []
    kinds = (
        ("dZ", c.vertical), ("dZ bed", c.bed), ("dZ land", c.land), ("C2C", c.c2c), ("M3C2", c.m3c2)
    )  # fmt: skip
    for title, pair in kinds:
        if pair is not None and pair.before is not None:
            rows.append(_row(f"{title} before", pair.before))
            title += " after"
        if pair is not None:
            rows.append(_row(title, pair.after))
    return rows


def _row(title: str, of: Statistics | Distribution | M3c2) -> str:
    s = of if isinstance(of, Statistics) else of.statistics
    marks = s.percentiles_m
    values = (s.mean_m, s.sd_m, s.rmse_m, s.nmad_m, s.median_m, marks["p5"], marks["p95"])
    return f"{title:<20}" + "".join(f"{value:9.3f}" for value in values)


def _normal(c: Comparison) -> list[str]:
    normal = (c.vertical or c.c2c).after.normal
    name = "dZ" if c.vertical else "C2C"
    if normal.histogram_mu_m is None:
        return [f"note: {name}: {normal.note}"]
    return [
        f"normal fit to the histogram of {name}: mu {normal.histogram_mu_m:.3f},"
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
    return pictures, [_statistics(compared), *_bins(compared)]


def _difference(values: FloatArray, extent_m: tuple[float, float, float, float]) -> Picture:
    reach = float(np.nanpercentile(np.abs(values), 98.0))
    alt = (
        "Map of the corrected surface minus the reference surface; blue where the cloud is lower."
        f" 98 % of the cells differ by less than {reach:.2f} m."
    )
    figure, axes = new_map(extent_m)
    image = axes.imshow(values, extent=extent_m, cmap="RdBu_r", vmin=-reach, vmax=reach)
    figure.colorbar(image, ax=axes, label="Cloud minus reference (m)", shrink=0.9)
    return Picture("dod", "Difference of the surfaces (DoD)", alt, figure)


def in_a_sentence(compared: Plain) -> str:
    """Return what the correction came to against the reference; empty where it is not known."""
    pair = compared["vertical"]
    if pair is None or pair["before"] is None:
        return ""
    before, after = (pair[when]["statistics"] for when, _, _ in _TIMES)
    name = compared["reference"].rsplit("/", 1)[-1]
    way = "fell" if after["rmse_m"] <= before["rmse_m"] else "grew"
    twice = f" {CORRECTED_BEFORE}" if CORRECTED_BEFORE in compared["notes"] else ""
    return (
        f" Against {name} the vertical error {way} from {before['rmse_m']:.3f} to"
        f" {after['rmse_m']:.3f} m (RMSE of {after['count']:,} points{_apart(compared)}); what is"
        f" left has a bias of {after['mean_m']:+.3f} m.{twice}"
    )


def _apart(compared: Plain) -> str:
    """Return how bed and land changed, where there are both."""
    parts = [(name, compared.get(name)) for name in ("bed", "land")]
    return "".join(
        f"; {name} {pair['before']['rmse_m']:.3f} to {pair['after']['rmse_m']:.3f} m"
        for name, pair in parts
        if pair is not None and all(pair for _, pair in parts)
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
            moments = " ".join(
                f"{name.capitalize()}: mean {s['mean_m']:.3f} m, standard deviation"
                f" {s['sd_m']:.3f} m."
                for when, name, _ in _TIMES
                if compared[key][when] is not None and (s := compared[key][when]["statistics"])
            )
            alt = f"{title}: histograms{bells}. {moments}"
            figure = _histogram(compared[key], label, bell=key == "vertical")
            pictures.append(Picture(f"histogram_{key}", title, alt, figure))
    return pictures


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
    axes.set(xlabel=label, ylabel="Cloud minus reference, Z (m)")
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
    axes.set(xlabel="Distance along the line (m)", ylabel="Height (m)")
    axes.legend(loc="best")
    return figure


def _statistics(compared: Plain) -> Table:
    header = ["", "points", "mean", "sd", "RMSE", "NMAD", "median", "95 %"]
    rows = []
    kinds = (
        ("vertical", "Vertical error"), ("bed", "Bed, vertical error"),
        ("land", "Land, vertical error"), ("m3c2", "M3C2 distance"), ("c2c", "C2C distance"),
    )  # fmt: skip
    for key, kind in kinds:
        for when, name, _ in _TIMES:
            # comparisons from before there were bed and land do without
            if (pair := compared.get(key)) is not None and pair[when] is not None:
                s = pair[when].get("statistics", pair[when])
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
        rows = [
            [f"{b['from_m']:g} to {b['to_m']:g}", f"{b['after']['count']:,}"]
            + [
                "" if b[when] is None else f"{b[when][key]:.3f}"
                for when, _, _ in _TIMES
                for key in ("mean_m", "rmse_m", "nmad_m")
            ]
            for b in compared["depth_bins"]
        ]
        tables.append(Table("By depth (m)", header, rows))
    return tables
