"""Describe a water surface: given, fitted or detected in a cloud; ``pcfix water``."""

import warnings
from typing import Any

import numpy as np

from pcfix.errors import PcfixWarning, plain
from pcfix.flow.inputs import paths_in
from pcfix.flow.runner import check_summary, write_summary
from pcfix.flow.surfaces import find_surface, sample_of, view_of
from pcfix.io.files import check_input
from pcfix.model import WaterDimension
from pcfix.options.correct import WaterCheckOptions
from pcfix.options.declare import taken
from pcfix.report.text import Plain, RowTable, aligned, filled
from pcfix.water.auto import WaterProposal
from pcfix.water.fit import ShoreFit
from pcfix.water.surface import FoundSurface, surface_above

SAMPLE_POINTS = 200_000  # points of the cloud that are compared with the water, evenly spread
MOST_LISTED = 10  # rejected points in the summary, the largest residual first
_FIT: RowTable = (
    ("Model", "{model}, {accepted} of {points} points; scatter {sigma_point_m:.3f} m", "points"),
    ("Level", "{level_m:.3f} m at {at_xy[0]:.1f}, {at_xy[1]:.1f}; standard error"
     " {sigma_level_m:.3f} m", "at_xy"),
    ("Tilt", "{tilt_percent:.3f} %, standard error {sigma_tilt_percent:.3f} %, falls towards"
     " {downhill_deg:.0f} deg", "tilt_percent"),
    ("Length", "{length_m:.1f} m, falls {drop_m:.3f} m; standard error of the level"
     " {sigma_level_m:.3f} m", "length_m"),
)  # fmt: skip


def check_water(
    spec: Any, options: WaterCheckOptions | None = None, **keywords: Any
) -> tuple[FoundSurface, Plain]:
    """Read, fit or find a water surface, and describe it; ``pcfix water``.

    `spec` is the water of `pcfix.flow.surfaces.find_surface`. Returns the surface, and what
    describes it in the types of JSON.
    """
    given = taken(WaterCheckOptions, options, keywords, "check_water")
    check_summary(given, paths_in(given))
    view = None if given.cloud is None else view_of(check_input(given.cloud))
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always", PcfixWarning)
        found = find_surface(spec, given, view)
    for one in shown:
        if str(one.message) not in found.notes:  # those are printed with the summary
            warnings.warn(one.message, one.category, stacklevel=2)
    below, unknown = None, None
    if view is not None and not isinstance(found.surface, WaterDimension):
        sample = sample_of(view, SAMPLE_POINTS).xyz
        height = surface_above(found.surface, sample, None).height_m
        unknown = float(np.mean(~np.isfinite(height)))
        below = float(np.mean(sample[:, 2] < height))
    points = None
    if isinstance(found, ShoreFit):
        columns = found.points, found.residual_m, found.accepted
        points = [
            {"xyz": xyz, "residual_m": residual, "accepted": accepted}
            for xyz, residual, accepted in zip(*columns, strict=True)
        ]
    figures = plain({
        "water": str(spec),
        "surface": str(found.surface),
        "fit": found.as_dict(),
        "points": points,
        "cloud": None if view is None else view.name,
        "share_below": below,  # of the points of the cloud
        "share_unknown": unknown,  # of those without a surface above them
        "notes": list(map(str, found.notes)),
    })  # fmt: skip
    write_summary(given, figures)
    return found, figures


def water_text(found: FoundSurface, r: Plain) -> str:
    """Return the summary of a water surface from the results of `check_water`."""
    rows = list[tuple[str, str]]()
    if isinstance(found, ShoreFit):
        rows = filled(_FIT, found.as_dict())
        off = np.where(found.accepted, 0.0, np.nan_to_num(found.residual_m))
        listed = min(MOST_LISTED, np.count_nonzero(off))
        for i in np.argsort(-np.abs(off), kind="stable")[:listed]:
            x, y, z = found.points[i]
            rows.append(("Rejected", f"{x:.2f}, {y:.2f}, {z:.2f}: {off[i]:+.3f} m"))
    elif isinstance(found, WaterProposal):
        rows = [
            ("Level", f"{found.level_m:.3f} m, standard error {found.sigma_level_m:.3f} m,"
             f" confidence {100.0 * found.confidence:.0f} %"),
            *(("Evidence", reason) for reason in found.reasons),
        ]  # fmt: skip
    if r["share_below"] is not None:
        below, unknown = 100.0 * r["share_below"], 100.0 * r["share_unknown"]
        words = f"{below:.1f} % of the points of {r['cloud']} are below the surface"
        words += f"; {unknown:.1f} % have no surface above them" if unknown else ""
        rows.append(("Cloud", words))
    return aligned(f"Water surface ({r['water']}): {r['surface']}", rows, found.notes)
