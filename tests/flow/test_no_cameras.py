"""Methods that need depths only work without cameras, from Python, command line and PDAL."""

import json

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.errors import PcfixWarning, SettingError
from pcfix.io.saved import read_regression
from pcfix.options.correct import WITHOUT_CAMERAS
from tests.pdal_stage.test_arrays import arrays_of, metadata_of
from tests.pdal_stage.test_arrays import run as stage
from tests.utils.clouds import WATER_M, block, cameras_csv, random_cloud, write_cloud
from tests.utils.codes import refused
from tests.utils.program import run_pcfix
from tests.utils.shared import SCENE

NONE = {"water": WATER_M}


@pytest.fixture
def folder(tmp_path):
    write_cloud(tmp_path / "cloud.las", 7)
    cameras_csv(tmp_path / "cameras.csv", block())
    las = laspy.read(tmp_path / "cloud.las")
    wet = las.xyz[las.xyz[:, 2] < WATER_M][::20]
    rows = [f"{x:.3f},{y:.3f},{0.02 + 1.4 * (WATER_M - z):.4f}" for x, y, z in wet]
    (tmp_path / "checks.csv").write_text("\n".join(["x,y,depth", *rows]) + "\n")
    return tmp_path


def fitted(folder):
    """The apparent depths of a random cloud have no bed, so that any fit is taken."""
    return {"method": "regression", "check_depths": folder / "checks.csv", "least_r2": 0.0}


def asked(folder, method):
    return {"method": "factor"} if method == "factor" else fitted(folder)


@pytest.mark.parametrize("method", WITHOUT_CAMERAS)
def test_with_and_without_cameras(folder, method):
    options = {**NONE, **asked(folder, method)}
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


REFUSED = (
    {"method": "snell"},
    {},
    {"method": "factor", "depth_factor": "auto"},
    {"method": "factor", "views": "list.ply"},
    {"method": "factor", "occlusion": "on"},
    {"method": "factor", "max_angle": 30.0},
    {"method": "factor", "tide": "tide.csv"},
    {"method": "regression", "check_depths": "c.csv", "regression": "l.json"},
    {"method": "factor", "regression": "l.json"},
    {"method": "regression"},
    {"method": "regression", "regression": "l.json", "save_regression": "m.json"},
    {"method": "regression", "check_depths": "checks.csv", "save_regression": "checks.csv"},
)
"""Options about cameras, and of the regression, that do not go together."""


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


def saved(folder):
    """Return what the fit came to, with the file of its line."""
    return pcfix.correct_file(
        folder / "cloud.las", folder / "fit.las", **NONE, **fitted(folder),
        save_regression=folder / "line.json",
    )  # fmt: skip


def test_saved_line(folder):
    fit = saved(folder)
    line = {"method": "regression", "regression": folder / "line.json"}
    again = pcfix.correct_file(folder / "cloud.las", folder / "again.las", **NONE, **line)
    one, other = (laspy.read(folder / name) for name in ("fit.las", "again.las"))
    assert np.array_equal(one.points.array, other.points.array)
    assert "checks.csv" in again.notes[0] and "cloud.las" in again.notes[0]
    assert not fit.why_no_order and again.why_no_order
    assert again.as_dict()["uncertainty"]["s44"] is None
    las = laspy.read(folder / "cloud.las")
    text = {"method": "regression", "regression": str(folder / "line.json")}
    outs, _ = stage("correct", arrays_of(las), metadata_of(las.header), **NONE, **text)
    assert np.allclose(outs["Z"], other.z, atol=1e-9)
    assert outs["SigmaZ"] == pytest.approx(np.asarray(other.SigmaZ), abs=1e-6)
    text = {**fitted(folder), "check_depths": str(folder / "checks.csv")}
    where = str(folder / "stage.json")
    stage("correct", arrays_of(las), metadata_of(las.header), **NONE, **text, save_regression=where)
    one, other = (json.loads((folder / name).read_text()) for name in ("line.json", "stage.json"))
    assert {**one, "source": ""} == {**other, "source": ""}


def test_extrapolation(folder):
    saved(folder)
    line = json.loads((folder / "line.json").read_text())
    depth = WATER_M - random_cloud(7).xyz[:, 2]
    deepest, most = float(np.median(depth[depth > 0])), float(depth.max())
    (folder / "line.json").write_text(json.dumps({**line, "deepest": deepest}))
    again = pcfix.correct_file(
        folder / "cloud.las", folder / "again.las", **NONE, method="regression",
        regression=folder / "line.json",
    )  # fmt: skip
    (note,) = [note for note in again.notes if "extrapolated" in note]
    assert f"{deepest:.2f} m" in note and f"{most:.2f} m" in note
    out = laspy.read(folder / "again.las")
    apparent = WATER_M - np.asarray(laspy.read(folder / "cloud.las").z)
    sigma = np.asarray(out.SigmaZ)
    inside = (apparent > line["shallowest"]) & (apparent < deepest)
    assert sigma[inside] == pytest.approx(line["cv_rmse"], abs=1e-4)
    assert sigma[apparent > deepest].min() >= sigma[inside].max()
    with pytest.warns(PcfixWarning):
        pcfix.correct_points(
            random_cloud(7).xyz, None, WATER_M, method="regression",
            regression=folder / "line.json",
        )  # fmt: skip


def test_cleaning(folder):
    pcfix.correct_file(folder / "cloud.las", folder / "out.las", **NONE, method="factor")
    found = pcfix.clean_file(folder / "out.las", folder / "clean.las")
    assert found.reasons["few_rays"] == 0
    assert len(found.not_run) == 1


def test_run(tmp_path):
    """The report has no figure of a block, and the line is saved for other clouds."""
    truth = laspy.read(SCENE / "truth.laz").xyz
    wet = truth[(truth[:, 2] < 0.2) & (truth[:, 2] > -9.0)][::400]
    rows = [f"{x:.3f},{y:.3f},{0.37 - z:.3f}" for x, y, z in wet]
    (tmp_path / "checks.csv").write_text("\n".join(["x,y,depth", *rows]) + "\n")
    words = ("--water", "0.37", "--method", "regression", "--check-depths", "checks.csv")
    words = ("run", SCENE / "cloud.laz", "out", *words)
    done = run_pcfix(*words, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "out" / "figures" / "cameras.png").exists()
    line = read_regression(tmp_path / "out" / "regression.json")
    assert 1.38 < line.slope < 1.48
    pyogrio = pytest.importorskip("pyogrio")
    meta, _, _, values = pyogrio.raw.read(tmp_path / "out" / "map.gpkg", layer="check_depths")
    assert list(meta["fields"]) == ["measured_m", "residual_m"]
    measured, residual = values
    expected = np.sqrt(np.nanmean(line.sigma_m(measured / line.slope) ** 2))
    assert np.sqrt(np.nanmean(residual**2)) == pytest.approx(expected, rel=0.5)
    again = run_pcfix(*words, folder=tmp_path)
    assert again.stdout.splitlines()[0].startswith("correct   already done")
    refused = run_pcfix(*words, "--adjust", "yes", "--overwrite", folder=tmp_path)
    assert refused.returncode == 1
