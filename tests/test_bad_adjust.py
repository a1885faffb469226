"""A user's mistake with an adjustment gives one line, exit code 1, and nothing left behind."""

from __future__ import annotations

import shutil
import sys
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix import cli
from pcfix.io.cameras.colmap.writing import write_colmap
from tests.test_bad_input import listing
from tests.utils.adjust_files import EPSG, write_block, write_gcps, write_gnss
from tests.utils.nightly import mostly_nightly

if TYPE_CHECKING:
    from pathlib import Path

    from tests.utils.adjust_files import Files

pytestmark = pytest.mark.filterwarnings("default::pcfix.errors.PcfixWarning")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return write_block(tmp_path_factory.mktemp("block"), points=900)


@pytest.fixture
def folder(files: Files, tmp_path: Path) -> Path:
    """A copy of the block's files."""
    return shutil.copytree(files.folder, tmp_path / "block")


@pytest.fixture
def refuse(folder, files, monkeypatch, capfd):
    """Return a function that runs ``pcfix adjust``, sees it refused tidily, and tells why.

    A run that ends well has broken the rule.
    """

    def call(model="model", *, gnss: bool = True, water: float | None = None, more=()) -> str:
        before = listing(folder)
        level = files.water if water is None else water
        words = ["adjust", model, "out", f"--water={level!r}", "--jobs=1", *more]
        words += ["--gnss=gnss.csv"] if gnss else []
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", ["pcfix", *words])
        monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
        capfd.readouterr()
        with pytest.raises(SystemExit) as stop:
            cli.main()
        out, err = capfd.readouterr()
        lines = [line for line in err.splitlines() if not line.startswith("pcfix: warning:")]
        assert stop.value.code == 1, (out, err)
        assert len(lines) == 1, err
        assert lines[0].startswith("pcfix: ")
        assert out == ""
        assert listing(folder) == before
        return lines[0]

    return call


def has(message, *words):
    for word in words:
        assert word in message, message


def test_neither_tie_points_nor_a_cloud(refuse):
    message = refuse("bare")
    has(message, "bare", "--cloud", "points3D", "tracks.csv", "BlocksExchange", "Bundler")


def test_measured_tie_points_that_are_not_there(refuse):
    has(refuse("bare", more=["--ties=measured", "--cloud=cloud.las"]), "0 usable tie points")


def test_no_datum_at_all(refuse):
    message = refuse(gnss=False)
    has(message, "shift in plan, turn and scale stay undetermined", "--gnss", "--gcps",
        "--datum free")  # fmt: skip


def test_no_datum_and_only_the_cloud(refuse):
    has(refuse("bare", gnss=False, more=["--cloud=cloud.las"]), "undetermined", "--gnss")
    message = refuse("bare", gnss=False, more=["--cloud=cloud.las", "--datum=free"])
    has(message, "--gnss or --gcps")


def test_a_block_all_above_the_water(refuse):
    has(refuse(water=-40.0), "lie below the water", "no refraction")
    has(refuse("bare", water=-40.0, more=["--cloud=cloud.las"]), "lie below the water")


def test_water_above_the_cameras(refuse):
    has(refuse(water=500.0), "under the water", "IMG_0001.JPG")


@pytest.fixture(scope="module")
def drowned(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """A block over a flat bed: nothing of it is land."""
    return write_block(tmp_path_factory.mktemp("drowned"), points=900, bed="flat")


@pytest.mark.parametrize("free", mostly_nightly(["level", "level,tilt,index"], "level"))
def test_a_block_all_under_water_with_the_water_free(refuse, folder, drowned, free):
    for name in ("model", "gnss.csv", "cloud.las"):
        here, there = folder / name, drowned.folder / name
        shutil.rmtree(here) if here.is_dir() else here.unlink()
        shutil.copytree(there, here) if there.is_dir() else shutil.copy(there, here)
    has(refuse(water=drowned.water, more=["--free", free]), "level", "fix")


def test_control_under_water_that_does_not_say_so(refuse, folder, files):
    write_gcps(folder / "gcps.csv", files.scene, wet=False)
    control = files.scene.control
    name = control.names[int(np.argmax(control.under_water))]
    has(refuse(more=["--gcps=gcps.csv"]), name, "under_water", "yes")


@pytest.mark.parametrize("gnss", [True, False])
@pytest.mark.parametrize("model", ["model", "bare"])
def test_control_points_that_are_mixed_up(refuse, folder, files, gnss, model):
    """Their coordinates go with the marks of another."""
    control = files.scene.control
    rows = np.flatnonzero(~control.is_check)[:2]
    order = np.arange(len(control.names))
    order[rows] = rows[::-1]
    write_gcps(
        folder / "gcps.csv", replace(files.scene, control=replace(control, xyz=control.xyz[order]))
    )
    message = refuse(model, gnss=gnss, more=["--gcps=gcps.csv", "--cloud=cloud.las"])
    has(message, "gcps.csv", "does not fit", "swapped")
    assert any(f"control point {control.names[i]} " in message for i in rows)


def test_control_points_in_another_crs(refuse, folder, files):
    """UTM of the next zone: as far away as a zone is wide."""
    from pyproj import Transformer

    control = files.scene.control
    x, y = Transformer.from_crs(32633, 32632).transform(*control.xyz.T[:2])
    moved = replace(control, xyz=np.column_stack([x, y, control.xyz[:, 2]]))
    write_gcps(folder / "gcps.csv", replace(files.scene, control=moved))
    has(refuse(more=["--gcps=gcps.csv"]), "gcps.csv", "CRS")


def test_control_points_with_swapped_axes(refuse, folder, files):
    control = files.scene.control
    turned = replace(control, xyz=control.xyz[:, [1, 0, 2]])
    write_gcps(folder / "gcps.csv", replace(files.scene, control=turned))
    has(refuse(more=["--gcps=gcps.csv"]), "gcps.csv")


def test_control_points_above_another_datum(refuse, folder, files):
    control = files.scene.control
    high = replace(control, xyz=control.xyz + np.array([0.0, 0.0, 30.0]))
    write_gcps(folder / "gcps.csv", replace(files.scene, control=high))
    has(refuse(more=["--gcps=gcps.csv"]), "control points", "height datum", "--gcps-crs")


def test_marks_in_images_that_are_not_in_the_model(refuse, folder):
    text = (folder / "gcps.csv").read_text()
    label = text.splitlines()[2].split(",")[4]
    (folder / "gcps.csv").write_text(text.replace(label, "DJI_9999.JPG"))
    has(refuse(more=["--gcps=gcps.csv"]), "DJI_9999.JPG", "not in the model")


def test_gnss_heights_above_another_datum(refuse, folder, files):
    gnss = files.scene.cameras.gnss
    write_gnss(
        folder / "gnss.csv",
        files.scene.cameras.labels,
        gnss.xyz + np.array([0.0, 0.0, 30.0]),
        gnss.sigma_m,
    )
    has(refuse(), "gnss.csv", "another datum", "30.")


def test_gnss_positions_in_another_crs(refuse, folder, files):
    from pyproj import Transformer

    gnss = files.scene.cameras.gnss
    x, y = Transformer.from_crs(32633, 32632).transform(*gnss.xyz.T[:2])
    far = np.column_stack([x, y, gnss.xyz[:, 2]])
    write_gnss(folder / "gnss.csv", files.scene.cameras.labels, far, gnss.sigma_m)
    has(refuse(), "gnss.csv", "CRS")


def test_gnss_positions_of_another_block(refuse, folder):
    text = (folder / "gnss.csv").read_text()
    (folder / "gnss.csv").write_text(text.replace("IMG", "DJI").replace("img", "dji"))
    has(refuse(), "gnss.csv", "no position is of an image of the block")


@pytest.mark.parametrize("model", ["wild", "upside down"])
def test_start_poses_from_which_nothing_can_be_found(refuse, folder, files, model):
    made, rng = files.made, np.random.default_rng(5)
    turn = Rotation.random(len(made.cameras), rng=rng).as_matrix()
    if model == "upside down":
        turn = np.broadcast_to(np.eye(3), turn.shape)
    wild = replace(
        made.cameras, rotations=np.ascontiguousarray(turn),
        centres=made.cameras.centres + rng.normal(0.0, 0.2, made.cameras.centres.shape),
    )  # fmt: skip
    shutil.rmtree(folder / "model")
    write_colmap(folder / "model", wild, made.ties, crs=EPSG)
    has(refuse(), "does not converge", "poses")


def test_water_unknowns_from_the_cloud_alone(refuse):
    message = refuse("bare", more=["--cloud=cloud.las", "--free=level"])
    has(message, "tie points only", "leave the water fixed")


def test_points_on_the_water_with_the_cloud_alone(refuse, folder):
    rows = (folder / "gcps.csv").read_text().replace(",control", ",waterline")
    (folder / "gcps.csv").write_text(rows)
    message = refuse("bare", more=["--cloud=cloud.las", "--gcps=gcps.csv"])
    has(message, "measured tie points only", "waterline")


def test_words_that_are_not_understood(refuse):
    has(refuse(more=["--free=distance"]), "free 'distance': the water has no distance", "shape")
    has(refuse(more=["--parallel=water,floor"]), "parallel 'water,floor'", "the role on:NAME")
    has(refuse(more=["--free=hight"]), "'hight'", "level, tilt, index")
    has(refuse(more=["--lens-unknowns=f,q9"]), "'q9'")
    has(refuse(more=["--sigma-level=-1"]), "-1")


def test_a_calibration_of_other_images(refuse, folder):
    (folder / "lens.csv").write_text("focal_px,width_px,height_px\n1000,4000,3000\n")
    has(refuse(more=["--lens=lens.csv"]), "4000 x 3000", "5472 x 3648")


def test_fixed_images_that_are_not_there(refuse):
    has(refuse(gnss=False, more=["--fixed-images=a.jpg,b.jpg"]), "a.jpg")


def test_a_folder_of_something_else(refuse, folder):
    (folder / "out").mkdir()
    (folder / "out" / "notes.txt").write_text("mine")
    has(refuse(more=["--overwrite"]), "out", "holds other files")
    has(refuse(), "out", "--overwrite")
