"""The effect of refraction on a pair of vertical images: physics, files, and mistakes."""

import csv
import json
import math
from functools import partial

import numpy as np
import pytest

import pcfix
from pcfix.errors import SettingError
from pcfix.simulate.hsu_wang import simulate_bowl
from pcfix.simulate.refraction_effect import (
    SWINGLETCAM,
    AerialCamera,
    StereoPair,
    effect,
    effects,
    true_points,
)
from pcfix.simulate.tracing import piercing_points
from tests.utils.program import run_pcfix
from tests.utils.twins import correct_slowly

PAIR = StereoPair(SWINGLETCAM, 100.0)
EFFECT = "--refraction-effect"
FIGURES = "", "_bed", "_stack"
"""Maps, Fig 4, and Figs 5 and 6."""


def test_index_of_one():
    still = effect(PAIR, 15.0, 1.0)
    assert np.abs(still.error_m).max() < 1e-9  # m, rounding of sums about 100
    assert still.shift_m.max() < 1e-9


def test_centre_by_triangle():
    """Two rays that are mirror images meet above the centre; Snell's law in one triangle."""
    tan_air = PAIR.base_m / 2.0 / (100.0 + 15.0)
    tan_water = math.tan(math.asin(math.sin(math.atan(tan_air)) / 1.34))
    true = 15.0 * tan_air / tan_water
    assert effect(PAIR, 15.0).centre_m == pytest.approx(15.0 - true, abs=1e-9)


def test_light_from_true_point():
    """Fermat's path from the true point: where two rays meet, straight lines meet as well."""
    apparent = np.array([[0.0, y, -15.0] for y in (0.0, 20.0, 60.0)])  # on the plane of symmetry
    true = true_points(apparent, PAIR.centres, 1.34)
    for centre in PAIR.centres:
        surface = piercing_points(true, np.tile(centre, (3, 1)), 0.0, 1.34)
        sight, straight = surface - centre, apparent - centre
        lengths = np.linalg.norm(sight, axis=1) * np.linalg.norm(straight, axis=1)
        sine = np.cross(sight, straight) / lengths[:, None]  # of two lines of about 120 m
        assert np.abs(sine).max() < 1e-9


def test_slow_twin():
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-45, 45, (20, 2)), -rng.uniform(0.5, 15.0, 20)])
    found = true_points(points, PAIR.centres, 1.34)
    for point, fast in zip(points, found, strict=True):
        slow, _, _ = correct_slowly(point, PAIR.centres, (0.0, 0.0, 0.0), 1.34)
        assert fast == pytest.approx(slow, abs=1e-8)  # m, a dense least-squares solution


def test_correction_agrees():
    model = effect(PAIR, 15.0, nodes=9)
    x, y = (side.ravel() for side in np.meshgrid(model.x_m, model.y_m))
    apparent = np.column_stack([x, y, np.full(len(x), -15.0)])
    cameras = pcfix.Cameras(("left", "right"), PAIR.centres)
    corrected = pcfix.correct_points(apparent, cameras, 0.0, index=1.34).xyz
    assert corrected[:, 2] == pytest.approx(model.error_m.ravel() - 15.0, abs=1e-8)  # m


def test_symmetric():
    error = effect(PAIR, 10.0).error_m
    assert error == pytest.approx(error[::-1], abs=1e-9)
    assert error == pytest.approx(error[:, ::-1], abs=1e-9)
    assert (error.min(), error.max()) == (error[0, 0], error[30, 30])


@pytest.mark.parametrize(
    "made",
    [
        lambda: StereoPair(SWINGLETCAM, -1.0),
        lambda: StereoPair(SWINGLETCAM, 100.0, 1.0),
        lambda: StereoPair(SWINGLETCAM, 100.0, 80.0),
        lambda: AerialCamera("x", 0.0, 4000, 3000, 1.5),
        lambda: effect(PAIR, math.nan),
        lambda: effects([PAIR], (0.0, 0.0)),
        lambda: effects([PAIR], (0.0, -1.0)),
        lambda: effects([PAIR], (1.0, math.inf)),
    ],
)
def test_out_of_range(made):
    with pytest.raises(SettingError) as caught:
        made()
    assert caught.value.code == "option.range"


@pytest.fixture
def bowl(monkeypatch):
    """A bowl of few points beside the pair, whose figures tests/papers checks."""
    monkeypatch.setattr("pcfix.flow.papers.simulate_bowl", partial(simulate_bowl, 0.01))


def rows_of(folder):
    return list(csv.DictReader((folder / "refraction_effect.csv").open()))


@pytest.mark.usefixtures("bowl")
def test_command(tmp_path):
    done = run_pcfix("simulate", tmp_path, EFFECT)
    assert done.returncode == 0, done.stderr
    assert "-8.232 m" in done.stdout and "-5.147 m" in done.stdout
    rows = rows_of(tmp_path)
    assert len(rows) == (2 + 2 * 2) * 16
    chosen = [r for r in rows if (r["flying_height_m"], r["apparent_depth_m"]) == ("100.0", "15.0")]
    assert float(chosen[0]["error_corner_m"]) == pytest.approx(-8.2322, abs=1e-4)  # m, as written
    assert (rows[0]["error_corner_m"], rows[0]["factor_corner"]) == ("0.0", "")  # at depth 0
    settings = json.loads((tmp_path / "refraction_effect.json").read_text())
    assert [one["overlaps"] for one in settings["cameras"]] == [[0.8], [0.6, 0.8]]
    assert settings["refractive_index"] == 1.3405
    drawn = [f"{name}{kind}" for name in ("swingletcam", "ultracamx") for kind in FIGURES]
    for name in (*drawn, "depth"):
        assert (tmp_path / f"refraction_effect_{name}.png").read_bytes().startswith(b"\x89PNG")
    assert run_pcfix("simulate", tmp_path, EFFECT).returncode == 1  # exists


@pytest.mark.usefixtures("bowl")
def test_own_camera(tmp_path):
    """With no refraction, so that the maps have to draw a level error too."""
    camera = "--effect-focal-mm 8.8 --effect-frame-px 5472x3648 --effect-pixel-um 2.41"
    pair = "--effect-overlap 0.6 --effect-heights 30 --effect-depths 1:5:3 --index 1 --quiet"
    done = run_pcfix("simulate", tmp_path, EFFECT, *camera.split(), *pair.split())
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    rows = rows_of(tmp_path)
    assert [r["apparent_depth_m"] for r in rows] == ["1.0", "4.0"]
    base = 0.4 * 3648 * 2.41e-6 * 30.0 / 8.8e-3
    assert float(rows[0]["base_m"]) == pytest.approx(base, abs=1e-4)  # m, as written
    assert float(rows[1]["error_corner_m"]) == pytest.approx(0.0, abs=1e-5)
    for kind in FIGURES:
        assert (tmp_path / f"refraction_effect_camera{kind}.png").stat().st_size > 5000


@pytest.mark.parametrize(
    "words",
    [
        "--effect-overlap 0.7",
        f"{EFFECT} --effect-focal-mm 5",
        f"{EFFECT} --effect-heights high",
        f"{EFFECT} --effect-heights 1,2,3,4,5,6,7",
        f"{EFFECT} --effect-depths -2",
        f"{EFFECT} --effect-depths 0:0:1",
        f"{EFFECT} --effect-depths 0:15:-1",
        f"{EFFECT} --effect-depths 15:0:1",
        f"{EFFECT} --effect-depths 0:15",
        f"{EFFECT} --effect-depths 0:15:0.01",
        f"{EFFECT} --effect-focal-mm 5 --effect-pixel-um 2 --effect-frame-px 4000",
    ],
)
def test_wrong_options(tmp_path, words):
    done = run_pcfix("simulate", tmp_path / "no", *words.split())
    assert done.returncode == 1
    assert done.error is not None
    assert not (tmp_path / "no").exists()
