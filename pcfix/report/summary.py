"""What a correction did, in numbers: the summary that ``--summary`` writes and the report shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from pcfix.errors import plain


class Figures(SimpleNamespace):
    """The results of a command by name, as its text and the JSON file of its summary have them."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(plain(self))


@dataclass(frozen=True)
class Summary:
    """What a run over a file did, in numbers; `as_dict` is what ``--summary`` writes."""

    input: str
    output: str
    pcfix: str
    points: int
    submerged: int
    corrected: int
    uncorrected: dict[str, int]
    dropped: int
    water_unknown: int
    depth_m: dict[str, float]
    shift_z_m: dict[str, float]
    rays: int
    incidence_deg: float  # the largest of the rays used, in air
    cameras: int
    cameras_used: int
    cameras_unused: list[str]  # labels of those without corrected points
    water: str
    settings: dict[str, Any]
    seconds: float
    views: dict[str, Any] | None = None
    water_fit: dict[str, Any] | None = None
    warnings: list[dict[str, Any]] = field(default_factory=list)
    labelling: dict[str, Any] | None = None
    uncertainty: dict[str, Any] | None = None
    carried: dict[str, Any] | None = None
    made: dict[str, Any] | None = None  # the reconstruction type, and why
    told: list[str] = field(default_factory=list)  # other notes on the cloud, also in `warnings`
    poses: dict[str, Any] | None = None  # whether they have absorbed the refraction
    unsure: int | None = None  # corrected points that only obliques see; None if not withheld
    shoreline: dict[str, Any] | None = None
    fit: dict[str, Any] | None = None  # see `pcfix.flow.plausibility`
    part: dict[str, Any] | None = None  # what was read, if not all points were

    @property
    def absorbed(self) -> bool | None:
        """Whether the poses have absorbed the refraction; None if that is unknown."""
        return None if self.poses is None else self.poses["absorbed"]

    @property
    def why_no_order(self) -> str:
        """Why no order of S-44 is claimed, as the whole bed may be off; empty if one is."""
        made = self.made or {}
        if self.settings["method"] == "regression":  # measured depths hold the bed
            return "the line is of another cloud" if "regression" in self.settings else ""
        if made.get("method") != "consistent" or not made.get("sure", bool(made.get("views_are"))):
            return "the reconstruction type is not certain, or the method is for another one"
        return {
            True: "the poses absorbed the refraction",
            None: "the poses were not checked for absorbed refraction",
            False: "",
        }[self.absorbed]

    @property
    def points_per_s(self) -> float:
        """Points read per second, files included."""
        return self.points / max(self.seconds, 1e-9)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; optional parts only if there are any."""
        optional = ("labelling", "carried", "unsure", "poses", "shoreline", "fit", "part")
        values = {
            name: value for name, value in vars(self).items()
            if name != "told" and not (name in optional and value is None)
        }  # fmt: skip
        if self.uncertainty is not None and self.why_no_order:
            no_order = {"s44": None, "why_no_order": self.why_no_order}
            values["uncertainty"] = {**self.uncertainty, **no_order}
        return {**values, "points_per_s": round(self.points_per_s)}
