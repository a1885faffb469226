"""What goes in comes out: every bit of a LAS file that a correction has no business with."""

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlrlist import VLRList

import pcfix
from pcfix import PcfixError
from pcfix.flow.plausibility import CloudSample
from pcfix.io.las.columns import COLUMNS, UPGRADE
from tests.utils.beyond_frames import BEYOND_FRAMES, DEEP
from tests.utils.clouds import (
    EAST_M,
    NORTH_M,
    WATER_M,
    Cameras,
    RawLas,
    add_undescribed_bytes,
    add_waveforms,
    added,
    block,
    described,
    fields,
    framed_block,
    patched,
    random_cloud,
    read_raw,
    write_cloud,
    xyz_of,
)
from tests.utils.codes import refused

pytestmark = [BEYOND_FRAMES, DEEP]

BATHYMETRIC_POINT = 40
ALL = ["ShiftX", "ShiftY", "ShiftZ", "WaterDepth", "RayMiss", "SigmaZ", "Incidence", "RayCount"]
ALL += ["SourceClass"]
MAY_CHANGE = {"X", "Y", "Z", "class", "angle", "extra", "withheld"}


class Trip(NamedTuple):
    """A cloud, its correction, and what `restore_file` makes of that."""

    source: Path
    output: Path
    back: Path

    @property
    def before(self) -> RawLas:
        return read_raw(self.source)

    @property
    def after(self) -> RawLas:
        return read_raw(self.output)

    @property
    def restored(self) -> RawLas:
        return read_raw(self.back)


def correct(source: Path, output: Path, **choices: object) -> pcfix.Summary:
    arguments = {"cameras": block(), "water": WATER_M, "method": "snell", **choices}
    return pcfix.correct_file(source, output, **arguments)


def round_trip(source: Path, **choices: object) -> Trip:
    trip = Trip(source, *(source.with_stem(name) for name in ("output", "back")))
    correct(trip.source, trip.output, **choices)
    pcfix.restore_file(trip.output, trip.back)
    return trip


def submerged(raw: RawLas) -> np.ndarray:
    return xyz_of(raw)[:, 2] < WATER_M


def rays_within(xyz: np.ndarray, cameras: Cameras, degrees: float) -> np.ndarray:
    """Count the cameras that a point sees at most so far from the vertical."""
    to_camera = cameras.centres - xyz[:, None]
    angle = np.arctan2(np.hypot(to_camera[..., 0], to_camera[..., 1]), to_camera[..., 2])
    return (np.degrees(angle) <= degrees).sum(axis=1)


def rays_in_frame(xyz: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Count the cameras of `framed_block` that have a point in their frame."""
    to_camera = cameras.centres - xyz[:, None]
    reach = to_camera[..., 2:] * [0.5, 0.2]
    return (np.abs(to_camera[..., :2]) <= reach).all(axis=2).sum(axis=1)


@pytest.fixture(scope="module", autouse=True)
def level_as_given() -> Iterator[None]:
    """Points at random show no level; to look for one there takes longer than to correct them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CloudSample, "level_notes", lambda sample: ())
        yield


@pytest.fixture(
    scope="module",
    # of each format the file or the packed one, by turns; the others at night
    params=[
        pytest.param(
            (number, suffix),
            id=f"format{number}{suffix}",
            marks=() if (number + packed) % 2 else pytest.mark.nightly,
        )
        for number in range(11)
        for packed, suffix in enumerate((".las", ".laz"))
    ],
)
def trip(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Trip:
    number, suffix = request.param
    folder = tmp_path_factory.mktemp("trip")
    return round_trip(write_cloud(folder / f"cloud{suffix}", number))


def test_output_format(trip: Trip) -> None:
    before, after = trip.before, trip.after
    assert after.version == (1, 4)
    assert after.point_format == UPGRADE[before.point_format]
    assert len(after.points) == len(before.points)
    assert (after.scales, after.offsets) == (before.scales, before.offsets)
    header, returns = after.header, fields(after)["return"]
    counts = struct.unpack_from("<15Q", header, 255)
    assert list(counts) == [(returns == number).sum() for number in range(1, 16)]
    assert struct.unpack_from("<6I", header, 107) == (0,) * 6  # the legacy counts
    xyz = xyz_of(after)
    bounds = np.array(struct.unpack_from("<6d", header, 179)).reshape(3, 2)
    np.testing.assert_allclose(bounds[:, 0], xyz.max(axis=0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(bounds[:, 1], xyz.min(axis=0), rtol=0, atol=1e-9)


def test_land_is_bit_identical(trip: Trip) -> None:
    land = ~submerged(trip.before)
    old, new = fields(trip.before), fields(trip.after)
    size = old["extra"].shape[1]
    assert 0 < land.sum() < len(land)
    for name in old.keys() - {"angle", "extra"}:
        np.testing.assert_array_equal(new[name][land], old[name][land], name)
    np.testing.assert_array_equal(new["extra"][land, :size], old["extra"][land])
    assert not new["extra"][land, size:].any()


def test_submerged_points(trip: Trip) -> None:
    wet = submerged(trip.before)
    old, new = fields(trip.before), fields(trip.after)
    for name in old.keys() - (MAY_CHANGE - {"withheld"}):
        np.testing.assert_array_equal(new[name][wet], old[name][wet], name)
    size = old["extra"].shape[1]
    np.testing.assert_array_equal(new["extra"][wet, :size], old["extra"][wet])
    assert (new["class"][wet] == BATHYMETRIC_POINT).all()
    assert (new["Z"][wet] < old["Z"][wet]).all()


def test_converted_fields(trip: Trip) -> None:
    old, new = fields(trip.before), fields(trip.after)
    for name in new.keys() - old.keys():
        assert not new[name].any(), name
    if trip.before.point_format >= 6:
        np.testing.assert_array_equal(new["angle"], old["angle"])
    else:  # half a step of 0.006 degrees
        np.testing.assert_allclose(new["angle"] * 0.006, old["angle"], atol=0.0031)


def test_dimensions(trip: Trip) -> None:
    wet = submerged(trip.before)
    old, new, more = fields(trip.before), fields(trip.after), added(trip.before, trip.after)
    assert list(more) == ALL
    for axis in "XYZ":
        moved = new[axis].astype(np.int64) - old[axis]
        np.testing.assert_array_equal(more[f"Shift{axis}"], moved)
    np.testing.assert_array_equal(more["SourceClass"][wet], old["class"][wet])
    assert (more["RayCount"][wet] == len(block())).all()
    scale = {name: step for name, _, step in described(trip.after)}
    assert [scale[f"Shift{axis}"] for axis in "XYZ"] == list(trip.after.scales)
    depth = WATER_M - xyz_of(trip.after)[wet, 2]
    np.testing.assert_allclose(more["WaterDepth"][wet] * scale["WaterDepth"], depth, atol=0.0012)


def test_vlrs(trip: Trip) -> None:
    before, after = trip.before, trip.after
    names = [record.kind for record in before.foreign()]
    added_wkt = [r for r in after.foreign() if r.kind[1] == 2112 and r.kind not in names]
    assert [r for r in after.foreign() if r not in added_wkt] == before.foreign()
    assert len(added_wkt) == (before.point_format < 6)
    assert after.extended == before.extended
    assert [r.kind for r in after.records].count((b"pcfix", 1)) == 1
    old, new = before.extra_bytes(), after.extra_bytes()
    assert (len(old), len(new)) == (6 * 192, (6 + len(ALL)) * 192)
    assert new.startswith(old)


def test_laspy_reads_it(trip: Trip) -> None:
    before, after = laspy.read(trip.source), laspy.read(trip.output)
    assert before.header.parse_crs().to_epsg() == 32633
    assert after.header.parse_crs().to_epsg() == 32633
    assert after.header.global_encoding.wkt
    for name in before.point_format.extra_dimension_names:
        np.testing.assert_array_equal(np.array(after[name]), np.array(before[name]), name)


def test_restored(trip: Trip) -> None:
    before, restored = trip.before, trip.restored
    assert (restored.version, restored.point_format) == (before.version, before.point_format)
    assert (restored.scales, restored.offsets) == (before.scales, before.offsets)
    np.testing.assert_array_equal(restored.points, before.points)
    assert restored.foreign() == before.foreign()
    assert restored.extended == before.extended
    assert restored.extra_bytes() == before.extra_bytes()
    assert restored.header[:96] == before.header[:96]
    if trip.source.suffix == ".las":
        assert trip.back.read_bytes() == trip.source.read_bytes()


@pytest.mark.parametrize("number", [9, 10])
def test_waveforms_1_4(tmp_path: Path, number: int) -> None:
    las = random_cloud(number)
    las.header.global_encoding.waveform_data_packets_internal = True
    las.evlrs = VLRList([*las.evlrs, laspy.VLR("LASF_Spec", 65535, "waves", b"wave" * 500)])
    las.write(tmp_path / "cloud.las")
    data = (tmp_path / "cloud.las").read_bytes()
    start = data.index(b"LASF_Spec\0\0\0\0\0\0\0\xff\xff") - 2
    trip = round_trip(patched(tmp_path / "cloud.las", 227, struct.pack("<Q", start)))
    assert trip.back.read_bytes() == trip.source.read_bytes()
    assert trip.after.extended == trip.before.extended
    data = trip.output.read_bytes()
    assert data[6] & 2
    (start,) = struct.unpack_from("<Q", data, 227)  # the header points at the record
    assert data[start + 2 :].startswith(b"LASF_Spec\0")
    assert data[start + 60 :].startswith(trip.before.extended[-1].data)


def old_format(number: int, version: str) -> Callable[[Path], Path]:
    return lambda path: write_cloud(path, number, version=version)


def waveforms(number: int) -> Callable[[Path], Path]:
    return lambda path: add_waveforms(write_cloud(path, number), b"wave" * 500)


def undescribed(number: int, plain: bool) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        las = random_cloud(number, plain=plain)
        las.evlrs = VLRList() if number == 6 else None
        las.write(path)
        return add_undescribed_bytes(path, 5)

    return write


def with_dimension(number: int, dimension: laspy.ExtraBytesParams) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        las = random_cloud(number, plain=True)
        points = las.points.array.copy()
        las.header.add_extra_dims([dimension])
        las.points = laspy.ScaleAwarePointRecord.zeros(len(points), header=las.header)
        for name in points.dtype.names:
            las.points.array[name] = points[name]
        values = np.arange(las.points.array[dimension.name].size) % 100
        las.points.array[dimension.name].reshape(-1)[:] = values
        las.write(path)
        return path

    return write


def with_text(number: int, old: bytes, new: bytes) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        source = write_cloud(path, number)
        return patched(source, source.read_bytes().index(old), new)

    return write


DIMENSIONS = {
    "three scaled": laspy.ExtraBytesParams(
        "Three", "3i4", offsets=[1.0, 2.0, 3.0], scales=[0.1, 0.2, 0.3]
    ),
    "three with no data": laspy.ExtraBytesParams("Three", "3u2", no_data=[7, 8, 9]),
    "NaN for no data": laspy.ExtraBytesParams("NoNumber", "float64", no_data=[np.nan]),
    "uint64": laspy.ExtraBytesParams("Long", "uint64", no_data=[2**64 - 1]),
    "accents": laspy.ExtraBytesParams("Zoë's réturn", "int8", "Größe"),
    "5 undocumented": laspy.ExtraBytesParams("Blob", "5u1", "undocumented"),
}
TEXTS = {
    "full description": (b"an exactly full description 31c\0", b"an exactly full description 32ch"),
    "accented description": (b"an exactly full description 31c", b"H\xf6he in Metern (2\xb0)\0"),
    "accented system": (b"Camera, drone (v2)", b"Kamera-Tr\xe4ger (2)"),
    "accented software": (b"Maker & Sons", b"M\xe4kler & S\xf6ne"),
    "full user id": (b"Someone" + b"\0" * 9, b"Someone of sixte"),
}
ODD = {
    **{f"format {n}, {v}": old_format(n, v)
       for n, v in ((1, "1.1"), (3, "1.3"), (0, "1.4"), (5, "1.4"))},
    **{f"waveforms of format {n}": waveforms(n) for n in (4, 5)},
    **{f"undescribed bytes, {n}, {plain}": undescribed(n, plain)
       for n in (1, 6) for plain in (True, False)},
    **{f"{name}, {n}": with_dimension(n, one) for name, one in DIMENSIONS.items() for n in (2, 7)},
    **{f"{name}, {n}": with_text(n, *texts) for name, texts in TEXTS.items() for n in (3, 6)},
}  # fmt: skip


@pytest.mark.parametrize("name", ODD)
def test_odd_files(tmp_path: Path, name: str) -> None:
    trip = round_trip(ODD[name](tmp_path / "cloud.las"))
    before, after = trip.before, trip.after
    old, size = fields(before)["extra"], fields(before)["extra"].shape[1]
    np.testing.assert_array_equal(fields(after)["extra"][:, :size], old)
    assert list(added(before, after))[-len(ALL) :] == ALL
    assert after.version == (1, 4)
    assert after.header[26:58] == before.header[26:58]
    assert after.extra_bytes().startswith(before.extra_bytes())
    assert [r for r in before.foreign() if r not in after.foreign()] == []
    assert after.extended == before.extended or before.point_format in (4, 5)
    assert trip.restored.extended == before.extended
    assert trip.back.read_bytes() == trip.source.read_bytes()


@pytest.mark.parametrize("size", [8, 200])
def test_undocumented_bytes(tmp_path: Path, size: int) -> None:
    """It reads the size of such a dimension, which stands in the options, as option bits."""
    las = random_cloud(2, plain=True)
    las.add_extra_dim(laspy.ExtraBytesParams("Blob", f"{size}u1", "undocumented"))
    las.write(tmp_path / "cloud.las")
    with refused("cloud.damaged"):
        correct(tmp_path / "cloud.las", tmp_path / "output.las")
    assert not (tmp_path / "output.las").exists()


@pytest.mark.parametrize(
    ("found", "ahead", "other"),
    [(b'"added_wkt":', 12, b"8"), (b'"identity":"', 12, b"\xff"), (b"ShiftZ\0", -2, b"\x03")],
    ids=["flag", "identity", "type"],
)
def test_damaged_record_is_not_restored(
    tmp_path: Path, found: bytes, ahead: int, other: bytes
) -> None:
    output = tmp_path / "output.las"
    correct(write_cloud(tmp_path / "cloud.las", 7), output)
    patched(output, output.read_bytes().index(found) + ahead, other)
    with pytest.raises(PcfixError):
        pcfix.restore_file(output, tmp_path / "back.las")
    assert not (tmp_path / "back.las").exists()


MISSED = {
    "angle": (block(), {"max_angle": 20.0}, lambda xyz: rays_within(xyz, block(), 20.0)),
    "frame": (framed_block(), {}, lambda xyz: rays_in_frame(xyz, framed_block())),
}


@pytest.mark.parametrize("number", [3, 8])
@pytest.mark.parametrize("why", MISSED)
def test_uncorrected_points(tmp_path: Path, why: str, number: int) -> None:
    """Submerged points with fewer than two usable rays stay, and are withheld."""
    cameras, choices, rays_of = MISSED[why]
    trip = round_trip(write_cloud(tmp_path / "cloud.las", number), cameras=cameras, **choices)
    old, new, more = fields(trip.before), fields(trip.after), added(trip.before, trip.after)
    wet, rays = submerged(trip.before), rays_of(xyz_of(trip.before))
    stuck = wet & (rays < 2)
    assert {0, 1} <= set(rays[stuck]) and stuck.sum() < wet.sum()
    assert set(old["withheld"][stuck]) == {0, 1}
    for name in old.keys() - {"angle", "extra", "withheld"}:
        np.testing.assert_array_equal(new[name][stuck], old[name][stuck], name)
    assert (new["class"][wet & ~stuck] == BATHYMETRIC_POINT).all()
    np.testing.assert_array_equal(more["RayCount"][wet], np.where(stuck, 0, rays)[wet])
    assert not any(more[f"Shift{axis}"][stuck].any() for axis in "XYZ")
    np.testing.assert_array_equal(new["withheld"], old["withheld"] | stuck)
    assert trip.back.read_bytes() == trip.source.read_bytes()


@pytest.mark.parametrize("number", [2, 7])
@pytest.mark.parametrize(
    ("dimensions", "names"), [("minimal", ["ShiftZ", "RayCount"]), ("none", [])]
)
def test_fewer_dimensions(tmp_path: Path, number: int, dimensions: str, names: list[str]) -> None:
    source = write_cloud(tmp_path / "cloud.las", number)
    correct(source, tmp_path / "all.las")
    correct(source, tmp_path / "few.las", dimensions=dimensions)
    before, full, few = (read_raw(tmp_path / f"{n}.las") for n in ("cloud", "all", "few"))
    assert list(added(before, few)) == names
    assert len(few.extra_bytes()) == len(before.extra_bytes()) + 192 * len(names)
    new = fields(few) | added(before, few)
    for name, values in (fields(full) | added(before, full)).items():
        if name in new and name != "extra":
            np.testing.assert_array_equal(new[name], values, name)
    old = fields(before)["extra"]
    np.testing.assert_array_equal(new["extra"][:, : old.shape[1]], old)
    with pytest.raises(PcfixError):
        pcfix.restore_file(tmp_path / "few.las", tmp_path / "back.las")
    assert not (tmp_path / "back.las").exists()


def test_large_shifts(tmp_path: Path) -> None:
    las = random_cloud(1, scales=(0.0001,) * 3, offsets=(EAST_M, NORTH_M, 0.0))
    las.points.array["Z"] -= 250_000  # 25 m
    las.write(tmp_path / "cloud.las")
    trip = round_trip(tmp_path / "cloud.las")
    types = {name: number for name, number, _ in described(trip.after)}
    assert (types["ShiftX"], types["ShiftY"], types["ShiftZ"]) == (6, 6, 6)
    moved = fields(trip.after)["Z"].astype(np.int64) - fields(trip.before)["Z"]
    assert moved.min() < np.iinfo(np.int16).min
    np.testing.assert_array_equal(added(trip.before, trip.after)["ShiftZ"], moved)
    assert trip.back.read_bytes() == trip.source.read_bytes()


@pytest.mark.parametrize(
    "bounds",
    [(0.0,) * 6, (1e9, -1e9) * 3, (float("nan"),) * 6, (float("-inf"), float("inf")) * 3],
    ids=["zero", "huge", "NaN", "inside out"],
)
def test_wrong_bounds_in_header(tmp_path: Path, bounds: tuple[float, ...]) -> None:
    offsets = (EAST_M, NORTH_M, 0.0)
    source = write_cloud(tmp_path / "cloud.las", 3, scales=(0.001,) * 3, offsets=offsets)
    correct(source, tmp_path / "right.las")
    trip = round_trip(patched(source, 179, struct.pack("<6d", *bounds)))
    np.testing.assert_array_equal(xyz_of(trip.after), xyz_of(read_raw(tmp_path / "right.las")))
    np.testing.assert_array_equal(trip.restored.points, trip.before.points)


@pytest.mark.parametrize(("number", "suffix"), [(3, ".las"), (10, ".laz")])
def test_any_chunk_size(
    tmp_path: Path, number: int, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = round_trip(write_cloud(tmp_path / f"cloud{suffix}", number))
    expected = [path.read_bytes() for path in (whole.output, whole.back)]
    monkeypatch.setattr("pcfix.io.las.source.CHUNK_POINTS", 100)
    whole.output.unlink()
    whole.back.unlink()
    pieces = round_trip(whole.source)
    assert [path.read_bytes() for path in (pieces.output, pieces.back)] == expected


def test_documented_dimensions() -> None:
    units = {0.0: "scale of the file", 0.001: "1 mm", 0.0001: "0.1 mm", 0.1: "0.1°", 1.0: ""}
    head = "| extra dimension | type | unit | |\n|---|---|---|---|\n"
    rows = [
        re.escape(f"| `{c.name}` | {c.dtype} | {units[c.scale]} |".replace("  ", " "))
        for c in COLUMNS
    ]
    table = re.compile(re.escape(head) + "".join(f"{row} .+ \\|\n" for row in rows) + "\n")
    root = Path(__file__).parents[2]
    documents = [*root.glob("*.md"), *root.glob("pcfix/**/*.md")]
    assert any(table.search(document.read_text("utf-8")) for document in documents)
