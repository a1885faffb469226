"""Vector files: what is read, where it goes, and what is refused."""

import json
import sys

import numpy as np
import pytest
from pyproj import Transformer

from pcfix.errors import InputError, SettingError
from pcfix.io import vectors
from pcfix.io.transformations import HeightsError
from pcfix.io.vectors import (
    in_cloud_crs,
    is_vector_file,
    read_shoreline,
    read_vectors,
    read_water_polygons,
)

shapely = pytest.importorskip("shapely")
raw = pytest.importorskip("pyogrio.raw")

UTM30 = "EPSG:25830"
SHORE = np.array([[725_448.0, 4_369_128.0, 2.25], [725_460.0, 4_369_140.0, 2.31]])


def write(path, geometries, *, crs=UTM30, kind="Unknown", layer=None):
    wkb = np.array([None if g is None else shapely.to_wkb(g) for g in geometries], object)
    raw.write(path, wkb, [], [], geometry_type=kind, crs=crs, layer=layer)
    return path


def write_geojson(path, *geometries, crs=None):
    features = [{"type": "Feature", "properties": {}, "geometry": one} for one in geometries]
    content = {"type": "FeatureCollection", "features": features}
    if crs:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(content))
    return path


def write_text(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def point(*xyz):
    return {"type": "Point", "coordinates": list(xyz)}


@pytest.mark.parametrize("suffix", ["gpkg", "shp", "geojson"])
def test_points_of_every_format(tmp_path, suffix):
    path = write(tmp_path / f"shore.{suffix}", shapely.points(SHORE), kind="Point Z")
    found = read_vectors(path)
    assert found.coordinates == pytest.approx(SHORE, abs=1e-6)
    assert found.crs == UTM30
    assert found.name == str(path)
    assert found.notes == ()


@pytest.mark.parametrize(
    ("lines", "crs"),
    [
        (("x,y,z", "725448,4369128,2.25", "725460,4369140,2.31"), None),
        (("Id;Easting;Northing;Height", "a;725448;4369128;2.25", "b;725460;4369140;2.31"), None),
        (("x [m]\ty [m]\tz [m]", "725448\t4369128\t2.25", "725460\t4369140\t2.31"), None),
        (("# crs: EPSG:25830", "x y z", "725448 4369128 2.25", "725460 4369140 2.31"), UTM30),
        (("wkt,id", '"POINT Z (725448 4369128 2.25)",1', '"POINT Z(725460 4369140 2.31)",2'), None),
        (("POINT Z (725448 4369128 2.25)", "", "POINT Z (725460 4369140 2.31)"), None),
        (("SRID=25830;POINT(725448 4369128 2.25)", "SRID=25830;POINT(725460 4369140 2.31)"), UTM30),
    ],
)  # fmt: skip
def test_points_of_text(tmp_path, lines, crs):
    found = read_vectors(write_text(tmp_path / "shore.csv", *lines))
    assert found.coordinates == pytest.approx(SHORE)
    assert found.crs == crs


def test_degrees_in_a_table_are_of_wgs84(tmp_path):
    path = write_text(tmp_path / "a.csv", "longitude,latitude", "-0.38,39.44")
    assert read_vectors(path).crs == "EPSG:4326"
    assert read_vectors(path, crs="EPSG:4258").crs == "EPSG:4258"


def test_points_of_a_table_may_lack_a_height(tmp_path):
    found = read_vectors(write_text(tmp_path / "a.csv", "x,y,z", "1,2,3", "4,5,", "6,7,nan"))
    assert np.isnan(found.coordinates[:, 2]).tolist() == [False, True, True]


def test_null_and_empty_geometries_are_counted(tmp_path):
    shapes = [None, shapely.Point(), *shapely.points(SHORE)]
    found = read_vectors(write(tmp_path / "a.gpkg", shapes))
    assert len(found.geometries) == 2
    assert found.notes == (f"{tmp_path / 'a.gpkg'}: 2 features without coordinates are left out.",)


def test_a_point_that_is_not_a_number_is_left_out(tmp_path):
    shapes = [shapely.from_wkb(shapely.to_wkb(shapely.Point(np.nan, 1.0))), shapely.Point(1, 2)]
    found = read_vectors(write(tmp_path / "a.gpkg", shapes))
    assert found.coordinates[:, :2].tolist() == [[1.0, 2.0]]


def test_a_layer_is_named_where_there_are_several(tmp_path):
    path = tmp_path / "river.gpkg"
    write(path, shapely.points(SHORE), layer="shore")
    write(path, shapely.points(SHORE[:1]), layer="gauge")
    with pytest.raises(InputError, match=r"has 2 layers \(shore, gauge\); name one, as in"):
        read_vectors(path)
    with pytest.raises(InputError, match="has no layer bank with geometries; it has shore, gauge"):
        read_vectors(f"{path}|layername=bank")
    for found in (read_vectors(f"{path}|layername=gauge"), read_vectors(f"{path}|gauge")):
        assert len(found.geometries) == 1
        assert found.name == f"{path}, layer gauge"


def test_names_of_vector_files():
    assert is_vector_file("a.GPKG|layername=b")
    assert not is_vector_file("a.tif")


def test_a_geojson_without_crs_is_in_degrees(tmp_path):
    flat = write_geojson(tmp_path / "a.geojson", point(-0.38, 39.44))
    assert read_vectors(flat).crs == "EPSG:4326"
    mixed = write_geojson(tmp_path / "b.geojson", point(-0.38, 39.44, 2.0), point(-0.38, 39.44))
    assert read_vectors(mixed).crs == "EPSG:4979"  # RFC 7946: above the ellipsoid
    named = write_geojson(tmp_path / "c.json", point(*SHORE[0]), crs="urn:ogc:def:crs:EPSG::25830")
    assert read_vectors(named).crs == UTM30


def test_degrees_that_are_none_are_refused(tmp_path):
    path = write_geojson(tmp_path / "a.geojson", point(725_448.0, 4_369_128.0))
    with pytest.raises(
        InputError, match=r"725448, 4369128 is no longitude and latitude, but .*GeoJ"
    ):
        read_vectors(path)
    assert read_vectors(path, crs=UTM30).crs == UTM30


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.gpkg", "x", "cannot be read"),
        ("a.geojson", "{", "cannot be read"),
        ("a.geojson", '{"type":"FeatureCollection","features":[]}', "no geometry with coordinates"),
        ("a.csv", "", "is empty"),
        ("a.csv", "a,b\n1,2\n", "must name the columns x and y .* it has: a, b"),
        ("a.csv", "x,y\n", "has a header but no rows"),
        ("a.csv", "x,y\n1\n", "line 2 has 1 fields, the header 2"),
        ("a.csv", "x,y,z\n1,2,low\n", "line 2, column z: 'low' is not a finite number"),
        ("a.csv", "x,y,z\n1,nan,3\n", "line 2, column y: 'nan' is not a finite number"),
        ("a.wkt", "POINT(1 2)\nPOINT(1\n", "line 2 is not WKT"),
        ("a.wkt", "SRID=25830;POINT(1 2)\nPOINT(1 2)\n", "different SRIDs"),
        ("a.wkt", "POINT EMPTY\n", "no geometry with coordinates"),
        ("a.dxf", "", "is not a vector file that pcfix reads; give GeoPackage"),
    ],
)
def test_files_that_hold_nothing(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_vectors(path)


def test_no_such_file(tmp_path):
    with pytest.raises(InputError, match=r"a\.gpkg: there is no such file"):
        read_vectors(tmp_path / "a.gpkg")


def test_a_table_of_a_geopackage_is_no_layer(tmp_path):
    raw.write(tmp_path / "a.gpkg", None, [np.array([1])], ["n"], geometry_type=None, crs=None)
    with pytest.raises(InputError, match="holds no layer with points, lines or polygons"):
        read_vectors(tmp_path / "a.gpkg")


def test_the_extra_is_named_where_it_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    (tmp_path / "a.gpkg").write_text("")
    with pytest.raises(SettingError, match=r"need pyogrio, .* pip install .*\[vector\]'"):
        read_vectors(tmp_path / "a.gpkg")


def test_an_unknown_crs_is_refused(tmp_path):
    path = write_text(tmp_path / "a.csv", "x,y", "1,2")
    with pytest.raises(InputError, match="the CRS 'EPSG:999999' is not one that PROJ knows"):
        read_vectors(path, crs="EPSG:999999")


def test_degrees_go_to_the_map_as_proj_says(tmp_path):
    path = write_text(tmp_path / "a.csv", "lon,lat,h", "-0.38,39.44,2.5", "-0.37,39.45,")
    moved = in_cloud_crs(read_vectors(path), UTM30, heights=True)
    x, y = Transformer.from_crs("EPSG:4326", UTM30, always_xy=True).transform(
        [-0.38, -0.37], [39.44, 39.45]
    )
    assert moved.coordinates[:, :2] == pytest.approx(np.column_stack([x, y]), abs=1e-6)
    assert moved.coordinates[0, 2] == 2.5
    assert np.isnan(moved.coordinates[1, 2])


def test_long_edges_bend_with_the_map(tmp_path):
    """The middle of an edge along a parallel is off the straight line on the map."""
    path = write_text(
        tmp_path / "a.wkt", "SRID=4326;POLYGON((-0.4 39,0 39,0 39.4,-0.4 39.4,-0.4 39))"
    )
    area = read_water_polygons(path, UTM30).area
    x, y = Transformer.from_crs("EPSG:4326", UTM30, always_xy=True).transform(-0.2, 39.0)
    assert area.exterior.distance(shapely.Point(x, y)) < 0.01


@pytest.mark.parametrize("heights", [True, False])
def test_no_crs_is_the_clouds(tmp_path, heights):
    found = read_vectors(write_text(tmp_path / "a.csv", "x,y", "1,2"))
    assert in_cloud_crs(found, None, heights=heights).notes == ()
    moved = in_cloud_crs(found, UTM30, heights=heights)
    assert moved.coordinates[0, :2].tolist() == [1.0, 2.0]
    assert "names no CRS; taken to be in the cloud's" in moved.notes[0]


def test_a_cloud_without_crs_takes_metres_alone(tmp_path):
    metres = read_vectors(write_text(tmp_path / "a.csv", "x,y", "1,2"), crs=UTM30)
    assert "no cloud names a CRS" in in_cloud_crs(metres, None, heights=True).notes[0]
    for crs, unit in (("EPSG:4326", "degrees"), ("EPSG:2992", "the unit foot")):
        found = read_vectors(tmp_path / "a.csv", crs=crs)
        with pytest.raises(InputError, match=f"is in {unit} .* set the cloud's CRS"):
            in_cloud_crs(found, None, heights=True)
    assert (
        in_cloud_crs(read_vectors(tmp_path / "a.csv", crs="local"), UTM30, heights=True).notes == ()
    )


LOCAL_CS = 'LOCAL_CS["Site",LOCAL_DATUM["Site",0],UNIT["metre",1]]'


@pytest.mark.parametrize(
    ("crs", "cloud", "message"),
    [
        (UTM30, LOCAL_CS, "the cloud is in a local frame"),
        (LOCAL_CS, UTM30, "is in a local frame"),
        ("EPSG:4978", UTM30, "is neither a map projection nor in degrees"),
        (UTM30, "EPSG:4326", "the cloud: .* is in degrees"),
    ],
)
def test_frames_that_do_not_meet(tmp_path, crs, cloud, message):
    found = read_vectors(write_text(tmp_path / "a.csv", "x,y,z", "1,2,3"), crs=crs)
    with pytest.raises(InputError, match=message):
        in_cloud_crs(found, cloud, heights=True)


def test_a_place_that_the_map_does_not_have(tmp_path):
    found = read_vectors(write_text(tmp_path / "a.csv", "lon,lat", "90.0,0.0"))
    with pytest.raises(InputError, match="has no place in the cloud's CRS"):
        in_cloud_crs(found, "EPSG:25830", heights=False)


def test_other_heights_need_a_grid_or_the_users_word(tmp_path):
    path = write_geojson(tmp_path / "a.geojson", point(-0.38, 39.44, 51.0))
    with pytest.raises(HeightsError, match=r"es_ign_egm08.* give the file's CRS as EPSG:4326, the"):
        read_shoreline(path, "EPSG:25830+5782")
    shore = read_shoreline(path, "EPSG:25830+5782", crs="EPSG:4326")
    assert shore.xyz[0, 2] == 51.0
    assert "does not say what its heights are" in shore.notes[0]
    assert "has ellipsoidal heights" in read_shoreline(path, UTM30).notes[0]
    mask = write_text(tmp_path / "b.wkt", "SRID=4979;POLYGON Z((0 39 1,1 39 1,1 40 1,0 39 1))")
    read_water_polygons(mask, "EPSG:25831+5782")  # a mask has no heights


def test_feet_become_metres(tmp_path):
    found = read_vectors(
        write_text(tmp_path / "a.csv", "x,y,z", "1000000,500000,10"), crs="EPSG:2992"
    )
    moved = in_cloud_crs(found, "EPSG:26910", heights=True)
    assert moved.coordinates[0, 2] == pytest.approx(3.048)


def test_shoreline_of_lines_and_polygons(tmp_path, monkeypatch):
    lines = (
        "LINESTRING Z (0 0 1, 10 0 2)",
        "LINESTRING (0 5, 10 5)",
        "POLYGON ((20 0,24 0,24 4,20 4,20 0),(21 1,22 1,22 2,21 1))",
        "GEOMETRYCOLLECTION (MULTIPOINT ((50 50),(51 51)), POINT Z (52 52 9))",
    )
    monkeypatch.setattr(vectors, "SPACING_M", 2.0)
    shore = read_shoreline(write_text(tmp_path / "a.wkt", *lines))
    rows = shore.xyz.tolist()
    measured = [row for row in rows if not np.isnan(row[2])]
    assert sorted(measured) == [[0, 0, 1], [10, 0, 2], [52, 52, 9]]
    drawn = {tuple(row[:2]) for row in rows if np.isnan(row[2])}
    assert {(float(x), 5.0) for x in range(0, 11, 2)} <= drawn
    assert {(22.0, 0.0), (21.0, 1.0), (22.0, 2.0), (50.0, 50.0)} <= drawn
    assert len(rows) == len({tuple(row[:2]) for row in rows})  # no closing vertex twice
    assert len(rows) == 2 + 6 + 8 + 3 + 3


def test_heights_that_are_all_zero_are_none(tmp_path):
    path = write_text(tmp_path / "a.csv", "x,y,z", "1,2,0", "3,4,0", "5,6,0")
    shore = read_shoreline(path)
    assert np.isnan(shore.xyz[:, 2]).all()
    assert "all 3 heights are exactly 0" in shore.notes[-1]


def test_shorelines_that_are_too_long(tmp_path):
    path = write_text(tmp_path / "a.wkt", "LINESTRING (0 0, 1e8 0)")
    with pytest.raises(InputError, match=r"would give 1e\+08 points"):
        read_shoreline(path)


def test_holes_of_the_mask_are_dry(tmp_path):
    lake = shapely.box(0, 0, 10, 10).difference(shapely.box(4, 4, 6, 6))
    path = write(tmp_path / "lake.gpkg", [lake, shapely.box(8, 8, 20, 20)], kind="Polygon")
    found = read_water_polygons(path, UTM30)
    x, y = np.array([1.0, 5.0, 9.0, 15.0, 25.0]), np.array([1.0, 5.0, 9.0, 15.0, 25.0])
    assert shapely.contains_xy(found.area, x, y).tolist() == [True, False, True, True, False]
    assert found.notes == ()


def test_polygons_that_cross_themselves_are_repaired(tmp_path):
    path = write_text(
        tmp_path / "a.wkt",
        "POLYGON((0 0,10 10,10 0,0 10,0 0))",
        "POLYGON((20 0,30 0,30 10,20 10,20 0),(28 4,32 4,32 6,28 6,28 4))",
        "POLYGON((50 0,60 0,60 10,50 10,50 0))",
    )
    found = read_water_polygons(path)
    assert found.area.is_valid
    assert found.area.area == pytest.approx(50.0 + 96.0 + 100.0)  # the hole stays a hole
    (note,) = found.notes
    assert note.startswith(f"{path}: 2 of 3 polygons cross or touch themselves (Self-intersection")
    assert note.endswith("they now cover 146.0 m2.")


def test_masks_without_area(tmp_path):
    path = write_text(tmp_path / "a.wkt", "POINT(1 2)", "LINESTRING(0 0,1 1)")
    with pytest.raises(InputError, match=r"holds no polygon \(LineString, Point\)"):
        read_water_polygons(path)
    path = write_text(tmp_path / "b.wkt", "POLYGON((0 0,1 1,2 2,0 0))")
    with pytest.raises(InputError, match="the polygons have no area"):
        read_water_polygons(path)


def test_lines_beside_the_polygons_are_left_out(tmp_path):
    path = write_text(tmp_path / "a.wkt", "POINT(1 2)", "POLYGON((0 0,1 0,1 1,0 0))")
    found = read_water_polygons(path)
    assert found.area.area == 0.5
    assert "1 points or lines beside the polygons are left out" in found.notes[0]
