"""The command ``pcfix dsm``."""

import json

from tests.grid.clouds import scattered, write
from tests.utils.program import run_pcfix
from tests.utils.rasters import read_raster


def test_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "c.laz", scattered(2000, 20.0, 10.0), classes=40)
    words = "c.laz d.tif --resolution 0.5 --method max --surface bed --fill 1.5 --summary s.json"
    words += " --counts n.tif --what height --style"
    answer = run_pcfix("dsm", *words.split())
    assert answer.returncode == 0, answer.stderr
    assert json.loads((tmp_path / "s.json").read_text())["settings"] == {
        "resolution": 0.5, "what": "height", "method": "max", "surface": "bed", "fill": 1.5,
    }  # fmt: skip
    assert read_raster("d.tif").array.shape == (1, 20, 40)
    assert read_raster("n.tif").array.shape == (2, 20, 40)
    assert (tmp_path / "d.qml").exists()
    words = ["dsm", "c.laz", "d.tif", "--resolution", "1"]
    assert run_pcfix(*words).returncode == 1  # without --overwrite
    again = run_pcfix(*words, "--overwrite", "--quiet")
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert run_pcfix(*words, "--method", "kriging").returncode == 2
