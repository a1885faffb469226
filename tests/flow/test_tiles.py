"""Many files as one cloud: the same points, the same figures, and what cannot be done."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields

import laspy
import numpy as np
import pytest
import rasterio

import pcfix
from pcfix.io.tiles import tiles_of
from pcfix.options.correct import CorrectOptions
from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix
from tests.utils.tiles import SCENE, cut, finished, records, write

CAMERAS = SCENE / "cameras.csv"
WORDS = ("--cameras", CAMERAS, "--water", "0.37")
PLAIN = {"method": "snell", "dimensions": "minimal"}
"""A correction that weighs nothing: for tests of files."""
PLAIN_WORDS = [word for name, value in PLAIN.items() for word in (f"--{name}", value)]
OWN = ("input", "output", "seconds", "points_per_s")
"""Figures of a summary that are those of a call."""


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """Return a folder with four tiles, and their points in one file."""
    return cut(tmp_path_factory.mktemp("cloud") / "tiles", 4)


@pytest.fixture(scope="module")
def corrected(cloud, tmp_path_factory):
    """Return the merged cloud corrected, and the tiles, by the default method."""
    folder = tmp_path_factory.mktemp("corrected")
    given = {"cameras": CAMERAS, "water": 0.37}
    one = pcfix.correct_file(cloud[1], folder / "merged.las", **given)
    many = pcfix.correct_file(cloud[0], folder / "tiles", jobs=1, **given)
    return folder, one, many


def figures(summary):
    return {name: value for name, value in summary.as_dict().items() if name not in OWN}


def tiles_in(folder):
    return sorted(folder.glob("*.la[sz]"))


def test_the_default_method_learns_of_all_tiles_as_of_one_cloud(corrected):
    folder, one, many = corrected
    assert one.made["method"] == "consistent"
    assert np.array_equal(records(*tiles_in(folder / "tiles")), records(folder / "merged.las"))
    assert figures(one) == figures(many)


@pytest.mark.parametrize(("count", "jobs"), mostly_nightly(((3, 2), (2, 1)), (3, 2)))
def test_neither_the_number_of_tiles_nor_of_jobs_counts(count, jobs, tmp_path):
    folder, merged = cut(tmp_path / "tiles", count)
    given = {"cameras": CAMERAS, "water": 0.37, "method": "snell", "uncorrected": "drop"}
    one = pcfix.correct_file(merged, tmp_path / "merged.las", max_angle=10, **given)
    many = pcfix.correct_file(folder, tmp_path / "out", max_angle=10, jobs=jobs, **given)
    assert 0 < one.dropped < one.submerged
    assert np.array_equal(records(*tiles_in(tmp_path / "out")), records(tmp_path / "merged.las"))
    assert figures(one) == figures(many)


def test_a_view_list_counts_the_rows_of_all_tiles(tmp_path):
    from pcfix.io.scenes import write_scene

    write_scene(pcfix.simulate_scene(3000, cloud="depth-maps"), tmp_path / "s", overwrite=False)
    folder, merged = cut(tmp_path / "tiles", 2, cloud=tmp_path / "s" / "cloud.laz")
    given = {"cameras": tmp_path / "s" / "cameras.csv", "water": 0.37}
    given["views"] = tmp_path / "s" / "dense.ply"
    one = pcfix.correct_file(merged, tmp_path / "merged.las", **given)
    many = pcfix.correct_file(folder, tmp_path / "out", **given)
    assert many.made == one.made
    names = ("by_row", "by_position", "unmatched", "entries", "distance_95_m")
    assert [many.views[name] for name in names] == [one.views[name] for name in names]
    here, there = records(tmp_path / "merged.las"), records(*tiles_in(tmp_path / "out"))
    # the depth maps about a point are those of its chunk: to the last digit for nearly all
    assert np.mean(here["Z"] != there["Z"]) < 0.02
    assert np.abs(here["Z"] - there["Z"]).max() <= 5


def test_a_shoreline_is_that_of_one_cloud(cloud, tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    given = {"cameras": CAMERAS, "water": 0.37, **PLAIN}
    pcfix.correct_file(cloud[1], tmp_path / "a.las", shoreline=tmp_path / "a.gpkg", **given)
    pcfix.correct_file(cloud[0], tmp_path / "b", shoreline=tmp_path / "b.gpkg", **given)
    one, many = (pyogrio.raw.read(tmp_path / f"{name}.gpkg") for name in "ab")
    assert len(one[2]) > 0
    assert list(one[2]) == list(many[2])


def test_restored_tiles_are_the_inputs(cloud, corrected, tmp_path):
    points = pcfix.restore_file(corrected[0] / "tiles", tmp_path / "back")
    assert points == 20_000
    for path in tiles_in(cloud[0]):
        assert np.array_equal(records(path), records(tmp_path / "back" / path.name))


def test_labels_by_the_surroundings_do_not_end_at_a_tile(cloud, tmp_path):
    given = {"water": 0.37, "connected": True, "dead_band": 0.3, "band": 0.05}
    one = pcfix.label_file(cloud[1], tmp_path / "merged.las", **given)
    many = pcfix.label_file(cloud[0], tmp_path / "out", **given)
    assert np.array_equal(records(*tiles_in(tmp_path / "out")), records(tmp_path / "merged.las"))
    assert figures(one) == figures(many)


def test_one_raster_is_made_of_many_tiles(corrected, tmp_path):
    folder = corrected[0]
    one = pcfix.grid_dsm(folder / "merged.las", tmp_path / "one.tif", method="tin")
    many = pcfix.grid_dsm(folder / "tiles", tmp_path / "many.tif", method="tin")
    with rasterio.open(tmp_path / "one.tif") as a, rasterio.open(tmp_path / "many.tif") as b:
        assert a.profile == b.profile
        assert np.array_equal(a.read(), b.read())
    assert figures(one) == figures(many)


def index_of(folder, paths):
    """Write a virtual point cloud, as STAC items with relative links."""
    items = [
        {"type": "Feature", "id": path.stem, "assets": {"data": {"href": f"./tiles/{path.name}"}}}
        for path in paths
    ]
    path = folder / "index.vpc"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": items}))
    return path


def test_a_folder_a_glob_a_list_and_an_index_name_the_same_files(cloud):
    folder = cloud[0]
    paths = tuple(tiles_in(folder))
    (folder.parent / "list.txt").write_text(
        "# tiles\n\n" + "\n".join(f"tiles/{path.name}" for path in paths)
    )
    index = index_of(folder.parent, paths)
    for given in (folder, f"{folder}/*.laz", folder.parent / "list.txt", index, paths):
        assert [one.resolve() for one in tiles_of(given).paths] == list(paths)
    assert tiles_of(cloud[1]) is None


def test_a_second_call_does_only_what_is_not_finished(cloud, tmp_path):
    given = {"cameras": CAMERAS, "water": 0.37, **PLAIN}
    first = pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    paths = tiles_in(tmp_path / "out")
    before = [path.stat().st_mtime_ns for path in paths]
    again = pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    assert again == first
    paths[1].unlink()
    paths[2].write_bytes(paths[2].read_bytes()[:-1])  # not as it was left
    with pytest.raises(pcfix.SettingError, match=r"tile2\.laz: the output exists"):
        pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    third = pcfix.correct_file(cloud[0], tmp_path / "out", overwrite=True, **given)
    after = [path.stat().st_mtime_ns for path in paths]
    assert [a == b for a, b in zip(after, before, strict=True)] == [True, False, False, True]
    assert figures(third) == figures(first)
    with pytest.raises(pcfix.SettingError, match="the output exists"):  # other options
        pcfix.correct_file(cloud[0], tmp_path / "out", **{**given, "index": 1.33})


def test_contents_count_not_times(cloud, tmp_path):
    given = {"water": 0.37, "overwrite": True}
    folder, _ = cut(tmp_path / "tiles", 2, suffix=".las")
    pcfix.label_file(folder, tmp_path / "out", **given)
    written = (tmp_path / "out" / "tile0.las").stat().st_mtime_ns
    path = folder / "tile1.las"
    state = path.stat()
    las = laspy.read(path)
    las.classification[0] = 2
    las.write(path)
    assert path.stat().st_size == state.st_size
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    pcfix.label_file(folder, tmp_path / "out", **given)
    assert (tmp_path / "out" / "tile0.las").stat().st_mtime_ns > written


def test_a_broken_tile_does_not_stop_the_others(tmp_path):
    folder, _ = cut(tmp_path / "tiles", 3, suffix=".las")
    whole = (folder / "tile1.las").read_bytes()
    (folder / "tile1.las").write_bytes(whole[: len(whole) // 2])
    (folder / "tile3.las").write_bytes(b"no cloud")
    done = run_pcfix("correct", folder, tmp_path / "out", *WORDS, *PLAIN_WORDS)
    assert done.returncode == 1
    head, *failures = done.stderr.splitlines()
    assert "2 of 4 files failed, the others are finished" in head
    assert "tile3.las: is damaged" in failures[0]
    assert "tile1.las: is cut short: the header promises" in failures[1]
    assert [path.name for path in tiles_in(tmp_path / "out")] == ["tile0.las", "tile2.las"]
    (folder / "tile3.las").unlink()
    listed = folder.parent / "list.txt"
    listed.write_text("tiles/tile0.las\ntiles/tile3.las")
    done = run_pcfix("label", listed, tmp_path / "labels", "--water", "0.37")
    assert done.stderr.splitlines()[1:] == ["  tiles/tile3.las: there is no such file."]
    (folder / "tile1.las").write_bytes(whole)
    done = run_pcfix("correct", folder, tmp_path / "out", *WORDS, *PLAIN_WORDS, "--overwrite")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(records(*tiles_in(tmp_path / "out"))) == 20_000


def test_a_full_disk_leaves_nothing_half_written(cloud, tmp_path, monkeypatch):
    from pcfix.flow import tiles
    from pcfix.io.las import writing

    wrote = writing.LasSink.write

    def full(sink, points):
        wrote(sink, points)
        if sink._path.name == "tile2.laz":
            with sink._write_errors():
                raise OSError(28, "No space left on device")

    given = {"cameras": CAMERAS, "water": 0.37, "jobs": 1, **PLAIN}
    wrote_record = tiles.write_counted

    def full_for_records(path, note, counted):
        if path.name == "tile1.laz.npz" and note["output"]:
            raise pcfix.InputError(f"{path}: cannot be written (No space left on device).")
        wrote_record(path, note, counted)

    monkeypatch.setattr(writing.LasSink, "write", full)
    monkeypatch.setattr(tiles, "write_counted", full_for_records)
    with pytest.raises(pcfix.InputError, match="2 of 4 files failed") as error:
        pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    assert "tile2.laz: cannot be written" in str(error.value)
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert left == {".pcfix", "tile0.laz", "tile1.laz", "tile3.laz"}
    monkeypatch.undo()
    pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    assert len(tiles_in(tmp_path / "out")) == 4


def test_a_result_that_cannot_be_right_leaves_nothing(cloud, tmp_path):
    with pytest.raises(pcfix.GeometryError, match="no point lies below the water"):
        pcfix.correct_file(cloud[0], tmp_path / "out", cameras=CAMERAS, water=-50.0, method="snell")
    assert tiles_in(tmp_path / "out") == []


def test_ctrl_c_is_a_clean_stop_and_the_same_command_goes_on(tmp_path):
    """In processes of its own, as only these are interrupted as a terminal does it."""
    folder, _ = cut(tmp_path / "tiles", 16)
    out, words = tmp_path / "out", ["--jobs", "2", *PLAIN_WORDS, *map(str, WORDS)]
    command = [sys.executable, "-m", "pcfix", "correct", str(folder), str(out), *words]
    running = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    until = time.monotonic() + 120
    while len(finished(out)) < 2 and time.monotonic() < until:
        time.sleep(0.02)
    os.killpg(running.pid, signal.SIGINT)
    _, error = running.communicate(timeout=60)
    assert running.returncode == 130
    assert error.splitlines()[-1].startswith("pcfix: stopped; ")
    assert "Traceback" not in error
    before = finished(out)
    assert 2 <= len(before) < 16
    assert not list(out.glob(".*.part*"))
    done = run_pcfix("correct", folder, out, "--jobs", "1", *words[2:])
    assert done.returncode == 0, done.stderr
    assert len(tiles_in(out)) == 16
    assert before.items() <= finished(out).items()


def other(folder, name, **how):
    """Write a tile that differs."""
    las = laspy.read(SCENE / "cloud.laz")
    if "crs" in how:
        from pyproj import CRS

        las.header.add_crs(CRS.from_epsg(how["crs"]))
    if "format" in how:
        las = laspy.convert(las, point_format_id=how["format"])
    write(folder / name, las, np.arange(100))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda f: other(f, "z.laz", crs=25831), "z.laz CRS ETRS89 / UTM zone 31N; tiles of one"),
        (lambda f: other(f, "z.laz", format=6), "z.laz point format 6; tiles of one cloud"),
        (lambda f: [path.unlink() for path in f.iterdir()], "has no LAS or LAZ files"),
        (lambda f: (f / "tile0.las").write_bytes(b""), "tile0.las: is damaged"),
    ],
)
def test_folders_that_are_refused(make, sentence, tmp_path):
    folder, _ = cut(tmp_path / "tiles", 1)
    make(folder)
    done = run_pcfix("correct", folder, tmp_path / "out", *WORDS)
    assert (done.returncode, done.stdout) == (1, "")
    assert sentence in done.stderr


def test_outputs_that_are_refused(cloud, tmp_path):
    folder, merged = cloud
    (tmp_path / "file.laz").write_bytes(b"")
    (tmp_path / "two.txt").write_text(f"{folder}/tile0.laz\n{folder}/../tiles/tile0.laz\n")
    (tmp_path / "bad.vpc").write_text('{"features": [{}]}')
    for input, output, sentence in (
        (folder, folder, "is the folder of tile0.laz, an input; give another one."),
        (folder, folder / "out", "lies in the folder of the inputs; give one outside of it."),
        (folder, tmp_path / "file.laz", "is a file; many files go to a folder"),
        (folder, "s3://bucket/out", "outputs go to a folder; write there, and copy them after."),
        (tmp_path / "two.txt", tmp_path / "out", "would both become tile0.laz; give them names"),
        (tmp_path / "bad.vpc", tmp_path / "out", "is not a virtual point cloud (KeyError"),
        (tmp_path / "none.vpc", tmp_path / "out", "is not a virtual point cloud (FileNotFound"),
        (f"{folder}/x*.laz", tmp_path / "out", "has no LAS or LAZ files"),
    ):
        done = run_pcfix("label", input, output, "--water", "0.37")
        assert (done.returncode, done.stdout) == (1, ""), done.stderr
        assert sentence in done.stderr
        assert len(done.stderr.splitlines()) == 1
    done = run_pcfix("label", merged, tmp_path / "a.laz", "--water", "0", "--scheduler", "x:1")
    assert "scheduler is for many files (a folder, glob or list of tiles) alone" in done.stderr


def test_tiles_that_overlap_are_warned_of(tmp_path):
    folder, _ = cut(tmp_path / "tiles", 2)
    (folder / "again.laz").write_bytes((folder / "tile1.laz").read_bytes())
    with pytest.warns(pcfix.PcfixWarning, match=r"again.laz and tile1.laz overlap \(1 pairs"):
        tiles_of(folder)


def test_every_option_is_part_of_the_key_but_how_it_is_done():
    from pcfix.flow.tiles import HOW

    assert set(HOW) < {one.name for one in fields(CorrectOptions)}
