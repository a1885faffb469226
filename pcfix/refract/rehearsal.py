"""What compiles the kernels with which it is weighed how a cloud was made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.ahead import Rehearsal
from pcfix.lens.frames import frames_of
from pcfix.model import Views
from pcfix.refract.batch import Batch, Survey
from pcfix.refract.fusion import invert_fusion, likely_beds
from pcfix.refract.matcher import AVERAGED, MATCHED, NEIGHBOURS, Matcher, bed_of
from pcfix.refract.smooth import consistent_in_cells
from pcfix.refract.stereo_pairs import invert_pairs
from pcfix.refract.uncertainty import covariances
from pcfix.water.surface import SurfaceAbove

_HERE = "pcfix.refract"


def rehearsals(survey: Survey) -> tuple[Rehearsal, ...]:
    """Return them in the order of their need; the cameras have angles and lenses."""
    one = _one_point(survey)
    return (
        Rehearsal((f"{_HERE}.smooth._correct_cells",), lambda: consistent_in_cells(one)),
        Rehearsal(
            (
                f"{_HERE}.fusion._likely",
                f"{_HERE}.matcher._vote",
                f"{_HERE}.matcher._without_outliers",
            ),
            lambda: bed_of(one.xyz, likely_beds(one)),
        ),
        Rehearsal((f"{_HERE}.fusion._invert",), lambda: invert_fusion(one)),
        Rehearsal((f"{_HERE}.stereo_pairs._invert",), lambda: invert_pairs(one)),
        Rehearsal((f"{_HERE}.uncertainty._of_lists",), lambda: covariances(one, np.zeros((1, 3)))),
    )


def _one_point(survey: Survey) -> Batch:
    """Return a point a metre under the water between two cameras."""
    cameras = survey.cameras
    table = np.full((len(cameras), NEIGHBOURS), -1)
    matcher = Matcher(
        matched=np.ascontiguousarray(table[:, :MATCHED]),
        averaged=np.ascontiguousarray(table[:, :AVERAGED]),
        fused=table,
        focal_px=np.ones(len(cameras)),
        inner=frames_of(cameras),
    )
    xyz = cameras.centres[:2].mean(axis=0, keepdims=True)
    level = xyz[:, 2] - 50.0
    xyz[0, 2] = level[0] - 1.0
    return Batch(
        xyz,
        SurfaceAbove(level, np.zeros((1, 2))),
        replace(survey, learned=survey.learned._replace(matcher=matcher)),
        Views(np.array([0, 2]), np.array([0, 1])),
    )
