"""What a correction learns of the block and the whole cloud before it moves the first point."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import repeat
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import SettingError
from pcfix.label.labelling import Part
from pcfix.model import NOISE_CLASSES, TiePoints, ViewKind
from pcfix.refract.batch import Batch, Learned, MadeWith, Survey, stacked
from pcfix.refract.learning import check_method, wants_matcher, with_matcher
from pcfix.refract.occlusion import Occluder
from pcfix.refract.regression import DepthRegression
from pcfix.refract.top_surface import OccluderBuilder, wants_occlusion
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from pcfix.flow.inputs import Inputs
    from pcfix.flow.surfaces import CloudView, Points


class Learning:
    """The lessons of one job.

    Parameters
    ----------
    survey : Survey
        Nothing learned yet.
    inputs : Inputs
    view : CloudView
        Of the whole cloud.
    views : {"tracks", "depth-maps"} or None
        Of which kind the view list is, if there is one.
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
        survey: Survey,
        inputs: Inputs,
        view: CloudView,
        views: ViewKind | None,
        ties: Callable[[], TiePoints | None] | None = None,
    ) -> None:
        self._ties = ties or (lambda: inputs.tie_points(view.crs))
        self.survey, self._inputs, self._view, self._views = survey, inputs, view, views
        self.notes: list[str] = []
        settings = survey.settings
        check_method(settings, survey.cameras)
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
            Part(xyz, surface_above(self.survey.water, xyz, heights), classes)
            for xyz, heights, classes in chunks()
        )
        found = learn_regression(path, parts, self.survey.settings)
        again = "" if found.cv_rmse_m is None else f", cross-validated {found.cv_rmse_m:.3f} m"
        self.notes += [
            f"Regression: {found}; standard errors {found.intercept_se_m:.3f} m and"
            f" {found.slope_se:.3f}, RMSE {found.rmse_m:.3f} m{again}.",
            *found.notes,
        ]
        return found

    def _occluder(self, chunks: Callable[[], Iterable[Points]]) -> Occluder | None:
        listed = self._views is not None and self.survey.settings.occlusion == "auto"
        if listed or not wants_occlusion(self.survey.cameras, self.survey.settings):
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
        if not wants_matcher(self.survey.settings, self._views):
            return learned
        step = max(1, self._view.points // _bed_points(self._view))
        survey = replace(self.survey, learned=learned)
        taken: list[Batch] = []
        done = 0
        makers = repeat(None) if came is None else came()
        for (xyz, heights, classes), made_with in zip(chunks(), makers, strict=False):
            rows = np.arange(-done % step, len(xyz), step)
            rows = rows[~np.isin(classes[rows], NOISE_CLASSES)]
            above = surface_above(
                survey.water, xyz[rows], None if heights is None else heights[rows]
            )
            made = None if made_with is None else made_with.take(rows)
            taken.append(Batch(xyz[rows], above, survey, made_with=made))
            done += len(xyz)
        return with_matcher(stacked(taken), self._views, self._ties())


BED_POINTS_A_M2 = 5.0
FEWEST_BED_POINTS, MOST_BED_POINTS = 250_000, 1_000_000
"""Of the cloud, evenly spread over its order, tell the bed of the surroundings."""


def _bed_points(view: CloudView) -> int:
    area_m2 = float(np.prod(np.maximum(np.subtract(view.high, view.low)[:2], 1.0)))
    return int(np.clip(BED_POINTS_A_M2 * area_m2, FEWEST_BED_POINTS, MOST_BED_POINTS))
