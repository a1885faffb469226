"""A disk that is full at any stage of a command: nothing half-written, and one clear sentence."""

import gc
import json
import math
import os
import shutil
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import laspy
import pytest
import rasterio

from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix

PAGE = 4096


@pytest.fixture(scope="module")
def disk(tmp_path_factory):
    """A folder with a disk of its own, in memory; see `resize`."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root may mount a small disk")
    folder = tmp_path_factory.mktemp("disk")
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", folder], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"a small disk cannot be mounted here ({done.stderr.strip()})")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture(scope="module")
def survey(inputs):
    """The folder of inputs, with the corrected cloud."""
    done = run_pcfix(*CORRECT, "corrected.laz", "--quiet", folder=inputs)
    assert done.returncode == 0, done.stderr
    return inputs


CAMERAS = ("--cameras", "cameras.csv", "--water", "0.37", "--method", "snell")
CORRECT = ("correct", "cloud.laz", *CAMERAS, "--jobs", "1")
COMPARE = ("compare", "corrected.laz", "lidar.laz")
# Arguments by name; DISK is the folder that fills up.
COMMANDS = {
    "correct": (*CORRECT, "DISK/c.laz", "--summary", "DISK/c.json"),
    "correct, LAS": (*CORRECT, "DISK/c.las"),
    "label": ("label", "cloud.laz", "DISK/l.laz", "--water", "0.37", "--summary", "DISK/l.json"),
    "restore": ("restore", "corrected.laz", "DISK/r.laz"),
    "clean": ("clean", "corrected.laz", "DISK/n.laz", "--summary", "DISK/n.json"),
    "dsm": ("dsm", "corrected.laz", "DISK/d.tif", "--resolution", "0.25", "--counts",
            "DISK/k.tif", "--style", "--summary", "DISK/d.json"),
    "compare": (*COMPARE, "--out-dir", "DISK/of", "--plot", "DISK/p.png", "--summary", "DISK/s"),
}  # fmt: skip


def resize(disk, pages):
    """Empty a disk and make it so many pages large."""
    gc.collect()  # arrays of a refused command may still hold files without a name
    for path in disk.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    options = f"remount,size={pages * PAGE}"
    subprocess.run(["mount", "-o", options, disk], check=True)


def state(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def check_whole(path):
    """Read a file to its end."""
    match path.suffix:
        case ".las" | ".laz":
            with laspy.open(path) as file:
                assert len(file.read()) == file.header.point_count > 0
        case ".tif":
            with rasterio.open(path) as raster:
                raster.read()
        case ".gpkg":
            with closing(sqlite3.connect(path)) as base:
                assert base.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        case ".json" | "":
            json.loads(path.read_text("utf-8"))
        case ".png":
            assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
        case suffix:
            end = {".html": b"</html>", ".qml": b"</qgis>", ".csv": b""}[suffix]
            assert path.read_bytes().rstrip(b"\n").endswith(end)


def on_a_disk_of(pages, words, disk, survey):
    """Run a command; return what did not find its place, None when all did."""
    resize(disk, pages)
    words = [word.replace("DISK", str(disk)) for word in words]
    done = run_pcfix(*words, "--quiet", folder=survey)
    files = [path for path in disk.rglob("*") if path.is_file()]
    assert not [path for path in disk.rglob("*") if path.name.startswith(".")]
    for path in files:
        check_whole(path)
    if done.returncode == 0:
        return None
    assert done.returncode == 1
    assert not [path for path in disk.rglob("*") if path.is_dir() and not any(path.iterdir())]
    assert done.code == "output.disk_full", done.stderr
    assert done.stderr.replace("pcfix: warning", "").count("pcfix:") == 1
    return str(Path(done.error.values["path"]).relative_to(disk))


@pytest.mark.parametrize("growth", [1.5, pytest.param(1.07, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", mostly_nightly(COMMANDS, "correct"))
def test_full_at_any_stage(name, growth, disk, survey):
    """The disk grows until the command goes through."""
    before, pages, blamed = state(survey), 1, []
    while (file := on_a_disk_of(pages, COMMANDS[name], disk, survey)) is not None:
        blamed.append(file)
        pages = math.ceil(pages * growth)
        assert pages * PAGE < 4e6
    written = {path.name for path in disk.rglob("*") if path.is_file()}
    named = {Path(word).name for word in COMMANDS[name] if word.startswith("DISK")}
    assert written >= named - {"of"}
    assert len(blamed) >= 3
    assert state(survey) == before
