"""The methods of correction, each under its name, all through one seam.

``snell`` with every camera in frame has a kernel of its own that chooses cameras as it goes; the
others get the chosen cameras of some points at a time.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.model import WaterPlane
from pcfix.refract.bed import Bed, bed_of
from pcfix.refract.bundles import Bundle
from pcfix.refract.choice import chosen_views, spatial_order
from pcfix.refract.depth_maps import invert_depth_maps
from pcfix.refract.fusion import invert_fusion, likely_beds
from pcfix.refract.intersect import intersect
from pcfix.refract.learned import Learned
from pcfix.refract.matcher import steepest_and_partners, without_border
from pcfix.refract.occlusion import in_sight
from pcfix.refract.result import Intersection
from pcfix.refract.stereo_pairs import cameras_of_pairs, invert_pairs
from pcfix.refract.uncertainty import with_uncertainty
from pcfix.water.surface import SurfaceAbove

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pcfix.model import Cameras, FloatArray, IntArray, Views, WaterSurface
    from pcfix.options import Settings
    from pcfix.refract.made_with import MadeWith
    from pcfix.refract.occlusion import Occluder

POINTS_AT_ONCE = 100_000
"""Bounds the memory of the lists of cameras: some 50 MB at 40 rays a point."""

_HOMES = {
    "snell": "pcfix.refract.methods",
    "consistent": "pcfix.refract.consistent",
    "shan": "pcfix.refract.literature.shan",
    "butler": "pcfix.refract.literature.butler",
    "murase": "pcfix.refract.literature.murase",
    "dietrich": "pcfix.refract.literature.dietrich",
    "factor": "pcfix.refract.literature.factor",
    "regression": "pcfix.refract.regression",
}
"""Where each method is: a function of its own name that takes a `Bundle`."""

_OF_MATCHERS: dict[str, Callable[[Bundle], Intersection]] = {
    "depth-maps": invert_depth_maps,
    "pairs": invert_pairs,
}
"""What `consistent` is for the kinds of dense clouds."""


def correct(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    views: Views | None = None,
    level_offset_m: FloatArray | None = None,
    learned: Learned | None = None,
    level_sigma_m: FloatArray | float | None = None,
    made_with: MadeWith | None = None,
) -> Intersection:
    """Correct submerged points by the method that the settings name.

    Parameters
    ----------
    xyz, surface, water, cameras, settings, views, level_offset_m
        As of `pcfix.refract.intersect.intersect`.
    learned : Learned, optional
    level_sigma_m : array, shape (m,), or float, optional
        As of `pcfix.refract.uncertainty.covariances`.
    made_with : MadeWith, optional
        The points as they came and the cameras they came from, where `xyz` are the same points
        carried to `cameras` (`pcfix.adjust.carry`). What undoes dense matching goes by it; the
        matcher learned is one of those cameras then.

    Returns
    -------
    Intersection
        One row per input point, in the same order.
    """
    learned = learned or Learned()
    method, pairs = _method(settings, views, learned), None
    if views is not None and views.kind == "pairs":
        views, pairs = cameras_of_pairs(views), views
    if settings.method == "snell" and learned == Learned(regression=learned.regression):
        found = intersect(xyz, surface, water, cameras, settings, views, level_offset_m)
        return with_uncertainty(
            found, xyz, surface, cameras, settings, views, level_offset_m, learned, level_sigma_m
        )
    offset = np.zeros(len(cameras)) if level_offset_m is None else level_offset_m
    order = spatial_order(xyz)
    parts = []
    for rows in _batches(order):
        above = type(surface)(surface.height_m[rows], surface.slope[rows])
        mine = None if views is None else views.take(rows)
        chosen = _cameras_of(xyz[rows], above, water, cameras, settings, mine, offset, learned)
        made = None if made_with is None else made_with.take(rows)
        bundle = Bundle(xyz[rows], above, water, cameras, chosen, settings, offset, learned, made)
        if method is invert_pairs and pairs is not None:
            found = invert_pairs(bundle, pairs.take(rows))
        else:
            found = method(bundle)
        sigma = level_sigma_m[rows] if isinstance(level_sigma_m, np.ndarray) else level_sigma_m
        known = with_uncertainty(
            found, xyz[rows], above, cameras, settings, chosen, offset, learned, sigma
        )
        parts.append(_with_ambiguity(known, found) if method is invert_fusion else known)
    return joined(parts, order, len(cameras))


def shift_of_land(
    xyz: FloatArray,
    cameras: Cameras,
    settings: Settings,
    views: Views | None,
    learned: Learned | None,
    made_with: MadeWith,
) -> FloatArray:
    """Return how far points on land are from where a dense matcher would have had them.

    Carried by all their images alike, they lie where straight rays meet best; a dense matcher
    would have made them of some images' depths. That is undone as on the bed, without water.

    Parameters
    ----------
    xyz, cameras, settings, views, learned, made_with
        As of `correct`.

    Returns
    -------
    array, shape (m, 3)
        Metres; zero for other methods than those that go by `made_with`.
    """
    learned = learned or Learned()
    if _method(settings, views, learned) not in (invert_fusion, *_OF_MATCHERS.values()):
        return np.zeros((len(xyz), 3))
    at_themselves = SurfaceAbove(xyz[:, 2].copy(), np.zeros((len(xyz), 2)))
    straight = replace(settings, refractive_index=1.0, dimensions="none")
    # the bed of the surroundings tells nothing of land: the largest group made the point
    found = correct(
        xyz, at_themselves, WaterPlane(0.0), cameras, straight, views, None,
        learned._replace(bed=None), made_with=made_with,
    )  # fmt: skip
    return found.shift_m


def _with_ambiguity(known: Intersection, found: Intersection) -> Intersection:
    """Add to the error of Z that of not knowing which group of images made the point."""
    if known.covariance_m2 is None:
        return known
    covariance = known.covariance_m2.copy()
    covariance[:, 5] += found.sigma_z_m**2
    return known._replace(covariance_m2=covariance, sigma_z_m=np.sqrt(covariance[:, 5]))


def learn_bed(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    level_offset_m: FloatArray | None,
    learned: Learned,
    made_with: MadeWith | None = None,
) -> Bed | None:
    """Return the bed that fused points of a whole cloud have in common, of a sample of them.

    Parameters
    ----------
    xyz, surface, water, cameras, settings, level_offset_m, learned, made_with
        As of `correct`. None where no image sees a point.
    """
    offset = np.zeros(len(cameras)) if level_offset_m is None else level_offset_m
    likely = []
    order = spatial_order(xyz)
    for rows in _batches(order):
        above = type(surface)(surface.height_m[rows], surface.slope[rows])
        chosen = _cameras_of(xyz[rows], above, water, cameras, settings, None, offset, learned)
        made = None if made_with is None else made_with.take(rows)
        bundle = Bundle(xyz[rows], above, water, cameras, chosen, settings, offset, learned, made)
        likely.append(likely_beds(bundle))
    most = max(part.shape[1] for part in likely)
    table = np.full((len(xyz), most), np.nan, np.float32)
    done = 0
    for part in likely:
        table[done : done + len(part), : part.shape[1]] = part
        done += len(part)
    return bed_of(xyz[order], table) if np.isfinite(table).any() else None


def _method(
    settings: Settings, views: Views | None, learned: Learned
) -> Callable[[Bundle], Intersection]:
    """Return the function that corrects; what a dense matcher made is not triangulated at once."""
    modelled = "tracks" if learned.matcher is None else settings.matcher
    kind = modelled if views is None else views.kind
    if settings.method == "consistent" and views is None and kind == "depth-maps":
        return invert_fusion
    if settings.method == "consistent" and kind in _OF_MATCHERS:
        return _OF_MATCHERS[kind]
    found: Callable[[Bundle], Intersection] = getattr(
        import_module(_HOMES[settings.method]), settings.method
    )
    return found


def _cameras_of(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    views: Views | None,
    offset: FloatArray,
    learned: Learned,
) -> Views:
    """Return the cameras of a list, of the model of a matcher, or all in frame; none hidden.

    Of the model, `consistent` takes all images that may have a depth of the point, as it weighs
    them by itself; to the other methods go the steepest image and those it was matched with.
    """
    if views is not None or learned.matcher is None:
        return _in_sight(xyz, surface, water, cameras, settings, views, offset, learned.occluder)
    inner = without_border(cameras)
    if settings.method == "consistent":
        return _in_sight(xyz, surface, water, inner, settings, None, offset, learned.occluder)
    any_number = replace(settings, max_cameras=None)
    seeing = _in_sight(xyz, surface, water, inner, any_number, None, offset, learned.occluder)
    partners = steepest_and_partners(xyz, cameras.centres, seeing, learned.matcher)
    return chosen_views(xyz, surface, water, cameras, settings, partners, offset)


def snell(bundle: Bundle) -> Intersection:
    """Return what `pcfix.refract.intersect.intersect` makes of the chosen cameras."""
    return intersect(
        bundle.xyz, bundle.surface, bundle.water, bundle.cameras, bundle.settings, bundle.views,
        bundle.level_offset_m,
    )  # fmt: skip


def _in_sight(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    views: Views | None,
    offset: FloatArray,
    occluder: Occluder | None,
) -> Views:
    """Return the chosen cameras, without those that the cloud hides; the steepest of the rest."""
    if occluder is None:
        return chosen_views(xyz, surface, water, cameras, settings, views, offset)
    any_number = replace(settings, max_cameras=None)
    chosen = chosen_views(xyz, surface, water, cameras, any_number, views, offset)
    seeing = in_sight(xyz, cameras.centres, chosen, occluder)
    if settings.max_cameras is None:
        return seeing
    return chosen_views(xyz, surface, water, cameras, settings, seeing, offset)


def _batches(order: IntArray) -> Iterator[IntArray]:
    for first in range(0, max(len(order), 1), POINTS_AT_ONCE):
        yield order[first : first + POINTS_AT_ONCE]


def joined(parts: list[Intersection], order: IntArray, k: int) -> Intersection:
    """Return the results of batches as one, back in the order of the points."""

    def back(name: str) -> Any:
        if parts[0].covariance_m2 is None and name == "covariance_m2":
            return None
        values = np.concatenate([getattr(part, name) for part in parts])
        full = np.empty_like(values)
        full[order] = values
        return full

    per_point = (
        "shift_m", "outcome", "ray_count", "ray_miss_m", "sigma_z_m", "incidence_deg",
        "covariance_m2",
    )  # fmt: skip
    used = np.any([part.camera_used for part in parts], axis=0) if k else np.zeros(0, np.bool_)
    tested = sum(part.pairs_tested for part in parts)
    return Intersection(
        **{name: back(name) for name in per_point}, camera_used=used, pairs_tested=tested
    )
