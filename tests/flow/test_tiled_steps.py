"""Clean and compare over many files: what they do to one file of the same points."""

import shutil

import numpy as np
import pytest

import pcfix
from pcfix.io.scenes import write_scene
from tests.utils.codes import refused
from tests.utils.program import run_pcfix
from tests.utils.tiles import cut, records

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


@pytest.mark.parametrize("more", [{}, {"drop": True}, {"water": 0.37, "radius": 2.0}])
def test_cleaned(more, scene, tmp_path):
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
    assert len(one[1]) == 4
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
    assert done.code == "cloud.broken_files"
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


def test_refused(scene, tmp_path):
    tiles, out = scene / "cloud" / "tiles", tmp_path / "out"
    with refused("output.is_input"):
        pcfix.clean_file(tiles, tiles / "out")
    with pytest.raises(pcfix.PcfixError):  # every point is noise
        pcfix.clean_file(tiles, out, drop=True, radius=1e-6)
    assert not list(tmp_path.iterdir())
