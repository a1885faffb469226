"""The figures of a comparison, from the points that were matched."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from pcfix.compare.c2c import cloud_to_cloud
from pcfix.compare.depth import Bin, binned, distance_from_shore, fit_line
from pcfix.compare.m3c2 import m3c2_distances
from pcfix.compare.pairs import pairs_at_cloud, pairs_at_reference
from pcfix.compare.sections import lines_downslope, section_along
from pcfix.compare.statistics import distribution_of
from pcfix.errors import GeometryError
from pcfix.flow.comparison import Comparison, Counts, DepthFits, Distances, M3c2Pair

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pcfix.compare.pairs import Pairs
    from pcfix.compare.sections import Section, SectionLine
    from pcfix.flow.match import Match
    from pcfix.model import FloatArray

MIN_REACH_M, REACH_FACTOR = 1.0, 1.5
"""M3C2 looks along the normal beyond nearly all differences: 1.5 times their 99th percentile."""


def figures_of(match: Match, lines: Sequence[SectionLine], started: float) -> Comparison:
    """Return all figures that the settings ask for.

    Parameters
    ----------
    match : Match
    lines : sequence of SectionLine
        Cross-sections, beside the automatic ones.
    started : float
        When the comparison began, on `time.perf_counter`.

    Raises
    ------
    GeometryError
        If there are too few points for planes, or M3C2 finds nothing.
    """
    notes, apparent = _notes(match), match.apparent
    after = before = None
    if match.settings.vertical:
        _check_enough(match)
        after = _pairs(match, match.cloud.xyz)
        before = None if apparent is None else _pairs(match, apparent)
    fits, depth_bins, shore_bins = _by_depth(match, after, before, notes)
    return Comparison(
        cloud=match.whole.name,
        reference=match.reference.name,
        measured_at="reference" if match.reference.sparse else "cloud",
        counts=_counts(match, after),
        c2c=Distances(
            distribution_of(_c2c(match, match.cloud.xyz)),
            None if apparent is None else distribution_of(_c2c(match, apparent)),
        ),
        vertical=_vertical(after, before),
        depth=fits,
        depth_bins=depth_bins,
        shore_bins=shore_bins,
        m3c2=_m3c2(match, after, before),
        sections=_sections(match, lines),
        settings=match.settings,
        notes=tuple(notes),
        seconds=round(time.perf_counter() - started, 3),
    )


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


def _c2c(match: Match, xyz: FloatArray) -> FloatArray:
    if match.reference.sparse:
        return cloud_to_cloud(match.places, xyz)
    return cloud_to_cloud(xyz, match.reference.xyz)


def _vertical(after: Pairs | None, before: Pairs | None) -> Distances | None:
    if after is None:
        return None
    return Distances(
        distribution_of(after.error_m),
        None if before is None else distribution_of(before.error_m),
    )


def _by_depth(
    match: Match, after: Pairs | None, before: Pairs | None, notes: list[str]
) -> tuple[DepthFits | None, tuple[Bin, ...], tuple[Bin, ...]]:
    """Return the fits and tables of the submerged places, as far as the water is known."""
    surface = None if after is None else match.water_at(after.xy)
    if after is None or surface is None:
        if after is not None:
            notes.append("no water surface is known, so nothing is said of depth; give --water")
        return None, (), ()
    wet = after.reference_m < surface if match.reference.sparse else match.wet
    wet = wet & np.isfinite(surface)
    if not wet.any():
        notes.append("no compared point is under water, so nothing is said of depth")
        return None, (), ()
    depth, error = (surface - after.reference_m)[wet], after.error_m[wet]
    depth_before = error_before = None
    if before is not None:
        over = match.water_at(before.xy)
        depth_before = ((surface if over is None else over) - before.reference_m)[wet]
        error_before = before.error_m[wet]
    fits = DepthFits(
        fit_line(depth, depth - error),
        None
        if depth_before is None or error_before is None
        else fit_line(depth_before, depth_before - error_before),
    )
    bins = binned(depth, error, error_before, match.settings.bin_width_m)
    if len(match.dry_xy) == 0:
        notes.append("the cloud has no dry point, so nothing is said of the distance from shore")
        return fits, bins, ()
    shore = distance_from_shore(after.xy[wet], match.dry_xy)
    return fits, bins, binned(shore, error, error_before, match.settings.shore_bin_width_m)


def _m3c2(match: Match, after: Pairs | None, before: Pairs | None) -> M3c2Pair | None:
    if not match.settings.m3c2:
        return None
    pairs = before or after
    far = _c2c(match, match.cloud.xyz) if pairs is None else np.abs(pairs.error_m)
    reach = max(MIN_REACH_M, REACH_FACTOR * float(np.percentile(far, 99)))
    target, apparent = match.reference.xyz, match.apparent
    return M3c2Pair(
        m3c2_distances(match.cloud.xyz, target, reach),
        None if apparent is None else m3c2_distances(apparent, target, reach),
    )


def _sections(match: Match, lines: Sequence[SectionLine]) -> tuple[Section, ...]:
    """Return the cross-sections that were asked for."""
    if match.settings.sections:
        bed = match.cloud.xyz[match.wet] if match.wet.any() else match.cloud.xyz
        lines = [*lines, *lines_downslope(bed, match.settings.sections)]
    layers = {
        "water": match.water_points,
        "apparent": match.apparent,
        "corrected": match.cloud.xyz,
        "reference": match.reference.xyz,
    }
    known = {name: xyz for name, xyz in layers.items() if xyz is not None and len(xyz)}
    return tuple(section_along(line, known, match.settings.corridor_m) for line in lines)


def _counts(match: Match, after: Pairs | None) -> Counts:
    whole, reference = match.whole, match.reference
    return Counts(
        cloud=len(whole) + whole.left_out,
        cloud_left_out=whole.left_out,
        reference=len(reference.xyz) + reference.left_out,
        reference_left_out=reference.left_out,
        outside_overlap=match.outside,
        not_submerged=match.not_submerged,
        compared=len(match.places) if reference.sparse else len(match.cloud),
        by_nearest=0 if after is None else int(after.by_nearest.sum()),
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
