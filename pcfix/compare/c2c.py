"""C2C: distances to the nearest point, either way, of a cloud and of further ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

from pcfix.compare.match import Match
from pcfix.compare.nearest import cloud_to_cloud, spacing_m
from pcfix.compare.statistics import Distribution, distances_of
from pcfix.errors import PcfixWarning
from pcfix.model import FloatArray

Given = TypeVar("Given")
Figure = TypeVar("Figure")

SPARSER = 2.0
"""A cloud is called sparse if its spacing is so many times that of the other."""


@dataclass(frozen=True, slots=True)
class AfterBefore(Generic[Figure]):
    """A figure after the correction and, if the cloud has shift dimensions, before it."""

    after: Figure
    before: Figure | None


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

    def distances(xyz: FloatArray) -> Distribution:
        return distances_of(distances_to(match, xyz), rules.classes, rules.share)

    def distances_back(xyz: FloatArray) -> Distribution:
        return distances_of(cloud_to_cloud(match.places, xyz), rules.classes, rules.share)

    to = back = None
    if rules.direction != "from-reference":
        to = both(distances, match.cloud.xyz, match.cloud.apparent)
    if rules.from_reference:
        back = both(distances_back, match.asked.xyz, match.asked.apparent)
    return to, back


def distances_to(match: Match, xyz: FloatArray) -> FloatArray:
    """Return the distance from each point of a cloud, or from each check point, shape (p,), m."""
    if match.reference.sparse:
        return cloud_to_cloud(match.places, xyz)
    return cloud_to_cloud(xyz, match.reference.xyz)


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
        notes.append(
            PcfixWarning(
                f"{sparse}.sparse",
                f"C2C to the {sparse} ({mean:.3f} m on average) mostly measures the spacing of its"
                f" points: {apart:.2g} m, {times:.0f} times that of the {dense}. {remedy}",
                spacing_m=apart,
                times=times,
            )
        )
    return notes
