"""Options are declared once; every door takes them under the same names, by the same rules."""

from __future__ import annotations

from typing import get_args, get_type_hints

import pytest

import pcfix
from pcfix.cli.commands import EXAMPLES
from pcfix.errors import PcfixWarning, SettingError
from pcfix.options.correct import CorrectOptions, ScienceOptions
from pcfix.options.declare import options_of
from pcfix.options.shared import Panel
from pcfix.options.survey import AdjustOptions
from pcfix.water.index import with_index
from tests.utils.program import run_pcfix

KINDS = [
    get_args(get_type_hints(command, include_extras=True)["options"])[0] for command, _ in EXAMPLES
]
FREE = {"resolution": 1.0}  # what a command cannot do without, and has a rule of its own


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_option_says_what_it_is(kind):
    names = [one.name for one in options_of(kind)]
    assert len(set(names)) == len(names)
    for one in options_of(kind):
        assert one.panel in list(Panel)
        assert one.help.endswith(".")
        assert one.default is None or one.checked(one.default) == one.default
    kind(**{name: value for name, value in FREE.items() if name in names})


@pytest.mark.parametrize(
    ("keywords", "sentence"),
    [
        ({"max_angel": 30}, "correct_file: there is no option 'max_angel'; did you mean max_angle"),
        ({"max_angle": 95}, "max-angle 95 is outside 0 to 90: give degrees from the surface"),
        ({"max_angle": "wide"}, "max-angle 'wide' is neither degrees nor none or auto"),
        ({"max_cameras": 2.5}, "max-cameras 2.5 must be a whole number"),
        ({"method": "snel"}, "method 'snel' is not one of auto, snell, consistent"),
        ({"index": 1.7}, "refractive index 1.7 is outside 1.0 to 1.5"),
        ({"depth_factor": 1.4}, "depth-factor is of no use without --method factor"),
        ({"least_pool": 3.0}, "least-pool is of no use without connected"),
        ({"options": CorrectOptions(), "method": "shan"}, "give options=... or method=..., not"),
    ],
)
def test_python_refuses(tmp_path, keywords, sentence):
    with pytest.raises(SettingError, match=sentence.replace("(", ".")):
        pcfix.correct_file("cloud.las", tmp_path / "out.las", **keywords)


def test_names_of_old_work_with_a_warning(tmp_path):
    with (
        pytest.warns(PcfixWarning, match="max_angle_deg is called max_angle now"),
        pytest.raises(SettingError, match="max-angle 95 is outside"),
    ):
        pcfix.correct_file("cloud.las", tmp_path / "out.las", max_angle_deg=95)


def test_the_engine_that_is_gone():
    with pytest.raises(SettingError, match="was the last version with COLMAP's engine"):
        AdjustOptions(engine="colmap")
    with pytest.warns(PcfixWarning, match="there is one engine only"):
        AdjustOptions(engine="direct")


def test_values_are_the_same_through_text_and_python():
    given = {"respect_classes": "6,2", "cameras_offset": "1,2,3", "index": "1.33"}
    same = {"respect_classes": (2, 6), "cameras_offset": (1.0, 2.0, 3.0), "index": 1.33}
    assert CorrectOptions(**given) == CorrectOptions(**same)


def test_wrong_usage_is_two_lines_and_code_2():
    done = run_pcfix("correct", "a.las", "b.las", "--water", "0.3")
    assert done.returncode == 2
    assert done.stderr == "pcfix: --cameras is needed\nTry 'pcfix correct --help'.\n"
    done = run_pcfix("correct", "a.las", "b.las", "--max-angel", "30")
    assert done.returncode == 2
    assert "--max-angel" in done.stderr


def test_a_part_keeps_what_it_has():
    given = with_index(CorrectOptions(salinity=10.0))
    part = given.part(ScienceOptions)
    assert (part.index, part.index_from) == (given.index, "10 PSU, 15 C, 0.53 um")


def test_a_stage_gets_every_digit():
    given = CorrectOptions(cameras_offset=(319900.125, 4650123.4567, 0.0), respect_classes=(2, 5))
    assert given.plain() == {
        "cameras_offset": "319900.125,4650123.4567,0", "respect_classes": "2,5",
    }  # fmt: skip
    assert CorrectOptions(**given.plain()) == given


def test_a_stage_is_told_that_there_is_no_limit():
    given = CorrectOptions(max_angle=None)
    assert given.plain() == {"max_angle": "none"}
    assert CorrectOptions(**given.plain()) == given
