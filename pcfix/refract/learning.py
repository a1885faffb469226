"""What is learned of a block and the whole cloud before the first point is corrected.

Also what a view list lists, where its file does not say. The file of COLMAP's dense fusion also
serves for tracks. Neighbouring points have different lists; corrected by the wrong model they are
shifted differently, and scatter. The right one leaves the smoother bed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import Cameras, FloatArray, IntArray, Outcome, TiePoints, ViewKind
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Learned
from pcfix.refract.choice import spatial_order
from pcfix.refract.consistent import check_consistent
from pcfix.refract.fusion import likely_beds
from pcfix.refract.matcher import Bed, bed_of, matcher_of, matcher_of_ties, places_for
from pcfix.refract.methods import batches, correct, with_rays
from pcfix.refract.regression import DepthRegression
from pcfix.refract.top_surface import occluder_of, wants_occlusion
from pcfix.water.surface import is_submerged


def check_method(settings: ScienceOptions, cameras: Cameras) -> None:
    """Refuse a method that these cameras are not enough for."""
    if settings.camera_set == "mvs" and (cameras.lenses is None or cameras.rotations is None):
        raise SettingError(
            "camera-set mvs needs the angles and the lens of each image: give --sensor, or a"
            " camera file that has them, or use --camera-set all."
        )
    if settings.method == "consistent":
        check_consistent(cameras)


def wants_matcher(settings: ScienceOptions, views: ViewKind | None) -> bool:
    """Return whether the images' partners must be known, with views of a kind or without any."""
    if views is None:
        return settings.models_matcher
    return settings.method == "consistent" and views == "depth-maps"


def learn_of_points(batch: Batch, regression: DepthRegression | None) -> Learned:
    """Return what is learned where the points of a batch, land too, are the whole cloud.

    Raises
    ------
    SettingError
        If the method lacks something that it cannot do without.
    """
    settings, cameras = batch.survey.settings, batch.survey.cameras
    check_method(settings, cameras)
    if settings.method == "regression" and regression is None:
        raise SettingError("method regression needs a regression; fit one of check depths first.")
    occluder = None
    if settings.occlusion == "on" or (settings.occlusion == "auto" and batch.views is None):
        occluder = occluder_of(batch.xyz) if wants_occlusion(cameras, settings) else None
    learned = Learned(regression=regression, occluder=occluder)
    kind = None if batch.views is None else batch.views.kind
    if not wants_matcher(settings, kind):
        return learned
    return with_matcher(replace(batch, survey=replace(batch.survey, learned=learned)), kind)


def with_matcher(batch: Batch, views: ViewKind | None, ties: TiePoints | None = None) -> Learned:
    """Add the model of the matcher to what was learned, and the bed where no list is given.

    Parameters
    ----------
    batch : Batch
        Points of the whole cloud, land too.
    views : {"tracks", "depth-maps", "pairs"} or None
        Of which kind the view list is, if there is one.
    ties : TiePoints, optional
        Of the block that made the points; else the points tell what the images have in common.
    """
    survey = batch.survey
    places, matched = batch.made_with or (batch.xyz, survey.cameras)
    if ties is not None:
        matcher = matcher_of_ties(matched, ties)
    else:
        step = max(1, len(batch) // places_for(matched))
        matcher = matcher_of(matched, np.ascontiguousarray(places[::step]))
    learned, settings = survey.learned._replace(matcher=matcher), survey.settings
    fuses = settings.method == "consistent" and settings.matcher == "depth-maps"
    rows = np.flatnonzero(is_submerged(batch.xyz[:, 2], batch.surface))
    if views is not None or not fuses or not len(rows):
        return learned
    sample = replace(batch.take(rows), survey=replace(survey, learned=learned), views=None)
    return learned._replace(bed=_learn_bed(sample))


def _learn_bed(batch: Batch) -> Bed | None:
    """Return the bed that fused points of a whole cloud have in common, of a sample of them.

    None where no image sees a point.
    """
    order = spatial_order(batch.xyz)
    likely = [likely_beds(with_rays(batch.take(rows))) for rows in batches(order)]
    most = max(part.shape[1] for part in likely)
    table = np.full((len(batch), most), np.nan, np.float32)
    done = 0
    for part in likely:
        table[done : done + len(part), : part.shape[1]] = part
        done += len(part)
    return bed_of(batch.xyz[order], table) if np.isfinite(table).any() else None


PATCHES, PATCH_POINTS = 300, 12
CLEARLY = 0.95
"""A list stands for depth maps unless tracks leave a bed with less than this share of scatter."""


class KindFound(NamedTuple):
    """Which kind of list it is, and the scatter (m) of the bed about planes under either."""

    kind: Literal["tracks", "depth-maps"]
    tracks_m: float
    depth_maps_m: float

    def __str__(self) -> str:
        names = {"tracks": "rays that were intersected", "depth-maps": "depth maps that were fused"}
        return (
            f"The view list is taken as one of {names[self.kind]}: neighbouring points then scatter"
            f" by {100.0 * min(self.tracks_m, self.depth_maps_m):.1f} cm,"
            f" else by {100.0 * max(self.tracks_m, self.depth_maps_m):.1f} cm; --views-are says"
            " it yourself."
        )


def kind_of_views(batch: Batch) -> KindFound | None:
    """Return which kind of list gives the smoother bed; None where there are too few points.

    Parameters
    ----------
    batch : Batch
        Submerged points with their lists.
    """
    listed = np.flatnonzero(np.diff(batch.rays.start) >= 2)
    if len(listed) < PATCHES:
        return None
    patch = _patches(batch.xyz[listed])
    rows, place = np.unique(listed[patch], return_inverse=True)
    place = place.reshape(patch.shape)
    part = batch.take(rows)
    part = replace(part, survey=replace(part.survey, level_offset_m=None))
    kinds: tuple[ViewKind, ...] = ("tracks", "depth-maps")
    scatter = []
    for kind in kinds:
        found = correct(replace(part, views=replace(part.rays, kind=kind)))
        corrected = (found.outcome == Outcome.CORRECTED)[:, None]
        scatter.append(_scatter_m(np.where(corrected, part.xyz + found.shift_m, np.nan)[place]))
    tracks, maps = scatter
    return KindFound("tracks" if tracks < CLEARLY * maps else "depth-maps", tracks, maps)


def _patches(xyz: FloatArray) -> IntArray:
    """Return the rows of neighbours around places spread evenly over the order of the points."""
    from scipy.spatial import cKDTree

    seeds = np.linspace(0, len(xyz) - 1, PATCHES).astype(int)
    tree = cKDTree(xyz[:, :2], balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(xyz[seeds, :2], k=PATCH_POINTS)[1])


def _scatter_m(patch: FloatArray) -> float:
    """Return the median over patches, (p, k, 3), of the standard deviation about a plane."""
    patch = patch[np.isfinite(patch).all(axis=(1, 2))]
    if not len(patch):
        return float("inf")
    middle = patch - patch.mean(axis=1, keepdims=True)
    across, up = middle[..., :2], middle[..., 2]
    normal = np.einsum("pki,pkj->pij", across, across) + 1e-9 * np.eye(2)
    slope = np.linalg.solve(normal, np.einsum("pki,pk->pi", across, up)[..., None])[..., 0]
    rest = up - np.einsum("pki,pi->pk", across, slope)
    return float(np.median(np.sqrt((rest**2).sum(axis=1) / (rest.shape[1] - 3))))
