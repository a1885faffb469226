"""The effect of refraction on a pair of vertical images: physics, files, and mistakes."""

import csv
import json
import math
from functools import partial

import numpy as np
import pytest

import pcfix
from pcfix.errors import SettingError
from pcfix.options.scenes import SimulateOptions
from pcfix.simulate.hsu_wang import simulate_bowl
from pcfix.simulate.refraction_effect import (
    SWINGLETCAM,
    ULTRACAM,
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


def test_without_refraction_nothing_moves():
    still = effect(PAIR, 15.0, 1.0)
    assert np.abs(still.error_m).max() < 1e-9  # m, rounding of sums about 100
    assert still.shift_m.max() < 1e-9


def test_from_far_away_the_depth_is_short_by_the_index():
    far = effect(StereoPair(SWINGLETCAM, 1e5, 0.99), 2.0)
    # the rays of the centre are 0.36 degrees off the vertical: 1e-4 of the depth at most
    assert far.centre_m == pytest.approx(-0.34 * 2.0, abs=2e-4)


def test_in_the_centre_angles_say_the_same():
    """Two rays that are mirror images meet above the centre; Snell's law in one triangle."""
    tan_air = PAIR.base_m / 2.0 / (100.0 + 15.0)
    tan_water = math.tan(math.asin(math.sin(math.atan(tan_air)) / 1.34))
    true = 15.0 * tan_air / tan_water
    assert effect(PAIR, 15.0).centre_m == pytest.approx(15.0 - true, abs=1e-9)


def test_light_from_the_true_point_comes_back_to_the_apparent_one():
    """Fermat's way from the true point: where two rays meet, straight lines meet as well."""
    apparent = np.array([[0.0, y, -15.0] for y in (0.0, 20.0, 60.0)])  # on the plane of symmetry
    true = true_points(apparent, PAIR.centres, 1.34)
    for centre in PAIR.centres:
        surface = piercing_points(true, np.tile(centre, (3, 1)), 0.0, 1.34)
        sight, to_apparent = surface - centre, apparent - centre
        # the sine of the angle between the two lines, which are about 120 m long
        apart = (
            np.cross(sight, to_apparent)
            / (np.linalg.norm(sight, axis=1) * np.linalg.norm(to_apparent, axis=1))[:, None]
        )
        assert np.abs(apart).max() < 1e-9


def test_agrees_with_the_slow_twin_where_rays_do_not_meet():
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-45, 45, (20, 2)), -rng.uniform(0.5, 15.0, 20)])
    found = true_points(points, PAIR.centres, 1.34)
    for point, fast in zip(points, found, strict=True):
        slow, _, _ = correct_slowly(point, PAIR.centres, (0.0, 0.0, 0.0), 1.34)
        assert fast == pytest.approx(slow, abs=1e-8)  # m, a dense least-squares solution


def test_the_correction_agrees_with_it():
    model = effect(PAIR, 15.0, nodes=9)
    x, y = (side.ravel() for side in np.meshgrid(model.x_m, model.y_m))
    apparent = np.column_stack([x, y, np.full(len(x), -15.0)])
    cameras = pcfix.Cameras(("left", "right"), PAIR.centres)
    corrected = pcfix.correct_points(apparent, cameras, 0.0, index=1.34).xyz
    assert corrected[:, 2] == pytest.approx(model.error_m.ravel() - 15.0, abs=1e-8)  # m


def test_the_map_is_symmetric_and_worst_in_the_corners():
    error = effect(PAIR, 10.0).error_m
    assert error == pytest.approx(error[::-1], abs=1e-9)
    assert error == pytest.approx(error[:, ::-1], abs=1e-9)
    assert error.min() == error[0, 0]
    assert error.max() == error[30, 30]


def test_deeper_and_wider_is_worse():
    by_depth = [one.centre_m for one in effects([PAIR], (1.0, 2.0, 5.0, 15.0))]
    assert by_depth == sorted(by_depth, reverse=True)
    wide, narrow = (effect(StereoPair(c, 1000.0), 10.0) for c in (SWINGLETCAM, ULTRACAM))
    assert wide.corner_m < narrow.corner_m


@pytest.mark.parametrize(
    ("made", "what"),
    [
        (lambda: StereoPair(SWINGLETCAM, -1.0), "flying height -1 m"),
        (lambda: StereoPair(SWINGLETCAM, 100.0, 1.0), "overlap 1 is not between 0 and 1"),
        (lambda: StereoPair(SWINGLETCAM, 100.0, 80.0), "give a share, as 0.8"),
        (lambda: AerialCamera("x", 0.0, 4000, 3000, 1.5), "focal length 0"),
        (lambda: effect(PAIR, 0.0), "apparent depth 0 m"),
        (lambda: effect(PAIR, math.nan), "apparent depth nan m"),
        (lambda: effects([PAIR], (0.0,)), "apparent depth 0 m is not finite and above 0"),
        (lambda: effects([PAIR], (0.0, -1.0)), "apparent depth -1 m"),
        (lambda: effects([PAIR], (0.0, 0.0)), "apparent depth 0 m"),
        (lambda: SimulateOptions(refraction_effect=True, effect_overlap=0.8), r"as \(0.8,\)"),
        (lambda: effects([PAIR], (1.0, math.inf)), "apparent depth inf m"),
        (lambda: effect(PAIR, 5.0, 1.7), "1.7"),
    ],
)
def test_mistakes_are_told(made, what):
    with pytest.raises(SettingError, match=what):
        made()


FIGURES = "", "_bed", "_stack"
"""Maps, Fig 4, and Figs 5 and 6."""


def run(*words):
    return run_pcfix("simulate", *words)


@pytest.fixture
def bowl(monkeypatch):
    """A bowl of few points beside the pair, whose figures tests/papers looks at."""
    monkeypatch.setattr("pcfix.flow.papers.simulate_bowl", partial(simulate_bowl, 0.01))


@pytest.mark.usefixtures("bowl")
def test_command_writes_tables_and_pictures(tmp_path):
    done = run(tmp_path / "out", "--refraction-effect")
    assert done.returncode == 0, done.stderr
    assert "-8.232 m" in done.stdout and "-5.147 m" in done.stdout and "published" in done.stdout
    rows = list(csv.DictReader((tmp_path / "out" / "refraction_effect.csv").open()))
    assert len(rows) == (2 + 2 * 2) * 16
    chosen = [r for r in rows if (r["flying_height_m"], r["apparent_depth_m"]) == ("100.0", "15.0")]
    assert float(chosen[0]["error_corner_m"]) == pytest.approx(-8.2322, abs=1e-4)  # m, as written
    assert (rows[0]["error_corner_m"], rows[0]["factor_corner"]) == ("0.0", "")  # at depth 0
    settings = json.loads((tmp_path / "out" / "refraction_effect.json").read_text())
    assert [one["overlaps"] for one in settings["cameras"]] == [[0.8], [0.6, 0.8]]
    assert settings["refractive_index"] == 1.3405
    drawn = [f"{name}{kind}" for name in ("swingletcam", "ultracamx") for kind in FIGURES]
    for name in (*drawn, "depth"):
        picture = (tmp_path / "out" / f"refraction_effect_{name}.png").read_bytes()
        assert picture.startswith(b"\x89PNG")
    again = run(tmp_path / "out", "--refraction-effect")
    assert again.returncode != 0 and "--overwrite" in again.stderr


@pytest.mark.usefixtures("bowl")
def test_command_takes_a_camera_of_ones_own(tmp_path):
    """With no refraction at all, so that the maps have to draw a level error too."""
    camera = "--effect-focal-mm 8.8 --effect-frame-px 5472x3648 --effect-pixel-um 2.41"
    pair = "--effect-overlap 0.6 --effect-heights 30 --effect-depths 1:5:3 --index 1 --quiet"
    done = run(tmp_path / "own", "--refraction-effect", *camera.split(), *pair.split())
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    rows = list(csv.DictReader((tmp_path / "own" / "refraction_effect.csv").open()))
    assert [r["apparent_depth_m"] for r in rows] == ["1.0", "4.0"]
    base = 0.4 * 3648 * 2.41e-6 * 30.0 / 8.8e-3
    assert float(rows[0]["base_m"]) == pytest.approx(base, abs=1e-4)  # m, as written
    assert float(rows[1]["error_corner_m"]) == pytest.approx(0.0, abs=1e-5)
    for kind in FIGURES:
        assert (tmp_path / "own" / f"refraction_effect_camera{kind}.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--effect-overlap", "0.7"], "--effect-overlap goes with --refraction-effect"),
        (["--refraction-effect", "--effect-focal-mm", "5"], "give all three"),
        (["--refraction-effect", "--effect-heights", "high"], "not a list of numbers"),
        (["--refraction-effect", "--effect-heights", "1,2,3,4,5,6,7"], "6 at most"),
        (["--refraction-effect", "--effect-depths", "-2"], "apparent depth -2 m"),
        (
            ["--refraction-effect", "--effect-depths", "0"],
            "apparent depth 0 m is not finite and above 0",
        ),
        (
            ["--refraction-effect", "--effect-depths", "0:0:1"],
            "apparent depth 0 m is not finite and above 0",
        ),
        (["--refraction-effect", "--effect-depths", "0:15:-1"], "with a step above 0, as 0:15:1"),
        (["--refraction-effect", "--effect-depths", "15:0:1"], "upwards"),
        (["--refraction-effect", "--effect-depths", "0:15"], "not FROM:TO:STEP"),
        (["--refraction-effect", "--effect-depths", "0:deep:1"], "0:deep:1 is not FROM:TO:STEP"),
        (["--refraction-effect", "--effect-depths", "0:15:0.01"], "1501 depths; give 100"),
        (["--refraction-effect", "--effect-depths", "shallow"], "not a list of numbers"),
        (["--refraction-effect", "--effect-overlap", "much"], "not a list of numbers"),
        (
            [
                "--refraction-effect",
                "--effect-focal-mm",
                "5",
                "--effect-pixel-um",
                "2",
                "--effect-frame-px",
                "4000",
            ],
            "not WIDTHxHEIGHT",
        ),
    ],
)
def test_wrong_options_are_told(tmp_path, words, what):
    done = run(tmp_path / "no", *words)
    assert done.returncode == 1
    assert what in done.stderr
