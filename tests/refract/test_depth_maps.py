"""Depth maps and their fusion, undone: slow twins, simulated blocks, a real one, and the bed."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import pcfix
from pcfix.io.views import ViewMatch, read_views
from pcfix.lens.imaging import frames_of
from pcfix.model import Outcome, Views, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Learned, Survey
from pcfix.refract.learning import learn_of_sample
from pcfix.refract.matcher import Matcher
from pcfix.refract.methods import correct
from pcfix.running import threads
from pcfix.water.surface import is_submerged, surface_above
from tests.utils.batches import batch_of
from tests.utils.depth_map_twin import LENS, fused_slowly, looking
from tests.utils.matchers import matched_scene
from tests.utils.nightly import mostly_nightly
from tests.utils.rendered import block_of, cloud_of, truth_m
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")
N_WATER, TOLERANCE = 1.34, 0.1
CENTRES = [
    [-24.0, 3, 70], [-8, -2, 71], [9, 14, 69], [25, -9, 70], [2, -20, 70],
    [-46, 5, 70], [3, 48, 69], [44, -4, 71],
]  # fmt: skip
TILTS = [0.0, 2.0, 3.0, 1.0, 2.0, 35.0, 35.0, 35.0]
HEADINGS = [0.0, 40.0, 100.0, 250.0, 10.0, 0.0, 270.0, 180.0]
CAMERAS = looking(CENTRES, TILTS, HEADINGS)
MATCHED = np.array(
    [
        [1, 4, 2, 5, 3], [0, 4, 2, 3, 5], [1, 3, 4, 6, 0], [2, 4, 1, 7, 0], [1, 3, 0, 2, -1],
        [0, 1, 4, 6, 2], [2, 1, 0, 3, 5], [3, 2, 4, 1, 6],
    ]
)  # fmt: skip
PARTNERS = [[j for j in row if j >= 0] for row in MATCHED]
NADIR, MIXED = (0, 1, 2, 3, 4), (0, 2, 4, 5, 7)


def matcher(cameras=CAMERAS, matched=MATCHED, averaged=None, fused=None, tolerance=TOLERANCE):
    k = len(cameras)
    none = np.full((k, 8), -1)
    return Matcher(
        matched, none if averaged is None else averaged,
        np.full((k, 12), -1) if fused is None else fused,
        np.full(k, LENS.focal), frames_of(cameras), np.full((k, 12), -1), tolerance,
    )  # fmt: skip


def run(xyz, water, views, learned, *, cameras=CAMERAS, offset=None, n=N_WATER):
    settings = ScienceOptions(method="consistent", index=n, dimensions="none")
    above = surface_above(water, xyz)
    return correct(batch_of(xyz, above, water, cameras, settings, views, offset, learned=learned))


def listed(lists, weights=None):
    start = np.concatenate([[0], np.cumsum([len(row) for row in lists])])
    weight = None if weights is None else np.concatenate(weights).astype(np.float32)
    return Views(start, np.concatenate(lists).astype(np.int64), weight, "depth-maps")


# one depth


def test_depth_needs_partner():
    none = matcher(matched=np.full((8, 5), -1))
    xyz = np.array([[3.0, 4, -4.5]])
    result = run(xyz, WaterPlane(0.3), listed([NADIR]), Learned(matcher=none))
    assert result.outcome.tolist() == [Outcome.ONE_CAMERA]
    assert np.abs(result.shift_m).max() == 0.0


# lists of depth maps

PLANES = {"level": (0.3, 0.0, 0.0), "tilted": (0.3, 0.004, -0.003)}
OFFSET = np.array([0.0, 0.05, -0.03, 0.02, 0.0, 0.04, 0.0, -0.05])


def inverted(maps, slope, metric, water, offset):
    """Return what the correction makes of a twin's point, and what that point shows."""
    planes = [(water[0] + up, *water[1:]) for up in offset]
    weights = 1.0 / ((CAMERAS.centres[list(maps)] - [3.0, 4.0, -4.0]) ** 2).sum(axis=1)
    made, true = fused_slowly(
        np.array([3.0, 4.0, -4.3]), maps, weights, CAMERAS, PARTNERS, planes, (-6.0, *slope),
        N_WATER, TOLERANCE, metric,
    )  # fmt: skip
    views = listed([maps], [weights / weights.sum()])
    result = run(made[None], WaterPlane(*water), views, Learned(matcher=matcher()), offset=offset)
    assert result.outcome.tolist() == [Outcome.CORRECTED]
    assert np.linalg.norm(result.shift_m) > 1.0  # far more than what is left
    return made + result.shift_m[0], true


@pytest.mark.parametrize("c", [1, 5])
def test_single_map(c):
    found, true = inverted((c,), (0.0, 0.0), "angles", PLANES["tilted"], OFFSET)
    # no mean to be taken: what is left is scipy's least value and the bisection of the height
    assert found == pytest.approx(true, abs=1e-5)


@pytest.mark.parametrize("maps", [NADIR, MIXED], ids=["nadir", "mixed"])
@pytest.mark.parametrize("water", PLANES)
def test_fused_maps(maps, water):
    found, true = inverted(maps, (0.0, 0.0), "angles", PLANES[water], OFFSET)
    # ways are balanced as shares of the distances from the cameras, which differ by 3 %, and the
    # maps by decimetres: 0.1 mm from nadir, 0.8 mm with obliques
    assert found == pytest.approx(true, abs=0.002)


@pytest.mark.parametrize("maps", [NADIR, MIXED], ids=["nadir", "mixed"])
@pytest.mark.parametrize("metric", ["angles", "pixels"])
def test_sloping_bed(maps, metric):
    """The model has a level bed, and angles for pixels; the truth has a slope of 0.15."""
    found, true = inverted(maps, (0.12, -0.09), metric, PLANES["level"], np.zeros(8))
    # 0.5 mm up and down, and 1.7 mm aside with obliques, whose places of the bed are far apart
    assert found == pytest.approx(true, abs=0.005)


def test_averaged_maps():
    """A map that was averaged with two others is as good as the three of them with a third each."""
    xyz, averaged = np.array([[3.0, 4, -4.5]]), np.full((8, 8), -1)
    averaged[2, :2] = [1, 5]
    one = run(xyz, WaterPlane(0.3), listed([[2]]), Learned(matcher=matcher(averaged=averaged)))
    three = run(xyz, WaterPlane(0.3), listed([[2, 1, 5]], [np.ones(3)]), Learned(matcher=matcher()))
    assert one.shift_m == pytest.approx(three.shift_m, abs=1e-9)


# no answer, and hardly any water

FUSED = np.array([[j for j in range(8) if j != c] + [-1] * 5 for c in range(8)])


@pytest.mark.parametrize("with_list", [True, False], ids=["list", "no list"])
def test_few_images(with_list):
    """In the middle; far outside; and where one oblique looks alone."""
    xyz = np.array([[3.0, 4, -4.5], [900.0, 0, -4.5], [75.0, 3.0, -3.0]])
    learned = Learned(matcher=matcher(fused=FUSED, averaged=FUSED[:, :8].copy()))
    views = listed([MIXED, [], [5]]) if with_list else None
    result = run(xyz, WaterPlane(0.3), views, learned)
    assert np.isfinite(result.shift_m).all()
    assert result.outcome[0] == Outcome.CORRECTED
    assert result.outcome[1] == Outcome.NO_CAMERA
    moved = result.outcome == Outcome.CORRECTED
    assert np.abs(result.shift_m[~moved]).max() == 0.0
    assert (result.ray_count[~moved] == 0).all()


# simulated blocks

FLAT = {"bed": "flat", "greatest_depth_m": 6.0, "lidar_per_m2": 0.0, "cloud": "depth-maps"}
SCENES = {
    "nadir": {},
    "half oblique": {"obliques_deg": 35.0, "oblique_share": 0.5, "area_m": (70.0, 50.0)},
}


@lru_cache
def scene_of(name):
    return matched_scene(1500, **FLAT, **SCENES[name])


def errors_gsd(name, **choices):
    """Return the errors in z of the points under water, GSD."""
    scene = scene_of(name)
    result = pcfix.correct_points(
        scene.xyz, scene.cameras, scene.water, index=scene.refractive_index, **choices
    )
    moved = (result.outcome == Outcome.CORRECTED) & (np.diff(scene.views.start) > 1)
    assert moved.mean() > 0.99
    return (scene.xyz + result.shift_m - scene.true_xyz)[moved, 2] / scene.gsd_m


def rms(values):
    return float(np.sqrt((values**2).mean()))


@pytest.mark.parametrize(
    ("name", "most"), mostly_nightly([("nadir", 2.2), ("half oblique", 8.0)], ("nadir", 2.2))
)
def test_block_with_list(name, most):
    """The partners are found from the cloud, nine in ten of them rightly; half a pixel of noise."""
    views = replace(scene_of(name).views, kind="depth-maps")
    error = errors_gsd(name, method="consistent", views=views)
    # 1.7 and 6.6 GSD; from nadir that is the noise, with obliques the maps that the software did
    # not average, as they differ by more than 1.2 %, and the model does
    assert rms(error) < most
    # 1.0 and 0.8: with noise the best pair is not that of the least squares
    assert abs(error.mean()) < 1.5
    assert rms(error) < 0.4 * rms(errors_gsd(name, method="snell", views=views))


@pytest.mark.parametrize(("name", "most"), mostly_nightly([("nadir", 3.0), ("half oblique", 9.0)]))
def test_block_without_list(name, most, monkeypatch):
    error = errors_gsd(name, method="consistent", camera_set="mvs")
    assert rms(error) < most  # 2.4 and 7.3 GSD
    # 1.3 and 5.2: with fewer wild points the bias of the wrong groups shows
    assert abs(error.mean()) < 5.7
    assert rms(error) < 0.6 * rms(errors_gsd(name, method="snell", camera_set="all"))
    monkeypatch.setattr("pcfix.refract.learning.bed_around", lambda *_: None)
    without_ties = errors_gsd(name, method="consistent", camera_set="mvs")
    # 3.5 and 42 GSD: the images of a group see the bed at heights that are a metre apart
    assert rms(error) < {"nadir": 0.9, "half oblique": 0.4}[name] * rms(without_ties)


# the bed of the surroundings


def test_any_chunk():
    """The result of a point does not depend on the others, nor on the number of threads."""
    scene = scene_of("nadir")
    settings = ScienceOptions(method="consistent", camera_set="mvs", dimensions="none")
    above = surface_above(scene.water, scene.xyz)
    whole = Batch(scene.xyz, above, Survey(scene.water, scene.cameras, settings))
    survey, _ = learn_of_sample(whole)
    part = replace(whole, survey=survey).take(np.flatnonzero(is_submerged(scene.xyz[:, 2], above)))
    listed = replace(scene.views.take(np.arange(len(part))), kind="depth-maps")
    for one in (part, replace(part, views=listed)):
        rows = np.random.default_rng(2).permutation(len(part))[:300]
        with threads(3):
            some = correct(one.take(rows)).shift_m
        np.testing.assert_array_equal(some, correct(one).shift_m[rows])


# a real cloud


@lru_cache
def rendered_cloud():
    xyz, cameras = cloud_of(RENDERED / "cloud.las"), block_of(RENDERED)[1]
    match = ViewMatch(read_views(RENDERED / "dense.vis", cameras), cameras, points=len(xyz))
    rows = np.arange(0, len(xyz), 6)
    return xyz[rows], cameras, match.views_of(xyz, 0)[0].take(rows)


@rendered
@pytest.mark.parametrize("with_list", [True, False], ids=["list", "no list"])
def test_real_cloud(with_list):
    """Heights against the true surface, in GSD of 5 cm, under more than 0.2 m of water."""
    xyz, cameras, views = rendered_cloud()
    views = replace(views, kind="depth-maps")
    choices = {"views": views} if with_list else {"camera_set": "mvs"}
    result = pcfix.correct_points(xyz, cameras, 0.37, method="consistent", **choices)
    found = xyz + result.shift_m
    wet = (truth_m(RENDERED, xyz) < 0.37 - 0.2) & (result.outcome == Outcome.CORRECTED)
    error = (found[:, 2] - truth_m(RENDERED, found))[wet] / 0.05
    error = error[np.isfinite(error)]
    assert len(error) > 10_000
    # 0.9 and 1.05 GSD; triangulated at once the same points have 1.3 to 1.9
    assert rms(error) < 1.2
    assert abs(error.mean()) < 0.3
