"""Ground control: surveyed points and their marks in images."""

import numpy as np
import pytest
from pyproj import Transformer

from pcfix.errors import PcfixWarning
from pcfix.io.cameras import read_cameras
from pcfix.io.ground_control import read_ground_control
from pcfix.model import Cameras, Lens
from tests.utils.codes import refused, warned
from tests.utils.reprojection import bring_to, check_file
from tests.utils.shared import needs

pytestmark = pytest.mark.quick_but("test_markers_of_metashape")

SOROLLA, sorolla = needs("cameras", "metashape", "uclm_sorolla")

LENS = Lens(1000.0, 1600.0, 1200.0, 800.0, 600.0)
XYZ = {"G1": (500010.0, 4000010.0, 2.5), "G2": (500030.5, 4000020.25, -1.75)}
HEAD = "name,x,y,z,image,u,v"
ROWS = [
    "G1,500010,4000010,2.5,a.jpg,100,200",
    "G1,500010.0,4000010,2.50,b.jpg,1600,0",
    "G2,500030.5,4000020.25,-1.75,b.jpg,0.5,1199.5",
]


def block(crs="EPSG:32636", labels=("a.jpg", "b.jpg", "c.jpg"), **more):
    k = len(labels)
    centres = np.array([500000.0, 4000000.0, 80.0]) + 10.0 * np.arange(k)[:, None]
    down = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (k, 3, 3))
    return Cameras(labels, centres, down, (LENS,) * k, crs, **more)


def write(tmp_path, *rows, head=HEAD, name="gcps.csv"):
    path = tmp_path / name
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def read(tmp_path, *rows, head=HEAD, cameras=None, crs="EPSG:32636", **more):
    return read_ground_control(
        write(tmp_path, *rows, head=head), cameras or block(), crs=crs, **more
    )


def fails(tmp_path, rows, code, more=None, **values):
    with refused(code, **values) as error:
        read(tmp_path, *rows, **(more or {}))
    assert "gcps.csv" in str(error.value)


@sorolla
@pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")
def test_markers_of_metashape():
    path = SOROLLA / "markers_25830-5782.xml"
    cameras = bring_to(read_cameras(path), "EPSG:25830", cameras_crs="EPSG:25830")
    found = read_ground_control(path, cameras)
    surveyed = np.loadtxt(SOROLLA / "gcp_25830-5782.csv", delimiter=";")
    assert found.names == tuple(str(int(name)) for name in surveyed[:, 0])
    assert found.xyz == pytest.approx(surveyed[:, 1:], abs=1e-3)
    assert (found.sigma_m == 0.005).all()
    assert (found.sigma_px == 0.5).all()
    assert not found.is_check.any()
    assert len(found.point) == path.read_text().count('pinned="true"')
    marks = zip(found.camera, found.image_xy.round(1).tolist(), strict=True)
    here = {(cameras.labels[camera], *uv) for camera, uv in marks}
    listed = check_file(SOROLLA)["observations"]
    assert {(o["image"], round(o["u"], 1), round(o["v"], 1)) for o in listed} <= here


def test_disabled_markers(tmp_path):
    path = tmp_path / "markers.xml"
    path.write_text(MARKERS)
    with warned("gcps.unposed", images=["z.jpg"]):
        found = read_ground_control(path, block(unposed=("z.jpg",)))
    assert found.names == ("P1", "P2")
    assert found.is_check.tolist() == [False, True]
    assert found.sigma_m.tolist() == [[0.02, 0.02, 0.05], [0.03] * 3]
    assert found.sigma_px.tolist() == [0.25] * 3
    assert found.camera.tolist() == [0, 1, 1]
    assert found.image_xy.tolist() == [[10.5, 20.25], [30, 40], [50, 60]]
    assert found.crs == "EPSG:32636"
    path.write_text(MARKERS.replace('marker_id="', 'marker_id="9'))
    with refused("gcps.none"):
        read_ground_control(path, block())


MARKERS = """<document version="2.0.0"><chunk label="c"><sensors/><cameras>
<camera id="4" label="a.jpg"/><camera id="5" label="b"/><camera id="6" label="z.jpg"/></cameras>
<markers>
<marker id="1" label="P1"><reference x="500010" y="4000010" z="2.5" sxy="0.02" sz="0.05"/></marker>
<group><marker id="2" label="P2">
<reference x="500020" y="4000010" z="1" enabled="false"/></marker></group>
<marker id="3" label="tie"/></markers>
<reference>EPSG:4326</reference><marker_reference>EPSG:32636</marker_reference>
<settings><property name="accuracy_markers" value="0.03"/>
<property name="accuracy_projections" value="0.25"/></settings>
<frames><frame id="0"><markers>
<marker marker_id="1"><location camera_id="4" pinned="true" x="10.5" y="20.25"/>
<location camera_id="5" pinned="true" x="30" y="40"/><location camera_id="6" x="1" y="1"/></marker>
<marker marker_id="2"><location camera_id="5" x="50" y="60"/>
<location camera_id="4" pinned="false" x="5" y="6"/></marker>
<marker marker_id="3"><location camera_id="5" x="50" y="60"/></marker>
</markers></frame></frames></chunk></document>
"""


def test_a_table(tmp_path):
    found = read(tmp_path, *ROWS)
    assert found.names == ("G1", "G2")
    assert found.xyz.tolist() == [list(XYZ["G1"]), list(XYZ["G2"])]
    assert found.point.tolist() == [0, 0, 1]
    assert found.camera.tolist() == [0, 1, 1]
    assert found.image_xy.tolist() == [[100.0, 200.0], [1600.0, 0.0], [0.5, 1199.5]]
    assert found.crs == "EPSG:32636"
    with warned("crs.assumed"):
        assert read(tmp_path, *ROWS, crs=None).xyz.tolist() == found.xyz.tolist()


def test_more_columns(tmp_path):
    head = (
        "Point;Easting [m];Northing [m];Height_(m);Photo;u_px;v_px;sx;sy;sz;su;sv;Type;under water"
    )
    rows = [
        "G10;500010;4000010;2.5;a;100;200;0.02;0.03;0.05;0.3;0.4;check point;yes",
        "G9;500030;4000020;-1.75;b;100;200;;;;;;Control;0",
    ]
    found = read(tmp_path, *rows, head=head)
    assert found.names == ("G10", "G9")  # the order of the file
    assert found.sigma_m.tolist() == [[0.02, 0.03, 0.05], [0.01] * 3]  # where none is stated
    assert found.sigma_px == pytest.approx([np.sqrt((0.09 + 0.16) / 2.0), 0.5])
    assert found.is_check.tolist() == [True, False]
    assert found.under_water.tolist() == [True, False]


@pytest.mark.parametrize("how", ["comment", "option"])
def test_its_own_crs(tmp_path, how):
    to_35 = Transformer.from_crs("EPSG:32636", "EPSG:32635", always_xy=True)
    rows = []
    for row in ROWS:
        name, x, y, *rest = row.split(",")
        x, y = to_35.transform(float(x), float(y))
        rows.append(",".join([name, f"{x:.5f}", f"{y:.5f}", *rest]))
    head = f"# CRS: EPSG:32635\n{HEAD}" if how == "comment" else HEAD
    found = read(tmp_path, *rows, head=head, crs="EPSG:32635" if how == "option" else None)
    # written to 0.01 mm
    assert found.xyz == pytest.approx(np.array(list(XYZ.values())), abs=2e-5)
    assert found.crs == "EPSG:32636"


def test_longitude_and_latitude(tmp_path):
    to_degrees = Transformer.from_crs("EPSG:32636", "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(*XYZ["G1"][:2])
    head = "name,latitude,longitude,ellipsoidal_height,image,u,v"
    path = write(tmp_path, f"G1,{lat:.11f},{lon:.11f},2.5,a.jpg,100,200", head=head)
    with pytest.warns(PcfixWarning, match="vertical datum"):
        found = read_ground_control(path, block())
    assert found.xyz[0] == pytest.approx(XYZ["G1"], abs=2e-6)


@pytest.mark.parametrize(
    "first", ["EPSG:32636", "WGS84 UTM 36N", "+proj=utm +zone=36 +datum=WGS84"]
)
@pytest.mark.parametrize("named", [True, False])
def test_odm(tmp_path, first, named):
    rows = []
    for row in ROWS:
        name, x, y, z, image, u, v = row.split(",")
        rows.append(f"{x}\t{y} {z} {u} {v} {image}" + (f" {name} more" if named else ""))
    path = write(tmp_path, "", *rows, head=first, name="gcp_list.txt")
    found = read_ground_control(path, block())
    assert found.names == (("G1", "G2") if named else ("GCP 1", "GCP 2"))
    assert found.xyz == pytest.approx(np.array(list(XYZ.values())), abs=1e-6)
    assert found.camera.tolist() == [0, 1, 1]
    assert found.image_xy.tolist() == [[100.0, 200.0], [1600.0, 0.0], [0.5, 1199.5]]


def test_unknown_images(tmp_path):
    rows = [*ROWS, "G2,500030.5,4000020.25,-1.75,z.jpg,5,6"]
    fails(tmp_path, rows, "gcps.unknown_image", point="G2", images=["z.jpg"])
    two = {"cameras": block(labels=("1/a.jpg", "2/a.jpg", "b.jpg"))}
    fails(tmp_path, ROWS, "images.ambiguous", two, image="a.jpg")
    unposed = {"cameras": block(labels=("q",), unposed=("a.jpg", "b.jpg"))}
    fails(tmp_path, ROWS, "gcps.no_pose", unposed)


def test_images_without_pose(tmp_path):
    rows = [*ROWS, "G3,500030,4000020,-1,z.jpg,5,6", "G1,500010,4000010,2.5,Z,5,6"]
    with pytest.warns(PcfixWarning) as given:
        found = read(tmp_path, *rows, cameras=block(unposed=("z.jpg",)))
    assert [one.message.code for one in given] == ["gcps.unposed"]
    assert found.names == ("G1", "G2")
    assert len(found.point) == 3


ON = [*(f"{row},control," for row in ROWS), "W1,,,,a.jpg,5,6,waterline,"]


def with_values(values):
    return [f"{row},{value}" for row, value in zip(ROWS, values.split(), strict=True)]


@pytest.mark.parametrize(
    ("more", "rows", "code"),
    [
        ("", [*ROWS, "G1,500010,4000010,2.6,c.jpg,1,2"], "gcps.contradiction"),
        ("", [*ROWS, "G1,500010,4000010,2.5,a.jpg,1,2"], "gcps.twice"),
        ("", [*ROWS, "G1,500010,4000010,2.5,A,1,2"], "images.ambiguous"),
        ("", [*ROWS, "G3,500010,4000010,2.5,c.jpg,1600.1,2"], "gcps.outside"),
        ("", [*ROWS, ",500010,4000010,1,c.jpg,1,5"], "gcps.no_name"),
        (",sigma", with_values("0.01 0.02 0.01"), "gcps.contradiction"),
        (",sigma", with_values("0 0 1"), "gcps.sigma"),
        (",role", with_values("check control check"), "gcps.contradiction"),
        (",role", with_values("tie tie tie"), "table.choice"),
        (",under_water", with_values("yes no yes"), "gcps.contradiction"),
        (",role,sigma_on", [*ON, "G3,,,,c.jpg,5,6,control,"], "gcps.no_coordinates"),
        (",role,sigma_on", [*ON, "W1,,,,b.jpg,5,6,on:floor,"], "gcps.contradiction"),
        (",role,sigma_on", [*ON, "W2,,,,b.jpg,5,6,waterline,0"], "gcps.sigma"),
    ],
)
def test_bad_rows(tmp_path, more, rows, code):
    fails(tmp_path, rows, code, {"head": HEAD + more})


def test_points_on_surfaces(tmp_path):
    head = f"{HEAD},role,sigma_on"
    rows = [
        *(f"{row},control," for row in ROWS),
        "W1,,,,a.jpg,5,6,Waterline,0.03", "W1,,,,b.jpg,7,8,waterline,0.03",
        "W2,500012,4000012,0.5,a.jpg,5,7,on:water,",
        "F1,,,,b.jpg,9,9,on:floor,",
    ]  # fmt: skip
    found = read(tmp_path, *rows, head=head)
    assert found.names == ("G1", "G2", "W1", "W2", "F1")
    assert found.on == ("", "", "water", "water", "floor")
    assert found.on_sigma_m.tolist() == [0.01, 0.01, 0.03, 0.01, 0.01]
    bare = np.array([False, False, True, False, True])
    assert (np.isnan(found.xyz).all(axis=1) == bare).all()
    assert (np.isinf(found.sigma_m).all(axis=1) == bare).all()
    assert not found.is_check.any()


@pytest.mark.parametrize("head", ["name,x,y,z", "name,x,y,z,image,u"])
def test_missing_columns(tmp_path, head):
    rows = [",".join(ROWS[0].split(",")[: head.count(",") + 1])]
    fails(tmp_path, rows, "table.column_missing", {"head": head})


def test_cameras_that_do_not_fit(tmp_path):
    bare = Cameras(("a.jpg", "b.jpg"), np.zeros((2, 3)))
    in_mm = Lens(3.6, 3.8, 2.8, 1.9, 1.4, unit="mm")
    turn = np.broadcast_to(np.eye(3), (2, 3, 3))
    film = Cameras(("a.jpg", "b.jpg"), np.zeros((2, 3)), turn, (in_mm,) * 2)
    for cameras in (bare, film):
        fails(tmp_path, ROWS, "cameras.no_lens", {"cameras": cameras})
    for crs in ("local", "ENU:1,2,3"):
        fails(tmp_path, ROWS, "crs.local", {"cameras": block(crs)})
    assert read(tmp_path, *ROWS, cameras=block("local"), crs="local").crs == "local"
    assert read(tmp_path, *ROWS, cameras=block(None), crs=None).crs is None


def test_points_far_away(tmp_path):
    rows = [row.replace("500010", "900010") for row in ROWS]
    fails(tmp_path, rows, "gcps.far", point="G1")
    rows = ["G1,4000010,500010,2.5,a.jpg,1,2"]
    fails(tmp_path, rows, "gcps.far")
    found = read(tmp_path, *rows, cameras=block("local"), crs="local")
    assert found.xyz.tolist() == [[4000010, 500010, 2.5]]
