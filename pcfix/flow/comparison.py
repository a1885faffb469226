"""What a comparison says: the figures of `pcfix.flow.compare`."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from pcfix.compare.depth import Bin, Line, check_width
from pcfix.compare.m3c2 import M3c2  # noqa: TC001
from pcfix.compare.sections import Section  # noqa: TC001
from pcfix.compare.statistics import Distribution  # noqa: TC001
from pcfix.compare.vertical import DEFAULT_NEIGHBOURS, check_neighbours
from pcfix.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Iterable


@dataclass(frozen=True, slots=True)
class CompareSettings:
    """What the user of a comparison may choose.

    Attributes
    ----------
    submerged : bool
        Compare only points under water.
    vertical : bool
        Whether signed differences are wanted, and all that rests on them.
    m3c2 : bool
        Whether M3C2 is wanted.
    neighbours : int
        Points of each fitted plane, at least 6.
    bin_width_m, shore_bin_width_m : float
        Of the tables by depth and by distance from the shore.
    max_gap_m : float or None
        How far in plan from the nearest point of the other cloud a point still counts; None: 5
        mean spacings of that cloud, at least 1 m.
    sections : int
        Automatic cross-sections.
    corridor_m : float
        Half-width of a cross-section.
    """

    submerged: bool = False
    vertical: bool = True
    m3c2: bool = False
    neighbours: int = DEFAULT_NEIGHBOURS
    bin_width_m: float = 1.0
    shore_bin_width_m: float = 10.0
    max_gap_m: float | None = None
    sections: int = 0
    corridor_m: float = 1.0

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        check_neighbours(self.neighbours)
        check_width(self.bin_width_m)
        check_width(self.shore_bin_width_m)
        for name, value in (("max-gap", self.max_gap_m), ("corridor", self.corridor_m)):
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise SettingError(f"{name} {value:g} is not positive; give metres.")
        if self.sections < 0:
            raise SettingError(f"sections {self.sections} is negative; give how many.")


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


@dataclass(frozen=True, slots=True)
class Distances:
    """One figure after the correction and, where the cloud says where its points were, before."""

    after: Distribution
    before: Distribution | None


@dataclass(frozen=True, slots=True)
class DepthFits:
    """Depth against reference depth; None where undefined."""

    after: Line | None
    before: Line | None


@dataclass(frozen=True, slots=True)
class M3c2Pair:
    """M3C2 after the correction, and before it."""

    after: M3c2
    before: M3c2 | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A cloud against a reference; all errors are cloud minus reference, metres.

    Attributes
    ----------
    cloud, reference : str
    measured_at : {"cloud", "reference"}
        Whether each point of the cloud was compared, or each check point.
    counts : Counts
    c2c : Distances
        To the nearest point, without sign.
    vertical : Distances or None
        Signed, along the vertical.
    depth : DepthFits or None
        None where the water surface is not known.
    depth_bins, shore_bins : tuple of Bin
        Submerged places by reference depth, and by distance in plan from the nearest dry point.
    m3c2 : M3c2Pair or None
    sections : tuple of Section
    settings : CompareSettings
    notes : tuple of str
        What was left out, and why.
    seconds : float
    """

    cloud: str
    reference: str
    measured_at: Literal["cloud", "reference"]
    counts: Counts
    c2c: Distances
    vertical: Distances | None
    depth: DepthFits | None
    depth_bins: tuple[Bin, ...]
    shore_bins: tuple[Bin, ...]
    m3c2: M3c2Pair | None
    sections: tuple[Section, ...]
    settings: CompareSettings
    notes: tuple[str, ...]
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; a section by its line, its heights are CSV."""
        names = [name for name in self.__slots__ if name != "sections"]
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


def bins_table(bins: Iterable[Bin]) -> str:
    """Return bins as CSV text; the columns of `before` are empty where it is not known."""
    figures = ("count", "mean_m", "sd_m", "rmse_m", "nmad_m")
    names = [n.replace("mean_m", "bias_m") for n in figures]
    head = [
        f"{n}_{when}" if n == "count" else f"{n[:-2]}_{when}_m"
        for when in ("after", "before")
        for n in names
    ]
    lines = [",".join(["from_m", "to_m", *head])]
    for one in bins:
        fields = [f"{one.from_m:g}", f"{one.to_m:g}"]
        for statistics in (one.after, one.before):
            for name in figures:
                value = "" if statistics is None else getattr(statistics, name)
                fields.append(f"{value:.4f}" if isinstance(value, float) else str(value))
        lines.append(",".join(fields))
    return "\n".join(lines) + "\n"
