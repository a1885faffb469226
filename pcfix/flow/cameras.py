"""Inspect a camera file: contents, fit to a cloud, absorbed refraction; ``pcfix cameras``."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcfix.adjust.diagnosis import EXPORT, Diagnosis
from pcfix.errors import InputError, SettingError, plain
from pcfix.flow.inputs import Inputs, paths_in
from pcfix.flow.plausibility import likely_mistake, plausible
from pcfix.flow.poses import adjust_words, diagnose_inputs, has_datum, quick_ties
from pcfix.flow.runner import check_summary, write_summary
from pcfix.flow.surfaces import CloudView, sample_of, view_of
from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.io.clouds import check_same_crs, read_reference
from pcfix.io.crs import shortened
from pcfix.io.files import check_input
from pcfix.io.ground_control import read_gnss
from pcfix.lens.imaging import count_visible_cameras
from pcfix.model import Cameras, FloatArray, TiePoints, WaterDimension
from pcfix.options.correct import CamerasCheckOptions
from pcfix.options.declare import File, taken
from pcfix.report.text import Plain, aligned
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above

SAMPLE_POINTS = 50_000  # points of the cloud that are tested in the frames, evenly spread
SHOWN_NAMES = 5


def check_cameras(
    path: File, options: CamerasCheckOptions | None = None, **keywords: Any
) -> "CamerasReport":
    """Inspect a camera file: contents, fit to a cloud, absorbed refraction; ``pcfix cameras``.

    With a cloud and water it is tested whether the poses have absorbed refraction, see
    `pcfix.adjust.diagnosis`.
    """
    given = taken(CamerasCheckOptions, options, keywords, "check_cameras")
    cloud = given.cloud
    check_summary(given, [path, *paths_in(given)])
    surveys = [name for name in ("gcps", "lens", "reference") if getattr(given, name) is not None]
    if surveys and (cloud is None or given.water is None):
        sentence = f"{surveys[0]} needs cloud and water, to test for absorbed refraction."
        raise SettingError("option.needs", sentence, options=[surveys[0], "cloud", "water"])
    inputs = replace(given.part(Inputs), cameras=path)
    read = inputs.read()
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
        named = {name: getattr(given, name) for name in ("gnss", "gcps", "lens", "index")}
        remedy = adjust_words(inputs, view.name, has_datum=has_datum(cameras, str(path)), **named)
    level = above = tilt = fit = None
    if surface is not None and not (isinstance(surface, WaterDimension) and heights is None):
        at = cameras.centres if heights is None else xyz
        known_m = surface_above(surface, at, heights).height_m
        level = float(np.nanmean(known_m)) if np.isfinite(known_m).any() else None
    if level is not None and not problem:  # geocentric cameras have no heights
        above = cameras.centres[:, 2] - level
    if cameras.rotations is not None and not problem:
        tilt = np.degrees(np.arccos(np.clip(-cameras.rotations[:, 2, 2], -1.0, 1.0)))
    if view is not None:
        fit = _fit(cameras, view, xyz, quick_ties(inputs, view.crs), path, level)
    figures = plain({
        "path": path,
        "crs_read": read.crs,
        "sensors": sensors_of(cameras, above),
        "height_above_water_m": None if above is None else (above.min(), above.mean(), above.max()),
        "tilt_deg": None if tilt is None else (np.median(tilt), tilt.max()),  # axes from nadir
        "gnss": _gnss(cameras, str(path)),
        "problem": problem,  # why the cameras are not in a map and have no heights
        "source": cameras.source,
        "images_posed": len(cameras),
        "images_unposed": cameras.unposed,
        "crs": cameras.crs,
        "fit": fit,
        "refraction": diagnosis and diagnosis.as_dict(),
        "notes": list(map(str, cameras.notes)),
    })  # fmt: skip
    write_summary(given, figures)
    return CamerasReport(figures, cameras, diagnosis, remedy)


@dataclass(frozen=True, eq=False)
class CamerasReport:
    """The report of ``pcfix cameras``."""

    figures: Plain  # as JSON holds them
    cameras: Cameras  # in the cloud's CRS, if there is a cloud
    diagnosis: Diagnosis | None  # whether the poses have absorbed the refraction
    remedy: str  # the command that corrects the poses


def sensors_of(cameras: Cameras, above_m: FloatArray | None) -> list[Plain]:
    """Return the sensors of a block.

    A sensor is a lens, or if nearly each image has its own, the lenses of one name, frame and
    projection. ``lenses`` counts those that differ.
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
            "distorted": any((*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism)),
            "gsd_m": height_m / lens.focal if height_m > 0.0 and lens.unit == "px" else None,
            "lenses": len(lenses),
        })  # fmt: skip
    return sensors


def _gnss(cameras: Cameras, name: str) -> Plain | None:
    """Return adjusted projection centres minus their GNSS positions: metres east, north, up."""
    if cameras.gnss is None:
        return None
    enu_m, reason = adjusted_minus_gnss(cameras, name)
    rows = np.flatnonzero(np.isfinite(enu_m[:, 0]))
    enu = enu_m[rows] if len(rows) else np.full((1, 3), np.nan)
    return {
        "images": len(rows), "mean_m": enu.mean(axis=0), "sd_m": enu.std(axis=0), "reason": reason
    }  # fmt: skip


def _fit(
    cameras: Cameras, view: CloudView, xyz: FloatArray, ties: TiePoints | None, file: File,
    water_m: float | None,
) -> Plain:  # fmt: skip
    """Test cameras against a sample of the cloud.

    ``seen_by`` are the shares of the points in the frames of 0, 1, 2, 3 or more images. The verdict
    is what is likely wrong, empty if cameras and cloud match.
    """
    visible = np.minimum(count_visible_cameras(xyz, cameras), 3)
    shares = np.bincount(visible, minlength=4) / len(xyz)
    found = plausible(cameras, xyz, ties, file=file, water_m=water_m)
    verdict = likely_mistake(cameras.centres, xyz.min(axis=0), xyz.max(axis=0))
    verdict = verdict or " ".join(map(str, found.problems))
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
    rows = [("Images", images), *(("Sensor", _sensor_words(one)) for one in sensors)]
    if not sensors:
        rows.append(("Sensor", "none: the image sizes are not known"))
    if cameras.rotations is None:
        rows.append(("Angles", "none: every camera counts as visible from every point"))
    rows.append(("CRS", shortened(r["crs_read"] or "not stated")))
    if r["crs"] != r["crs_read"]:
        rows.append(("CRS of cloud", shortened(r["crs"] or "not stated")))
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
            ", ".join("-" if one is None else f"{one:z.3f}" for one in gnss[name])
            for name in ("mean_m", "sd_m")
        )
        rows.append(("GNSS", f"{gnss['images']:,} images. Poses minus GNSS (east, north, up):"
                     f" mean {mean} m, standard deviation {sd} m"))  # fmt: skip
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
        verdicts = {True: "absorbed: ", False: "not absorbed: ", None: "no evidence: "}
        verdict = f"not known; give control points (--gcps), or {EXPORT}"
        if found.decided_by is not None:
            have = "have" if found.absorbed else "have not"
            verdict = f"the poses {have} absorbed the refraction, as {found.decided_by.name} show"
        if found.likely_error_m is not None:
            verdict += f"; the likely error of heights is {found.likely_error_m:.2g} m"
        rows.append(("Refraction", verdict))
        rows += [
            (s.name[:1].upper() + s.name[1:], verdicts[s.absorbed] + s.words) for s in found.signs
        ]
        if found.absorbed:
            rows += [("Next step", "adjust the poses:"), ("", report.remedy)]
    return aligned(f"{r['path']}: {cameras.source or 'cameras'}", rows)


def _sensor_words(s: Plain) -> str:
    """Return frame, focal length and pixel size of a sensor."""
    low, high = f"{s['focal']:.6g}", f"{s['focal_most']:.6g}"
    words = f"{s['name'] or 'unnamed'}: {s['images']:,} images"
    words += f" with {s['lenses']:,} different lenses" if s["lenses"] > 1 else ""
    words += f", {s['width']:g} x {s['height']:g} {s['unit']}, focal length"
    words += f" {low if low == high else f'{low} to {high}'} {s['unit']}, {s['projection']}"
    words += ", distorted" if s["distorted"] else ""
    gsd = f", GSD {100.0 * s['gsd_m']:.2f} cm at the water" if s["gsd_m"] is not None else ""
    return words + gsd
