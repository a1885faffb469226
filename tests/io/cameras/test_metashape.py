"""Poses, lenses, GNSS positions, tie points and markers from Agisoft Metashape."""

import struct
import zipfile

import numpy as np
import pytest
from pyproj import CRS

from pcfix.lens.imaging import project
from pcfix.model import Lens
from tests.utils.camera_files import brown, notes, read, read_ties
from tests.utils.codes import refused

pytestmark = pytest.mark.quick_but(
    "test_fisheyes_have_the_distortion_of_a_frame_camera",
    "test_new_calibration",
    "test_old_calibration_is_absolute_and_in_the_order_of_opencv",
)


ONE = "1 0 0 {} 0 1 0 {} 0 0 1 {} 0 0 0 1"
QUARTER = "0 -1 0 1 0 0 0 0 1"  # a quarter turn about z: (x, y, z) goes to (-y, x, z)

UTM30 = CRS("EPSG:25830").to_wkt("WKT1_GDAL")
UTM30 = UTM30.replace('AUTHORITY["EPSG","6258"]', 'TOWGS84[0,0,0,0,0,0,0],AUTHORITY["EPSG","6258"]')
WGS84 = CRS("EPSG:4326").to_wkt("WKT1_GDAL")
GEOCENTRIC = CRS("EPSG:4978").to_wkt("WKT1_GDAL")


def calibration(inner="<f>100</f>", kind="frame", use="adjusted", size='width="60" height="40"'):
    return f'<calibration type="{kind}" class="{use}"><resolution {size}/>{inner}</calibration>'


def sensor(inner=None, number=0, attributes='type="frame"'):
    inner = calibration() if inner is None else inner
    return (
        f'<sensor id="{number}" label="S{number}" {attributes}>'
        f'<resolution width="60" height="40"/>{inner}</sensor>'
    )


def camera(number, inner=None, attributes='sensor_id="0"', label=None):
    inner = f"<transform>{ONE.format(1, 2, 3)}</transform>" if inner is None else inner
    name = f"img{number}.jpg" if label is None else label
    return f'<camera id="{number}" label="{name}" {attributes}>{inner}</camera>'


def transform(translation="10 20 30", rotation=QUARTER, scale="2"):
    return (
        f'<transform><rotation locked="true">{rotation}</rotation>'
        f"<translation>{translation}</translation><scale>{scale}</scale></transform>"
    )


def chunk(sensors=None, cameras=None, rest="", attributes='label="C" enabled="true"'):
    sensors = sensor() if sensors is None else sensors
    cameras = camera(0) if cameras is None else cameras
    return (
        f'<chunk {attributes}><sensors next_id="9">{sensors}</sensors>'
        f'<cameras next_id="9">{cameras}</cameras>{rest}</chunk>'
    )


def document(content, attributes='version="2.0.0"'):
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<document {attributes}>{content}</document>'


def same_crs(found, expected):
    """Whether two texts name one CRS, as a code or at length."""
    if "local" in (found, expected):
        return found == expected
    return found == expected or CRS(found).equals(CRS(expected), ignore_axis_order=True)


def write(tmp_path, content, name="cameras.xml"):
    path = tmp_path / name
    path.write_text(document(content))
    return path


def read_chunk(tmp_path, *args, **kwargs):
    return read(write(tmp_path, chunk(*args, **kwargs)))


def lens_of(tmp_path, inner, **kwargs):
    return read_chunk(tmp_path, sensors=sensor(inner, **kwargs)).lenses[0]


def put_zip(path, entries):
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return path


def ply(properties, rows, order="little"):
    kinds = {"float": "f", "int": "i", "uint": "I", "uint64": "Q", "uchar": "B"}
    head = "".join(f"property {kind} {name}\n" for kind, name in properties)
    layout = ("<" if order == "little" else ">") + "".join(kinds[k] for k, _ in properties)
    body = b"".join(struct.pack(layout, *row) for row in rows)
    text = f"ply\nformat binary_{order}_endian 1.0\nelement vertex {len(rows)}\n{head}end_header\n"
    return text.encode() + body


POINT = (("float", "x"), ("float", "y"), ("float", "z"), ("int", "id"))
MARK = (("float", "x"), ("float", "y"), ("float", "size"), ("int", "id"))


# The format


def test_scale_enters_the_centre_alone(tmp_path):
    cameras = read_chunk(tmp_path, rest=transform())
    assert cameras.centres.tolist() == [[10 - 2 * 2, 20 + 2 * 1, 30 + 2 * 3]]
    assert cameras.rotations[0] == pytest.approx(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
    assert cameras.crs == "local"
    assert cameras.notes == ()


@pytest.mark.parametrize(
    ("wkt", "crs", "project_crs"),
    [
        (UTM30, "EPSG:4936", UTM30),
        (WGS84, "EPSG:4978", WGS84),
        (GEOCENTRIC, "EPSG:4978", "EPSG:4978"),
        ("EPSG::32630", "EPSG:4978", "EPSG::32630"),
        (
            f'COMPD_CS["x",{UTM30},VERT_CS["h",VERT_DATUM["h",2005],UNIT["metre",1]]]',
            "EPSG:4936",
            1,
        ),
        ('LOCAL_CS["Local",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]', "local", None),
        ("LOCAL", "local", None),
    ],
)
def test_world_of_each_kind_of_crs(tmp_path, wkt, crs, project_crs):
    place = "4932318 -32706 4030484"
    cameras = read_chunk(tmp_path, rest=transform(place) + f"<reference>{wkt}</reference>")
    assert same_crs(cameras.crs, crs)
    if project_crs is None:
        assert cameras.project_crs is None
    else:
        assert same_crs(cameras.project_crs, wkt if project_crs == 1 else project_crs)
    assert cameras.centres.tolist() == [[4932318 - 4, -32706 + 2, 4030484 + 6]]


def components(*inner, active=0):
    each = "".join(f'<component id="{i}">{part}</component>' for i, part in enumerate(inner))
    return f'<components next_id="9" active_id="{active}">{each}</components>'


TWO = camera(0, attributes='sensor_id="0" component_id="0"') + camera(
    1, attributes='sensor_id="0" component_id="1"'
)


@pytest.mark.parametrize(
    ("rest", "labels", "centres", "codes"),
    [
        (
            components(transform(), transform("0 0 0", "1 0 0 0 1 0 0 0 1", "10")) + transform(),
            ("img0.jpg", "img1.jpg"),
            [[6, 22, 36], [10, 20, 30]],
            [],
        ),
        (components(transform(), ""), ("img0.jpg",), [[6, 22, 36]], ["cameras.left_out"]),
        (components("", "", active=1), ("img1.jpg",), [[1, 2, 3]], ["cameras.left_out"]),
        (
            components("", "", active=1) + transform(),
            ("img1.jpg",),
            [[6, 22, 36]],
            ["cameras.left_out"],
        ),
    ],
)
def test_components(tmp_path, rest, labels, centres, codes):
    """A component has its own transform, or that of the chunk where it is the active one."""
    cameras = read_chunk(tmp_path, cameras=TWO, rest=rest)
    assert (cameras.labels, cameras.centres.tolist()) == (labels, centres)
    assert notes(cameras) == codes
    assert len(cameras) + len(cameras.unposed) == 2


def test_slave_sits_on_its_master(tmp_path):
    slave = sensor(
        calibration()
        + f"<rotation>{QUARTER}</rotation><rotation_covariance>1 2</rotation_covariance>"
        + "<location>0.5 0 0</location><location_covariance>1 2</location_covariance>",
        number=1,
        attributes='type="frame" master_id="0"',
    )
    master = camera(7, "<transform>0 -1 0 1 1 0 0 2 0 0 1 3 0 0 0 1</transform>")
    cameras = read_chunk(
        tmp_path,
        sensors=sensor() + slave,
        cameras=camera(8, "", 'sensor_id="1" master_id="7"') + master,
    )
    assert cameras.labels == ("img8.jpg", "img7.jpg")
    # half a unit along the master's x axis, which is the chunk's y axis
    assert cameras.centres.tolist() == [[1.0, 2.5, 3.0], [1.0, 2.0, 3.0]]
    # two quarter turns
    assert cameras.rotations[0] == pytest.approx(np.diag([-1.0, -1.0, 1.0]))
    assert [lens.sensor for lens in cameras.lenses] == ["S1", "S0"]


def test_groups_keyframes_disabled_spherical_and_repeated_labels(tmp_path):
    images = (
        f'<group id="0" type="folder">{camera(0)}<group id="1">{camera(1)}</group></group>'
        + camera(2, attributes='sensor_id="0" enabled="false"')
        + camera(3, "", 'sensor_id="0" enabled="false"')
        + camera(4, attributes='sensor_id="0" type="keyframe"')
        + camera(5, label="img0.jpg", attributes='sensor_id="0" enabled="true"')
        + camera(6, attributes='sensor_id="1"')
    )
    spherical = sensor(calibration(kind="spherical"), 1, 'type="spherical"')
    cameras = read_chunk(tmp_path, sensors=sensor() + spherical, cameras=images)
    assert cameras.labels == ("img0.jpg", "img1.jpg", "img0.jpg")
    assert cameras.unposed == ("img2.jpg", "img3.jpg", "img6.jpg")
    assert notes(cameras) == ["cameras.left_out"]


# Lenses


def test_new_calibration(tmp_path):
    inner = (
        "<f>100</f><cx>3</cx><cy>-4</cy><b1>0.5</b1><b2>0.25</b2><k1>0.1</k1><k2>0.2</k2>"
        "<k3>0.3</k3><k4>0.4</k4><p1>0.01</p1><p2>0.02</p2><p3>0.03</p3><p4>0.04</p4>"
    )
    size = '<property name="pixel_width" value="0.005"/>'
    lens = lens_of(tmp_path, size + calibration(inner))
    assert lens == Lens(
        *(100.0, 60.0, 40.0, 33.0, 16.0, 0.5, 0.25),
        radial=(0.1, 0.2, 0.3, 0.4),
        tangential=(0.01, 0.02, 0.03, 0.04),
        sensor="S0",
    )
    # the manual's formula, written out again
    x, y = 0.2, -0.1
    more = 1 + 0.03 * 0.05 + 0.04 * 0.05**2
    xd, yd = brown(x, y, (0.1, 0.2, 0.3, 0.4), (0.01 * more, 0.02 * more))
    u = 60 * 0.5 + 3 + xd * 100 + xd * 0.5 + yd * 0.25
    v = 40 * 0.5 - 4 + yd * 100
    assert project(lens, np.array([[2 * x, 2 * y, 2.0]]))[0] == pytest.approx([u, v], abs=1e-9)


def test_old_calibration_is_absolute_and_in_the_order_of_opencv(tmp_path):
    inner = (
        "<fx>101</fx><fy>100</fy><cx>33</cx><cy>16</cy><skew>0.25</skew><k1>0.1</k1>"
        "<p1>0.01</p1><p2>0.02</p2>"
    )
    lens = lens_of(tmp_path, calibration(inner))
    x, y = 0.2, -0.1
    xd, yd = brown(x, y, (0.1,), (0.02, 0.01))
    expected = [33 + 101 * xd + 0.25 * yd, 16 + 100 * yd]
    assert project(lens, np.array([[x, y, 1.0]]))[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("kind", "radius"),
    [
        ("fisheye", lambda theta: theta),
        ("equidistant_fisheye", lambda theta: theta),
        ("equisolid_fisheye", lambda theta: 2 * np.sin(theta / 2)),
    ],
)
def test_fisheyes_have_the_distortion_of_a_frame_camera(tmp_path, kind, radius):
    inner = calibration("<f>20</f><k1>0.1</k1>", kind=kind)
    lens = lens_of(tmp_path, inner, attributes=f'type="{kind}"')
    theta = 0.8
    r = radius(theta)
    expected = [30 + 20 * r * (1 + 0.1 * r * r), 20.0]
    ray = np.array([[np.sin(theta), 0.0, np.cos(theta)]])
    assert project(lens, ray)[0] == pytest.approx(expected, abs=1e-9)


def test_additional_corrections_are_ignored(tmp_path):
    corrections = '<corrections type="fourier"><coeffs>3 4 0 0</coeffs></corrections>'
    cameras = read_chunk(tmp_path, sensors=sensor(calibration("<f>9</f>" + corrections)))
    assert notes(cameras) == ["cameras.corrections"]


# GNSS


def reference(attributes, pose=True):
    transform = f"<transform>{ONE.format(1, 2, 3)}</transform>" if pose else ""
    return f"{transform}<reference {attributes}/>"


def test_gnss_positions_and_their_accuracy(tmp_path):
    images = (
        camera(0, reference('x="-0.5" y="39" z="100" enabled="true"'))
        + camera(1, reference('x="-0.6" y="39" z="101" sxyz="3"'))
        + camera(2, reference('x="-0.7" y="39" z="102" sxy="1" sz="2"'))
        + camera(3, reference('x="-0.8" y="39" enabled="true" sx="4"'))
        + camera(4, reference('x="-0.9" y="39" z="104" enabled="false"'))
        + camera(5)
    )
    settings = (
        '<settings><property name="accuracy_cameras" value="10"/>'
        '<property name="accuracy_cameras_z" value="20"/></settings>'
    )
    rest = f"<reference>{UTM30}</reference><camera_reference>{WGS84}</camera_reference>"
    gnss = read_chunk(tmp_path, cameras=images, rest=rest + settings).gnss
    assert gnss.crs == WGS84
    none = np.nan
    xyz = [[-0.5, 39, 100], [-0.6, 39, 101], [-0.7, 39, 102], [-0.8, 39, none]]
    np.testing.assert_allclose(gnss.xyz, [*xyz, [none] * 3, [none] * 3], rtol=1e-12)
    sigma = [[10, 10, 20], [3, 3, 3], [1, 1, 2], [4, 10, none], [none] * 3, [none] * 3]
    np.testing.assert_allclose(gnss.sigma_m, sigma, rtol=1e-12)


# Projects


def project_of(tmp_path, chunks, active=0, frame="<frame></frame>", entries=None):
    """Write a .psx with its folder; `chunks` are chunk elements, `entries` the tie points."""
    folder = tmp_path / "river.files"
    listed = "".join(f'<chunk id="{i}" path="{i}/chunk.zip"/>' for i in range(len(chunks)))
    top = document(f'<chunks next_id="9" active_id="{active}">{listed}</chunks>')
    put_zip(folder / "project.zip", {"doc.xml": top})
    for i, content in enumerate(chunks):
        put_zip(folder / f"{i}/chunk.zip", {"doc.xml": content})
        put_zip(folder / f"{i}/0/frame.zip", {"doc.xml": frame})
        if entries is not None:
            put_zip(folder / f"{i}/0/point_cloud/point_cloud.zip", entries)
    path = tmp_path / "river.psx"
    path.write_text(document("", 'version="1.2.0" path="{projectname}.files/project.zip"'))
    return path


FRAMES = '<frames next_id="1"><frame id="0" path="0/frame.zip"/></frames>'


def test_active_chunk(tmp_path):
    chunks = [
        chunk(attributes='label="one"'),
        chunk(attributes='label="two"', cameras=camera(5)),
        chunk(attributes='label="empty"', cameras=camera(6, "")),
    ]
    cameras = read(project_of(tmp_path, chunks, active=1))
    assert cameras.labels == ("img5.jpg",)
    assert cameras.notes[0].values.items() >= {"chunk": "two", "others": ["one"]}.items()
    path = project_of(tmp_path, chunks[::-1][:2])  # the first is empty
    assert read(path).labels == ("img5.jpg",)
    assert read(tmp_path / "river.files/1/chunk.zip").labels == ("img5.jpg",)


# Tie points


TIES = (
    '<point_cloud version="1.7.0"><tracks path="tracks.ply" count="9"/>'
    '<points component_id="0" path="points0.ply"/><points component_id="1" path="points1.ply"/>'
    '<projections camera_id="0" path="p0.ply"/><projections camera_id="1" path="p1.ply"/>'
    '<projections camera_id="2" path="p2.ply"/><projections camera_id="9" path="p9.ply"/>'
    "</point_cloud>"
)
MARKERS = (
    '<markers><marker marker_id="0"><location camera_id="0" pinned="true" x="1.5" y="2.5"/>'
    '<location camera_id="1" pinned="false" x="9" y="9"/><location camera_id="77" x="9" y="9"/>'
    '</marker><marker marker_id="1"><location camera_id="1" pinned="false" x="9" y="9"/></marker>'
    '<marker marker_id="2"><location camera_id="2" x="3" y="4"/>'
    '<location camera_id="0" valid="false" x="9" y="9"/></marker></markers>'
)


def tie_project(tmp_path):
    """A project with two components, of which the second is ten times as large in its frame."""
    images = (
        camera(0, attributes='sensor_id="0" component_id="0"')
        + camera(1, attributes='sensor_id="0" component_id="0"')
        + camera(2, attributes='sensor_id="0" component_id="1"')
    )
    rest = components(transform(), transform("0 0 0", scale="10")) + FRAMES
    frame = f'<frame>{MARKERS}<point_cloud path="point_cloud/point_cloud.zip"/></frame>'
    newer = (*MARK, ("float", "z"), ("uint64", "keypoint"))
    entries = {
        "doc.xml": TIES,
        "points0.ply": ply(POINT, [(1, 2, 3, 7), (4, 5, 6, 4)]),
        "points1.ply": ply(POINT, [(1, 0, 0, 7)], order="big"),
        "p0.ply": ply(MARK, [(10, 11, 1, 4), (12, 13, 1, 5), (14, 15, 1, 7)]),
        "p1.ply": ply(newer, [(20, 21, 1, 7, -1, 3)]),
        "p2.ply": ply(MARK, [(30, 31, 1, 7)]),
    }
    return project_of(tmp_path, [chunk(cameras=images, rest=rest)], frame=frame, entries=entries)


def test_tie_points_of_components_and_markers(tmp_path):
    ties = read_ties(tie_project(tmp_path))
    none = [np.nan] * 3
    assert ties.xyz == pytest.approx(
        np.array([[6, 22, 36], [0, 28, 42], [0, 10, 0], none, none]), nan_ok=True
    )
    assert ties.views.start.tolist() == [0, 2, 3, 4, 5, 6]
    assert ties.views.camera.tolist() == [0, 1, 0, 2, 0, 2]
    assert ties.image_xy.tolist() == [[14, 15], [20, 21], [10, 11], [30, 31], [1.5, 2.5], [3, 4]]


# Bad input


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (chunk(cameras=camera(0, "")), "cameras.no_pose"),
        ("<chunks/>", "cameras.no_pose"),
        (chunk(sensors=""), "cameras.damaged"),
        (chunk(sensors=sensor(calibration(""))), "cameras.lens"),
        (chunk(cameras=camera(0, "<transform>1 2 3</transform>")), "cameras.damaged"),
        (chunk(rest=transform(rotation="1 0 0 0 1 0 0 0 2")), "cameras.rotation"),
    ],
)
def test_refused(tmp_path, content, code):
    path = write(tmp_path, content)
    with refused(code, path=path):
        read(path)
