"""The report page of a run: words, pictures and tables on the correction and the adjustment."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.colours import DEPTH, DIFFERENCE, RAYS, UNCERTAINTY
from pcfix.grid.maps import Extent, Maps, contours, depth_interval
from pcfix.model import Cameras, FloatArray
from pcfix.refract.tally import COVERAGE_95, ORDERS, largest_tvu_m
from pcfix.report.comparison import noise_sentence, raw_of, signed
from pcfix.report.page import (
    AFTER,
    BEFORE,
    REFERENCE,
    WATER,
    Layer,
    Picture,
    Report,
    Table,
    Tile,
    label_plan,
    map_figure,
    name_of,
    new_figure,
    relief,
)
from pcfix.report.summary import Summary
from pcfix.report.text import FEWEST, formal_words, summary_rows, uncertainty_sentence
from pcfix.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Plain = dict[str, Any]
Pair = tuple[str, str]
FIRST_FIGURES = ("water", "section_1", "depth_bins", "uncertainty", "cameras")
"""Those that are shown where they are there, the first four of them."""
SHOWN_NOTES = 3
CONTRADICTS = 1.5
"""Measured and predicted errors that differ by a larger factor contradict each other."""
BESIDE_MAP = ("Submerged", "Cameras", "Water", "")
"""Labels of the rows that are also shown beside the map."""
UNKNOWN_DATUM = "vertical datum not known"


@dataclass(frozen=True, eq=False)
class RunResults:
    """Everything that the page of a run shows."""

    summary: Summary
    cameras: Cameras
    maps: Maps
    depth_m: dict[str, float]  # min, mean and max of the bed's points that are not noise
    sample: FloatArray  # shape (m, 2): depth and standard error of Z, zero where unknown
    crs: str = ""  # of the cloud, and its vertical datum; empty if not known
    heights: str = ""
    project: str = ""
    date: str = ""  # of the images
    pictures: Sequence[Picture] = ()  # of other steps, the most important first
    tables: Sequence[Table] = ()
    verdict: str = ""  # one sentence on them
    compared: Plain = field(default_factory=dict)  # `Comparison.as_dict`
    difference: tuple[FloatArray, Extent] | None = None  # cloud minus reference, metres


def run_report(run: RunResults, inputs: Table, files: Sequence[Pair]) -> Report:
    """Return the page of a run; `inputs` lists the files read, `files` those beside the page."""
    s, depth = run.summary, run.depth_m
    versions = [["pcfix", __version__], ["Python", platform.python_version()]]
    versions += [[name, version(name)] for name in ("numpy", "scipy", "numba", "laspy", "lazrs")]
    order = {name: place for place, name in enumerate(FIRST_FIGURES)}
    mean = s.shift_z_m["mean"]
    lead = (
        f"Correction for refraction of {name_of(s.input)}: {s.corrected:,} of {s.points:,} points"
        f" are under water and were moved, {abs(mean):.2f} m"
        f" {'higher' if mean > 0.0 else 'deeper'} on average."
    )
    if s.transfer is not None:
        lead += (
            " Before that, the whole cloud was transferred to the adjusted poses, which moved it by"
            f" {s.transfer['shift_m']['rms']:.2f} m (rms)."
        )
    rows = summary_rows(s)
    beside = [
        ["Images", run.date or "date not stated"],
        ["CRS", run.crs or "not stated by the cloud"],
        ["Heights", run.heights or f"{UNKNOWN_DATUM}: the cloud states none"],
        ["Points", f"{s.points:,}"],
        *([label, words] for label, words in rows if label in BESIDE_MAP),
    ]
    notes = notes_of(s, run.heights, run.compared)
    moved = (
        f"{s.corrected:,} points of the bed moved {'up' if mean > 0.0 else 'down'} by"
        f" {abs(mean):.2f} m on average."
    )
    depths = [
        ("range", f"{depth['min']:.2f} to {depth['max']:.2f} m"),
        ("mean", f"{depth['mean']:.2f} m"),
    ]
    # the rows of the terminal, with the detected reconstruction type in words
    facts = {"Cloud": name_of(s.input), "Points": f"{s.points:,}", **dict(rows)}
    found = s.reconstruction
    facts |= {"Method": f"{found['method']}. {found['because']}"} if found else {}
    # it names the order of S-44, by the measured differences where there are some
    facts |= {"Uncertainty": uncertainty_sentence(s, run.compared.get("tvu")), "IHO S-44": ""}
    settings = [
        [name.replace("_", " "), _worded(value)]
        for name, value in s.settings.items()
        if value not in (None, "", {}, [])
    ]
    return Report(
        title=run.project or Path(name_of(s.input)).stem,
        lead=lead + run.verdict,
        head=Table("The project", [], beside),
        tiles=[
            Tile("Depth", figures=depths, notes=[moved]),
            accuracy_tile(s, run.compared),
            Tile("Warnings", notes=notes[:SHOWN_NOTES] or ["None."]),
        ],
        warnings=notes,
        maps=run.maps,
        place=f"{run.crs or 'CRS not stated'}; heights: {run.heights or UNKNOWN_DATUM}.",
        layers=_layers(run),
        pictures=sorted(
            [*_pictures(run), *run.pictures], key=lambda one: order.get(one.name, len(order))
        ),
        tables=list(run.tables),
        files=files,
        provenance=[
            Table("In short", [], [[label, words] for label, words in facts.items() if words]),
            Table("Settings", ["setting", "value"], settings),
            inputs,
            Table("Software", ["name", "version"], versions),
        ],
    )


def _layers(run: RunResults) -> list[Layer]:
    """Return the choices of the map, depth first."""
    maps, known = run.maps, np.isfinite(run.maps.uncertainty_m).any()
    by = "Uncertainty (95 %)" if known else ""
    layers = [Layer("Depth", "m", maps.depth_m, DEPTH, by, has_contours=True)]
    if known:
        layers.append(Layer(by, "m", maps.uncertainty_m, UNCERTAINTY))
    if run.difference is not None:
        values = maps.sampled(*run.difference)
        layers.append(Layer("Cloud minus reference", "m", values, DIFFERENCE, is_centred=True))
    return [
        *layers,
        Layer("Rays", "", maps.rays, RAYS),
        Layer("Shift in Z", "m", maps.shift_z_m),
        Layer("Height", "m", maps.height_m),
    ]


def _worded(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return "; ".join(f"{name} {_worded(one)}" for name, one in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_worded, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _pictures(run: RunResults) -> list[Picture]:
    """Return the map of depths, the cameras, and TVU over depth where there are standard errors."""
    s, maps, depth = run.summary, run.maps, run.depth_m
    interval = depth_interval(maps.depth_m, maps.uncertainty_m)
    shade = relief(maps.height_m, maps.cell_m)
    depths = map_figure(maps.depth_m, maps.extent_m, "Depth (m)", shade, cmap=DEPTH)
    for _, place in contours(maps.depth_m, interval):
        x, y = (place + 0.5).T * maps.cell_m  # from the corner of the map
        depths.axes[0].plot(maps.west_m + x, maps.north_m - y, color=REFERENCE, linewidth=0.5)
    pictures = [
        Picture(
            "depth", "Depth",
            f"Map of the corrected depth over the shaded relief; {depth['min']:.2f} to"
            f" {depth['max']:.2f} m, mean {depth['mean']:.2f} m; contours every {interval:g} m.",
            depths,
        ),
    ]  # fmt: skip
    if s.cameras:
        alt = (
            f"Projection centres over the cloud; {s.cameras_used} of {s.cameras} see corrected"
            " points."
        )
        pictures.append(Picture("cameras", "Cameras", alt, cameras_figure(run)))
    known = run.sample[:, 1] > 0.0
    if s.uncertainty is not None and known.any():
        bins = run.compared["depth_bins"] if run.compared.get("tvu") else []
        dots = (
            " Dots: 95 % of the differences from the reference are smaller, noise of the"
            " reference included."
        )
        alt = (
            "Total vertical uncertainty at 95 % (1.96 standard errors of Z) over depth, and the"
            f" limits of the orders of IHO S-44. {formal_words(s)}.{dots if bins else ''}"
            " S-44 has requirements other than the TVU: position, features and coverage."
        )
        depth_m, sigma_z_m = run.sample[known].T
        figure = tvu_figure(depth_m, sigma_z_m, bins)
        pictures.append(Picture("uncertainty", "Vertical uncertainty", alt, figure))
    return pictures


def cameras_figure(run: RunResults) -> Figure:
    """Draw the projection centres in plan over the cloud."""
    maps, cameras = run.maps, run.cameras
    used = ~np.isin(np.array(cameras.labels), run.summary.cameras_unused)
    figure, plan = new_figure(8.0, 5.0)
    plan.imshow(maps.height_m, extent=maps.extent_m, cmap="Greys_r", alpha=0.6)
    depth = plan.imshow(maps.depth_m, extent=maps.extent_m, cmap=DEPTH)
    figure.colorbar(depth, ax=plan, label="Depth (m)", shrink=0.8)
    for chosen, mark, colour, name in (used, "o", AFTER, "used"), (~used, "x", BEFORE, "not used"):
        if chosen.any():
            x, y, _ = cameras.centres[chosen].T
            plan.plot(x, y, mark, color=colour, label=name, markersize=4)
    label_plan(plan)
    # above the axes, where it covers no camera
    plan.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
    return figure


def tvu_figure(depth_m: FloatArray, sigma_z_m: FloatArray, measured: Sequence[Plain]) -> Figure:
    """Draw TVU at 95 % over depth, and the limits of the orders of IHO S-44 up to one above it.

    `measured` are the `Comparison.depth_bins` of a reference, in plain values.
    """
    figure, axes = new_figure()
    deepest = float(max(depth_m.max(), 1e-3))
    edges = np.linspace(0.0, deepest * (1.0 + 1e-9), 31)
    slot = np.clip(np.digitize(depth_m, edges) - 1, 0, 29)
    used = np.unique(slot)
    tvu = COVERAGE_95 * sigma_z_m
    low, middle, high = np.array([np.percentile(tvu[slot == i], [5, 50, 95]) for i in used]).T
    centres = 0.5 * (edges[:-1] + edges[1:])[used]
    axes.fill_between(
        centres, low, high, color=WATER, alpha=0.6, linewidth=0.0, label="predicted, 90 %"
    )
    axes.plot(centres, middle, color=AFTER, label="predicted, median")
    within = [one["after"]["within_95_m"] for one in measured]
    if measured:
        at = [0.5 * (one["from_m"] + one["to_m"]) for one in measured]
        axes.plot(at, within, "o", color=REFERENCE, label="measured")
    depths = np.linspace(0.0, deepest, 100)
    for order, style in zip(ORDERS, ("-", "--", "-.", ":"), strict=True):
        largest = largest_tvu_m(order, depths)
        name = order.name if order.name[0].isalpha() else f"order {order.name}"
        axes.plot(depths, largest, style, color=BEFORE, label=f"IHO S-44 {name}")
        if largest[0] > max(high.max(), *within, 0.0):
            break  # laxer limits would only press the points down
    axes.set(xlim=(0.0, deepest), ylim=(0.0, None), xlabel="Depth (m)", ylabel="TVU at 95 % (m)")
    axes.legend(loc="best")
    return figure


def in_short(tiles: Sequence[Tile]) -> str:
    """Return the figures of tiles in a line, for the terminal."""
    parts = []
    for tile in tiles:
        if tile.figures:
            tag = f", {tile.tag}" if tile.tag else ""
            figures = ", ".join(f"{name} {value}" for name, value in tile.figures)
            parts.append(f"{tile.title[0].lower()}{tile.title[1:]}{tag}: {figures}")
    return "; ".join(parts)


def accuracy_tile(s: Summary, compared: Plain) -> Tile:
    """Return the accuracy of the bed: measured where there is a reference, else predicted."""
    if not compared.get("own"):
        title, unknown = "Accuracy of the bed", "not known"
        if s.uncertainty is None:
            why = "There is no reference, and the points have no standard errors."
            return Tile(title, "predicted", [("RMSE", unknown)], [why])
        sigma, tvu = s.uncertainty["sigma_z_m"]["mean"], s.uncertainty["tvu_95_m"]["mean"]
        figures = [
            ("standard error", f"{sigma:.3f} m"), ("95 % within", f"{tvu:.3f} m"),
            ("bias", unknown),
        ]  # fmt: skip
        why = (
            "No reference was given. The prediction follows from assumed errors without a common"
            " bias."
        )
        return Tile(title, "predicted", figures, [why])
    own, pair = compared["own"], raw_of(compared)
    raw, before = pair["after"], pair["before"]
    known = raw if own["rmse_m"] is None else own
    noise = noise_sentence(own, raw)
    notes = [
        f"At {raw['count']:,} points against {name_of(compared['reference'])}"
        + (f"; before the correction, RMSE {before['rmse_m']:.3f} m." if before else "."),
        noise[:1].upper() + noise[1:],
    ]
    if own["of"] == "bed" and compared["land"]:
        land = compared["land"]["after"]
        notes.append(
            f"Land: bias {signed(land['mean_m'])}, RMSE {land['rmse_m']:.3f} m, reference included."
        )
    figures = [
        ("bias", signed(own["mean_m"])), ("RMSE", f"{known['rmse_m']:.3f} m"),
        ("95 % within", f"{known['within_95_m']:.3f} m"),
    ]  # fmt: skip
    of = "bed" if own["of"] == "bed" else "cloud (bed and land are not separated)"
    return Tile(f"Accuracy of the {of}", "measured", figures, notes)


def notes_of(s: Summary, heights: str, compared: Plain) -> list[str]:
    """Return what to check, the most important first; `heights` is the vertical datum."""
    notes = []
    if not compared.get("own"):
        notes.append("No reference: the accuracy is predicted. Check points on the bed measure it.")
    elif compared.get("bed"):
        after, noise = compared["bed"]["after"], compared["own"]["sigma_reference_m"]
        if s.uncertainty is not None and after["count"] >= FEWEST:
            sigma, measured = s.uncertainty["sigma_z_m"]["mean"], after["rmse_m"]
            expected = (sigma**2 + noise**2) ** 0.5
            if not 1.0 / CONTRADICTS <= measured / expected <= CONTRADICTS:
                is_larger = measured > expected
                notes.append(
                    f"The measured errors of the bed are {'larger' if is_larger else 'smaller'}"
                    f" than the predicted ones (RMSE {measured:.3f} m, predicted {expected:.3f} m"
                    " with the noise of the reference):"
                    f" {'use the measured ones' if is_larger else 'the prediction is cautious'}."
                )
        bias = after["mean_m"]
        if abs(bias) > max(after["sd_m"], noise):
            notes.append(
                f"The bed is too {'high' if bias > 0.0 else 'low'} by {abs(bias):.3f} m on average,"
                " more than it scatters. Check water level, refractive index, vertical datum and"
                " poses."
            )
    if s.poses is not None and s.poses["absorbed"] is None and s.cameras:
        notes.append(f"Poses: {s.poses['words']}.")
    if not heights:
        notes.append(
            "The vertical datum is not known: water level, cloud and reference must have the same."
        )
    if s.water_unknown:
        notes.append(f"{s.water_unknown:,} points have no known water surface above them.")
    notes += [one["message"] for one in s.warnings]
    notes += [one["message"] for one in compared.get("notes", ())]
    return [note[:1].upper() + note[1:] for note in notes]
