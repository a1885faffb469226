"""A user's mistake gives one line with a code, exit code 1, and nothing is written."""

import os
import struct

import laspy
import numpy as np
import pytest

from pcfix import Cameras
from tests.io.test_water import ply
from tests.utils.clouds import (
    EAST_M,
    NORTH_M,
    WATER_M,
    block,
    cameras_csv,
    patched,
    random_cloud,
    write_cloud,
)
from tests.utils.program import run_pcfix

SENSOR = "focal,sensor_x,sensor_y\n"
ROWS = "a,456010,5432010,90\nb,456060,5432010,90\nc,456010,5432060,90\n"
TABLES = {
    "long_row": "label,x,y,z\n" + ROWS + "d,1,456060,5432060,90\n",
    "short_row": "label,x,y,z\n" + ROWS + "d,5432060,90\n",
    "no_z": "label,x,y\na,1,2\n",
    "word": "label,x,y,z\na,456010,5432010,90\nb,east,5432010,90\n",
    "empty_field": "label,x,y,z\n" + ROWS + "d,456060,,90\n",
    "inf": "label,x,y,z\n" + ROWS + "d,-inf,5432060,90\n",
    "empty_lines": "label,x,y,z\n\n\n" + ROWS + "\nd,1,2,east\n",
    "header_only": "label,x,y,z\n",
    "empty": "",
    "binary": "\x00\x01\x02\x03" * 100,
    "no_header": ROWS,
    "two_angles": "label,x,y,z,yaw,pitch\na,456010,5432010,90,0,0\n",
    "nan_angle": "label,x,y,z,yaw,pitch,roll\na,1,2,90,0,nan,0\n",
    "open_quote": 'label,x,y,z\n"a,1,2,90\nb,1,2,90\n',
    "endless": 'label,x,y,z\n"' + "a" * 200_000 + "\n",
}
CORNERS = [[0, 0, 1], [9, 0, 1], [0, 9, 1]]
V = "v 0 0 1\nv 9 0 1\nv 0 9 1\n"
MESHES = {
    "empty.obj": "",
    "no_faces.obj": V,
    "too_large.obj": V + "f 1 2 4\n",
    "zero.obj": V + "f 0 1 2\n",
    "far_back.obj": V + "f -9 -1 -2\n",
    "word.obj": "v 0 0 a\n" + V + "f 1 2 3\n",
    "flat.obj": "v 0 0\n" + V + "f 1 2 3\n",
    "nan.obj": "v 0 0 nan\n" + V + "f 1 2 3\n",
    "vertical.obj": "v 0 0 1\nv 9 0 1\nv 9 0 5\nf 1 2 3\n",
    "garbage.obj": "\x00\x01\x02 no mesh at all \xff\xfe\n" * 50,
    "empty.ply": "",
    "no_faces.ply": ply(CORNERS, []).decode("latin-1"),
    "bad_index.ply": ply(CORNERS, [[0, 1, 7]]).decode("latin-1"),
    "cut.ply": ply(CORNERS, [[0, 1, 2]]).decode("latin-1")[:-1],
}
SENSORS = {
    "negative": SENSOR + "-24,36,24\n",
    "nan": SENSOR + "24,36,nan\n",
    "no_height": SENSOR + "24,36,0\n",
    "twice": SENSOR + "24,36,24\n24,36,24\n",
    "no_rows": SENSOR,
    "no_column": "focal,sensor_x\n24,36\n",
    "empty": "",
}
HEADERS = {
    "record_count": (100, "<I", 2**32 - 1),
    "start": (96, "<I", 2**32 - 1),
    "size": (94, "<H", 5),
    "record_length": (105, "<H", 1),
    "format": (104, "<B", 99),
    "version": (25, "<B", 9),
    "point_count": (107, "<I", 2**32 - 1),
    "scale_zero": (147, "<d", 0.0),
    "scale_nan": (131, "<d", np.nan),
    "offset_inf": (171, "<d", np.inf),
}
RECORDS = {"brace": b"{", "list": b"[]", "text": b'"no"', "object": b"{}", "binary": b"\xff\xfe"}


def correct(*more: str, cloud: str = "cloud.las", output: str = "out.las") -> list[str]:
    """Return the words of a correction; those in `more` come last and win."""
    given = ["--cameras", "cameras.csv", "--water", str(WATER_M), "--max-angle", "80"]
    return ["correct", cloud, output, *given, *more]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a cloud, its cameras, and every file that a case names."""
    at = tmp_path_factory.mktemp("bad")
    las = random_cloud(3, count=300)
    write_clouds(at, las)
    cameras_csv(at / "cameras.csv", block())
    cameras_csv(at / "angles.csv", block(), angles=True)
    (at / "one.csv").write_text("".join((at / "cameras.csv").open().readlines()[:2]))
    far = Cameras(block().labels, block().centres + np.array([500_000.0, 0.0, 0.0]))
    cameras_csv(at / "far.csv", far)
    (at / "images").mkdir()
    (at / "images" / "cameras.csv").write_bytes((at / "cameras.csv").read_bytes())
    for kind, texts in (("t_{}.csv", TABLES), ("s_{}.csv", SENSORS), ("{}", MESHES)):
        for name, text in texts.items():
            (at / kind.format(name)).write_bytes(text.encode("latin-1"))
    (at / "shore.txt").write_text("x y z\n")
    (at / "sensor.las").write_text(SENSOR + "24,360,240\n")
    corners = [(x, y) for y in (NORTH_M - 50, NORTH_M + 200) for x in (EAST_M - 50, EAST_M + 200)]
    for name, height in (("high.obj", 500), ("lake.obj", 12)):
        vertices = "".join(f"v {x} {y} {height}\n" for x, y in corners)
        (at / name).write_text(vertices + "f 1 2 4\nf 1 4 3\n")
    for name in ("taken.las", "taken.json"):
        (at / name).write_text("somebody's work")
    return at


def write_clouds(at, las):
    las.write(at / "cloud.las")
    os.link(at / "cloud.las", at / "hard.las")
    (at / "link.las").symlink_to("cloud.las")
    data = (at / "cloud.las").read_bytes()
    for name, (place, layout, value) in HEADERS.items():
        (at / f"h_{name}.las").write_bytes(data)
        patched(at / f"h_{name}.las", place, struct.pack(layout, value))
    (at / "folder.las").mkdir()
    (at / "cloud.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    for name, content in (("text", b"x y z\n1 2 3\n"), ("no", b""), ("four", b"LASF")):
        (at / f"{name}.las").write_bytes(content)
    write_cloud(at / "no_points.las", 3, count=0)
    write_cloud(at / "few.las", 7, count=300)
    patched(at / "few.las", 247, struct.pack("<Q", 100))
    old = random_cloud(6, count=300)
    write_cloud(at / "records.las", 6, count=300)
    old.evlrs = None
    old.write(at / "six.las")
    write_cloud(at / "whole.laz", 3)
    for name, source, sizes in (
        ("c3", "cloud.las", (100, 226, 400, 900, -1, -3000)), ("c6", "six.las", (226, 900, -40)),
        ("e6", "records.las", (-4000, -30_000, -60_000)),
        ("z3", "whole.laz", (0.05, 0.3, 0.6, 0.999)),
    ):  # fmt: skip
        data = (at / source).read_bytes()
        for i, size in enumerate(sizes):
            end = int(len(data) * size) if isinstance(size, float) else size
            (at / f"{name}_{i}{source[-4:]}").write_bytes(data[:end])
    for name in ("ShiftX", "RayCount", "SourceClass"):
        las.add_extra_dim(laspy.ExtraBytesParams(name, "int16"))
        las.write(at / f"{name}.las")
        las.remove_extra_dims([name])
    for name, height in (("w_high", 500.0), ("w_none", np.nan)):
        las.add_extra_dim(laspy.ExtraBytesParams(name, "float64"))
        las[name] = np.full(300, height)
    las.write(at / "dims.las")


@pytest.fixture(scope="module")
def corrected(folder):
    """Add corrected clouds to the folder, one with a damaged record and one without its shift."""
    for name in ("all", "minimal", "none"):
        done = run_pcfix(*correct("--dimensions", name, output=f"{name}.las"), folder=folder)
        assert done.returncode == 0, done.stderr
    data = (folder / "all.las").read_bytes()
    place = data.index(b"pcfix\0") - 2
    (length,) = struct.unpack_from("<H", data, place + 20)
    for name, damage in RECORDS.items():
        (folder / f"r_{name}.las").write_bytes(data)
        patched(folder / f"r_{name}.las", place + 54, damage.ljust(length))
    las = laspy.read(folder / "all.las")
    las.remove_extra_dims(["ShiftX", "ShiftY"])
    las.write(folder / "no_shift.las")
    return folder


def listing(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


def refuse(folder, words, code, **values):
    """Run a command that is refused with a code and values, in one line, and writes nothing."""
    before = listing(folder)
    done = run_pcfix(*words, folder=folder)
    lines = [x for x in done.stderr.splitlines() if not x.startswith("pcfix: warning:")]
    assert (done.returncode, len(lines), done.stdout) == (1, 1, ""), done.stderr
    assert lines[0].startswith("pcfix: ")
    assert done.code == code, done.stderr
    for name, value in values.items():
        assert str(done.error.values[name]) == str(value), (name, done.error.values)
    assert listing(folder) == before


CLOUDS = {
    "input.unreadable": ["nowhere.las"],
    "cloud.no_files": ["folder.las"],
    "cloud.damaged": [
        "text.las", "no.las", "four.las", *(f"c3_{i}.las" for i in range(6)),
        *(f"c6_{i}.las" for i in range(3)), *(f"e6_{i}.las" for i in range(3)),
        *(f"z3_{i}.laz" for i in range(4)), "h_record_count.las", "h_start.las", "h_size.las",
        "h_record_length.las", "h_format.las", "h_version.las",
    ],
    "cloud.count": ["few.las", "h_point_count.las"],
    "cloud.scales": ["h_scale_zero.las", "h_scale_nan.las", "h_offset_inf.las"],
    "cloud.empty": ["no_points.las"],
    "cloud.ply": ["cloud.ply"],
    "cloud.dimension_exists": ["ShiftX.las", "RayCount.las", "SourceClass.las"],
}  # fmt: skip
WATERS = {
    "input.unreadable": ["nowhere.obj", "nowhere.ply"],
    "water.below_cloud": ["-40", "plane:3.5,0,0", "plane:-4560,0.01,0", "dim:w_none"],
    "cameras.under_water": ["500", "plane:500,0,0", "plane:-455560,1,0", "high.obj", "dim:w_high"],
    "cloud.no_dimension": ["dim:w_surf"],
    "water.spec": [
        "wet", "", "nan", "inf", "0,37", "plane:1,2", "plane:1,2,3,4", "plane:a,b,c",
        "plane:1,nan,0", "plane:", "dim:", "1 2", "level:3",
    ],
    "water.mesh_damaged": [
        "too_large.obj", "zero.obj", "far_back.obj", "word.obj", "flat.obj", "nan.obj",
        "bad_index.ply",
    ],
    "water.mesh_empty": ["empty.obj", "no_faces.obj", "garbage.obj", "no_faces.ply"],
    "water.mesh_flat": ["vertical.obj"],
    "ply.header": ["empty.ply"],
    "ply.cut_short": ["cut.ply"],
    "table.empty": ["shore.txt"],
}  # fmt: skip
CAMERAS = {
    "input.unreadable": ["nowhere.csv", "angles.csv --sensor nowhere.csv"],
    "cameras.folder": ["images"],
    "cameras.no_overlap": ["far.csv"],
    "cameras.none_corrected": ["one.csv --method snell"],
    "cameras.unknown": ["t_empty.csv", "t_binary.csv"],
    "cameras.not_read": ["t_no_header.csv"],
    "cameras.sensor_missing": ["angles.csv"],
    "cameras.sensor_unused": ["cameras.csv --sensor s_negative.csv"],
    "cameras.sensor_rows": ["angles.csv --sensor s_twice.csv"],
    "cameras.lens": [
        f"angles.csv --sensor s_{name}.csv" for name in ("negative", "no_height")
    ],
    "table.column_missing": [
        "t_no_z.csv", "t_two_angles.csv", "angles.csv --sensor s_no_column.csv",
        "angles.csv --sensor s_empty.csv",
    ],
    "cameras.no_frames": ["cameras.csv --max-angle auto"],
    "table.empty": ["t_header_only.csv", "angles.csv --sensor s_no_rows.csv"],
    "table.number": [
        *(f"t_{name}.csv" for name in ("word", "empty_field", "inf", "empty_lines",
                                       "nan_angle")),
        "angles.csv --sensor s_nan.csv",
    ],
    "table.not_csv": ["t_endless.csv"],
    "table.shifted": ["t_long_row.csv", "t_short_row.csv", "t_open_quote.csv"],
}  # fmt: skip
LAKE = "--overwrite --cameras angles.csv --sensor sensor.las --water lake.obj"
OUTPUTS = {
    "output.is_input": [
        *(f"{output} --overwrite" for output in (
            "cloud.las", "./cloud.las", "images/../cloud.las", "link.las", "hard.las")),
        *(f"{name} {LAKE}" for name in ("angles.csv", "sensor.las", "lake.obj")),
        *(f"out.las --summary {name}" for name in ("cloud.las", "out.las", "cameras.csv")),
        *(f"out.las {LAKE} --summary {name}" for name in ("angles.csv", "sensor.las", "lake.obj")),
    ],
    "output.exists": ["taken.las", "out.las --summary taken.json"],
    "output.no_folder": ["nowhere/out.las", "out.las --summary nowhere/s.json"],
    "output.not_a_file": ["."],
    "output.suffix": ["out.txt", "out"],
    "water.below_cloud": ["taken.las --overwrite --water -40"],
}  # fmt: skip
RESTORED = {
    "cloud.not_corrected": ["cloud.las back.las"],
    "cloud.vlr_damaged": [f"r_{name}.las back.las" for name in RECORDS],
    "cloud.cannot_restore": ["none.las back.las", "minimal.las back.las", "no_shift.las back.las"],
    "output.exists": ["cloud.las taken.las"],
    "output.is_input": ["all.las all.las"],
    "output.no_folder": ["all.las nowhere/back.las"],
    "output.suffix": ["all.las back.txt"],
}


def pairs(table):
    """Return (case, code) of a table of cases by their code."""
    return [(case, code) for code, cases in table.items() for case in cases]


@pytest.mark.parametrize(("name", "code"), pairs(CLOUDS))
def test_cloud(folder, name, code):
    refuse(folder, correct(cloud=name), code, path=name)


@pytest.mark.parametrize(("water", "code"), pairs(WATERS))
def test_water(folder, water, code):
    refuse(folder, correct("--water", water, cloud="dims.las"), code)


@pytest.mark.parametrize(("words", "code"), pairs(CAMERAS))
def test_cameras(folder, words, code):
    refuse(folder, correct("--cameras", *words.split()), code)


@pytest.mark.parametrize(("words", "code"), pairs(OUTPUTS))
def test_output(folder, words, code):
    output, *more = words.split()
    refuse(folder, correct(*more, output=output), code)


@pytest.mark.parametrize(("words", "code"), pairs(RESTORED))
def test_restore(corrected, words, code):
    refuse(corrected, ["restore", *words.split()], code)


@pytest.mark.parametrize("words", ["index 1.51", "index nan", "max-angle 0", "jobs 0"])
def test_out_of_range(folder, words):
    refuse(folder, correct(*f"--{words}".split()), "option.range")


@pytest.mark.parametrize("name", ["all", "minimal", "none"])
def test_corrected_twice(corrected, name):
    words = correct("--dimensions", "none", cloud=f"{name}.las")
    refuse(corrected, words, "cloud.corrected", path=f"{name}.las")


@pytest.mark.parametrize(
    "words",
    [
        ["correct", "cloud.las"],
        ["correct", "cloud.las", "out.las", "--water", "3"],
        ["correct", "cloud.las", "out.las", "--cameras", "cameras.csv"],
        correct("--deeper"),
        correct("--jobs", "few"),
        correct("--method", "burn"),
        correct("--dimensions", "some"),
        ["restore", "cloud.las"],
        ["refract", "cloud.las"],
    ],
    ids=" ".join,
)
def test_usage(folder, words):
    before = listing(folder)
    done = run_pcfix(*words, folder=folder)
    assert done.returncode == 2
    assert done.stderr
    assert listing(folder) == before
