"""What the page of a run says first: of what, by which water, how deep, how well, and what not.

Measured figures come before formal ones, those of the bed before all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pcfix.options.correct import LEVEL_M
from pcfix.refract.tally import COVERAGE_95, Summary
from pcfix.report.comparison import noise_sentence, raw_of, signed
from pcfix.report.page import Table, Tile, name_of
from pcfix.report.text import FEWEST, share

Plain = dict[str, Any]

CONTRADICTS = 1.5
"""Times by which measured and predicted errors may differ, where there are enough."""
SHOWN_NOTES = 3


@dataclass(frozen=True)
class Survey:
    """What the page says of the project that is not of the correction.

    Attributes
    ----------
    project : str
    date : str
        When the images were taken; empty where that is not known.
    crs, heights : str
        Name of the system in plan, and what heights are above; empty where the cloud says none.
    """

    project: str = ""
    date: str = ""
    crs: str = ""
    heights: str = ""

    @property
    def place(self) -> str:
        """Of the coordinates of the map."""
        return f"{self.crs or 'CRS not stated'}; heights: {self.heights or UNKNOWN_DATUM}."


UNKNOWN_DATUM = "vertical datum not known"


def head_of(s: Summary, survey: Survey) -> Table:
    """Return the lines beside the map."""
    rows = [
        ["Images", survey.date or "date not stated"],
        ["CRS", survey.crs or "not stated by the cloud"],
        ["Heights", survey.heights or f"{UNKNOWN_DATUM}: the cloud states none"],
        ["Water", water_words(s)],
        ["Points", f"{s.points:,}, {share(s.submerged, s.points)} under water"],
        ["Cameras", f"{s.cameras_used} of {s.cameras} used" if s.cameras else "none"],
    ]
    return Table("The project", [], rows)


def is_found(s: Summary) -> bool:
    """Whether the water was sought in the cloud."""
    return s.water_fit is not None and s.water_fit["model"] == "auto"


def water_words(s: Summary) -> str:
    """Return the level with its standard error, and where they come from."""
    fit, stated = s.water_fit, s.settings.get("sigma_level")
    if fit is None:
        origin, sigma, of = "as given", LEVEL_M, "assumed"
    else:
        known = f" to {fit['accepted']} of {fit['points']} points" if "points" in fit else ""
        origin = "found in the cloud" if is_found(s) else f"fitted{known}"
        sigma, of = fit["sigma_level_m"], "of the fit"
    if stated is not None:
        sigma, of = stated, "as stated"
    is_level = fit is not None and not fit.get("tilt_percent", 1.0)
    water = f"level {fit['level_m']:.3f} m" if fit and is_level else s.water
    index = s.settings["index"]
    return f"{water}, {origin}; standard error {sigma:.3f} m ({of}); index {index:g}"


def tiles_of(s: Summary, survey: Survey, compared: Plain, depth_m: Plain) -> list[Tile]:
    """Return the three tiles: depth (`depth_m` with min, mean and max), accuracy, watch out."""
    notes = notes_of(s, survey, compared)
    return [
        Tile(
            "Depth",
            figures=[
                ("range", f"{depth_m['min']:.2f} to {depth_m['max']:.2f} m"),
                ("mean", f"{depth_m['mean']:.2f} m"),
            ],
            notes=[_moved(s)],
        ),
        accuracy_tile(s, compared),
        Tile("What to watch out for", notes=notes[:SHOWN_NOTES] or ["Nothing stood out."]),
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


def _moved(s: Summary) -> str:
    mean = s.shift_z_m["mean"]
    way = "up" if mean > 0.0 else "down"
    return f"{s.corrected:,} points of the bed moved {way} by {abs(mean):.2f} m on average."


def accuracy_tile(s: Summary, compared: Plain) -> Tile:
    """Return how good the bed is: as measured where there is a reference, else as predicted."""
    if compared.get("own"):
        return _measured(compared)
    if s.uncertainty is None:
        return Tile(
            "Accuracy of the bed", "predicted", [("RMSE", "not known")],
            ["No reference, and no standard errors of the points."],
        )  # fmt: skip
    sigma, tvu = s.uncertainty["sigma_z_m"]["mean"], s.uncertainty["tvu_95_m"]["mean"]
    return Tile(
        "Accuracy of the bed",
        "predicted",
        [("standard error", f"{sigma:.3f} m"), ("95 %", f"{tvu:.3f} m"), ("bias", "not known")],
        ["No reference was given: predicted from the errors assumed, which hold no common bias."],
    )


def _measured(compared: Plain) -> Tile:
    own, pair = compared["own"], raw_of(compared)
    raw, came = pair["after"], pair["before"]
    name = name_of(compared["reference"])
    of = "bed" if own["of"] == "bed" else "cloud (bed and land are not told apart)"
    is_known = own["rmse_m"] is not None
    rmse, within = (own if is_known else raw)["rmse_m"], (own if is_known else raw)["within_95_m"]
    noise = noise_sentence(own, raw)
    notes = [
        f"At {raw['count']:,} points against {name}"
        + (f"; as it came, RMSE {came['rmse_m']:.3f} m." if came else "."),
        noise[:1].upper() + noise[1:],
    ]
    if own["of"] == "bed" and compared["land"]:
        land = compared["land"]["after"]
        notes.append(
            f"Land: bias {signed(land['mean_m'])}, RMSE {land['rmse_m']:.3f} m, reference included."
        )
    figures = [("bias", signed(own["mean_m"])), ("RMSE", f"{rmse:.3f} m")]
    return Tile(f"Accuracy of the {of}", "measured", [*figures, ("95 %", f"{within:.3f} m")], notes)


def notes_of(s: Summary, survey: Survey, compared: Plain) -> list[str]:
    """Return what to watch out for, what was measured first."""
    notes = [*_contradiction(s, compared), *_biased(compared)]
    if not compared.get("own"):
        notes.append("No reference: the accuracy is predicted. Check points on the bed measure it.")
    if s.poses is not None and s.poses["absorbed"] is None and s.cameras:
        notes.append(f"Poses: {s.poses['words']}.")
    if not survey.heights:
        notes.append(
            "The vertical datum is not known: the water level, the cloud and any reference must"
            " count from one."
        )
    notes += [*_uncorrected(s), *(one["message"] for one in s.warnings), *compared.get("notes", ())]
    return [note[:1].upper() + note[1:] for note in notes]


def _contradiction(s: Summary, compared: Plain) -> list[str]:
    """Say where measured errors are not those that were predicted."""
    own, bed = compared.get("own"), compared.get("bed")
    if not own or not bed or s.uncertainty is None or bed["after"]["count"] < FEWEST:
        return []
    sigma, measured = s.uncertainty["sigma_z_m"]["mean"], bed["after"]["rmse_m"]
    expected = (sigma**2 + own["sigma_reference_m"] ** 2) ** 0.5
    if 1.0 / CONTRADICTS <= measured / expected <= CONTRADICTS:
        return []
    way = "larger" if measured > expected else "smaller"
    rely = "take the measured ones" if measured > expected else "these are cautious here"
    return [
        f"The measured errors of the bed are {way} than the predicted ones (RMSE {measured:.3f} m,"
        f" predicted {expected:.3f} m with the reference's noise; 95 % predicted"
        f" {COVERAGE_95 * sigma:.3f} m without): {rely}."
    ]


def _biased(compared: Plain) -> list[str]:
    own, bed = compared.get("own"), compared.get("bed")
    if not own or not bed:
        return []
    bias, scatter = bed["after"]["mean_m"], bed["after"]["sd_m"]
    if abs(bias) <= max(scatter, own["sigma_reference_m"]):
        return []
    way = "high" if bias > 0.0 else "low"
    return [
        f"The bed is too {way} as a whole by {abs(bias):.3f} m, more than it scatters: check water"
        " level, refractive index, vertical datum and poses."
    ]


def _uncorrected(s: Summary) -> list[str]:
    notes = []
    fate = {"withhold": "flagged as withheld", "keep": "left as they were", "drop": "left out"}
    for reason, count in s.uncorrected.items():
        if count:
            notes.append(
                f"{count:,} points under water could not be corrected ({reason}); they were not"
                f" moved and are {fate[s.settings['uncorrected']]}."
            )
    if s.water_unknown:
        notes.append(f"{s.water_unknown:,} points have no known water surface above them.")
    return notes
