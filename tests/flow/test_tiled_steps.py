"""Clean and compare over many files: what they do to one file of the same points."""

import json
import shutil

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.flow.request import Files, Request, request_of
from pcfix.io.scenes import write_scene
from tests.utils.program import run_pcfix
from tests.utils.tiles import cut, finished, records

OWN = ("input", "output", "seconds", "cloud", "reference", "also")
"""Figures that are those of a call."""
MANY = {"deviations": 0.5, "fences": 0.2, "below": 0.01, "floating": 0.01}
"""A good part of the points is noise by these."""


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


def figures(summary):
    return {name: value for name, value in summary.as_dict().items() if name not in OWN}


def tiles_in(folder):
    return sorted(folder.glob("*.la[sz]"))


@pytest.mark.parametrize("more", [{}, {"drop": True}, {"water": 0.37, "radius": 2.0, "tile_m": 30}])
def test_tiles_are_cleaned_as_one_cloud(more, scene, tmp_path):
    one = pcfix.clean_file(scene / "cloud" / "merged.laz", tmp_path / "one.las", **MANY, **more)
    done = []
    many = pcfix.clean_file(
        scene / "cloud" / "tiles", tmp_path / "many", **MANY, **more, jobs=1,
        progress=lambda *told: done.append(told),
    )  # fmt: skip
    assert np.array_equal(records(*tiles_in(tmp_path / "many")), records(tmp_path / "one.las"))
    assert figures(one) == figures(many)
    assert 300 < many.noise < 3000
    assert (many.input, many.output) == (str(scene / "cloud" / "tiles"), str(tmp_path / "many"))
    assert done == sorted(done)
    assert done[-1] == (4000, 4000)


def test_cleaning_goes_on_where_it_was_stopped(scene, tmp_path):
    tiles, out = scene / "cloud" / "tiles", tmp_path / "new" / "out"

    def stop(done, total):
        if len(finished(out)) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"stopped; 1 of 3 files are finished, the same"):
        pcfix.clean_file(tiles, out, **MANY, jobs=1, progress=stop)
    before = finished(out)
    assert [path.name for path in tiles_in(out)] == ["tile0.laz"]
    first = pcfix.clean_file(tiles, out, **MANY, jobs=1)
    after = finished(out)
    assert before.items() < after.items()
    assert pcfix.clean_file(tiles, out, **MANY) == first
    assert finished(out) == after
    with pytest.raises(pcfix.SettingError, match="the output exists"):  # by other rules
        pcfix.clean_file(tiles, out, deviations=2.0)


def test_a_full_disk_while_cleaning(scene, tmp_path, monkeypatch):
    from pcfix.io.las import writing

    wrote = writing.LasSink.write

    def full(sink, points):
        wrote(sink, points)
        if sink._path.name == "tile1.laz":
            with sink._write_errors():
                raise OSError(28, "No space left on device")

    monkeypatch.setattr(writing.LasSink, "write", full)
    with pytest.raises(pcfix.InputError, match="1 of 3 files failed, the others") as error:
        pcfix.clean_file(scene / "cloud" / "tiles", tmp_path / "out", jobs=1)
    assert "tile1.laz: cannot be written (No space left on the disk of" in str(error.value)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        ".pcfix", "tile0.laz", "tile2.laz",
    }  # fmt: skip


def test_tiles_are_compared_as_one_cloud_with_tiles(scene, tmp_path):
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
    assert len(one[1]) == 4
    first, second = (figures(found) for found, _ in (one, many))
    for settings in (first["settings"], second["settings"]):
        del settings["also"]
    assert first == second
    assert one[0].also[0].c2c == many[0].also[0].c2c
    assert (many[0].cloud, many[0].reference) == (
        str(scene / "cloud" / "tiles"), str(scene / "lidar" / "tiles"),
    )  # fmt: skip


def test_a_text_file_as_reference_is_a_table(scene, tmp_path):
    lidar = laspy.read(scene / "s" / "lidar.laz")
    lines = [f"{x:.3f},{y:.3f},{z:.3f}" for x, y, z in lidar.xyz[::500]]
    (tmp_path / "check.txt").write_text("\n".join(["x,y,z", *lines]))
    with pytest.warns(pcfix.PcfixWarning, match="CRS"):
        found = pcfix.compare_clouds(scene / "cloud" / "tiles", tmp_path / "check.txt")
    assert found.measured_at == "reference"


def test_of_a_damaged_tile_the_others_are_cleaned_and_nothing_is_made_of_all(scene, tmp_path):
    shutil.copytree(scene / "cloud" / "tiles", tmp_path / "tiles")
    (tmp_path / "tiles" / "tile1.laz").write_bytes(b"no cloud")
    done = run_pcfix("clean", tmp_path / "tiles", tmp_path / "out", "--jobs", "1")
    assert done.returncode == 1
    head, failure = done.stderr.splitlines()
    assert "1 of 3 files failed, the others are finished; the same command goes on" in head
    assert "tile1.laz: is damaged" in failure
    assert [path.name for path in tiles_in(tmp_path / "out")] == ["tile0.laz", "tile2.laz"]
    reference = scene / "lidar" / "merged.laz"
    for make in (
        lambda: pcfix.compare_clouds(tmp_path / "tiles", reference),
        lambda: pcfix.compare_clouds(reference, tmp_path / "tiles"),
        lambda: pcfix.grid_dsm(tmp_path / "tiles", tmp_path / "dsm.tif"),
    ):
        with pytest.raises(pcfix.InputError, match=r"1 of 3 files cannot be read") as error:
            make()
        assert "tile1.laz: is damaged" in str(error.value)
    assert not (tmp_path / "dsm.tif").exists()


def test_what_is_refused_as_by_the_other_commands(scene, tmp_path):
    tiles, merged = scene / "cloud" / "tiles", scene / "cloud" / "merged.laz"
    lidar = scene / "lidar" / "tiles" / "tile0.laz"
    same = [tiles / "tile0.laz", scene / "lidar" / "tiles" / "tile0.laz"]
    out = tmp_path / "out"
    for call, sentence in (
        (lambda: pcfix.clean_file([merged, lidar], out), "tiles of one cloud have the same"),
        (lambda: pcfix.compare_clouds([merged, lidar], lidar), "tiles of one cloud have the same"),
        (lambda: pcfix.clean_file(same, out), "would both become tile0.laz"),
        (lambda: pcfix.clean_file(tiles, tiles), "is the folder of tile0.laz, an input"),
        (lambda: pcfix.clean_file(tiles, tiles / "out"), "lies in the folder of the inputs"),
        (lambda: pcfix.clean_file(tmp_path, out), "has no LAS or LAZ files"),
        (lambda: pcfix.clean_file(merged, out.with_suffix(".laz"), scheduler="x:1"), "many files"),
        (
            lambda: pcfix.clean_file(tiles, out, drop=True, radius=1e-6),
            "every point is noise by these thresholds",
        ),
    ):  # fmt: skip
        with pytest.raises(pcfix.PcfixError, match=sentence) as error:
            call()
        assert len(str(error.value).splitlines()) == 1
    assert not list(tmp_path.iterdir())
    with pytest.warns(pcfix.PcfixWarning, match=r"overlap \(1 pairs"):
        pcfix.clean_file([merged, tiles / "tile1.laz"], out, jobs=1)


def test_a_run_takes_a_list_and_removes_what_was_made_of_other_files(scene, tmp_path):
    paths = tuple(map(str, tiles_in(scene / "cloud" / "tiles")))
    asked = Request(input=paths, cameras="cameras.csv", water="0.37")
    (tmp_path / "run.json").write_text(
        json.dumps({"request": asked.record(), "inputs": [], "steps": {}})
    )
    assert request_of(tmp_path / "run.json") == asked
    assert [str(path) for path in asked.source.paths] == list(paths)
    for name in ("tile0.laz", "old.laz", "mine.laz"):
        path = tmp_path / "cleaned" / name
        (path.parent / ".pcfix").mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
        if name != "mine.laz":
            (path.parent / ".pcfix" / f"{name}.npz").write_bytes(b"")
    (tmp_path / "cleaned.laz").write_bytes(b"")
    Files(tmp_path, asked.source).remove_others()
    assert not (tmp_path / "cleaned.laz").exists()
    assert [path.name for path in tiles_in(tmp_path / "cleaned")] == ["mine.laz", "tile0.laz"]
    assert len(list((tmp_path / "cleaned" / ".pcfix").iterdir())) == 1
    Files(tmp_path, tmp_path / "cloud.laz").remove_others()
    assert [path.name for path in tiles_in(tmp_path / "cleaned")] == ["mine.laz"]
