"""Damaged clouds: one sentence each, no traceback, no end of the process, nothing left behind."""

import struct

import laspy
import pytest

import pcfix
from tests.fuzz.mutations import put

# Places in the header (LAS 1.4 R15, table 3).
VERSION, POINTS_START, SCALE_X, OFFSET_X, EVLRS, COUNT = 24, 96, 131, 155, 235, 247


@pytest.fixture(scope="module")
def clouds(inputs):
    """The bytes of a cloud, packed and not."""
    laspy.read(inputs / "cloud.laz").write(inputs / "cloud.las")
    return {suffix: (inputs / f"cloud{suffix}").read_bytes() for suffix in (".laz", ".las")}


def chunks_of(data):
    """Where the points begin, the table of chunks, and what the record on LAZ says of chunks."""
    (start,) = struct.unpack_from("<I", data, POINTS_START)
    (table,) = struct.unpack_from("<q", data, start)
    return start, table, data.find(b"laszip encoded") - 2 + 54 + 12


def of_chunks(name, layout, value):
    def damage(data):
        start, table, size = chunks_of(data)
        places = {"table": start, "version": table, "count": table + 4}
        place = (places | {"size": size, "items": size + 20, "item": size + 24})[name]
        return put(data, place, layout, value)

    return damage


PACKED = {
    "count of chunks": (of_chunks("count", "<I", 2**32 - 1), "cloud.damaged"),
    "more chunks than points": (of_chunks("count", "<I", 2), "cloud.damaged"),
    "fewer points": (lambda d: put(d, COUNT, "<Q", 300), "cloud.count"),
    "no chunks": (of_chunks("count", "<I", 0), "cloud.damaged"),
    "chunks of one point": (of_chunks("size", "<I", 1), "cloud.count"),
    "records of no items": (of_chunks("items", "<H", 0), "cloud.damaged"),
    "records of more bytes": (of_chunks("item", "<H", 157), "cloud.damaged"),
    "table far away": (of_chunks("table", "<q", 2**62), "cloud.damaged"),
    "table nowhere": (of_chunks("table", "<q", -1), "cloud.damaged"),
    "cut in the table": (lambda data: data[: chunks_of(data)[1] + 6], "cloud.damaged"),
    "cut in the points": (lambda data: data[: len(data) // 2], "cloud.damaged"),
    "one byte": (lambda data: data[:1], "cloud.damaged"),
}
PLAIN = {
    "version 2.0": (lambda d: put(d, VERSION, "<BB", 2, 0), "cloud.damaged"),
    "version 1.0": (lambda d: put(d, VERSION, "<BB", 1, 0), "cloud.empty"),
    "more points": (lambda d: put(d, COUNT, "<Q", 30_000), "cloud.count"),
    "offset": (lambda d: put(d, OFFSET_X, "<d", 1e18), "cloud.scales"),
    "scale": (lambda d: put(d, SCALE_X, "<d", 1e300), "cloud.scales"),
    "records behind": (lambda d: put(d, EVLRS, "<QI", 2**63, 4), "cloud.damaged"),
    "count of points": (lambda d: put(d, COUNT, "<Q", 2**63), "cloud.damaged"),
}
CASES = [
    *(pytest.param(".laz", *case, id=name) for name, case in PACKED.items()),
    *(pytest.param(".las", *case, id=name) for name, case in PLAIN.items()),
]


def label(data, suffix, folder):
    """Label a cloud of these bytes; return the error, if any, and check that nothing is left."""
    source, target = folder / f"cloud{suffix}", folder / "out.laz"
    source.write_bytes(data)
    try:
        pcfix.label_file(source, target, water=0.37, jobs=1)
    except pcfix.PcfixError as error:
        assert [path.name for path in folder.iterdir()] == [source.name]
        assert source.read_bytes() == data
        assert "\n" not in str(error) and source.name in str(error)
        return error
    with laspy.open(source) as header:
        assert len(laspy.read(target)) == header.header.point_count
    target.unlink()
    return None


@pytest.mark.parametrize(("suffix", "damage", "code"), CASES)
def test_damage(suffix, damage, code, clouds, tmp_path):
    assert label(damage(clouds[suffix]), suffix, tmp_path).code == code
