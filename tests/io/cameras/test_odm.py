"""OpenDroneMap's projects."""

import json
import shutil

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from pcfix.errors import InputError
from pcfix.io.cameras import odm, opensfm
from pcfix.io.cameras.formats import Source
from tests.io.cameras.test_opensfm import residuals
from tests.utils.reprojection import check_file, residuals_px, row_of
from tests.utils.shared import needs

TESTERARM, on_testerarm = needs("cameras", "odm", "testerarm_sub0")
HECTORSOSA, hectorsosa = needs("cameras", "odm", "hectorsosa")
ORTHORITY, orthority = needs("cameras", "odm", "orthority_odm")

UTM15 = "+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs +type=crs"
CRS, EAST, NORTH = "EPSG:32632", 680000, 5210000  # 2.4 degrees east of the meridian
TO_UTM = Transformer.from_crs("EPSG:4979", CRS, always_xy=True)
LON, LAT = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(EAST, NORTH)
CAMERA = {
    **{"projection_type": "brown", "width": 4000, "height": 3000, "focal_x": 0.8, "focal_y": 0.8},
    **{"k1": -0.1, "p1": 0.001},
}
DOWN = [np.pi, 0.0, 0.0]
PLACES = np.array([[0, 0, 100], [150, 20, 110], [-40, 200, 105], [90, -180, 95]], dtype=float)


def to_ecef(lon, lat, h):
    return np.array(
        Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, h)
    )


def enu_axes(lon, lat):
    lon, lat = np.radians([lon, lat])
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


def exact_utm(enu, lon=LON, lat=LAT):
    """Topocentric to UTM by way of the earth's centre."""
    ecef = to_ecef(lon, lat, 0.0) + enu @ enu_axes(lon, lat)
    back = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    return np.column_stack(TO_UTM.transform(*back.transform(*ecef.T)))


def shot(place, rotation=DOWN, **more):
    shift = -Rotation.from_rotvec(rotation).apply(place)
    return {"camera": "c", "rotation": list(rotation), "translation": list(shift), **more}


def reconstruction(places, lon=LON, lat=LAT, gnss=None, points=None):
    shots = {f"{i}.jpg": shot(place) for i, place in enumerate(places)}
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


def read(path):
    source = Source(path)
    assert odm.recognises(source)
    return odm.read(source)


def check_centres(cameras, sample, metres):
    for truth in check_file(sample)["projection_centres"]:
        i = row_of(cameras, truth["image"])
        assert cameras.centres[i] == pytest.approx([truth[k] for k in "XYZ"], abs=metres)
        up = np.array(truth["up_dir_minus_cam_y"])
        up /= np.linalg.norm(up)  # it was put through a map that scales in plan
        assert cameras.rotations[i][2] == pytest.approx(truth["view_dir"], abs=2e-5)
        assert -cameras.rotations[i][1] == pytest.approx(up, abs=2e-5)


@on_testerarm
@pytest.mark.parametrize(
    "path", ["", "opensfm", "opensfm/reconstruction.json", "odm_report/shots.geojson"]
)
def test_old_project_comes_out_in_its_projected_crs(path):
    cameras, check = read(TESTERARM / path), check_file(TESTERARM)
    check_centres(cameras, TESTERARM, 1e-4)
    expected = np.array([seen["res_px"] for seen in check["observations"]])
    found = residuals_px(cameras, check["observations"])
    # The map scales in plan alone (0.9996), which no rotation can: 0.06 px in the corners.
    assert found == pytest.approx(expected, abs=0.06)
    assert np.median(found) == pytest.approx(0.10, abs=0.015)
    assert (cameras.crs, cameras.project_crs) == (UTM15, None)
    assert cameras.gnss.crs == "EPSG:4326"
    assert cameras.gnss.xyz[:, 0] == pytest.approx(-91.994, abs=1e-3)


@on_testerarm
def test_old_project_turns_by_the_meridian_convergence():
    source = Source(TESTERARM / "opensfm" / "reconstruction.json")
    projected, plain = odm.read(source), opensfm.read(source)
    north = np.median(
        [
            a.T @ b @ [0.0, 1.0, 0.0]
            for a, b in zip(projected.rotations, plain.rotations, strict=True)
        ],
        axis=0,
    )
    assert np.degrees(np.arctan2(north[0], north[1])) == pytest.approx(-0.7339, abs=1e-3)


@on_testerarm
def test_tie_points_of_the_old_project_lie_in_its_frame():
    source, check = Source(TESTERARM), check_file(TESTERARM)
    cameras = odm.read(source)
    misses = residuals(cameras, odm.tie_points(source, cameras))
    assert len(misses) == check["n_observations_used_for_rms"]
    assert np.sqrt(np.mean(misses**2)) == pytest.approx(check["reprojection_rms_px"], abs=0.01)
    assert np.median(misses) == pytest.approx(check["reprojection_median_px"], abs=0.015)


@hectorsosa
@pytest.mark.parametrize("path", ["", "odm_report", "odm_report/shots.geojson"])
def test_project_without_reconstruction(path):
    cameras = read(HECTORSOSA / path)
    check_centres(cameras, HECTORSOSA, 1e-4)
    assert cameras.crs == UTM15.replace("15", "16")
    assert len(cameras) == 40
    assert cameras.notes == cameras.unposed == ()
    lens = cameras.lenses[0]
    assert (lens.width, lens.height) == (2048, 1536)
    assert lens.focal == pytest.approx(2048 * 0.5675645720115157)
    assert lens.tangential == pytest.approx((0.0002101851524261031, -0.00024999352086827305))
    assert np.nanmax(np.abs(cameras.gnss.xyz - [-87.1598, 14.0880, 1154.7])) < 1.0


@orthority
@pytest.mark.parametrize("path", ["", "opensfm/reconstruction.json"])
def test_newer_project_is_shifted_by_its_reference(path):
    cameras = read(ORTHORITY / path)
    check_centres(cameras, ORTHORITY, 1e-3)
    assert cameras.crs == "EPSG:32651"
    assert cameras.gnss.crs.startswith("ENU:24.6809")


@orthority
def test_newer_reconstruction_alone_in_another_folder(tmp_path):
    shutil.copy(ORTHORITY / "opensfm" / "reconstruction.json", tmp_path / "poses.json")
    check_centres(read(tmp_path / "poses.json"), ORTHORITY, 1e-3)


def test_reference_at_whole_metres_means_projected_axes(tmp_path):
    path = project(tmp_path, reconstruction=reconstruction(PLACES))
    cameras = read(path)
    assert cameras.centres == pytest.approx(np.add(PLACES, [EAST, NORTH, 0]), abs=1e-6)
    assert (cameras.crs, cameras.project_crs) == (CRS, None)


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


def test_topocentric_copy_of_the_reconstruction(tmp_path):
    folder = project(
        tmp_path, reconstruction=reconstruction(PLACES), topocentric=reconstruction(PLACES)
    )
    cameras = read(folder / "opensfm" / "reconstruction.topocentric.json")
    assert cameras.crs == f"ENU:{LAT!r},{LON!r},0.0"


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
    points = odm.tie_points(Source(path), cameras)
    assert points.xyz == pytest.approx(exact_utm(np.array([[9.0, 8, 7]]), lon, lat), abs=1e-3)
    identity = cameras.rotations @ cameras.rotations.transpose(0, 2, 1)
    assert identity == pytest.approx(np.broadcast_to(np.eye(3), identity.shape), abs=1e-12)


def test_transformation_of_another_origin_is_not_used(tmp_path):
    path = project(
        tmp_path,
        reconstruction=reconstruction(PLACES),
        transformation=transformation(LON + 0.01, LAT),
        coords="WGS84 UTM 32N\n",
    )
    assert read(path).centres == pytest.approx(np.add(PLACES, [EAST, NORTH, 0]), abs=1e-6)


def test_aligned_project_is_told(tmp_path):
    shots = geojson(np.add(PLACES, [EAST + 1.5, NORTH, 0]))
    path = project(tmp_path, reconstruction=reconstruction(PLACES), shots=shots)
    assert "1.50 m" in read(path).notes[0]
    assert read(path / "odm_report").centres[0] == pytest.approx([EAST, NORTH, 100])


def test_crs_of_shots_follows_from_their_longitude_and_latitude(tmp_path):
    places = np.add(PLACES, [EAST, NORTH, 0])
    shots = geojson(places, {0: (LON, LAT, 100)})
    assert read(project(tmp_path, shots=shots)).crs == CRS


@pytest.mark.parametrize("place", [(8, 47, 9), (0.0, 0.0, 0.0)])
def test_made_up_coordinates_are_local(tmp_path, place):
    assert read(project(tmp_path, shots=geojson(PLACES, {0: place}))).crs == "local"


def test_lens_by_name_or_by_size_and_focal_length(tmp_path):
    other = {**CAMERA, "k1": 0.3}
    path = project(
        tmp_path, shots=geojson(PLACES, camera="two"), cameras={"one": CAMERA, "two": other}
    )
    assert read(path).lenses[0].radial[0] == 0.3
    project(tmp_path, shots=geojson(PLACES), cameras={"one": CAMERA, "x": {**other, "width": 400}})
    assert read(path).lenses[0].radial[0] == -0.1


@pytest.mark.parametrize("cameras", [{}, {"one": CAMERA, "two": {**CAMERA, "k1": 0.3}}])
def test_lens_that_cannot_be_told_is_plain(tmp_path, cameras):
    found = read(project(tmp_path, shots=geojson(PLACES), cameras=cameras))
    assert (found.lenses[0].focal, found.lenses[0].radial) == (3200, ())
    assert "4 images" in found.notes[0]


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


def test_link_kept_as_text(tmp_path):
    folder = project(tmp_path, reconstruction=reconstruction(PLACES))
    (folder / "real").mkdir()
    (folder / "opensfm/reconstruction.json").rename(folder / "real/reconstruction.json")
    link = folder / "opensfm/reconstruction.json"
    link.write_text("../real/reconstruction.json")
    assert len(read(link)) == 4
    for target in ("../../away/reconstruction.json", "../nothing/reconstruction.json"):
        link.write_text(target)
        assert not odm.recognises(Source(link))
        with pytest.raises(
            InputError, match=rf"reconstruction\.json: is only a link to '{target}'"
        ):
            odm.read(Source(link))


def test_opensfm_alone_is_not_claimed(tmp_path):
    (tmp_path / "reconstruction.json").write_text(json.dumps(reconstruction(PLACES, LON + 1e-4)))
    assert not odm.recognises(Source(tmp_path))
    assert not odm.recognises(Source(tmp_path / "reconstruction.json"))
    assert opensfm.recognises(Source(tmp_path))


@pytest.mark.parametrize("text", ["", "{}", "label,x,y,z\n", '{"features": []}', "\x00" * 9])
def test_other_files_are_not_recognised(tmp_path, text):
    path = tmp_path / "other.json"
    path.write_text(text)
    assert not odm.recognises(Source(path))
    assert not odm.recognises(Source(tmp_path))


def twice():
    shots = geojson(PLACES)
    first, _, third = (feature["properties"] for feature in shots["features"][:3])
    third["filename"] = first["filename"]
    return shots


def without(name):
    shots = geojson(PLACES)
    del shots["features"][2]["properties"][name]
    return shots


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"shots": without("filename")}, "shots.geojson: feature 3 has no filename"),
        ({"shots": twice()}, "shots.geojson: feature 3 repeats the filename"),
        ({"shots": without("rotation")}, r"shots.geojson: image 2.jpg, rotation"),
        ({"shots": without("translation")}, "shots.geojson: translation"),
        ({"shots": without("focal")}, r"shots.geojson: image 2.jpg, width, height, focal"),
        ({"shots": geojson(PLACES, focal=0)}, "focal length 0"),
        ({"shots": {"type": "FeatureCollection", "features": []}}, "has no features"),
        ({"shots": {"type": "FeatureCollection", "features": [1]}}, "feature 1 is not an object"),
        ({"shots": "{"}, "shots.geojson: the JSON is damaged"),
        ({"shots": geojson(PLACES), "proj": "+proj=nowhere"}, "proj.txt: '.proj=nowhere' names no"),
        ({"shots": geojson(PLACES), "coords": "\n"}, "coords.txt: '' names no CRS"),
        ({"shots": geojson(PLACES), "cameras": [1]}, "cameras.json: the file is not an object"),
        ({"shots": geojson(PLACES), "images": {}}, "images.json: is not a list"),
        (
            {"shots": geojson(PLACES), "images": [{"filename": "1.jpg", "latitude": "x"}]},
            "images.json: image 1.jpg, latitude: 'x'|images.json: image 1.jpg, latitude",
        ),
        (
            {"reconstruction": reconstruction(PLACES), "transformation": ""},
            "geocoords_transformation.txt: is not four rows",
        ),
        (
            {"reconstruction": reconstruction(PLACES), "transformation": "1 0 0\n0 1"},
            "geocoords_transformation.txt: is not four rows",
        ),
        (
            {"reconstruction": reconstruction(PLACES), "transformation": "9 0 0 9\n" * 4},
            "geocoords_transformation.txt: is not four rows",
        ),
        ({"images": []}, "has neither"),
    ],
)
def test_damaged_files_are_named(tmp_path, files, words):
    with pytest.raises(InputError, match=words):
        odm.read(Source(project(tmp_path, **files)))
