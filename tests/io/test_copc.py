"""COPC, written: the octree against a slow twin, and against readers that stream it."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
import pytest

import pcfix
from pcfix import PcfixError, SettingError
from pcfix.flow.plausibility import CloudSample
from pcfix.io.las import copc, part
from pcfix.io.las.part import Box, cloud_part
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import LasSink
from pcfix.options.shared import PartOptions
from tests.utils.clouds import (
    EAST_M,
    NORTH_M,
    SIDE_M,
    WATER_M,
    block,
    cameras_csv,
    random_cloud,
    read_raw,
    write_cloud,
)
from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix
from tests.utils.real_pdal import needs_pdal, pdal

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LEAF, CELLS = 100, 2


@pytest.fixture(scope="module", autouse=True)
def level_as_given() -> Iterator[None]:
    """Points at random show no level; to look for one there takes longer than to correct them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CloudSample, "level_doubts", lambda sample: ())
        yield


@pytest.fixture
def small_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let 2,000 points fill an octree, from several runs, in several batches."""
    monkeypatch.setattr(copc, "LEAF_POINTS", LEAF)
    monkeypatch.setattr(copc, "_CELLS", CELLS)
    monkeypatch.setattr(copc, "CHUNK_POINTS", 700)


def written(las: laspy.LasData, path: Path, jobs: int | None = None) -> Path:
    """Write a cloud as it is."""
    with LasSink(path, las.header, jobs=jobs) as sink:
        sink.write(las.points)
    return path


def rows(path: Path) -> list[bytes]:
    """Return all points, in an order that says nothing."""
    return sorted(bytes(one) for one in read_raw(path).points)


def corrected(source: Path, target: Path, **more: object) -> Path:
    pcfix.correct_file(source, target, cameras=block(), water=WATER_M, **more)
    return target


def nodes_of(path: Path) -> dict[tuple[int, int, int, int], list[bytes]]:
    """Return the points of each node, by its level and place."""
    with laspy.CopcReader.open(path) as reader:
        entries = reader.root_page.entries
        found = {}
        for key, entry in entries.items():
            node = laspy.copc.OctreeNode()
            node.offset, node.byte_size = entry.offset, entry.byte_size
            node.point_count = entry.point_count
            points = reader._fetch_and_decompress_points_of_nodes([node] if entry.offset else [])
            found[key.level, key.x, key.y, key.z] = [bytes(one) for one in points.array]
    return found


def nodes_of_twin(
    las: laspy.LasData, low: np.ndarray, side: float
) -> dict[tuple[int, int, int, int], list[bytes]]:
    """Put points into an octree one by one, along the curve."""
    xyz = np.column_stack([las.X, las.Y, las.Z]) - low
    at = xyz * las.header.scales / side * 2**21  # what lies on the far faces is inside
    places = [[min(int(v), 2**21 - 1) for v in row] for row in at]

    def curve(place: list[int]) -> int:
        return sum(
            (v >> bit & 1) << (3 * bit + a) for a, v in enumerate(place) for bit in range(21)
        )

    def cell(place: list[int], level: int) -> tuple[int, ...]:
        return (level, *(v >> (21 - level) for v in place))

    below = Counter(cell(place, level) for place in places for level in range(22))
    seen, nodes = set(), defaultdict(list)
    for i in sorted(range(len(places)), key=lambda i: curve(places[i])):  # ties as they came
        taken = False
        for level in range(22):
            fine = (level, cell(places[i], level + CELLS)) if level + CELLS <= 21 else None
            first = fine is not None and fine not in seen
            seen.add(fine)
            if not taken and (first or below[cell(places[i], level)] <= LEAF or level == 21):
                nodes[cell(places[i], level)].append(bytes(las.points.array[i]))
                taken = True
    return dict(nodes)


def strange(kind: str) -> laspy.LasData:
    """Return a cloud that lies as few do."""
    las, rng = random_cloud(7), np.random.default_rng(3)
    if kind == "one place":
        for axis in "XYZ":
            las.points.array[axis] = 5
    elif kind == "a stray point":
        las.points.array["X"][7] = 2_000_000_000
    elif kind == "two layers":
        las.points.array["Z"] = np.where(rng.random(len(las)) < 0.5, -1000, 90_000)
    elif kind == "one point":
        las.points = las.points[:1]
    elif kind == "clumps":
        for axis in "XYZ":
            las.points.array[axis] = rng.integers(0, 40, len(las)) * 3_000 + rng.integers(0, 3)
    return las


@pytest.mark.usefixtures("small_nodes")
@pytest.mark.parametrize(
    "kind", ["any", "one place", "a stray point", "two layers", "one point", "clumps"]
)
def test_every_point_is_in_the_node_of_the_slow_twin(tmp_path: Path, kind: str) -> None:
    las = strange(kind)
    nodes = nodes_of(written(las, tmp_path / "tree.copc.laz"))
    with laspy.CopcReader.open(tmp_path / "tree.copc.laz") as reader:
        info, header = reader.copc_info, reader.header
    assert info.spacing == 2 * info.halfsize / 2**CELLS
    assert (header.mins >= info.center - info.halfsize - 1e-6).all()
    assert (header.maxs <= info.center + info.halfsize + 1e-6).all()
    assert (info.gps_min, info.gps_max) == (las.gps_time.min(), las.gps_time.max())
    low = np.array([las.X.min(), las.Y.min(), las.Z.min()], np.int64)
    twin = nodes_of_twin(las, low, 2 * info.halfsize)
    assert {key: points for key, points in nodes.items() if points} == twin
    for level, *place in nodes:  # readers come to a node by those above it
        assert level == 0 or (level - 1, *(v // 2 for v in place)) in nodes


@pytest.mark.usefixtures("small_nodes")
def test_queries_find_what_lies_there(tmp_path: Path) -> None:
    las = random_cloud(8)
    written(las, tmp_path / "tree.copc.laz")
    low, high = (np.array([EAST_M, NORTH_M]) + share * SIDE_M for share in (0.2, 0.45))
    inside = (las.x >= low[0]) & (las.x <= high[0]) & (las.y >= low[1]) & (las.y <= high[1])
    with laspy.CopcReader.open(tmp_path / "tree.copc.laz") as reader:
        found = reader.query(bounds=laspy.copc.Bounds(low, high))
        assert sorted(map(bytes, found.array)) == sorted(map(bytes, las.points.array[inside]))
        counts = [len(reader.query(level=level)) for level in range(7)]
        assert sum(counts) == len(las)
        assert counts[0] <= 4**3
        assert all(counts[:3])
        for level in range(3):  # coarse levels keep their distance, in plan and height
            some = reader.query(level=range(level + 1))
            xyz = np.column_stack([some.X, some.Y, some.Z]).astype(float)
            xyz = (xyz - [las.X.min(), las.Y.min(), las.Z.min()]) * las.header.scales
            cells = np.floor(xyz / (reader.copc_info.spacing / 2**level))
            assert len(np.unique(cells, axis=0)) == len(cells)


@pytest.mark.usefixtures("small_nodes")
@pytest.mark.parametrize("point_format", mostly_nightly([2, 6, 7, 8], 2, 8))
def test_all_that_a_cloud_has_goes_into_copc_and_back(tmp_path: Path, point_format: int) -> None:
    source = write_cloud(tmp_path / "cloud.laz", point_format)
    plain = corrected(source, tmp_path / "plain.laz")
    tree = corrected(source, tmp_path / "tree.copc.laz")
    one, other = read_raw(plain), read_raw(tree)
    assert rows(tree) == rows(plain)
    assert other.header[:94] == one.header[:94]  # what it is of, and of which day
    assert (other.scales, other.offsets) == (one.scales, one.offsets)
    assert other.records[0].kind == (b"copc", 1)
    laz = (b"laszip encoded", 22204)
    assert [r for r in other.records[1:] if r.kind != laz] == [
        r for r in one.records if r.kind != laz
    ]
    assert other.extended[0].kind == (b"copc", 1000)
    assert other.extended[1:] == one.extended
    if point_format < 6:
        with pytest.raises(SettingError, match=r"COPC has point formats 6 to 8, and the output"):
            pcfix.restore_file(tree, tmp_path / "back.copc.laz")
    back = tmp_path / "back.laz"
    pcfix.restore_file(tree, back)
    assert rows(back) == rows(source)
    assert read_raw(back).foreign() == read_raw(source).foreign()
    assert read_raw(back).extended == read_raw(source).extended


@pytest.mark.usefixtures("small_nodes")
def test_copc_that_comes_in_goes_out_as_laz_without_its_index(tmp_path: Path) -> None:
    tree = written(random_cloud(7), tmp_path / "tree.copc.laz")
    out = corrected(tree, tmp_path / "out.laz")
    raw = read_raw(out)
    assert not [r for r in raw.records + raw.extended if r.user_id.startswith(b"copc")]
    again = corrected(tree, tmp_path / "again.copc.laz")
    assert rows(again) == rows(out)
    records = read_raw(again).records + read_raw(again).extended
    assert sorted(r.record_id for r in records if r.user_id.startswith(b"copc")) == [1, 1000]
    pcfix.restore_file(again, tmp_path / "back.copc.laz")
    assert (tmp_path / "back.copc.laz").read_bytes() == tree.read_bytes()


@pytest.mark.usefixtures("small_nodes")
def test_threads_and_chunks_leave_no_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_cloud(tmp_path / "cloud.laz", 7)
    files = [corrected(source, tmp_path / f"{n}.copc.laz", jobs=n) for n in (1, 2)]
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", 300)
    files.append(corrected(source, tmp_path / "3.copc.laz"))
    monkeypatch.setattr(copc, "CHUNK_POINTS", 5000)
    files.append(corrected(source, tmp_path / "4.copc.laz"))
    assert len({one.read_bytes() for one in files}) == 1
    assert len(list(tmp_path.iterdir())) == 5


@pytest.mark.parametrize("suffix", [".copc.laz", ".COPC.LAZ"])
def test_what_copc_cannot_hold_is_refused(tmp_path: Path, suffix: str) -> None:
    source = write_cloud(tmp_path / "cloud.las", 4)
    with pytest.raises(SettingError) as refusal:
        corrected(source, tmp_path / f"out{suffix}")
    assert str(refusal.value) == (
        f"{tmp_path}/out{suffix}: COPC has point formats 6 to 8, and the output has 9; give a name"
        " without '.copc'."
    )
    assert sorted(tmp_path.iterdir()) == [source]


@pytest.mark.usefixtures("small_nodes")
def test_copclib_reads_it(tmp_path: Path) -> None:
    copclib = pytest.importorskip("copclib")
    las = random_cloud(7)
    written(las, tmp_path / "tree.copc.laz")
    reader = copclib.FileReader(str(tmp_path / "tree.copc.laz"))
    points = reader.GetAllPoints()
    np.testing.assert_allclose(np.sort(points.x), np.sort(las.x), atol=1e-6)
    low, high = (np.array([EAST_M, NORTH_M]) + share * SIDE_M for share in (0.2, 0.45))
    inside = (las.x >= low[0]) & (las.x <= high[0]) & (las.y >= low[1]) & (las.y <= high[1])
    found = reader.GetPointsWithinBox(copclib.Box(*low, -1e3, *high, 1e3))
    np.testing.assert_allclose(np.sort(found.x), np.sort(las.x[inside]), atol=1e-6)
    assert 0 < len(found) < len(las)
    assert reader.GetMaxDepth() >= 2


@needs_pdal
@pytest.mark.usefixtures("small_nodes")
def test_pdal_reads_it(tmp_path: Path) -> None:
    """By its index where PDAL is 2.4 or newer; 2.2 takes it for any LAZ."""
    source = write_cloud(tmp_path / "cloud.laz", 7)
    tree = corrected(source, tmp_path / "tree.copc.laz")
    las = laspy.read(tree)
    low, high = (np.array([EAST_M, NORTH_M]) + share * SIDE_M for share in (0.2, 0.45))
    bounds = f"([{low[0]},{high[0]}],[{low[1]},{high[1]}])"
    inside = (las.x >= low[0]) & (las.x <= high[0]) & (las.y >= low[1]) & (las.y <= high[1])
    by_index = "readers.copc" in pdal("--drivers", folder=tmp_path).stdout
    if by_index:
        words = ["-r", "readers.copc", f"--readers.copc.bounds={bounds}"]
    else:
        words = ["-f", "filters.crop", f"--filters.crop.bounds={bounds}"]
    done = pdal("translate", tree, "out.las", *words, "--writers.las.forward=all",
                "--writers.las.minor_version=4", "--writers.las.dataformat_id=7",
                "--writers.las.extra_dims=ShiftZ=float", folder=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = laspy.read(tmp_path / "out.las")
    for name in [*"XYZ", "classification", "gps_time", "red"]:
        np.testing.assert_array_equal(np.sort(found[name]), np.sort(np.array(las[name])[inside]))


# A part of a cloud


WEST, SOUTH = EAST_M + 0.2 * SIDE_M, NORTH_M + 0.2 * SIDE_M
BOX = (WEST, SOUTH, WEST + 40.0, SOUTH + 50.0)


def inside(las: laspy.LasData) -> np.ndarray:
    x, y = np.array(las.x), np.array(las.y)
    return (x >= BOX[0]) & (x <= BOX[2]) & (y >= BOX[1]) & (y <= BOX[3])


@pytest.mark.usefixtures("small_nodes")
@pytest.mark.parametrize(
    ("name", "chunk"), [("cloud.las", 1_000_000), ("cloud.laz", 150), ("cloud.copc.laz", 150)]
)
def test_bounds_read_what_lies_within(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, chunk: int
) -> None:
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", chunk)
    las = random_cloud(7)
    source = written(las, tmp_path / name)
    how = {"cameras": block(), "water": WATER_M, "method": "snell", "max_angle": None}
    summary = pcfix.correct_file(
        source, tmp_path / "part.laz", bounds=BOX, summary=tmp_path / "part.json", **how
    )
    expected = {"points": int(inside(las).sum()), "of": 2000, "bounds": list(BOX),
                "read_resolution": None}  # fmt: skip
    assert summary.part == json.loads((tmp_path / "part.json").read_text())["part"] == expected
    assert summary.points == len(laspy.read(tmp_path / "part.laz")) == expected["points"]
    pcfix.correct_file(source, tmp_path / "whole.laz", **how)
    whole = laspy.read(tmp_path / "whole.laz")
    some = whole.points.array[inside(laspy.read(source))]
    assert rows(tmp_path / "part.laz") == sorted(map(bytes, some))
    ours = next(v for v in laspy.read(tmp_path / "part.laz").vlrs if v.user_id == "pcfix")
    assert json.loads(ours.record_data)["part"] == expected
    pcfix.restore_file(tmp_path / "part.laz", tmp_path / "back.laz")
    before = laspy.read(source)
    assert rows(tmp_path / "back.laz") == sorted(map(bytes, before.points.array[inside(before)]))


@pytest.mark.usefixtures("small_nodes")
def test_of_copc_only_the_nodes_within_are_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, unpacked = written(random_cloud(7), tmp_path / "tree.copc.laz"), []
    of = part._unpacked
    monkeypatch.setattr(part, "_unpacked", lambda *a: unpacked.append(len(a[1])) or of(*a))
    with LasSource(cloud_part(source, PartOptions(bounds=BOX))) as cloud:
        points = np.concatenate([one.array for one in cloud.chunks()])
    assert len(points) == len(cloud) == inside(laspy.read(source)).sum()
    assert 0 < sum(unpacked) / 2 < len(nodes_of(source)) / 2


@pytest.mark.usefixtures("small_nodes")
@pytest.mark.parametrize("resolution", [100.0, 20.0, 3.0])
@pytest.mark.parametrize("box", [None, BOX])
def test_coarse_levels_of_copc(tmp_path: Path, resolution: float, box: Box | None) -> None:
    source = written(random_cloud(7), tmp_path / "tree.copc.laz")
    summary = pcfix.label_file(
        source, tmp_path / "part.las", water=WATER_M, bounds=box, read_resolution=resolution
    )
    corners = None if box is None else laspy.copc.Bounds(np.array(box[:2]), np.array(box[2:]))
    with laspy.CopcReader.open(source) as reader:
        expected = reader.query(bounds=corners, resolution=resolution)
    found = laspy.read(tmp_path / "part.las")
    np.testing.assert_array_equal(np.sort(found.gps_time), np.sort(expected["gps_time"]))
    assert summary.part is not None
    assert (summary.part["points"], summary.part["of"]) == (len(expected), 2000)
    ours = next(v for v in found.vlrs if v.user_id == "pcfix")
    assert json.loads(ours.record_data)["part"] == summary.part


def test_a_surface_model_of_a_part(tmp_path: Path) -> None:
    source = written(random_cloud(7), tmp_path / "tree.copc.laz")
    done = run_pcfix(
        "dsm", source, "dsm.tif", "--bounds", ",".join(map(str, BOX)), "--resolution", 10,
        folder=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    count = inside(laspy.read(source)).sum()
    assert f"{count:,} of {count:,} (" in done.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": (0, 0, 1, 1)}, "no point lies within 0,0,1,1; it reaches from 456000."),
        ({"read_resolution": 1.0}, "is not COPC, so it has no coarser levels to read; leave out"),
        ({"bounds": "1,2,3"}, "bounds must be four numbers X0,Y0,X1,Y1 in metres, west and"),
        ({"bounds": (2, 0, 1, 1)}, "bounds must be four numbers X0,Y0,X1,Y1 in metres, west and"),
        ({"read_resolution": 0.0}, "read-resolution 0 must be above 0: give metres."),
    ],
)
def test_parts_that_cannot_be(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    source = write_cloud(tmp_path / "cloud.laz", 7)
    with pytest.raises(PcfixError) as refusal:
        pcfix.label_file(source, tmp_path / "out.las", water=WATER_M, **options)
    assert message in str(refusal.value)
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("output", "more", "message"),
    [
        ("out.laz", ["--bounds=0,0,1,1"], "give readers.copc its bounds and resolution"),
        ("out.copc.laz", [], "the pipeline would write LAZ without the octree of COPC; give"),
    ],
)
def test_what_a_pipeline_of_pdal_does_otherwise(
    tmp_path: Path, output: str, more: list[str], message: str
) -> None:
    write_cloud(tmp_path / "cloud.laz", 7)
    cameras_csv(tmp_path / "cameras.csv", block())
    words = ["cloud.laz", output, "--cameras", "cameras.csv", "--water", WATER_M, *more]
    done = run_pcfix("pipeline", *words, folder=tmp_path)
    assert done.returncode == 1
    assert message in done.stderr
