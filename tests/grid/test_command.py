"""The words of ``pcfix dsm``."""

from __future__ import annotations

import json

import pytest
import typer
from pcfix.cli.dsm import dsm
from typer.testing import CliRunner

from pcfix.io.rasters import read_raster
from tests.grid.clouds import scattered, write

app = typer.Typer()
app.command()(dsm)


@pytest.fixture
def cloud(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return write(tmp_path / "c.laz", scattered(2000, 20.0, 10.0), classes=40)


def test_options_reach_the_raster(cloud):
    words = "c.laz d.tif --resolution 0.5 --method idw --surface bed --fill 1.5 --summary s.json"
    words += " --hillshade h.tif --azimuth 300 --altitude 30 --cog"
    answer = CliRunner().invoke(app, words.split())
    assert answer.exit_code == 0, answer.output
    assert "raster       40 x 20 cells of 0.5 m, idw" in answer.stdout
    assert "points       2,000 of 2,000 (bed, class 40)" in answer.stdout
    settings = json.loads((cloud.parent / "s.json").read_text())["settings"]
    assert settings == {
        "resolution_m": 0.5,
        "method": "idw",
        "surface": "bed",
        "fill_m": 1.5,
        "azimuth_deg": 300.0,
        "altitude_deg": 30.0,
    }
    assert read_raster("d.tif").array.shape == (3, 20, 40)
    assert read_raster("h.tif").array.dtype == "uint8"


def test_quiet_and_overwrite(cloud):
    words = ["c.laz", "d.tif", "--resolution", "1", "--quiet"]
    assert CliRunner().invoke(app, words).output == ""
    assert "add --overwrite" in str(CliRunner().invoke(app, words).exception)
    assert CliRunner().invoke(app, [*words, "--overwrite"]).exit_code == 0


def test_resolution_is_asked_for(cloud):
    assert CliRunner().invoke(app, ["c.laz", "d.tif"]).exit_code == 2
    wrong = ["c.laz", "d.tif", "--resolution", "1", "--method", "kriging"]
    assert CliRunner().invoke(app, wrong).exit_code == 2
