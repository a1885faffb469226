"""What a comparison says of the points that were matched, in figures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from pcfix.blocks import kept, mapped
from pcfix.compare.c2c import AfterBefore, Further, both, c2c_of, far_of, further_of, sparse_notes
from pcfix.compare.m3c2 import M3c2, m3c2_distances
from pcfix.compare.match import Match
from pcfix.compare.sections import Section, SectionLine, lines_downslope, section_along
from pcfix.compare.statistics import (
    Bin,
    Distribution,
    Line,
    Own,
    Sample,
    Statistics,
    Tvu,
    binned,
    distance_from_shore,
    distribution_of,
    fit_line,
    own_of,
    statistics_of,
    tvu_of,
)
from pcfix.compare.vertical import Pairs, pairs_at_cloud, pairs_at_reference
from pcfix.errors import GeometryError
from pcfix.model import BoolArray, FloatArray
from pcfix.options.steps import CompareRules


@dataclass(frozen=True, slots=True)
class Counts:
    """Points of the cloud, of the reference, and those that were compared."""

    cloud: int
    cloud_left_out: int
    reference: int
    reference_left_out: int
    outside_overlap: int
    not_submerged: int
    compared: int
    by_nearest: int
    reference_compared: int  # with C2C from the reference


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A cloud against a reference; all errors are cloud minus reference, metres.

    Attributes
    ----------
    cloud, reference : str
    measured_at : {"cloud", "reference"}
        Whether each point of the cloud was compared, or each check point.
    counts : Counts
    c2c : AfterBefore of Distribution, or None
        From each point of the cloud to the nearest of the reference, without sign; from each check
        point to the nearest of the cloud. None with ``direction="from-reference"``.
    c2c_from_reference : AfterBefore of Distribution, or None
        From each point of the reference to the nearest of the cloud, where that was asked for.
    also : tuple of Further
        C2C of the further clouds.
    vertical : AfterBefore of Distribution, or None
        Signed, along the vertical.
    bed, land : AfterBefore of Statistics, or None
        The same of what lies under water and of what does not.
    own : Own or None
        Those of the bed, or of all where it is not known, without the noise of the reference.
    depth : AfterBefore of Line, or None
        Depth against reference depth; None where the water surface is not known.
    depth_bins, shore_bins : tuple of Bin
        Submerged places by reference depth, and by distance in plan from the nearest dry point.
    tvu : Tvu or None
        Of all submerged places.
    m3c2 : AfterBefore of M3c2, or None
    sections : tuple of Section
    settings : CompareRules
    notes : tuple of str
        What was left out, and why.
    seconds : float
    check_points : array, shape (p, 4), or None
        x, y and z of single points of the reference, and the error there.
    """

    cloud: str
    reference: str
    measured_at: Literal["cloud", "reference"]
    counts: Counts
    c2c: AfterBefore[Distribution] | None
    c2c_from_reference: AfterBefore[Distribution] | None
    also: tuple[Further, ...]
    vertical: AfterBefore[Distribution] | None
    bed: AfterBefore[Statistics] | None
    land: AfterBefore[Statistics] | None
    own: Own | None
    depth: AfterBefore[Line | None] | None
    depth_bins: tuple[Bin, ...]
    shore_bins: tuple[Bin, ...]
    tvu: Tvu | None
    m3c2: AfterBefore[M3c2] | None
    sections: tuple[Section, ...]
    settings: CompareRules
    notes: tuple[str, ...]
    seconds: float
    check_points: FloatArray | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; a section by its line, its heights are CSV."""
        names = [name for name in self.__slots__ if name not in ("sections", "check_points")]
        plain = {name: _plain(getattr(self, name)) for name in names}
        plain["sections"] = [
            {**asdict(s.line), "half_width_m": s.half_width_m, "stations": len(s.distance_m)}
            for s in self.sections
        ]
        return plain


def _plain(value: Any) -> Any:
    if hasattr(value, "__dataclass_fields__"):
        return _plain(asdict(value))
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


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


CORRECTED_BEFORE = (
    "As it came, the cloud has the depths of the reference: it was likely corrected before."
)
AS_DEEP, TOO_DEEP = 0.10, 0.15
"""Of the depth: a cloud that came so near to the reference, and is deeper by that much now, was
corrected twice; as refraction leaves it, it lacks a quarter.
"""
MIN_REACH_M, REACH_FACTOR = 1.0, 1.5
"""M3C2 looks along the normal beyond nearly all differences: 1.5 times their 99th percentile."""


def figures_of(
    match: Match, lines: Sequence[SectionLine], started: float, others: Mapping[str, Match]
) -> Comparison:
    """Return all figures that the settings ask for.

    The cross-sections along `lines` come beside the automatic ones; the comparison `started` at a
    time of `time.perf_counter`; `others` are further clouds by name. A `GeometryError` if there are
    too few points for planes, or M3C2 finds nothing.
    """
    notes, c2c = _notes(match), c2c_of(match)
    notes += sparse_notes(match, c2c)
    pairs = None
    if match.settings.vertical:
        _check_enough(match)
        pairs = both(partial(_pairs, match), match.cloud.xyz, match.cloud.apparent)
    vertical = (
        None
        if pairs is None
        else both(lambda p: distribution_of(p.error_m), pairs.after, pairs.before)
    )
    of_depth = _by_depth(match, pairs, notes)
    return Comparison(
        cloud=match.whole.name,
        reference=match.reference.name,
        measured_at="reference" if match.reference.sparse else "cloud",
        counts=_counts(match, pairs),
        c2c=c2c.to_reference,
        c2c_from_reference=c2c.from_reference,
        also=further_of(others),
        vertical=vertical,
        bed=of_depth.bed,
        land=of_depth.land,
        own=_own(match, of_depth.bed, vertical),
        depth=of_depth.fits,
        depth_bins=of_depth.depth_bins,
        shore_bins=of_depth.shore_bins,
        tvu=of_depth.tvu,
        m3c2=_m3c2(match, pairs),
        sections=_sections(match, lines, others),
        settings=match.settings,
        notes=tuple(notes),
        seconds=round(time.perf_counter() - started, 3),
        check_points=_residuals(match, pairs),
    )


def _residuals(match: Match, pairs: AfterBefore[Pairs] | None) -> FloatArray | None:
    if pairs is None or not match.reference.sparse:
        return None
    after = pairs.after
    return np.column_stack([after.xy, after.reference_m, after.error_m])


def _check_enough(match: Match) -> None:
    """Refuse surfaces with too few points for a plane."""
    sparse, wanted = match.reference.sparse, match.settings.neighbours
    name = match.whole.name if sparse else match.reference.name
    count = len(match.cloud if sparse else match.reference.xyz)
    if count < wanted:
        raise GeometryError(
            f"{name}: {count} points are too few for planes through {wanted} neighbours; give"
            " more points (at least 6, with --neighbours 6)."
        )


def _pairs(match: Match, xyz: FloatArray) -> Pairs:
    k = match.settings.neighbours
    if match.reference.sparse:
        return pairs_at_reference(xyz, match.places, k)
    return pairs_at_cloud(xyz, match.reference.xyz, k)


@dataclass(frozen=True)
class _OfDepth:
    """What is said of the submerged places, and of the others; see `Comparison`."""

    fits: AfterBefore[Line | None] | None = None
    depth_bins: tuple[Bin, ...] = ()
    shore_bins: tuple[Bin, ...] = ()
    tvu: Tvu | None = None
    bed: AfterBefore[Statistics] | None = None
    land: AfterBefore[Statistics] | None = None


def _by_depth(match: Match, pairs: AfterBefore[Pairs] | None, notes: list[str]) -> _OfDepth:
    """Return fits, tables and TVU of the submerged places, as far as the water is known."""
    nothing = _OfDepth()
    if pairs is None:
        return nothing
    after, before = pairs.after, pairs.before
    surface = match.water_at(after.xy)
    if surface is None:
        notes.append("no water surface is known, so nothing is said of depth; give --water")
        return nothing
    wet = mapped(np.less, after.reference_m, surface) if match.reference.sparse else match.wet
    wet = wet & mapped(np.isfinite, surface)
    if not wet.any():
        notes.append("no compared point is under water, so nothing is said of depth")
        return nothing
    depth, error = _of(wet, np.subtract, surface, after.reference_m), kept(wet, after.error_m)
    fits = AfterBefore(fit_line(depth, mapped(np.subtract, depth, error)), None)
    error_before: FloatArray | None = None
    if before is not None:
        over = match.water_at(before.xy)
        over = surface if over is None else over
        depth_before = _of(wet, np.subtract, over, before.reference_m)
        error_before = kept(wet, before.error_m)
        line = fit_line(depth_before, mapped(np.subtract, depth_before, error_before))
        fits = replace(fits, before=line)
        now, came = _ratio(depth, error), _ratio(depth_before, error_before)
        if abs(came - 1.0) <= AS_DEEP and now > 1.0 + TOO_DEEP:
            notes.append(CORRECTED_BEFORE)
    bins = binned(depth, error, error_before, match.settings.bin_width)
    bed, land = _errors_of(pairs, wet), _errors_of(pairs, ~wet)
    found = _OfDepth(fits, bins, tvu=tvu_of(error, depth), bed=bed, land=land)
    if not match.dry.any():
        notes.append("the cloud has no dry point, so nothing is said of the distance from shore")
        return found
    shore = distance_from_shore(kept(wet, after.xy), kept(match.dry, match.whole.xyz)[:, :2])
    width = match.settings.shore_bin_width
    return replace(found, shore_bins=binned(shore, error, error_before, width))


def _errors_of(pairs: AfterBefore[Pairs], rows: BoolArray) -> AfterBefore[Statistics] | None:
    """Return what the vertical errors of some places are; None without any."""
    if not rows.any():
        return None
    return both(lambda p: statistics_of(kept(rows, p.error_m)), pairs.after, pairs.before)


def _of(rows: BoolArray, function: Callable[..., Any], *columns: FloatArray) -> FloatArray:
    """Return a function of columns, (n,), at some rows."""
    return mapped(function, *(kept(rows, one) for one in columns))


def _own(
    match: Match, bed: AfterBefore[Statistics] | None, vertical: AfterBefore[Distribution] | None
) -> Own | None:
    if vertical is None:
        return None
    errors = (vertical.after.statistics, "all") if bed is None else (bed.after, "bed")
    return own_of(*errors, match.settings.sigma_reference, match.reference.kind)


def _ratio(depth_m: FloatArray, error_m: FloatArray) -> float:
    """Return the median of depth over reference depth, where that is one; NaN if nowhere."""
    some = mapped(lambda depth: depth > 0.0, depth_m)
    if not some.any():
        return math.nan
    ratio = _of(some, lambda error, depth: 1.0 - error / depth, error_m, depth_m)
    return float(Sample(ratio).percentiles(50))


def _m3c2(match: Match, pairs: AfterBefore[Pairs] | None) -> AfterBefore[M3c2] | None:
    if not match.settings.m3c2:
        return None
    if pairs is None:
        far = far_of(match, match.cloud.xyz)
    else:
        far = mapped(np.abs, (pairs.before or pairs.after).error_m)
    reach = max(MIN_REACH_M, REACH_FACTOR * float(Sample(far).percentiles(99)))
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


def _counts(match: Match, pairs: AfterBefore[Pairs] | None) -> Counts:
    whole, reference = match.whole, match.reference
    return Counts(
        cloud=len(whole) + whole.left_out,
        cloud_left_out=whole.left_out,
        reference=len(reference.xyz) + reference.left_out,
        reference_left_out=reference.left_out,
        outside_overlap=match.outside,
        not_submerged=match.not_submerged,
        compared=len(match.places) if reference.sparse else len(match.cloud),
        by_nearest=0 if pairs is None else int(pairs.after.by_nearest.sum()),
        reference_compared=len(match.places) if match.settings.from_reference else 0,
    )


def _notes(match: Match) -> list[str]:
    notes = []
    if match.cloud.shift_m is None:
        notes.append(
            "the cloud does not say where its points were before (no dimensions ShiftX, ShiftY,"
            " ShiftZ), so only its present state is compared"
        )
    if match.reference.sparse:
        notes.append("the reference is check points, so the cloud's surface is measured at each")
    return notes
