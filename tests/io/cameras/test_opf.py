"""OPF: what images saw by its own formulas falls where the reader's cameras see it."""

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.io.cameras import read_tie_points
from pcfix.model import Cameras, Lens
from tests.utils.camera_files import brown
from tests.utils.codes import refused
from tests.utils.opf_files import FIRST_ID, Base, shift_of
from tests.utils.opf_files import opf as write
from tests.utils.reprojection import bring_to, tie_point_residuals_px

pytestmark = pytest.mark.quick_but("test_refused", "test_tracks_fall_where_the_images_saw_them")

RADIAL, T1, T2 = (-0.05, 0.02, -0.003), 0.004, -0.002
POLYNOMIAL, AFFINE = (0.01, 1.0, 0.02, -0.1), (1810.0, 3.0, -2.0, 1800.0)
SIZE = (4000, 3000)
# Of a pixel coordinate below 4096, and of points some tens of metres from their node.
FLOAT32_PX = 3e-4


def seen(kind, angles_deg, centre, point):
    """Return u, v by the specification, one point at a time: R = Rx Ry Rz, then the lens."""
    turn = Rotation.from_euler("XYZ", angles_deg, degrees=True)
    right, top, back = turn.inv().apply(point - centre)
    x, y, z = right, -top, -back
    cx, cy = SIZE[0] / 2 + 11.0, SIZE[1] / 2 - 7.0
    if kind == "fisheye":
        theta = 2.0 / math.pi * math.atan2(math.hypot(x, y), z)
        rho = sum(p * theta**i for i, p in enumerate(POLYNOMIAL)) / math.hypot(x, y)
        c, d, e, f = AFFINE
        return c * rho * x + d * rho * y + cx, e * rho * x + f * rho * y + cy
    u, v = brown(x / z, y / z, RADIAL, (T2, T1))
    return 3000.0 * u + cx, 3000.0 * v + cy


LENSES = {
    "perspective": {
        "type": "perspective", "focal_length_px": 3000.0, "radial_distortion": list(RADIAL),
        "tangential_distortion": [T1, T2],
    },
    "fisheye": {
        "type": "fisheye", "affine": list(AFFINE), "polynomial": list(POLYNOMIAL),
        "is_symmetric_affine": False, "is_p0_zero": False,
    },
}  # fmt: skip
PLACES = np.array([[500_000.0, 5_200_000.0, 480.0], [500_012.5, 5_200_003.0, 481.0]])
ANGLES = np.array([[12.0, -8.0, 101.0], [-20.0, 15.0, -37.0]])


def change(folder, name, **values):
    """Change what a part of a project has at its top."""
    path = folder / name
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.fixture
def make(tmp_path):
    """Write a project of two obliques with tracks, of a kind of lens, in a base CRS."""

    def made(kind="perspective", base=None, epsg=32632, places=PLACES):
        up_back = Rotation.from_euler("XYZ", ANGLES, degrees=True).as_matrix()
        rotations = (up_back @ np.diag([1.0, -1.0, -1.0])).transpose(0, 2, 1)
        lens = Lens(3000.0, *SIZE, SIZE[0] / 2, SIZE[1] / 2)
        labels = ("a b.jpg", "b.jpg")
        block = Cameras(labels, places, rotations, (lens,) * 2, f"EPSG:{epsg}")
        noise = np.random.default_rng(1).uniform(-6.0, 6.0, (30, 3))
        xyz = places.mean(axis=0) - [0.0, 0.0, 60.0] + noise
        # as the file rounds them, so that they are seen where they are
        shift = shift_of(block)
        middle = np.round(np.median(xyz + shift, axis=0))
        xyz = (xyz + shift - middle).astype("<f4") + middle - shift
        point, camera = np.repeat(np.arange(30), 2)[:-1], np.tile([0, 1], 30)[:-1]
        uv = np.array(
            [seen(kind, ANGLES[c], places[c], xyz[p]) for p, c in zip(point, camera, strict=True)]
        )
        path = write(tmp_path, block, base, (xyz, point, camera, uv))
        middle_px = [SIZE[0] / 2 + 11.0, SIZE[1] / 2 - 7.0]
        inner = LENSES[kind] | {"principal_point_px": middle_px}
        change(tmp_path, "calibrated-cameras.json", sensors=[{"id": 7, "internals": inner}])
        return path, xyz

    return made


@pytest.mark.parametrize("kind", LENSES)
def test_tracks_fall_where_the_images_saw_them(make, kind):
    path, xyz = make(kind)
    cameras = pcfix.read_cameras(path)
    ties = read_tie_points(path, cameras)
    assert ties.xyz == pytest.approx(xyz, abs=1e-5)
    assert np.diff(ties.views.start).tolist() == [2] * 29 + [1]
    misses = tie_point_residuals_px(cameras, ties)
    assert len(misses) == 59
    assert misses.max() < FLOAT32_PX
    assert cameras.labels == ("a b.jpg", "b.jpg")


@pytest.mark.parametrize("given", ["folder", "project.opf", "calibrated-cameras.json"])
def test_project_folder_and_calibration_are_one_block(make, tmp_path, given):
    path, _ = make()
    found = pcfix.read_cameras(tmp_path if given == "folder" else tmp_path / given)
    assert (found.centres == pcfix.read_cameras(path).centres).all()
    assert found.crs == pcfix.read_cameras(path).crs


FOOT = 1200.0 / 3937.0
BASES = {
    "metres, heights above a geoid": (Base("EPSG:32632+5773"), 32632, [1.0, 1.0, 1.0]),
    "northing before easting": (Base("EPSG:31467", north_first=True), 31467, [1.0, 1.0, 1.0]),
    "feet": (Base("EPSG:6434", plan_m=FOOT, up_m=FOOT), 6434, [FOOT, FOOT, 1.0]),
    "feet, as EPSG+EPSG": (
        Base("EPSG:6434+EPSG:6360", plan_m=FOOT, up_m=FOOT), 6434, [FOOT, FOOT, FOOT],
    ),
    "metres in plan, feet up": (Base("EPSG:32618+6360", up_m=FOOT), 32618, [1.0, 1.0, FOOT]),
}  # fmt: skip


@pytest.mark.parametrize("name", BASES)
def test_out_of_the_processing_frame_into_the_crs(make, name):
    """Centres in the units of the CRS, east before north; axes stay east, north, up."""
    base, epsg, unit_m = BASES[name]
    places = np.array([[303_000.0, 212_000.0, 60.0], [303_012.5, 212_003.0, 61.0]])
    if epsg == 31467:
        places = PLACES + np.array([3_000_000.0, 0.0, 0.0])
    path, _ = make(base=base, epsg=epsg, places=places)
    cameras = pcfix.read_cameras(path)
    assert cameras.centres * unit_m == pytest.approx(places, abs=1e-6)
    there = bring_to(cameras, None)
    assert there.centres * unit_m == pytest.approx(places, abs=1e-6)
    plain, _ = make()
    turned = pcfix.read_cameras(plain).rotations.transpose(0, 2, 1) @ cameras.rotations
    assert turned == pytest.approx(np.tile(np.eye(3), (2, 1, 1)), abs=1e-9)


def test_an_arbitrary_frame_is_local(make, tmp_path):
    path, _ = make()
    local = (
        'ENGINEERINGCRS["site",ENGINEERINGDATUM["corner"],CS[Cartesian,3],AXIS["x",east],'
        'AXIS["y",north],AXIS["z",up],LENGTHUNIT["metre",1]]'
    )
    change(tmp_path, "scene-reference-frame.json", crs={"definition": local})
    assert pcfix.read_cameras(path).crs == "local"
    project = json.loads(path.read_text())
    project["items"] = [i for i in project["items"] if i["type"] != "scene_reference_frame"]
    path.write_text(json.dumps(project))
    assert pcfix.read_cameras(path).crs == "local"


def test_gnss_is_of_the_reference_camera_east_before_north(make, tmp_path):
    """Coordinates are in the order of the CRS, standard deviations metres."""
    path, _ = make()
    cameras = [{"id": FIRST_ID + i} for i in range(3)]
    place = {
        "crs": {"definition": "EPSG:4326"}, "coordinates": [46.95, 9.0, 512.0],
        "sigmas": [0.02, 0.03, 0.05],
    }  # fmt: skip
    capture = {
        "id": 1, "reference_camera_id": FIRST_ID + 1, "cameras": cameras, "geolocation": place,
    }  # fmt: skip
    change(tmp_path, "input-cameras.json", captures=[capture])
    found = pcfix.read_cameras(path)
    assert np.isnan(found.gnss.xyz[0]).all()
    assert found.gnss.xyz[1].tolist() == [9.0, 46.95, 512.0]
    assert found.gnss.sigma_m[1].tolist() == [0.03, 0.02, 0.05]
    assert found.unposed == (f"camera {FIRST_ID + 2}",)


@pytest.mark.parametrize(
    ("part", "values", "code"),
    [
        ("project.opf", {"items": []}, "cameras.damaged"),
        (
            "calibrated-cameras.json",
            {"sensors": [{"id": 7, "internals": {"type": "x", "principal_point_px": [1, 2]}}]},
            "cameras.unsupported",
        ),
        ("scene-reference-frame.json", {"crs": {"definition": "nowhere"}}, "cameras.crs"),
    ],
)
def test_refused(make, tmp_path, part, values, code):
    path, _ = make()
    change(tmp_path, part, **values)
    with refused(code):
        pcfix.read_cameras(path)
