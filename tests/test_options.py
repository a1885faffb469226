"""Options are declared once; every door takes them under the same names, by the same rules."""

import pytest

import pcfix
from pcfix.cli.commands import COMMANDS
from pcfix.options.correct import LEVEL_M, CorrectOptions, RunOptions, ScienceOptions
from pcfix.options.declare import options_of
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX, Panel
from pcfix.water.index import with_index
from tests.utils.codes import refused
from tests.utils.program import run_pcfix

KINDS = [one.kind for one in COMMANDS.values()]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_declared(kind):
    names = [one.name for one in options_of(kind)]
    groups = [group for base in kind.__bases__ for group in base.__mro__[:-2]]
    assert len({*groups}) == len(groups)  # none is reached twice
    for one in options_of(kind):
        assert one.panel in list(Panel)
        assert one.help.partition(" [")[0].endswith(".")
        assert one.default is None or one.checked(one.default) == one.default
        assert not one.needs or one.needs.split()[0] in {*names, "reference", "water"}
    kind()


@pytest.mark.parametrize(
    ("keywords", "code", "values"),
    [
        ({"max_angel": 30}, "option.unknown", {"near": "max_angle"}),
        *[
            ({"max_angle": value}, "option.range", {"value": value, "most": 90})
            for value in (0, 91, -5, float("inf"))
        ],
        ({"max_angle": "wide"}, "option.type", {"option": "max_angle", "value": "wide"}),
        ({"jobs": 2.5}, "option.type", {"option": "jobs"}),
        ({"jobs": 0}, "option.range", {"least": 1}),
        ({"jobs": "two"}, "option.type", {"option": "jobs"}),
        ({"method": "snell", "camera_set": "mvs"}, "option.needs", {"option": "camera_set"}),
        ({"method": "snel"}, "option.choice", {"option": "method", "value": "snel"}),
        ({"index": 0.99}, "option.range", {"option": "index"}),
        ({"index": 1.51}, "option.range", {"option": "index"}),
        ({"sigma_image": float("nan")}, "option.range", {"option": "sigma_image"}),
        ({"cameras_offset": "1,2"}, "option.count", {"option": "cameras_offset"}),
        ({"cameras_offset": ""}, "option.count", {"option": "cameras_offset"}),
        ({"cameras_offset": "a,b,c"}, "option.type", {"option": "cameras_offset"}),
        ({"cameras_offset": "1,2,inf"}, "option.range", {"option": "cameras_offset"}),
        ({"respect_classes": "2,ground"}, "option.type", {"option": "respect_classes"}),
        ({"depth_factor": 1.4}, "option.needs", {"needs": "method factor"}),
        ({"least_pool": 3.0}, "option.needs", {"needs": "connected"}),
        ({"options": CorrectOptions(), "method": "shan"}, "option.twice", {"option": "method"}),
    ],
)
def test_refused(tmp_path, keywords, code, values):
    with refused(code, pcfix.SettingError, **values):
        pcfix.correct_file("cloud.las", tmp_path / "out.las", **keywords)


def test_texts_and_values():
    given = {"respect_classes": "6,2", "cameras_offset": "1,2,3", "index": "1.33"}
    same = {"respect_classes": (2, 6), "cameras_offset": (1.0, 2.0, 3.0), "index": 1.33}
    assert CorrectOptions(**given) == CorrectOptions(**same)
    assert CorrectOptions(respect_classes=2, sigma_image="1") == CorrectOptions(
        respect_classes=(2,), sigma_image=1.0
    )


def test_help():
    """The options that most people need, or all."""
    short, every = (run_pcfix("correct", word).stdout for word in ("--help", "--help-all"))
    names = [one.flag for one in options_of(CorrectOptions)]
    assert all(f" {name} " in every for name in names)
    assert 12 <= sum(f" {name} " in short for name in names) <= 18
    assert "pcfix correct --help-all" in short


def test_defaults_in_words():
    """Texts that name a default say what the code has."""
    found = {one.name: one.default_text for one in options_of(RunOptions)}
    assert found["index"] == f"{DEFAULT_REFRACTIVE_INDEX:g}"
    assert found["sigma_level"].endswith(f" {LEVEL_M:g}")


def test_part():
    given = with_index(CorrectOptions(salinity=10.0))
    part = given.part(ScienceOptions)
    assert (part.index, part.index_from) == (given.index, "10 PSU, 15 C, 0.53 um")
