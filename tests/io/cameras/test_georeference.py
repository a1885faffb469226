"""Cameras from the frame of their file into the cloud's CRS."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from pcfix.flow.plausibility import likely_mistake
from pcfix.io.cameras.georeference import adjusted_minus_gnss, georeference
from pcfix.model import Cameras, GnssPositions
from tests.utils import geodesy
from tests.utils.codes import refused
from tests.utils.geodesy import axes_at as east_north_up
from tests.utils.nightly import mostly_nightly
from tests.utils.reprojection import bring_to

pytestmark = pytest.mark.quick_but(
    "test_differences_are_east_north_up",
    "test_heights_that_cannot_be_compared_leave_the_plan",
    "test_a_map_with_north_first_is_read_east_first",
    "test_heights",
    "test_points_below_a_camera_fall_on_the_same_pixels",
    "test_with_the_geoid_installed_heights_are_brought_over",
)

FOCAL_PX, FRAME_PX, BELOW_M = 3650.0, 4000.0, 100.0
NADIR = np.diag([1.0, -1.0, -1.0])
LOCAL_CS = 'LOCAL_CS["Local",LOCAL_DATUM["Local",0],UNIT["metre",1]]'
VALENCIA = [725448.8215, 4369128.6996, 142.4802]
VALENCIA_LON_LAT = [-0.3802, 39.4423, 142.48]
UTM30, UTM30_ALICANTE = "EPSG:25830", "EPSG:25830+5782"


def cameras(centres, crs, rotations=None, **more):
    centres = np.atleast_2d(np.asarray(centres, float))
    labels = tuple(f"{i}.jpg" for i in range(len(centres)))
    return Cameras(labels, centres, rotations, crs=crs, **more)


def geocentric(lon, lat, h, f=1 / 298.257222101):
    return geodesy.geocentric(lon, lat, h, 6378137.0, f)


def image_px(rotation, centre, points):
    x, y, z = rotation @ (points - centre).T
    return FOCAL_PX * np.column_stack([x / z, y / z])


# ---- centres ----


@pytest.mark.parametrize("code", ["EPSG:2193", "EPSG:31467", "EPSG:2180"])
def test_a_map_with_north_first_is_read_east_first(code):
    crs = CRS(code)
    area = crs.area_of_use
    lon, lat = (area.west + area.east) / 2, (area.south + area.north) / 2
    x, y = Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True).transform(lon, lat)
    assert [a.direction for a in crs.axis_info] == ["north", "east"]
    found = bring_to(cameras([lon, lat, 50.0], crs.geodetic_crs.to_wkt()), code)
    assert found.centres[0] == pytest.approx([x, y, 50.0], abs=1e-4)
    ellipsoid = "bessel" if code == "EPSG:31467" else "GRS80"
    here = f"+proj=tmerc +lat_0={lat} +lon_0={lon} +ellps={ellipsoid} +type=crs"
    back = bring_to(cameras([x, y, 50.0], code), here)
    assert np.hypot(*back.centres[0, :2]) < 1e-2


def test_an_offset_comes_before_all_else():
    shift = (725000.0, 4369000.0, 100.0)
    moved = np.array(VALENCIA) - shift
    direct = bring_to(cameras(VALENCIA, "EPSG:32630"), UTM30).centres
    assert bring_to(cameras(moved, "EPSG:32630"), UTM30, offset_m=shift).centres == pytest.approx(
        direct, abs=1e-8
    )
    assert bring_to(cameras(moved, None), UTM30, offset_m=shift).centres[0] == pytest.approx(
        VALENCIA, abs=1e-9
    )


def test_tie_points_go_the_same_way_and_unknown_ones_stay_unknown():
    read = cameras([VALENCIA_LON_LAT], "EPSG:4258")
    there = georeference(read, UTM30)
    points = np.array([VALENCIA_LON_LAT, [np.nan] * 3, [-0.3801, 39.4424, 3.0], [1e9, 1e9, 0]])
    found = there.points(points)
    assert found[0] == pytest.approx(there.cameras(read).centres[0], abs=1e-9)
    assert np.isnan(found[[1, 3]]).any(axis=1).all()
    assert np.isfinite(found[2]).all()


# ---- rotations ----


@pytest.mark.parametrize("kind", ["ECEF", "ENU", "degrees"])
@pytest.mark.parametrize(
    ("lon", "lat"), [(-0.38, 39.44), (-3.1, 39.4), (-5.9, 65.0), (-2.0, -33.0)]
)
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_points_below_a_camera_fall_on_the_same_pixels(kind, lon, lat, tilt_deg):
    """But for the scale of the map against the heights: up to |k - 1| of the image distance."""
    h, f84 = 150.0, 1 / 298.257223563
    code = "EPSG:32630" if lat > 0 else "EPSG:32730"
    centre, axes = geocentric(lon, lat, h, f=f84), east_north_up(lon, lat)
    looks = NADIR @ Rotation.from_euler("zx", [40.0, tilt_deg], degrees=True).as_matrix()
    x, y = np.meshgrid(*[np.linspace(-0.5, 0.5, 9) * FRAME_PX / FOCAL_PX] * 2)
    rays = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)]) @ looks  # east, north, up
    enu = rays * (-BELOW_M / rays[:, 2])[:, None]
    seen = image_px(looks, 0.0, enu)
    ecef = centre + enu @ axes
    to_map = Transformer.from_crs("EPSG:4978", CRS(code).to_3d(), always_xy=True)
    points = np.column_stack(to_map.transform(*ecef.T))
    if kind == "degrees":
        read = cameras([lon, lat, h], "EPSG:4979", looks[None])
    elif kind == "ECEF":
        read = cameras(centre, "EPSG:4978", (looks @ axes)[None])
    else:  # in axes at a place that is 1.4 km away
        there = east_north_up(lon + 0.01, lat - 0.01)
        origin = geocentric(lon + 0.01, lat - 0.01, 20.0, f=f84)
        crs = f"ENU:{lat - 0.01!r},{lon + 0.01!r},20"
        read = cameras(there @ (centre - origin), crs, (looks @ axes @ there.T)[None])
    found = bring_to(read, code)
    areas = [np.linalg.det(np.cov(xyz[:, :2].T)) for xyz in (points, enu)]
    k = (areas[0] / areas[1]) ** 0.25
    raw = image_px(found.rotations[0], found.centres[0], points) - seen
    tilted = 1.0 + np.tan(np.radians(tilt_deg)) ** 2
    bound = abs(k - 1) * np.hypot(*seen.T).max() * 2.0 * tilted + 0.1
    assert np.hypot(*raw.T).max() < bound
    assert np.hypot(*raw.T).max() < 2.5
    even = found.centres[0] + (points - found.centres[0]) / [k, k, 1.0]
    left = image_px(found.rotations[0], found.centres[0], even) - seen
    drop_m = np.linalg.norm(enu, axis=1).max() ** 2 / 2 / 6.37e6  # the earth is curved
    assert np.hypot(*left.T).max() < 1.2 * FOCAL_PX * drop_m / BELOW_M


def test_left_handed_axes_are_refused():
    crs = CRS("EPSG:5513")  # south, west
    x, y = Transformer.from_crs("EPSG:4156", crs, always_xy=True).transform(15.0, 50.0)
    read = cameras([x, y, 300.0], "EPSG:5513", NADIR[None])
    with refused("cameras.left_handed"):
        bring_to(read, "EPSG:5514", name="a.csv")
    assert np.isfinite(bring_to(replace(read, rotations=None), "EPSG:5514").centres).all()


# ---- heights ----


GEOID = """
import sys, numpy as np, pyproj, rasterio
from rasterio.transform import from_origin
folder = sys.argv[1]
north, west = np.mgrid[40.5:38.5:-0.05, -1.5:0.5:0.05]
grid = (50.0 + 0.02 * (west + 0.38) * 85.9).astype("float32")
with rasterio.open(folder + "/es_ign_egm08-rednap.tif", "w", driver="GTiff", count=1,
                   dtype="float32", width=grid.shape[1], height=grid.shape[0], crs="EPSG:4258",
                   transform=from_origin(-1.525, 40.525, 0.05, 0.05)) as out:
    out.write(grid, 1)
    out.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
    out.set_band_description(1, "geoid_undulation")
pyproj.datadir.append_data_dir(folder)
from pcfix.io.cameras.georeference import georeference
from pcfix.model import Cameras
ecef = [[float(w) for w in sys.argv[2:5]]]
read = Cameras(("a",), np.array(ecef), np.eye(3)[None], crs="EPSG:4936",
               project_crs="EPSG:25830+5782")
for cloud in ("EPSG:25830", "EPSG:25830+5782"):
    found = georeference(read, cloud).cameras(read)
    flat = georeference(read, cloud, cameras_crs="EPSG:25830").cameras(read)
    turn = flat.rotations[0] @ found.rotations[0].T
    turn_deg = np.degrees(np.linalg.norm(turn - turn.T) / np.sqrt(8))
    print(found.crs, *found.centres[0], turn_deg, found.notes)
"""


def test_with_the_geoid_installed_heights_are_brought_over(tmp_path):
    ecef = geocentric(*VALENCIA_LON_LAT)
    script = tmp_path / "geoid.py"
    script.write_text(GEOID)
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path), *map(repr, ecef.tolist())],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    for line in done.stdout.splitlines():
        crs, _, _, z, turn_deg, notes = line.split(maxsplit=5)
        assert crs == UTM30_ALICANTE
        assert float(z) == pytest.approx(142.48 - 50.0, abs=2e-3)
        # 0.02 m per km of slope: half of it is a turn, half shear
        assert float(turn_deg) == pytest.approx(np.degrees(0.5 * 0.02e-3), rel=0.1)
        assert notes == "()"


ASSUMED = "cameras.heights_assumed"
ALICANTE_ECEF = geocentric(*VALENCIA_LON_LAT)
OREGON = [500000.0, 4900000.0, 1000.0]
TO_FEET = Transformer.from_crs("EPSG:26910", "EPSG:2992", always_xy=True)
OREGON_FEET = [*TO_FEET.transform(5e5, 4.9e6), 1000.0]
ENU_FRAME = "ENU:39.44,-0.38,92.5"


@pytest.mark.parametrize(
    ("at", "crs", "project", "cloud", "given", "z", "codes"),
    [
        # heights in feet where the plan is in feet, or the CRS says so
        (OREGON_FEET, "EPSG:2992", None, "EPSG:26910", None, 304.8, [ASSUMED]),
        (OREGON, "EPSG:26910+6360", None, "EPSG:26910", None, 1200000.0 / 3937.0, []),
        # the user vouches for the heights
        (ALICANTE_ECEF, "EPSG:4936", UTM30_ALICANTE, UTM30, UTM30, 142.48, []),
        (ALICANTE_ECEF, "EPSG:4936", UTM30_ALICANTE, UTM30_ALICANTE, UTM30, 142.48, []),
        ([0.0, 0, 50], ENU_FRAME, None, UTM30_ALICANTE, ENU_FRAME, 142.5, []),
        # ellipsoidal ones stay if the cloud does not state its datum
        (VALENCIA_LON_LAT, "EPSG:4937", None, UTM30, None, 142.48, [ASSUMED]),
        # those not stated are the cloud's
        (VALENCIA_LON_LAT, "EPSG:4326", None, UTM30_ALICANTE, None, 142.48, [ASSUMED]),
        (VALENCIA_LON_LAT, "EPSG:4326", None, UTM30_ALICANTE, "EPSG:4326", 142.48, []),
        (VALENCIA, UTM30, None, UTM30_ALICANTE, None, VALENCIA[2], [ASSUMED]),
        (VALENCIA, UTM30, None, UTM30_ALICANTE, UTM30, VALENCIA[2], []),
    ],
)
def test_heights(at, crs, project, cloud, given, z, codes):
    found = bring_to(cameras(at, crs, project_crs=project), cloud, cameras_crs=given)
    assert found.centres[0, 2] == pytest.approx(z, abs=1e-3)
    assert [note.code for note in found.notes if note.code == ASSUMED] == codes


# ---- who says what ----


@pytest.mark.parametrize(
    ("at", "crs", "project", "cloud", "code"),
    [
        (VALENCIA, "local", None, UTM30, "cameras.local"),
        (VALENCIA, UTM30, None, LOCAL_CS, "cloud.local"),
        (VALENCIA_LON_LAT, "EPSG:4326", None, None, "cloud.no_crs"),
        (ALICANTE_ECEF, "EPSG:4936", None, None, "cloud.no_crs"),
        (VALENCIA, "EPSG:4326", None, UTM30, "cameras.degrees"),
        (VALENCIA, "EPSG:4978", None, UTM30, "cameras.geocentric"),
        ([1e30, 1e30, 5.0], "EPSG:32631", None, UTM30, "cameras.not_transformed"),
        (VALENCIA, "EPSG:32630+5773", None, UTM30_ALICANTE, "crs.heights"),
        (VALENCIA, "nonsense", None, UTM30, "crs.unknown"),
        (VALENCIA, "EPSG:32630", None, "EPSG:4326", "crs.not_projected"),
        (VALENCIA, "EPSG:32630", None, "EPSG:2992", "crs.unit"),
        (VALENCIA, "ENU:39", None, UTM30, "crs.origin"),
    ],
)
def test_refused(at, crs, project, cloud, code):
    with refused(code):
        bring_to(cameras(at, crs, NADIR[None], project_crs=project), cloud, name="a.xml")


def test_without_the_clouds_crs():
    ecef = geocentric(*VALENCIA_LON_LAT)
    found = bring_to(cameras(ecef, "EPSG:4936", project_crs=UTM30), None, name="a.xml")
    assert (found.crs, found.centres[0, 2]) == (UTM30, pytest.approx(142.48))
    assert [note.code for note in found.notes] == ["cloud.crs_assumed"]
    for at, crs in ((VALENCIA, UTM30), ([1.0, 2, 3], "ENU:39,0,5"), ([6.0, 4, 2], "EPSG:2992")):
        found = bring_to(cameras(at, crs), None)
        assert (found.crs, found.centres[0].tolist()) == (crs, list(at))
        assert found.notes[0].code == "cloud.crs_assumed"
    for crs in ("local", None):
        found = bring_to(cameras([1.0, 2, 3], crs), None)
        assert (found.crs, found.centres.tolist(), found.notes) == (crs, [[1, 2, 3]], ())


def test_no_offset_of_degrees():
    with refused("cameras.offset"):
        bring_to(cameras(VALENCIA_LON_LAT, "EPSG:4326"), UTM30, offset_m=(1.0, 0.0, 0.0))


# ---- adjusted centres minus GNSS positions ----

LON, LAT, H = 139.5405, 35.7380, 130.0
ENU_M = np.array([[1.5, -2.0, 0.5], [0.0, 0.25, -3.0], [np.nan] * 3])


def moved_block(crs, gnss_crs, enu_m=ENU_M, height=H, **more):
    """Return cameras in a CRS and GNSS positions that differ from them by ENU_M."""
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    axes = east_north_up(LON, LAT)
    origin = np.array(to_ecef.transform(LON, LAT, height))
    adjusted = origin + np.array([[0.0, 0, 0], [5.0, 8.0, 1.0], [9.0, -4.0, 0.0]]) @ axes
    measured = adjusted - enu_m @ axes

    def there(ecef, crs):
        if crs.startswith("ENU"):
            return (ecef - origin) @ axes.T
        target = CRS(crs)
        target = target if len(target.axis_info) == 3 else target.to_3d()
        step = Transformer.from_crs("EPSG:4978", target, always_xy=True)
        return np.column_stack(step.transform(*ecef.T))

    gnss = GnssPositions(there(measured, gnss_crs), np.full((3, 3), np.nan), gnss_crs)
    labels = ("a", "b", "c")
    return Cameras(labels, there(adjusted, crs), crs=crs, gnss=gnss, **more)


ENU = f"ENU:{LAT},{LON},{H}"


@pytest.mark.parametrize("gnss", ["EPSG:4326", "EPSG:4979", "EPSG:4978", "EPSG:32654"])
@pytest.mark.parametrize("crs", mostly_nightly(["EPSG:4978", "EPSG:4979", "EPSG:4326", ENU], ENU))
def test_differences_are_east_north_up(crs, gnss):
    enu_m, why = adjusted_minus_gnss(moved_block(crs, gnss))
    assert enu_m == pytest.approx(ENU_M, abs=2e-4, nan_ok=True)
    assert why == ""


def test_in_the_axes_of_a_map():
    read = moved_block("EPSG:4978", "EPSG:4326", project_crs="EPSG:32654")
    enu_m, _ = adjusted_minus_gnss(bring_to(read, "EPSG:32654"))
    gamma = np.arctan(np.tan(np.radians(LON - 141.0)) * np.sin(np.radians(LAT)))
    east, north = ENU_M[:2, :2].T
    turned = np.column_stack(
        [east * np.cos(gamma) - north * np.sin(gamma), east * np.sin(gamma) + north * np.cos(gamma)]
    )
    assert enu_m[:2, :2] == pytest.approx(turned, abs=2e-3)  # scale 0.9997 of 3 m
    assert enu_m[:2, 2] == pytest.approx(ENU_M[:2, 2], abs=1e-4)
    assert np.isnan(enu_m[2]).all()


@pytest.mark.parametrize(
    ("crs", "gnss_crs", "reason"),
    [
        ("EPSG:4978", "EPSG:4326+5773", "us_nga_egm96_15.tif"),
        ("EPSG:32654+5773", "EPSG:4979", "us_nga_egm96_15.tif"),
        ("EPSG:32654+5773", "EPSG:4326", "the CRS of the GNSS names no vertical datum"),
        ("EPSG:32654", "EPSG:4326+5773", "the CRS of the cameras names no vertical datum"),
    ],
)
def test_heights_that_cannot_be_compared_leave_the_plan(crs, gnss_crs, reason):
    flat = moved_block(*(text.partition("+")[0] for text in (crs, gnss_crs)))
    read = replace(flat, crs=crs, gnss=replace(flat.gnss, crs=gnss_crs))
    enu_m, why = adjusted_minus_gnss(read, "a.xml")
    assert why.startswith("a.xml: ")
    assert reason in why
    assert why.endswith("only plan is compared.")
    assert "--cameras-crs" not in why
    assert np.isnan(enu_m[:, 2]).all()
    lengths = np.hypot(*enu_m[:2, :2].T)
    assert lengths == pytest.approx(np.hypot(*ENU_M[:2, :2].T), rel=5e-4)


# ---- cameras that are not over their cloud ----

LOW, HIGH = np.array([725300.0, 4369000.0, 8.0]), np.array([725600.0, 4369250.0, 30.0])
FITS = np.random.default_rng(1).uniform([725320, 4369020, 138], [725580, 4369230, 144], (60, 3))
AWAY = (LOW + HIGH)[:2] / 2 - np.median(FITS[:, :2], axis=0)


@pytest.mark.parametrize(
    ("centres", "words"),
    [
        (FITS[:, [1, 0, 2]], "km from the cloud in plan; check the CRS, the unit"),
        (FITS - [-3000.0, 4000.0, 0.0], "offset of {:.0f}, {:.0f} m".format(*AWAY - [3e3, -4e3])),
        (FITS - [0.0, 0.0, 150.0], "below the lowest point of the cloud"),
        (FITS * [1, 1, 20 / 0.3048], "above the cloud"),
    ],
)
def test_mistake(centres, words):
    assert words in likely_mistake(centres, LOW, HIGH)
    assert likely_mistake(FITS, LOW, HIGH) is None
    assert likely_mistake(FITS - [250.0, 0.0, 60.0], LOW, HIGH) is None  # obliques
