"""Tide tables, the times of images, and the water level of each."""

import warnings

import numpy as np
import pytest
from PIL import Image

from pcfix.io.photographs import read_image_times
from pcfix.io.water import level_offsets, read_tide
from tests.utils.codes import refused

pytestmark = pytest.mark.quick_but("test_exif")

TIDE = """time,level_m
2026-05-01T10:00:00Z,1.00
2026-05-01T10:30:00Z,1.30
2026-05-01T11:00:00Z,1.40
"""
NOON_S = 1_777_636_800.0  # 2026-05-01T12:00:00Z


def table(tmp_path, text, name="tide.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def times_of(tmp_path, *times):
    labels = [f"IMG_{i}" for i in range(len(times))]
    rows = [f"{label}.JPG,{time}" for label, time in zip(labels, times, strict=True)]
    path = table(tmp_path, "\n".join(["label,time", *rows]) + "\n", "times.csv")
    return read_image_times(path, labels), labels


def test_zones_and_spellings(tmp_path):
    words = [
        "2026-05-01T12:00:00Z", "2026-05-01T12:00:00+00:00", "2026-05-01 14:00:00+02:00",
        "2026:05:01 05:00:00.0-07:00", "20260501T120000Z", "2026-05-01T12:00Z",
    ]  # fmt: skip
    times, _ = times_of(tmp_path, *words)
    assert times.zoned
    assert times.time_s.tolist() == [NOON_S] * len(words)


@pytest.mark.parametrize(
    ("text", "times", "level", "codes"),
    [
        (TIDE, ("T10:15:00Z", "T12:45:00+02:00", "T10:30:00Z"), (1.15, 1.35, 1.30), []),
        (TIDE.replace("Z", ""), ("T10:00:00", "T10:30:00"), (1.0, 1.3), []),
        (TIDE.replace("T11", "T16"), ("T10:15Z", "T13:15:00Z"), (1.15, 1.35), ["tide.sparse"]),
    ],
)
def test_offsets(tmp_path, text, times, level, codes):
    tide, heights = read_tide(table(tmp_path, text))
    found, labels = times_of(tmp_path, *(f"2026-05-01{time}" for time in times))
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        offset = level_offsets(tide, heights, found, labels)
    assert offset == pytest.approx(np.array(level) - np.mean(level), abs=1e-9)
    assert [note.message.code for note in notes] == codes


def test_table_that_does_not_fit(tmp_path):
    tide, level = read_tide(table(tmp_path, TIDE))
    late = times_of(tmp_path, "2026-05-01T10:00:00Z", "2026-05-01T11:00:01Z")
    with refused("tide.not_covered", path=tide.name, image="IMG_1", count=1):
        level_offsets(tide, level, *late)
    local = times_of(tmp_path, "2026-05-01T10:00:00", "2026-05-01T10:30:00")
    with refused("time.zone", path=tmp_path / "times.csv"):
        level_offsets(tide, level, *local)


@pytest.mark.parametrize(
    ("text", "code", "values"),
    [
        ("time,level_ft\n2026-05-01T10:00:00Z,1\n", "table.column_missing", {}),
        (TIDE.replace("1.30", "high"), "table.number", {"line": 3, "value": "high"}),
        (TIDE.replace("2026-05-01T10:30:00Z", "half ten"), "time.format", {"value": "half ten"}),
        (TIDE.replace("10:30:00Z", "10:30:00"), "time.zone", {"value": "2026-05-01T10:30:00"}),
        (TIDE.replace("T10:30", "T10:00"), "tide.order", {"line": 3}),
        ("time,level_m\n2026-05-01T10:00:00Z,1\n", "tide.one_row", {}),
    ],
)
def test_bad_tides(tmp_path, text, code, values):
    with refused(code, path=tmp_path / "tide.csv", **values):
        read_tide(table(tmp_path, text))


def photo(path, **tags):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({int(k[1:], 16): v for k, v in tags.items()})
    Image.new("RGB", (8, 6)).save(path, exif=exif)


def test_exif(tmp_path):
    with refused("image_times.missing"):
        read_image_times(tmp_path, ["one"])
    (tmp_path / "a").mkdir()
    when = "2026:05:01 14:00:00"
    photo(tmp_path / "a" / "one.jpg", x9003=when, x9011="+02:00", x9291="50")
    photo(tmp_path / "two.JPG", x9003=when, x9011="+01:00")
    times = read_image_times(tmp_path, ["one", "two"])
    assert times.zoned
    assert times.time_s.tolist() == [NOON_S + 0.5, NOON_S + 3600.0]
    photo(tmp_path / "three.jpg", x9003=when)
    assert not read_image_times(tmp_path, ["three"]).zoned
    with refused("time.zone", value=when):
        read_image_times(tmp_path, ["one", "three"])
    Image.new("RGB", (8, 6)).save(tmp_path / "four.jpg")
    with refused("image_times.missing", path=tmp_path / "four.jpg"):
        read_image_times(tmp_path, ["four"])
    (tmp_path / "five.jpg").write_text("no image")
    with refused("photos.unreadable", path=tmp_path / "five.jpg"):
        read_image_times(tmp_path, ["five"])
