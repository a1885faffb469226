"""A run that adjusts its cameras first: when it does, what it leaves, and how it resumes.

The block is traced by the simulator and adjusted without a word of the water, as usual software
does it; the cloud is where straight rays of these poses meet.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from typing import NamedTuple

import laspy
import numpy as np
import pyproj
import pytest

from pcfix.adjust.problem import intersect_fixed
from pcfix.errors import GeometryError, PcfixWarning, SettingError
from pcfix.flow.correct import correct_file
from pcfix.flow.inputs import Inputs
from pcfix.flow.request import Request, request_of
from pcfix.flow.run import run_all
from pcfix.flow.run_adjust import adjust_first, figures_of
from pcfix.io.cameras.colmap.writing import write_colmap
from pcfix.model import TiePoints, Views
from pcfix.report.run import adjustment_table
from tests.utils.bent_blocks import GNSS_M, LEVEL_M, TrueBlock
from tests.utils.program import run_pcfix


def first_step(request, folder):
    inputs = [path for some in request.files().values() for path in some]
    return adjust_first(request.adjust_step(), folder, inputs)


ORIGIN_M = (319900.0, 3842700.0, 0.0)
GSD_M = 0.05
STEPS = ["adjust", "correct", "clean", "dsm", "compare", "map", "report"]
pytestmark = pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")


class Scene(NamedTuple):
    folder: object
    truth: np.ndarray

    def request(self, cameras="bent", **words):
        """Return a request; the models do not say where they lie."""
        return Request(
            input=str(self.folder / f"{cameras}.las"), cameras=str(self.folder / cameras),
            water=str(LEVEL_M),
            cameras_offset=ORIGIN_M, **words,
        )  # fmt: skip

    @property
    def gnss(self):
        return str(self.folder / "gnss.csv")

    def whole(self):
        return self.request(adjust="yes", gnss=self.gnss, reference=str(self.folder / "truth.las"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    block = TrueBlock(4)
    for name, cameras in (("bent", block.adjusted()), ("true", block.cameras)):
        _write(folder, name, block, cameras)
    _write_las(folder / "truth.las", block.xyz + ORIGIN_M)
    rows = [
        f"{label},{x:.4f},{y:.4f},{z:.4f},{GNSS_M},{GNSS_M},{GNSS_M}"
        for label, (x, y, z) in zip(
            block.cameras.labels, block.cameras.gnss.xyz + ORIGIN_M, strict=True
        )
    ]
    (folder / "gnss.csv").write_text("\n".join(["image,x,y,z,sx,sy,sz", *rows]) + "\n")
    return Scene(folder, block.xyz + ORIGIN_M)


def _write(folder, name, block, cameras):
    """Write a model and the cloud that it makes."""
    apparent = intersect_fixed(block.block(cameras, None)).xyz
    ties = TiePoints(apparent, Views(block.start, block.camera), block.image_xy)
    write_colmap(folder / name, replace(cameras, gnss=None), ties, offset_m=(0.0, 0.0, 0.0))
    (folder / name / "georeference.json").unlink(missing_ok=True)
    _write_las(folder / f"{name}.las", apparent + ORIGIN_M)


def _write_las(path, xyz):
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.add_crs(pyproj.CRS("EPSG:32636"))
    las.header.scales, las.header.offsets = [1e-4] * 3, ORIGIN_M
    las.xyz = xyz
    las.write(path)


def errors_gsd(path, truth):
    """Return rms height errors of bed and land, GSD."""
    error = (np.array(laspy.read(path).xyz) - truth)[:, 2] / GSD_M
    wet = truth[:, 2] < LEVEL_M
    return [float(np.sqrt(np.mean(error[rows] ** 2))) for rows in (wet, ~wet)]


@pytest.fixture(scope="module")
def finished(scene, tmp_path_factory):
    folder, said = tmp_path_factory.mktemp("run") / "out", []
    run_all(scene.whole(), folder, say=said.append)
    return folder, said


def test_cloud_comes_home(scene, finished):
    folder, _ = finished
    bed, land = errors_gsd(folder / "corrected.laz", scene.truth)
    # vertical images of 0.5 px and GNSS of 3 cm know the focal length to 1.5 px, which is 1.5 GSD
    # of height; with true poses the noise of 3 to 12 rays leaves 1.0 GSD; 1.7 standard errors
    assert bed < 3.0
    assert land < 3.0
    apparent = errors_gsd(scene.folder / "bent.las", scene.truth)
    assert min(apparent) > 6.0


def test_first_step_is_said_and_recorded(finished):
    folder, said = finished
    assert [line.split()[0] for line in said if not line.startswith(" ")] == STEPS
    assert said[0] == f"adjust    done: {folder / 'adjusted' / 'report.html'}"
    assert "focal length" in said[1]
    assert "under water" in said[1]
    record = json.loads((folder / "run.json").read_text())
    assert record["steps"]["adjust"]["result"]["model"] == "colmap"
    assert "gnss.csv" in {one["path"].rsplit("/", 1)[-1] for one in record["inputs"]}
    assert record["request"]["cameras"].endswith("bent")


def test_report_tells_of_the_adjustment(finished):
    folder, _ = finished
    page = (folder / "report.html").read_text()
    for words in (
        "Refractive bundle adjustment", "Focal length", "Residuals under water (rms)",
        "Centres minus GNSS", "as that was asked for", "First the whole cloud, land too",
    ):  # fmt: skip
        assert words in page
    assert '<a href="adjusted/report.html">' in page
    summary = json.loads((folder / "adjusted" / "adjustment.json").read_text())
    assert f"{summary['poses']['moved_rms_m']:.3f} m</td>" in page
    assert summary["gnss"]["rms_before_m"][2] > summary["gnss"]["rms_m"][2]


def test_report_has_bed_and_land_before_and_after(finished):
    folder, _ = finished
    page = (folder / "report.html").read_text()
    found = json.loads((folder / "compare" / "compare.json").read_text())
    for name, words in (("bed", "of the bed fell from"), ("land", "Land:")):
        before, after = (found[name][when]["rmse_m"] for when in ("before", "after"))
        assert before > 1.5 * after  # planes through the few points of this scene blur both
        assert f"{words} {before:.3f} to {after:.3f} m" in page
        for when in ("as it came", "corrected"):
            assert f"{name.capitalize()}, vertical error, {when}" in page
    counts = [found[name]["after"]["count"] for name in ("bed", "land")]
    assert sum(counts) == found["counts"]["compared"]


def test_notes_of_the_adjustment_are_said_and_stand_in_the_report(scene, finished, monkeypatch):
    figures = figures_of(finished[0]) | {"notes": ["the GNSS positions lie 0.3 m above"]}
    assert ["Note", "", "The GNSS positions lie 0.3 m above"] in adjustment_table(figures, "p").rows
    monkeypatch.setattr("pcfix.flow.run.figures_of", lambda _: figures)
    said = []
    run_all(scene.whole(), finished[0], say=said.append)
    assert any(line.strip() == "The GNSS positions lie 0.3 m above" for line in said)


def test_a_finished_adjustment_is_not_done_again(scene, finished):
    folder, _ = finished
    said = []
    run_all(scene.whole(), folder, say=said.append)
    assert sum("done before" in line for line in said) == len(STEPS)


def test_a_lost_model_is_made_again(scene, finished, tmp_path, monkeypatch):
    shutil.copytree(finished[0], tmp_path / "out", copy_function=shutil.copy2)
    record = tmp_path / "out" / "run.json"
    record.write_text(record.read_text().replace(str(finished[0]), str(tmp_path / "out")))
    (tmp_path / "out" / "adjusted" / "colmap" / "images.bin").unlink()
    monkeypatch.setattr("pcfix.flow.run_adjust._adjust", _stop)
    with pytest.raises(KeyboardInterrupt):
        run_all(scene.whole(), tmp_path / "out")


def _stop(*_):
    raise KeyboardInterrupt


def test_a_record_repeats_the_adjustment(finished, tmp_path, monkeypatch):
    folder, _ = finished
    seen = []
    monkeypatch.setattr("pcfix.flow.run.run_all", lambda request, *_, **__: seen.append(request))
    words = ["run", str(tmp_path / "again"), "--config", str(folder / "run.json")]
    done = run_pcfix(*words)
    assert done.returncode == 0, done.stderr
    assert seen == [request_of(folder / "run.json")]
    assert (seen[0].adjust, seen[0].gnss[-8:]) == ("yes", "gnss.csv")


def test_auto_adjusts_bent_poses_with_a_datum(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("pcfix.flow.run_adjust._adjust", lambda *_: "colmap")
    step = first_step(scene.request(gnss=scene.gnss), tmp_path)
    assert step["adjusted"]
    assert "absorbed the refraction: tie points under water" in step["why"]


@pytest.mark.usefixtures("undrawn")
def test_auto_without_a_datum_says_what_is_missing(scene, tmp_path):
    said = []
    with pytest.warns(PcfixWarning, match="have absorbed the refraction"):
        page = run_all(scene.request(), tmp_path / "out", say=said.append)
    with pytest.warns(PcfixWarning):
        correct_file(
            scene.folder / "bent.las", tmp_path / "plain.laz", cameras=scene.folder / "bent",
            cameras_offset=ORIGIN_M, water=LEVEL_M,
        )  # fmt: skip
    one, other = (laspy.read(tmp_path / name) for name in ("out/corrected.laz", "plain.laz"))
    np.testing.assert_array_equal(one.points.array, other.points.array)
    assert not (tmp_path / "out" / "adjusted").exists()
    lines = [line for line in said if line.startswith("adjust")]
    assert len(lines) == 1
    assert lines[0].startswith("adjust    not done: nothing says where the block is")
    assert "not adjusted: nothing says where the block is" in page.read_text()


def test_auto_leaves_true_poses_alone(scene, tmp_path):
    step = first_step(scene.request("true", gnss=scene.gnss), tmp_path)
    assert not step["adjusted"]
    assert step["is_said"]
    assert step["why"].startswith("the poses have not absorbed the refraction: tie points")
    step = first_step(scene.request("true"), tmp_path)
    assert (step["adjusted"], step["is_said"]) == (False, False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("sigma_m", "is_datum"), [(0.03, True), (10.0, False)])
def test_positions_in_the_camera_file_are_a_datum_if_they_are_good(
    scene, tmp_path, monkeypatch, sigma_m, is_datum
):
    """10 m is what Metashape writes for positions of unknown accuracy."""
    block, original = TrueBlock(4), Inputs.block

    def with_gnss(inputs, *args):
        cameras, views = original(inputs, *args)
        places = replace(
            block.cameras.gnss, xyz=block.cameras.gnss.xyz + ORIGIN_M,
            sigma_m=np.full((len(cameras), 3), sigma_m),
        )  # fmt: skip
        return replace(cameras, gnss=places), views

    monkeypatch.setattr(Inputs, "block", with_gnss)
    monkeypatch.setattr("pcfix.flow.run_adjust._adjust", lambda *_: "colmap")
    assert first_step(scene.request(), tmp_path)["adjusted"] is is_datum


def test_a_water_dimension_is_not_adjusted(scene, tmp_path):
    las = laspy.read(scene.folder / "bent.las")
    las.add_extra_dim(laspy.ExtraBytesParams("w_surf", "f4"))
    las["w_surf"] = np.full(len(las), LEVEL_M, np.float32)
    las.write(tmp_path / "cloud.las")
    request = replace(
        scene.request(gnss=scene.gnss), input=str(tmp_path / "cloud.las"), water="dim:w_surf"
    )
    step = first_step(request, tmp_path)
    assert not step["adjusted"]
    assert "w_surf" in step["why"]
    with pytest.raises(SettingError, match="known at the points of the cloud only"):
        first_step(replace(request, adjust="yes"), tmp_path)


def test_yes_without_a_datum_stops(scene, tmp_path):
    with pytest.raises((GeometryError, SettingError), match=r"datum|GNSS"):
        run_all(scene.request(adjust="yes"), tmp_path / "out")
    assert not (tmp_path / "out" / "adjusted").exists()
    assert not (tmp_path / "out" / "corrected.laz").exists()


def test_inputs_are_not_replaced(scene, finished, tmp_path):
    shutil.copytree(finished[0] / "adjusted", tmp_path / "out" / "adjusted")
    request = replace(
        scene.whole(),
        cameras=str(tmp_path / "out" / "adjusted" / "colmap"), cameras_offset=None,
    )  # fmt: skip
    with pytest.raises(SettingError, match="give another OUT_DIR"):
        run_all(request, tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "adjusted" / "colmap" / "images.bin").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"adjust": "no", "gnss": "gnss.csv"}, "gnss is of use to an adjustment only"),
        ({"adjust": "no", "lens": "lens.xml"}, "lens is of use to an adjustment only"),
        ({"adjust": "yes", "adjusted_from": "old"}, "the cameras are adjusted already"),
        ({"adjust": "yes", "tide": "tide.csv"}, "each image its own water level"),
        ({"adjust": "perhaps"}, "is not one of auto, yes, no"),
    ],
)
def test_words_that_do_not_go_together(words, sentence):
    with pytest.raises(SettingError, match=sentence):
        Request(input="cloud.las", cameras="cameras.csv", water="0", **words)


def test_records_from_before_adjustments_do_without(finished, tmp_path):
    record = json.loads((finished[0] / "run.json").read_text())
    for name in ("adjust", "gnss", "gcps", "lens"):
        del record["request"][name]
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert request_of(tmp_path / "run.json").adjust == "no"


def test_command_line_passes_its_words(scene, tmp_path):
    words = ["run", f"{scene.folder}/bent.las", str(tmp_path / "out"), "--water", "0"]
    words += ["--cameras", f"{scene.folder}/bent", "--adjust", "no", "--gnss", scene.gnss]
    assert "gnss is of use to an adjustment only" in run_pcfix(*words).stderr
    assert run_pcfix(*words, "--adjust", "maybe").returncode == 2
