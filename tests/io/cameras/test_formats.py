"""The table of formats: what the documentation says is what is read."""

import re
from pathlib import Path

import pytest

import pcfix
from pcfix.io.cameras import FORMATS
from tests.utils.codes import refused

pytestmark = pytest.mark.quick

README = Path(pcfix.__file__).parent / "io" / "cameras" / "README.md"
PART = re.compile(r"<!-- formats: .*? -->\n(.*?)<!-- end of formats -->", re.DOTALL)


def test_the_table_of_the_readme_is_that_of_the_formats():
    lines = ["| software | what to give |", "|---|---|"]
    lines += [f"| {each.software} | {each.give} |" for each in FORMATS if each.give]
    table = "\n".join(lines) + "\n"
    found = PART.search(README.read_text())
    assert found is not None
    assert found[1] == table, f"put this into {README}:\n{table}"


@pytest.mark.parametrize("angles", [True, False])
def test_a_sensor_of_positions_alone_is_refused(tmp_path, angles):
    """BlocksExchange without a lens: with rotations the sensor counts, without it says nothing."""
    turn = "".join(f"<M_{i}{j}>{float(i == j)}</M_{i}{j}>" for i in range(3) for j in range(3))
    rotation = f"<Rotation>{turn}</Rotation>" if angles else ""
    photo = (
        f"<Photo><Id>0</Id><ImagePath>a.jpg</ImagePath><Pose>{rotation}"
        "<Center><x>1</x><y>2</y><z>3</z></Center></Pose></Photo>"
    )
    (tmp_path / "b.xml").write_text(
        '<BlocksExchange version="3.2"><Block><Photogroups><Photogroup><Name>g</Name>'
        f"{photo}</Photogroup></Photogroups></Block></BlocksExchange>"
    )
    sensor = tmp_path / "s.csv"
    sensor.write_text("focal,sensor_x,sensor_y\n8.8,13.2,8.8\n")
    if angles:
        assert pcfix.read_cameras(tmp_path / "b.xml", sensor).lenses[0].focal == 8.8
    else:
        with refused("cameras.sensor_unused"):
            pcfix.read_cameras(tmp_path / "b.xml", sensor)
