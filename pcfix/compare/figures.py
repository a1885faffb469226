"""All figures of a comparison of matched points, and cross-sections along lines in plan."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from pcfix.compare.match import Match, heights_at, mean_spacing_m
from pcfix.compare.statistics import (
    binned,
    distribution_of,
    fit_line,
    m3c2_distances,
    statistics_of,
    tvu_of,
)
from pcfix.errors import GeometryError, PcfixWarning, SettingError, plain
from pcfix.model import FloatArray
from pcfix.points.neighbours import nearest_distance, spacing_m
from pcfix.running import blocks, bounds, mapped, subset
from pcfix.sums import Figures


class Pairs(NamedTuple):
    """The heights of cloud and reference at n places, world Z, metres."""

    xy: FloatArray  # (n, 2), world frame
    reference_m: FloatArray  # (n,)
    error_m: FloatArray  # (n,), cloud minus reference: positive where the cloud is too high


class Comparison(Figures):
    """A cloud against a reference; all errors are cloud minus reference, metres.

    Most figures have ``after``, of the corrected cloud, and ``before``, of the apparent one, which
    is None if the cloud has no shift dimensions.
    """

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; a section by its line, its heights are CSV."""
        values = {name: value for name, value in vars(self).items() if name != "check_points"}
        sections = [
            {**s.line._asdict(), "half_width_m": s.half_width_m, "stations": len(s.distance_m)}
            for s in self.sections
        ]
        return dict(plain(values | {"sections": sections}))


def bins_table(bins: Iterable[Figures]) -> str:
    """Return bins as CSV text; the columns of `before` are empty where it is not known."""
    columns = ("bias", "mean_m"), ("sd", "sd_m"), ("rmse", "rmse_m"), ("nmad", "nmad_m")
    rows: list[list[Any]] = [["from_m", "to_m"]]
    for when in ("after", "before"):
        rows[0] += [f"count_{when}", *(f"{name}_{when}_m" for name, _ in columns)]
    for one in bins:
        rows.append([f"{one.from_m:g}", f"{one.to_m:g}"])
        for found in (one.after, one.before):
            names = ("count", *(name for _, name in columns))
            rows[-1] += [getattr(found, name, None) for name in names]
    return _csv(rows)


def _csv(rows: Iterable[Iterable[Any]]) -> str:
    """Return rows as CSV text, fractions with four digits, unknown values as empty fields."""

    def field(value: Any) -> str:
        if value is None or value != value:  # NaN
            return ""
        return f"{value:.4f}" if isinstance(value, float) else str(value)

    return "".join(",".join(map(field, row)) + "\n" for row in rows)


def figures_of(
    match: Match, lines: "Sequence[SectionLine]", others: Mapping[str, Match]
) -> Comparison:
    """Return all figures that the settings ask for.

    The cross-sections along `lines` come with the automatic ones; `others` are further clouds by
    name. Raises GeometryError if there are too few points for planes, or M3C2 finds nothing.
    """
    survey, reference, rules = match.survey, match.reference, match.settings
    c2c, c2c_from_reference = found = c2c_of(match)
    notes = sparse_notes(match, *found)
    pairs = vertical = residuals = None
    by_depth: dict[str, Any] = {**dict.fromkeys(("bed", "land", "depth", "tvu")), "depth_bins": []}
    if not rules.c2c_only:
        pairs = _pairs(match)
        # 64 classes; half a percent on either side is left out
        vertical = both(lambda p: distribution_of(p.error_m, 64, (), 0.5), pairs)
        by_depth |= _by_depth(match, pairs, notes)
        if reference.sparse:
            after = pairs.after
            residuals = np.column_stack([after.xy, after.reference_m, after.error_m])
    m3c2 = None
    if rules.m3c2:  # along normals as far as 1.5 times nearly all of the differences
        if pairs is None:
            far = nearest_distance(*match.facing(match.cloud.xyz))
        else:
            far = mapped(np.abs, (pairs.before or pairs.after).error_m)
        reach = max(1.0, 1.5 * float(np.percentile(far, 99)))
        m3c2 = both(lambda xyz: m3c2_distances(xyz, reference.xyz, reach), match.cloud)
    also = []
    for name, other in others.items():
        to, back = (pair and pair.after for pair in c2c_of(other))
        also.append(Figures(name=name, cloud=other.survey.name, c2c=to, c2c_from_reference=back))
    counts = Figures(
        cloud=len(survey) + survey.excluded,
        cloud_excluded=survey.excluded,
        reference=len(reference.xyz) + reference.excluded,
        reference_excluded=reference.excluded,
        outside_overlap=match.outside,
        not_submerged=match.not_submerged,
        compared=len(match.places) if reference.sparse else len(match.cloud),
        # with C2C from the reference
        reference_compared=len(match.places) if rules.from_reference else 0,
    )
    return Comparison(
        cloud=survey.name,
        reference=reference.name,
        # each point of the cloud, or each check point
        measured_at="reference" if reference.sparse else "cloud",
        counts=counts,
        # unsigned distances, to the reference (from check points: to the cloud) and from it
        c2c=c2c,
        c2c_from_reference=c2c_from_reference,
        also=also,  # further clouds
        vertical=vertical,  # signed, along the vertical
        # if water is known: vertical errors of submerged places (bed), of the others (land), and by
        # depth; depth against reference depth; and the uncertainty of all submerged places (tvu)
        **by_depth,
        m3c2=m3c2,
        sections=_sections(match, lines, others),
        settings=rules,
        notes=notes,
        seconds=0.0,
        check_points=residuals,  # (p, 4): x, y, z of check points, and the error
    )


def both(figure: Callable[[Any], Any], cloud: Any) -> Figures:
    """Return a figure of the corrected and of the apparent cloud, where it is known.

    `cloud` has the two as `after` and `before`.
    """
    before = None if cloud.before is None else figure(cloud.before)
    return Figures(after=figure(cloud.after), before=before)


def c2c_of(match: Match) -> tuple[Figures | None, Figures | None]:
    """Return the distances to the reference and from it; None for a direction not asked for.

    By default they start at each point of the cloud, or at each check point. From the reference
    means from each of its points that the cloud covers in plan, to the nearest of the whole cloud.
    """
    rules = match.settings

    def distribution(places: FloatArray, surface: FloatArray) -> Figures:
        return distribution_of(nearest_distance(places, surface), None, rules.share)

    to = back = None
    if rules.direction != "from-reference":
        to = both(lambda xyz: distribution(*match.facing(xyz)), match.cloud)
    if rules.from_reference:
        back = both(lambda xyz: distribution(match.places, xyz), match.asked)
    return to, back


def sparse_notes(match: Match, to: Figures | None, back: Figures | None) -> list[PcfixWarning]:
    """Return warnings of distances that mostly measure the spacing of a sparse cloud."""
    if match.reference.sparse:
        return []
    spacings = {}
    for name, xyz in ("reference", match.reference.xyz), ("cloud", match.asked.xyz):
        side = 3.0**0.5 * mean_spacing_m(xyz)  # of squares with three points, on average
        spacings[name] = spacing_m(xyz, max(side, 1e-9))
    notes = []
    for pair, sparse, dense in zip((to, back), spacings, reversed(spacings), strict=True):
        spacing, times = spacings[sparse], spacings[sparse] / max(spacings[dense], 1e-9)
        if pair is None or times < 2.0 or spacing < (mean := pair.after.statistics.mean_m):
            continue
        remedy = f"Give --direction {'from' if sparse == 'reference' else 'to'}-reference."
        if match.reference.raster:
            remedy = "Use the vertical error, or give the reference as points."
        text = (
            f"C2C to the {sparse} ({mean:.3f} m on average) mostly measures the spacing of its"
            f" points: {spacing:.2g} m, {times:.0f} times that of the {dense}. {remedy}"
        )
        notes.append(PcfixWarning(f"{sparse}.sparse", text, spacing_m=spacing, times=times))
    return notes


def _pairs(match: Match) -> Figures:
    """Return the `Pairs` at each point of the cloud, or at each check point."""
    sparse, k = match.reference.sparse, match.settings.neighbours
    name = match.survey.name if sparse else match.reference.name
    count = len(match.cloud if sparse else match.reference.xyz)
    if count < k:
        sentence = f"{name}: {count} points are too few for {k} neighbours. Give more points."
        code = f"{'cloud' if sparse else 'reference'}.too_few_points"
        raise GeometryError(code, sentence, path=name, points=count, least=k)

    def pairs(xyz: FloatArray) -> Pairs:
        places, surface = match.facing(xyz)
        height = heights_at(places, surface, k)
        measured, known = (height, places[:, 2]) if sparse else (places[:, 2], height)
        return Pairs(places[:, :2], known, mapped(np.subtract, measured, known))

    return both(pairs, match.cloud)


def _by_depth(match: Match, pairs: Figures, notes: list[PcfixWarning]) -> dict[str, Any]:
    """Return the figures of submerged places and of the others by name; none without water."""
    after, rules = pairs.after, match.settings
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
        depth = mapped(np.subtract, subset(wet, above), subset(wet, p.reference_m))
        return depth, subset(wet, p.error_m)

    found = both(submerged, pairs)
    (depth, error), error_before = found.after, found.before and found.before[1]
    figures = {
        "depth": both(lambda f: fit_line(f[0], mapped(np.subtract, *f)), found),
        "depth_bins": binned(depth, error, error_before, rules.bin_width),
        "tvu": tvu_of(error, depth),
        "bed": both(lambda p: statistics_of(subset(wet, p.error_m)), pairs),
    }
    if not wet.all():
        figures["land"] = both(lambda p: statistics_of(subset(~wet, p.error_m)), pairs)
    return figures


def _sections(
    match: Match, lines: "Sequence[SectionLine]", others: Mapping[str, Match]
) -> "tuple[Section, ...]":
    """Return the cross-sections that were asked for."""
    if match.settings.sections:
        bed = subset(match.wet, match.cloud.xyz) if match.wet.any() else match.cloud.xyz
        lines = [*lines, *lines_downslope(bed, match.settings.sections)]
    layers = {
        "water": match.water_points,
        "apparent": match.cloud.before,
        "corrected": match.cloud.xyz,
        "reference": match.reference.xyz,
        **{name: other.cloud.xyz for name, other in others.items()},
    }
    known = {name: xyz for name, xyz in layers.items() if xyz is not None and len(xyz)}
    return tuple(section_along(line, known, match.settings.corridor) for line in lines)


# Cross-sections


class SectionLine(NamedTuple):
    """A line in plan from (x1, y1) to (x2, y2), metres, world frame."""

    x1: float
    y1: float
    x2: float
    y2: float

    @property
    def length_m(self) -> float:
        """Length in plan."""
        return float(np.hypot(self.x2 - self.x1, self.y2 - self.y1))


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Heights along a line: running medians of the points in a corridor.

    The heights, world Z, are those of ``water``, ``apparent``, ``corrected`` and ``reference``, as
    far as known, and of further clouds by name; NaN if the corridor is empty.
    """

    line: SectionLine
    half_width_m: float
    distance_m: FloatArray  # (s,), stations from the start of the line
    heights_m: dict[str, FloatArray]  # (s,) each

    def table(self) -> str:
        """Return the section as CSV text; unknown heights are empty fields."""
        head = ["distance_m", *(f"{name}_m" for name in self.heights_m)]
        return _csv([head, *np.column_stack([self.distance_m, *self.heights_m.values()])])


def parse_line(text: str) -> SectionLine:
    """Parse ``x1,y1,x2,y2``; SettingError ``option.section`` if that is no line."""
    with suppress(ValueError, TypeError):  # no numbers, or not four
        line = SectionLine(*map(float, text.split(",")))
        if 0.0 < line.length_m < np.inf:
            return line
    sentence = "is not x1,y1,x2,y2, two different points. Give them in the CRS of the cloud."
    raise SettingError("option.section", f"section '{text}' {sentence}", value=text)


def section_along(line: SectionLine, layers: dict[str, FloatArray], half_width_m: float) -> Section:
    """Return the heights of several clouds, (n, 3) by name, metres, world frame, along a line.

    Each is the median of the points within a positive `half_width_m` across the line, and within
    that or the distance of the stations along it.
    """
    step = max(line.length_m / 200, 0.5 * half_width_m)  # 201 stations at most
    stations = np.linspace(0.0, line.length_m, max(round(line.length_m / step), 1) + 1)
    window, heights = max(step, half_width_m), {}
    east, north = (line.x2 - line.x1) / line.length_m, (line.y2 - line.y1) / line.length_m
    for name, xyz in layers.items():
        found = []
        for rows in blocks(len(xyz)):
            u, v = xyz[rows, 0] - line.x1, xyz[rows, 1] - line.y1
            inside = np.abs(v * east - u * north) <= half_width_m
            found.append(((u * east + v * north)[inside], xyz[rows, 2][inside]))
        along, z = np.hstack(found)
        order = np.argsort(along, kind="stable")
        along, z = along[order], z[order]
        first = np.searchsorted(along, stations - window, side="left")
        last = np.searchsorted(along, stations + window, side="right")
        heights[name] = np.array(
            [np.median(z[a:b]) if b > a else np.nan for a, b in zip(first, last, strict=True)]
        )
    return Section(line, half_width_m, stations, heights)


def lines_downslope(xyz: FloatArray, count: int) -> tuple[SectionLine, ...]:
    """Return evenly spaced lines down the steepest direction of a bed.

    The direction is that of the plane fitted to all points (n, 3), metres, world frame; each line
    runs over the extent of the points in its own share of the bed, from high to low. Raises
    GeometryError ``cloud.on_line`` if the points lie on a line in plan.
    """
    origin = np.sum([xyz[rows].sum(axis=0) for rows in blocks(len(xyz))], axis=0) / len(xyz)
    locals_ = (xyz[rows] - origin for rows in blocks(len(xyz)))
    products = np.sum([local[:, :2].T @ local for local in locals_], axis=0)
    covariance = products[:, :2]
    eigenvalues = np.linalg.eigvalsh(covariance)
    if len(xyz) < 3 or eigenvalues[0] <= 1e-6 * eigenvalues[1]:
        raise GeometryError(
            "cloud.on_line", "The bed is on a line in plan. Give --section x1,y1,x2,y2 instead."
        )
    gradient = np.linalg.solve(covariance, products[:, 2])
    steepness = float(np.hypot(*gradient))
    down = -gradient / steepness if steepness > 1e-9 else np.array([1.0, 0.0])
    left = np.array([-down[1], down[0]])
    place = mapped(lambda p: (p[:, :2] - origin[:2]) @ np.column_stack([down, left]), xyz)
    (_, right), (_, top) = bounds(place)
    lines = []
    for low, high in pairwise(np.linspace(right, top, count + 1)):
        left_of = place[:, 1]
        share = subset((left_of >= low) & (left_of <= high), place)
        (start, _), (stop, _) = bounds(share) if len(share) else np.zeros((2, 2))
        if stop > start:
            middle = origin[:2] + 0.5 * (low + high) * left
            ends = np.append(middle + start * down, middle + stop * down)
            lines.append(SectionLine(*ends.tolist()))
    return tuple(lines)
