"""The shoreline: its standard error, and lines of shores, islands and pools."""

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

import pcfix
from pcfix.flow.demo import write_scene
from pcfix.flow.run_folder import waterline
from pcfix.grid import maps
from pcfix.grid.maps import waterlines
from pcfix.simulate.scene import ORIGIN_M
from pcfix.simulate.settings import Terrain

LEVEL_M, SIGMA_M = 0.37, 0.03


@pytest.fixture(scope="module")
def beach(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Terrain]:
    """Return the folder of a simulated shore, and the ground that it was made of."""
    made, folder = [], tmp_path_factory.mktemp("shore")
    with pytest.MonkeyPatch.context() as patch:
        whole = Terrain.random
        patch.setattr(Terrain, "random", lambda *a: made.append(whole(*a)) or made[-1])
        scene = pcfix.simulate_scene(points=20_000, water=LEVEL_M, seed=4)
    write_scene(scene, folder / "scene", overwrite=False)
    return folder / "scene", made[0]


def distance_m(ground: Terrain, xy: np.ndarray) -> np.ndarray:
    """Return how far places are from the true waterline, by Newton along the slope."""
    at, step = xy - ORIGIN_M[:2], 1e-4
    start = at.copy()
    for _ in range(8):
        x, y = at.T
        east, north = (
            (ground.height(x + dx, y + dy) - ground.height(x - dx, y - dy)) / (2.0 * step)
            for dx, dy in ((step, 0.0), (0.0, step))
        )
        slope = np.column_stack([east, north])
        fall = (ground.height(x, y) - LEVEL_M) / np.maximum((slope**2).sum(axis=1), 1e-4)
        at = at - np.clip(fall[:, None] * slope, -0.2, 0.2)
    return np.hypot(*(at - start).T)


@pytest.mark.parametrize("off_m", [0.0, SIGMA_M])
def test_standard_error(beach, tmp_path, off_m):
    """Also where the level is wrong by its standard error: then by about that over the slope."""
    folder, ground = beach
    pcfix.correct_file(
        folder / "cloud.laz", tmp_path / "out.laz", cameras=folder / "cameras.csv",
        water=LEVEL_M + off_m, method="snell", max_angle=None,
    )  # fmt: skip
    layer = waterline(tmp_path / "out.laz", pcfix.WaterPlane(LEVEL_M + off_m), SIGMA_M)
    assert len(layer.geometries) >= 1
    for line, level, sigma, length in zip(
        layer.geometries, *(layer.values[n] for n in ("level_m", "sigma_m", "length_m")),
        strict=True,
    ):  # fmt: skip
        distance = distance_m(ground, shapely.get_coordinates(line))
        rms = math.sqrt(np.mean(distance**2))
        assert rms < 2.0 * sigma
        assert off_m == 0.0 or rms > 0.3 * sigma  # it is no larger than it need be
        assert level == pytest.approx(LEVEL_M + off_m, abs=1e-6)
        assert length == pytest.approx(line.length)


@pytest.mark.parametrize("most", [2_000_000, 20_000])
def test_islands_and_pools(monkeypatch, most):
    """A beach at x = 10 with an island of radius 6 m and a pool of 4 m."""
    monkeypatch.setattr(maps, "MOST_POINTS", most)
    rng = np.random.default_rng(5)
    x, y = rng.uniform(0.0, (100.0, 60.0), (60_000, 2)).T
    island = 0.2 * (6.0 - np.hypot(x - 60.0, y - 30.0))
    above = np.maximum(0.1 * (10.0 - x), island)
    pool = 0.2 * (np.hypot(x - 30.0, y - 20.0) - 4.0)
    spit = 0.2 * (8.0 - np.hypot(x - 30.0, y - 20.0))  # the land about the pool
    above = np.maximum(above, np.minimum(pool, spit)) + rng.normal(0.0, 0.02, len(x))
    columns = np.column_stack([x + 4e5, y + 4e6, above, above, np.zeros(len(x))])
    lines = waterlines(np.array_split(columns, 7), 0.01)
    expected = [60.0, 16.0 * math.pi, 12.0 * math.pi, 8.0 * math.pi]
    assert [one.length_m for one in lines] == pytest.approx(expected, rel=0.05)
    closed = [bool((one.xy[0] == one.xy[-1]).all()) for one in lines]
    assert closed == [False, True, True, True]
    # heights scatter by 2 cm and the level by 1 cm, over slopes of 0.1 and 0.2
    # (the thinner the cloud, the more of its form counts as scatter)
    expected = math.hypot(0.02, 0.01) / np.array([0.1, 0.2, 0.2, 0.2])
    ratio = np.array([one.sigma_m for one in lines]) / expected
    assert (ratio > 0.9).all()
    assert (ratio < (1.3 if most > 60_000 else 1.6)).all()


def test_flat_water():
    """Ground within its noise of the water would be all line."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0.0, 50.0, (2, 20_000))
    above = -0.05 + rng.normal(0.0, 0.03, 20_000)
    columns = np.column_stack([x, y, above, above, np.zeros(len(x))])
    assert sum(one.length_m for one in waterlines([columns], 0.02)) < 10.0
    assert waterlines([], 0.0) == []
