"""Cross-sections: heights along lines in plan."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pcfix.blocks import blocks, bounds, kept, mapped
from pcfix.errors import GeometryError, SettingError
from pcfix.model import FloatArray

STATIONS = 200
"""Maximum number of stations; they are at least a quarter of the corridor's width apart."""


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
        columns = [self.distance_m, *self.heights_m.values()]
        lines = [",".join(["distance_m", *(f"{name}_m" for name in self.heights_m)])]
        lines += [
            ",".join("" if np.isnan(value) else f"{value:.4f}" for value in row)
            for row in zip(*columns, strict=True)
        ]
        return "\n".join(lines) + "\n"


def parse_line(text: str) -> SectionLine:
    """Parse ``x1,y1,x2,y2``; SettingError ``option.section`` if that is no line."""
    try:
        x1, y1, x2, y2 = (float(part) for part in text.split(","))
        line = SectionLine(x1, y1, x2, y2)
        if 0.0 < line.length_m < np.inf:
            return line
    except ValueError:
        pass
    sentence = "is not x1,y1,x2,y2, two different points. Give them in the CRS of the cloud."
    raise SettingError("option.section", f"section '{text}' {sentence}", value=text)


def section_along(line: SectionLine, layers: dict[str, FloatArray], half_width_m: float) -> Section:
    """Return the heights of several clouds, (n, 3) by name, metres, world frame, along a line.

    Each is the median of the points within a positive `half_width_m` across the line, and within
    that or the distance of the stations along it.
    """
    step = max(line.length_m / STATIONS, 0.5 * half_width_m)
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
    edges = np.linspace(right, top, count + 1)
    lines = []
    for low, high in pairwise(edges):
        left_of = place[:, 1]
        share = kept((left_of >= low) & (left_of <= high), place)
        (start, _), (stop, _) = bounds(share) if len(share) else np.zeros((2, 2))
        if stop > start:
            middle = origin[:2] + 0.5 * (low + high) * left
            ends = np.append(middle + start * down, middle + stop * down)
            lines.append(SectionLine(*ends.tolist()))
    return tuple(lines)
