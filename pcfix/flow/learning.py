"""What a correction learns of the block and the whole cloud before it moves the first point."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import SettingError
from pcfix.label.labelling import Part
from pcfix.label.surface import surface_above
from pcfix.refract.learned import Learned
from pcfix.refract.matcher import matcher_of, matcher_of_ties, places_for

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pcfix.flow.inputs import Inputs
    from pcfix.flow.job import Points
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import Cameras, FloatArray, Views, WaterSurface
    from pcfix.refract.matcher import Matcher
    from pcfix.refract.occlusion import Occluder
    from pcfix.refract.regression import DepthRegression
    from pcfix.settings import Settings, ViewsAre


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
        views: ViewsAre | None,
    ) -> None:
        self._settings, self._inputs, self._cameras = settings, inputs, cameras
        self._water, self._view, self._views = water, view, views
        self.notes: list[str] = []
        check_method(settings, cameras)
        if (settings.method == "regression") != (inputs.check_depths is not None):
            raise SettingError(
                "method regression needs check-depths, a CSV of measured depths, and check-depths"
                " are of no use without it; give both, or neither."
            )

    def of_cloud(self, chunks: Callable[[], Iterable[Points]]) -> Learned:
        """Return what is learned of the whole cloud, whose chunks may be asked for again."""
        return Learned(
            regression=self._regression(chunks),
            occluder=self._occluder(chunks),
            matcher=self._matcher(chunks),
        )

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
        self.notes += found.notes
        return found

    def _occluder(self, chunks: Callable[[], Iterable[Points]]) -> Occluder | None:
        from pcfix.flow.occlusion import OccluderBuilder, wants_occlusion

        listed = self._views is not None and self._settings.occlusion == "auto"
        if listed or not wants_occlusion(self._cameras, self._settings):
            return None  # listed cameras did see their points
        builder = OccluderBuilder(self._view.low, self._view.high, self._view.points)
        for xyz, _, classes in chunks():
            builder.add(xyz, classes)
        return builder.build()

    def _matcher(self, chunks: Callable[[], Iterable[Points]]) -> Matcher | None:
        """Return the model of the matcher, by the tie points where the camera file has some."""
        if not wants_matcher(self._settings, self._views):
            return None
        ties = self._inputs.tie_points(self._view.crs)
        if ties is not None:
            return matcher_of_ties(self._cameras, ties)
        step = max(1, self._view.points // places_for(self._cameras))
        taken, done = [], 0
        for xyz, _, _ in chunks():
            taken.append(xyz[-done % step :: step])
            done += len(xyz)
        return matcher_of(self._cameras, np.vstack(taken))


def wants_matcher(settings: Settings, views: ViewsAre | None) -> bool:
    """Return whether the images' partners must be known, with views of a kind or without any."""
    if views is None:
        return settings.camera_set == "mvs"
    return settings.method == "consistent" and views == "depth-maps"


def learn_of_points(
    xyz: FloatArray,
    cameras: Cameras,
    settings: Settings,
    regression: DepthRegression | None,
    views: Views | None,
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
        from pcfix.flow.occlusion import occluder_of, wants_occlusion

        occluder = occluder_of(xyz) if wants_occlusion(cameras, settings) else None
    matcher = None
    if wants_matcher(settings, None if views is None else views.kind):
        step = max(1, len(xyz) // places_for(cameras))
        matcher = matcher_of(cameras, np.ascontiguousarray(xyz[::step]))
    return Learned(regression=regression, occluder=occluder, matcher=matcher)


def check_method(settings: Settings, cameras: Cameras) -> None:
    """Refuse a method that these cameras are not enough for."""
    if settings.camera_set == "mvs" and cameras.lenses is None:
        raise SettingError(
            "camera-set mvs needs the interior orientation of the cameras: give --sensor, or a"
            " camera file that has it, or use --camera-set all."
        )
    if settings.method == "consistent":
        from pcfix.refract.consistent import check_consistent

        check_consistent(cameras)
