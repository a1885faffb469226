"""BlocksExchange XML."""

import zipfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.lens.imaging import project
from tests.utils.camera_files import brown, read, read_ties
from tests.utils.codes import refused
from tests.utils.shared import needs

pytestmark = pytest.mark.quick_but(
    "test_fisheye", "test_local_frame_at_a_place_and_gnss", "test_perspective_lens"
)

ENU, enu = needs("cameras", "blocksexchange", "goodale_enu_one_photo", "AT_one_photo.xml")

# World to x right, y down, z forward of a camera that looks nearly down.
TURN = Rotation.from_euler("XYZ", (178.0, 3.0, 40.0), degrees=True).as_matrix().T
GROUP = """<Name>wide</Name>
<ImageDimensions><Width>6000</Width><Height>4000</Height></ImageDimensions>
<FocalLength>24</FocalLength><SensorSize>36</SensorSize>
<PrincipalPoint><x>3010</x><y>1990</y></PrincipalPoint>"""
SRS = "<SRS><Id>3</Id><Name>UTM</Name><Definition>EPSG:32632</Definition></SRS>"


def matrix(rotation=TURN):
    return "".join(
        f"<M_{i}{j}>{float(rotation[i][j])!r}</M_{i}{j}>" for i in range(3) for j in range(3)
    )


def photo(number=0, rotation=None, centre=(1, 2, 3), extra="", pose_extra="", component=""):
    turn = f"<Rotation>{matrix() if rotation is None else rotation}</Rotation>"
    x, y, z = centre
    place = f"<Center><x>{x}</x><y>{y}</y><z>{z}</z></Center>"
    part = f"<Component>{component}</Component>" if component else ""
    return (
        f"<Photo><Id>{number}</Id><ImagePath>D:\\flight\\p{number}.jpg</ImagePath>{part}"
        f"<Pose>{turn}{place}{pose_extra}</Pose>{extra}</Photo>"
    )


def group(*photos, head=GROUP):
    return f"<Photogroup>{head}{''.join(photos)}</Photogroup>"


def block(*groups, tail="", srs="<SRSId>3</SRSId>"):
    return f"<Block>{srs}<Photogroups>{''.join(groups)}</Photogroups>{tail}</Block>"


def document(*blocks, systems=SRS):
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="3.2">'
        f"<SpatialReferenceSystems>{systems}</SpatialReferenceSystems>{''.join(blocks)}"
        "</BlocksExchange>"
    )


def simple(*photos, head=GROUP, tail=""):
    return document(block(group(*photos, head=head), tail=tail))


def write(tmp_path, text, name="block.xml"):
    path = tmp_path / name
    path.write_text(text)
    return path


@enu
def test_local_frame_at_a_place_and_gnss():
    cameras = read(ENU)
    assert cameras.crs == "ENU:39.97523,-83.00678,0"
    assert cameras.gnss.crs == "EPSG:4326+5773"
    assert cameras.gnss.xyz[0] == pytest.approx([-83.0064163888889, 39.9752701666667, 157.918])
    assert cameras.rotations[0][2] == pytest.approx([-0.868160, -0.188568, -0.459064], abs=1e-6)


AXES = {"Right": (1, 0), "Left": (-1, 0), "Down": (0, 1), "Up": (0, -1)}


@pytest.mark.parametrize(
    "name",
    [
        *("XRightYDown", "XRightYUp", "XLeftYDown", "XLeftYUp"),
        *("XDownYRight", "XDownYLeft", "XUpYRight", "XUpYLeft"),
    ],
)
@pytest.mark.parametrize("angles", [False, True])
def test_camera_orientations(tmp_path, name, angles):
    # a point one metre along the camera's x must be seen where the name says that x points
    x, y = (AXES[word] for word in name[1:].split("Y"))
    omega, phi, kappa = (-5.0, 12.0, 33.0)
    world_to_camera = Rotation.from_euler("XYZ", (omega, phi, kappa), degrees=True).as_matrix().T
    rotation = matrix(world_to_camera)
    if angles:
        rotation = f"<Omega>{omega}</Omega><Phi>{phi}</Phi><Kappa>{kappa}</Kappa>"
    head = GROUP + f"<CameraOrientation>{name}</CameraOrientation>"
    cameras = read(write(tmp_path, simple(photo(rotation=rotation), head=head)))
    for axis, place in zip(world_to_camera[:2], (x, y), strict=True):
        assert cameras.rotations[0] @ axis == pytest.approx([*place, 0.0], abs=1e-12)
    assert np.linalg.det(cameras.rotations[0]) == pytest.approx(1.0)


BROWN = (
    "<Distortion><K1>0.1</K1><K2>-0.2</K2><K3>0.3</K3><P1>0.01</P1><P2>0.02</P2></Distortion>"
    "<AspectRatio>1.1</AspectRatio><Skew>5</Skew>"
)


@pytest.mark.parametrize(
    "focal",
    [
        "<FocalLength>24</FocalLength><SensorSize>36</SensorSize>",
        "<FocalLength>24</FocalLength><PixelSize>0.006</PixelSize>",
        "<FocalLengthPixels>4000</FocalLengthPixels>",
    ],
)
def test_perspective_lens(tmp_path, focal):
    head = GROUP.replace("<FocalLength>24</FocalLength><SensorSize>36</SensorSize>", focal)
    lens = read(write(tmp_path, simple(photo(), head=head + BROWN))).lenses[0]
    x, y = 0.2, -0.1
    xd, yd = brown(x, y, (0.1, -0.2, 0.3), (0.01, 0.02))
    expected = (3010.5 + 4000 * xd + 5 * yd, 1990.5 + 4400 * yd)
    assert project(lens, np.array([[x, y, 1.0]]))[0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("principal", "orientation", "expected"),
    [
        ("", "XRightYDown", (3000, 2000)),
        ("<xmm>0.06</xmm><ymm>-0.12</ymm>", "XRightYDown", (3010, 1980)),
        ("<xmm>0.06</xmm><ymm>-0.12</ymm>", "XRightYUp", (3010, 2020)),
        ("<xmm>0.06</xmm><ymm>-0.12</ymm>", "XDownYRight", (2980, 2010)),
    ],
)
def test_principal_point(tmp_path, principal, orientation, expected):
    head = GROUP[: GROUP.index("<PrincipalPoint>")]
    head += f"<PrincipalPoint>{principal}</PrincipalPoint>"
    head += f"<CameraOrientation>{orientation}</CameraOrientation>"
    lens = read(write(tmp_path, simple(photo(), head=head))).lenses[0]
    assert (lens.principal_x, lens.principal_y) == pytest.approx(expected)


EQUIDISTANT = "<CameraModelType>Fisheye</CameraModelType>"
MATRIX = (
    "<FisheyeFocalMatrix><M_00>1960</M_00><M_01>2</M_01><M_10>-3</M_10><M_11>1970</M_11>"
    "</FisheyeFocalMatrix>"
)
POLYNOMIAL = (
    "<FisheyeDistortion><P0>0</P0><P1>1</P1><P2>0.02</P2><P3>-0.1</P3><P4>0.01</P4>"
    "</FisheyeDistortion>"
)


@pytest.mark.parametrize("direction", [(0.3, 0.4, 1.0), (-2.0, 1.0, 0.1)])
@pytest.mark.parametrize("with_matrix", [True, False])
def test_fisheye(tmp_path, direction, with_matrix):
    """Without the matrix it is equidistant: pi / 2 times the focal length."""
    more = MATRIX + POLYNOMIAL if with_matrix else ""
    lens = read(write(tmp_path, simple(photo(), head=GROUP + EQUIDISTANT + more))).lenses[0]
    x, y, z = direction
    q = 2 / np.pi * np.arctan2(np.hypot(x, y), z)
    rho = q + 0.02 * q**2 - 0.1 * q**3 + 0.01 * q**4
    m = np.array([[1960, 2], [-3, 1970]])
    if not with_matrix:
        rho, m = q, np.pi / 2 * 4000 * np.eye(2)
    expected = [3010.5, 1990.5] + m @ (rho * np.array([x, y]) / np.hypot(x, y))
    assert project(lens, np.array([direction]))[0] == pytest.approx(expected)


def test_photos_without_a_pose_in_the_block_are_left_out(tmp_path):
    bare = "<Photo><Id>7</Id><ImagePath>bare.jpg</ImagePath><Component>0</Component></Photo>"
    only_position = photo(8, rotation="").replace("<Rotation></Rotation>", "")
    text = simple(photo(1), bare, only_position, photo(9, component=2), photo(2, component=1))
    cameras = read(write(tmp_path, text))
    assert cameras.labels == ("p1.jpg", "p2.jpg")
    assert sorted(cameras.unposed) == ["bare.jpg", "p8.jpg", "p9.jpg"]
    assert cameras.notes == ()
    assert cameras.crs == "EPSG:32632"


@pytest.mark.parametrize(
    ("definition", "crs"),
    [
        ("EPSG:32632+5773", "EPSG:32632+5773"),
        ("+proj=utm +zone=32 +datum=WGS84", "+proj=utm +zone=32 +datum=WGS84"),
        ("ENU:47.5,8.25", "ENU:47.5,8.25,0"),
        ("ENU:47.5,8.25,410.5", "ENU:47.5,8.25,410.5"),
        ("Local", "local"),
        ("", "local"),
        ('LOCAL_CS["Local coordinates",UNIT["m",1.0]]', "local"),
    ],
)
def test_reference_systems(tmp_path, definition, crs):
    systems = SRS.replace("EPSG:32632", definition)
    block_srs = "<SRSId>3</SRSId>" if definition else ""
    text = document(block(group(photo()), srs=block_srs), systems=systems)
    assert read(write(tmp_path, text)).crs == crs


TIE = (
    "<TiePoint><Position><x>1</x><y>2</y><z>3</z></Position>"
    "<Measurement><PhotoId>1</PhotoId><x>10</x><y>20</y></Measurement>"
    "<Measurement><PhotoId>99</PhotoId><x>1</x><y>1</y></Measurement>"
    "<Measurement><PhotoId>2</PhotoId><x>3110</x><y>1890</y></Measurement></TiePoint>"
    "<TiePoint><Measurement><PhotoId>2</PhotoId><x>0</x><y>0</y></Measurement></TiePoint>"
    "<TiePoint><SRSId>0</SRSId><Position><x>1</x><y>2</y><z>3</z></Position>"
    "<Measurement><PhotoId>2</PhotoId><x>5</x><y>6</y></Measurement></TiePoint>"
    "<TiePoint><Measurement><PhotoId>99</PhotoId><x>0</x><y>0</y></Measurement></TiePoint>"
)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("external", [False, True])
def test_tie_points(tmp_path, external, packed):
    inside = "<Path>TiePoints.xml</Path>" if external else TIE
    (tmp_path / "TiePoints.xml").write_text('<?xml version="1.0" encoding="utf-8"?>\n' + TIE)
    text = simple(photo(1), photo(2), tail=f"<TiePoints>{inside}</TiePoints>")
    path = write(tmp_path, text)
    if packed:
        with zipfile.ZipFile(tmp_path / "block.xmlz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.write(path, "block.xml")
        path = tmp_path / "block.xmlz"
    ties = read_ties(path)
    assert ties.views.start.tolist() == [0, 2, 3, 4]
    assert ties.views.camera.tolist() == [0, 1, 1, 1]
    expected = [[10.5, 20.5], [3110.5, 1890.5], [0.5, 0.5], [5.5, 6.5]]
    assert ties.image_xy == pytest.approx(np.array(expected))
    assert ties.xyz[0].tolist() == [1, 2, 3]
    assert np.isnan(ties.xyz[1:]).all()


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (simple(), "cameras.no_pose"),
        (simple(photo(), head=GROUP + "<InverseDistortion/>"), "cameras.unsupported"),
        (document(block(group(photo())), systems=""), "cameras.damaged"),
        (
            document(block(group(photo(1)), group(photo(2), head=GROUP + "<SRSId>0</SRSId>"))),
            "cameras.several_blocks",
        ),
        (simple(photo(1)), "cameras.no_tie_points"),
        (
            simple(photo(1), tail="<TiePoints><Path>gone.xml</Path></TiePoints>"),
            "cameras.missing_file",
        ),
    ],
)
def test_refused(tmp_path, text, code):
    with refused(code):
        read_ties(write(tmp_path, text))
