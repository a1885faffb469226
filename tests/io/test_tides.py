"""Tide tables, the times of images, and the level that each image saw."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import pcfix
from pcfix.flow.inputs import Inputs
from pcfix.io.scenes import write_scene
from pcfix.io.tides import ImageTimes, TideTable, level_offsets, read_image_times, read_tide
from tests.utils.shared import needs

ODM, odm = needs("cameras/odm/testerarm_sub0")

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


def times_of(tmp_path, *times, labels=None, name="times.csv"):
    labels = labels or [f"IMG_{i}" for i in range(len(times))]
    rows = [f"{label}.JPG,{time}" for label, time in zip(labels, times, strict=True)]
    path = table(tmp_path, "\n".join(["label,time", *rows]) + "\n", name)
    return read_image_times(path, labels), labels


def test_offsets_are_linear_in_time_and_have_no_mean(tmp_path):
    tide = read_tide(table(tmp_path, TIDE))
    times, labels = times_of(
        tmp_path, "2026-05-01T10:15:00Z", "2026-05-01T12:45:00+02:00", "2026-05-01T10:30:00Z"
    )
    offset, notes = level_offsets(tide, times, labels)
    level = np.array([1.15, 1.35, 1.30])
    assert offset == pytest.approx(level - level.mean(), abs=1e-9)
    assert notes == ()


def test_zones_and_spellings_are_one_moment(tmp_path):
    words = [
        "2026-05-01T12:00:00Z", "2026-05-01T12:00:00+00:00", "2026-05-01 14:00:00+02:00",
        "2026:05:01 05:00:00.0-07:00", "20260501T120000Z", "2026-05-01T12:00Z",
    ]  # fmt: skip
    times, _ = times_of(tmp_path, *words)
    assert times.zoned
    assert times.time_s.tolist() == [NOON_S] * len(words)


@given(shift=st.floats(-5, 5), share=st.lists(st.floats(0, 1), min_size=2, max_size=9))
def test_the_gauge_may_count_from_anywhere(shift, share):
    at, labels = np.linspace(0.0, 44_712.0, 60), [str(i) for i in range(len(share))]
    level = np.sin(at / 44_712.0 * 2.0 * math.pi)
    times = ImageTimes(np.array(share) * at[-1], True, "images")
    one, _ = level_offsets(TideTable(at, level, True, "tide"), times, labels)
    other, _ = level_offsets(TideTable(at, level + shift, True, "tide"), times, labels)
    assert one == pytest.approx(other, abs=1e-12)
    # of a sine over steps of 12.6 min the chord is at most (2 pi / 59)^2 / 8 = 1.4 mm off
    true = np.sin(times.time_s / 44_712.0 * 2.0 * math.pi)
    assert one == pytest.approx(true - true.mean(), abs=0.003)


def test_one_row_beyond_the_ends_and_no_more(tmp_path):
    tide = read_tide(table(tmp_path, TIDE))
    times, labels = times_of(tmp_path, "2026-05-01T09:30:00Z", "2026-05-01T11:30:00Z")
    offset, notes = level_offsets(tide, times, labels)
    assert offset == pytest.approx([-0.4, 0.4], abs=1e-9)  # levels 0.70 and 1.50
    assert "2 images were taken before its first or after its last row" in notes[0]
    late, labels = times_of(tmp_path, "2026-05-01T10:00:00Z", "2026-05-01T11:30:01Z")
    with pytest.raises(
        pcfix.InputError,
        match=r"covers 2026-05-01 10:00:00 UTC to 2026-05-01 11:00:00 UTC, but image IMG_1 was"
        r" taken at 2026-05-01 11:30:01 UTC \(1 of 2 images are outside\)",
    ):
        level_offsets(tide, late, labels)


def test_rows_far_apart_are_said(tmp_path):
    sparse = TIDE.replace("T11:00", "T16:30")
    times, labels = times_of(tmp_path, "2026-05-01T10:15:00Z", "2026-05-01T12:00:00Z")
    _, notes = level_offsets(read_tide(table(tmp_path, sparse)), times, labels)
    assert "rows are 6.0 h apart" in notes[0]


def test_local_times_on_both_sides(tmp_path):
    tide = read_tide(table(tmp_path, TIDE.replace("Z", "")))
    times, labels = times_of(tmp_path, "2026-05-01T10:00:00", "2026-05-01T10:30:00")
    assert not tide.zoned
    assert level_offsets(tide, times, labels)[0] == pytest.approx([-0.15, 0.15])


def test_zones_on_one_side_are_refused(tmp_path):
    times, labels = times_of(tmp_path, "2026-05-01T10:00:00", "2026-05-01T10:30:00")
    with pytest.raises(pcfix.InputError, match=r"times.csv: times have no zone, those of .*tide"):
        level_offsets(read_tide(table(tmp_path, TIDE)), times, labels)
    with pytest.raises(pcfix.InputError, match=r"line 3: '2026-05-01T10:30:00' has no zone"):
        times_of(tmp_path, "2026-05-01T10:00:00Z", "2026-05-01T10:30:00")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,level_ft\n2026-05-01T10:00:00Z,1\n", "level_m missing"),
        (TIDE.replace("1.30", "high"), r"line 3, column level_m: 'high' is not a finite number"),
        (TIDE.replace("2026-05-01T10:30:00Z", "half ten"), r"line 3: 'half ten' is not a date"),
        (TIDE.replace("2026-05-01T10:30:00Z", "2026-05-01"), r"'2026-05-01' is not a date with"),
        (TIDE.replace("T10:30", "T10:00"), "line 3: the time is not later than the one before"),
        ("time,level_m\n2026-05-01T10:00:00Z,1\n", "has one row"),
    ],
)
def test_a_table_that_is_no_tide(tmp_path, text, message):
    with pytest.raises(pcfix.InputError, match=message):
        read_tide(table(tmp_path, text))


def test_labels_are_found_without_folder_and_extension(tmp_path):
    path = table(tmp_path, "label,time\nday1/A.JPG,2026-05-01T10:00Z\nb,2026-05-01T11:00Z\n")
    times = read_image_times(path, ["B.tif", "C:\\flight\\a"])
    assert times.time_s.tolist() == [NOON_S - 3600.0, NOON_S - 7200.0]
    with pytest.raises(pcfix.InputError, match=r"when image c was taken \(1 of 2 images"):
        read_image_times(path, ["a", "c"])
    table(tmp_path, path.read_text() + "day2/A.JPG,2026-05-01T10:00Z\n")
    with pytest.raises(pcfix.InputError, match="when image a was taken"):
        read_image_times(table(tmp_path, path.read_text() + "d2/A.JPG,2026-05-01T10:00Z\n"), ["a"])


def photo(path, **tags):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({int(k[1:], 16): v for k, v in tags.items()})
    Image.new("RGB", (8, 6)).save(path, exif=exif)


def test_times_from_the_images(tmp_path):
    (tmp_path / "a").mkdir()
    when = "2026:05:01 14:00:00"
    photo(tmp_path / "a" / "one.jpg", x9003=when, x9011="+02:00", x9291="50")
    photo(tmp_path / "two.JPG", x9003=when, x9011="+01:00")
    times = read_image_times(tmp_path, ["one", "two"])
    assert times.zoned
    assert times.time_s.tolist() == [NOON_S + 0.5, NOON_S + 3600.0]
    photo(tmp_path / "three.jpg", x9003=when)
    assert not read_image_times(tmp_path, ["three"]).zoned
    with pytest.raises(pcfix.InputError, match=r"image three.jpg: '2026:05:01 14:00:00' has no"):
        read_image_times(tmp_path, ["one", "three"])


def test_images_that_do_not_say(tmp_path):
    with pytest.raises(pcfix.InputError, match="holds no images"):
        read_image_times(tmp_path, ["a"])
    Image.new("RGB", (8, 6)).save(tmp_path / "a.jpg")
    with pytest.raises(pcfix.InputError, match="its EXIF data has no DateTimeOriginal"):
        read_image_times(tmp_path, ["a"])
    (tmp_path / "b.jpg").write_text("no image")
    with pytest.raises(pcfix.InputError, match=r"b.jpg: is not an image that can be read"):
        read_image_times(tmp_path, ["b"])


LAYOUTS = {
    "images.json": [{"filename": "a.jpg", "utc_time": 1000.0 * NOON_S}],
    "shots.geojson": {
        "features": [{"properties": {"filename": "a.jpg", "capture_time": NOON_S}}]
    },
    "reconstruction.json": [{"shots": {"a.jpg": {"capture_time": NOON_S}}}],
}  # fmt: skip


@pytest.mark.parametrize("name", LAYOUTS)
def test_times_that_the_software_kept(tmp_path, name):
    path = table(tmp_path, json.dumps(LAYOUTS[name]), name)
    times = read_image_times(path, ["a"])
    assert (times.time_s.tolist(), times.zoned) == ([NOON_S], True)
    nought = path.read_text().replace(str(1000.0 * NOON_S), "0").replace(str(NOON_S), "0")
    with pytest.raises(pcfix.InputError, match=r"does not say when image a.jpg was taken"):
        read_image_times(table(tmp_path, nought, name), ["a"])


@pytest.mark.parametrize("text", ["{", "[1, 2]", '{"features": [{}]}', "[]"])
def test_json_that_holds_no_times(tmp_path, text):
    with pytest.raises(pcfix.InputError, match=r"t.json: (is not a file of|has no times)"):
        read_image_times(table(tmp_path, text, "t.json"), ["a"])


@odm
def test_one_project_says_the_same_twice():
    labels = list(json.loads((ODM / "opensfm/reconstruction.json").read_text())[0]["shots"])
    names = ("images.json", "opensfm/reconstruction.json")
    one, other = (read_image_times(ODM / name, labels).time_s for name in names)
    assert one == pytest.approx(other, abs=1.0)  # whole seconds, or parts of them
    with pytest.raises(pcfix.InputError, match="does not say when image"):
        read_image_times(ODM / "odm_report/shots.geojson", labels)  # of that version


# Through the inputs of a correction


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_scene(pcfix.simulate_scene(500, seed=3), folder, overwrite=False)
    return folder


def test_inputs_give_each_camera_its_level(scene, tmp_path):
    cameras = pcfix.read_cameras(scene / "cameras.csv")
    minutes = np.linspace(0, 59, len(cameras)).astype(int)
    rows = [
        f"{label},2026-05-01T10:{m:02d}:00Z"
        for label, m in zip(cameras.labels, minutes, strict=True)
    ]
    times = table(tmp_path, "\n".join(["label,time", *rows]) + "\n", "times.csv")
    tide = table(tmp_path, TIDE)
    inputs = Inputs(cameras=scene / "cameras.csv", water=0.37, tide=tide, image_times=times)
    level = np.interp(minutes, [0, 30, 60], [1.0, 1.3, 1.4])
    assert inputs.level_offset_m(cameras) == pytest.approx(level - level.mean(), abs=1e-9)
    assert {tide, times} <= set(inputs.paths())


def test_inputs_that_lack_times_or_a_tide(scene, tmp_path):
    cameras, tide = pcfix.read_cameras(scene / "cameras.csv"), table(tmp_path, TIDE)
    assert Inputs(cameras=cameras, water=0.37).level_offset_m(cameras) is None
    with pytest.raises(pcfix.SettingError, match="a tide needs image-times"):
        Inputs(cameras=cameras, water=0.37, tide=tide).level_offset_m(cameras)
    with pytest.raises(pcfix.SettingError, match="image-times is of no use without tide"):
        Inputs(cameras=cameras, water=0.37, image_times=tide).level_offset_m(cameras)
    with pytest.raises(pcfix.InputError, match="must name the columns label, time"):
        Inputs(cameras=scene / "cameras.csv", water=0.37, tide=tide).level_offset_m(cameras)
