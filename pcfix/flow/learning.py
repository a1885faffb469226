"""What a correction learns of the block and the whole cloud before it moves the first point."""

from __future__ import annotations

from itertools import repeat
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import SettingError
from pcfix.flow.occlusion import (
    OccluderBuilder,
    occluder_of,
    wants_occlusion,
)
from pcfix.label.labelling import Part
from pcfix.model import NOISE_CLASSES
from pcfix.refract.learned import Learned
from pcfix.refract.made_with import MadeWith
from pcfix.refract.matcher import matcher_of, matcher_of_ties, places_for
from pcfix.refract.methods import learn_bed
from pcfix.water.surface import SurfaceAbove, is_submerged, surface_above

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pcfix.flow.inputs import Inputs
    from pcfix.flow.job import Points
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import Cameras, FloatArray, TiePoints, ViewKind, Views, WaterSurface
    from pcfix.options import Settings
    from pcfix.refract.occlusion import Occluder
    from pcfix.refract.regression import DepthRegression


class Learning:
    """The lessons of one job.

    Parameters
    ----------
    settings : Settings
    inputs : Inputs
    cameras : Cameras
        In the cloud's CRS.
    water : WaterSurface
    view : CloudView
        Of the whole cloud.
    views : {"tracks", "depth-maps"} or None
        Of which kind the view list is, if there is one.
    level_offset_m : array, shape (k,), or None
        How much higher the water stood at each image.
    ties : callable, optional
        Returns the tie points of the block, of the cameras that made the cloud. Default: those of
        the camera file.

    Raises
    ------
    SettingError
        If the method lacks something that it cannot do without.
    """

    def __init__(
        self,
        settings: Settings,
        inputs: Inputs,
        cameras: Cameras,
        water: WaterSurface,
        view: CloudView,
        views: ViewKind | None,
        level_offset_m: FloatArray | None,
        ties: Callable[[], TiePoints | None] | None = None,
    ) -> None:
        self._ties = ties or (lambda: inputs.tie_points(view.crs))
        self._settings, self._inputs, self._cameras = settings, inputs, cameras
        self._water, self._view, self._views = water, view, views
        self._level_offset_m = level_offset_m
        self.notes: list[str] = []
        check_method(settings, cameras)
        if (settings.method == "regression") != (inputs.check_depths is not None):
            raise SettingError(
                "method regression needs check-depths, a CSV of measured depths, and check-depths"
                " are of no use without it; give both, or neither."
            )

    def of_cloud(
        self,
        chunks: Callable[[], Iterable[Points]],
        came: Callable[[], Iterable[MadeWith]] | None = None,
    ) -> Learned:
        """Return what is learned of the whole cloud, whose chunks may be asked for again.

        And, chunk by chunk, what made the points, where that are not these cameras.
        """
        learned = Learned(regression=self._regression(chunks), occluder=self._occluder(chunks))
        return self._with_matcher(learned, chunks, came)

    def _regression(self, chunks: Callable[[], Iterable[Points]]) -> DepthRegression | None:
        path = self._inputs.check_depths
        if path is None:
            return None
        from pcfix.flow.regression import learn_regression

        parts = (
            Part(xyz, surface_above(self._water, xyz, heights), classes)
            for xyz, heights, classes in chunks()
        )
        found = learn_regression(path, parts, self._settings)
        again = "" if found.cv_rmse_m is None else f", cross-validated {found.cv_rmse_m:.3f} m"
        self.notes += [
            f"Regression: {found}; standard errors {found.intercept_se_m:.3f} m and"
            f" {found.slope_se:.3f}, RMSE {found.rmse_m:.3f} m{again}.",
            *found.notes,
        ]
        return found

    def _occluder(self, chunks: Callable[[], Iterable[Points]]) -> Occluder | None:
        listed = self._views is not None and self._settings.occlusion == "auto"
        if listed or not wants_occlusion(self._cameras, self._settings):
            return None  # listed cameras did see their points
        builder = OccluderBuilder(self._view.low, self._view.high, self._view.points)
        for xyz, _, classes in chunks():
            builder.add(xyz, classes)
        return builder.build()

    def _with_matcher(
        self,
        learned: Learned,
        chunks: Callable[[], Iterable[Points]],
        came: Callable[[], Iterable[MadeWith]] | None,
    ) -> Learned:
        """Add the model of the matcher, by the tie points where the camera file has some."""
        if not wants_matcher(self._settings, self._views):
            return learned
        step = max(1, self._view.points // _bed_points(self._view))
        taken: list[tuple[FloatArray, SurfaceAbove]] = []
        made: list[MadeWith] = []
        done = 0
        makers = repeat(None) if came is None else came()
        for (xyz, heights, classes), made_with in zip(chunks(), makers, strict=False):
            rows = np.arange(-done % step, len(xyz), step)
            rows = rows[~np.isin(classes[rows], NOISE_CLASSES)]
            above = surface_above(
                self._water, xyz[rows], None if heights is None else heights[rows]
            )
            taken.append((xyz[rows], above))
            if made_with is not None:
                made.append(made_with.take(rows))
            done += len(xyz)
        xyz = np.vstack([one for one, _ in taken])
        above = SurfaceAbove(
            np.concatenate([one.height_m for _, one in taken]),
            np.vstack([one.slope for _, one in taken]),
        )
        ties = self._ties()
        some = (self._cameras, self._water, self._settings, self._level_offset_m)
        maker = MadeWith(np.vstack([one.xyz for one in made]), made[0].cameras) if made else None
        return with_matcher(learned, xyz, above, *some, self._views, ties, maker)


BED_POINTS_A_M2 = 5.0
FEWEST_BED_POINTS, MOST_BED_POINTS = 250_000, 1_000_000
"""Of the cloud, evenly spread over its order, tell the bed of the surroundings."""


def _bed_points(view: CloudView) -> int:
    area_m2 = float(np.prod(np.maximum(np.subtract(view.high, view.low)[:2], 1.0)))
    return int(np.clip(BED_POINTS_A_M2 * area_m2, FEWEST_BED_POINTS, MOST_BED_POINTS))


def wants_matcher(settings: Settings, views: ViewKind | None) -> bool:
    """Return whether the images' partners must be known, with views of a kind or without any."""
    if views is None:
        return settings.models_matcher
    return settings.method == "consistent" and views == "depth-maps"


def with_matcher(
    learned: Learned,
    xyz: FloatArray,
    surface: SurfaceAbove,
    cameras: Cameras,
    water: WaterSurface,
    settings: Settings,
    level_offset_m: FloatArray | None,
    views: ViewKind | None,
    ties: TiePoints | None = None,
    made_with: MadeWith | None = None,
) -> Learned:
    """Add the model of the matcher to what was learned, and the bed where no list is given.

    Parameters
    ----------
    xyz, surface
        Points of the whole cloud and the water above them.
    views : {"tracks", "depth-maps", "pairs"} or None
        Of which kind the view list is, if there is one.
    ties : TiePoints, optional
        Of the block; else the points of the cloud tell what the images have in common.
    made_with : MadeWith, optional
        What made the points, where that are not these cameras; the tie points are theirs.
    """
    places, matched = made_with or (xyz, cameras)
    if ties is not None:
        matcher = matcher_of_ties(matched, ties)
    else:
        step = max(1, len(xyz) // places_for(matched))
        matcher = matcher_of(matched, np.ascontiguousarray(places[::step]))
    learned = learned._replace(matcher=matcher)
    fuses = settings.method == "consistent" and settings.matcher == "depth-maps"
    rows = np.flatnonzero(is_submerged(xyz[:, 2], surface))
    if views is not None or not fuses or not len(rows):
        return learned
    above = SurfaceAbove(surface.height_m[rows], surface.slope[rows])
    made = None if made_with is None else made_with.take(rows)
    bed = learn_bed(xyz[rows], above, water, cameras, settings, level_offset_m, learned, made)
    return learned._replace(bed=bed)


def learn_of_points(
    xyz: FloatArray,
    surface: SurfaceAbove,
    cameras: Cameras,
    water: WaterSurface,
    settings: Settings,
    regression: DepthRegression | None,
    views: Views | None,
    level_offset_m: FloatArray | None,
    made_with: MadeWith | None = None,
) -> Learned:
    """Return what is learned where these points, shape (n, 3), are the whole cloud.

    Raises
    ------
    SettingError
        If the method lacks something that it cannot do without.
    """
    check_method(settings, cameras)
    if settings.method == "regression" and regression is None:
        raise SettingError("method regression needs a regression; fit one of check depths first.")
    occluder = None
    if settings.occlusion == "on" or (settings.occlusion == "auto" and views is None):
        occluder = occluder_of(xyz) if wants_occlusion(cameras, settings) else None
    learned = Learned(regression=regression, occluder=occluder)
    kind = None if views is None else views.kind
    if not wants_matcher(settings, kind):
        return learned
    some = (cameras, water, settings, level_offset_m, kind)
    return with_matcher(learned, xyz, surface, *some, made_with=made_with)


def check_method(settings: Settings, cameras: Cameras) -> None:
    """Refuse a method that these cameras are not enough for."""
    if settings.camera_set == "mvs" and (cameras.lenses is None or cameras.rotations is None):
        raise SettingError(
            "camera-set mvs needs the angles and the lens of each image: give --sensor, or a"
            " camera file that has them, or use --camera-set all."
        )
    if settings.method == "consistent":
        from pcfix.refract.consistent import check_consistent

        check_consistent(cameras)
