"""What a text names, and what becomes of heights and units."""

import numpy as np
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS, Transformer

from pcfix.errors import InputError
from pcfix.flow.surfaces import view_of
from pcfix.io.crs import (
    Topocentric,
    check_projected_metres,
    crs_text,
    geographic_3d,
    heights_of,
    is_local,
    is_same,
    is_same_vertical_datum,
    metres_up,
    parse_crs,
    parts,
    with_heights,
)
from pcfix.io.transformations import HeightsError, transformation_in_plan, transformation_in_space
from tests.utils.clouds import random_cloud

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


@pytest.mark.parametrize(
    "text",
    ["", "EPSG:99999999", "9" * 40, "WGS85", "PROJCS[", "\0", "EPSG:25830+", "+proj=no", "\ud800"],
)
def test_a_text_that_names_no_crs(text):
    with pytest.raises(InputError, match=r"^cameras.xml: the CRS '.*' is not one that PROJ knows"):
        parse_crs(text, "cameras.xml")


def test_wkt_that_proj_does_not_read_again():
    """A code with a line break is in what PROJ writes of it, and PROJ cannot read that."""
    text = (
        'PROJCS["",GEOGCS["",DATUM["",SPHEROID["",7,9[""]]TOWGS84[0,0,0,0,0,0,0][""]][""[""]]'
        '[""""]]PROJECTION[""[""""]][""][""[""]]AUTHORITY["G","2\n0"]]'
    )
    with pytest.raises(InputError, match="is not one that PROJ knows"):
        parse_crs(text, "cameras.xml")


@pytest.mark.parametrize("number", ["-1", "0", "1e999"])
def test_wkt_with_numbers_that_no_ellipsoid_has(number, tmp_path):
    """Of a camera file, and of a cloud, whose sentence does not hold all of it."""
    text = CRS("EPSG:32633").to_wkt().replace("6378137", number)
    with pytest.raises(InputError, match=r"the CRS 'PROJCRS.*\.\.\.' is not one that PROJ knows"):
        parse_crs(text, "cameras.xml")
    las = random_cloud(6, count=300)
    las.header.vlrs.append(WktCoordinateSystemVlr(text))
    las.header.global_encoding.wkt = True
    las.write(tmp_path / "cloud.las")
    with pytest.raises(
        InputError, match=r"cloud\.las: its coordinate system cannot be read"
    ) as said:
        view_of(tmp_path / "cloud.las")
    assert len(str(said.value).removeprefix(str(tmp_path))) < 160


def test_a_vertical_crs_alone_is_no_place():
    with pytest.raises(InputError, match="NAVD88 height is a vertical CRS; add the horizontal"):
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
def test_what_heights_mean(text, kind):
    assert heights_of(CRS(text)) == kind


def test_parts_of_a_bound_compound_crs():
    wkt = (
        'COMPD_CS["a",' + CRS("EPSG:25830").to_wkt("WKT1_GDAL").replace(
            'AUTHORITY["EPSG","6258"]', 'TOWGS84[0,0,0,0,0,0,0],AUTHORITY["EPSG","6258"]'
        ) + "," + CRS("EPSG:5782").to_wkt("WKT1_GDAL") + "]"
    )  # fmt: skip
    plan, vertical = parts(CRS(wkt))
    assert plan.is_bound
    assert is_same(plan, CRS("EPSG:25830"))
    assert vertical.to_epsg() == 5782


def test_crs_without_a_code_are_not_one_for_having_no_name():
    one, other = (CRS(f"+proj=tmerc +lon_0={lon} +datum=WGS84 +type=crs") for lon in (3, 4))
    assert one.name == other.name
    assert not is_same(one, other)
    assert is_same(one, CRS(one.to_wkt()))


def test_a_vertical_datum_has_more_than_one_unit():
    assert is_same_vertical_datum(CRS("EPSG:5703"), CRS("EPSG:6360"))
    assert not is_same_vertical_datum(CRS("EPSG:5703"), CRS("EPSG:5782"))
    in_metres = with_heights(CRS("EPSG:26910"), CRS("EPSG:6360"))
    assert metres_up(in_metres) == 1.0
    assert is_same_vertical_datum(parts(in_metres)[1], CRS("EPSG:5703"))


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
def test_the_unit_of_heights(text, metres):
    assert metres_up(CRS(text)) == pytest.approx(metres, rel=1e-12)


@pytest.mark.parametrize("text", ["EPSG:25830", "EPSG:25830+5782", "EPSG:4978", "EPSG:4979"])
def test_the_text_of_a_crs_is_its_codes(text):
    assert crs_text(CRS(text)) == text
    assert crs_text(CRS(CRS(text).to_wkt())) == text


def test_the_text_of_a_crs_without_codes_means_the_same():
    three = CRS("EPSG:25830").to_3d()
    assert CRS(crs_text(three)) == three


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:4326", "is in degrees; reproject the cloud"),
        ("EPSG:4978", "is in no map projection"),
        ("EPSG:2992", "is in foot; reproject the cloud to one in metres"),
        ("EPSG:26910+6360", "is in US survey foot and metre"),
    ],
)
def test_what_a_cloud_cannot_be_in(text, message):
    with pytest.raises(InputError, match=f"the cloud: .*{message}"):
        check_projected_metres(CRS(text), "the cloud")


def test_local_frames():
    assert is_local(CRS(LOCAL_CS))
    assert not is_local(CRS("EPSG:25830"))


@pytest.mark.parametrize(
    ("geocentric", "geographic"), [("EPSG:4978", "EPSG:4979"), ("EPSG:4936", "EPSG:4937")]
)
def test_the_geographic_crs_of_a_datum(geocentric, geographic):
    assert geographic_3d(CRS(geocentric)) == CRS(geographic)


def test_a_geocentric_crs_keeps_its_shift_to_wgs84():
    wkt = (
        'GEOCCS["Amersfoort",DATUM["Amersfoort",SPHEROID["Bessel 1841",6377397.155,299.1528128],'
        'TOWGS84[565.4,50.3,465.5,-0.4,0.3,-1.9,4.1]],PRIMEM["Greenwich",0],UNIT["metre",1]]'
    )
    assert geographic_3d(CRS(wkt)).is_bound
    assert geographic_3d(CRS(wkt)).is_geographic


def test_topocentric_axes_by_hand():
    lat, lon, h = 52.519, 13.4004, 34.0
    a, f = 6378137.0, 1 / 298.257223563
    phi, lam = np.radians([lat, lon])
    e2 = f * (2 - f)
    n = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    origin = [
        (n + h) * np.cos(phi) * np.cos(lam),
        (n + h) * np.cos(phi) * np.sin(lam),
        (n * (1 - e2) + h) * np.sin(phi),
    ]
    found = Topocentric.from_text(f"ENU:{lat},{lon},{h}", "a").to_geocentric(
        np.array([[0.0, 0, 0], [100.0, -50.0, 20.0]])
    )
    assert found[0] == pytest.approx(origin, abs=1e-6)
    proj = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={lat} +lon_0={lon}"
        f" +h_0={h}"
    ).transform(100.0, -50.0, 20.0)
    assert found[1] == pytest.approx(proj, abs=1e-6)


def test_the_height_of_a_topocentric_origin_may_be_left_out():
    assert Topocentric.from_text("enu: 39.97523, -83.00678", "a") == Topocentric(
        39.97523, -83.00678, 0.0
    )


@pytest.mark.parametrize("text", ["ENU:", "ENU:1", "ENU:1,2,3,4", "ENU:a,b,c", "ENU:nan,2,3"])
def test_a_topocentric_frame_without_place(text):
    with pytest.raises(InputError, match=r"a\.xml: 'ENU:.*' is not ENU:latitude,longitude"):
        Topocentric.from_text(text, "a.xml")


def test_a_topocentric_frame_with_longitude_first():
    with pytest.raises(InputError, match="is not on the earth; give latitude, then longitude"):
        Topocentric.from_text("ENU:139.5,35.7,100", "a.xml")


def test_only_the_plan_goes_over_and_feet_become_metres():
    step = transformation_in_plan(CRS("EPSG:2992"), CRS("EPSG:26910"), np.zeros((1, 3)), "a")
    x, y = Transformer.from_crs("EPSG:26910", "EPSG:2992", always_xy=True).transform(5e5, 4.9e6)
    assert step.forward(np.array([[x, y, 1000.0]])) == pytest.approx(
        np.array([[5e5, 4.9e6, 304.8]]), abs=1e-3
    )


def test_a_missing_vertical_grid_is_named():
    with pytest.raises(HeightsError) as caught:
        transformation_in_space(
            CRS("EPSG:4937"), CRS("EPSG:25830+5782"), np.array([[-0.38, 39.44, 142.0]]), "a.xml"
        )
    assert str(caught.value) == (
        "a.xml: ellipsoidal heights (ETRS89) cannot be brought to Alicante height without the"
        " grid es_ign_egm08-rednap.tif: install it with 'pyproj sync --file"
        " es_ign_egm08-rednap.tif' or PROJ's projsync, or let PROJ fetch it with PROJ_NETWORK=ON"
    )


def test_heights_between_which_proj_knows_nothing():
    unknown = CRS(
        'COMPD_CS["b",' + CRS("EPSG:25830").to_wkt("WKT1_GDAL")
        + ',VERT_CS["Site zero",VERT_DATUM["Site zero",2005],UNIT["metre",1],AXIS["Up",UP]]]'
    )  # fmt: skip
    with pytest.raises(HeightsError, match="to Site zero: PROJ knows no transformation"):
        transformation_in_space(CRS("EPSG:4937"), unknown, np.array([[-0.38, 39.44, 1.0]]), "a")


def test_a_missing_horizontal_grid_is_an_error_where_nothing_else_is_known():
    with pytest.raises(InputError, match=r"NAD27 .* can be brought to NAD83 .* only with the grid"):
        transformation_in_plan(
            CRS("EPSG:26715"), CRS("EPSG:26915"), np.array([[5e5, 5.0e6, 0.0]]), "a.xml"
        )


def test_a_horizontal_grid_that_would_do_better_is_a_note():
    step = transformation_in_plan(CRS("EPSG:23030"), CRS("EPSG:25830"), VALENCIA, "a.xml")
    (note,) = step.notes
    assert note.startswith(
        "a.xml: from ED50 / UTM zone 30N to ETRS89 / UTM zone 30N positions are good to about"
        " 1.5 m; 0.2 m with the grid es_ign_SPED2ETV2.tif"
    )


def test_a_datum_without_a_name_is_a_note():
    nameless = CRS("+proj=tmerc +lon_0=-3 +ellps=intl +type=crs")
    at = np.array([[1000.0, 4.4e6, 5.0]])
    (note,) = transformation_in_plan(nameless, CRS("EPSG:25830"), at, "a.xml").notes
    assert "PROJ knows no transformation from unknown" in note


def test_datums_alike_to_a_metre_are_no_note():
    assert transformation_in_plan(CRS("EPSG:32630"), CRS("EPSG:25830"), VALENCIA, "a").notes == ()


def test_a_crs_that_is_no_single_map():
    with pytest.raises(InputError, match="PROJ cannot bring WGS 84 to WGS 84 / UTM grid system"):
        transformation_in_plan(CRS("EPSG:4326"), CRS("EPSG:32600"), np.zeros((1, 3)), "a")
