"""Simulate the input of a bundle adjustment with its truth: tie points, GNSS and control points.

Light is traced by `pcfix.simulate.tracing`, which shares nothing with the adjustment.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    GnssPositions,
    GroundControl,
    TiePoints,
    Views,
    WaterPlane,
)
from pcfix.simulate.scene import (
    ORIGIN_M,
    Site,
    Visible,
    cameras_in_world,
    find_visible,
    lay_out,
    plane_in_world,
    points_on,
)
from pcfix.simulate.settings import SceneSettings

_CANDIDATES = 4000
_LEAST_TIES = 8  # an image with fewer tie points is excluded from the block

_CLEAR_M = 0.1  # minimum height difference of control and check points from the water surface


@dataclass(frozen=True)
class TieNoise:
    """Standard deviations of observations; the default is stated for those without noise."""

    image_px: float = 0.5
    gnss_m: float = 0.03
    survey_m: float = 0.01


@dataclass(frozen=True, eq=False)
class TieScene:
    """A block of images; metres, UTM; all observations without and with noise."""

    true_cameras: Cameras
    cameras: Cameras  # with noise, and with GNSS positions: the start of an adjustment
    truth: FloatArray  # (m, 3)
    views: Views  # three images or more for each point
    exact_xy: FloatArray  # (o, 2), pixels, without noise
    ties: TiePoints  # the true points, with noise in the images
    is_wet: BoolArray  # (m,)
    control: GroundControl  # control points on land, check points also under water; with noise
    control_truth: FloatArray  # (q, 3)
    control_exact_xy: FloatArray  # (r, 2)
    water: WaterPlane
    refractive_index: float
    noise: TieNoise
    settings: dict[str, Any]

    def measured(self, rng: np.random.Generator) -> "TieScene":
        """Return the scene with other noise; poses, points and start values stay."""
        image_px, k = self.noise.image_px, len(self.cameras)
        image = self.exact_xy + rng.normal(0.0, image_px, self.exact_xy.shape)
        marks = self.control_exact_xy + rng.normal(0.0, image_px, self.control_exact_xy.shape)
        survey = self.control_truth + rng.normal(0.0, self.noise.survey_m, self.control_truth.shape)
        gnss = self.true_cameras.centres + rng.normal(0.0, self.noise.gnss_m, (k, 3))
        stated = self.noise.gnss_m or TieNoise.gnss_m
        positions = GnssPositions(gnss, np.full((k, 3), stated), None)
        return replace(
            self,
            cameras=replace(self.cameras, gnss=positions),
            ties=TiePoints(self.truth, self.views, image),
            control=replace(self.control, xyz=survey, image_xy=marks),
        )


def simulate_tie_points(
    points: int = 400,
    *,
    gnss_noise_m: float = 0.03,
    survey_noise_m: float = 0.01,
    control: int = 6,
    checks: int = 6,
    **settings: Any,
) -> TieScene:
    """Simulate a block of images with tie points above and below the water.

    Points in fewer than three images are left out. Control points are on land; every other check
    point is under water if possible. `settings` are those of `SceneSettings`.
    """
    chosen = SceneSettings(points=points, **settings)
    site = lay_out(chosen)
    terrain, plane = site.terrain, site.terrain.water
    truth, ties = _seen(points_on(terrain, points, site.rng), site)
    enough = np.bincount(ties.camera, minlength=len(site.true)) >= _LEAST_TIES
    if not enough.all():
        site = replace(site, true=_only(site.true, enough), given=_only(site.given, enough))
        truth, ties = _seen(truth, site)
    places = points_on(terrain, _CANDIDATES, site.rng)
    places = places[_spread(places, _above(places, plane), control, checks)]
    surveyed, marks = _seen(places, site)
    made = TieScene(
        true_cameras=cameras_in_world(site.true), cameras=cameras_in_world(site.given),
        truth=truth + ORIGIN_M, views=Views(ties.start, ties.camera),
        exact_xy=site.optics.to_image(ties.ideal),
        ties=TiePoints(truth, Views(ties.start, ties.camera), ties.ideal),
        is_wet=_above(truth, plane) < 0.0,
        control=_control(surveyed, marks, _above(surveyed, plane) < 0.0, control, chosen),
        control_truth=surveyed + ORIGIN_M, control_exact_xy=site.optics.to_image(marks.ideal),
        water=plane_in_world(plane), refractive_index=chosen.refractive_index,
        noise=TieNoise(chosen.image_noise, gnss_noise_m, survey_noise_m),
        settings=chosen.as_dict(),
    )  # fmt: skip
    control_sigma = np.full(surveyed.shape, survey_noise_m or TieNoise.survey_m)
    made = replace(made, control=replace(made.control, sigma_m=control_sigma))
    return made.measured(np.random.default_rng([chosen.seed, 9]))


def _only(cameras: Cameras, keep: BoolArray) -> Cameras:
    """Return some of the images; obliques may show none of the area."""
    rows = np.flatnonzero(keep)
    return Cameras(
        tuple(cameras.labels[i] for i in rows), cameras.centres[rows], cameras.rotations[rows],
        tuple(cameras.lenses[i] for i in rows),
    )  # fmt: skip


def _above(xyz: FloatArray, plane: WaterPlane) -> FloatArray:
    """Return heights above the water, local coordinates."""
    return np.asarray(xyz[:, 2] - (plane.a + xyz[:, :2] @ [plane.b, plane.c]))


def _seen(xyz: FloatArray, site: Site) -> tuple[FloatArray, Visible]:
    """Return the points in enough images, and their images."""
    imaged = find_visible(xyz, site, site.luck)
    made = imaged.paired
    start = np.concatenate([imaged.start[:-1][made], imaged.start[-1:]])
    point = np.repeat(np.arange(int(made.sum())), np.diff(start))
    return xyz[made], replace(imaged, truth=xyz[made], start=start, point=point)


def _spread(xyz: FloatArray, above: FloatArray, control: int, checks: int) -> FloatArray:
    """Return rows of control points on land and of check points, far from each other."""
    land, wet = np.flatnonzero(above > _CLEAR_M), np.flatnonzero(above < -_CLEAR_M)
    under = min(checks // 2, len(wet))
    on_land = _far_apart(xyz[land], control + checks - under)
    return np.concatenate([land[on_land], wet[_far_apart(xyz[wet], under)]])


def _far_apart(xyz: FloatArray, count: int) -> FloatArray:
    """Return rows of points, each the farthest in plan from those before it."""
    rows: list[int] = []
    if len(xyz) == 0:
        return np.zeros(0, np.int64)
    away = np.linalg.norm(xyz[:, :2] - xyz[:, :2].mean(axis=0), axis=1)
    for _ in range(min(count, len(xyz))):
        rows.append(int(np.argmax(away)))
        near = np.linalg.norm(xyz[:, :2] - xyz[rows[-1], :2], axis=1)
        away = near if len(rows) == 1 else np.minimum(away, near)
    return np.array(rows, np.int64)


def _control(
    xyz: FloatArray, marks: Visible, wet: BoolArray, control: int, chosen: SceneSettings
) -> GroundControl:
    """Return surveyed points without noise; the first ones on land are control points."""
    rank = np.arange(len(xyz))
    is_check = wet | (rank >= control)
    names = tuple(f"{'CP' if check else 'GCP'}{i + 1}" for i, check in enumerate(is_check))
    return GroundControl(
        names, xyz + ORIGIN_M, np.zeros(xyz.shape), is_check, wet,
        marks.point, marks.camera, marks.ideal,
        np.full(len(marks.point), chosen.image_noise or TieNoise.image_px),
    )  # fmt: skip
