"""The sentences that users read most often, word by word; other tests compare codes and values."""

import pytest

from tests.test_bad_input import TABLES, correct
from tests.utils.clouds import block, cameras_csv, write_cloud
from tests.utils.program import run_pcfix

MESSAGES = [
    (correct(cloud="nowhere.las"), "nowhere.las: there is no such file."),
    (
        correct(cloud="text.las"),
        "text.las: is damaged, or is not a LAS or LAZ file (it does not begin with LASF). Export or"
        " copy it again.",
    ),
    (
        correct("--water", "dim:w_surf"),
        "cloud.las: has no dimension w_surf; its extra dimensions are Quality, Level, Precise,"
        " Normal, Blob, Echo.",
    ),
    (
        correct("--water", "-40"),
        "cloud.las: no point lies below the water (level -40 m); the cloud's heights are 4.13 to"
        " 29.85 m. Check the height of the water and its vertical datum.",
    ),
    (
        correct("--water", "500"),
        "9 of 9 cameras are under the water (level 500 m), the first c0 at z = 87.40 m. Check the"
        " vertical datum, the order of the columns and the water surface.",
    ),
    (
        correct("--cameras", "word.csv"),
        "word.csv: line 3 (image b): column x: 'east' is not a finite number. Correct it.",
    ),
    (
        correct("--cameras", "angles.csv"),
        "angles.csv: has angles but no sensor. Give --sensor a table with the columns"
        " focal,sensor_x,sensor_y (mm).",
    ),
    (correct(output="text.las"), "text.las: the output exists. Add --overwrite to replace it."),
    (correct("--index", "1.6"), "index 1.6 must be at least 1 and at most 1.5."),
    (
        ["restore", "cloud.las", "back.las"],
        "cloud.las: was not corrected by pcfix; there is nothing to undo.",
    ),
    (["correct", "a.las", "b.las"], "--water is needed, or --port\nTry 'pcfix correct --help'."),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    at = tmp_path_factory.mktemp("messages")
    write_cloud(at / "cloud.las", 3, count=300)
    cameras_csv(at / "cameras.csv", block())
    cameras_csv(at / "angles.csv", block(), angles=True)
    (at / "word.csv").write_text(TABLES["word"])
    (at / "text.las").write_text("x y z\n1 2 3\n")
    return at


@pytest.mark.parametrize(("words", "message"), MESSAGES)
def test_message(words, message, folder):
    assert run_pcfix(*words, folder=folder).stderr == f"pcfix: {message}\n"
