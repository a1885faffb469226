"""C2C: distances to the nearest point, either way, of a cloud and of further ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from pcfix.compare.match import Match
from pcfix.compare.nearest import cloud_to_cloud, spacing_m
from pcfix.compare.statistics import Distribution, distances_of
from pcfix.model import FloatArray

Given = TypeVar("Given")
Figure = TypeVar("Figure")

SPARSER = 2.0
"""How many times farther apart points must be to be called sparse."""


@dataclass(frozen=True, slots=True)
class AfterBefore(Generic[Figure]):
    """A figure after the correction and, where the cloud says where its points were, before."""

    after: Figure
    before: Figure | None


def both(
    figure: Callable[[Given], Figure], after: Given, before: Given | None
) -> AfterBefore[Figure]:
    """Return a figure of what is after, and of what was before where that is known."""
    return AfterBefore(figure(after), None if before is None else figure(before))


@dataclass(frozen=True, slots=True)
class Further:
    """The C2C of a further cloud, as it is; see `pcfix.compare.figures.Comparison`."""

    name: str
    cloud: str
    c2c: Distribution | None
    c2c_from_reference: Distribution | None


@dataclass(frozen=True, slots=True)
class C2c:
    """The distances of a cloud in the directions that were asked for."""

    to_reference: AfterBefore[Distribution] | None
    from_reference: AfterBefore[Distribution] | None


def c2c_of(match: Match) -> C2c:
    """Return the distances in every direction that the settings ask for.

    By default from each point of the cloud, or of check points. From the reference means from each
    of its points that the cloud reaches in plan, to the nearest of the whole cloud.
    """
    rules = match.settings

    def distances(xyz: FloatArray) -> Distribution:
        return distances_of(far_of(match, xyz), rules.classes, rules.share)

    def distances_back(xyz: FloatArray) -> Distribution:
        return distances_of(cloud_to_cloud(match.places, xyz), rules.classes, rules.share)

    to = back = None
    if rules.direction != "from-reference":
        to = both(distances, match.cloud.xyz, match.cloud.apparent)
    if rules.from_reference:
        back = both(distances_back, match.asked.xyz, match.asked.apparent)
    return C2c(to, back)


def far_of(match: Match, xyz: FloatArray) -> FloatArray:
    """Return the distance from each point of a cloud, or from each check point, shape (p,), m."""
    if match.reference.sparse:
        return cloud_to_cloud(match.places, xyz)
    return cloud_to_cloud(xyz, match.reference.xyz)


def further_of(others: Mapping[str, Match]) -> tuple[Further, ...]:
    """Return the distances of further clouds, by name."""
    rows = []
    for name, match in others.items():
        found = c2c_of(match)
        to, back = (
            None if p is None else p.after for p in (found.to_reference, found.from_reference)
        )
        rows.append(Further(name, match.whole.name, to, back))
    return tuple(rows)


def sparse_notes(match: Match, found: C2c) -> list[str]:
    """Return which distances rather say how far apart the points of a sparse cloud are."""
    if match.reference.sparse:
        return []
    apart_m = {"reference": spacing_m(match.reference.xyz), "cloud": spacing_m(match.asked.xyz)}
    ways = (
        (found.to_reference, "reference", "cloud"), (found.from_reference, "cloud", "reference")
    )  # fmt: skip
    notes = []
    for pair, sparse, dense in ways:
        times = apart_m[sparse] / max(apart_m[dense], 1e-9)
        if pair is None or times < SPARSER or apart_m[sparse] < pair.after.statistics.mean_m:
            continue
        remedy = f"give --direction {'from' if sparse == 'reference' else 'to'}-reference"
        if match.reference.raster:
            remedy = "judge by the vertical error, or give the reference as points"
        elif None not in (found.to_reference, found.from_reference):
            remedy = f"judge by C2C from each point of the {sparse}"
        notes.append(
            f"the points of the {sparse} are {apart_m[sparse]:.2g} m apart, {times:.0f} times as"
            f" far as those of the {dense}, so that C2C to the nearest of them"
            f" ({pair.after.statistics.mean_m:.3f} m on average) is mostly this spacing; {remedy}"
        )
    return notes
