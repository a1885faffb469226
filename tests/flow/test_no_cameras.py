"""Methods that need depths only work without cameras, from Python, command line and PDAL."""

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.errors import SettingError
from pcfix.options.correct import WITHOUT_CAMERAS
from tests.utils.clouds import WATER_M, block, cameras_csv, random_cloud, write_cloud
from tests.utils.codes import refused
from tests.utils.program import run_pcfix
from tests.utils.shared import SCENE

NONE = {"water": WATER_M}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    # the apparent depths of a random cloud have no bed, so that any fit must do
    monkeypatch.setattr("pcfix.flow.planning.LEAST_R2", 0.0)
    write_cloud(tmp_path / "cloud.las", 7)
    cameras_csv(tmp_path / "cameras.csv", block())
    las = laspy.read(tmp_path / "cloud.las")
    wet = las.xyz[las.xyz[:, 2] < WATER_M][::20]
    rows = [f"{x:.3f},{y:.3f},{0.02 + 1.4 * (WATER_M - z):.4f}" for x, y, z in wet]
    (tmp_path / "checks.csv").write_text("\n".join(["x,y,depth", *rows]) + "\n")
    return tmp_path


@pytest.mark.parametrize("method", WITHOUT_CAMERAS)
def test_with_and_without_cameras(folder, method):
    checks = {"check_depths": folder / "checks.csv"} if method == "regression" else {}
    options = {**NONE, "method": method, **checks}
    bare = pcfix.correct_file(folder / "cloud.las", folder / "bare.las", **options)
    pcfix.correct_file(
        folder / "cloud.las", folder / "with.las", cameras=folder / "cameras.csv", **options
    )
    one, other = (laspy.read(folder / name) for name in ("bare.las", "with.las"))
    for name in ("X", "Y", "Z", "classification", "withheld", "WaterDepth", "ShiftZ"):
        assert np.array_equal(one[name], other[name]), name
    moved = np.asarray(one.RayCount) > 0
    assert moved.sum() == bare.corrected == bare.submerged
    assert set(np.asarray(one.RayCount)[moved]) == {1}
    assert not np.asarray(one.Incidence).any()
    if method == "regression":
        assert np.array_equal(one.SigmaZ, other.SigmaZ)
    else:
        assert not np.asarray(one.SigmaZ).any()
    assert (bare.cameras, bare.absorbed) == (0, None)


# Options about cameras, and of the regression, that do not go together.
REFUSED = (
    {"method": "snell"},
    {},
    {"method": "factor", "depth_factor": "auto"},
    {"method": "factor", "views": "list.ply"},
    {"method": "factor", "occlusion": "on"},
    {"method": "factor", "max_angle": 30.0},
    {"method": "factor", "tide": "tide.csv"},
    {"method": "factor", "check_depths": "c.csv"},
    {"method": "regression"},
)


@pytest.mark.parametrize("options", REFUSED, ids=str)
def test_refused(folder, monkeypatch, options):
    monkeypatch.chdir(folder)
    with pytest.raises(SettingError):
        pcfix.correct_file("cloud.las", "out.las", **NONE, **options, overwrite=True)
    assert not (folder / "out.las").exists()


def test_arrays_refused():
    xyz = random_cloud(7).xyz
    with refused("cameras.missing"):
        pcfix.correct_points(xyz, None, WATER_M)
    with refused("option.needs"):
        pcfix.correct_points(xyz, None, WATER_M, method="factor", level_offset_m=[0.1])


def test_cleaning(folder):
    pcfix.correct_file(folder / "cloud.las", folder / "out.las", **NONE, method="factor")
    found = pcfix.clean_file(folder / "out.las", folder / "clean.las")
    assert found.reasons["few_rays"] == 0
    assert len(found.not_run) == 1


def test_run(tmp_path):
    """The report has no figure of a block."""
    truth = laspy.read(SCENE / "truth.laz").xyz
    wet = truth[(truth[:, 2] < 0.2) & (truth[:, 2] > -9.0)][::400]
    rows = [f"{x:.3f},{y:.3f},{0.37 - z:.3f}" for x, y, z in wet]
    (tmp_path / "checks.csv").write_text("\n".join(["x,y,depth", *rows]) + "\n")
    words = ("--water", "0.37", "--method", "regression", "--check-depths", "checks.csv")
    words = ("run", SCENE / "cloud.laz", "out", *words)
    done = run_pcfix(*words, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "out" / "figures" / "cameras.png").exists()
    pyogrio = pytest.importorskip("pyogrio")
    meta, _, _, values = pyogrio.raw.read(tmp_path / "out" / "map.gpkg", layer="check_depths")
    assert list(meta["fields"]) == ["measured_m", "residual_m"]
    assert np.sqrt(np.nanmean(values[1] ** 2)) < 0.1  # noise of 4 cm, and cells of 2 m
    again = run_pcfix(*words, folder=tmp_path)
    assert again.stdout.splitlines()[0].startswith("correct   already done")
    refused = run_pcfix(*words, "--adjust", "yes", "--overwrite", folder=tmp_path)
    assert refused.returncode == 1
