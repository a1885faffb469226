"""What a run passes on to its comparison: directions, shares and further clouds of C2C."""

import json
import shutil

import pytest

import pcfix
from pcfix.flow.request import Request, request_of
from pcfix.flow.run import run_all
from tests.compare.test_files import LIDAR, SCENE


def request(**more):
    given = {"input": str(SCENE / "cloud.laz"), "cameras": str(SCENE / "cameras.csv")}
    return Request(**given, water="0.37", adjust="no", **more)


def test_a_run_shows_c2c_both_ways_and_further_clouds(tmp_path):
    further = tmp_path / "raw.laz"
    shutil.copy(SCENE / "cloud.laz", further)
    asked = request(
        reference=str(LIDAR), direction="both", share=["0.6,1.0"], classes=50,
        also={"raw": further},
    )  # fmt: skip
    said: list[str] = []
    page = run_all(asked, tmp_path / "out", say=said.append).read_text()
    figures = json.loads((tmp_path / "out" / "compare" / "compare.json").read_text())
    for way in ("c2c", "c2c_from_reference"):
        normal = figures[way]["after"]["normal"]
        assert f"<td>{normal['mu_m']:.6f}</td><td>{normal['sigma_m']:.6f}</td><td>50</td>" in page
        came, raw = figures[way]["before"]["statistics"], figures["also"][0][way]["statistics"]
        # the raw cloud is what the corrected one came as; cleaning left out a few points
        assert raw["mean_m"] == pytest.approx(came["mean_m"], abs=0.01)
    assert "0.6 to 1 m" in page and "from reference, raw" in page
    assert (tmp_path / "out" / "figures" / "histogram_c2c.png").exists()
    assert request_of(tmp_path / "out" / "run.json") == asked
    run_all(asked, tmp_path / "out", say=said.append)
    assert sum("done before" in line for line in said) == len(said) // 2
    further.unlink()
    with pytest.raises(pcfix.InputError, match=r"raw\.laz: there is no such file"):
        run_all(asked, tmp_path / "out")


@pytest.mark.parametrize(
    "more", [{"direction": "both"}, {"share": "1,2"}, {"also": "a=b.laz"}, {"classes": 9}]
)
def test_without_a_reference_there_is_nothing_to_compare(more):
    (name,) = more
    with pytest.raises(pcfix.SettingError, match=f"{name} has no effect without --reference"):
        request(**more)
