"""What a correction did, in numbers: the summary that ``--summary`` writes and the report shows."""

from __future__ import annotations

from typing import Any

from pcfix.sums import Figures


class Summary(Figures):
    """The results of a correction by name; `as_dict` is what ``--summary`` writes."""

    @property
    def absorbed(self) -> bool | None:
        """Whether the poses have absorbed the refraction; None if that is unknown."""
        return None if self.poses is None else self.poses["absorbed"]

    @property
    def why_no_order(self) -> str:
        """Why no order of S-44 is claimed, as the whole bed may be off; empty if one is."""
        found = self.reconstruction or {}
        if self.settings["method"] == "regression":  # measured depths hold the bed
            return ""
        is_sure = found.get("sure", bool(found.get("views_are")))
        if found.get("method") != "consistent" or not is_sure:
            return "the reconstruction type is uncertain, or the method assumes another one"
        return {
            True: "the poses have absorbed the refraction",
            None: "the poses were not checked for absorbed refraction",
            False: "",
        }[self.absorbed]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; optional parts only if there are any."""
        optional = ("labelling", "transfer", "poses", "fit", "part")
        values = {
            name: value for name, value in vars(self).items()
            if name != "notes" and not (name in optional and value is None)
        }  # fmt: skip
        if self.uncertainty is not None and self.why_no_order:
            no_order = {"s44": None, "why_no_order": self.why_no_order}
            values["uncertainty"] = {**self.uncertainty, **no_order}
        return values
