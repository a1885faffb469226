"""The report page of a run: words, pictures and tables on the correction and the adjustment."""

import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.grid.lattice import Lattice
from pcfix.grid.maps import DEPTH, DIFFERENCE, UNCERTAINTY, contours, depth_interval
from pcfix.model import Cameras, FloatArray
from pcfix.refract.tally import ORDERS, largest_tvu_m
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
    map_figure,
    name_of,
    new_figure,
    relief,
)
from pcfix.report.text import Plain, Summary, formal_words, summary_rows
from pcfix.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class RunMaps(NamedTuple):
    """The rasters of a run in common cells, shape (rows, columns), metres; NaN if unknown."""

    lattice: Lattice
    height_m: FloatArray  # of land and bed
    depth_m: FloatArray
    uncertainty_m: FloatArray  # of the bed, at 95 %
    difference_m: FloatArray | None  # cloud minus reference
    crs: str  # of the cloud, and its vertical datum; empty if not known
    heights: str


def run_report(
    s: Summary,
    cameras: Cameras,
    maps: RunMaps,
    *,
    project: str = "",
    date: str = "",
    verdict: str = "",
    compared: Plain | None = None,
    pictures: Sequence[Picture] = (),
    tables: Sequence[Table] = (),
    inputs: Sequence[Table] = (),
    files: Sequence[tuple[str, str]] = (),
) -> Report:
    """Return the page of a run.

    `compared` is `Comparison.as_dict`, and `verdict` a sentence on the steps before the correction.
    `pictures` and `tables` are of other steps, the most important first; `inputs` list the files
    read, `files` those next to the page. `date` is that of the images.
    """
    compared, depth, mean = compared or {}, s.depth_m, s.shift_z_m["mean"]
    lead = (
        f"Correction for refraction of {name_of(s.input)}: {s.corrected:,} of {s.points:,} points"
        f" are under water and were moved, {abs(mean):.2f} m"
        f" {'higher' if mean > 0.0 else 'deeper'} on average."
    )
    rows = summary_rows(s, compared.get("tvu"))
    notes = notes_of(s, maps.heights, compared)
    head = [
        ("Images", date or "date not stated"),
        ("CRS", maps.crs or "not stated by the cloud"),
        ("Heights", maps.heights or "vertical datum not stated by the cloud"),
        ("Points", f"{s.points:,}"),
        *(row for row in rows if row[0] in ("Submerged", "Cameras", "Water", "")),
    ]
    depths = [("range", f"{depth['min']:.2f} to {depth['max']:.2f} m")]
    depths += [("mean", f"{depth['mean']:.2f} m")]
    # the rows of the terminal, and why the method was chosen
    facts = [("Input cloud", name_of(s.input)), ("Points", f"{s.points:,}"), *rows]
    facts += [("Reconstruction", s.reconstruction["because"])] if s.reconstruction else []
    settings = [
        [name.replace("_", " "), _worded(value)]
        for name, value in s.settings.items()
        if value not in (None, "", {}, [])
    ]
    libraries = [[name, version(name)] for name in ("numpy", "scipy", "numba", "laspy", "lazrs")]
    versions = [["pcfix", __version__], ["Python", platform.python_version()], *libraries]
    # these come before the others, as the page shows four and folds the rest
    first = "section_1", "depth_bins", "uncertainty", "cameras"
    order = {name: place for place, name in enumerate(first)}
    pictures = [*_pictures(s, cameras, maps, compared), *pictures]
    return Report(
        title=project or Path(name_of(s.input)).stem,
        lead=lead + verdict,
        head=Table("The project", [], head),
        tiles=[
            Tile("Depth", figures=depths),
            accuracy_tile(s, compared),
            Tile("Warnings", notes=notes[:3] or ["None."]),
        ],
        warnings=notes,
        lattice=maps.lattice,
        height_m=maps.height_m,
        layers=_layers(maps),
        pictures=sorted(pictures, key=lambda one: order.get(one.name, len(order))),
        tables=list(tables),
        files=files,
        provenance=[
            Table("In short", [], facts),
            Table("Settings", ["setting", "value"], settings),
            *inputs,
            Table("Software", ["name", "version"], versions),
        ],
    )


def _layers(maps: RunMaps) -> list[Layer]:
    """Return the choices of the map, depth first."""
    known = np.isfinite(maps.uncertainty_m).any()
    by = "Uncertainty (95 %)" if known else ""
    layers = [Layer("Depth", "m", maps.depth_m, DEPTH, by, has_contours=True)]
    if known:
        layers.append(Layer(by, "m", maps.uncertainty_m, UNCERTAINTY))
    if maps.difference_m is not None:
        name = "Cloud minus reference"
        layers.append(Layer(name, "m", maps.difference_m, DIFFERENCE, is_centred=True))
    return [*layers, Layer("Height", "m", maps.height_m)]


def _worded(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return "; ".join(f"{name} {_worded(one)}" for name, one in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_worded, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _pictures(s: Summary, cameras: Cameras, maps: RunMaps, compared: Plain) -> list[Picture]:
    """Return the map of depths, the cameras, and TVU over depth where there are standard errors."""
    lattice, depth = maps.lattice, s.depth_m
    interval = depth_interval(maps.depth_m, maps.uncertainty_m)
    shade = relief(maps.height_m, lattice.resolution_m)
    figure = map_figure(maps.depth_m, lattice, "Depth (m)", shade, cmap=DEPTH)
    for _, place in contours(maps.depth_m, interval):
        x, y = (place + 0.5).T * lattice.resolution_m  # from the corner of the map
        figure.axes[0].plot(lattice.left_m + x, lattice.top_m - y, color=REFERENCE, linewidth=0.5)
    alt = (
        f"Map of the corrected depth over the shaded relief; {depth['min']:.2f} to"
        f" {depth['max']:.2f} m, mean {depth['mean']:.2f} m; contours every {interval:g} m."
    )
    pictures = [Picture("depth", "Depth", alt, figure)]
    if s.cameras:
        alt = f"Projection centres over the cloud; {s.cameras_used} of {s.cameras} were used."
        figure = map_figure(maps.depth_m, lattice, "Depth (m)", shade, cmap=DEPTH)
        used, plan = ~np.isin(np.array(cameras.labels), s.cameras_unused), figure.axes[0]
        looks = (used, "o", AFTER, "used"), (~used, "x", BEFORE, "not used")
        for chosen, mark, colour, name in looks:
            if chosen.any():
                x, y, _ = cameras.centres[chosen].T
                plan.plot(x, y, mark, color=colour, label=name, markersize=4)
        # above the axes, where it covers no camera
        plan.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
        pictures.append(Picture("cameras", "Cameras", alt, figure))
    known = np.isfinite(maps.depth_m) & np.isfinite(maps.uncertainty_m)
    if s.uncertainty is not None and known.any():
        bins = compared["depth_bins"] if compared.get("tvu") else []
        dots = " Dots: 95 % of the differences from the reference are smaller." if bins else ""
        alt = (
            "Total vertical uncertainty at 95 % (1.96 standard errors of Z) over depth, and the"
            f" limits of the orders of IHO S-44. {formal_words(s)}.{dots}"
            " S-44 has requirements other than the TVU: position, features and coverage."
        )
        figure = tvu_figure(maps.depth_m[known], maps.uncertainty_m[known], bins)
        pictures.append(Picture("uncertainty", "Vertical uncertainty", alt, figure))
    return pictures


def tvu_figure(depth_m: FloatArray, tvu_m: FloatArray, measured: Sequence[Plain]) -> "Figure":
    """Draw TVU at 95 % of cells over depth, (n,), metres, and the limits of the orders of S-44.

    `measured` are the `Comparison.depth_bins` of a reference, in plain values.
    """
    figure, axes = new_figure()
    axes.plot(depth_m, tvu_m, ".", markersize=1, color=WATER, label="predicted, each cell")
    within = [one["after"]["within_95_m"] for one in measured]
    if measured:
        at = [0.5 * (one["from_m"] + one["to_m"]) for one in measured]
        axes.plot(at, within, "o", color=REFERENCE, label="measured")
    deepest = max(float(depth_m.max()), 1e-3)
    depths, most = np.linspace(0.0, deepest, 100), 1.3 * max(np.percentile(tvu_m, 99), *within, 0.2)
    for order, style in zip(ORDERS, ("-", "--", "-.", ":"), strict=True):
        largest = largest_tvu_m(order, depths)
        if largest[0] < most:
            axes.plot(depths, largest, style, color=BEFORE, label=f"IHO S-44 {order.name}")
    axes.set(xlim=(0.0, deepest), ylim=(0.0, most), xlabel="Depth (m)", ylabel="TVU at 95 % (m)")
    axes.legend(loc="best")
    return figure


def accuracy_tile(s: Summary, compared: Plain) -> Tile:
    """Return the accuracy of the bed: measured where there is a reference, else predicted."""
    if not compared:
        title, unknown = "Accuracy of the bed", "not known"
        if s.uncertainty is None:
            why = "There is no reference, and the points have no standard errors."
            return Tile(title, "predicted", [("RMSE", unknown)], [why])
        sigma, tvu = s.uncertainty["sigma_z_m"]["mean"], s.uncertainty["tvu_95_m"]["mean"]
        figures = [
            ("standard error", f"{sigma:.3f} m"), ("95 % within", f"{tvu:.3f} m"),
            ("bias", unknown),
        ]  # fmt: skip
        why = "No reference was given. The prediction follows from assumed errors without a bias."
        return Tile(title, "predicted", figures, [why])
    pair = compared["bed"] or {
        when: of and of["statistics"] for when, of in compared["vertical"].items()
    }
    after, before = pair["after"], pair["before"]
    notes = [
        f"At {after['count']:,} points against {name_of(compared['reference'])}, whose noise is"
        " included"
        + (f"; before the correction, RMSE {before['rmse_m']:.3f} m." if before else ".")
    ]
    if compared["land"]:
        land = compared["land"]["after"]
        notes.append(f"Land: bias {land['mean_m']:+z.3f} m, RMSE {land['rmse_m']:.3f} m.")
    figures = [
        ("bias", f"{after['mean_m']:+z.3f} m"), ("RMSE", f"{after['rmse_m']:.3f} m"),
        ("95 % within", f"{after['within_95_m']:.3f} m"),
    ]  # fmt: skip
    of = "bed" if compared["bed"] else "cloud (bed and land are not separated)"
    return Tile(f"Accuracy of the {of}", "measured", figures, notes)


def notes_of(s: Summary, heights: str, compared: Plain) -> list[str]:
    """Return what to check, the most important first; `heights` is the vertical datum."""
    notes = []
    if not compared:
        notes.append("No reference: the accuracy is predicted. Check points on the bed measure it.")
    elif compared["bed"]:
        bias, sd = (compared["bed"]["after"][key] for key in ("mean_m", "sd_m"))
        # LiDAR itself has about 3 cm of noise
        if abs(bias) > max(sd, 0.03):
            notes.append(
                f"The bed is too {'high' if bias > 0.0 else 'low'} by {abs(bias):.3f} m on average,"
                " more than it scatters. Check water level, refractive index, vertical datum and"
                " poses."
            )
    if s.poses is not None and s.poses["absorbed"] is None and s.cameras:
        notes.append(f"Poses: {s.poses['words']}.")
    if not heights:
        notes.append(
            "The vertical datum is not known: water level, cloud and reference must share it."
        )
    notes += [one["message"] for one in s.warnings]
    notes += [one["message"] for one in compared.get("notes", ())]
    return [note[:1].upper() + note[1:] for note in notes]
