"""Damaged clouds: one sentence each, no traceback, no end of the process, nothing left behind."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import laspy
import pytest

import pcfix
from pcfix.io.las.source import las_errors

SCENE = Path(__file__).parents[2] / "samples" / "scene"
# Places in the header (LAS 1.4 R15, table 3).
VERSION, HEADER_SIZE, POINTS_START, VLRS, FORMAT = 24, 94, 96, 100, 104
RECORD, SCALE_X, OFFSET_X, EVLRS, COUNT = 105, 131, 155, 235, 247


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    """The bytes of a cloud, packed and not."""
    cloud, folder = laspy.read(SCENE / "cloud.laz"), tmp_path_factory.mktemp("plain")
    cloud.points = cloud.points[::8].copy()
    for suffix in (".laz", ".las"):
        cloud.write(folder / f"cloud{suffix}")
    return {path.suffix: path.read_bytes() for path in folder.iterdir()}


def chunks_of(data):
    """Where the points begin, the table of chunks, and what the record on LAZ says of chunks."""
    (start,) = struct.unpack_from("<I", data, POINTS_START)
    (table,) = struct.unpack_from("<q", data, start)
    return start, table, data.find(b"laszip encoded") - 2 + 54 + 12


def put(data, place, layout, *values):
    changed = bytearray(data)
    struct.pack_into(layout, changed, place, *values)
    return bytes(changed)


def of_chunks(name, layout, value):
    def damage(data):
        start, table, size = chunks_of(data)
        places = {"table": start, "version": table, "count": table + 4}
        place = (places | {"size": size, "items": size + 20, "item": size + 24})[name]
        return put(data, place, layout, value)

    return damage


def layer_of_gigabytes(data):
    """A chunk begins with its first point; the count of its points and its layers' bytes follow."""
    start, _, _ = chunks_of(data)
    (record,) = struct.unpack_from("<H", data, RECORD)
    return put(data, start + 8 + record + 4, "<I", 3 * 10**9)


PACKED = {
    "count of chunks": (of_chunks("count", "<I", 2**32 - 1), "states 4,294,967,295 chunks"),
    "too many chunks": (of_chunks("count", "<I", 10**6), "states 1,000,000 chunks of points in"),
    "more chunks than points": (of_chunks("count", "<I", 2), "its header counts 2,500 points"),
    "fewer points": (lambda d: put(d, COUNT, "<Q", 300), "the file holds at least 2,500"),
    "no chunks": (of_chunks("count", "<I", 0), "2,500 points in 0 chunks"),
    "chunks without points": (of_chunks("size", "<I", 0), "its chunks have no points"),
    "chunks of one point": (of_chunks("size", "<I", 1), "2,500 points in 1 chunks of 1"),
    "records of no items": (of_chunks("items", "<H", 0), "those that are packed 0"),
    "records of more bytes": (of_chunks("item", "<H", 157), "those that are packed"),
    "chunks of a billion": (of_chunks("size", "<I", 2**30), "chunks of 1,073,741,824 points, and"),
    "table far away": (of_chunks("table", "<q", 2**62), "begin at byte 4,611,686,018,427,387,904"),
    "table before the file": (of_chunks("table", "<q", -5), "is damaged"),
    "table nowhere": (of_chunks("table", "<q", -1), "is damaged"),
    "layer of gigabytes": (layer_of_gigabytes, "in a chunk of"),
    "cut in the table": (lambda data: data[: chunks_of(data)[1] + 6], "is damaged"),
    "cut in the points": (lambda data: data[: len(data) // 2], "is damaged"),
    "one byte": (lambda data: data[:1], "does not begin with LASF"),
}
PLAIN = {
    "version 2.0": (lambda d: put(d, VERSION, "<BB", 2, 0), "its version is 2.0"),
    "version 1.0": (lambda d: put(d, VERSION, "<BB", 1, 0), "holds no points"),
    "version 1.9": (lambda d: put(d, VERSION, "<BB", 1, 9), "its version is 1.9"),
    "offset": (lambda d: put(d, OFFSET_X, "<d", 1e18), "are lost beside them"),
    "offset not finite": (lambda d: put(d, OFFSET_X, "<d", float("nan")), "must be finite"),
    "scale": (lambda d: put(d, SCALE_X, "<d", 1e300), "at most 1,000"),
    "scale of zero": (lambda d: put(d, SCALE_X, "<d", 0.0), "the scales positive"),
    "size of the header": (lambda d: put(d, HEADER_SIZE, "<H", 0), "is damaged"),
    "start of the points": (lambda d: put(d, POINTS_START, "<I", 10), "states 1 records"),
    "records": (lambda d: put(d, VLRS, "<I", 2**31), "states 2,147,483,648 records"),
    "records behind": (lambda d: put(d, EVLRS, "<QI", 2**63, 4), "states 4 records"),
    "format": (lambda d: put(d, FORMAT, "<B", 200), "is damaged"),
    "short record": (lambda d: put(d, RECORD, "<H", 3), "Incoherent point size"),
    "long record": (lambda d: put(d, RECORD, "<H", 65535), "is damaged"),
    "count of points": (lambda d: put(d, COUNT, "<Q", 2**63), "is damaged"),
    "empty": (lambda d: b"", "does not begin with LASF"),
}
CASES = [
    *(pytest.param(".laz", *case, id=name) for name, case in PACKED.items()),
    *(pytest.param(".las", *case, id=name) for name, case in PLAIN.items()),
]


def label(data, suffix, folder):
    """Label a cloud of these bytes; return the error, if any, once nothing is left of it."""
    source, target = folder / f"cloud{suffix}", folder / "out.laz"
    source.write_bytes(data)
    try:
        pcfix.label_file(source, target, water=0.37, jobs=1)
    except pcfix.PcfixError as error:
        assert [path.name for path in folder.iterdir()] == [source.name]
        assert source.read_bytes() == data
        return str(error)
    with laspy.open(source) as header:
        assert len(laspy.read(target)) == header.header.point_count
    target.unlink()
    return None


@pytest.mark.parametrize(("suffix", "damage", "sentence"), CASES)
def test_each_gets_a_sentence(suffix, damage, sentence, clouds, tmp_path):
    said = label(damage(clouds[suffix]), suffix, tmp_path)
    assert said is not None
    assert sentence in said and "cloud" + suffix in said
    assert "\n" not in said


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(s, marks=pytest.mark.nightly) for s in range(2, 12))]
)
def test_random_bytes_of_header_and_records(suffix, seed, clouds, tmp_path):
    """A change is refused in a sentence, or leaves a cloud of which every row comes out."""
    whole, rng = clouds[suffix], random.Random(seed)
    start, table, _ = chunks_of(clouds[".laz"])
    places = range(start if suffix == ".laz" else 800)
    if suffix == ".laz":
        places = [*places, *range(start, start + 8), *range(table, len(whole))]
    refused = 0
    for _ in range(30):
        changed = bytearray(whole)
        for place in rng.sample(places, rng.choice([1, 1, 2, 8])):
            changed[place] = rng.randrange(256)
        said = label(bytes(changed), suffix, tmp_path)
        refused += said is not None
    assert refused >= 1


def test_a_panic_of_the_decompressor_is_damage_too(tmp_path):
    """Its exceptions, which are under no name to import, are none that `except Exception` sees."""
    panic = type("PanicException", (BaseException,), {})
    said = pytest.raises(pcfix.InputError, match=r"cloud\.laz: is damaged.*index out of bounds")
    with said, las_errors(tmp_path / "cloud.laz"):
        raise panic("index out of bounds: the len is 66 but the index is 96")
    with pytest.raises(KeyboardInterrupt), las_errors(tmp_path / "cloud.laz"):
        raise KeyboardInterrupt
