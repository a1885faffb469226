"""The same cloud through Python arrays, Python files and the command line."""

import contextlib
import json
import os
import subprocess
import sys
import threading

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.flow.demo import write_scene
from pcfix.model import Lens, Outcome
from tests.utils.program import run_pcfix
from tests.utils.shared import needs

RIVER, river = needs("river")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    simulated = pcfix.simulate_scene(3000, seed=3)
    write_scene(simulated, folder, overwrite=False)
    return folder


def test_command_line(scene, tmp_path):
    """And what is piped is the summary and nothing else."""
    words = ("--cameras", scene / "cameras.csv", "--water", "0.37", "--max-angle", "45")
    command = ["correct", scene / "cloud.laz", tmp_path / "a.las", *words, "--jobs=1"]
    command = [sys.executable, "-m", "pcfix", *command, "--summary", tmp_path / "run.json"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    given = {"cameras": scene / "cameras.csv", "water": 0.37, "max_angle": 45}
    pcfix.correct_file(scene / "cloud.laz", tmp_path / "b.las", **given)
    assert (tmp_path / "a.las").read_bytes() == (tmp_path / "b.las").read_bytes()
    report = json.loads((tmp_path / "run.json").read_text())
    assert f"{report['submerged']:,} points (" in done.stdout
    assert report["points"] == 3000
    assert report["submerged"] == report["corrected"] + sum(report["uncorrected"].values())
    assert report["cameras"] == report["cameras_used"] + len(report["cameras_unused"])
    depth = report["depth_m"]
    assert 0 <= depth["min"] < depth["mean"] < depth["max"] < 13


def test_arrays(scene, tmp_path):
    pcfix.correct_file(
        scene / "cloud.laz", tmp_path / "out.las", cameras=scene / "cameras.csv", water=0.37
    )
    apparent, out = laspy.read(scene / "cloud.laz"), laspy.read(tmp_path / "out.las")
    result = pcfix.correct_points(
        apparent.xyz, pcfix.read_cameras(scene / "cameras.csv"), pcfix.read_water("0.37")
    )
    steps = np.rint(result.shift_m / apparent.header.scales).astype(int)
    for axis, name in enumerate("XYZ"):
        assert np.array_equal(out[name], apparent[name] + steps[:, axis])
    assert np.array_equal(out.RayCount, result.ray_count)
    assert np.asarray(out.RayMiss) == pytest.approx(result.ray_miss_m, abs=0.00005001)
    assert np.asarray(out.WaterDepth) == pytest.approx(result.depth_m, abs=0.0005001)
    assert np.asarray(out.Incidence) == pytest.approx(result.incidence_deg, abs=0.05001)


def test_outcomes():
    """Straight below one of two cameras, between them, and outside of all frames."""
    lens = Lens(500.0, 1000.0, 1000.0, 500.0, 500.0)  # 100 m up, 60 m apart
    centres = np.array([[-30.0, 0.0, 100.0], [30.0, 0.0, 100.0]])
    down = np.tile(np.diag([1.0, -1.0, -1.0]), (2, 1, 1))
    cameras = pcfix.Cameras(("a", "b"), centres, down, (lens,) * 2)
    xyz = [[30.0, 0.0, -2.0], [0.0, 0.0, -2.0], [0.0, 500.0, -2.0]]
    with pytest.warns(pcfix.PcfixWarning):
        found = pcfix.correct_points(xyz, cameras, 0.0, method="snell", max_angle=20.0)
    assert found.outcome.tolist() == [Outcome.FLAT_RAYS, Outcome.CORRECTED, Outcome.NO_CAMERA]


def test_progress(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", 700)
    calls = []
    given = {"cameras": scene / "cameras.csv", "water": 0.37}
    pcfix.correct_file(
        scene / "cloud.laz", tmp_path / "out.las", **given, progress=lambda *one: calls.append(one)
    )
    assert calls == sorted(calls)
    assert {(700, 3000), (1400, 3000), (2100, 3000), (2800, 3000), (3000, 3000)} <= set(calls)


def test_terminal(scene, tmp_path):
    import pty

    try:
        parent, child = pty.openpty()
    except OSError as error:
        pytest.skip(f"this machine lends no terminal: {error}")
    seen = []

    def read():
        with contextlib.suppress(OSError):  # the end of a terminal is an error
            while part := os.read(parent, 4096):
                seen.append(part.decode(errors="replace"))

    reader = threading.Thread(target=read)  # meanwhile: a terminal that nobody reads is soon full
    reader.start()
    words = ("--cameras", scene / "cameras.csv", "--water", "0.37", "--method", "snell")
    words += ("--dimensions", "minimal", "--quiet")
    for quiet in (words, words[:-1]):
        done = subprocess.run(
            [sys.executable, "-m", "pcfix", "correct", str(scene / "cloud.laz"),
             str(tmp_path / f"{len(quiet)}.las"), *map(str, quiet)],
            stderr=child, stdout=subprocess.PIPE, check=True,
            env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
        )  # fmt: skip
        assert (done.stdout == b"") == ("--quiet" in quiet)
    os.close(child)
    reader.join()
    assert "Correcting" in "".join(seen)
    assert "points/s" in "".join(seen)


@pytest.mark.usefixtures("undrawn")
def test_demo(tmp_path):
    done = run_pcfix("demo", tmp_path / "demo", "--points", "1500")
    assert done.returncode == 0, done.stderr
    rows = {}
    for line in done.stdout.splitlines():
        for name in ("uncorrected", "default options", "with the view list"):
            if line.startswith(name):
                rows.setdefault(name, []).append(float(line[30:].split()[6]))
    before, snell, consistent = (np.array(r) for r in rows.values())
    assert (consistent < 0.5).all()  # GSD; the noise floor of these blocks is 0.2 and 0.4
    assert (consistent < snell).all()
    assert (snell < 0.2 * before).all()
    again = run_pcfix("demo", tmp_path / "demo", "--points", "1500")
    assert again.returncode == 1


@river
def test_river(tmp_path):
    out, every = tmp_path / "river.las", slice(None, None, 4)
    source = laspy.read(RIVER / "points.las")
    source.points = source.points[np.arange(len(source))[every]]
    source.write(tmp_path / "points.las")
    done = run_pcfix(
        "correct", tmp_path / "points.las", out, "--cameras", RIVER / "cameras.csv",
        "--water", "dim:w_surf", "--index", "1.337", "--max-angle", "35",
        "--method", "consistent", "--camera-set", "all",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    cloud = laspy.read(out)
    reference = np.genfromtxt(RIVER / "ref_out.csv", delimiter=",", names=True)[every]
    assert (cloud.classification == 40).all()
    assert np.array_equal(cloud.w_surf, source.w_surf)
    # the same cameras within the angle, but for footprints on a flat plane and their edges
    assert (cloud.RayCount == reference["n_cams35"]).mean() > 0.95
    deep = reference["h_a"] > 0.1
    ratio = (np.asarray(source.w_surf) - cloud.z)[deep] / reference["h_a"][deep]
    # the intersection of rays up to 35 degrees deepens more than the mean of depths over them
    assert np.median(ratio) == pytest.approx(1.3873, rel=0.05)


@river
@pytest.mark.filterwarnings("ignore::pcfix.PcfixWarning")
def test_limit_of_snell(tmp_path):
    """Seven obliques see the river at up to 74 degrees, and cannot have made the cloud."""
    found = {}
    for limit in ("auto", "none"):
        summary = pcfix.correct_file(
            RIVER / "points.las", tmp_path / f"{limit}.laz", cameras=RIVER / "cameras.csv",
            sensor=RIVER / "sensor.csv", water="dim:w_surf", method="snell",
            max_angle=None if limit == "none" else limit,
        )  # fmt: skip
        cloud = laspy.read(tmp_path / f"{limit}.laz")
        depth, moved = np.asarray(cloud.WaterDepth), -np.asarray(cloud.ShiftZ)
        found[limit] = np.median((depth / (depth - moved))[depth > 0.3])
        # no point is withheld that has rays without a limit
        assert sum(summary.uncorrected.values()) == 0
        assert summary.settings["max_angle"] == (35.0 if limit == "auto" else None)
    # of water it is 1.34 straight below the camera; all rays make it absurd
    assert 1.37 < found["auto"] < 1.47 and found["none"] > 2.0
