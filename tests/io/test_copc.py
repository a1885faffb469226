"""COPC files, which another library writes."""

from pathlib import Path
from typing import Any

import laspy
import pytest

import pcfix
from tests.utils.clouds import WATER_M, block, random_cloud, read_raw, write_cloud
from tests.utils.codes import refused
from tests.utils.copc import write_copc

pytest.importorskip("copclib")
SNELL: dict[str, Any] = {"water": WATER_M, "method": "snell", "max_angle": None}


def cloud(path: Path) -> Path:
    las = random_cloud(7, plain=True)
    if ".copc" in path.name:
        return write_copc(path, las)
    las.write(path)
    return path


@pytest.mark.parametrize("chunk", [1_000_000, 150])
def test_all_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    """The points of a COPC file are corrected as those of a LAS file."""
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", chunk)
    tables = []
    for name in ("cloud.las", "tree.copc.laz"):
        out = tmp_path / f"{name}.out.laz"
        pcfix.correct_file(cloud(tmp_path / name), out, cameras=block(), **SNELL)
        tables.append(sorted(map(bytes, laspy.read(out).points.array)))
    assert tables[0] == tables[1]
    raw = read_raw(out)  # has no index
    assert not [r for r in raw.records + raw.extended if r.user_id.startswith(b"copc")]


@pytest.mark.parametrize("suffix", [".copc.laz", ".COPC.LAZ"])
def test_copc_output(tmp_path: Path, suffix: str) -> None:
    source = write_cloud(tmp_path / "cloud.laz", 7)
    with refused("output.copc"):
        pcfix.label_file(source, tmp_path / f"out{suffix}", water=WATER_M)
    assert list(tmp_path.iterdir()) == [source]
