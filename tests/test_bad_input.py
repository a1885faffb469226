"""A user's mistake gives one line that says what to mend, exit code 1, and nothing left behind."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import warnings
from typing import TYPE_CHECKING

import laspy
import numpy as np
import pytest

from pcfix import Cameras, cli
from tests.utils.beyond_frames import BEYOND_FRAMES, DEEP
from tests.utils.clouds import (
    EAST_M,
    NORTH_M,
    SIDE_M,
    WATER_M,
    block,
    cameras_csv,
    patched,
    random_cloud,
    write_cloud,
)
from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Refuse = Callable[..., str]

SQUARE = [(x, y) for y in (NORTH_M - 50, NORTH_M + 200) for x in (EAST_M - 50, EAST_M + 200)]
SENSOR = "focal,sensor_x,sensor_y\n24,36,24\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a cloud and cameras that fit together."""
    write_cloud(tmp_path / "cloud.las", 3, count=300)
    cameras_csv(tmp_path / "cameras.csv", block())
    return tmp_path


def listing(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


def a_process(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pcfix", *arguments]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the command line in this process, in the folder."""

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", ["pcfix", *arguments])
        monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
        capfd.readouterr()
        code = 0
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code or 0
        out, err = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, code, out, err)

    return call


def job(*more: str, cloud: str = "cloud.las", output: str = "out.las") -> list[str]:
    """Return the arguments of a correction; those in `more` come last and win."""
    return ["correct", cloud, output, "--cameras", "cameras.csv", "--water", str(WATER_M), *more]


def message_of(done: subprocess.CompletedProcess[str]) -> str:
    """Return the one line that a refusal prints."""
    lines = [x for x in done.stderr.splitlines() if not x.startswith("pcfix: warning:")]
    assert done.returncode == 1, done
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("pcfix: ")
    assert done.stdout == ""
    return lines[0]


@pytest.fixture
def refuse(folder: Path, run: Callable[..., subprocess.CompletedProcess[str]]) -> Refuse:
    """Return a function that runs a command, sees it refused tidily, and returns the message."""

    def call(*arguments: str) -> str:
        before = listing(folder)
        message = message_of(run(*arguments))
        assert listing(folder) == before
        return message

    return call


# The cloud


def test_a_cloud_that_is_not_there(refuse: Refuse) -> None:
    assert "nowhere.las" in refuse(*job(cloud="nowhere.las"))


@pytest.mark.parametrize("content", [b"x y z\n1 2 3\n", b"", b"LASF", b"LASF" + b"\xff" * 500])
def test_a_file_that_is_no_cloud(refuse: Refuse, folder: Path, content: bytes) -> None:
    (folder / "text.las").write_bytes(content)
    assert "text.las" in refuse(*job(cloud="text.las"))


def test_ply_is_told_how_to_be_converted(refuse: Refuse, folder: Path) -> None:
    (folder / "cloud.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    said = refuse(*job(cloud="cloud.ply"))
    assert "is a PLY file" in said and "damaged" not in said
    assert "pdal translate cloud.ply cloud.laz --writers.las.scale_x=0.001" in said


@pytest.mark.parametrize(("suffix", "count"), [(".las", 300), (".laz", 120_000)])
def test_a_header_that_counts_too_few(
    refuse: Refuse, folder: Path, suffix: str, count: int
) -> None:
    """Of LAZ the chunk table tells: full chunks hold 50,000 points."""
    path = write_cloud(folder / f"few{suffix}", 7, count=count)
    patched(path, 247, struct.pack("<Q", count // 3))
    assert f"counts {count // 3:,} points" in refuse(*job(cloud=path.name))


def test_a_folder_as_input(refuse: Refuse, folder: Path) -> None:
    (folder / "folder.las").mkdir()
    assert "folder.las" in refuse(*job(cloud="folder.las"))


@pytest.mark.parametrize("number", [3, 6])
@pytest.mark.parametrize("size", [100, 226, 400, 900, -1, -40, -3000])
def test_las_cut_short(refuse: Refuse, folder: Path, size: int, number: int) -> None:
    las = random_cloud(number, count=300)
    las.evlrs = None
    las.write(folder / "whole.las")
    (folder / "cut.las").write_bytes((folder / "whole.las").read_bytes()[:size])
    message = refuse(*job(cloud="cut.las"))
    assert "cut.las" in message
    assert "copy it again" in message


@pytest.mark.parametrize("size", [4000, 30_000, 60_000])
def test_extended_records_cut_short(refuse: Refuse, folder: Path, size: int) -> None:
    data = write_cloud(folder / "whole.las", 6, count=300).read_bytes()
    (folder / "cut.las").write_bytes(data[:-size])
    assert "cut.las" in refuse(*job(cloud="cut.las"))


@pytest.mark.parametrize("jobs", ["1", "2"])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.9, 0.999])
def test_laz_cut_short(refuse: Refuse, folder: Path, share: float, jobs: str) -> None:
    data = write_cloud(folder / "whole.laz", 3).read_bytes()
    (folder / "cut.laz").write_bytes(data[: int(len(data) * share)])
    message = refuse(*job("--jobs", jobs, cloud="cut.laz"))
    assert "cut.laz" in message
    assert "copy it again" in message


@pytest.mark.parametrize("number", [3, 7])
def test_laz_with_damaged_points_is_refused_or_read(
    folder: Path, run: Callable[..., subprocess.CompletedProcess[str]], number: int
) -> None:
    """Compressed points hold no check sum: damage is noticed, or not, but never a traceback."""
    path = write_cloud(folder / "damaged.laz", number)
    (start,) = struct.unpack_from("<I", path.read_bytes(), 96)
    patched(path, start + 8, b"\xff\x00" * 2000)
    done = run(*job(cloud="damaged.laz"))
    assert done.returncode in (0, 1)
    assert len(done.stderr.splitlines()) == done.returncode


@pytest.mark.parametrize(
    ("place", "layout", "value"),
    [
        (100, "<I", 2**32 - 1),
        (96, "<I", 2**32 - 1),
        (94, "<H", 5),
        (105, "<H", 1),
        (104, "<B", 99),
        (25, "<B", 9),
        (107, "<I", 2**32 - 1),
    ],
    ids=["record count", "start", "size", "record length", "format", "version", "point count"],
)
def test_nonsense_in_the_header(
    refuse: Refuse, folder: Path, place: int, layout: str, value: int
) -> None:
    patched(folder / "cloud.las", place, struct.pack(layout, value))
    assert "cloud.las" in refuse(*job())


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("number", [3, 6])
def test_a_cloud_without_points(refuse: Refuse, folder: Path, number: int, suffix: str) -> None:
    write_cloud(folder / f"empty{suffix}", number, count=0)
    assert "no points" in refuse(*job(cloud=f"empty{suffix}"))


@pytest.mark.parametrize("place", [131, 139, 147, 155, 163, 171])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_scale_or_offset_that_is_no_number(
    refuse: Refuse, folder: Path, place: int, value: float
) -> None:
    patched(folder / "cloud.las", place, struct.pack("<d", value))
    assert "scales" in refuse(*job())


def test_a_scale_of_zero(refuse: Refuse, folder: Path) -> None:
    patched(folder / "cloud.las", 147, struct.pack("<d", 0.0))
    assert "scales" in refuse(*job())


@pytest.mark.parametrize("name", ["ShiftX", "RayCount", "SourceClass"])
def test_a_cloud_that_has_a_dimension_of_ours(refuse: Refuse, folder: Path, name: str) -> None:
    las = random_cloud(3, count=300)
    las.add_extra_dim(laspy.ExtraBytesParams(name, "int16"))
    las.write(folder / "taken.las")
    assert name in refuse(*job(cloud="taken.las"))


def test_a_cloud_that_was_corrected_already(
    refuse: Refuse, run: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    assert run(*job()).returncode == 0
    assert "already" in refuse(*job(cloud="out.las", output="again.las"))


@pytest.mark.parametrize("dimensions", ["none", "minimal"])
def test_a_cloud_that_was_corrected_already_with_fewer_dimensions(
    refuse: Refuse, run: Callable[..., subprocess.CompletedProcess[str]], dimensions: str
) -> None:
    assert run(*job("--dimensions", dimensions)).returncode == 0
    assert "already" in refuse(*job("--dimensions", "none", cloud="out.las", output="again.las"))


# The water


@pytest.mark.parametrize("water", ["-40", "plane:3.5,0,0", "plane:-4560,0.01,0"])
def test_no_point_below_the_water(refuse: Refuse, water: str) -> None:
    message = refuse(*job("--water", water))
    assert "no point" in message
    assert "water" in message


@pytest.mark.parametrize(
    "water",
    ["wet", "", "nan", "inf", "0,37", "plane:1,2", "plane:1,2,3,4", "plane:a,b,c", "plane:1,nan,0",
     "plane:", "dim:", "1 2", "level:3"],
)  # fmt: skip
def test_water_that_is_not_understood(refuse: Refuse, water: str) -> None:
    assert f"'{water}'" in refuse(*job("--water", water))


@pytest.mark.parametrize("name", ["lake.obj", "lake.ply"])
def test_a_mesh_that_is_not_there(refuse: Refuse, name: str) -> None:
    assert name in refuse(*job("--water", name))


PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\n"
PLY += "property double z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n"
V = "v 0 0 1\nv 9 0 1\nv 0 9 1\n"
MESHES = {
    "empty.obj": "",
    "no_faces.obj": V,
    "index_too_large.obj": V + "f 1 2 4\n",
    "index_zero.obj": V + "f 0 1 2\n",
    "index_far_back.obj": V + "f -9 -1 -2\n",
    "not_a_number.obj": "v 0 0 a\n" + V + "f 1 2 3\n",
    "two_coordinates.obj": "v 0 0\n" + V + "f 1 2 3\n",
    "not_finite.obj": "v 0 0 nan\n" + V + "f 1 2 3\n",
    "words.obj": V + "f one two three\n",
    "vertical.obj": "v 0 0 1\nv 9 0 1\nv 9 0 5\nf 1 2 3\n",
    "garbage.obj": "\x00\x01\x02 no mesh at all \xff\xfe\n" * 50,
    "empty.ply": "",
    "garbage.ply": "\x00\x01\x02 no mesh at all \xff\xfe\n" * 50,
    "no_faces.ply": PLY.format(3, 0) + "0 0 1\n9 0 1\n0 9 1\n",
    "bad_index.ply": PLY.format(3, 1) + "0 0 1\n9 0 1\n0 9 1\n3 0 1 7\n",
    "cut.ply": PLY.format(300, 100) + "0 0 1\n9 0 1\n0 9 1\n",
}


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_that_is_no_surface(refuse: Refuse, folder: Path, name: str) -> None:
    (folder / name).write_text(MESHES[name], "latin-1")
    assert name in refuse(*job("--water", name))


def test_a_text_file_as_water(refuse: Refuse, folder: Path) -> None:
    (folder / "shore.txt").write_text("1 2 3\n")
    assert "shore.txt" in refuse(*job("--water", "shore.txt"))


def test_a_dimension_that_the_cloud_lacks(refuse: Refuse) -> None:
    message = refuse(*job("--water", "dim:w_surf"))
    for name in ("w_surf", "Quality", "Level", "Precise", "Echo"):
        assert name in message


def cloud_with_surface(folder: Path, heights: float) -> None:
    las = random_cloud(3, count=300)
    las.add_extra_dim(laspy.ExtraBytesParams("w_surf", "float64"))
    las.w_surf = np.full(300, heights)
    las.write(folder / "cloud.las")


def test_a_dimension_without_one_height(refuse: Refuse, folder: Path) -> None:
    cloud_with_surface(folder, np.nan)
    assert "no point" in refuse(*job("--water", "dim:w_surf"))


def surface_above_all(folder: Path) -> None:
    """Write a cloud with a dimension, and a mesh, both above every camera."""
    cloud_with_surface(folder, 500.0)
    vertices = "".join(f"v {x} {y} 500\n" for x, y in SQUARE)
    (folder / "high.obj").write_text(vertices + "f 1 2 4\nf 1 4 3\n")


@pytest.mark.parametrize("water", ["500", "plane:500,0,0", "plane:-455560,1,0", "high.obj",
                                   "dim:w_surf"])  # fmt: skip
def test_cameras_under_the_water(refuse: Refuse, folder: Path, water: str) -> None:
    surface_above_all(folder)
    message = refuse(*job("--water", water))
    assert "under the water" in message
    assert "c0" in message


# The cameras


def test_cameras_that_are_not_there(refuse: Refuse) -> None:
    assert "none.csv" in refuse(*job("--cameras", "none.csv"))


def test_a_folder_that_holds_cameras(refuse: Refuse, folder: Path) -> None:
    (folder / "images").mkdir()
    assert "is not a camera file" in refuse(*job("--cameras", "images"))
    (folder / "images" / "cameras.csv").write_bytes((folder / "cameras.csv").read_bytes())
    (folder / "images" / "notes.txt").write_text("flown on a Tuesday")
    said = refuse(*job("--cameras", "images"))
    assert "is a folder that holds cameras.csv (CSV table). Give images/cameras.csv itself" in said


@pytest.mark.parametrize("angles", [False, True])
def test_cameras_far_away(refuse: Refuse, folder: Path, angles: bool) -> None:
    (folder / "sensor.csv").write_text(SENSOR)
    far = Cameras(block().labels, block().centres + np.array([500_000.0, 0.0, 0.0]))
    cameras_csv(folder / "far.csv", far, angles=angles)
    message = refuse(*job("--cameras", "far.csv"))
    assert "CRS" in message
    assert any(f"{km}." in message for km in range(499, 501))
    assert " km " in message


ROWS = "a,456010,5432010,90\nb,456060,5432010,90\nc,456010,5432060,90\n"
TABLES = {
    "too many fields": ("label,x,y,z\n" + ROWS + "d,1,456060,5432060,90\n", ["line 5", "shifted"]),
    "too few fields": ("label,x,y,z\n" + ROWS + "d,5432060,90\n", ["line 5", "shifted"]),
    "no column z": ("label,x,y\na,1,2\n", ["lacks z"]),
    "no column label": ("who,x,y,z\n" + ROWS, ["lacks label"]),
    "a word": ("label,x,y,z\na,456010,5432010,90\nb,east,5432010,90\n", ["line 3", "column x"]),
    "an empty field": ("label,x,y,z\n" + ROWS + "d,456060,,90\n", ["line 5", "column y"]),
    "nan": ("label,x,y,z\n" + ROWS + "d,456060,5432060,nan\n", ["line 5", "column z", "'nan'"]),
    "inf": ("label,x,y,z\n" + ROWS + "d,-inf,5432060,90\n", ["line 5", "column x", "'-inf'"]),
    "a decimal comma": ("label;x;y;z\na;456010,5;5432010;90\n", ["line 2", "column x"]),
    "behind an empty line": ("label,x,y,z\n\n\n" + ROWS + "\nd,1,2,east\n", ["line 8", "column z"]),
    "only a header": ("label,x,y,z\n", ["no rows"]),
    "nothing": ("", []),
    "binary": ("\x00\x01\x02\x03" * 100, []),
    "no header": (ROWS, []),
    "two angles": ("label,x,y,z,yaw,pitch\na,456010,5432010,90,0,0\n", ["roll"]),
    "an angle of nan": ("label,x,y,z,yaw,pitch,roll\na,1,2,90,0,nan,0\n", ["pitch", "line 2"]),
    "a quote that is never closed": ('label,x,y,z\n"a,1,2,90\nb,1,2,90\n', ["line 2"]),
    "an endless field": ('label,x,y,z\n"' + "a" * 200_000 + "\n", ["line 2"]),
}


@pytest.mark.parametrize("case", TABLES)
def test_camera_tables_that_are_not_right(refuse: Refuse, folder: Path, case: str) -> None:
    text, expected = TABLES[case]
    (folder / "sensor.csv").write_text(SENSOR)
    (folder / "bad.csv").write_text(text)
    message = refuse(*job("--cameras", "bad.csv"))
    for part in ["bad.csv", *expected]:
        assert part in message


def test_angles_without_a_sensor(refuse: Refuse, folder: Path) -> None:
    cameras_csv(folder / "cameras.csv", block(), angles=True)
    assert "sensor" in refuse(*job())


def test_a_sensor_without_angles(refuse: Refuse, folder: Path) -> None:
    (folder / "lens.csv").write_text(SENSOR)
    assert "angles" in refuse(*job("--sensor", "lens.csv"))


@pytest.mark.parametrize(
    "text",
    [
        "focal,sensor_x,sensor_y\n0,36,24\n",
        "focal,sensor_x,sensor_y\n-24,36,24\n",
        "focal,sensor_x,sensor_y\n24,36,nan\n",
        "focal,sensor_x,sensor_y\n24,36,0\n",
        "focal,sensor_x,sensor_y\n24,36,24\n24,36,24\n",
        "focal,sensor_x,sensor_y\n",
        "focal,sensor_x\n24,36\n",
        "",
    ],
)
def test_sensors_that_are_not_right(refuse: Refuse, folder: Path, text: str) -> None:
    cameras_csv(folder / "cameras.csv", block(), angles=True)
    (folder / "lens.csv").write_text(text)
    assert "lens.csv" in refuse(*job("--sensor", "lens.csv"))


def test_a_sensor_that_is_not_there(refuse: Refuse, folder: Path) -> None:
    cameras_csv(folder / "cameras.csv", block(), angles=True)
    assert "lens.csv" in refuse(*job("--sensor", "lens.csv"))


# The options


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [
        ("--index", "0.99", "0.99"),
        ("--index", "1.51", "1.51"),
        ("--index", "nan", "index"),
        ("--index", "inf", "index"),
        ("--max-angle", "0", "max-angle"),
        ("--max-angle", "91", "max-angle"),
        ("--max-angle", "-5", "max-angle"),
        ("--max-angle", "nan", "max-angle"),
        ("--max-cameras", "1", "max-cameras"),
        ("--max-cameras", "0", "max-cameras"),
        ("--jobs", "0", "jobs"),
        ("--jobs", "-2", "jobs"),
    ],
)
def test_values_outside_their_rule(refuse: Refuse, option: str, value: str, word: str) -> None:
    assert word in refuse(*job(option, value))


# The files that are to be written


@pytest.mark.parametrize("output", ["cloud.las", "./cloud.las", "below/../cloud.las", "link.las"])
def test_output_on_top_of_the_input(refuse: Refuse, folder: Path, output: str) -> None:
    (folder / "below").mkdir()
    (folder / "link.las").symlink_to("cloud.las")
    assert "same file" in refuse(*job("--overwrite", output=output))


def test_output_on_top_of_the_input_by_its_full_path(refuse: Refuse, folder: Path) -> None:
    assert "same file" in refuse(*job("--overwrite", output=str(folder / "cloud.las")))


def test_output_on_top_of_the_input_by_a_hard_link(refuse: Refuse, folder: Path) -> None:
    os.link(folder / "cloud.las", folder / "hard.las")
    before = (folder / "cloud.las").read_bytes()
    assert "same file" in refuse(*job("--overwrite", output="hard.las"))
    assert (folder / "cloud.las").read_bytes() == before


@pytest.mark.parametrize("command", ["correct", "restore"])
def test_output_that_exists(refuse: Refuse, folder: Path, command: str) -> None:
    (folder / "out.las").write_text("somebody's work")
    arguments = job() if command == "correct" else ["restore", "cloud.las", "out.las"]
    assert "--overwrite" in refuse(*arguments)


def test_output_that_exists_stays_when_the_correction_fails(refuse: Refuse, folder: Path) -> None:
    (folder / "out.las").write_text("somebody's work")
    refuse(*job("--overwrite", "--water", "-40"))


@pytest.mark.parametrize(
    ("output", "word"),
    [("nowhere/out.las", "folder"), ("out.txt", ".laz"), ("out", ".laz"), (".", "folder")],
)
def test_outputs_that_cannot_be(refuse: Refuse, output: str, word: str) -> None:
    assert word in refuse(*job(output=output))


@pytest.mark.parametrize("output", ["nowhere/back.las", "back.txt", "cloud.las"])
def test_restored_outputs_that_cannot_be(refuse: Refuse, output: str) -> None:
    refuse("restore", "cloud.las", output, "--overwrite")


@pytest.mark.parametrize(
    "summary", ["cloud.las", "out.las", "taken.json", "nowhere/s.json", "cameras.csv"]
)
def test_summaries_that_cannot_be_written(refuse: Refuse, folder: Path, summary: str) -> None:
    (folder / "taken.json").write_text("{}")
    refuse(*job("--summary", summary))


@pytest.mark.parametrize("other", ["cameras.csv", "sensor.las", "high.obj"])
@pytest.mark.parametrize("option", ["output", "summary"])
def test_no_other_input_is_written_over(
    refuse: Refuse, folder: Path, other: str, option: str
) -> None:
    """Even with --overwrite: cameras, sensor and mesh are inputs as the cloud is."""
    surface_above_all(folder)
    (folder / "high.obj").write_text((folder / "high.obj").read_text().replace(" 500\n", " 12\n"))
    cameras_csv(folder / "cameras.csv", block(), angles=True)
    (folder / "sensor.las").write_text(SENSOR.replace("36,24", "360,240"))
    more = ["--overwrite", "--sensor", "sensor.las", "--water", "high.obj"]
    target = {"output": other} if option == "output" else {}
    arguments = job(*more, **target)
    assert other in refuse(*arguments, *(["--summary", other] if not target else []))


def test_restore_of_a_cloud_that_was_never_corrected(refuse: Refuse) -> None:
    assert "not corrected" in refuse("restore", "cloud.las", "back.las")


@pytest.mark.parametrize("dimensions", ["none", "minimal"])
def test_restore_of_a_cloud_without_the_way_back(
    refuse: Refuse, run: Callable[..., subprocess.CompletedProcess[str]], dimensions: str
) -> None:
    assert run(*job("--dimensions", dimensions)).returncode == 0
    assert dimensions in refuse("restore", "out.las", "back.las")


@pytest.mark.parametrize("damage", [b"{", b"[]", b'"no"', b"{}", b"\xff\xfe", b'{"settings":{}}'])
def test_restore_of_a_cloud_whose_settings_are_damaged(
    refuse: Refuse,
    run: Callable[..., subprocess.CompletedProcess[str]],
    folder: Path,
    damage: bytes,
) -> None:
    assert run(*job()).returncode == 0
    data = (folder / "out.las").read_bytes()
    place = data.index(b"pcfix\0") - 2
    (length,) = struct.unpack_from("<H", data, place + 20)
    patched(folder / "out.las", place + 54, damage.ljust(length))
    assert "out.las" in refuse("restore", "out.las", "back.las")


def test_restore_of_a_cloud_whose_shift_was_removed(
    refuse: Refuse, run: Callable[..., subprocess.CompletedProcess[str]], folder: Path
) -> None:
    assert run(*job()).returncode == 0
    las = laspy.read(folder / "out.las")
    las.remove_extra_dims(["ShiftX", "ShiftY"])
    las.write(folder / "out.las")
    assert "Shift" in refuse("restore", "out.las", "back.las")


# The same through a real process


PROCESSES = {
    "missing input": (job(cloud="nowhere.las"), "nowhere.las"),
    "text for a cloud": (job(cloud="text.las"), "text.las"),
    "laz cut short": (job(cloud="cut.laz"), "copy it again"),
    "garbage mesh": (job("--water", "garbage.ply"), "garbage.ply"),
    "bad index in a mesh": (job("--water", "bad.obj"), "bad.obj"),
    "no point below": (job("--water=-40"), "no point"),
    "shifted row": (job("--cameras", "shifted.csv"), "line 5"),
    "index": (job("--index", "1.6"), "1.6"),
    "output exists": (job(output="cameras.las"), "--overwrite"),
    "never corrected": (["restore", "cloud.las", "back.las"], "not corrected"),
}


@pytest.mark.parametrize("case", mostly_nightly(PROCESSES, "garbage mesh", "never corrected"))
def test_a_process_refuses_tidily(folder: Path, case: str) -> None:
    arguments, word = PROCESSES[case]
    (folder / "text.las").write_text("x y z\n")
    (folder / "garbage.ply").write_text(MESHES["garbage.ply"], "latin-1")
    (folder / "bad.obj").write_text(MESHES["index_too_large.obj"])
    (folder / "shifted.csv").write_text(TABLES["too many fields"][0])
    (folder / "cameras.las").write_text("somebody's work")
    data = write_cloud(folder / "whole.laz", 3).read_bytes()
    (folder / "cut.laz").write_bytes(data[: len(data) // 2])
    before = listing(folder)
    done = a_process(folder, *arguments)
    assert word in message_of(done)
    assert "Traceback" not in done.stderr
    assert listing(folder) == before


@pytest.mark.parametrize("suffix", mostly_nightly([".las", ".laz"], ".laz"))
@pytest.mark.parametrize(("count", "limit"), [(300, 2000), (3000, 60_000)], ids=["end", "middle"])
def test_a_full_disk_leaves_nothing_behind(
    folder: Path, count: int, limit: int, suffix: str
) -> None:
    """A limit on the size of files fails as a full disk does."""
    resource = pytest.importorskip("resource")
    write_cloud(folder / "cloud.las", 3, count=count)
    before = listing(folder)
    done = subprocess.run(
        [sys.executable, "-m", "pcfix", *job(output=f"out{suffix}")],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert "cannot be written" in message_of(done)
    assert listing(folder) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["correct", "cloud.las"],
        ["correct", "cloud.las", "out.las", "--water", "3"],
        ["correct", "cloud.las", "out.las", "--cameras", "cameras.csv"],
        job("--deeper"),
        job("--max-cameras", "few"),
        job("--uncorrected", "burn"),
        job("--dimensions", "some"),
        ["restore", "cloud.las"],
        ["refract", "cloud.las"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_exit_code_2(
    folder: Path, run: Callable[..., subprocess.CompletedProcess[str]], arguments: list[str]
) -> None:
    before = listing(folder)
    done = run(*arguments)
    assert done.returncode == 2
    assert done.stderr
    assert "Traceback" not in done.stderr
    assert listing(folder) == before


# What goes well


KEYS = {
    "input", "output", "pcfix", "points", "submerged", "corrected", "uncorrected", "dropped",
    "water_unknown", "depth_m", "shift_z_m", "rays", "cameras", "cameras_used", "cameras_unused",
    "cameras_left_out", "water", "settings", "seconds", "views", "water_fit", "warnings",
    "points_per_s", "uncertainty", "made", "poses", "incidence_deg", "fit",
}  # fmt: skip


def test_labels_that_repeat_are_a_warning(folder: Path) -> None:
    table = (folder / "cameras.csv").read_text().splitlines()
    moved = table[2].replace(",4560", ",4559")
    (folder / "cameras.csv").write_text("\n".join([*table, table[1], moved]) + "\n")
    done = run_pcfix(*job("--summary", "summary.json"), folder=folder)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("pcfix: warning: ")
    assert "c0" in line
    assert "c1" in line and "1 exact copies are dropped" in line
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["cameras"] == 10
    assert len(summary["warnings"]) == 1


def test_summary_is_json_with_the_documented_keys(folder: Path) -> None:
    done = a_process(folder, *job("--summary", "summary.json"))
    assert (done.returncode, done.stderr) == (0, "")
    assert "cloud.las -> out.las" in done.stdout
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary) == KEYS
    z = laspy.read(folder / "cloud.las").z
    assert summary["points"] == 300
    assert summary["submerged"] == summary["corrected"] == np.sum(np.array(z) < WATER_M)
    assert summary["settings"]["index"] == 1.34
    assert sorted(path.name for path in folder.iterdir()) == [
        "cameras.csv", "cloud.las", "out.las", "summary.json",
    ]  # fmt: skip


def test_nothing_corrected_is_an_error(refuse: Refuse, folder: Path) -> None:
    lines = (folder / "cameras.csv").read_text().splitlines()
    (folder / "cameras.csv").write_text("\n".join(lines[:2]) + "\n")
    message = refuse(*job("--method", "snell"))
    assert "submerged points can be corrected" in message
    assert "one usable ray only" in message


def test_little_corrected_is_said_first(
    run: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    done = run(*job("--max-angle", "20"))
    assert done.returncode == 0, done.stderr
    first = done.stdout.splitlines()[0]
    assert first.startswith("WARNING      only ")
    assert "submerged points were corrected" in first


def test_quiet_says_nothing(
    folder: Path, run: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    done = run(*job("--quiet"))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    done = run("restore", "--quiet", "out.las", "back.las")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (folder / "back.las").read_bytes() == (folder / "cloud.las").read_bytes()


def test_overwrite_replaces_an_output(
    folder: Path, run: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    for name in ("out.las", "summary.json"):
        (folder / name).write_text("an earlier run")
    assert run(*job("--overwrite", "--summary", "summary.json")).returncode == 0
    assert (folder / "out.las").read_bytes().startswith(b"LASF")
    assert set(json.loads((folder / "summary.json").read_text())) == KEYS


@pytest.mark.parametrize("header", ["Label;X;Y;Z", "\ufefflabel,x,y,z", "x\ty\tz\tlabel"])
def test_tables_as_spreadsheets_write_them(
    folder: Path, run: Callable[..., subprocess.CompletedProcess[str]], header: str
) -> None:
    rows = [["a", "456010", "5432010", "90"], ["b", "456060", "5432010", "90"]]
    if header.startswith("x"):
        rows = [[*row[1:], row[0]] for row in rows]
    delimiter = next(c for c in ",;\t" if c in header)
    text = "\r\n".join([header, *(delimiter.join(row) for row in rows)])
    (folder / "cameras.csv").write_text(text, "utf-8")
    assert run(*job()).returncode == 0


@BEYOND_FRAMES
@DEEP
def test_the_bed_may_lie_below_zero(
    folder: Path, run: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    offsets = (EAST_M, NORTH_M, -SIDE_M)
    las = random_cloud(3, count=300, offsets=offsets)
    las.points.array["Z"] -= int(30.0 / las.header.scales[2])
    las.write(folder / "cloud.las")
    done = run(*job("--water", "-3.5"))
    assert done.returncode == 0, done.stderr
