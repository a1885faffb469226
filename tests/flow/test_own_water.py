"""Images that were each taken through water of their own: a sea that moves between them."""

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.correction import OWN_WATER
from pcfix.io.water import write_water_raster
from pcfix.model import Lens, WaterRaster
from tests.utils.clouds import write_las
from tests.utils.waves import Sea, bed_seen

PLACE = np.array([512_000.0, 4_987_000.0, 0.0])
BED = (-2.0, 0.05, -0.03)
HIGH_M, HALF_M, CELL_M, SECONDS = 10.0, 12.0, 0.1, 1.7
LENS = Lens(500.0, 2000, 2000, 1000.0, 1000.0)
SEA, TIMES = Sea(2.0), SECONDS * np.arange(6)
MILLIMETRE, MICROMETRE = 1e-3, 1e-6


def centres():
    x, y = np.meshgrid([-4.0, 0.0, 4.0], [-3.0, 3.0])
    return np.column_stack([x.ravel(), y.ravel(), np.full(6, HIGH_M)])


def block():
    down = np.tile(np.diag([1.0, -1.0, -1.0]), (6, 1, 1))
    labels = tuple(f"DCIM/DJI_{i}.JPG" for i in range(6))
    return pcfix.Cameras(labels, centres() + PLACE, down, (LENS,) * 6)


def slopes_seen(centre, time, bed):
    """Return the sideways slopes, shape (n, 2), of the light that comes from points of the bed."""
    slope = (bed - centre)[:, :2] / (centre[2] - bed[:, 2])[:, None]
    for _ in range(60):
        ray = np.column_stack([slope, np.full(len(bed), -1.0)])
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        off = bed_seen(ray, centre, SEA, time, BED) - bed
        slope -= off[:, :2] / HIGH_M
    assert np.abs(off).max() < 1e-9
    return slope


def scene():
    """Return a bed, and where straight rays meet, with least squares of residuals in the images."""
    xy = np.random.default_rng(2).uniform([-4.0, -3.0], [4.0, 3.0], (300, 2))
    bed = np.column_stack([xy, BED[0] + xy @ BED[1:]])
    seen = [slopes_seen(c, t, bed) for c, t in zip(centres(), TIMES, strict=True)]
    points = bed * [1.0, 1.0, 0.7]
    for _ in range(20):
        normal, right = np.zeros((len(bed), 3, 3)), np.zeros((len(bed), 3))
        for centre, slope in zip(centres(), seen, strict=True):
            far = (centre[2] - points[:, 2])[:, None]
            there = (points - centre)[:, :2] / far
            by_point = np.concatenate([np.tile(np.eye(2), (len(bed), 1, 1)), there[..., None]], 2)
            by_point /= far[..., None]
            normal += by_point.transpose(0, 2, 1) @ by_point
            right += np.einsum("nij,ni->nj", by_point, slope - there)
        points = points + np.linalg.solve(normal, right[..., None])[..., 0]
    return bed, points + PLACE


def write(folder, heights):
    """Write a raster for each image, of a function of places from `PLACE`."""
    folder.mkdir(parents=True)
    side = np.arange(-HALF_M + CELL_M / 2, HALF_M, CELL_M)
    x, y = np.meshgrid(side, side[::-1])
    for number, one in enumerate(heights):
        values = one(np.column_stack([x.ravel(), y.ravel()])) + np.zeros(x.size)
        corner = PLACE[0] - HALF_M, PLACE[1] + HALF_M
        raster = WaterRaster(values.reshape(x.shape), *corner, (CELL_M, CELL_M))
        write_water_raster(folder / f"DJI_{number}.tif", raster, None)
    return folder


def at(time):
    return lambda xy: SEA.at(xy, time)[0]


@pytest.fixture(scope="module")
def seen():
    return scene()


@pytest.fixture(scope="module")
def waters(tmp_path_factory):
    return write(tmp_path_factory.mktemp("own") / "water", [at(time) for time in TIMES])


def rmse(found, bed):
    return float(np.sqrt(np.mean((found.xyz - PLACE - bed)[:, 2] ** 2)))


def test_bed_under_waves(seen, waters):
    """Against the sea that bent the light, six images 1.7 s apart."""
    bed, points = seen
    flat = pcfix.correct_points(points, block(), 0.0, method="consistent", camera_set="all")
    own = pcfix.correct_points(points, block(), 0.0, water_per_image=waters)
    assert (own.ray_count == 6).all()
    assert rmse(own, bed) < 0.1 * rmse(flat, bed)
    # the rays through one apparent point are not those that made it
    simple = pcfix.correct_points(points, block(), 0.0, method="snell", water_per_image=waters)
    assert rmse(own, bed) < rmse(simple, bed) < 0.4 * rmse(flat, bed)


@pytest.mark.parametrize("method", ["snell", "consistent"])
def test_raster_missing(seen, tmp_path, method):
    """One image's water is 10 cm higher, as far as its raster goes: as of a tide of 10 cm there."""
    folder = write(tmp_path / "water", [lambda xy: np.where(xy[:, 0] < 0.0, 0.1, np.nan)])
    with pytest.warns(PcfixWarning):
        own = pcfix.correct_points(seen[1], block(), 0.0, method=method, water_per_image=folder)
    flat, tide = (
        pcfix.correct_points(
            seen[1], block(), 0.0, method=method, camera_set="all",
            level_offset_m=np.append(offset, np.zeros(5)),
        )
        for offset in (0.0, 0.1)
    )  # fmt: skip
    # the first image stands at x = -4: its rays to points west of x = 0 pierce the water there
    west, east = seen[1][:, 0] < PLACE[0] - 0.1, seen[1][:, 0] > PLACE[0] + 1.0
    assert own.xyz[west] == pytest.approx(tide.xyz[west], abs=MICROMETRE)
    assert own.xyz[east] == pytest.approx(flat.xyz[east], abs=MICROMETRE)
    assert np.abs(tide.xyz - flat.xyz)[west].max() > MILLIMETRE


def test_file(seen, waters, tmp_path):
    write_las(tmp_path / "cloud.las", seen[1], crs=None, offsets=PLACE)
    rows = [
        f"{label},{x},{y},{z},0,0,0"
        for label, (x, y, z) in zip(block().labels, block().centres, strict=True)
    ]
    (tmp_path / "cameras.csv").write_text("\n".join(["label,x,y,z,yaw,pitch,roll", *rows]))
    (tmp_path / "sensor.csv").write_text("focal,sensor_x,sensor_y\n25,100,100\n")
    options = {"cameras": str(tmp_path / "cameras.csv"), "water_per_image": str(waters)}
    summary = pcfix.correct_file(tmp_path / "cloud.las", tmp_path / "a.las", water=0, **options)
    assert OWN_WATER in summary.reconstruction["because"]
    out, las = laspy.read(tmp_path / "a.las"), laspy.read(tmp_path / "cloud.las")
    found = pcfix.correct_points(
        las.xyz, pcfix.read_cameras(tmp_path / "cameras.csv"), 0.0, water_per_image=waters
    )
    assert found.xyz == pytest.approx(np.asarray(out.xyz), abs=0.51 * MILLIMETRE)
    assert np.array_equal(found.ray_count, np.asarray(out.RayCount))


@pytest.mark.parametrize(
    "options",
    [
        {"method": "shan"},
        {"method": "consistent", "camera_set": "mvs"},
        {"water": 5.0},  # another datum
        {"water_per_image": "elsewhere"},  # no raster has the name of an image
    ],
    ids=str,
)
def test_refused(seen, waters, options):
    given = {"water": 0.0, "water_per_image": waters, **options}
    with pytest.raises((SettingError, InputError)):
        pcfix.correct_points(seen[1], block(), **given)
