"""Vector files: shorelines and masks, in the cloud's CRS."""

import json
import sys
import warnings

import numpy as np
import pytest
import shapely
from pyproj import Transformer

from pcfix.io import vectors
from pcfix.io.crs import HeightsError
from pcfix.io.vectors import in_cloud_crs, read_shoreline, read_vectors, read_water_polygons
from tests.utils.codes import refused, warned

pytestmark = pytest.mark.quick_but("test_crs_that_do_not_fit", "test_heights_need_a_grid")

raw = pytest.importorskip("pyogrio.raw")

UTM30 = "EPSG:25830"
SHORE = np.array([[725_448.0, 4_369_128.0, 2.25], [725_460.0, 4_369_140.0, 2.31]])


def write(path, geometries, *, crs=UTM30, kind="Unknown", layer=None):
    wkb = np.array([None if g is None else shapely.to_wkb(g) for g in geometries], object)
    raw.write(path, wkb, [], [], geometry_type=kind, crs=crs, layer=layer)
    return path


def feature(geometry):
    return {"type": "Feature", "properties": {}, "geometry": geometry}


def write_geojson(path, *geometries, crs=None):
    content = {"type": "FeatureCollection", "features": [*map(feature, geometries)]}
    if crs:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(content))
    return path


def codes(read, *args, **keywords):
    """Return what a function returns, and the codes of its warnings."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        found = read(*args, **keywords)
    return found, [one.message.code for one in shown]


def write_text(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def point(*xyz):
    return {"type": "Point", "coordinates": list(xyz)}


@pytest.mark.parametrize("suffix", ["gpkg", "shp", "geojson"])
def test_formats(tmp_path, suffix):
    path = write(tmp_path / f"shore.{suffix}", shapely.points(SHORE), kind="Point Z")
    found = read_vectors(path)
    assert found.coordinates == pytest.approx(SHORE, abs=1e-6)
    assert found.crs == UTM30
    assert found.name == str(path)


def test_text(tmp_path):
    lines = "# crs: EPSG:25830", "x y z", "725448 4369128 2.25", "725460 4369140 2.31"
    found = read_vectors(write_text(tmp_path / "shore.csv", *lines))
    assert found.coordinates == pytest.approx(SHORE)
    assert found.crs == UTM30


def test_features_without_coordinates(tmp_path):
    not_finite = shapely.from_wkb(shapely.to_wkb(shapely.Point(np.nan, 1.0)))
    shapes = [None, shapely.Point(), not_finite, *shapely.points(SHORE)]
    found = read_vectors(write(tmp_path / "a.gpkg", shapes))
    assert found.coordinates[:, 0].tolist() == SHORE[:, 0].tolist()


def test_layers(tmp_path):
    path = tmp_path / "river.gpkg"
    write(path, shapely.points(SHORE), layer="shore")
    write(path, shapely.points(SHORE[:1]), layer="gauge")
    for given, layer in ((path, None), (f"{path}|layername=bank", "bank")):
        with refused("vector.layer", layer=layer, layers=["shore", "gauge"]):
            read_vectors(given)
    for found in (read_vectors(f"{path}|layername=gauge"), read_vectors(f"{path}|gauge")):
        assert len(found.geometries) == 1
        assert found.name == f"{path}, layer gauge"


def test_crs_of_geojson(tmp_path):
    flat = write_geojson(tmp_path / "a.geojson", point(-0.38, 39.44))
    assert read_vectors(flat).crs == "EPSG:4326"
    mixed = write_geojson(tmp_path / "b.geojson", point(-0.38, 39.44, 2.0), point(-0.38, 39.44))
    assert read_vectors(mixed).crs == "EPSG:4979"  # RFC 7946: above the ellipsoid
    named = write_geojson(tmp_path / "c.json", point(*SHORE[0]), crs="urn:ogc:def:crs:EPSG::25830")
    assert read_vectors(named).crs == UTM30
    metres = write_geojson(tmp_path / "d.geojson", point(725_448.0, 4_369_128.0))
    with refused("vector.not_degrees", path=metres):
        read_vectors(metres)
    assert read_vectors(metres, crs=UTM30).crs == UTM30


BAD = [
    ("a.gpkg", "x", "vector.damaged", {}),
    ("a.geojson", '{"type":"FeatureCollection","features":[]}', "vector.empty", {}),
    ("a.csv", "", "table.column_missing", {}),
    ("a.csv", "a,b\n1,2\n", "table.column_missing", {}),
    ("a.csv", "x,y,z\n1,2,low\n", "table.number", {"column": "z", "value": "low"}),
    ("a.csv", "# crs: EPSG:999999\nx,y\n1,2\n", "crs.unknown", {"value": "EPSG:999999"}),
    ("a.dxf", "", "vector.format", {}),
]


@pytest.mark.parametrize(("name", "text", "code", "values"), BAD)
def test_bad_files(tmp_path, name, text, code, values):
    path = tmp_path / name
    path.write_text(text)
    with refused(code, path=path, **values):
        read_vectors(path)


def test_no_layer_with_geometries(tmp_path, monkeypatch):
    raw.write(tmp_path / "a.gpkg", None, [np.array([1])], ["n"], geometry_type=None, crs=None)
    with refused("vector.layer", layers=[]):
        read_vectors(tmp_path / "a.gpkg")
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    with refused("library.missing", library="pyogrio"):
        read_vectors(tmp_path / "a.gpkg")


def test_degrees_to_metres(tmp_path):
    path = write_text(tmp_path / "a.csv", "lon,lat,h", "-0.38,39.44,2.5", "-0.37,39.45,")
    moved = in_cloud_crs(read_vectors(path), UTM30, heights=True)
    x, y = Transformer.from_crs("EPSG:4326", UTM30, always_xy=True).transform(
        [-0.38, -0.37], [39.44, 39.45]
    )
    assert moved.coordinates[:, :2] == pytest.approx(np.column_stack([x, y]), abs=1e-6)
    assert moved.coordinates[0, 2] == 2.5
    assert np.isnan(moved.coordinates[1, 2])


LOCAL_CS = 'LOCAL_CS["Site",LOCAL_DATUM["Site",0],UNIT["metre",1]]'


@pytest.mark.parametrize(
    ("crs", "cloud", "notes"),
    [
        *((None, None, []), (None, UTM30, ["crs.assumed"]), (None, LOCAL_CS, [])),
        *((UTM30, None, ["crs.assumed"]), ("local", UTM30, []), (LOCAL_CS, LOCAL_CS, [])),
    ],
)
def test_assumed_crs(tmp_path, crs, cloud, notes):
    found = read_vectors(write_text(tmp_path / "a.csv", "x,y", "1,2"), crs=crs)
    for heights in (True, False):
        moved, shown = codes(in_cloud_crs, found, cloud, heights=heights)
        assert moved.coordinates[0, :2].tolist() == [1.0, 2.0]
        assert shown == notes


@pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")
@pytest.mark.parametrize(
    ("crs", "cloud", "code"),
    [
        (UTM30, LOCAL_CS, "crs.local"),
        (LOCAL_CS, UTM30, "crs.local"),
        ("EPSG:4978", UTM30, "crs.not_projected"),
        (UTM30, "EPSG:4326", "crs.not_projected"),
        ("EPSG:4326", None, "crs.cloud_missing"),
        ("EPSG:2992", None, "crs.cloud_missing"),
        ("EPSG:4979", "EPSG:25830+5782", "crs.heights"),
        ("EPSG:4326", UTM30, "vector.outside_crs"),
    ],
)
def test_crs_that_do_not_fit(tmp_path, crs, cloud, code):
    found = read_vectors(write_text(tmp_path / "a.csv", "x,y,z", "90,0,3"), crs=crs)
    with refused(code):
        in_cloud_crs(found, cloud, heights=True)


def test_heights_need_a_grid(tmp_path):
    path = write_geojson(tmp_path / "a.geojson", point(-0.38, 39.44, 51.0))
    with refused("crs.heights", HeightsError, grids=["es_ign_egm08-rednap.tif"]):
        read_shoreline(path, "EPSG:25830+5782")
    shore, shown = codes(read_shoreline, path, "EPSG:25830+5782", crs="EPSG:4326")
    assert shore.xyz[0, 2] == 51.0
    assert shown == codes(read_shoreline, path, UTM30)[1] == ["crs.heights_assumed"]
    polygon = shapely.Polygon([(0, 39, 1), (1, 39, 1), (1, 40, 1)])
    mask = write(tmp_path / "b.gpkg", [polygon], crs="EPSG:4979", kind="Polygon Z")
    read_water_polygons(mask, "EPSG:25831+5782")  # a mask has no heights


def test_shoreline(tmp_path, monkeypatch):
    lines = (
        "LINESTRING Z (0 0 1, 10 0 2)",
        "LINESTRING (0 5, 10 5)",
        "POLYGON ((20 0,24 0,24 4,20 4,20 0),(21 1,22 1,22 2,21 1))",
        "GEOMETRYCOLLECTION (MULTIPOINT ((50 50),(51 51)), POINT Z (52 52 9))",
    )
    monkeypatch.setattr(vectors, "SPACING_M", 2.0)
    shore = read_shoreline(write(tmp_path / "a.gpkg", shapely.from_wkt(lines)), UTM30)
    rows = shore.xyz.tolist()
    measured = [row for row in rows if not np.isnan(row[2])]
    assert sorted(measured) == [[0, 0, 1], [10, 0, 2], [52, 52, 9]]
    drawn = {tuple(row[:2]) for row in rows if np.isnan(row[2])}
    assert {(float(x), 5.0) for x in range(0, 11, 2)} <= drawn
    assert {(22.0, 0.0), (21.0, 1.0), (22.0, 2.0), (50.0, 50.0)} <= drawn
    assert len(rows) == len({tuple(row[:2]) for row in rows})  # no closing vertex twice
    assert len(rows) == 2 + 6 + 8 + 3 + 3


def test_mask(tmp_path):
    lake = shapely.box(0, 0, 10, 10).difference(shapely.box(4, 4, 6, 6))
    path = write(tmp_path / "lake.gpkg", [lake, shapely.box(8, 8, 20, 20)], kind="Polygon")
    found = read_water_polygons(path, UTM30)
    x, y = np.array([1.0, 5.0, 9.0, 15.0, 25.0]), np.array([1.0, 5.0, 9.0, 15.0, 25.0])
    inside = shapely.contains_xy(found.geometries[0], x, y)
    assert inside.tolist() == [True, False, True, True, False]


def test_repaired_mask(tmp_path):
    shapes = (
        "POLYGON((0 0,10 10,10 0,0 10,0 0))",
        "POLYGON((20 0,30 0,30 10,20 10,20 0),(28 4,32 4,32 6,28 6,28 4))",
        "POLYGON((50 0,60 0,60 10,50 10,50 0))",
        "POINT(1 2)",
    )
    path = write(tmp_path / "a.gpkg", shapely.from_wkt(shapes))
    with warned("mask.repaired", count=2):
        found = read_water_polygons(path, UTM30)
    assert found.geometries[0].is_valid
    assert found.geometries[0].area == pytest.approx(50.0 + 96.0 + 100.0)  # the hole stays a hole
