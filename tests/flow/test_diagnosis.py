"""Absorbed refraction: one warning in a correction, all signs in `pcfix cameras`."""

import json
import warnings

import numpy as np
import pytest

import pcfix
from pcfix.adjust.diagnosis import Diagnosis, land_sign, neighbours_sign
from pcfix.errors import PcfixWarning
from pcfix.flow.cameras import cameras_text, check_cameras
from pcfix.flow.inputs import Inputs
from pcfix.flow.poses import adjust_words
from tests.utils.crops import middle_of
from tests.utils.shared import SCENE, needs

TRUE, rendered = needs("rendered_a")
ABSORBED, needs_absorbed = needs("rendered_a_free")
OFFSET_M = (319900.0, 3842700.0, 0.0)
LEVEL_M = 0.37


def warnings_of(source, output, **given):
    """Return the warnings of absorbed refraction, and the summary, of a correction."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        summary = pcfix.correct_file(source, output, **given)
    found = [one.message for one in caught if issubclass(one.category, PcfixWarning)]
    return [one for one in found if one.code == "poses.absorbed"], summary


@needs_absorbed
def test_bent_poses(tmp_path):
    model, cloud = ABSORBED / "sparse", middle_of(ABSORBED, tmp_path) / "cloud.las"
    found, summary = warnings_of(
        cloud, tmp_path / "out.laz", cameras=model, cameras_offset=OFFSET_M, water=LEVEL_M
    )
    assert len(found) == 1
    values = found[0].values
    assert values["command"].startswith(f"pcfix adjust {model} OUT --water 0.37 --cloud {cloud}")
    # the land lies 0.96 m too low; the block's own centres tell most of it
    assert 0.6 < values["likely_error_m"] < 1.3
    assert found[0].as_dict() in summary.warnings
    assert summary.absorbed is True
    assert summary.as_dict()["uncertainty"]["s44"] is None and summary.why_no_order


@rendered
def test_true_poses(tmp_path):
    level = json.loads((SCENE / "scene.json").read_text())["water_level_m"]
    rendered_a = {"cameras": TRUE / "colmap", "cameras_offset": OFFSET_M, "water": LEVEL_M}
    for cloud, given in (
        (middle_of(TRUE, tmp_path) / "cloud.las", rendered_a),
        (SCENE / "cloud.laz", {"cameras": SCENE / "cameras.csv", "water": level}),
    ):
        assert warnings_of(cloud, tmp_path / "out.laz", overwrite=True, **given)[0] == []


@needs_absorbed
@pytest.mark.filterwarnings("ignore:.*names no CRS")
def test_every_sign():
    report = check_cameras(
        ABSORBED / "sparse", cloud=ABSORBED / "cloud.las", water=LEVEL_M, cameras_offset=OFFSET_M,
        gnss=ABSORBED / "gnss.csv", gcps=ABSORBED / "gcps.csv", reference=TRUE / "lidar.laz",
    )  # fmt: skip
    signs = report.figures["refraction"]["signs"]
    assert {sign["name"] for sign in signs} == {
        "tie points", "GNSS positions", "measured depths", "heights of land",
    }  # fmt: skip
    assert all(sign["absorbed"] for sign in signs)
    # the README of the data: the land is 0.96 m too low
    assert report.figures["refraction"]["likely_error_m"] == pytest.approx(0.96, abs=0.05)
    text = cameras_text(report)
    assert "the poses have absorbed the refraction" in text
    assert "--gcps" in text


@needs_absorbed
def test_gnss_is_enough():
    report = check_cameras(
        ABSORBED / "cameras.xml",
        cloud=ABSORBED / "cloud.las",
        water=LEVEL_M,
        gnss=ABSORBED / "gnss.csv",
    )
    assert report.diagnosis.decided_by.name == "GNSS positions"
    assert report.diagnosis.absorbed is True


@needs_absorbed
@pytest.mark.filterwarnings("ignore:.*names no CRS")
def test_no_sign():
    report = check_cameras(
        TRUE / "colmap", cloud=TRUE / "cloud.las", water=LEVEL_M, cameras_offset=OFFSET_M,
        gnss=ABSORBED / "gnss.csv", gcps=ABSORBED / "gcps.csv", reference=TRUE / "lidar.laz",
    )  # fmt: skip
    assert report.diagnosis.absorbed is False
    assert not any(sign.absorbed for sign in report.diagnosis.signs)
    assert report.figures["refraction"]["likely_error_m"] is None


@pytest.mark.parametrize(
    ("share", "sigma", "is_fused", "absorbed"),
    [
        (0.02, 0.03, True, False),
        (0.25, 0.02, True, False),
        (0.86, 0.02, True, True),
        (0.86, 0.02, False, None),  # the reconstruction type may be wrong
        (0.25, 0.02, False, False),
        (0.6, 0.05, True, None),
    ],
)
def test_neighbours_sign(share, sigma, is_fused, absorbed):
    assert neighbours_sign(share, sigma, is_fused=is_fused).absorbed is absorbed


def test_neighbours_last():
    off = land_sign(np.ones(9), 0.05)
    assert Diagnosis((off, neighbours_sign(0.1, 0.01, is_fused=True))).absorbed is True
    seems = Diagnosis((neighbours_sign(0.9, 0.01, is_fused=True),))
    assert seems.sentence("pcfix adjust").startswith("The poses seem to have absorbed")


def test_command():
    inputs = Inputs(
        cameras="my model", water=0.5, cameras_offset=(1.0, 2.0, 3.0), cameras_crs="EPSG:25830",
        views="dense.vis", views_are="depth-maps",
    )  # fmt: skip
    head = "pcfix adjust 'my model' OUT --water 0.5 --cloud cloud.laz"
    tail = (
        "--cameras-crs EPSG:25830 --cameras-offset 1,2,3 --views dense.vis --views-are depth-maps"
    )
    command = adjust_words(inputs, "cloud.laz", has_datum=False, gnss="gnss.csv")
    assert command == f"{head} {tail} --gnss gnss.csv"
    command = adjust_words(inputs, "cloud.laz", has_datum=False)
    assert command == f"{head} {tail} --gnss GNSS.csv"
