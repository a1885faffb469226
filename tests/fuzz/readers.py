"""Every reader of files that people give, and the files that are damaged for it.

Of shared data the small files of some are taken where they are at hand; the tests do without.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import pcfix
from pcfix.io.cameras import read_tie_points
from pcfix.io.clouds import read_cloud
from pcfix.io.gnss_positions import read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.members import find_members
from pcfix.io.photographs import read_photograph, size_of
from pcfix.io.regressions import read_regression
from pcfix.io.tables import read_check_depths
from pcfix.io.tides import read_image_times, read_tide
from pcfix.io.tiles import open_cloud, part_of
from pcfix.io.vectors import read_shoreline, read_water_polygons
from pcfix.io.views import ViewMatch, read_views
from tests.fuzz import seeds
from tests.io import test_ground_control as control
from tests.io import test_water as water
from tests.io.cameras import test_colmap as colmap
from tests.io.cameras import test_metashape as metashape
from tests.io.cameras import test_realitycapture as realitycapture
from tests.io.cameras import test_unsupported as unsupported
from tests.utils.pose_files import WRITERS


class Reader(NamedTuple):
    """What yields the results of a file, and the seeds."""

    read: Callable[..., Iterator[Any]]
    seeds: dict[str, seeds.Seed]


def read_block(path: Path, **options: Any) -> Iterator[Any]:
    known = {name: value for name, value in options.items() if name in ("sensor", "angles")}
    found = pcfix.read_cameras(path, **known)
    yield found
    yield read_tie_points(path, found)


def read_lists(path: Path) -> Iterator[Any]:
    found = read_views(path, seeds.views_cameras())
    count = len(found)
    yield ViewMatch(found, seeds.views_cameras(), points=count).views_of(np.zeros((count, 3)), 0)[0]


def read_water(path: Path) -> Iterator[Any]:
    yield pcfix.read_water(path, "EPSG:32632")


def read_lines(path: Path) -> Iterator[Any]:
    shore = read_shoreline(path, "EPSG:32632")
    yield shore.xyz[:, :2], shore.counts, shore.notes
    yield read_water_polygons(path, "EPSG:32632")


def read_marks(path: Path) -> Iterator[Any]:
    yield read_ground_control(path, control.block(), crs="EPSG:32636")


def read_positions(path: Path) -> Iterator[Any]:
    yield read_gnss(path, seeds.cameras())


def read_times(path: Path) -> Iterator[Any]:
    if path.name == "tide.csv":
        yield read_tide(path)
    else:
        yield read_image_times(path, seeds.block().labels)


def read_picture(path: Path) -> Iterator[Any]:
    yield size_of(path)
    yield read_photograph(path)


def read_points(path: Path) -> Iterator[Any]:
    yield read_cloud(path)
    part = {"bounds": (456_000.0, 5_432_000.0, 456_060.0, 5_432_090.0), "read_resolution": None}
    if "copc" in path.name:
        part["read_resolution"] = 5.0
    with open_cloud(part_of(path, SimpleNamespace(**part)), 1) as source:
        yield sum(len(points) for points in source.chunks())


def read_one(read: Callable[[Path], Any]) -> Callable[[Path], Iterator[Any]]:
    def reader(path: Path) -> Iterator[Any]:
        yield read(path)

    return reader


def read_members(path: Path) -> Iterator[Any]:
    found = find_members(path.parent / "cameras.csv")
    yield None if found is None else found[1]


def camera_reader(**written: seeds.Seed) -> Reader:
    return Reader(read_block, written)


READERS: dict[str, Reader] = {
    "metashape": camera_reader(
        project=metashape.tie_project, chunk=seeds.metashape_chunk,
        packed=seeds.packed(seeds.metashape_chunk, "a.psz", "doc.xml"),
        geocentric=seeds.of("Metashape XML, geocentric"),
    ),
    "pix4d": camera_reader(
        params=seeds.pix4d_params, block=seeds.of("Pix4D params"),
        **seeds.shared("cameras", "pix4d", "lod3_amsterdam"),
    ),
    "opf": camera_reader(tracks=seeds.opf_with_tracks, fisheye=seeds.opf_fisheye),
    "odm": camera_reader(
        project=seeds.odm_project, shots=seeds.of("ODM shots.geojson"),
        today=seeds.of("ODM reconstruction"), **seeds.shared("cameras", "odm", "orthority_odm"),
    ),
    "opensfm": camera_reader(
        lenses=seeds.opensfm_lenses, tracks=seeds.opensfm_with_tracks, block=seeds.of("OpenSfM")
    ),
    "colmap text": camera_reader(
        model=seeds.colmap_text_folder, block=seeds.of("COLMAP text"), lenses=seeds.colmap_lenses
    ),
    "colmap binary": camera_reader(
        model=lambda folder: colmap.binary_folder(folder / "sparse"),
        block=seeds.of("COLMAP binary"), lenses=seeds.colmap_binary_lenses,
    ),
    "micmac": camera_reader(
        block=seeds.of("MicMac"),
        **seeds.shared("cameras", "micmac", "li3ds", give="Orientation-00.xml"),
    ),
    "bundler": camera_reader(
        points=seeds.bundle_file, block=seeds.of("Bundler")
    ),
    "nvm": camera_reader(points=seeds.nvm_file, block=seeds.of("VisualSFM")),
    "blocksexchange": camera_reader(
        ties=seeds.blocks_exchange, block=seeds.of("BlocksExchange, ENU"),
        packed=seeds.packed(seeds.blocks_exchange, "block.xmlz", "block.xml"),
        **seeds.shared("cameras", "blocksexchange", "paris_doc_example", "Paris2012_one_photo.xml"),
    ),
    "realitycapture": camera_reader(
        one=lambda folder: realitycapture.write(folder).parent,
        block=seeds.of("RealityCapture XMP"),
    ),
    "table": camera_reader(
        **{one: seeds.of(one) for one in WRITERS if "table" in one or "omega" in one}
    ),
    "unsupported": camera_reader(
        **{name: seeds.text(name, data) for name, (data, _) in unsupported.FILES.items()}
    ),
    "views": Reader(read_lists, {
        "colmap": seeds.vis, "openmvs": seeds.openmvs("<"), "big": seeds.openmvs(">"),
        "text": seeds.openmvs("", weights=False),
    }),
    "mesh": Reader(read_water, {
        "obj": seeds.text("water.obj", water.OBJ), "ply": seeds.text("water.ply", seeds.PLANE),
    }),
    "raster": Reader(read_water, {"tif": seeds.raster, "turned": seeds.turned_raster}),
    "vectors": Reader(read_lines, {
        "csv": seeds.text("shore.csv", seeds.LINE),
        "geojson": seeds.text("water.geojson", seeds.SHAPE),
        "wkt": seeds.text("a.wkt", "POLYGON Z ((0 0 1, 9 0 1, 9 9 1, 0 0 1))\nPOINT (3 4)\n"),
        "gpkg": seeds.vector("water.gpkg"), "shp": seeds.vector("water.shp"),
    }),
    "control": Reader(read_marks, {
        "table": seeds.text("gcps.csv", "\n".join([control.HEAD, *control.ROWS])),
        "odm": seeds.text("gcp_list.txt", "EPSG:32636\n500010 4000010 2.5 100 200 a.jpg G1\n"
                                          "500030 4000020 -1.75 0.5 1199 b.jpg G2\n"),
        "markers": seeds.markers,
    }),
    "gnss": Reader(read_positions, {
        "table": seeds.text("gnss.csv", seeds.GNSS), "geo": seeds.text("geo.txt", seeds.GEO),
        "images": seeds.odm_images,
    }),
    "tides": Reader(read_times, {
        "pictures": seeds.pictures, "tide": seeds.text("tide.csv", seeds.TIDE),
        "times": seeds.text("times.csv", seeds.TIMES), "images": seeds.odm_images,
    }),
    "depths": Reader(
        read_one(read_check_depths), {"table": seeds.text("depths.csv", seeds.DEPTHS)}
    ),
    "regression": Reader(read_one(read_regression), {"line": seeds.regression}),
    "members": Reader(read_members, {"npz": seeds.members}),
    "pictures": Reader(
        read_picture, {one: seeds.picture(f"a.{one}") for one in ("jpg", "png", "tif")}
    ),
    "las": Reader(read_points, {
        "1.4": seeds.cloud("cloud.las", 7), "1.2": seeds.cloud("cloud.las", 3), "copc": seeds.copc,
        "laz": seeds.cloud("cloud.laz", 6),
    }),
}  # fmt: skip
