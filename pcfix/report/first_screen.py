"""The first screen of the report page: project, depth, accuracy, and what to check.

Measured figures come before predicted ones, those of the bed before all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pcfix.refract.tally import COVERAGE_95, Summary
from pcfix.report.comparison import noise_sentence, raw_of, signed
from pcfix.report.page import Table, Tile, name_of
from pcfix.report.text import FEWEST, summary_rows

Plain = dict[str, Any]

CONTRADICTS = 1.5
"""Measured and predicted errors that differ by a larger factor contradict each other."""
SHOWN_NOTES = 3
UNKNOWN_DATUM = "vertical datum not known"


@dataclass(frozen=True)
class Survey:
    """Project, date of the images, CRS, and vertical datum; empty where not known."""

    project: str = ""
    date: str = ""
    crs: str = ""
    heights: str = ""

    @property
    def place(self) -> str:
        """CRS and vertical datum of the map."""
        return f"{self.crs or 'CRS not stated'}; heights: {self.heights or UNKNOWN_DATUM}."


def head_of(s: Summary, survey: Survey) -> Table:
    """Return the lines beside the map."""
    shown = ("Submerged", "Cameras", "Water", "")
    rows = [
        ["Images", survey.date or "date not stated"],
        ["CRS", survey.crs or "not stated by the cloud"],
        ["Heights", survey.heights or f"{UNKNOWN_DATUM}: the cloud states none"],
        ["Points", f"{s.points:,}"],
        *([label, text] for label, text in summary_rows(s) if label in shown),
    ]
    return Table("The project", [], rows)


def is_found(s: Summary) -> bool:
    """Whether the water was sought in the cloud."""
    return s.water_fit is not None and s.water_fit["model"] == "auto"


def tiles_of(s: Summary, survey: Survey, compared: Plain, depth_m: Plain) -> list[Tile]:
    """Return the three tiles: depth (`depth_m` with min, mean and max), accuracy, notes."""
    mean = s.shift_z_m["mean"]
    way = "up" if mean > 0.0 else "down"
    depths = [
        ("range", f"{depth_m['min']:.2f} to {depth_m['max']:.2f} m"),
        ("mean", f"{depth_m['mean']:.2f} m"),
    ]
    moved = f"{s.corrected:,} points of the bed moved {way} by {abs(mean):.2f} m on average."
    notes = notes_of(s, survey, compared)[:SHOWN_NOTES] or ["None."]
    return [
        Tile("Depth", figures=depths, notes=[moved]),
        accuracy_tile(s, compared),
        Tile("Warnings", notes=notes),
    ]


def in_short(tiles: Sequence[Tile]) -> str:
    """Return the figures of `tiles_of` in a line, for the terminal."""
    parts = []
    for tile in tiles:
        if tile.figures:
            tag = f", {tile.tag}" if tile.tag else ""
            figures = ", ".join(f"{name} {value}" for name, value in tile.figures)
            parts.append(f"{tile.title[0].lower()}{tile.title[1:]}{tag}: {figures}")
    return "; ".join(parts)


def accuracy_tile(s: Summary, compared: Plain) -> Tile:
    """Return the accuracy of the bed: measured where there is a reference, else predicted."""
    if compared.get("own"):
        return _measured(compared)
    title, unknown = "Accuracy of the bed", "not known"
    if s.uncertainty is None:
        why = "There is no reference, and the points have no standard errors."
        return Tile(title, "predicted", [("RMSE", unknown)], [why])
    sigma, tvu = s.uncertainty["sigma_z_m"]["mean"], s.uncertainty["tvu_95_m"]["mean"]
    figures = [("standard error", f"{sigma:.3f} m"), ("95 %", f"{tvu:.3f} m"), ("bias", unknown)]
    why = (
        "No reference was given. The prediction follows from assumed errors without a common bias."
    )
    return Tile(title, "predicted", figures, [why])


def _measured(compared: Plain) -> Tile:
    own, pair = compared["own"], raw_of(compared)
    raw, before = pair["after"], pair["before"]
    name = name_of(compared["reference"])
    of = "bed" if own["of"] == "bed" else "cloud (bed and land are not separated)"
    known = raw if own["rmse_m"] is None else own
    noise = noise_sentence(own, raw)
    notes = [
        f"At {raw['count']:,} points against {name}"
        + (f"; before the correction, RMSE {before['rmse_m']:.3f} m." if before else "."),
        noise[:1].upper() + noise[1:],
    ]
    if own["of"] == "bed" and compared["land"]:
        land = compared["land"]["after"]
        notes.append(
            f"Land: bias {signed(land['mean_m'])}, RMSE {land['rmse_m']:.3f} m, reference included."
        )
    figures = [
        ("bias", signed(own["mean_m"])),
        ("RMSE", f"{known['rmse_m']:.3f} m"),
        ("95 %", f"{known['within_95_m']:.3f} m"),
    ]
    return Tile(f"Accuracy of the {of}", "measured", figures, notes)


def notes_of(s: Summary, survey: Survey, compared: Plain) -> list[str]:
    """Return what to check, the most important first."""
    notes = [] if not compared.get("own") else _contradictions(s, compared)
    if not compared.get("own"):
        notes.append("No reference: the accuracy is predicted. Check points on the bed measure it.")
    if s.poses is not None and s.poses["absorbed"] is None and s.cameras:
        notes.append(f"Poses: {s.poses['words']}.")
    if not survey.heights:
        notes.append(
            "The vertical datum is not known: water level, cloud and reference must have the same."
        )
    fate = {"withhold": "withheld", "keep": "kept", "drop": "dropped"}[s.settings["uncorrected"]]
    notes += [
        f"{count:,} points under water could not be corrected ({reason}). They were not moved and"
        f" are {fate}."
        for reason, count in s.uncorrected.items()
        if count
    ]
    if s.water_unknown:
        notes.append(f"{s.water_unknown:,} points have no known water surface above them.")
    notes += [one["message"] for one in s.warnings]
    notes += [one["message"] for one in compared.get("notes", ())]
    return [note[:1].upper() + note[1:] for note in notes]


def _contradictions(s: Summary, compared: Plain) -> list[str]:
    """Return notes where measured errors are not the predicted ones, or the bed has a bias."""
    own, bed = compared["own"], compared.get("bed")
    if not bed:
        return []
    notes, after, noise = [], bed["after"], own["sigma_reference_m"]
    if s.uncertainty is not None and after["count"] >= FEWEST:
        sigma, measured = s.uncertainty["sigma_z_m"]["mean"], after["rmse_m"]
        expected = (sigma**2 + noise**2) ** 0.5
        if not 1.0 / CONTRADICTS <= measured / expected <= CONTRADICTS:
            is_larger = measured > expected
            notes.append(
                f"The measured errors of the bed are {'larger' if is_larger else 'smaller'} than"
                f" the predicted ones (RMSE {measured:.3f} m, predicted {expected:.3f} m with the"
                f" reference's noise; 95 % predicted {COVERAGE_95 * sigma:.3f} m without): "
                f"{'use the measured ones' if is_larger else 'the predicted ones are cautious'}."
            )
    bias = after["mean_m"]
    if abs(bias) > max(after["sd_m"], noise):
        notes.append(
            f"The bed is too {'high' if bias > 0.0 else 'low'} by {abs(bias):.3f} m on average,"
            " more than it scatters. Check water level, refractive index, vertical datum and poses."
        )
    return notes
