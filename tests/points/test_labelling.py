"""Connectivity and respected classes on shores with a known waterline."""

from functools import reduce
from operator import add
from types import SimpleNamespace

import numpy as np

from pcfix.options.shared import LandRules
from pcfix.points.labelling import Labelling, Part
from pcfix.water.surface import SurfaceAbove
from tests.utils.codes import refused

EAST, NORTH, WATER_M = 456_000.0, 5_432_000.0, 12.4


def part_of(xyz, classes=None, level=WATER_M):
    n = len(xyz)
    surface = SurfaceAbove(np.broadcast_to(level, n).astype(float), np.zeros((n, 2)))
    return Part(xyz, surface, np.zeros(n, np.uint8) if classes is None else classes)


def labelled(part, **choices):
    """Label a cloud in three chunks; return the classes and what was counted."""
    rows = np.array_split(np.arange(len(part.xyz)), 3)

    def parts():
        for r in rows:
            above = SurfaceAbove(part.surface.height_m[r], part.surface.slope[r])
            yield Part(part.xyz[r], above, part.classes[r])

    low, high = part.xyz[:, :2].min(axis=0), part.xyz[:, :2].max(axis=0)
    labelling = Labelling(LandRules(**choices)).scanned(parts(), low, high)
    labels = [labelling.labels(p) for p in parts()]
    counts = reduce(add, [one for _, one in labels])
    counted = SimpleNamespace(
        report=lambda: labelling.report(counts), check=lambda name: labelling.check(name, counts)
    )
    return np.concatenate([classes for classes, _ in labels]), counted


def beach(count=60_000, noise_m=0.03, seed=1):
    """Return a shore of 2 % with its waterline at 50 m, a berm, and a pit of 4 m behind it.

    Coordinates from the corner, true height above the water, and the cloud with noise.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 100, count), rng.uniform(0, 40, count)
    height = 0.02 * (x - 50.0) + 0.8 * np.exp(-(((x - 62.0) / 2.0) ** 2))
    height -= 1.2 * np.exp(-((x - 80.0) ** 2 + (y - 20.0) ** 2) / 16.0)
    z = WATER_M + height + rng.normal(0.0, noise_m, count)
    return x, y, height, np.column_stack([EAST + x, NORTH + y, z])


def test_surface_only():
    *_, xyz = beach(5000)
    level = np.full(5000, WATER_M)
    level[::7] = np.nan
    classes = np.random.default_rng(0).integers(0, 256, 5000).astype(np.uint8)
    found, labelling = labelled(part_of(xyz, classes, level))
    np.testing.assert_array_equal(found, np.where(xyz[:, 2] < level, 40, classes))
    assert labelling.report() is None


def test_connected():
    x, _, _, xyz = beach()
    pit = (x > 66.0) & (xyz[:, 2] < WATER_M)
    plain, _ = labelled(part_of(xyz))
    found, labelling = labelled(part_of(xyz), connected=True)
    assert (plain[pit] == 40).all()
    assert (found[x > 66.0] != 40).all()
    np.testing.assert_array_equal(found[x < 50.0], plain[x < 50.0])
    separate = labelling.report()["separate"]
    assert (separate["pools"], separate["points"]) == (1, (plain == 40).sum() - (found == 40).sum())

    channel = (np.abs(xyz[:, 1] - NORTH - 20.0) < 1.0) & (x > 40) & (x < 82)
    xyz[channel, 2] = WATER_M - 0.3
    found, labelling = labelled(part_of(xyz), connected=True)
    assert (found[(np.hypot(x - 80, xyz[:, 1] - NORTH - 20) < 2)] == 40).all()


def test_least_pool():
    x, _, _, xyz = beach()
    pit = np.hypot(x - 80.0, xyz[:, 1] - NORTH - 20.0) < 2.0
    assert (labelled(part_of(xyz), connected=True, least_pool=20.0)[0][pit] == 40).all()
    assert (labelled(part_of(xyz), connected=True, least_pool=60.0)[0][pit] != 40).all()
    # the largest stays whatever is asked for
    assert (labelled(part_of(xyz), connected=True, least_pool=1e9)[0][x < 42] == 40).all()
    two = np.abs(x - 25.0) > 6.0  # dry ground parts the sea in two of like size
    xyz[~two, 2] = WATER_M + 1.0
    assert (labelled(part_of(xyz), connected=True)[0][two & (x < 42)] == 40).all()


def test_respect_classes():
    *_, xyz = beach(20_000)
    classes = np.random.default_rng(0).choice([0, 2, 5, 40, 41], 20_000).astype(np.uint8)
    wet = xyz[:, 2] < WATER_M
    found, labelling = labelled(part_of(xyz, classes), respect_classes=(5, 2, 2))
    respected = np.isin(classes, (2, 5))
    np.testing.assert_array_equal(found, np.where(wet & ~respected, 40, classes))
    assert labelling.report()["respected"] == (wet & respected).sum()
    with refused("option.respect_classes", points=int(wet.sum())):
        labelled(part_of(xyz, classes), respect_classes=(0, 2, 5, 40, 41))[1].check("cloud")


def test_line_and_outlier():
    xyz = np.column_stack([EAST + np.arange(4000.0), np.full(4000, NORTH), np.full(4000, 12.0)])
    xyz[0, :2] += 4e6
    assert (labelled(part_of(xyz), connected=True, least_pool=1e5)[0][1:] == 40).all()
