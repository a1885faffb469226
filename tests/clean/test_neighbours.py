"""Neighbours: as a twin that measures every pair finds them, however the tiles lie."""

from __future__ import annotations

import numpy as np
import pytest

from pcfix.clean import neighbours
from pcfix.clean.neighbours import Neighbours, height_quartiles, make_tiles, mean_of_first
from pcfix.clean.points import Reason, clean_points
from pcfix.libraries import load_open3d
from pcfix.options.steps import CleanRules
from tests.clean.scenes import spoilt_scene
from tests.utils.nightly import mostly_nightly

K = 12
FEW, OUTLIERS = 15_000, 75


def _clustered(n: int = 500) -> np.ndarray:
    """Clusters of many densities in UTM, with one point at the origin of the coordinates."""
    rng = np.random.default_rng(2)
    centres = rng.uniform(0.0, 50.0, (9, 3))
    spread = 10.0 ** rng.uniform(-1.5, 1.0, (9, 1))
    which = rng.integers(0, 9, n)
    xyz = centres[which] + rng.normal(size=(n, 3)) * spread[which] + (410_200.0, 4_650_300.0, 0.0)
    xyz[n // 2] = 0.0
    return np.round(xyz, 3)


def _lattice() -> np.ndarray:
    """A raster: every neighbourhood has ties, some points coincide; heights differ."""
    x, y = (grid.ravel() for grid in np.mgrid[:30, :30])
    xyz = np.column_stack([x, y, np.random.default_rng(3).normal(size=900)]).astype(float)
    return np.vstack([xyz, xyz[:40], xyz[:40]])


def _pairs(xyz: np.ndarray, axes: int) -> np.ndarray:
    """The distance of every point from every other."""
    apart = xyz[:, None, :axes] - xyz[None, :, :axes]
    return np.sqrt((apart**2).sum(axis=-1))


def _mean_distances(xyz: np.ndarray, tile_m: float) -> np.ndarray:
    cut = make_tiles(xyz, np.ones(len(xyz), bool), tile_m)
    near, out = Neighbours(cut, 3), np.empty(len(xyz))
    for piece in cut.pieces(100):
        out[cut.row[piece]] = mean_of_first(near.nearest(cut.xyz[piece], K)[0], K)
    return out


def _quartiles(xyz: np.ndarray, tile_m: float) -> np.ndarray:
    cut = make_tiles(xyz, np.ones(len(xyz), bool), tile_m)
    near, out = Neighbours(cut, 2), np.empty((len(xyz), 2))
    for piece in cut.pieces(100):
        out[cut.row[piece]] = height_quartiles(near, cut.xyz[piece], K)
    return out


@pytest.mark.parametrize("make", mostly_nightly([_clustered, _lattice], _clustered))
def test_statistics_are_those_of_all_pairs_and_of_any_tiles(make) -> None:
    xyz = make()
    twin_mean = np.sort(_pairs(xyz, 3), axis=1)[:, :K].mean(axis=1)
    plan = _pairs(xyz, 2)
    far = np.sort(plan, axis=1)[:, K - 1]
    twin_quartiles = np.array(
        [np.percentile(xyz[plan[i] <= far[i] * (1 + 1e-9), 2], (25, 75)) for i in range(len(xyz))]
    )
    whole_mean, whole_quartiles = _mean_distances(xyz, 1e9), _quartiles(xyz, 1e9)
    # rounding of sums of a dozen distances
    np.testing.assert_allclose(whole_mean, twin_mean, rtol=1e-13)
    np.testing.assert_allclose(whole_quartiles, twin_quartiles, rtol=0, atol=1e-12)
    for tile_m in (0.5, 3.0, 7.3, 25.0):
        assert np.array_equal(_mean_distances(xyz, tile_m), whole_mean)
        assert np.array_equal(_quartiles(xyz, tile_m), whole_quartiles)


def test_tiles_hold_every_used_point_once() -> None:
    xyz = _clustered()
    used = np.random.default_rng(1).random(len(xyz)) < 0.7
    cut = make_tiles(xyz, used, 4.0)
    assert len(cut) > 20
    assert np.array_equal(np.sort(cut.row), np.flatnonzero(used))
    assert np.array_equal(cut.xyz, xyz[cut.row])
    assert (np.diff(cut.start) > 0).all()


def test_blocks_of_rows_do_not_change_the_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz, used = _clustered(), np.ones(500, bool)
    whole = make_tiles(xyz, used, 4.0)
    monkeypatch.setattr("pcfix.blocks.ROWS", 77)
    cut = make_tiles(xyz, used, 4.0)
    assert np.array_equal(cut.row, whole.row)
    assert np.array_equal(cut.start, whole.start)


def test_points_over_each_other_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand points in one place of the plan: an answer, and not a table of all pairs."""
    monkeypatch.setattr(neighbours, "_MOST_COLUMNS", 64)
    xyz = np.zeros((1000, 3))
    xyz[:, 2] = np.arange(1000.0)
    lower, upper = _quartiles(xyz, 1.0).T
    assert (upper > lower).all()


@pytest.mark.parametrize("tile_m", mostly_nightly([8.0, 31.0, 400.0], 8.0))
def test_reasons_do_not_depend_on_tiles(tile_m: float) -> None:
    s = spoilt_scene(FEW, OUTLIERS)
    settings = CleanRules(deviations=2.0, radius=1.0)
    whole = clean_points(s.xyz, water=s.water_level_m, settings=settings)
    cut = clean_points(s.xyz, water=s.water_level_m, settings=settings, tile_m=tile_m, jobs=1)
    assert np.array_equal(cut, whole)
    for reason in (Reason.STATISTICAL, Reason.RADIUS, Reason.BELOW_BED, Reason.FLOATING):
        assert (whole & reason).any()


@pytest.mark.parametrize("deviations", mostly_nightly([0.5, 2.0, 4.0], 2.0))
@pytest.mark.parametrize("k", [8, 20])
def test_statistical_outliers_are_those_of_open3d(deviations: float, k: int) -> None:
    o3d, xyz = load_open3d(), spoilt_scene(FEW, OUTLIERS).xyz
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
    _, kept = cloud.remove_statistical_outlier(k, deviations)
    settings = CleanRules(neighbours=k, deviations=deviations, below=None, floating=None)
    found = clean_points(xyz, settings=settings, tile_m=20.0)
    assert np.array_equal(np.flatnonzero(found == 0), np.asarray(kept))
    assert len(kept) < len(xyz)


@pytest.mark.parametrize(("radius", "least"), [(0.6, 1), (1.0, 6)])
def test_radius_outliers_are_those_of_open3d(radius: float, least: int) -> None:
    o3d, xyz = load_open3d(), spoilt_scene(FEW, OUTLIERS).xyz
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
    _, kept = cloud.remove_radius_outlier(least, radius)  # it counts the point itself
    settings = CleanRules(
        deviations=None, radius=radius, radius_neighbours=least, below=None, floating=None
    )
    found = clean_points(xyz, settings=settings, tile_m=20.0)
    assert np.array_equal(np.flatnonzero(found == 0), np.asarray(kept))
    assert len(kept) < len(xyz)
