"""OpenDroneMap's projects."""

import json

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from tests.utils.camera_files import read, read_ties
from tests.utils.codes import refused
from tests.utils.geodesy import axes_at

pytestmark = pytest.mark.quick

UTM15 = "+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs +type=crs"
CRS, EAST, NORTH = "EPSG:32632", 680000, 5210000  # 2.4 degrees east of the meridian
TO_UTM = Transformer.from_crs("EPSG:4979", CRS, always_xy=True)
TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
LON, LAT = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(EAST, NORTH)
CAMERA = {
    **{"projection_type": "brown", "width": 4000, "height": 3000, "focal_x": 0.8, "focal_y": 0.8},
    **{"k1": -0.1, "p1": 0.001},
}
DOWN = [np.pi, 0.0, 0.0]
PLACES = np.array([[0, 0, 100], [150, 20, 110], [-40, 200, 105], [90, -180, 95]], dtype=float)


def exact_utm(enu, lon=LON, lat=LAT):
    """Topocentric to UTM by way of the earth's centre."""
    ecef = np.array(TO_ECEF.transform(lon, lat, 0.0)) + enu @ axes_at(lon, lat)
    return np.column_stack(TO_UTM.transform(*TO_ECEF.transform(*ecef.T, direction="INVERSE")))


def reconstruction(places, lon=LON, lat=LAT, gnss=None, points=None):
    shifts = -Rotation.from_rotvec(DOWN).apply(places)
    shots = {
        f"{i}.jpg": {"camera": "c", "rotation": DOWN, "translation": list(shift)}
        for i, shift in enumerate(shifts)
    }
    for i, place in enumerate([] if gnss is None else gnss):
        shots[f"{i}.jpg"] |= {"gps_position": list(place), "gps_dop": 0.1}
    lla = {"latitude": lat, "longitude": lon, "altitude": 0.0}
    return [
        {"cameras": {"c": CAMERA}, "shots": shots, "reference_lla": lla, "points": points or {}}
    ]


def geojson(places, lonlat=None, **more):
    features = [
        {
            "type": "Feature",
            "properties": {
                **{"filename": f"{i}.jpg", "focal": 0.8, "width": 4000, "height": 3000},
                **{"translation": list(place), "rotation": DOWN, **more},
            },
            "geometry": {"type": "Point", "coordinates": list((lonlat or {}).get(i, (8, 47, 9)))},
        }
        for i, place in enumerate(places)
    ]
    return {"type": "FeatureCollection", "features": features}


def project(tmp_path, **files):
    """Write a project; names with __ for / and without suffix."""
    places = {
        "reconstruction": "opensfm/reconstruction.json",
        "topocentric": "opensfm/reconstruction.topocentric.json",
        "transformation": "opensfm/geocoords_transformation.txt",
        "tracks": "opensfm/tracks.csv",
        "shots": "odm_report/shots.geojson",
        "proj": "odm_georeferencing/proj.txt",
        "coords": "odm_georeferencing/coords.txt",
        "cameras": "cameras.json",
        "images": "images.json",
    }
    for name, content in files.items():
        path = tmp_path / places[name]
        path.parent.mkdir(exist_ok=True)
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return tmp_path


def test_whole_metres_in_the_crs_that_the_project_names(tmp_path):
    lon, lat = Transformer.from_crs("EPSG:25833", "EPSG:4326", always_xy=True).transform(2e5, 52e5)
    coords = "EPSG:25833\n200000 5200000\n"
    path = project(tmp_path, reconstruction=reconstruction(PLACES, lon, lat), coords=coords)
    cameras = read(path)
    assert cameras.centres == pytest.approx(np.add(PLACES, [2e5, 52e5, 0]), abs=1e-6)
    assert cameras.crs == "EPSG:25833"


def test_any_other_reference_means_topocentric(tmp_path):
    path = project(
        tmp_path, reconstruction=reconstruction(PLACES, LON + 1e-4), proj=UTM15.replace("15", "32")
    )
    cameras = read(path)
    assert cameras.centres == pytest.approx(PLACES)
    assert cameras.crs == f"ENU:{LAT!r},{LON + 1e-4!r},0.0"
    assert cameras.project_crs == UTM15.replace("15", "32")


def test_shots_tell_a_topocentric_reconstruction_from_a_moved_one(tmp_path):
    path = project(
        tmp_path, reconstruction=reconstruction(PLACES), shots=geojson(exact_utm(PLACES))
    )
    cameras = read(path)
    assert cameras.centres == pytest.approx(PLACES)
    assert (cameras.crs, cameras.project_crs) == (f"ENU:{LAT!r},{LON!r},0.0", CRS)


@pytest.mark.parametrize("moved", [False, True])
def test_gnss_tells_a_topocentric_reconstruction_from_a_moved_one(tmp_path, moved):
    noise = np.random.default_rng(1).normal(0.0, 0.3, PLACES.shape)
    places = exact_utm(PLACES) - [EAST, NORTH, 0] if moved else PLACES
    path = project(tmp_path, reconstruction=reconstruction(places, gnss=PLACES + noise))
    cameras = read(path)
    assert cameras.crs.startswith("EPSG:32632" if moved else "ENU:")
    assert cameras.gnss.xyz == pytest.approx(PLACES + noise)
    assert cameras.gnss.crs.startswith("ENU:")


def transformation(lon, lat):
    """The affine map of export_geocoords: images of the origin and the unit vectors."""
    steps = exact_utm(np.vstack([np.eye(3), np.zeros(3)]), lon, lat)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = (steps[:3] - steps[3]).T, steps[3]
    return "\n".join(" ".join(map(repr, row)) for row in matrix.tolist()) + "\n"


@pytest.mark.parametrize("named", [True, False])
def test_transformation_is_applied_to_poses_and_points(tmp_path, named):
    lon, lat = LON + 1e-4, LAT + 1e-4
    path = project(
        tmp_path,
        reconstruction=reconstruction(PLACES, lon, lat, points={"1": {"coordinates": [9, 8, 7]}}),
        transformation=transformation(lon, lat),
        tracks="0.jpg\t1\t0\t0.1\t0.2\n",
        coords="WGS84 UTM 32N\n680000 5210000\n" if named else "WGS84 UTM 32N\n",
    )
    cameras = read(path)
    assert cameras.crs == CRS
    assert cameras.centres == pytest.approx(exact_utm(PLACES, lon, lat), abs=0.02)
    points = read_ties(path)
    assert points.xyz == pytest.approx(exact_utm(np.array([[9.0, 8, 7]]), lon, lat), abs=1e-3)
    ray = Rotation.from_rotvec(DOWN).apply([9.0, 8.0, 7.0] - PLACES[1])
    turned = cameras.rotations[1] @ (points.xyz[0] - cameras.centres[1])
    assert turned == pytest.approx(ray, abs=0.1)  # the map scales in plan by 0.9996


def test_transformation_of_another_origin_is_not_used(tmp_path):
    path = project(
        tmp_path,
        reconstruction=reconstruction(PLACES),
        transformation=transformation(LON + 0.01, LAT),
        coords="WGS84 UTM 32N\n",
    )
    assert read(path).centres == pytest.approx(np.add(PLACES, [EAST, NORTH, 0]), abs=1e-6)


def test_crs_of_shots_follows_from_their_longitude_and_latitude(tmp_path):
    places = np.add(PLACES, [EAST, NORTH, 0])
    shots = geojson(places, {0: (LON, LAT, 100)})
    assert read(project(tmp_path, shots=shots)).crs == CRS


def test_lens_by_name_or_by_size_and_focal_length(tmp_path):
    other = {**CAMERA, "k1": 0.3}
    path = project(
        tmp_path, shots=geojson(PLACES, camera="two"), cameras={"one": CAMERA, "two": other}
    )
    assert read(path).lenses[0].radial[0] == 0.3
    project(tmp_path, shots=geojson(PLACES), cameras={"one": CAMERA, "x": {**other, "width": 400}})
    assert read(path).lenses[0].radial[0] == -0.1


def test_images_without_pose_and_their_gnss(tmp_path):
    images = [
        {"filename": "9.jpg", "latitude": LAT, "longitude": LON, "altitude": 100},
        {"filename": "1.jpg", "latitude": LAT, "longitude": LON, "altitude": 99}
        | {"gps_xy_stddev": 0.02, "gps_z_stddev": 0.04},
        {"filename": "2.jpg", "latitude": None, "longitude": None, "altitude": None},
    ]
    cameras = read(project(tmp_path, reconstruction=reconstruction(PLACES), images=images))
    assert cameras.unposed == ("9.jpg",)
    assert cameras.gnss.xyz[1] == pytest.approx([LON, LAT, 99])
    assert cameras.gnss.sigma_m[1] == pytest.approx([0.02, 0.02, 0.04])
    assert np.isnan(cameras.gnss.xyz[[0, 2, 3]]).all()


@pytest.mark.parametrize(
    ("files", "code"),
    [
        ({"shots": geojson(PLACES, filename="0.jpg")}, "cameras.damaged"),
        ({"shots": geojson(PLACES), "proj": "+proj=nowhere"}, "cameras.crs"),
        (
            {"reconstruction": reconstruction(PLACES), "transformation": "1 0 0\n0 1"},
            "cameras.damaged",
        ),
    ],
)
def test_refused(tmp_path, files, code):
    with refused(code):
        read(project(tmp_path, **files))
