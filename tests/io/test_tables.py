"""Check depths in tables."""

import pytest

from pcfix.io.tables import read_check_depths
from tests.utils.codes import refused

pytestmark = pytest.mark.quick

ROWS = "500001.5,4600002.25,1.5\n500003,4600004,2\n"


def written(tmp_path, text, name="checks.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "text",
    [
        "x,y,depth\n" + ROWS,
        "X;Y;Depth (m)\n" + ROWS.replace(",", ";"),
        "id,Easting,Northing,Water depth [m],sigma\nA1,500001.5,4600002.25,1.5,0.02\n"
        "A2,500003,4600004,2,\n",
        "depth_m\ty_m\tx_m\n1.5\t4600002.25\t500001.5\n2\t4600004\t500003\n",
        "x y depth\n\n" + ROWS.replace(",", " "),
        "x,y,z,depth\n500001.5,4600002.25,-7,1.5\n500003,4600004,-7,2\n",
    ],
)
def test_check_depths(tmp_path, text):
    found = read_check_depths(written(tmp_path, text))
    assert found.xy.tolist() == [[500001.5, 4600002.25], [500003.0, 4600004.0]]
    assert found.value_m.tolist() == [1.5, 2.0]
    assert not found.are_heights
    assert len(found) == 2


@pytest.mark.parametrize("name", ["z", "Elevation", "height_m", "altitude"])
def test_check_heights(tmp_path, name):
    found = read_check_depths(written(tmp_path, f"id,x,y,{name}\nA,1,2,-3.5\n"))
    assert found.are_heights
    assert found.value_m.tolist() == [-3.5]
    assert found.where(0).endswith("checks.csv: line 2 (1.00, 2.00)")


BAD = [
    ("x,y\n1,2\n", "table.column_missing", {"missing": ["depth"]}),
    ("longitude,latitude,depth\n1,2,3\n", "table.column_missing", {"missing": ["x", "y"]}),
    ("x,y,depth\n", "table.empty", {}),
    ("x,y,depth\n1,2,deep\n", "table.number", {"line": 2, "column": "depth"}),
    ("x,y,depth\n1,2,3\n1,,3\n", "table.number", {"line": 3, "column": "y"}),
    ("x,y,depth\n1,2,1e400\n", "table.number", {"value": "1e400"}),
    ("x,y,depth\n1,2,1\n5,6,-3\n5,6,-4\n", "check_depths.negative", {"line": 3, "count": 2}),
    ("x,y,depth\n1,2\n", "table.shifted", {"line": 2}),
    ('x,y,depth\n1,2,"' + "1" * 200_000, "table.not_csv", {}),
    ("x,y,depth_cm\n1,2,300\n", "table.unit", {"column": "depth", "value": "cm"}),
    ("x,y,depth (ft)\n1,2,3\n", "table.unit", {"value": "ft"}),
]


@pytest.mark.parametrize(("text", "code", "values"), BAD)
def test_bad_check_depths(tmp_path, text, code, values):
    path = written(tmp_path, text)
    with refused(code, path=path, **values):
        read_check_depths(path)
