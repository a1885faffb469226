"""The words of ``pcfix dsm``."""

from __future__ import annotations

import json

import pytest

from pcfix.io.rasters import read_raster
from tests.grid.clouds import scattered, write
from tests.utils.program import run_pcfix


@pytest.fixture
def cloud(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return write(tmp_path / "c.laz", scattered(2000, 20.0, 10.0), classes=40)


def test_options_reach_the_raster(cloud):
    words = "c.laz d.tif --resolution 0.5 --method idw --surface bed --fill 1.5 --summary s.json"
    words += " --hillshade h.tif --azimuth 300 --altitude 30 --cog"
    words += " --counts n.tif --what height --style"
    answer = run_pcfix("dsm", *words.split())
    assert answer.returncode == 0, answer.stderr
    assert "40 x 20 cells of 0.5 m, idw" in answer.stdout
    assert "2,000 of 2,000 (bed, class 40) points" in answer.stdout
    settings = json.loads((cloud.parent / "s.json").read_text())["settings"]
    assert settings == {
        "resolution": 0.5,
        "what": "height",
        "method": "idw",
        "surface": "bed",
        "fill": 1.5,
        "azimuth": 300.0,
        "altitude": 30.0,
    }
    assert read_raster("d.tif").array.shape == (1, 20, 40)
    assert read_raster("n.tif").array.shape == (2, 20, 40)
    assert (cloud.parent / "d.qml").exists()
    assert read_raster("h.tif").array.dtype == "uint8"


def test_quiet_and_overwrite(cloud):
    words = ["dsm", "c.laz", "d.tif", "--resolution", "1", "--quiet"]
    first = run_pcfix(*words)
    assert (first.returncode, first.stdout, first.stderr) == (0, "", "")
    assert "add --overwrite" in run_pcfix(*words).stderr
    assert run_pcfix(*words, "--overwrite").returncode == 0


def test_resolution_is_said_where_it_is_chosen(cloud):
    answer = run_pcfix("dsm", "c.laz", "d.tif")
    assert "cells of 0.5 m, chosen for 2 to 4 points each, mean" in answer.stdout
    assert "heights: the cloud states no vertical datum" in answer.stdout
    wrong = ["dsm", "c.laz", "d.tif", "--resolution", "1", "--method", "kriging"]
    assert run_pcfix(*wrong).returncode == 2
