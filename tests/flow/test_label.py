"""Labelling files: what is kept, what is said, and the same result through every door."""

import json

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.flow.label import label_file
from tests.pdal_stage.test_arrays import arrays_of, metadata_of, run
from tests.utils.clouds import (
    EAST_M,
    NORTH_M,
    WATER_M,
    block,
    cameras_csv,
    fields,
    read_raw,
    write_cloud,
)
from tests.utils.codes import refused
from tests.utils.program import run_pcfix

shapely = pytest.importorskip("shapely")


@pytest.fixture
def path(tmp_path):
    return write_cloud(tmp_path / "in.las", 7)


@pytest.fixture
def mask(tmp_path):
    """Return a lake with an island, in the CRS of `random_cloud`."""
    lake = shapely.box(EAST_M + 20, NORTH_M + 10, EAST_M + 90, NORTH_M + 100)
    island = shapely.box(EAST_M + 40, NORTH_M + 40, EAST_M + 60, NORTH_M + 70)
    return write_area(tmp_path / "lake.geojson", lake.difference(island))


def write_area(path, area):
    pytest.importorskip("pyogrio")
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    path.write_text(json.dumps({**shapely.geometry.mapping(area), "crs": crs}))
    return path


@pytest.mark.parametrize("point_format", [1, 3, 5, 6, 8, 10])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_rest_kept(tmp_path, mask, point_format, suffix):
    path = write_cloud(tmp_path / f"in{suffix}", point_format)
    target = tmp_path / f"out{suffix}"
    result = label_file(path, target, water=WATER_M, water_mask=mask)
    before, after = read_raw(path), read_raw(target)
    old, new = fields(before), fields(after)
    source = laspy.read(path)
    east, north = np.asarray(source.x) - EAST_M, np.asarray(source.y) - NORTH_M
    lake = (east >= 20) & (east <= 90) & (north >= 10) & (north <= 100)
    island = (east > 40) & (east < 60) & (north > 40) & (north < 70)
    wet = (np.asarray(source.z) < WATER_M) & lake & ~island
    assert after.version == (1, 4)
    assert result.submerged == wet.sum() > 100
    np.testing.assert_array_equal(new.pop("class"), np.where(wet, 40, old.pop("class")))
    for name in set(old) - {"angle"}:
        np.testing.assert_array_equal(new[name], old[name], name)
    ours = [r for r in after.records if r.user_id.startswith(b"pcfix")]
    assert [r.record_id for r in ours] == [3]
    recorded = json.loads(ours[0].data)
    assert recorded["water_mask"] == str(mask)
    assert recorded["water_plane"] == [WATER_M, 0.0, 0.0]


def test_corrected_and_restored(path, tmp_path):
    """The record of a labelling is not taken for one of a correction, nor the other way round."""
    label_file(path, tmp_path / "labelled.las", water=WATER_M)
    with refused("cloud.not_corrected"):
        pcfix.restore_file(tmp_path / "labelled.las", tmp_path / "no.las")
    given = {"cameras": block(), "water": WATER_M}
    pcfix.correct_file(tmp_path / "labelled.las", tmp_path / "corrected.las", **given)
    label_file(tmp_path / "corrected.las", tmp_path / "twice.las", water=WATER_M)
    pcfix.restore_file(tmp_path / "twice.las", tmp_path / "back.las")
    first, last = laspy.read(tmp_path / "labelled.las"), laspy.read(tmp_path / "back.las")
    np.testing.assert_array_equal(first.xyz, last.xyz)
    records = [v.record_id for v in laspy.read(tmp_path / "twice.las").vlrs if v.user_id == "pcfix"]
    assert records == [3, 1, 3]


CHOICES = [
    {},
    {"connected": True, "least_pool": 300.0},
    {"connected": True, "respect_classes": "2,5,6,7,8,9"},
]


@pytest.mark.parametrize("choices", CHOICES)
def test_label_doors(path, tmp_path, mask, choices, monkeypatch):
    las = laspy.read(path)
    words = ["--water", WATER_M, "--water-mask", mask]
    for name, value in choices.items():
        words += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
    summary = tmp_path / "s.json"
    done = run_pcfix("label", path, tmp_path / "a.las", *words, "--summary", summary)
    assert done.returncode == 0
    found = np.asarray(laspy.read(tmp_path / "a.las").classification)
    metadata = metadata_of(las.header)
    wkt = las.header.parse_crs().to_wkt()
    metadata["children"][0]["children"].append({"name": "comp_spatialreference", "value": wkt})
    outs, report = run(
        "label", arrays_of(las), metadata, water=WATER_M, water_mask=str(mask), **choices
    )
    np.testing.assert_array_equal(found, outs["Classification"])
    written = json.loads(summary.read_text())
    assert report["children"][0]["value"] == written["submerged"]
    assert written["submerged"] <= (found == 40).sum()
    assert written["labelling"]["outside_mask"] > 0
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", 333)
    label_file(path, tmp_path / "b.las", water=WATER_M, water_mask=mask, **choices)
    assert (tmp_path / "a.las").read_bytes() == (tmp_path / "b.las").read_bytes()


@pytest.mark.parametrize("choices", [{}, CHOICES[1], {"respect_classes": "1,2,3,4"}])
def test_corrects_what_is_labelled(path, tmp_path, mask, choices):
    cameras = cameras_csv(tmp_path / "cameras.csv", block())
    las = laspy.read(path)
    result = pcfix.correct_file(
        path, tmp_path / "a.las", cameras=cameras, water=WATER_M, water_mask=mask, max_angle=80.0,
        **choices,
    )  # fmt: skip
    out = laspy.read(tmp_path / "a.las")
    las.classification = np.where(las.classification == 40, 0, las.classification)
    las.write(tmp_path / "plain.las")
    given = {"water": WATER_M, "water_mask": mask, **choices}
    label_file(tmp_path / "plain.las", tmp_path / "labelled.las", **given)
    submerged = np.asarray(laspy.read(tmp_path / "labelled.las").classification) == 40
    arrays = pcfix.correct_points(
        las.xyz, pcfix.read_cameras(cameras), np.where(submerged, WATER_M, np.nan)
    )
    np.testing.assert_array_equal(arrays.corrected, np.asarray(out.RayCount) > 0)
    assert result.submerged == submerged.sum() == arrays.submerged.sum()
    assert 0 < result.submerged < (np.asarray(las.z) < WATER_M).sum()
    np.testing.assert_array_equal(out.xyz[~submerged], las.xyz[~submerged])


def test_masks_refused(path, tmp_path):
    elsewhere = {"bounds": (10.0, 20.0, 30.0, 40.0)}
    for area, code, values in (
        (shapely.Point(EAST_M, NORTH_M), "mask.no_area", {}),
        (shapely.box(10, 20, 30, 40), "mask.no_points", elsewhere),
    ):
        bad = write_area(tmp_path / "mask.geojson", area)
        with refused(code, **values):
            label_file(path, tmp_path / "out.las", water=WATER_M, water_mask=bad)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.las", "mask.geojson"]
