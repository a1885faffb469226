"""Inspect a camera file: contents, fit to a cloud, absorbed refraction; ``pcfix cameras``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.diagnosis import EXPORT, Diagnosis
from pcfix.errors import InputError, SettingError, plain, shown_once
from pcfix.flow.diagnosis import adjust_words, diagnose_inputs, has_datum, quick_ties
from pcfix.flow.inputs import Inputs, paths_in
from pcfix.flow.plausibility import plausible
from pcfix.flow.runner import check_summary, write_summary
from pcfix.flow.surfaces import CloudView, sample_of, view_of
from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.io.cameras.mistakes import UNDULATION_M, likely_mistake
from pcfix.io.clouds import check_same_crs, read_reference
from pcfix.io.files import check_input
from pcfix.io.gnss_positions import read_gnss
from pcfix.lens.frames import cameras_in_sight, footprint
from pcfix.lens.imaging import unproject
from pcfix.model import Cameras, FloatArray, Lens, TiePoints, WaterDimension
from pcfix.options.correct import CamerasCheckOptions
from pcfix.options.declare import File, taken
from pcfix.report.page import (
    AFTER,
    WATER,
    draw_cloud,
    label_plan,
    label_side,
    legend_below,
    new_figure,
)
from pcfix.report.text import Plain, Rows, aligned
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_SENSORS = 8
"""Sensors in the text; the others are counted."""
SAMPLE_POINTS = 50_000
"""Points of the cloud that are tested in the frames, evenly spread."""
MOST_FOOTPRINTS = 400
SHORT_CRS, SHOWN_NAMES = 60, 5


def check_cameras(
    path: File, options: CamerasCheckOptions | None = None, **keywords: Any
) -> CamerasReport:
    """Inspect a camera file: contents, fit to a cloud, absorbed refraction; ``pcfix cameras``.

    Parameters
    ----------
    path : path
        See `pcfix.read_cameras`.
    options
        See `pcfix.correct_file`. With a cloud and water it is tested whether the poses have
        absorbed refraction, see `pcfix.adjust.diagnosis`.
    """
    given = taken(CamerasCheckOptions, options, keywords, "check_cameras")
    cloud = given.cloud
    check_summary(given, [path, *paths_in(given)])
    if cloud is None or given.water is None:
        for name in ("gcps", "lens", "reference"):
            if getattr(given, name) is not None:
                sentence = f"{name} needs cloud and water, to test for absorbed refraction."
                raise SettingError("option.needs", sentence, options=[name, "cloud", "water"])
    inputs = replace(given.part(Inputs), cameras=path)
    read = shown_once(inputs.read, lambda cameras: cameras.notes)
    view = None if cloud is None else view_of(check_input(cloud))
    surface = None if given.water is None else inputs.surface(view).surface
    xyz, heights, problem = np.zeros((0, 3)), None, ""
    if view is not None:
        sample = sample_of(view, SAMPLE_POINTS, surface)
        xyz, heights = sample.xyz, sample.heights
    try:
        cameras = inputs.block(None if view is None else view.crs, read)[0]
    except InputError as error:
        if view is not None:
            raise
        cameras, problem = read, str(error)
    if given.gnss is not None:
        cameras = read_gnss(given.gnss, cameras)
    diagnosis, remedy = None, ""
    if view is not None and surface is not None:
        reference = None if given.reference is None else read_reference(given.reference)
        if reference is not None:
            crs = None if isinstance(view.crs, str) else view.crs
            check_same_crs(view.name, crs, reference.name, reference.crs)
        index = index_of(given.index, given.index_formula)[0]
        diagnosis = diagnose_inputs(
            inputs, cameras, view, surface, index, gcps=given.gcps, reference=reference
        )
        surveys = {name: getattr(given, name) for name in ("gnss", "gcps", "lens", "index")}
        remedy = adjust_words(inputs, view.name, has_datum=has_datum(cameras, str(path)), **surveys)
    level = above = tilt = fit = None
    if surface is not None and not (isinstance(surface, WaterDimension) and heights is None):
        at = cameras.centres if heights is None else xyz
        known_m = surface_above(surface, at, heights).height_m
        level = float(np.nanmean(known_m)) if np.isfinite(known_m).any() else None
    if level is not None and not problem:  # geocentric cameras have no heights
        above = cameras.centres[:, 2] - level
    if cameras.rotations is not None and not problem:
        tilt = np.degrees(np.arccos(np.clip(-cameras.rotations[:, 2, 2], -1.0, 1.0)))
    gnss = _gnss(cameras, str(path))
    if view is not None:
        up = 0.0 if gnss is None or inputs.cameras_crs is None else np.nan_to_num(gnss["mean_m"][2])
        flight = {"file": path, "water_m": level, "every": view.points / max(len(xyz), 1)}
        fit = _fit(cameras, view, xyz, quick_ties(inputs, view.crs), up, flight)
    figures = plain({
        "path": path,
        "crs_read": read.crs,
        "sensors": sensors_of(cameras, above),
        "height_above_water_m": None if above is None else (above.min(), above.mean(), above.max()),
        "tilt_deg": None if tilt is None else (np.median(tilt), tilt.max()),  # axes from nadir
        "gnss": gnss,
        "problem": problem,  # why the cameras are not in a map and have no heights
        "source": cameras.source,
        "images_posed": len(cameras),
        "images_unposed": cameras.unposed,
        "crs": cameras.crs,
        "fit": fit,
        "refraction": diagnosis and diagnosis.as_dict(),
        "notes": list(map(str, cameras.notes)),
    })  # fmt: skip
    report = CamerasReport(figures, cameras, xyz, level, diagnosis, remedy)
    write_summary(given, figures, lambda: block_figure(report))
    return report


@dataclass(frozen=True, eq=False)
class CamerasReport:
    """The report of ``pcfix cameras``."""

    figures: Plain  # as JSON holds them
    cameras: Cameras  # in the cloud's CRS, where there is a cloud
    sample_xyz: FloatArray  # points of the cloud, shape (m, 3), for a picture
    level_m: float | None  # mean height of the water
    diagnosis: Diagnosis | None  # whether the poses have absorbed the refraction
    remedy: str  # the command that corrects the poses


def sensors_of(cameras: Cameras, above_m: FloatArray | None) -> list[Plain]:
    """Return the sensors of a block; values are None where not stated.

    A sensor is a lens, or if nearly each image has its own, a name with a frame and a projection.
    ``lenses`` counts the lenses that differ, and ``folded`` is the share of the frame beyond the
    fold of the distortion.
    """
    all_lenses, groups = cameras.lenses or (), dict[Any, list[int]]()
    is_shared = 2 * len(set(all_lenses)) <= len(cameras)
    for row, lens in enumerate(all_lenses):
        kind = lens.sensor, lens.width, lens.height, lens.unit, lens.projection
        groups.setdefault(lens if is_shared else kind, []).append(row)
    sensors = []
    for rows in groups.values():
        lenses = list(dict.fromkeys(all_lenses[row] for row in rows))
        lens, focal = lenses[0], [one.focal for one in lenses]
        height_m = 0.0 if above_m is None else float(np.mean(above_m[rows]))
        sensors.append({
            "name": lens.sensor,
            "images": len(rows),
            "width": lens.width,
            "height": lens.height,
            "focal": min(focal),
            "focal_most": max(focal),
            "unit": lens.unit,
            "projection": lens.projection,
            "distorted": _is_distorted(lens),
            "gsd_m": height_m / lens.focal if height_m > 0.0 and lens.unit == "px" else None,
            "lenses": len(lenses),
            "folded": max(_folded(one) for one in lenses[:: 1 + len(lenses) // 20]),
        })  # fmt: skip
    return sensors


def _is_distorted(lens: Lens) -> bool:
    return any((*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism))


def _folded(lens: Lens) -> float:
    """Return the share of the frame that no direction is imaged to, beyond the fold of the lens."""
    if not _is_distorted(lens):  # the border of a fisheye's image is none
        return 0.0
    across = np.linspace(0.0, 1.0, 41)
    places = np.stack(np.meshgrid(across * lens.width, across * lens.height), axis=-1)
    return float(np.mean(np.isnan(unproject(lens, places.reshape(-1, 2))).any(axis=1)))


def _gnss(cameras: Cameras, name: str) -> Plain | None:
    """Return adjusted projection centres minus their GNSS positions: metres east, north, up."""
    if cameras.gnss is None:
        return None
    enu_m, reason = adjusted_minus_gnss(cameras, name)
    rows = np.flatnonzero(np.isfinite(enu_m[:, 0]))
    enu = enu_m[rows] if len(rows) else np.full((1, 3), np.nan)
    length = np.sqrt(np.nansum(enu * enu, axis=1))
    return {
        "images": len(rows),
        "mean_m": enu.mean(axis=0),
        "sd_m": enu.std(axis=0),
        "largest_m": length.max(),
        "largest_image": cameras.labels[rows[int(np.argmax(length))]] if len(rows) else "",
        "reason": reason,
    }


def _fit(
    cameras: Cameras, view: CloudView, xyz: FloatArray, ties: TiePoints | None, up_m: float,
    flight: dict[str, Any],
) -> Plain:  # fmt: skip
    """Test cameras against a sample of the cloud; `up_m` are they above their GNSS positions.

    ``seen_by`` are the shares of the points that 0, 1, 2, 3 or more frames hold. The verdict is
    what is likely wrong, empty where cameras and cloud match.
    """
    visible = np.minimum(cameras_in_sight(xyz, cameras), 3)
    shares = np.bincount(visible, minlength=4) / len(xyz)
    found = plausible(cameras, xyz, ties, **flight)
    verdict = likely_mistake(cameras.centres, xyz.min(axis=0), xyz.max(axis=0), view.crs)
    verdict = verdict or " ".join(map(str, found.doubts))
    if not verdict and abs(up_m) >= UNDULATION_M[0]:
        side = "above" if up_m > 0.0 else "below"
        verdict = (
            f"With --cameras-crs the cameras are {abs(up_m):.1f} m {side} their GNSS heights. One"
            " of them is likely above the ellipsoid and the other above the geoid; check the"
            " vertical CRS."
        )
    return {
        "cloud": view.name,
        "points_sampled": len(xyz),
        "seen_by": dict(zip(("0", "1", "2", "3 or more"), shares, strict=True)),
        "verdict": verdict,
        "tested": found.fits,
        "not_tested": found.unchecked,
        "fits": not verdict,
    }


def cameras_text(report: CamerasReport) -> str:
    """Return the summary of a camera file."""
    r, cameras, z = report.figures, report.cameras, report.cameras.centres[:, 2]
    missing, sensors, fit, gnss = cameras.unposed, r["sensors"], r["fit"], r["gnss"]
    images = f"{len(cameras):,} with a pose"
    if missing:
        more = ", ..." if len(missing) > SHOWN_NAMES else ""
        images += f", {len(missing):,} without: {', '.join(missing[:SHOWN_NAMES])}{more}"
    rows = [("Images", images), *(row for s in sensors[:MOST_SENSORS] for row in _sensor_rows(s))]
    if len(sensors) > MOST_SENSORS:
        rows.append(("", f"and {len(sensors) - MOST_SENSORS} more"))
    if not sensors:
        rows.append(("Sensor", "none: the image sizes are not known"))
    if cameras.rotations is None:
        rows.append(("Angles", "none: every camera counts as visible from every point"))
    rows.append(("CRS", _short(r["crs_read"])))
    if r["crs"] != r["crs_read"]:
        rows.append(("CRS of cloud", _short(r["crs"])))
    heights = f"{z.min():.2f} to {z.max():.2f} m, mean {z.mean():.2f} m"
    rows.append(("Problem", r["problem"]) if r["problem"] else ("Heights", heights))
    if r["height_above_water_m"] is not None:
        low, mean, high = r["height_above_water_m"]
        rows.append(("Above water", f"{low:.1f} to {high:.1f} m, mean {mean:.1f} m"))
    if r["tilt_deg"] is not None:
        median, largest = r["tilt_deg"]
        rows.append(("Tilt", f"median {median:.1f} deg, largest {largest:.1f} deg"))
    if gnss is not None and gnss["images"]:
        mean, sd = (
            ", ".join("-" if one is None else f"{one:{form}}" for one in gnss[name])
            for name, form in (("mean_m", "+z.3f"), ("sd_m", "z.3f"))
        )
        rows.append(("GNSS", f"{gnss['images']:,} images. Poses minus GNSS (east, north, up):"
                     f" mean {mean} m, standard deviation {sd} m; largest distance"
                     f" {gnss['largest_m']:.3f} m ({gnss['largest_image']})"))  # fmt: skip
    if gnss is not None and gnss["reason"]:
        rows.append(("GNSS", gnss["reason"]))
    if fit is not None:
        shares = ", ".join(f"{100.0 * part:.1f}" for part in fit["seen_by"].values())
        match = "cameras and cloud match" if fit["tested"] else "nothing could be tested"
        rows += [
            ("Cloud", f"{fit['cloud']} ({fit['points_sampled']:,} points sampled)"),
            ("Visible", f"{shares} % of the points in {', '.join(fit['seen_by'])} images"),
            ("Check", fit["verdict"] or match),
        ]
        for label, tests in (("Tested", fit["tested"]), ("Not tested", fit["not_tested"])):
            rows += [("" if i else label, one) for i, one in enumerate(tests)]
    if (found := report.diagnosis) is not None:
        says = {True: "absorbed: ", False: "not absorbed: ", None: "no evidence: "}
        verdict = f"not known; give control points (--gcps), or {EXPORT}"
        if found.absorbed is not None and found.decided_by is not None:
            have = "have" if found.absorbed else "have not"
            verdict = f"the poses {have} absorbed the refraction, as {found.decided_by.name} show"
        if found.likely_error_m is not None:
            verdict += f"; the likely error of heights is {found.likely_error_m:.2g} m"
        rows.append(("Refraction", verdict))
        rows += [(s.name[:1].upper() + s.name[1:], says[s.speaks] + s.words) for s in found.signs]
        if found.absorbed:
            rows += [("Next step", "adjust the poses:"), ("", report.remedy)]
    return aligned(f"{r['path']}: {cameras.source or 'cameras'}", rows, cameras.notes)


def _sensor_rows(s: Plain) -> Rows:
    """Return frame, focal length and pixel size of a sensor, and what is wrong with its lens."""
    low, high = f"{s['focal']:.6g}", f"{s['focal_most']:.6g}"
    words = f"{s['name'] or 'unnamed'}: {s['images']:,} images"
    words += f" with {s['lenses']:,} different lenses" if s["lenses"] > 1 else ""
    words += f", {s['width']:g} x {s['height']:g} {s['unit']}, focal length"
    words += f" {low if low == high else f'{low} to {high}'} {s['unit']}, {s['projection']}"
    words += ", distorted" if s["distorted"] else ""
    words += f", GSD {100.0 * s['gsd_m']:.2f} cm at the water" if s["gsd_m"] is not None else ""
    folded = f"the distortion folds within the frame: {100.0 * s['folded']:.2g} % of it is not used"
    fold: Rows = [("", f"{folded}; check the radial coefficients")] if s["folded"] else []
    return [("Sensor", words), *fold]


def _short(crs: str | None) -> str:
    """Return the name of a CRS, whose text may be pages long."""
    if not crs or len(crs) < SHORT_CRS:
        return crs or "not stated"
    return crs.split('"')[1] if '"' in crs else crs[:SHORT_CRS] + " ..."


def draw_footprints(plan: Axes, cameras: Cameras, level_m: float, **look: Any) -> bool:
    """Draw footprints on a level, of at most `MOST_FOOTPRINTS` images; return whether any exist."""
    is_drawn = False
    for row in range(0, len(cameras), max(1, len(cameras) // MOST_FOOTPRINTS)):
        border = footprint(cameras, row, level_m)
        if len(border) and np.isfinite(border).all():
            plan.plot(*np.vstack([border, border[:1]]).T, color=WATER, **look)
            is_drawn = True
    return is_drawn


def block_figure(report: CamerasReport) -> Figure:
    """Draw the block in plan, with the footprints of its frames, and from the south."""
    cameras, xyz, level = report.cameras, report.sample_xyz, report.level_m
    figure, (plan, side) = new_figure(8.0, 8.5, nrows=2, height_ratios=[5, 2])
    shown = draw_cloud(figure, plan, xyz, level, label="cloud")
    side.plot(shown[:, 0], shown[:, 2], ".", color="0.6", markersize=1)
    if level is not None:
        side.axhline(level, color=WATER)
    elif len(xyz):
        level = float(np.median(xyz[:, 2]))  # of the footprints: the middle of the cloud
    if level is not None and draw_footprints(plan, cameras, level, linewidth=0.6, alpha=0.6):
        plan.plot([], [], color=WATER, label=f"footprints at {level:.1f} m")
    for axes, heights in ((plan, cameras.centres[:, 1]), (side, cameras.centres[:, 2])):
        axes.plot(cameras.centres[:, 0], heights, "^", color=AFTER, markersize=4, label="cameras")
    label_plan(plan, 20.0)
    label_side(side)
    side.tick_params(axis="x", labelrotation=20)
    legend_below(plan)
    return figure
