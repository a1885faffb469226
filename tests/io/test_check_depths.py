"""Tables of check depths: many spellings, one meaning, and sentences for what is wrong."""

import pytest

from pcfix.errors import InputError
from pcfix.io.tables import read_check_depths

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
def test_depths_are_read_whatever_the_columns_are_called(tmp_path, text):
    found = read_check_depths(written(tmp_path, text))
    assert found.xy.tolist() == [[500001.5, 4600002.25], [500003.0, 4600004.0]]
    assert found.value_m.tolist() == [1.5, 2.0]
    assert not found.are_heights
    assert len(found) == 2


@pytest.mark.parametrize("name", ["z", "Elevation", "height_m", "altitude"])
def test_heights_are_read_as_such_and_may_be_negative(tmp_path, name):
    found = read_check_depths(written(tmp_path, f"id,x,y,{name}\nA,1,2,-3.5\n"))
    assert found.are_heights
    assert found.value_m.tolist() == [-3.5]
    assert found.where(0).endswith("checks.csv: line 2 (1.00, 2.00)")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x,y\n1,2\n", "depth or z missing (it has: x, y)"),
        ("y,depth\n1,2\n", "x missing"),
        ("longitude,latitude,depth\n1,2,3\n", "x, y missing"),
        ("x,y,depth\n", "has a header but no rows"),
        ("", "has a header but no rows"),
        ("x,y,depth\n1,2,deep\n", "line 2, column depth: 'deep' is not a finite number"),
        ("x,y,depth\n1,2,3\n1,,3\n", "line 3, column y: '' is not a finite number"),
        ("x,y,depth\n1,2,nan\n", "line 2, column depth: 'nan' is not a finite number"),
        ("x,y,depth\n1,2,1e308\n", "line 2, column depth: '1e308' is too large"),
        ("x,y,depth\n1,2,1e400\n", "line 2, column depth: '1e400' is not a finite number"),
        ("x,y,depth\n1,2,1\n5,6,-3\n5,6,-4\n", "line 3 (5.00, 6.00): the depth -3 is negative"),
        ("x,y,depth\n1,2,-1\n1,2,1\n", "1 of 2; depths count positive down"),
        ("x,y,depth\n1,2\n", "line 2 has 2 fields, the header 3"),
        ("x,y,depth_cm\n1,2,300\n", "column depth_cm is in 'cm'; give metres"),
        ("x,y,depth (ft)\n1,2,3\n", "column depth (ft) is in 'ft'; give metres"),
        ("x,easting,y,depth\n1,1,2,3\n", "the columns x, easting may all be x"),
        ("x,y,depth,depth\n1,2,3,4\n", "the columns depth, depth may all be depth"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, text, said):
    with pytest.raises(InputError) as caught:
        read_check_depths(written(tmp_path, text))
    assert said in str(caught.value)
    assert "checks.csv" in str(caught.value)


def test_a_missing_file_is_said_to_be_missing(tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        read_check_depths(tmp_path / "none.csv")
