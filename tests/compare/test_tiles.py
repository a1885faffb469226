"""Figures do not depend on tiles, blocks, threads and arrays on disk."""

import json

import numpy as np
import pytest

from pcfix import running
from pcfix.compare.statistics import m3c2_distances
from pcfix.errors import InputError
from pcfix.flow.compare import compare_clouds
from pcfix.points import neighbours
from pcfix.running import threads
from tests.compare.test_files import py4dgeo, write_las
from tests.utils.codes import refused


def in_small_tiles(monkeypatch, points, rows=1_000_000, large=2_000_000):
    """Have tiles of so many points, blocks of so many rows, and larger arrays on disk."""
    monkeypatch.setattr(neighbours, "POINTS_PER_TILE", points)
    monkeypatch.setattr(running, "ROWS", rows)
    monkeypatch.setattr(running, "LARGE", large)


def bed(count, seed, lift_m=0.0):
    """Return points to the millimetre on a wavy bed of 40 m by 60 m, far from the origin."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((0.0, 0.0), (40.0, 60.0), (count, 2))
    z = np.sin(xy[:, 0] / 6.0) + rng.normal(0.0, 0.03, count) + lift_m - 4.0
    return np.round(np.column_stack([xy + np.array([500_000.0, 5_000_000.0]), z]), 3)


def figures(folder, name):
    """Compare with all that there is, and return what stands in the files, but for the time."""
    out = folder / name
    compare_clouds(
        folder / "cloud.las", folder / "reference.las", out_dir=out, water=-3.6, sections=2,
        direction="both", max_gap=2.0, overwrite=True,
    )  # fmt: skip
    found = {path.name: path.read_text() for path in out.iterdir()}
    written = json.loads(found["compare.json"])
    del written["seconds"]
    return found | {"compare.json": written}


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles")
    shifts = {f"Shift{axis}": np.full(3000, 0.1) for axis in "XYZ"}
    write_las(folder / "cloud.las", bed(3000, 1, 0.05), **shifts)
    write_las(folder / "reference.las", bed(2500, 2))
    return folder


def test_comparison(clouds, monkeypatch):
    whole = figures(clouds, "whole")
    in_small_tiles(monkeypatch, 300, large=500)
    with threads(1):
        assert figures(clouds, "tiled") == whole
    in_small_tiles(monkeypatch, 170, large=500)
    assert figures(clouds, "small") == whole
    in_small_tiles(monkeypatch, 300, rows=400, large=500)  # sums of shorter blocks
    found = figures(clouds, "blocks")
    assert {name: found[name] for name in found if name.startswith("section")} == {
        name: whole[name] for name in whole if name.startswith("section")
    }
    flat, expected = (dict(leaves(one["compare.json"])) for one in (found, whole))
    assert flat.keys() == expected.keys()
    for name, value in expected.items():
        assert flat[name] == (pytest.approx(value, rel=1e-9) if isinstance(value, float) else value)
    assert sorted(p.name for p in clouds.iterdir()) == sorted(
        ["cloud.las", "reference.las", "whole", "tiled", "small", "blocks"]
    )


def leaves(value, name=""):
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, one in items:
            yield from leaves(one, f"{name}/{key}")
    else:
        yield name, value


def m3c2_twin(cloud, reference, core, normal_m, cylinder_m, reach_m):
    """Return M3C2 distances by the definition, every point of a cylinder looked at."""
    found = []
    for place in core:
        around = cloud[np.linalg.norm(cloud - place, axis=1) <= normal_m]
        normal = np.linalg.svd(around - around.mean(axis=0))[2][2]
        normal *= np.sign(normal[2])
        means = []
        for one in (cloud, reference):
            along = (one - place) @ normal
            across = np.linalg.norm(one - place - along[:, None] * normal, axis=1)
            inside = (across <= cylinder_m) & (np.abs(along) <= reach_m)
            means.append(along[inside].mean() if inside.any() else np.nan)
        found.append(means[0] - means[1])
    return np.array(found)


@py4dgeo
def test_m3c2():
    """Were the core point on the border of two pieces of the cylinder, one in two would be off."""
    cloud, reference = bed(1200, 1, 0.05), bed(900, 2)
    found = m3c2_distances(cloud, reference, 1.84)
    radii = found.normal_radius_m, found.cylinder_radius_m, found.max_distance_m
    expected = m3c2_twin(cloud, reference, cloud, *radii)
    expected = expected[np.isfinite(expected)]
    assert found.statistics.count == len(expected)
    assert found.statistics.mean_m == pytest.approx(expected.mean(), abs=1e-9)
    assert found.statistics.sd_m == pytest.approx(expected.std(), abs=1e-9)


def test_disk_after_errors(clouds, tmp_path, monkeypatch):
    """Arrays on disk are removed if the clouds do not overlap, or the disk is full."""
    monkeypatch.setattr(running, "LARGE", 500)
    far, summary = tmp_path / "far.las", tmp_path / "found.json"
    write_las(far, bed(1000, 3) + 5000.0)
    with refused("reference.no_overlap"):
        compare_clouds(clouds / "cloud.las", far, summary=summary)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full, raising=False)
    with pytest.raises(InputError):
        compare_clouds(clouds / "cloud.las", clouds / "reference.las", summary=summary)
    assert list(tmp_path.iterdir()) == [far]
