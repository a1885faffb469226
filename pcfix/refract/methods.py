"""Correct points by the method of a name.

``snell`` and tracks with all cameras in frame choose cameras in their kernels; the others get
batches of points with chosen cameras. A method is loaded when it is first used.
"""

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.model import FloatArray, IntArray, Outcome, WaterMesh, WaterPlane, WaterRaster
from pcfix.refract.batch import Batch, Intersection, Survey
from pcfix.refract.choice import chosen_views, near_borders
from pcfix.refract.patches import gsd_m
from pcfix.refract.tiling import spatial_order
from pcfix.refract.uncertainty import with_uncertainty
from pcfix.water.surface import SurfaceAbove

if TYPE_CHECKING:
    from pcfix.refract.fusion import Bed

POINTS_AT_ONCE = 100_000  # bounds the memory of lists of cameras: some 50 MB at 40 rays a point
BED_POINTS = 100_000  # points of a sample that are enough for the bed, which takes longest

# Module and function by the names of `pcfix.options.Method`: a new method is a function and an
# entry.
METHODS = {
    "snell": "intersect.intersect",
    "consistent": "intersect.consistent",
    "shan": "literature.shan",
    "butler": "literature.butler",
    "murase": "literature.murase",
    "dietrich": "literature.butler",
    "factor": "literature.factor",
    "regression": "literature.regression",
}
# What `consistent` is for dense clouds.
_MAPS, _PAIRS = "depth_maps.invert_depth_maps", "stereo_pairs.invert_pairs"


def correct(batch: Batch) -> Intersection:
    """Correct submerged points by the method that the settings name; one row per point."""
    parts = batch.parts()
    found = [_without_limit(_corrected(part), part) for _, part in parts]
    if len(found) == 1:
        return found[0]
    return joined(found, np.concatenate([rows for rows, _ in parts]))


def _without_limit(found: Intersection, batch: Batch) -> Intersection:
    """Treat points that lack rays only because of the largest angle.

    If that was set, they have an outcome of their own; if it was learned from the cloud, they are
    corrected with all rays.
    """
    survey = batch.survey
    few = np.flatnonzero(np.isin(found.outcome, (Outcome.NO_CAMERA, Outcome.ONE_CAMERA)))
    if survey.limit_deg is None or not len(few):
        return found
    settings = replace(survey.settings, max_angle=None)
    free = replace(survey, settings=settings, learned=survey.learned._replace(limit_deg=None))
    part = replace(batch.take(few), survey=free)
    if survey.settings.limit_deg is None:
        return found.with_rows(few, _corrected(part))
    flat = few[with_rays(part).counts >= 2]
    outcome = found.outcome.copy()
    outcome[flat] = Outcome.FLAT_RAYS
    return found._replace(outcome=outcome)


def _corrected(batch: Batch) -> Intersection:
    """Correct points of one reconstruction type."""
    name = _method(batch)
    module, function = name.split(".")
    method = getattr(import_module(f"pcfix.refract.{module}"), function)

    def solved(part: Batch) -> Intersection:
        return with_uncertainty(method(part), part)

    survey, learned = batch.survey, batch.survey.learned
    takes_all = batch.views is None and learned.occluder is None and learned.matcher is None
    # the rays of a point pierce the water under different slopes
    is_wavy = isinstance(survey.water, WaterMesh | WaterRaster) or survey.own_water is not None
    if name in (METHODS["snell"], METHODS["consistent"]) and takes_all and not is_wavy:
        # the kernel chooses among all cameras
        found = solved(batch)
    else:
        order = spatial_order(batch.xyz)
        parts = [solved(with_rays(batch.take(rows))) for rows in batches(order)]
        found = joined(parts, order)
    if name != METHODS["consistent"] or batch.views is not None:
        return found
    # an image shows the true point, near its border sometimes without the apparent one
    again = near_borders(batch, found.shift_m)
    again = again[found.outcome[again] == Outcome.CORRECTED]
    if not len(again):
        return found
    part = with_rays(batch.take(again), found.shift_m[again])
    return found.with_rows(again, solved(part))


def shift_of_land(batch: Batch) -> FloatArray:
    """Return the shift of land points between a dense matcher and the intersection of all rays.

    A transfer to adjusted cameras intersects the rays of all images; a dense matcher uses the
    depths of some images. That is inverted as on the bed, without water. Zero for tracks.
    """
    batch = replace(batch, survey=batch.survey.learned.land or on_land(batch.survey))
    if _method(batch) not in (_MAPS, _PAIRS):
        return np.zeros((len(batch), 3))
    at_themselves = SurfaceAbove(batch.xyz[:, 2].copy(), np.zeros((len(batch), 2)))
    return correct(replace(batch, surface=at_themselves)).shift_m


def on_land(survey: Survey) -> Survey:
    """Return the survey for points without water.

    The bed of the surroundings is not used: on land the groups of images are centimetres apart.
    """
    return replace(
        survey,
        water=WaterPlane(0.0),
        settings=replace(survey.settings, index=1.0, dimensions="none"),
        level_offset_m=None,
        learned=survey.learned._replace(bed=None),
        unlisted=None,
        own_water=None,
    )


def _method(batch: Batch) -> str:
    """Return the function that corrects; for `consistent` it depends on the reconstruction type."""
    settings, views = batch.survey.settings, batch.views
    if settings.method != "consistent":
        return METHODS[settings.method]
    modelled = "tracks" if batch.survey.learned.matcher is None else settings.matcher
    kind = modelled if views is None else views.kind
    if kind in ("depth-maps", "single-map", "nearest-map"):
        return _MAPS
    return _PAIRS if kind == "pairs" else METHODS["consistent"]


def with_rays(batch: Batch, shift_m: FloatArray | None = None) -> Batch:
    """Return the batch with its cameras chosen, without occluded ones.

    They are those of its view list, or all in frame; with the model of a matcher, all images that
    may have a depth of the point. With `shift_m`, shape (m, 3), the frames hold the images of the
    true points instead of the apparent points.
    """
    from pcfix.refract.matcher import without_border
    from pcfix.refract.occlusion import visible_cameras

    survey, centres = batch.survey, batch.survey.cameras.centres
    occluder = survey.learned.occluder
    inner = survey
    if survey.learned.matcher is not None and batch.views is None:
        inner = replace(survey, cameras=without_border(survey.cameras))
    views = chosen_views(replace(batch, survey=inner), shift_m)
    if occluder is not None:
        views = visible_cameras(batch.xyz, centres, views, occluder)
    return replace(batch, views=views)


def bed_around(batch: Batch) -> "Bed | None":
    """Return the most likely bed of a sample of fused points; None if no image sees a point."""
    from pcfix.refract.depth_maps import likely_beds
    from pcfix.refract.fusion import bed_of

    # of single maps each point shows the bed less clearly: all of them are needed
    many = len(batch) > BED_POINTS and batch.survey.settings.matcher == "depth-maps"
    batch = batch.take(np.arange(0, len(batch), 2 if many else 1))
    order = spatial_order(batch.xyz)
    likely = [likely_beds(with_rays(batch.take(rows))).height_m for rows in batches(order)]
    table = np.full((len(batch), max(part.shape[1] for part in likely)), np.nan)
    for rows, part in zip(batches(order), likely, strict=True):
        table[rows, : part.shape[1]] = part
    return bed_of(batch.xyz[:, :2], table, gsd_m(batch)) if np.isfinite(table).any() else None


def batches(order: IntArray) -> Iterator[IntArray]:
    """Yield the rows of points in batches, at least one."""
    for first in range(0, max(len(order), 1), POINTS_AT_ONCE):
        yield order[first : first + POINTS_AT_ONCE]


def joined(parts: list[Intersection], order: IntArray) -> Intersection:
    """Join the results of batches, in the original order of the points."""
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    used, known = np.any([part.camera_used for part in parts], axis=0), dict[str, Any]()
    for name, value in parts[0]._asdict().items():
        if value is not None and name != "camera_used":
            known[name] = np.concatenate([getattr(part, name) for part in parts])
            known[name] = known[name].take(place, axis=0)
    return parts[0]._replace(**known, camera_used=used)
