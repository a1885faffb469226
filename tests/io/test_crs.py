"""Texts that name a CRS, kinds of heights, units, and transformations."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from pcfix.io.crs import (
    HeightsError,
    Topocentric,
    check_projected_metres,
    geographic_3d,
    heights_of,
    metres_up,
    parse_crs,
    transformation,
)
from tests.utils.codes import refused
from tests.utils.geodesy import geocentric

pytestmark = pytest.mark.quick_but("test_unknown")

ESRI = (
    'PROJCS["ETRS_1989_UTM_Zone_30N",GEOGCS["GCS_ETRS_1989",DATUM["D_ETRS_1989",'
    'SPHEROID["GRS_1980",6378137.0,298.257222101]],PRIMEM["Greenwich",0.0],'
    'UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],'
    'PARAMETER["Central_Meridian",-3.0],PARAMETER["Scale_Factor",0.9996],'
    'PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]'
)
LOCAL_CS = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
VALENCIA = np.array([[725448.8215, 4369128.6996, 142.4802]])


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("EPSG:25830", 25830),
        ("epsg::25830", 25830),
        (" 25830 ", 25830),
        ("urn:ogc:def:crs:EPSG::25830", 25830),
        (ESRI, 25830),
        (CRS("EPSG:25830").to_wkt("WKT1_GDAL"), 25830),
        (CRS("EPSG:25830").to_wkt("WKT2_2019"), 25830),
        ("+proj=utm +zone=30 +datum=WGS84 +units=m +no_defs +type=crs", 32630),
        ("ETRS89 / UTM zone 30N", 25830),
    ],
)
def test_texts(text, code):
    assert parse_crs(text, "cameras.xml").to_epsg() == code


# A code with a line break is in what PROJ writes of it, and PROJ cannot read that.
NO_CODE = (
    'PROJCS["",GEOGCS["",DATUM["",SPHEROID["",7,9[""]]TOWGS84[0,0,0,0,0,0,0][""]][""[""]]'
    '[""""]]PROJECTION[""[""""]][""][""[""]]AUTHORITY["G","2\n0"]]'
)


@pytest.mark.parametrize(
    "text",
    [
        *("", "EPSG:99999999", "9" * 40, "WGS85", "PROJCS[", "\0", "EPSG:25830+", "+proj=no"),
        *("\ud800", NO_CODE),
        *(CRS("EPSG:32633").to_wkt().replace("6378137", axis) for axis in ("-1", "0", "1e999")),
    ],
)
def test_unknown(text):
    with refused("crs.unknown", path="cameras.xml"):
        parse_crs(text, "cameras.xml")


def test_vertical_only():
    with refused("crs.vertical_only", crs="NAVD88 height"):
        parse_crs("EPSG:5703", "cameras.xml")


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("EPSG:4978", "ellipsoidal"),
        ("EPSG:4979", "ellipsoidal"),
        ("EPSG:4326", "unstated"),
        ("EPSG:25830", "unstated"),
        ("EPSG:25830+5782", "gravity"),
        (f'{ESRI},VERTCS["WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137,298.257223563'
         ']],PARAMETER["Vertical_Shift",0],PARAMETER["Direction",1],UNIT["Meter",1]]',
         "ellipsoidal"),
    ],
)  # fmt: skip
def test_heights_of(text, kind):
    assert heights_of(CRS(text)) == kind


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("EPSG:25830", 1.0),
        ("EPSG:4326", 1.0),
        ("EPSG:2992", 0.3048),
        ("EPSG:2992+5703", 1.0),
        ("EPSG:26910+6360", 1200.0 / 3937.0),
        ("EPSG:25830+5715", -1.0),
    ],
)
def test_metres_up(text, metres):
    assert metres_up(CRS(text)) == pytest.approx(metres, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        *(("EPSG:4326", "crs.not_projected"), ("EPSG:4978", "crs.not_projected")),
        *(("EPSG:2992", "crs.unit"), ("EPSG:26910+6360", "crs.unit")),
    ],
)
def test_clouds_need_metres(text, code):
    with refused(code, path="the cloud", crs=CRS(text).name):
        check_projected_metres(CRS(text), "the cloud")


@pytest.mark.parametrize(
    ("geocentric", "geographic"), [("EPSG:4978", "EPSG:4979"), ("EPSG:4936", "EPSG:4937")]
)
def test_geographic_3d(geocentric, geographic):
    assert geographic_3d(CRS(geocentric)) == CRS(geographic)


def test_topocentric():
    lat, lon, h = 52.519, 13.4004, 34.0
    origin = geocentric(lon, lat, h, 6378137.0, 1 / 298.257223563)
    place = Topocentric.from_text(f"ENU:{lat},{lon},{h}", "a")
    enu = np.array([[0.0, 0, 0], [100.0, -50.0, 20.0]])
    degrees = place.to_degrees(enu)
    found = [geocentric(*point, 6378137.0, 1 / 298.257223563) for point in degrees]
    assert found[0] == pytest.approx(origin, abs=1e-6)
    assert np.linalg.norm(np.subtract(found[1], origin)) == pytest.approx(np.linalg.norm(enu[1]))
    assert (degrees[1] > [lon, -90.0, h]).all()
    assert degrees[1, 1] < lat
    assert Topocentric.from_text("enu: 39.9, -83.0", "a") == Topocentric(39.9, -83.0, 0.0)


def test_plan_in_feet():
    crs = CRS("EPSG:2992"), CRS("EPSG:26910")
    forward, _ = transformation(*crs, np.zeros((1, 3)), "a", heights=False)
    x, y = Transformer.from_crs("EPSG:26910", "EPSG:2992", always_xy=True).transform(5e5, 4.9e6)
    assert forward(np.array([[x, y, 1000.0]])) == pytest.approx(
        np.array([[5e5, 4.9e6, 304.8]]), abs=1e-3
    )


UNKNOWN_HEIGHTS = (
    'COMPD_CS["b",' + CRS("EPSG:25830").to_wkt("WKT1_GDAL")
    + ',VERT_CS["Site zero",VERT_DATUM["Site zero",2005],UNIT["metre",1],AXIS["Up",UP]]]'
)  # fmt: skip


@pytest.mark.parametrize(
    ("target", "grids"), [("EPSG:25830+5782", ["es_ign_egm08-rednap.tif"]), (UNKNOWN_HEIGHTS, [])]
)
def test_heights_without_a_grid(target, grids):
    at = np.array([[-0.38, 39.44, 142.0]])
    with refused("crs.heights", HeightsError, grids=grids):
        transformation(CRS("EPSG:4937"), CRS(target), at, "a.xml", heights=True)


@pytest.mark.parametrize(
    ("source", "target", "at", "code"),
    [
        ("EPSG:26715", "EPSG:26915", (5e5, 5e6, 0.0), "crs.grid_missing"),
        ("EPSG:4326", "EPSG:32600", (0.0, 0.0, 0.0), "crs.no_transformation"),
    ],
)
def test_plan_that_cannot_be_transformed(source, target, at, code):
    with refused(code, path="a.xml"):
        transformation(CRS(source), CRS(target), np.array([at]), "a.xml", heights=False)


@pytest.mark.parametrize(
    ("source", "codes"),
    [
        ("EPSG:23030", ["crs.accuracy"]),  # 1.5 m; 0.2 m with a grid
        ("+proj=tmerc +lon_0=-3 +ellps=intl +type=crs", ["crs.datum"]),
        ("EPSG:32630", []),  # the same to a metre
    ],
)
def test_notes(source, codes):
    target = CRS("EPSG:25830")
    _, notes = transformation(CRS(source), target, VALENCIA, "a.xml", heights=False)
    assert [note.code for note in notes] == codes
    if codes == ["crs.accuracy"]:
        assert notes[0].values["grids"] == ["es_ign_SPED2ETV2.tif"]
