"""Damaged files of every reader: one sentence each, or a result that is fit for use."""

import random
import struct

import pytest

from tests.fuzz.judge import Bench
from tests.fuzz.mutations import mutated, put
from tests.fuzz.readers import READERS

SEEDS = [1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(2, 12))]


@pytest.fixture(scope="module", params=READERS)
def bench(request, tmp_path_factory):
    return Bench(request.param, tmp_path_factory.mktemp("bench"))


def test_whole_files(bench):
    for part in {part.seed: part for part in bench.parts}.values():
        results, sentence = bench.read(part, part.data)
        assert results or bench.name == "unsupported", sentence


@pytest.mark.parametrize("seed", SEEDS)
def test_mutations(bench, seed):
    chance = random.Random(seed)
    for _ in range(10):
        part = chance.choice(bench.parts)
        bench.read(part, mutated(part.data, chance))


def instead(old, new):
    """Return what puts something else where `old` is."""

    def damage(data):
        assert old in data
        return data.replace(old, new)

    return damage


def extra_dimension(data):
    """A dimension of no type that takes no bytes."""
    return put(data, data.index(b"Quality") - 4, "<2xBB", 0, 0)


PLACE = struct.pack("<2d", 5e5, 5.2e6)  # of a raster's cells, as GeoTIFF has them

# Faults that fuzzing found: reader, seed, file (and entry of an archive), and the damage.
FOUND = {
    "points behind the end": ("las", "1.4", "cloud.las", lambda data: put(data, 96, "<I", 2**31)),
    "records of many bytes": ("las", "1.2", "cloud.las",
        lambda data: put(data, 105, "<HI", 60_000, 2**31)),
    "dimension of no bytes": ("las", "1.4", "cloud.las", extra_dimension),
    "infinite place": ("metashape", "chunk", "cameras.xml",
        instead(b"<scale>10", b"<scale>9e307")),
    "no transformation": ("odm", "project", "geocoords_transformation.txt", lambda data: b"\n" * 9),
    "infinitely many cameras": ("bundler", "points", "bundle.out", instead(b"\n2 3", b"\n1e999 3")),
    # these three ended the process, in open3d or in the index of the facets
    "vertex too many": ("mesh", "ply", "water.ply", instead(b"vertex 4", b"vertex 6")),
    "element of another name": ("mesh", "ply", "water.ply",
        instead(b"element vertex", b"element vvertex")),
    "vertex on no map": ("mesh", "obj", "water.obj", instead(b"v 512000.12345", b"v -1e308")),
    "corner of many digits": ("mesh", "obj", "water.obj",
        instead(b"f 1/", b"f 99999999999999999999/")),
    "mesh of one line": ("mesh", "obj", "water.obj", instead(b"f 1/1/1 2/1/1 3//1 -1", b"f 1 2 2")),
    "many records of no properties": ("mesh", "ply", "water.ply",
        instead(b"element face 2\n", b"element face 99999999999999999999\nelement f 2\n")),
    "raster without a place": ("raster", "tif", "water.tif",
        instead(PLACE, struct.pack("<2d", float("nan"), 5.2e6))),
    "picture of too many pixels": ("pictures", "png", "a.png",
        instead(struct.pack(">I", 60), struct.pack(">I", 2**30))),
    "picture of no pages": ("pictures", "tif", "a.tif",
        lambda data: data[:4] + bytes(4) + data[8:]),
    "raster of half its bytes": ("raster", "tif", "water.tif", lambda data: data[:900]),
    "column with many brackets": ("depths", "table", "depths.csv",
        instead(b"depth_m", b"depth" + b"(" * 20_000)),
    "labels that are none": ("members", "npz", "ensemble.npz labels.npy",
        instead(b"(4,)", b"(2,)")),
    "array that is none": ("members", "npz", "ensemble.npz labels.npy", lambda data: b"no array"),
    "deep brackets beside a model": ("colmap text", "model", "georeference.json",
        lambda data: b"[" * 100_000),
    "escapes for the terminal": ("gnss", "table", "gnss.csv",
        instead(b"IMG_0002.jpg,", b"IMG_0002.jpg,\x1b[2J")),
    "number of many digits": ("realitycapture", "one", "a.xmp",
        instead(b"n>10 ", b"n>" + b"9" * 5000 + b" ")),
}  # fmt: skip


@pytest.mark.parametrize("name", FOUND)
def test_found(name, tmp_path):
    reader, seed, file, damage = FOUND[name]
    bench = Bench(reader, tmp_path)
    (part,) = (
        one for one in bench.parts
        if one.seed == seed and f"{one.path.name} {one.entry}".strip() == file
    )  # fmt: skip
    sentence = bench.read(part, damage(part.data))[1]
    assert file.split()[0] in sentence
