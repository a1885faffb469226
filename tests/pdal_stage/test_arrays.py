"""The stage as a function of arrays; no PDAL is needed for it."""

import json
import subprocess
import sys

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.io.las.columns import COLUMNS
from pcfix.io.pdal import add_dimension
from tests.utils.beyond_frames import BEYOND_FRAMES
from tests.utils.clouds import WATER_M, block, cameras_csv, framed_block, random_cloud, write_cloud

pytestmark = BEYOND_FRAMES

DTYPES = {"float": "f4", "uint16": "u2", "uint8": "u1"}


@pytest.fixture
def cloud(tmp_path):
    """Return a file, and the arrays and metadata that PDAL has of it."""
    path = write_cloud(tmp_path / "cloud.las", 7)
    cameras_csv(tmp_path / "cameras.csv", block())
    return path, arrays_of(laspy.read(path)), metadata_of(laspy.read(path).header)


def arrays_of(las):
    ins = {axis: np.array(las[axis.lower()]) for axis in "XYZ"}
    ins["Classification"] = np.array(las.classification)
    ins["ClassFlags"] = (
        np.array(las.synthetic)
        | np.array(las.key_point) << 1
        | np.array(las.withheld) << 2
        | np.array(las.overlap) << 3
    ).astype(np.uint8)
    for word in add_dimension(COLUMNS).split(","):
        name, kind = word.split("=")
        ins[name] = np.zeros(len(las), DTYPES[kind])
    return ins


def metadata_of(header):
    values = {f"scale_{axis}": s for axis, s in zip("xyz", header.scales, strict=True)}
    values["dataformat_id"] = header.point_format.id
    children = [{"name": name, "value": str(value)} for name, value in values.items()]
    return {"name": "root", "children": [{"name": "readers.las", "children": children}]}


def run(function, ins, metadata, **options):
    namespace = {"pdalargs": options, "metadata": metadata}
    exec(f"from pcfix.pdal_stage import {function}", namespace)
    outs = {}
    assert namespace[function](ins, outs) is True
    return outs, namespace.get("out_metadata")


def test_correct(cloud, tmp_path, monkeypatch):
    """The arrays are those of a file, and as PDAL takes them without a check."""
    path, ins, metadata = cloud
    before = {name: values.copy() for name, values in ins.items()}
    options = {"cameras": str(tmp_path / "cameras.csv"), "water": WATER_M, "max_angle": 80.0}
    outs, _ = run("correct", ins, metadata, **options)
    pcfix.correct_file(path, tmp_path / "out.las", **options)
    las = laspy.read(tmp_path / "out.las")
    for axis in "XYZ":
        scale, offset = (getattr(las.header, f"{axis.lower()}_{w}") for w in ("scale", "offset"))
        np.testing.assert_array_equal(np.rint((outs[axis] - offset) / scale), las[axis])
    np.testing.assert_array_equal(outs["Classification"], np.array(las.classification))
    for column in COLUMNS:
        expected = np.array(las[column.name]).astype(ins[column.name].dtype)
        np.testing.assert_array_equal(outs[column.name], expected, column.name)
    assert set(outs) >= {"X", "Y", "Z", "Classification", "ClassFlags", "ShiftZ", "RayCount"}
    land = before["Z"] >= WATER_M
    for name, values in outs.items():
        assert values.dtype == before[name].dtype, name
        assert values.flags.c_contiguous, name
        assert values.shape == before["X"].shape, name
        np.testing.assert_array_equal(values[land], before[name][land], name)  # all bits
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", 111)
    pieces, _ = run("correct", arrays_of(laspy.read(path)), metadata, **options)
    for name in outs:
        np.testing.assert_array_equal(outs[name], pieces[name])


@pytest.mark.parametrize("keeps", ["ClassFlags", "Withheld"])
def test_withheld(tmp_path, keeps):
    ins = arrays_of(random_cloud(7))
    cameras_csv(tmp_path / "cameras.csv", framed_block(), angles=True)
    (tmp_path / "sensor.csv").write_text("focal,sensor_x,sensor_y\n24,24,9.6\n")
    was = ins["ClassFlags"] & 4 != 0
    others = ins["ClassFlags"] & ~np.uint8(4)
    if keeps == "Withheld":
        ins["Withheld"] = was.astype(np.uint8)
        del ins["ClassFlags"]
    ins["Outcome"] = np.zeros(len(was), np.uint8)
    outs, _ = run(
        "correct", ins, None, cameras=str(tmp_path / "cameras.csv"), water=WATER_M,
    )  # fmt: skip
    stuck = outs["Outcome"] > pcfix.Outcome.CORRECTED
    assert stuck.sum() > 0
    expected = was | stuck
    if keeps == "Withheld":
        np.testing.assert_array_equal(outs["Withheld"], expected)
    else:
        np.testing.assert_array_equal(outs["ClassFlags"] & 4 != 0, expected)
        np.testing.assert_array_equal(outs["ClassFlags"] & ~np.uint8(4), others)


def test_report(cloud, tmp_path):
    """The metadata and the summary are those of a file."""
    path, ins, metadata = cloud
    options = {"cameras": str(tmp_path / "cameras.csv"), "water": str(WATER_M), "max_angle": 80.0}
    _, report = run("correct", ins, metadata, **options, summary=str(tmp_path / "s.json"))
    found = {node["name"]: node["value"] for node in report["children"]}
    summary = pcfix.correct_file(path, tmp_path / "out.las", **options)
    for name in ("points", "submerged", "corrected", "rays", "cameras_used", "water"):
        assert found[name] == getattr(summary, name), name
    assert json.loads(found["shift_z_m"]) == summary.shift_z_m
    written = json.loads((tmp_path / "s.json").read_text())
    assert set(written) == set(summary.as_dict())
    assert written["depth_m"] == summary.depth_m


GOOD = {"cameras": "cameras.csv", "water": WATER_M, "max_angle": 80.0}
# Options, and the code of the error where it is one of this room.
MISTAKES = [
    ({**GOOD, "watre": 1}, None),
    ({"water": 1.0}, "option.missing"),
    ({"cameras": "cameras.csv"}, "option.missing"),
    ({**GOOD, "jobs": "few"}, "option.type"),
    ({**GOOD, "max_angle": True}, "option.type"),
    ({**GOOD, "cameras": ["a"]}, "option.type"),
    ({**GOOD, "jobs": 2.5}, "option.type"),
    ("cameras.csv", "option.type"),
    ({**GOOD, "water": "dim:w_surf"}, "cloud.dimension_missing"),
    ({**GOOD, "water": "wet"}, "water.spec"),
    ({**GOOD, "max-angle": 95}, None),
    ({**GOOD, "cameras": "none.csv"}, None),
    ({**GOOD, "water": -40}, None),
    ({**GOOD, "summary": "cameras.csv", "overwrite": True}, None),
]


@pytest.mark.parametrize(("options", "code"), MISTAKES)
def test_mistakes(cloud, tmp_path, monkeypatch, capsys, options, code):
    _, ins, metadata = cloud
    monkeypatch.chdir(tmp_path)
    namespace = {"pdalargs": options, "metadata": metadata}
    exec("from pcfix.pdal_stage import correct", namespace)
    stdout, flags = sys.stdout, sys.getdlopenflags()
    before = sorted(tmp_path.iterdir())
    outs = {}
    with pytest.raises(pcfix.PcfixError) as caught:
        namespace["correct"](ins, outs)
    message = str(caught.value)
    assert code in (None, caught.value.code)
    assert message.count("\n") == 0
    assert outs == {}
    assert (sys.stdout, sys.getdlopenflags(), sorted(tmp_path.iterdir())) == (stdout, flags, before)
    if "pdal" not in sys.modules:  # and in PDAL's program, where a traceback follows
        monkeypatch.setitem(sys.modules, "redirector", sys)
        monkeypatch.setattr(sys, "tracebacklimit", None, raising=False)
        with pytest.raises(pcfix.PcfixError) as caught:
            namespace["correct"](ins, outs)
        assert message not in str(caught.value)
        assert capsys.readouterr().err.splitlines()[-1] == f"pcfix: {message}"


@pytest.mark.parametrize(
    ("name", "values", "code"),
    [
        ("ShiftY", None, "cloud.dimension_missing"),
        ("SourceClass", None, "cloud.dimension_missing"),
        ("Classification", None, "cloud.dimension_missing"),
        ("WaterDepth", np.zeros(1, np.int32), "cloud.dimension_type"),
        ("Y", np.full(1, np.nan), None),
    ],
)
def test_bad_dimensions(cloud, tmp_path, name, values, code):
    _, ins, metadata = cloud
    if values is None:
        del ins[name]
    else:
        ins[name] = np.resize(values, len(ins["X"]))
    with pytest.raises(pcfix.PcfixError) as caught:
        run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)
    assert code in (None, caught.value.code)


def test_imports():
    """PDAL's libraries and those of pyproj must be separate, which `_run` takes care of."""
    program = (
        "import sys, pcfix.pdal_stage;"
        "print([m for m in ('numba', 'scipy', 'laspy', 'pyproj', 'open3d') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"
    with pytest.raises(ImportError):
        exec("from pcfix.pdal_stage import corect", {})
