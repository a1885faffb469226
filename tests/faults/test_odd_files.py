"""Names and things that are no ordinary files: one sentence each, and nothing written over."""

import os
import stat
import tempfile
from pathlib import Path

import numpy as np
import pytest
import rasterio

from pcfix.errors import InputError
from pcfix.io.files import check_input, check_output
from tests.utils.clouds import WATER_M, write_cloud
from tests.utils.codes import refused
from tests.utils.program import run_pcfix

NOT_UTF8 = os.fsdecode(b"h\xf6he")


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """A folder with a cloud and what is no file beside it."""
    folder = tmp_path_factory.mktemp("odd")
    write_cloud(folder / "cloud.las", 3, count=300)
    (folder / "one").symlink_to("other")
    (folder / "other").symlink_to("one")
    (folder / "folder").mkdir()
    (folder / "folder" / "self").symlink_to("../folder")
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "pipe")
    return folder


@pytest.fixture(scope="module")
def raster(odd):
    """A raster of heights over the cloud, and its bytes."""
    place = rasterio.transform.from_origin(455_950.0, 5_432_150.0, 1.0, 1.0)
    how = {"driver": "GTiff", "width": 200, "height": 200, "count": 1, "dtype": "float32"}
    with rasterio.open(odd / "whole.tif", "w", transform=place, **how) as target:
        target.write(np.full((200, 200), WATER_M, np.float32), 1)
    return (odd / "whole.tif").read_bytes()


def refused_command(folder, *words):
    """Run a command that is refused in one line and leaves the folder as it was."""
    before = sorted(folder.iterdir())
    done = run_pcfix(*words, folder=folder)
    assert done.returncode == 1, done
    lines = [one for one in done.stderr.splitlines() if not one.startswith("pcfix: warning:")]
    assert len(lines) == 1 and lines[0].startswith("pcfix: "), done.stderr
    assert sorted(folder.iterdir()) == before
    return done


def label(cloud="cloud.las", output="out.las", water=str(WATER_M)):
    return ["label", cloud, output, "--water", water, "--overwrite"]


KINDS = {
    "loop": "one",
    "long name": "9" * 300 + ".x",
    "folder": "folder",
    "pipe": "pipe",
    "device": os.devnull,
}
PLACES = {
    "cloud": (lambda path: label(path), "input.unreadable"),
    "water": (lambda path: label(water=path), "input.unreadable"),
    "cameras": (lambda path: ["cameras", path], "input.unreadable"),
    "output": (lambda path: label(output=path), "output.not_a_file"),
    "summary": (lambda path: [*label(), "--summary", path], "output.not_a_file"),
}
OTHERS = {
    ("loop", "output"): "output.cannot_write",
    ("loop", "summary"): "output.cannot_write",
    ("long name", "output"): "output.cannot_write",
    ("long name", "cloud"): "",  # the system refuses it before pcfix looks at it
    ("long name", "cameras"): "",
    ("long name", "summary"): "output.cannot_write",
    ("folder", "cloud"): "cloud.no_files",
    ("folder", "cameras"): "cameras.unknown",
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="has no pipes in folders")
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", KINDS)
def test_not_a_file(odd, kind, place):
    if (kind, place) in (("device", "output"), ("device", "summary")):
        return  # a command that broke the rule would replace the device; see below
    words, code = PLACES[place]
    done = refused_command(odd, *words(KINDS[kind]))
    assert done.code == OTHERS.get((kind, place), code), done.stderr
    assert len(done.stderr) < 900
    assert stat.S_ISFIFO((odd / "pipe").stat().st_mode)


def test_devices_are_never_written_over():
    with refused("output.not_a_file"):
        check_output(os.devnull, overwrite=True)


def test_names_that_are_not_utf8(odd, raster):
    """A cloud of such a name goes through; what a library cannot open is said."""
    cloud = odd / f"{NOT_UTF8}.las"
    cloud.write_bytes((odd / "cloud.las").read_bytes())
    (odd / f"{NOT_UTF8}.tif").write_bytes(raster)
    done = run_pcfix(*label(cloud.name, f"out{NOT_UTF8}.laz"), folder=odd)
    assert done.returncode == 0, done.stderr
    done = refused_command(odd, *label(water=f"{NOT_UTF8}.tif"))
    assert "UTF-8" in done.stderr


@pytest.fixture
def closed():
    """A folder that others may look for but not into, and a cloud that they may not read."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        for part in ("closed", "open"):
            (folder / part).mkdir()
            write_cloud(folder / part / "cloud.las", 3, count=300)
        (folder / "open" / "cloud.las").chmod(0)
        folder.chmod(0o755)
        (folder / "closed").chmod(0)
        try:
            yield folder
        finally:
            (folder / "closed").chmod(0o700)


@pytest.mark.skipif(not hasattr(os, "seteuid"), reason="has no users to change to")
@pytest.mark.parametrize("name", ["closed/cloud.las", "open/cloud.las"])
def test_files_that_may_not_be_read(closed, name):
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        with refused("input.unreadable"):
            check_input(closed / name)
        with refused("output.exists" if name.startswith("open") else "output.cannot_write"):
            check_output(closed / name, overwrite=False)
    finally:
        if is_root:
            os.seteuid(0)


def test_long_value():
    shown = str(InputError("x.y", f"/long/name.txt: '{'9' * 5000}' is no number. Give one."))
    assert len(shown) < 800
    assert shown.startswith("/long/name.txt: '999") and shown.endswith("9' is no number. Give one.")
