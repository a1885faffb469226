"""A run that adjusts its cameras first: when it does, what it leaves, and how it resumes.

The block is traced by the simulator and adjusted without a word of the water, as usual software
does it; the cloud is where straight rays of these poses meet.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import pytest

from pcfix.flow.correct import correct_file
from pcfix.flow.inputs import Inputs
from pcfix.flow.run import adjust_first, run
from pcfix.flow.run_folder import RunFolder
from pcfix.model import GnssPositions
from pcfix.options.correct import RunOptions
from tests.utils.block_kinds import GSD_M, write_kind
from tests.utils.clouds import write_las
from tests.utils.codes import refused, warned


def first_step(scene, folder, **options):
    asked = {"cameras": scene.model, "water": "0", **options}
    given = RunFolder(folder, str(scene.folder / "cloud.las"), RunOptions(**asked))
    return adjust_first(given, [path for some in given.files.values() for path in some])


def write_nothing(folder, *_):
    """Leave an empty model, in place of an adjustment."""
    (folder / "colmap").mkdir(parents=True)


STEPS = ["adjust", "correct", "clean", "dsm", "compare", "map", "report"]
pytestmark = pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")


class Scene(NamedTuple):
    folder: Path
    truth: np.ndarray

    @property
    def model(self):
        return str(self.folder / "model")

    @property
    def gnss(self):
        return str(self.folder / "gnss.csv")

    def run(self, folder, **options):
        return run(self.folder / "cloud.las", folder, cameras=self.model, water="0", **options)

    def adjusted(self, folder, printed):
        surveys = {"gnss": self.gnss, "reference": self.folder / "truth.las"}
        return self.run(folder, adjust="yes", say=printed.append, **surveys)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    truth = write_kind(folder, "20 % land", 4)
    write_las(folder / "truth.las", truth)
    return Scene(folder, truth)


def errors_gsd(path, truth):
    """Return rms height errors of bed and land, GSD."""
    error = (np.array(laspy.read(path).xyz) - truth)[:, 2] / GSD_M
    wet = truth[:, 2] < 0.0
    return [float(np.sqrt(np.mean(error[rows] ** 2))) for rows in (wet, ~wet)]


@pytest.fixture(scope="module")
def finished(scene, tmp_path_factory):
    folder, printed = tmp_path_factory.mktemp("run") / "out", []
    scene.adjusted(folder, printed)
    return folder, printed


def test_cloud_comes_home(scene, finished):
    folder, _ = finished
    bed, land = errors_gsd(folder / "corrected.laz", scene.truth)
    # vertical images of 0.5 px and GNSS of 3 cm know the focal length to 1.5 px, which is 1.5 GSD
    # of height; with true poses the noise of 3 to 12 rays leaves 1.0 GSD; 1.7 standard errors
    assert bed < 3.0
    assert land < 3.0
    apparent = errors_gsd(scene.folder / "cloud.las", scene.truth)
    assert min(apparent) > 6.0


def test_first_step(finished):
    folder, printed = finished
    assert [line.split()[0] for line in printed if not line.startswith(" ")] == STEPS
    assert printed[0] == f"adjust    done: {folder / 'adjusted' / 'report.html'}"
    assert "focal length" in printed[1]
    assert "under water" in printed[1]
    record = json.loads((folder / "run.json").read_text())
    assert record["steps"]["adjust"]["result"]["model"] == "colmap"
    assert record["options"]["cameras"].endswith("model")


def test_resumed(scene, finished):
    folder, _ = finished
    printed = []
    scene.adjusted(folder, printed)
    assert sum("already done" in line for line in printed) == len(STEPS)


def test_auto(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("pcfix.flow.run.adjust_into", write_nothing)
    step = first_step(scene, tmp_path, gnss=scene.gnss)
    assert step["model"] == "colmap"
    assert "tie points under water" in step["why"]


@pytest.mark.usefixtures("undrawn")
def test_auto_without_datum(scene, tmp_path):
    printed = []
    with warned("poses.absorbed"):
        page = scene.run(tmp_path / "out", say=printed.append).report
    with warned("poses.absorbed"):
        correct_file(
            scene.folder / "cloud.las", tmp_path / "plain.laz", cameras=scene.folder / "model",
            water=0.0,
        )  # fmt: skip
    one, other = (laspy.read(tmp_path / name) for name in ("out/corrected.laz", "plain.laz"))
    np.testing.assert_array_equal(one.points.array, other.points.array)
    assert not (tmp_path / "out" / "adjusted").exists()
    (line,) = [line for line in printed if line.startswith("adjust")]
    assert line.startswith("adjust    skipped: the camera file has no GNSS positions")
    assert "not adjusted: the camera file has no GNSS positions" in page.read_text()


@pytest.mark.parametrize(("sigma_m", "is_datum"), [(0.03, True), (10.0, False)])
def test_datum_of_camera_file(scene, tmp_path, monkeypatch, sigma_m, is_datum):
    """10 m is what Metashape writes for positions of unknown accuracy."""
    original = Inputs.block

    def with_gnss(inputs, *args):
        cameras, views = original(inputs, *args)
        xyz = np.genfromtxt(scene.gnss, delimiter=",", skip_header=1)[:, 1:4]
        sigma = np.full((len(cameras), 3), sigma_m)
        return replace(cameras, gnss=GnssPositions(xyz, sigma, "EPSG:32633")), views

    monkeypatch.setattr(Inputs, "block", with_gnss)
    monkeypatch.setattr("pcfix.flow.run.adjust_into", write_nothing)
    model = first_step(scene, tmp_path)["model"]
    assert (model is not None) is is_datum


def test_water_dimension(scene, tmp_path):
    las = laspy.read(scene.folder / "cloud.las")
    las.add_extra_dim(laspy.ExtraBytesParams("w_surf", "f4"))
    las["w_surf"] = np.full(len(las), 0.0, np.float32)
    las.write(tmp_path / "cloud.las")
    other = Scene(tmp_path, scene.truth)
    options = {"cameras": scene.model, "water": "dim:w_surf", "gnss": scene.gnss}
    step = first_step(other, tmp_path, **options)
    assert step["model"] is None
    assert "w_surf" in step["why"]
    with refused("water.dimension"):
        first_step(other, tmp_path, adjust="yes", **options)


@pytest.mark.parametrize(
    "words",
    [
        {"adjust": "no", "gnss": "gnss.csv"},
        {"adjust": "no", "lens": "lens.xml"},
        {"adjust": "yes", "adjusted_from": "old"},
        {"adjust": "yes", "tide": "tide.csv"},
    ],
)
def test_conflicts(tmp_path, words):
    with refused("option.conflict", value=words["adjust"]):
        run("cloud.las", tmp_path / "out", cameras="cameras.csv", water="0", **words)
