"""Many files as one cloud: the same points, the same figures, errors."""

import os
import shutil
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from pyproj import CRS

import pcfix
from pcfix.flow.demo import write_scene
from pcfix.flow.runner import in_processes
from tests.io.test_views import write_ply
from tests.utils.codes import refused
from tests.utils.matchers import matched_scene
from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix
from tests.utils.tiles import SCENE, cut, figures, finished, records, tiles_in, write

CAMERAS = SCENE / "cameras.csv"
WORDS = ("--cameras", CAMERAS, "--water", "0.37")
# A correction that weighs nothing: for tests of files.
PLAIN = {"method": "snell", "dimensions": "minimal"}
PLAIN_WORDS = [word for name, value in PLAIN.items() for word in (f"--{name}", value)]


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


def test_default_method(corrected):
    folder, one, many = corrected
    assert one.reconstruction["method"] == "consistent"
    assert np.array_equal(records(*tiles_in(folder / "tiles")), records(folder / "merged.las"))
    assert figures(one) == figures(many)


@pytest.mark.parametrize(("count", "jobs"), mostly_nightly(((3, 2), (2, 1)), (3, 2)))
def test_tiles_and_jobs(count, jobs, tmp_path):
    folder, merged = cut(tmp_path / "tiles", count)
    given = {"cameras": CAMERAS, "water": 0.37, "method": "snell"}
    one = pcfix.correct_file(merged, tmp_path / "merged.las", max_angle=10, **given)
    many = pcfix.correct_file(folder, tmp_path / "out", max_angle=10, jobs=jobs, **given)
    assert np.array_equal(records(*tiles_in(tmp_path / "out")), records(tmp_path / "merged.las"))
    assert figures(one) == figures(many)


def test_view_list(tmp_path):
    scene = matched_scene(3000, cloud="depth-maps")
    write_scene(scene, tmp_path / "s", overwrite=False)
    folder, merged = cut(tmp_path / "tiles", 2, cloud=tmp_path / "s" / "cloud.laz")
    given = {"cameras": tmp_path / "s" / "cameras.csv", "water": 0.37}
    given["views"] = tmp_path / "dense.ply"
    rows = [slice(*pair) for pair in pairwise(scene.views.start)]
    lists, weights = (
        [one[some].tolist() for some in rows] for one in (scene.views.camera, scene.views.weight)
    )
    write_ply(given["views"], scene.apparent_xyz, lists, weights, position="double")
    one = pcfix.correct_file(merged, tmp_path / "merged.las", **given)
    many = pcfix.correct_file(folder, tmp_path / "out", **given)
    assert many.reconstruction == one.reconstruction
    names = ("by_row", "by_position", "unmatched", "entries")
    assert [many.views[name] for name in names] == [one.views[name] for name in names]
    here, there = records(tmp_path / "merged.las"), records(*tiles_in(tmp_path / "out"))
    # the depth maps about a point are those of its chunk: to the last digit for nearly all
    assert np.mean(here["Z"] != there["Z"]) < 0.02
    assert np.abs(here["Z"] - there["Z"]).max() <= 5


def test_restored(cloud, corrected, tmp_path):
    points = pcfix.restore_file(corrected[0] / "tiles", tmp_path / "back")
    assert points == 20_000
    for path in tiles_in(cloud[0]):
        assert np.array_equal(records(path), records(tmp_path / "back" / path.name))


def test_labels(cloud, tmp_path):
    given = {"water": 0.37, "connected": True}
    one = pcfix.label_file(cloud[1], tmp_path / "merged.las", **given)
    many = pcfix.label_file(cloud[0], tmp_path / "out", **given)
    assert np.array_equal(records(*tiles_in(tmp_path / "out")), records(tmp_path / "merged.las"))
    assert figures(one) == figures(many)


def test_raster(corrected, tmp_path):
    folder = corrected[0]
    one = pcfix.grid_dsm(folder / "merged.las", tmp_path / "one.tif", method="tin")
    many = pcfix.grid_dsm(folder / "tiles", tmp_path / "many.tif", method="tin")
    with rasterio.open(tmp_path / "one.tif") as a, rasterio.open(tmp_path / "many.tif") as b:
        assert a.profile == b.profile
        assert np.array_equal(a.read(), b.read())
    assert figures(one) == figures(many)


def test_resumes(cloud, tmp_path):
    given = {"cameras": CAMERAS, "water": 0.37, **PLAIN}
    first = pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    paths = tiles_in(tmp_path / "out")
    before = [path.stat().st_mtime_ns for path in paths]
    paths[1].unlink()
    again = pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    after = [path.stat().st_mtime_ns for path in paths]
    assert [a == b for a, b in zip(after, before, strict=True)] == [True, False, True, True]
    assert figures(again) == figures(first)
    with pytest.raises(pcfix.SettingError):  # other options
        pcfix.correct_file(cloud[0], tmp_path / "out", **{**given, "index": 1.33})


def test_broken_tile(tmp_path):
    folder, _ = cut(tmp_path / "tiles", 3, suffix=".las")
    whole = (folder / "tile1.las").read_bytes()
    (folder / "tile1.las").write_bytes(whole[: len(whole) // 2])
    (folder / "tile3.las").write_bytes(b"no cloud")
    words = ("correct", folder, tmp_path / "out", *WORDS, *PLAIN_WORDS)
    done = run_pcfix(*words)
    assert (done.returncode, done.code) == (1, "cloud.damaged")
    assert Path(done.error.values["path"]).name == "tile3.las"
    (folder / "tile3.las").unlink()
    assert run_pcfix(*words).returncode == 1  # which is found when the points are read
    assert not tiles_in(tmp_path / "out")
    (folder / "tile1.las").write_bytes(whole)
    done = run_pcfix(*words)
    assert (done.returncode, done.stderr) == (0, "")
    assert len(records(*tiles_in(tmp_path / "out"))) == 20_000


def test_full_disk(cloud, tmp_path, monkeypatch):
    wrote = laspy.LasWriter.write_points

    def full(writer, points):
        wrote(writer, points)
        if "tile2.laz" in writer.dest.name:
            raise OSError(28, "No space left on device")

    given = {"cameras": CAMERAS, "water": 0.37, "jobs": 1, **PLAIN}
    monkeypatch.setattr(laspy.LasWriter, "write_points", full)
    with refused("tiles.failed") as error:
        pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    assert "tile2.laz" in error.value.values["failed"][0]
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert left == {".pcfix", "tile0.laz", "tile1.laz", "tile3.laz"}
    monkeypatch.undo()
    pcfix.correct_file(cloud[0], tmp_path / "out", **given)
    assert len(tiles_in(tmp_path / "out")) == 4


def ended_by_two(shared, task, jobs):
    """End the process of task 2, as the system does for lack of memory."""
    if task == 2:
        os._exit(1)
    return "" if task % 2 else f"error of {task}"


def test_process_ends():
    found = dict(in_processes(ended_by_two, b"", range(5), most=2, jobs=2))
    assert found[2].startswith("2: its process ended")
    assert set(found) == set(range(5))


def test_ctrl_c(tmp_path):
    """In processes of its own, as only these are interrupted as a terminal does it."""
    folder, _ = cut(tmp_path / "tiles", 32)
    out, words = tmp_path / "out", ["--jobs", "2", *PLAIN_WORDS, *map(str, WORDS)]
    command = [sys.executable, "-m", "pcfix", "correct", str(folder), str(out), *words]
    running = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
        # jobs in the background of a shell ignore Ctrl-C, and so would the command
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    until = time.monotonic() + 120
    # of four outputs the two processes have recorded two; reading records takes longer than tiles
    while len(tiles_in(out)) < 4 and time.monotonic() < until:
        time.sleep(0.005)
    os.killpg(running.pid, signal.SIGINT)
    _, error = running.communicate(timeout=60)
    assert running.returncode == 130
    assert error.splitlines()[-1] == "pcfix: stopped."
    assert "Traceback" not in error
    before = finished(out)
    assert 2 <= len(before) < 32
    assert not list(out.glob(".*.part*"))
    done = run_pcfix("correct", folder, out, "--jobs", "1", *words[2:])
    assert done.returncode == 0, done.stderr
    assert len(tiles_in(out)) == 32
    assert before.items() <= finished(out).items()


@pytest.mark.parametrize("case", ["crs", "format", "empty", "damaged"])
def test_refused_inputs(case, tmp_path):
    folder, _ = cut(tmp_path / "tiles", 1)
    las = laspy.read(SCENE / "cloud.laz")
    if case == "crs":
        las.header.add_crs(CRS.from_epsg(25831))
    if case == "format":
        las = laspy.convert(las, point_format_id=6)
    if case in ("crs", "format"):
        write(folder / "z.laz", las, np.arange(100))
    elif case == "empty":
        (folder / "tile0.laz").unlink()
    else:
        (folder / "tile0.las").write_bytes(b"")
    done = run_pcfix("correct", folder, tmp_path / "out", *WORDS)
    assert (done.returncode, done.stdout) == (1, "")
    written = [path.name for path in tiles_in(tmp_path / "out")]
    assert not written


def test_refused_outputs(cloud, tmp_path):
    folder, _ = cloud
    (tmp_path / "file.laz").write_bytes(b"")
    (tmp_path / "two.txt").write_text(f"{folder}/tile0.laz\n{folder}/../tiles/tile0.laz\n")
    (tmp_path / "bad.vpc").write_text('{"features": [{}]}')
    for input, output, code in (
        (folder, folder, "output.is_input"),
        (folder, folder / "out", "output.is_input"),
        (folder, tmp_path / "file.laz", "output.folder"),
        (tmp_path / "two.txt", tmp_path / "out", None),
        (tmp_path / "bad.vpc", tmp_path / "out", None),
        (tmp_path / "none.vpc", tmp_path / "out", None),
        (f"{folder}/x*.laz", tmp_path / "out", None),
    ):
        done = run_pcfix("label", input, output, "--water", "0.37")
        assert (done.returncode, done.stdout) == (1, ""), done.stderr
        assert code in (None, done.code)
        assert len(done.stderr.splitlines()) == 1


# Clean and compare

# A good part of the points is noise by these.
MANY = {"deviations": 0.5, "fences": 0.2, "below": 0.01, "floating": 0.01}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a folder with a corrected cloud and a reference, each in tiles and as merged.laz."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(pcfix.simulate_scene(4000), folder / "s", overwrite=False)
    pcfix.correct_file(
        folder / "s" / "cloud.laz", folder / "c.laz", method="snell", water=0.37,
        cameras=folder / "s" / "cameras.csv",
    )  # fmt: skip
    cut(folder / "cloud" / "tiles", 3, cloud=folder / "c.laz")
    cut(folder / "lidar" / "tiles", 2, cloud=folder / "s" / "lidar.laz")
    return folder


@pytest.mark.parametrize("more", [{}, {"drop": True}, {"water": 0.37, "radius": 2.0}])
def test_cleaned(more, scene, tmp_path):
    one = pcfix.clean_file(scene / "cloud" / "merged.laz", tmp_path / "one.las", **MANY, **more)
    done = []
    many = pcfix.clean_file(
        scene / "cloud" / "tiles", tmp_path / "many", **MANY, **more, jobs=1,
        progress=lambda *one: done.append(one),
    )  # fmt: skip
    assert np.array_equal(records(*tiles_in(tmp_path / "many")), records(tmp_path / "one.las"))
    assert figures(one) == figures(many)
    assert 300 < many.noise < 3000
    assert (many.input, many.output) == (str(scene / "cloud" / "tiles"), str(tmp_path / "many"))
    assert done == sorted(done)
    assert done[-1] == (4000, 4000)


def test_compared(scene, tmp_path):
    def compared(cloud, reference, out_dir):
        asked = {"sections": 2, "direction": "both", "share": ["0.1,0.2"]}
        found = pcfix.compare_clouds(
            cloud, reference, out_dir=out_dir, also={"again": cloud}, **asked
        )
        return found, {path.name: path.read_bytes() for path in out_dir.glob("*.csv")}

    names = ("merged.laz", "tiles")
    one, many = (
        compared(scene / "cloud" / name, scene / "lidar" / name, tmp_path / name) for name in names
    )
    assert one[1] == many[1]
    assert len(one[1]) == 3
    first, second = (figures(found) for found, _ in (one, many))
    for settings in (first["settings"], second["settings"]):
        del settings["also"]
    assert first == second
    assert one[0].also[0].c2c == many[0].also[0].c2c
    assert (many[0].cloud, many[0].reference) == (
        str(scene / "cloud" / "tiles"), str(scene / "lidar" / "tiles"),
    )  # fmt: skip


def test_damaged_tile(scene, tmp_path):
    """Nothing is written."""
    shutil.copytree(scene / "cloud" / "tiles", tmp_path / "tiles")
    (tmp_path / "tiles" / "tile1.laz").write_bytes(b"no cloud")
    done = run_pcfix("clean", tmp_path / "tiles", tmp_path / "out", "--jobs", "1")
    assert done.code == "cloud.damaged"
    assert not list((tmp_path / "out").glob("*.la[sz]"))
    reference = scene / "lidar" / "merged.laz"
    for make in (
        lambda: pcfix.compare_clouds(tmp_path / "tiles", reference),
        lambda: pcfix.compare_clouds(reference, tmp_path / "tiles"),
        lambda: pcfix.grid_dsm(tmp_path / "tiles", tmp_path / "dsm.tif"),
    ):
        with pytest.raises(pcfix.InputError) as error:
            make()
        assert "tile1.laz: is damaged" in str(error.value)
    assert not (tmp_path / "dsm.tif").exists()


def test_refused_noise(scene, tmp_path):
    tiles, out = scene / "cloud" / "tiles", tmp_path / "out"
    with pytest.raises(pcfix.PcfixError):  # every point is noise
        pcfix.clean_file(tiles, out, drop=True, radius=1e-6)
    assert not list(tmp_path.iterdir())
