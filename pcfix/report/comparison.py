"""A comparison in a few lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.report.text import share

if TYPE_CHECKING:
    from pcfix.compare.figures import AfterBefore, Comparison
    from pcfix.compare.m3c2 import M3c2
    from pcfix.compare.statistics import Bin, Line, Statistics

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
        lines += ["", *_fits("depth fit", c.depth.before, c.depth.after)]
    for title, bins in (("depth", c.depth_bins), ("from shore", c.shore_bins)):
        lines += _bins(title, bins)
    if c.m3c2 is not None:
        lines += ["", *_m3c2(c.m3c2)]
    return "\n".join([*lines, *(f"note: {note}" for note in c.notes)])


def _rows(c: Comparison) -> list[str]:
    rows = []
    for title, distances in (("dZ", c.vertical), ("C2C", c.c2c)):
        if distances is not None:
            if distances.before is not None:
                rows.append(_row(f"{title} before", distances.before.statistics))
            rows.append(
                _row(f"{title} after" if distances.before else title, distances.after.statistics)
            )
    if c.m3c2 is not None:
        if c.m3c2.before is not None:
            rows.append(_row("M3C2 before", c.m3c2.before.statistics))
        rows.append(_row("M3C2 after" if c.m3c2.before else "M3C2", c.m3c2.after.statistics))
    return rows


def _row(title: str, s: Statistics) -> str:
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


def _fits(title: str, before: Line | None, after: Line | None) -> list[str]:
    return [
        f"{title} {when:<7} depth = {line.intercept_m:+.3f} m + {line.slope:.4f} x reference depth,"
        f" r2 {line.r2:.4f}"
        for when, line in (("before", before), ("after", after))
        if line is not None
    ]


def _bins(title: str, bins: tuple[Bin, ...]) -> list[str]:
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


def _m3c2(pair: AfterBefore[M3c2]) -> list[str]:
    m = pair.after
    return [
        f"M3C2: {m.statistics.count:,} of {m.core_points:,} core points, normals"
        f" {m.normal_radius_m:.2f} m, cylinder {m.cylinder_radius_m:.2f} m; mean level of"
        f" detection {m.mean_level_of_detection_m:.3f} m,"
        f" {100 * m.significant_share:.0f} % of the distances beyond it"
    ]
