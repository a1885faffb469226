"""All figures of a comparison of matched points."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from pcfix.blocks import kept, mapped
from pcfix.clean.neighbours import nearest_distance
from pcfix.compare.m3c2 import M3c2, m3c2_distances
from pcfix.compare.match import Match, heights_at, spacing_m
from pcfix.compare.sections import Section, SectionLine, lines_downslope, section_along
from pcfix.compare.statistics import (
    Bin,
    Distribution,
    Statistics,
    binned,
    distances_of,
    distribution_of,
    fit_line,
    own_of,
    statistics_of,
    tvu_of,
)
from pcfix.errors import GeometryError, PcfixWarning, plain
from pcfix.model import BoolArray, FloatArray
from pcfix.sums import Figures

Given = TypeVar("Given")
Figure = TypeVar("Figure")


@dataclass(frozen=True, slots=True)
class AfterBefore(Generic[Figure]):
    """A figure after the correction and, if the cloud has shift dimensions, before it."""

    after: Figure
    before: Figure | None


class Pairs(NamedTuple):
    """The heights of cloud and reference at n places, world Z, metres."""

    xy: FloatArray  # (n, 2), world frame
    reference_m: FloatArray  # (n,)
    error_m: FloatArray  # (n,), cloud minus reference: positive where the cloud is too high
    by_nearest: BoolArray  # (n,), one of the two heights is that of a single point


class Comparison(Figures):
    """A cloud against a reference; all errors are cloud minus reference, metres."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; a section by its line, its heights are CSV."""
        names = vars(self).keys() - {"sections", "check_points"}
        found = {name: plain(value) for name, value in vars(self).items() if name in names}
        found["sections"] = [
            {**asdict(s.line), "half_width_m": s.half_width_m, "stations": len(s.distance_m)}
            for s in self.sections
        ]
        return found


_BIN_COLUMNS = {
    "count_{}": "count",
    "bias_{}_m": "mean_m",
    "sd_{}_m": "sd_m",
    "rmse_{}_m": "rmse_m",
    "nmad_{}_m": "nmad_m",
}


def bins_table(bins: Iterable[Bin]) -> str:
    """Return bins as CSV text; the columns of `before` are empty where it is not known."""
    head = [name.format(when) for when in ("after", "before") for name in _BIN_COLUMNS]
    lines = [",".join(["from_m", "to_m", *head])]
    for one in bins:
        fields = [f"{one.from_m:g}", f"{one.to_m:g}"]
        for statistics in (one.after, one.before):
            for name in _BIN_COLUMNS.values():
                value = "" if statistics is None else getattr(statistics, name)
                fields.append(f"{value:.4f}" if isinstance(value, float) else str(value))
        lines.append(",".join(fields))
    return "\n".join(lines) + "\n"


SPARSER = 2.0
"""Ratio of the spacings of two clouds from which one is called sparse."""
AS_DEEP, TOO_DEEP = 0.10, 0.15
"""Relative to the depth: a cloud whose apparent depths differ from the reference by at most the
first, and whose corrected ones by more than the second, was corrected twice. Refraction makes
apparent depths a quarter too small.
"""
MIN_REACH_M, REACH_FACTOR = 1.0, 1.5
"""M3C2 searches along the normal as far as 1.5 times the 99th percentile of the differences."""


def figures_of(
    match: Match, lines: Sequence[SectionLine], started: float, others: Mapping[str, Match]
) -> Comparison:
    """Return all figures that the settings ask for.

    The cross-sections along `lines` come with the automatic ones; the comparison `started` at a
    time of `time.perf_counter`; `others` are further clouds by name. Raises GeometryError if there
    are too few points for planes, or M3C2 finds nothing.
    """
    whole, reference = match.whole, match.reference
    c2c, c2c_from_reference = found = c2c_of(match)
    notes = sparse_notes(match, found)
    pairs = vertical = residuals = None
    if match.settings.vertical:
        pairs = _pairs(match)
        vertical = both(lambda p: distribution_of(p.error_m), pairs.after, pairs.before)
        if reference.sparse:
            after = pairs.after
            residuals = np.column_stack([after.xy, after.reference_m, after.error_m])
    by_depth, own = {} if pairs is None else _by_depth(match, pairs, notes), None
    if vertical is not None:
        bed, stated = by_depth.get("bed"), match.settings.sigma_reference
        errors = vertical.after.statistics if bed is None else bed.after
        own = own_of(errors, "all" if bed is None else "bed", stated, reference.kind)
    also = [
        Figures(
            name=name,
            cloud=other.whole.name,
            **{
                way: None if found is None else found.after
                for way, found in zip(("c2c", "c2c_from_reference"), c2c_of(other), strict=True)
            },
        )
        for name, other in others.items()
    ]
    counts = Figures(
        cloud=len(whole) + whole.left_out,
        cloud_left_out=whole.left_out,
        reference=len(reference.xyz) + reference.left_out,
        reference_left_out=reference.left_out,
        outside_overlap=match.outside,
        not_submerged=match.not_submerged,
        compared=len(match.places) if reference.sparse else len(match.cloud),
        by_nearest=0 if pairs is None else int(pairs.after.by_nearest.sum()),
        # with C2C from the reference
        reference_compared=len(match.places) if match.settings.from_reference else 0,
    )
    return Comparison(
        cloud=whole.name,
        reference=reference.name,
        # each point of the cloud, or each check point
        measured_at="reference" if reference.sparse else "cloud",
        counts=counts,
        # unsigned distances, to the reference (from check points: to the cloud) and from it
        c2c=c2c,
        c2c_from_reference=c2c_from_reference,
        also=also,  # further clouds
        vertical=vertical,  # signed, along the vertical
        own=own,  # of the bed, or of all, without the noise of the reference
        **{
            "bed": None, "land": None,  # the same of submerged places and of the others
            "depth": None,  # against reference depth, if water is known
            "depth_bins": (), "shore_bins": (),  # by depth, and by distance from the shore
            "tvu": None,  # of all submerged places
            **by_depth,
        },
        m3c2=_m3c2(match, pairs) if match.settings.m3c2 else None,
        sections=_sections(match, lines, others),
        settings=match.settings,
        notes=notes,
        seconds=round(time.perf_counter() - started, 3),
        check_points=residuals,  # (p, 4): x, y, z of check points, and the error
    )  # fmt: skip


def both(
    figure: Callable[[Given], Figure], after: Given, before: Given | None
) -> AfterBefore[Figure]:
    """Return a figure of the corrected cloud, and of the apparent one if it is known."""
    return AfterBefore(figure(after), None if before is None else figure(before))


C2c: TypeAlias = tuple[AfterBefore[Distribution] | None, AfterBefore[Distribution] | None]
"""Distances to the reference and from it; None for a direction that was not asked for."""


def c2c_of(match: Match) -> C2c:
    """Return the distances in the directions of the settings.

    By default they start at each point of the cloud, or at each check point. From the reference
    means from each of its points that the cloud covers in plan, to the nearest of the whole cloud.
    """
    rules = match.settings

    def distribution(values: FloatArray) -> Distribution:
        return distances_of(values, rules.classes, rules.share)

    to = back = None
    if rules.direction != "from-reference":
        cloud = match.cloud
        to = both(lambda p: distribution(distances_to(match, p)), cloud.xyz, cloud.apparent)
    if rules.from_reference:
        near, asked = partial(nearest_distance, match.places, axes=3), match.asked
        back = both(lambda p: distribution(near(p)), asked.xyz, asked.apparent)
    return to, back


def distances_to(match: Match, xyz: FloatArray) -> FloatArray:
    """Return the distance from each point of a cloud, or from each check point, shape (p,), m."""
    if match.reference.sparse:
        return nearest_distance(match.places, xyz, 3)
    return nearest_distance(xyz, match.reference.xyz, 3)


def sparse_notes(match: Match, found: C2c) -> list[PcfixWarning]:
    """Return warnings of distances that mostly measure the spacing of a sparse cloud."""
    if match.reference.sparse:
        return []
    spacings = {"reference": spacing_m(match.reference.xyz), "cloud": spacing_m(match.asked.xyz)}
    notes = []
    for pair, sparse, dense in zip(found, spacings, reversed(spacings), strict=True):
        apart, times = spacings[sparse], spacings[sparse] / max(spacings[dense], 1e-9)
        if pair is None or times < SPARSER or apart < (mean := pair.after.statistics.mean_m):
            continue
        remedy = f"Give --direction {'from' if sparse == 'reference' else 'to'}-reference."
        if match.reference.raster:
            remedy = "Use the vertical error, or give the reference as points."
        elif None not in found:
            remedy = f"Use C2C from each point of the {sparse}."
        text = (
            f"C2C to the {sparse} ({mean:.3f} m on average) mostly measures the spacing of its"
            f" points: {apart:.2g} m, {times:.0f} times that of the {dense}. {remedy}"
        )
        notes.append(PcfixWarning(f"{sparse}.sparse", text, spacing_m=apart, times=times))
    return notes


def _pairs(match: Match) -> AfterBefore[Pairs]:
    """Return the heights of cloud and reference at each point of the cloud, or check point."""
    sparse, k = match.reference.sparse, match.settings.neighbours
    name = match.whole.name if sparse else match.reference.name
    count = len(match.cloud if sparse else match.reference.xyz)
    if count < k:
        sentence = (
            f"{name}: {count} points are too few for planes through {k} neighbours. Give more"
            " points (at least 6, with --neighbours 6)."
        )
        code = f"{'cloud' if sparse else 'reference'}.too_few_points"
        raise GeometryError(code, sentence, path=name, points=count, least=k)

    def pairs(xyz: FloatArray) -> Pairs:
        places, surface = (match.places, xyz) if sparse else (xyz, match.reference.xyz)
        height, by_nearest = heights_at(places, surface, k)
        measured, known = (height, places[:, 2]) if sparse else (places[:, 2], height)
        return Pairs(places[:, :2], known, mapped(np.subtract, measured, known), by_nearest)

    return both(pairs, match.cloud.xyz, match.cloud.apparent)


def _by_depth(match: Match, pairs: AfterBefore[Pairs], notes: list[PcfixWarning]) -> dict[str, Any]:
    """Return the figures of submerged places, and of the others, by the names of `Comparison`."""
    after = pairs.after
    surface = match.water_at(after.xy)
    if surface is None:
        text = "The water surface is not known, so there are no figures by depth. Give --water."
        notes.append(PcfixWarning("water.missing", text))
        return {}
    wet = mapped(np.less, after.reference_m, surface) if match.reference.sparse else match.wet
    wet = wet & mapped(np.isfinite, surface)
    if not wet.any():
        text = "No compared point is under water, so there are no figures by depth."
        notes.append(PcfixWarning("cloud.not_submerged", text))
        return {}

    def submerged(p: Pairs) -> tuple[FloatArray, FloatArray]:
        """Return reference depths and errors of the submerged places."""
        above = surface if p is after else np.asarray(match.water_at(p.xy))
        return _at(wet, np.subtract, above, p.reference_m), kept(wet, p.error_m)

    found = both(submerged, after, pairs.before)
    (depth, error), error_before = found.after, None
    if found.before is not None:
        error_before = found.before[1]
        corrected, apparent = _ratio(*found.after), _ratio(*found.before)
        if abs(apparent - 1.0) <= AS_DEEP and corrected > 1.0 + TOO_DEEP:
            text = (
                "The input cloud had the depths of the reference already: it was likely corrected"
                " before."
            )
            ratios = {"apparent_ratio": apparent, "corrected_ratio": corrected}
            notes.append(PcfixWarning("cloud.corrected_twice", text, **ratios))
    rules, shore_bins = match.settings, tuple[Bin, ...]()
    if match.dry.any():
        dry = kept(match.dry, match.whole.xyz)[:, :2]
        shore = nearest_distance(kept(wet, after.xy), dry)
        shore_bins = binned(shore, error, error_before, rules.shore_bin_width)
    return {
        "depth": both(lambda f: fit_line(f[0], mapped(np.subtract, *f)), found.after, found.before),
        "depth_bins": binned(depth, error, error_before, rules.bin_width),
        "shore_bins": shore_bins,
        "tvu": tvu_of(error, depth),
        "bed": _errors_of(pairs, wet),
        "land": _errors_of(pairs, ~wet),
    }


def _errors_of(pairs: AfterBefore[Pairs], rows: BoolArray) -> AfterBefore[Statistics] | None:
    """Return the vertical errors of some places; None if there are none."""
    if not rows.any():
        return None
    return both(lambda p: statistics_of(kept(rows, p.error_m)), pairs.after, pairs.before)


def _at(rows: BoolArray, function: Callable[..., Any], *columns: FloatArray) -> FloatArray:
    """Return a function of columns, (n,), at some rows."""
    return mapped(function, *(kept(rows, one) for one in columns))


def _ratio(depth_m: FloatArray, error_m: FloatArray) -> float:
    """Return the median of depth over reference depth, where that is positive; NaN if nowhere."""
    some = mapped(lambda depth: depth > 0.0, depth_m)
    if not some.any():
        return math.nan
    ratio = _at(some, lambda error, depth: 1.0 - error / depth, error_m, depth_m)
    return float(np.median(ratio))


def _m3c2(match: Match, pairs: AfterBefore[Pairs] | None) -> AfterBefore[M3c2]:
    if pairs is None:
        far = distances_to(match, match.cloud.xyz)
    else:
        far = mapped(np.abs, (pairs.before or pairs.after).error_m)
    reach = max(MIN_REACH_M, REACH_FACTOR * float(np.percentile(far, 99)))
    cloud, target = match.cloud, match.reference.xyz
    return both(lambda xyz: m3c2_distances(xyz, target, reach), cloud.xyz, cloud.apparent)


def _sections(
    match: Match, lines: Sequence[SectionLine], others: Mapping[str, Match]
) -> tuple[Section, ...]:
    """Return the cross-sections that were asked for."""
    if match.settings.sections:
        bed = kept(match.wet, match.cloud.xyz) if match.wet.any() else match.cloud.xyz
        lines = [*lines, *lines_downslope(bed, match.settings.sections)]
    layers = {
        "water": match.water_points,
        "apparent": match.cloud.apparent,
        "corrected": match.cloud.xyz,
        "reference": match.reference.xyz,
        **{name: other.cloud.xyz for name, other in others.items()},
    }
    known = {name: xyz for name, xyz in layers.items() if xyz is not None and len(xyz)}
    return tuple(section_along(line, known, match.settings.corridor) for line in lines)
