"""Parts of a cloud, and COPC files, which another library writes."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

import pcfix
from tests.utils.clouds import (
    EAST_M,
    NORTH_M,
    SIDE_M,
    WATER_M,
    block,
    random_cloud,
    read_raw,
    write_cloud,
)
from tests.utils.codes import refused
from tests.utils.copc import write_copc

pytest.importorskip("copclib")
WEST, SOUTH = EAST_M + 0.2 * SIDE_M, NORTH_M + 0.2 * SIDE_M
BOX = (WEST, SOUTH, WEST + 40.0, SOUTH + 50.0)
SNELL: dict[str, Any] = {"water": WATER_M, "method": "snell", "max_angle": None}


def cloud(path: Path) -> Path:
    las = random_cloud(7, plain=True)
    if ".copc" in path.name:
        return write_copc(path, las)
    las.write(path)
    return path


def inside(las: laspy.LasData) -> np.ndarray:
    x, y = np.array(las.x), np.array(las.y)
    return (x >= BOX[0]) & (x <= BOX[2]) & (y >= BOX[1]) & (y <= BOX[3])


def rows(path: Path) -> list[bytes]:
    return sorted(map(bytes, laspy.read(path).points.array))


@pytest.mark.parametrize(
    ("name", "chunk"), [("cloud.las", 1_000_000), ("cloud.laz", 150), ("cloud.copc.laz", 150)]
)
def test_bounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, chunk: int) -> None:
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", chunk)
    source = cloud(tmp_path / name)
    before = laspy.read(source)
    summary = pcfix.correct_file(
        source, tmp_path / "part.laz", cameras=block(), bounds=BOX,
        summary=tmp_path / "part.json", **SNELL,
    )  # fmt: skip
    expected = {"points": int(inside(before).sum()), "of": 2000, "bounds": list(BOX)}
    assert summary.part == json.loads((tmp_path / "part.json").read_text())["part"] == expected
    assert summary.points == len(laspy.read(tmp_path / "part.laz")) == expected["points"]
    pcfix.correct_file(source, tmp_path / "whole.laz", cameras=block(), **SNELL)
    whole = laspy.read(tmp_path / "whole.laz").points.array[inside(before)]
    assert rows(tmp_path / "part.laz") == sorted(map(bytes, whole))
    ours = next(v for v in laspy.read(tmp_path / "part.laz").vlrs if v.user_id == "pcfix")
    assert json.loads(ours.record_data)["part"] == expected
    pcfix.restore_file(tmp_path / "part.laz", tmp_path / "back.laz")
    assert rows(tmp_path / "back.laz") == sorted(map(bytes, before.points.array[inside(before)]))


def test_output_has_no_index(tmp_path: Path) -> None:
    tree = cloud(tmp_path / "tree.copc.laz")
    pcfix.correct_file(tree, tmp_path / "out.laz", cameras=block(), **SNELL)
    raw = read_raw(tmp_path / "out.laz")
    assert not [r for r in raw.records + raw.extended if r.user_id.startswith(b"copc")]


@pytest.mark.parametrize("suffix", [".copc.laz", ".COPC.LAZ"])
def test_copc_output(tmp_path: Path, suffix: str) -> None:
    source = write_cloud(tmp_path / "cloud.laz", 7)
    with refused("output.copc"):
        pcfix.label_file(source, tmp_path / f"out{suffix}", water=WATER_M)
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"bounds": (0, 0, 1, 1)}, "cloud.bounds"),
        ({"bounds": "1,2,3"}, "option.count"),
        ({"bounds": (2, 0, 1, 1)}, "option.range"),
    ],
)
def test_bad_parts(tmp_path: Path, options: dict[str, Any], code: str) -> None:
    source = write_cloud(tmp_path / "cloud.laz", 7)
    with refused(code):
        pcfix.label_file(source, tmp_path / "out.las", water=WATER_M, **options)
    assert list(tmp_path.iterdir()) == [source]
