"""The stage as a function of arrays; no PDAL is needed for it."""

from __future__ import annotations

import json
import subprocess
import sys

import laspy
import numpy as np
import pytest

import pcfix
from pcfix import pdal_stage
from pcfix.io.las.columns import COLUMNS, UNSURE
from pcfix.io.pdal import STAGE_SOURCE, add_dimension
from tests.utils.beyond_frames import BEYOND_FRAMES
from tests.utils.clouds import WATER_M, block, cameras_csv, framed_block, random_cloud, write_cloud
from tests.utils.half_oblique import write_half_oblique

pytestmark = BEYOND_FRAMES

DTYPES = {"float": "f4", "uint16": "u2", "uint8": "u1"}


@pytest.fixture
def cloud(tmp_path):
    """Return a file, and the arrays and metadata that PDAL has of it."""
    path = write_cloud(tmp_path / "cloud.las", 7)
    cameras_csv(tmp_path / "cameras.csv", block())
    return path, arrays_of(laspy.read(path)), metadata_of(laspy.read(path).header)


def arrays_of(las, added=None):
    ins = {axis: np.array(las[axis.lower()]) for axis in "XYZ"}
    ins["Classification"] = np.array(las.classification)
    ins["ClassFlags"] = (
        np.array(las.synthetic)
        | np.array(las.key_point) << 1
        | np.array(las.withheld) << 2
        | np.array(las.overlap) << 3
    ).astype(np.uint8)
    for word in (added or add_dimension(COLUMNS)).split(","):
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
    exec(STAGE_SOURCE.format(function), namespace)
    outs = {}
    assert namespace[function](ins, outs) is True
    return outs, namespace.get("out_metadata")


def test_the_line_of_earlier_pipelines_still_works(cloud):
    _, ins, metadata = cloud
    namespace = {"pdalargs": {"water": WATER_M}, "metadata": metadata}
    line = "from pcfix.pdal_stage import stages; correct, label = stages(globals())"
    exec(line, namespace)
    outs = {}
    assert namespace["label"](ins, outs)
    expected, _ = run("label", ins, metadata, water=WATER_M)
    np.testing.assert_array_equal(outs["Classification"], expected["Classification"])
    with pytest.raises(ImportError, match="corect"):
        exec(STAGE_SOURCE.format("corect"), {})


def test_arrays_and_files_agree(cloud, tmp_path):
    path, ins, metadata = cloud
    outs, _ = run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)
    pcfix.correct_file(path, tmp_path / "out.las", cameras=tmp_path / "cameras.csv", water=WATER_M)
    las = laspy.read(tmp_path / "out.las")
    for axis in "XYZ":
        scale, offset = (getattr(las.header, f"{axis.lower()}_{w}") for w in ("scale", "offset"))
        np.testing.assert_array_equal(np.rint((outs[axis] - offset) / scale), las[axis])
    np.testing.assert_array_equal(outs["Classification"], np.array(las.classification))
    for column in COLUMNS:
        expected = np.array(las[column.name]).astype(ins[column.name].dtype)
        np.testing.assert_array_equal(outs[column.name], expected, column.name)


def test_outputs_are_what_pdal_takes_unseen(cloud, tmp_path):
    """It checks neither length nor strides, and the type only by size and kind."""
    _, ins, metadata = cloud
    kinds = {name: values.dtype for name, values in ins.items()}
    outs, _ = run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)
    assert set(outs) >= {"X", "Y", "Z", "Classification", "ClassFlags", "ShiftZ", "RayCount"}
    for name, values in outs.items():
        assert values.dtype == kinds[name], name
        assert values.flags.c_contiguous, name
        assert values.shape == ins["X"].shape, name


def test_land_keeps_its_bits(cloud, tmp_path):
    _, ins, metadata = cloud
    before = {name: values.copy() for name, values in ins.items()}
    outs, _ = run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)
    land = before["Z"] >= WATER_M
    for name in outs:
        np.testing.assert_array_equal(outs[name][land], before[name][land], name)


def test_chunks_leave_no_trace(cloud, tmp_path, monkeypatch):
    path, ins, metadata = cloud
    options = {"cameras": str(tmp_path / "cameras.csv"), "water": WATER_M}
    whole, _ = run("correct", ins, metadata, **options)
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", 111)
    pieces, _ = run("correct", arrays_of(laspy.read(path)), metadata, **options)
    for name in whole:
        np.testing.assert_array_equal(whole[name], pieces[name])


@pytest.mark.parametrize("keeps", ["ClassFlags", "Withheld"])
@pytest.mark.parametrize("uncorrected", ["keep", "withhold"])
def test_withheld_is_honoured_wherever_pdal_keeps_it(tmp_path, keeps, uncorrected):
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
        uncorrected=uncorrected,
    )  # fmt: skip
    stuck = outs["Outcome"] > pcfix.Outcome.CORRECTED
    assert stuck.sum() > 0
    expected = was | stuck if uncorrected == "withhold" else was
    if keeps == "Withheld":
        np.testing.assert_array_equal(outs["Withheld"], expected)
    else:
        np.testing.assert_array_equal(outs["ClassFlags"] & 4 != 0, expected)
        np.testing.assert_array_equal(outs["ClassFlags"] & ~np.uint8(4), others)


def test_unsure_points_are_withheld_as_in_files(tmp_path):
    more = {"method": "snell", "max_angle": "none", "occlusion": "off", "unsure": "withhold"}
    more |= write_half_oblique(tmp_path)
    before = laspy.read(tmp_path / "cloud.las")
    ins = arrays_of(before, add_dimension((*COLUMNS, UNSURE)))
    outs, report = run("correct", ins, metadata_of(before.header), **more)
    pcfix.correct_file(tmp_path / "cloud.las", tmp_path / "out.las", **more)
    las = laspy.read(tmp_path / "out.las")
    np.testing.assert_array_equal(outs["Unsure"], las.Unsure)
    np.testing.assert_array_equal(outs["ClassFlags"] >> 2 & 1, las.withheld)
    (told,) = (node["value"] for node in report["children"] if node["name"] == "unsure")
    assert told > np.array(las.Unsure).sum() > 0  # some came withheld


def test_classes_packed_with_flags_are_taken_apart(cloud, tmp_path):
    """As PDAL 2.2 hands on point formats 0 to 5."""
    path, ins, _ = cloud
    metadata = metadata_of(random_cloud(3).header)
    classes, flags = ins["Classification"] & 31, ins["ClassFlags"] & 7
    ins["Classification"], ins["ClassFlags"] = classes | flags << 5, np.zeros_like(flags)
    outs, _ = run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)
    wet = np.array(laspy.read(path).z) < WATER_M
    np.testing.assert_array_equal(outs["Classification"], np.where(wet, 40, classes))
    np.testing.assert_array_equal(outs["ClassFlags"], flags)
    np.testing.assert_array_equal(outs["SourceClass"], np.where(wet, classes, 0))


def test_without_one_scale_nothing_is_rounded(cloud, tmp_path):
    _, ins, _ = cloud
    xyz = np.column_stack([ins[axis] for axis in "XYZ"]).copy()
    outs, _ = run("correct", ins, None, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)
    expected = pcfix.correct_points(xyz, pcfix.read_cameras(tmp_path / "cameras.csv"), WATER_M).xyz
    found = np.column_stack([outs[axis] for axis in "XYZ"])
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-7)  # half a step of 2**-20 m


def test_label_sets_classes_and_nothing_else(cloud):
    _, ins, metadata = cloud
    outs, report = run("label", ins, metadata, water=WATER_M)
    wet = ins["Z"] < WATER_M
    np.testing.assert_array_equal(outs["Classification"], np.where(wet, 40, ins["Classification"]))
    np.testing.assert_array_equal(outs["ClassFlags"], ins["ClassFlags"])
    assert set(outs) == {"Classification", "ClassFlags"}
    assert report["children"][0]["value"] == wet.sum()


def test_report_is_the_summary(cloud, tmp_path):
    path, ins, metadata = cloud
    options = {"cameras": str(tmp_path / "cameras.csv"), "water": str(WATER_M)}
    _, report = run("correct", ins, metadata, **options, summary=str(tmp_path / "s.json"))
    found = {node["name"]: node["value"] for node in report["children"]}
    summary = pcfix.correct_file(
        path, tmp_path / "out.las", cameras=tmp_path / "cameras.csv", water=WATER_M
    )
    for name in ("points", "submerged", "corrected", "rays", "cameras_used", "water"):
        assert found[name] == getattr(summary, name), name
    assert json.loads(found["shift_z_m"]) == summary.shift_z_m
    written = json.loads((tmp_path / "s.json").read_text())
    assert set(written) == set(summary.as_dict())
    assert written["depth_m"] == summary.depth_m


def test_shoreline_is_that_of_files(cloud, tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    path, ins, metadata = cloud
    options = {"cameras": str(tmp_path / "cameras.csv"), "water": WATER_M}
    _, report = run("correct", ins, metadata, **options, shoreline=str(tmp_path / "stage.gpkg"))
    pcfix.correct_file(path, tmp_path / "o.las", **options, shoreline=tmp_path / "file.gpkg")
    stage, file = (pyogrio.raw.read(tmp_path / f"{door}.gpkg") for door in ("stage", "file"))
    assert list(stage[2]) == list(file[2])
    told = next(node["value"] for node in report["children"] if node["name"] == "shoreline")
    assert json.loads(told)["lines"] == len(stage[2])


GOOD = {"cameras": "cameras.csv", "water": WATER_M}
MISTAKES = {
    "an option that is none": ({**GOOD, "watre": 1}, "no option 'watre'"),
    "no cameras": ({"water": 1.0}, "'cameras' is needed"),
    "no water": ({"cameras": "cameras.csv"}, "'water' is needed"),
    "a word for a number": (
        {**GOOD, "max_cameras": "few"},
        'max_cameras must be a whole number, not "few"',
    ),
    "true for a number": (
        {**GOOD, "max_angle": True},
        "max_angle must be a number or a text, not true",
    ),
    "a list": ({**GOOD, "cameras": ["a"]}, 'cameras must be a text, not ["a"]'),
    "half a camera": ({**GOOD, "max_cameras": 2.5}, "max_cameras must be a whole number"),
    "an index": ({**GOOD, "index": 1.6}, "refractive index 1.6 is outside 1.0 to 1.5"),
    "an angle": ({**GOOD, "max_angle": 0}, "max-angle 0 is outside"),
    "a choice": ({**GOOD, "uncorrected": "burn"}, "uncorrected 'burn' is not one of"),
    "drop": ({**GOOD, "uncorrected": "drop"}, "filters.range"),
    "jobs": ({**GOOD, "jobs": 0}, "jobs 0 is less than 1"),
    "no such cameras": ({**GOOD, "cameras": "none.csv"}, "none.csv: there is no such file"),
    "water too low": ({**GOOD, "water": -40}, "no point lies below the water"),
    "no such dimension": ({**GOOD, "water": "dim:w_surf"}, "no dimension w_surf; it has X, Y, Z"),
    "a strange word": ({**GOOD, "water": "wet"}, "water 'wet' is not understood"),
    "summary over an input": ({**GOOD, "summary": "cameras.csv", "overwrite": True}, "same file"),
    "a name twice": ({**GOOD, "max-angle": 30, "max_angle": 30}, "max-angle is given twice"),
    "a dash": ({**GOOD, "max-angle": 95}, "max-angle 95 is outside 0 to 90"),
    "not an object": ("cameras.csv", "must be an object"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_have_one_sentence(cloud, tmp_path, monkeypatch, capsys, case):
    _, ins, metadata = cloud
    options, sentence = MISTAKES[case]
    monkeypatch.chdir(tmp_path)
    correct, _ = pdal_stage.stages({"pdalargs": options, "metadata": metadata})
    stdout, flags = sys.stdout, sys.getdlopenflags()
    before = sorted(tmp_path.iterdir())
    outs = {}
    with pytest.raises(pcfix.PcfixError) as caught:
        correct(ins, outs)
    message = str(caught.value)
    assert sentence in message
    assert message.count("\n") == 0
    assert outs == {}
    assert (sys.stdout, sys.getdlopenflags(), sorted(tmp_path.iterdir())) == (stdout, flags, before)
    if "pdal" not in sys.modules:  # and in PDAL's program, where a traceback follows
        monkeypatch.setitem(sys.modules, "redirector", sys)
        monkeypatch.setattr(sys, "tracebacklimit", None, raising=False)
        with pytest.raises(pcfix.PcfixError, match="as said above") as caught:
            correct(ins, outs)
        assert sentence not in str(caught.value)
        assert capsys.readouterr().err.splitlines()[-1] == f"pcfix: {message}"


@pytest.mark.parametrize("name", ["ShiftY", "SourceClass"])
def test_dimensions_that_were_not_added(cloud, tmp_path, name):
    _, ins, metadata = cloud
    del ins[name]
    with pytest.raises(pcfix.PcfixError, match=f'add_dimension: {name} missing; give "ShiftX='):
        run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)


def test_a_dimension_of_the_wrong_kind(cloud, tmp_path):
    _, ins, metadata = cloud
    ins["WaterDepth"] = ins["WaterDepth"].astype(np.int32)
    with pytest.raises(pcfix.PcfixError, match="WaterDepth must be float"):
        run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)


def test_a_point_that_is_nowhere(cloud, tmp_path):
    _, ins, metadata = cloud
    ins["Y"][7] = np.nan
    with pytest.raises(pcfix.PcfixError, match="row 7 is not finite"):
        run("correct", ins, metadata, cameras=str(tmp_path / "cameras.csv"), water=WATER_M)


def test_no_heavy_library_before_the_stage_runs():
    """PDAL's libraries and those of pyproj must be kept apart, which is done once it runs."""
    program = (
        "import sys, pcfix.pdal_stage;"
        "print([m for m in ('numba', 'scipy', 'laspy', 'pyproj', 'open3d') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"
