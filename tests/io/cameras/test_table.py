"""Poses from CSV tables."""

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.io.cameras import table
from pcfix.io.cameras.table import read_sensor
from tests.utils.camera_files import read
from tests.utils.codes import refused

pytestmark = pytest.mark.quick


def write(tmp_path, text, sensor="focal,sensor_x,sensor_y\n8.8,13.2,8.8\n"):
    if sensor:
        (tmp_path / "sensor.csv").write_text(sensor)
    path = tmp_path / "cameras.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


DOWN, NORTH, EAST, UP, WEST, SOUTH = (
    *((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    *((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
)


@pytest.mark.parametrize(
    ("kind", "angles", "forward", "top", "right"),
    [
        ("yaw-pitch-roll", (0, 0, 0), DOWN, NORTH, EAST),
        ("yaw-pitch-roll", (90, 0, 0), DOWN, EAST, SOUTH),
        ("yaw-pitch-roll", (0, 90, 0), NORTH, UP, EAST),
        ("yaw-pitch-roll", (90, 90, 0), EAST, UP, SOUTH),
        ("yaw-pitch-roll", (0, 0, 90), WEST, NORTH, DOWN),
        ("aircraft", (0, -90, 0), DOWN, NORTH, EAST),
        ("aircraft", (90, -90, 0), DOWN, EAST, SOUTH),
        ("aircraft", (0, 0, 0), NORTH, UP, EAST),
        ("aircraft", (90, 0, 0), EAST, UP, SOUTH),
        ("aircraft", (0, -30, 0), (0, np.sqrt(0.75), -0.5), (0, 0.5, np.sqrt(0.75)), EAST),
        ("aircraft", (0, 0, 90), NORTH, EAST, DOWN),
    ],
)
def test_yaw_pitch_roll(tmp_path, kind, angles, forward, top, right):
    path = write(tmp_path, "label,x,y,z,yaw,pitch,roll\na,1,2,3," + ",".join(map(str, angles)))
    east, south, view = read(path, angles=kind).rotations[0]
    found = view, -south, east
    for vector, expected in zip(found, (forward, top, right), strict=True):
        assert vector == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "z;label;x;y\n3;a;1;2\n",
        "label\tx\ty\tz\textra\na\t1\t2\t3\tword\n",
        b"\xef\xbb\xbflabel,x,y,z\r\n\r\na,1,2,3\r\n\r\n",
        '"label","x","y","z"\n"a, b",1,2,3\n',
        b"label,x,y,z\nStra\xdfe.jpg,1,2,3\n",
        "label;x;y;z\na;1,0;2,00;3\n",
        "#Label,X/Easting,Y/Northing,Z/Altitude\na.jpg,1,2,3\n",
        "filename,X[m],Y[m],Z[m]\na.jpg,1,2,3\n",
        "PhotoID,x_m,y_m,z_m\na.jpg,1,2,3\n",
        "imageName,East,North,Elevation (m)\na.jpg,1,2,3\n",
        '"file name","projectedX","projectedY","projectedZ"\na.jpg,1,2,3\n',
    ],
)
def test_dialects_and_spellings(tmp_path, text):
    cameras = pcfix.read_cameras(write(tmp_path, text, sensor=None))
    assert cameras.centres.tolist() == [[1, 2, 3]]
    assert (cameras.crs, cameras.notes) == (None, ())


# Columns


def plain(tmp_path, text, **options):
    """Return the cameras of a table as this module reads it, with the usual sensor beside it."""
    return read(write(tmp_path, text), **options)


@pytest.mark.parametrize(
    ("header", "crs"),
    [
        ("label,longitude,latitude,altitude", "EPSG:4326"),
        ("Label,X/Longitude,Y/Latitude,Z/Altitude", "EPSG:4326"),
        ("image,lon,lat,ellipsoidal_height", "EPSG:4979"),
    ],
)
def test_degrees(tmp_path, header, crs):
    cameras = plain(tmp_path, header + "\na,12.5,55.25,90\n")
    assert cameras.centres.tolist() == [[12.5, 55.25, 90]]
    assert cameras.crs == crs


@pytest.mark.parametrize(
    ("stated", "crs"),
    [
        ("# CoordinateSystem: EPSG:32632", "EPSG:32632"),
        ("# crs: EPSG:25832+7837", "EPSG:25832+7837"),
        ('# CoordinateSystem: LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]', "local"),
    ],
)
def test_the_crs_of_a_comment(tmp_path, stated, crs):
    assert plain(tmp_path, stated + "\n#Label,X,Y,Z\na,1,2,3\n").crs == crs


# Angles


def nadir(cameras):
    """Return the angles between the views and straight down."""
    forward = cameras.rotations[:, 2]
    return np.degrees(np.arctan2(np.hypot(forward[:, 0], forward[:, 1]), -forward[:, 2]))


@pytest.mark.parametrize(
    ("header", "per_degree"),
    [
        ("label,x,y,z,omega,phi,kappa", 1.0),
        ("label,x,y,z,omega[deg],phi[deg],kappa[deg]", 1.0),
        ("label,x,y,z,omega[gon],phi[gon],kappa[gon]", 10 / 9),
        ("label,x,y,z,omega_rad,phi_rad,kappa_rad", np.pi / 180),
    ],
)
def test_omega_phi_kappa(tmp_path, header, per_degree):
    angles = np.array([12.0, -7.0, 130.0])
    row = ",".join(repr(float(a)) for a in angles * per_degree)
    cameras = plain(tmp_path, f"{header}\na,1,2,3,{row}\n")
    to_world = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    assert cameras.rotations[0] == pytest.approx(np.diag([1, -1, -1]) @ to_world.T, abs=1e-12)


@pytest.mark.parametrize("names", ["qw,qx,qy,qz", "r11,r12,r13,r21,r22,r23,r31,r32,r33"])
def test_turns_are_from_world_to_camera(tmp_path, names):
    turn = Rotation.from_euler("xyz", [170.0, 12.0, 34.0], degrees=True)
    numbers = np.roll(turn.as_quat(), 1) if "q" in names else turn.as_matrix().ravel()
    row = ",".join(map(repr, numbers.tolist()))
    cameras = plain(tmp_path, f"label,x,y,z,{names}\na,1,2,3,{row}\n")
    assert cameras.rotations[0] == pytest.approx(turn.as_matrix(), abs=1e-12)


GIMBAL = "label,x,y,z,{}\na,1,2,3,10,-90,0\nb,1,2,3,20,-60,0\n"


def test_angles_of_a_gimbal_do_not_pass_as_others(tmp_path):
    text = GIMBAL.format("yaw,pitch,roll")
    with refused("cameras.angles"):
        plain(tmp_path, text)
    assert nadir(plain(tmp_path, text, angles="aircraft")) == pytest.approx([0, 30])
    assert nadir(plain(tmp_path, text, angles="yaw-pitch-roll")) == pytest.approx([90, 60])


def test_obliques_among_views_down_are_not_taken_for_a_gimbal(tmp_path):
    rows = "".join(f"{i},1,2,3,10,{pitch},0\n" for i, pitch in enumerate((0, 1, -2, 55, -50)))
    cameras = plain(tmp_path, "label,x,y,z,yaw,pitch,roll\n" + rows)
    assert nadir(cameras) == pytest.approx([0, 1, 2, 55, 50])


# Software


METASHAPE_TABLE = """\
# CoordinateSystem: EPSG:32632
#Label,Enable,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll,Accuracy_X/Y/Z_(m),\
Accuracy_Yaw/Pitch/Roll_(deg),Error_(m),X_error,X_est,Y_est,Z_est,Yaw_est,Pitch_est,Roll_est,X_var
a,1,500001,5600002,90,10,1,2,0.05,,1.5,1,500002,5600003,91,11,0,0,0.1
b,0,500011,5600012,90,,,,0.02,,1.5,1,500012,5600013,91,12,5,0,0.1
c,1,500021,5600022,90,10,1,2,0.05,,,,,,,,,,
d,1,,,,,,,,,,,500032,5600033,91,13,0,0,0.1
"""


def test_metashape_reference_has_estimates_and_sources(tmp_path):
    cameras = plain(tmp_path, METASHAPE_TABLE)
    assert cameras.labels == ("a", "b", "d")
    assert cameras.unposed == ("c",)
    assert cameras.crs == "EPSG:32632"
    assert cameras.centres[0].tolist() == [500002, 5600003, 91]
    assert nadir(cameras) == pytest.approx([0, 5, 0], abs=1e-6)
    assert -cameras.rotations[0][1, :2] == pytest.approx(
        [np.sin(np.radians(11)), np.cos(np.radians(11))]
    )
    assert cameras.gnss.crs == "EPSG:32632"
    assert cameras.gnss.xyz[0].tolist() == [500001, 5600002, 90]
    assert cameras.gnss.sigma_m[0].tolist() == [0.05] * 3
    assert np.isnan(cameras.gnss.xyz[1:]).all()  # b is switched off, d has none
    assert cameras.notes == ()


RC = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
RC_FRAME = "focal_px,width_px,height_px\n1,3840,2880\n"


def test_realitycapture_turns_as_its_xmp(tmp_path):
    # one camera that a user of RealityCapture published in both forms
    (tmp_path / "frame.csv").write_text(RC_FRAME)
    angles = "163.736597399311,83.4154313461628,174.386496244756"
    text = RC + f"a.jpg,1,2,3,{angles},24,0,0,0,0,0,0,0,0\n"
    cameras = plain(tmp_path, text, sensor=tmp_path / "frame.csv")
    xmp = [0.982594073038806, 0.185426733553445, -0.0112166890261935]
    xmp += [-0.032113633044729, 0.11008102707942, -0.993403685341366]
    assert cameras.rotations[0][:2].ravel() == pytest.approx(xmp, abs=1e-8)


def test_realitycapture_lens(tmp_path):
    (tmp_path / "frame.csv").write_text(RC_FRAME)
    row = "{},44.5,138.8,6.8,170.3,5.1,-2.7,{},-1e-3,2e-3,0.01,-0.02,0.03,0.04,5e-4,6e-4\n"
    text = RC + row.format("a", 18) + row.format("b", 18) + row.format("c", 27)
    cameras = plain(tmp_path, text, sensor=tmp_path / "frame.csv")
    lens = cameras.lenses[0]
    assert lens == pcfix.Lens(
        focal=1920.0,
        width=3840.0,
        height=2880.0,
        principal_x=1920.0 - 3.84,
        principal_y=1440.0 + 7.68,
        radial=(0.01, -0.02, 0.03, 0.04),
        tangential=(5e-4, 6e-4),
    )
    assert cameras.lenses[1] is lens
    assert cameras.lenses[2].focal == pytest.approx(2880.0)


# Sensors


def test_a_sensor_in_pixels_has_the_order_of_opencv(tmp_path):
    sensor = tmp_path / "sensor.csv"
    sensor.write_text(
        "focal_px,width_px,height_px,cx,cy,k1,k2,p1,p2,k3\n3000,4000,3000,2010,1490,.1,.2,.3,.4,.5\n"
    )
    assert read_sensor(sensor) == pcfix.Lens(
        3000, 4000, 3000, 2010, 1490, radial=(0.1, 0.2, 0.5), tangential=(0.4, 0.3)
    )


# GNSS


def test_geo_txt(tmp_path):
    path = tmp_path / "geo.txt"
    path.write_text(
        "WGS84 UTM 16S\nDJI_0028.JPG 500000.5 4000000 198.6\n\n"
        "DJI_0032.JPG 500010 4000000 199 10 0 0 0.02 0.04 more of it\nDJI_0033.JPG 1 2\n"
    )
    columns = table.open_table(path)
    gnss = table.gnss_positions(columns)
    assert columns.labels == ["DJI_0028.JPG", "DJI_0032.JPG", "DJI_0033.JPG"]
    assert gnss.crs == "EPSG:32716"
    assert gnss.xyz[:2].tolist() == [[500000.5, 4000000, 198.6], [500010, 4000000, 199]]
    assert np.isnan(gnss.xyz[2]).all()
    assert np.isnan(gnss.sigma_m[0]).all()
    assert gnss.sigma_m[1].tolist() == [0.02, 0.02, 0.04]


# Tables that are not right

ANGLED = "label,x,y,z,omega,phi,kappa\n"
MATRIX = "label,x,y,z," + ",".join(f"r{i}{j}" for i in "123" for j in "123")
REFUSED = {
    "two names for one thing": ("label,easting,east,y,z\na,1,1,2,3\n", "table.columns_alike"),
    "feet": ("label,x[ft],y[ft],z[ft]\na,1,2,3\n", "table.unit"),
    "mils": ("label,x,y,z,omega[mil],phi,kappa\na,1,2,3,0,0,0\n", "table.unit"),
    "no height": ("label,lon,lat\na,1,2\n", "table.column_missing"),
    "no number": ("label,x,y,z\na.jpg,1,two,3\n", "table.number"),
    "two angles": ("label,x,y,z,omega,phi\na,1,2,3,0,0\n", "table.column_missing"),
    "phi first": ("label,x,y,z,phi,omega,kappa\na,1,2,3,0,0,0\n", "cameras.angles"),
    "RealityCapture's omega": ("#name,x,y,z,omega,phi,kappa\na,1,2,3,0,0,0\n", "cameras.angles"),
    "a quaternion": ("label,x,y,z,qw,qx,qy,qz\na.jpg,1,2,3,1,1,0,0\n", "cameras.rotation"),
    "a mirror": (MATRIX + "\na.jpg,1,2,3,1,0,0,0,1,0,0,0,-1\n", "cameras.rotation"),
    "gon": (ANGLED + "a,1,2,3,0,0,300\nb,1,2,3,399.9,0,100\n", "cameras.angle_range"),
    "nothing adjusted": ("#Label,X,Y,Z,X_est,Y_est,Z_est\na,1,2,3,,,\n", "cameras.no_pose"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_tables_that_are_not_right(tmp_path, case):
    text, message = REFUSED[case]
    with refused(message):
        plain(tmp_path, text)


def test_the_option_settles_the_order_of_the_turns(tmp_path):
    text = "#name,x,y,z,omega,phi,kappa\na,1,2,3,10,0,0\n"
    assert nadir(plain(tmp_path, text, angles="omega-phi-kappa")) == pytest.approx([10])


@pytest.mark.parametrize("text", [ANGLED, RC])
def test_angles_need_a_sensor(tmp_path, text):
    row = "a,1,2,3" + ",0" * (text.count(",") - 3)
    with refused("cameras.sensor_missing"):
        read(write(tmp_path, text + row, sensor=None))


def test_a_projection_beside_a_table_is_its_crs(tmp_path):
    path = tmp_path / "cameras.csv"
    path.write_text("label,x,y,z\na,500000,5200000,90\n")
    path.with_suffix(".prj").write_text(CRS.from_epsg(32632).to_wkt("WKT1_ESRI"))
    assert CRS(pcfix.read_cameras(path).crs).equals(CRS(32632), ignore_axis_order=True)
    path.write_text("# crs: EPSG:25832\nlabel,x,y,z\na,500000,5200000,90\n")
    assert pcfix.read_cameras(path).crs == "EPSG:25832"  # the comment overrides it
