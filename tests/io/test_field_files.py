"""Files of practitioners: read as they are meant, or refused by what they are."""

import struct

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.io.clouds import read_reference
from pcfix.io.ground_control import read_gnss
from pcfix.io.las.source import LasSource, metric_crs, stated_crs
from pcfix.io.tables import read_check_depths
from pcfix.io.vectors import read_vectors
from pcfix.io.water import write_water_raster
from pcfix.model import WaterRaster
from tests.utils.clouds import EAST_M, NORTH_M, block, random_cloud
from tests.utils.codes import refused, warned


@pytest.fixture
def path(tmp_path):
    random_cloud(6, plain=True, count=50).write(tmp_path / "cloud.las")
    return tmp_path / "cloud.las"


def with_keys(path, **keys):
    """Write a cloud in UTM whose CRS is GeoTIFF keys, with further ones."""
    las = random_cloud(1, plain=True, count=50)
    values = {"1024": 1, "3072": 32633, **{name[1:]: value for name, value in keys.items()}}
    data = struct.pack("<4H", 1, 1, 0, len(values))
    data += b"".join(struct.pack("<4H", int(k), 0, 1, v) for k, v in values.items())
    las.header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", data))
    las.write(path)
    return path


def test_heights_of_geotiff_keys(tmp_path):
    source = with_keys(tmp_path / "a.las", k4096=3855, k4099=9001)
    pcfix.label_file(source, tmp_path / "b.las", water=15.0)
    for path in (source, tmp_path / "b.las"):
        with LasSource(path) as cloud:
            assert [one.to_epsg() for one in stated_crs(cloud).sub_crs_list] == [32633, 3855]


@pytest.mark.parametrize("keys", [{"k3076": 9003}, {"k4099": 9002}, {"k4096": 6360}])
def test_feet_of_geotiff_keys(tmp_path, keys):
    with refused("cloud.crs_unit"), LasSource(with_keys(tmp_path / "a.las", **keys)) as cloud:
        metric_crs(cloud)


@pytest.mark.parametrize(
    "start", ["version https://git-lfs.github.com/spec/v1\noid sha256:0", "<!DOCTYPE html><p>"]
)
def test_not_the_file(tmp_path, start):
    (tmp_path / "a.laz").write_text(start)
    with refused("input.not_the_file"):
        LasSource(tmp_path / "a.laz")


@pytest.mark.parametrize("name", ["100_0001_Timestamp.MRK", "events.pos"])
def test_gnss_without_images(tmp_path, name):
    (tmp_path / name).write_text("1\t282401.669089\t[2404]\t101,N\t107,E\n")
    with refused("gnss.no_names"):
        read_gnss(tmp_path / name, block())


@pytest.mark.parametrize(
    ("encoding", "comment"), [("utf-8", "# "), ("utf-16", ""), ("latin-1", "")]
)
def test_decimal_commas(tmp_path, encoding, comment):
    rows = f"{comment}Easting;Northing;Höhe;Depth\n500001,5;4600002,25;-1,5;1,5\n"
    (tmp_path / "a.csv").write_text(rows, encoding)
    found = read_check_depths(tmp_path / "a.csv")
    assert [*found.xy[0], *found.value_m] == [500001.5, 4600002.25, 1.5]


def test_check_points(tmp_path):
    rows = "1,4650352.898,410231.491,-0.093,BED\n"
    (tmp_path / "a.csv").write_text(rows)
    with refused("table.no_header"):
        read_reference(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("Point,Northing,Easting,Elevation,Description\n" + rows)
    assert read_reference(tmp_path / "b.csv").xyz.tolist() == [[410231.491, 4650352.898, -0.093]]


KML = '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
KML += "<Point><coordinates>15,42,0</coordinates></Point></Placemark></Document></kml>"
GPX = '<?xml version="1.0"?><gpx version="1.1" creator="x" '
GPX += 'xmlns="http://www.topografix.com/GPX/1/1"><wpt lat="42" lon="15"/></gpx>'


@pytest.mark.parametrize(("name", "text"), [("a.kml", KML), ("a.gpx", GPX)])
def test_other_vectors(tmp_path, name, text):
    pytest.importorskip("pyogrio")
    (tmp_path / name).write_text(text)
    found = read_vectors(tmp_path / name)
    assert (found.coordinates[0, :2].tolist(), found.crs) == ([15.0, 42.0], "EPSG:4326")


FAR = {
    "a.csv": "x,y,z\n1000,2000,15\n1010,2000,15\n1000,2010,15\n1010,2020,15\n",
    "a.obj": "v 0 0 15\nv 100 0 15\nv 0 100 15\nf 1 2 3\n",
}


@pytest.mark.parametrize("name", [*FAR, "a.tif"])
def test_water_elsewhere(tmp_path, path, name):
    level = WaterRaster(np.full((50, 50), 15.0), 0.0, 50.0, (1.0, 1.0), "")
    write_water_raster(tmp_path / "a.tif", level, None)
    if name in FAR:
        (tmp_path / name).write_text(FAR[name])
    with refused("water.no_overlap") as caught:
        pcfix.label_file(path, tmp_path / "b.las", water=tmp_path / name)
    assert caught.value.values["away_m"] == pytest.approx(np.max([EAST_M, NORTH_M]), rel=2e-3)


def test_rough_water(tmp_path):
    noise = np.random.default_rng(1).normal(0.37, 0.1, (50, 50))
    raster = WaterRaster(noise, EAST_M, NORTH_M, (1.0, 1.0), "")
    write_water_raster(tmp_path / "w.tif", raster, "EPSG:32633")
    with warned("water.rough") as caught:
        pcfix.read_water(tmp_path / "w.tif", "EPSG:32633")
    (noise_m,) = (one.message.values["noise_m"] for one in caught if hasattr(one.message, "code"))
    assert noise_m == pytest.approx(0.1 * 1.25**0.5, rel=0.1)


def test_water_far_above(tmp_path, path):
    with warned("water.above_cloud"):
        pcfix.label_file(path, tmp_path / "b.las", water=80.0)
