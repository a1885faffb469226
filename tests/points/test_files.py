"""Cleaning of files: nothing lost, the same result as with arrays, and restored corrections."""

import json
import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.flow.clean import clean_file
from pcfix.io.las.source import read_xyz
from pcfix.options.steps import CleanRules
from tests.points.scenes import reasons_of, spoilt_scene
from tests.utils.clouds import (
    WATER_M,
    RawLas,
    add_undescribed_bytes,
    block,
    fields,
    read_raw,
    write_cloud,
    write_las,
)
from tests.utils.codes import refused

MANY = {"deviations": 0.5, "fences": 0.2}  # on a cloud of white noise, a third of the points
OURS = (b"pcfix", 2)


def _before(raw: RawLas) -> np.ndarray:
    """Points that were withheld or noise already."""
    whole = fields(raw)
    return (whole["withheld"] != 0) | np.isin(whole["class"], (7, 18))


def _assert_nothing_lost(before: RawLas, after: RawLas, noise: np.ndarray) -> None:
    """All is as it was but for class and withheld flag of the noise."""
    old, new = fields(before), fields(after)
    old["class"] = np.where(noise, 7, old["class"])
    old["withheld"] = np.where(noise, 1, old["withheld"])
    if before.point_format < 6:
        old["angle"] = np.rint(old["angle"] / 0.006)
    for name, values in old.items():
        assert np.array_equal(new[name], values), name
    assert (after.scales, after.offsets) == (before.scales, before.offsets)
    records = [r for r in after.foreign() if r.kind != OURS]
    foreign_records = [r for r in records if r in before.foreign()]
    assert foreign_records == before.foreign()
    assert {r.kind for r in records if r not in foreign_records} <= {(b"LASF_Projection", 2112)}
    assert after.extended == before.extended
    assert after.extra_bytes()[: len(before.extra_bytes())] == before.extra_bytes()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_nothing_is_lost(tmp_path: Path, point_format: int, suffix: str) -> None:
    source = write_cloud(tmp_path / f"in{suffix}", point_format)
    target = tmp_path / f"out{suffix}"
    result = clean_file(source, target, water=WATER_M, **MANY)
    before, after = read_raw(source), read_raw(target)
    aside = _before(before)
    rules = CleanRules(**MANY)
    noise = reasons_of(read_xyz(source), water=WATER_M, used=~aside, rules=rules) != 0
    assert 100 < result.noise == noise.sum()
    assert not (noise & aside).any()
    assert (after.version, after.point_format >= 6) == ((1, 4), True)
    _assert_nothing_lost(before, after, noise)
    assert result.set_aside == aside.sum()
    if point_format == 6 and suffix == ".las":
        source = add_undescribed_bytes(write_cloud(tmp_path / "u.las", 6, plain=True), 5)
        clean_file(source, tmp_path / "v.las", water=WATER_M, **MANY)
        old, new = read_raw(source), read_raw(tmp_path / "v.las")
        assert np.array_equal(old.points[:, -5:], new.points[:, -5:])


def test_drop(tmp_path: Path) -> None:
    source = write_cloud(tmp_path / "in.laz", 7)
    clean_file(source, tmp_path / "flagged.laz", water=WATER_M, **MANY)
    result = clean_file(source, tmp_path / "out.laz", water=WATER_M, **MANY, drop=True)
    before, flagged = read_raw(source), read_raw(tmp_path / "flagged.laz")
    noise = (_before(flagged)) & ~_before(before)
    after = read_raw(tmp_path / "out.laz")
    assert np.array_equal(after.points, before.points[~noise])
    assert result.dropped == result.noise == noise.sum() > 0
    assert struct.unpack_from("<Q", after.header, 247)[0] == len(after.points)


def test_record(tmp_path: Path) -> None:
    s = spoilt_scene(20_000, 100)
    source = write_las(tmp_path / "in.las", s.xyz, crs=None)
    result = clean_file(source, tmp_path / "out.las", water=s.water_level_m)
    (record,) = [r for r in read_raw(tmp_path / "out.las").records if r.kind == OURS]
    recorded = json.loads(record.data)
    assert (recorded["settings"], recorded["reasons"]) == (result.settings, result.reasons)
    assert (recorded["pcfix"], recorded["drop"]) == (pcfix.__version__, False)
    assert len(result.not_run) == 1
    clean_file(tmp_path / "out.las", tmp_path / "twice.las", water=s.water_level_m)
    records = [r for r in read_raw(tmp_path / "twice.las").records if r.kind == OURS]
    assert len(records) == 2
    assert records[0] == record
    dry = clean_file(source, tmp_path / "dry.las")  # the bed too
    assert len(dry.not_run) == 2
    assert dry.reasons["statistical"] > 0
    # noise in the input is not tested again, and no neighbour
    first, second = (read_raw(tmp_path / name) for name in ("out.las", "twice.las"))
    aside = _before(first)
    again = reasons_of(s.xyz.round(3), water=s.water_level_m, used=~aside) != 0
    assert np.array_equal(_before(second), aside | again)


def test_restore_after_cleaning(tmp_path: Path) -> None:
    source = write_cloud(tmp_path / "in.laz", 1)
    steps = [tmp_path / name for name in ("corrected.laz", "cleaned.laz", "restored.laz")]
    cameras = block()
    pcfix.correct_file(source, steps[0], cameras=cameras, water=WATER_M)
    result = clean_file(steps[0], steps[1], **MANY)
    assert result.not_run == []
    assert result.reasons["below_bed"] > 0
    pcfix.restore_file(steps[1], steps[2])
    before, after = read_raw(source), read_raw(steps[2])
    noise = _before(read_raw(steps[1])) & ~_before(read_raw(steps[0]))
    assert noise.sum() == result.noise > 100
    old, new = fields(before), fields(after)
    for name, values in old.items():
        rows = ~noise if name in ("class", "withheld") else slice(None)
        assert np.array_equal(new[name][rows], values[rows]), name
    assert after.version == before.version
    assert after.point_format == before.point_format
    assert [r for r in after.foreign() if r.kind != OURS] == before.foreign()
    # cleaned first, then corrected: the cleaned cloud
    clean_file(source, tmp_path / "a.las", water=WATER_M, **MANY)
    pcfix.correct_file(tmp_path / "a.las", tmp_path / "b.las", cameras=cameras, water=WATER_M)
    pcfix.restore_file(tmp_path / "b.las", tmp_path / "c.las")
    assert (tmp_path / "c.las").read_bytes() == (tmp_path / "a.las").read_bytes()


def test_refused_files(tmp_path: Path) -> None:
    s = spoilt_scene(20_000, 100)
    good = write_las(tmp_path / "good.las", s.xyz, crs=None)
    few = write_las(tmp_path / "few.las", s.xyz[:5], crs=None)
    las = laspy.read(good)
    las.classification[:] = 18
    las.write(tmp_path / "noise.las")
    (tmp_path / "cut.las").write_bytes(good.read_bytes()[:-500])
    before = sorted(p.name for p in tmp_path.iterdir())
    out = tmp_path / "out.las"
    with refused("cloud.too_few_points", points=5):
        clean_file(few, out)
    with refused("cloud.all_withheld", points=len(s.xyz)):
        clean_file(tmp_path / "noise.las", out)
    with refused("water.below_cloud"):
        clean_file(good, out, water=-500.0)
    with refused("cloud.damaged"):
        clean_file(tmp_path / "cut.las", out)
    with refused("cloud.no_dimension"):
        clean_file(good, out, water="dim:Level")
    assert sorted(p.name for p in tmp_path.iterdir()) == before
