"""The water surface: texts, meshes and rasters, and whether it fits the cloud."""

import laspy
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine, from_origin

import pcfix
from pcfix.flow.demo import write_scene
from pcfix.water.surface import surface_above
from tests.utils.codes import refused, warned


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("0.37", pcfix.WaterPlane(0.37)),
        ("-1.5e-1", pcfix.WaterPlane(-0.15)),
        (12, pcfix.WaterPlane(12.0)),
        ("plane:1,0.01,-0.02", pcfix.WaterPlane(1.0, 0.01, -0.02)),
        ("dim:w_surf", pcfix.WaterDimension("w_surf")),
    ],
)
def test_texts(spec, expected):
    assert pcfix.read_water(spec) == expected


@pytest.mark.parametrize(
    "spec", ["nan", "1e999", "plane:1,2", "plane:1,2,x", "plane:1,inf,0", "dim:", "none", "0.3m"]
)
def test_bad_texts(spec):
    with refused("water.spec", pcfix.SettingError, value=spec):
        pcfix.read_water(spec)


OBJ = """# a square with a normal and a texture, as exporters write it
mtllib water.mtl
v 512000.12345 4987000.54321 10.001
v 512010.12345 4987000.54321 10.002 1.0
vt 0 0
vn 0 0 1
v 512010.12345 4987010.54321 10.003
v 512000.12345 4987010.54321 10.004
g water
f 1/1/1 2/1/1 3//1 -1
"""


def test_obj(tmp_path):
    path = tmp_path / "water.obj"
    path.write_text(OBJ)
    mesh = pcfix.read_water(path)
    assert mesh.vertices[0].tolist() == [512000.12345, 4987000.54321, 10.001]
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]


PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty double x\n"
    b"property double y\nproperty double z\nelement face %d\n"
    b"property list uchar int vertex_indices\nend_header\n"
)


def ply(vertices, triangles):
    """Return the bytes of a mesh, shapes (n, 3)."""
    faces = np.zeros(len(triangles), [("count", "u1"), ("corner", "<i4", 3)])
    faces["count"], faces["corner"] = 3, np.reshape(triangles, (-1, 3))
    counts = len(vertices), len(triangles)
    return PLY % counts + np.asarray(vertices, "<f8").tobytes() + faces.tobytes()


def test_ply(tmp_path):
    vertices = np.array(
        [[512000.12345, 4987000.54321, 10.001], [512010.5, 4987000.5, 10], [512000, 4987010, 10]]
    )
    path = tmp_path / "water.ply"
    path.write_bytes(ply(vertices, [[0, 1, 2]]))
    mesh = pcfix.read_water(path)
    assert np.array_equal(mesh.vertices, vertices)
    assert mesh.triangles.tolist() == [[0, 1, 2]]
    path.write_bytes(path.read_bytes().replace(b"binary_little_endian", b"ascii"))
    with refused("ply.text", path=path):
        pcfix.read_water(path)


# Rasters

UTM33 = "EPSG:32633"
LEFT, TOP = 410_000.0, 4_650_400.0


def tilted(x, y):
    return 5.0 + 0.003 * (x - LEFT) - 0.002 * (y - TOP)


def write(path, heights, transform=None, crs=UTM33, nodata=np.nan, bands=1, **more):
    profile = {
        "driver": "GTiff", "height": heights.shape[0], "width": heights.shape[1], "count": bands,
        "dtype": heights.dtype, "crs": crs, "nodata": nodata,
        "transform": transform or from_origin(LEFT, TOP, 2.0, 2.0),
    }  # fmt: skip
    unit = more.pop("unit", None)
    with rasterio.open(path, "w", **{**profile, **more}) as target:
        for band in range(1, bands + 1):
            target.write(heights, band)
        if unit:
            target.set_band_unit(1, unit)
    return path


def sloping():
    """Return the heights of cells of 2 m."""
    column, row = np.meshgrid(np.arange(200) + 0.5, np.arange(150) + 0.5)
    return tilted(LEFT + 2.0 * column, TOP - 2.0 * row)


PLACES = np.random.default_rng(2).uniform(
    [LEFT + 20.0, TOP - 280.0, 0.0], [LEFT + 380.0, TOP - 20.0, 0.0], (500, 3)
)


def expect_plane(water, at=PLACES):
    surface = surface_above(water, at)
    assert surface.height_m == pytest.approx(tilted(*at[:, :2].T), abs=1e-6)
    assert surface.slope == pytest.approx(np.tile([0.003, -0.002], (len(at), 1)), abs=1e-5)


def test_north_up(tmp_path):
    heights = sloping()
    heights[3:5, 7] = np.nan
    water = pcfix.read_water(write(tmp_path / "water.tif", heights), UTM33)
    assert np.array_equal(water.height_m, heights, equal_nan=True)
    assert (water.left_m, water.top_m, water.cell_m) == (LEFT, TOP, (2.0, 2.0))
    assert str(water) == "raster water.tif, 200 x 150 cells of 2 m"
    expect_plane(water, PLACES[np.isfinite(surface_above(water, PLACES).height_m)])


def test_other_places(tmp_path):
    """A raster in another CRS, or a turned one, is refused with the remedy."""
    turned = Affine(1.7, -1.0, LEFT, -1.0, -1.7, TOP)
    for crs, transform in ((UTM33, turned), ("EPSG:32632", None), ("EPSG:3857", None)):
        path = write(tmp_path / "w.tif", FLAT, transform, crs)
        with refused("water.raster_place", path=path):
            pcfix.read_water(path, UTM33)


def test_nodata(tmp_path):
    heights = sloping().astype(np.float32)
    heights[0, 0] = -9999.0
    stated = pcfix.read_water(write(tmp_path / "a.tif", heights, nodata=-9999.0), UTM33)
    with warned("water.raster_nodata", count=1):
        unstated = pcfix.read_water(write(tmp_path / "b.tif", heights, nodata=None), UTM33)
    assert np.isnan(stated.height_m[0, 0])
    assert np.array_equal(stated.height_m, unstated.height_m, equal_nan=True)
    heights[:] = -9999.0
    with refused("water.raster_empty"):
        pcfix.read_water(write(tmp_path / "c.tif", heights, nodata=-9999.0), UTM33)


def test_units(tmp_path):
    heights = sloping()
    expect_plane(pcfix.read_water(write(tmp_path / "w.tif", heights, unit="m"), UTM33))
    for more, cloud in (
        ({"unit": "ft"}, UTM33),
        ({"crs": "EPSG:26910+6360"}, "EPSG:26910+5703"),
        ({"crs": "EPSG:2225"}, "EPSG:26910"),
    ):
        with refused("water.raster_unit"):
            pcfix.read_water(write(tmp_path / "f.tif", heights, **more), cloud)
    with warned("crs.assumed"):
        expect_plane(pcfix.read_water(write(tmp_path / "n.tif", heights)))


FLAT = np.full((20, 20), 10.0)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize(
    ("name", "content", "more", "code"),
    [
        ("rgb.tif", FLAT, {"bands": 3}, "water.raster_bands"),
        ("row.tif", FLAT[:1], {}, "water.raster_size"),
        ("n.tif", FLAT, {"transform": Affine.identity(), "crs": None}, "water.raster_place"),
        ("large.tif", FLAT, {}, "water.raster_size"),
        ("garbage.tif", b"II*\0nonsense", {}, "raster.damaged"),
        ("shore.csv", b"x,y,z\n1,2,3\n", {}, "water.format"),
    ],
)
def test_bad_rasters(tmp_path, monkeypatch, name, content, more, code):
    path = tmp_path / name
    monkeypatch.setattr("pcfix.io.water.MOST_CELLS", 300)
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        write(path, content, **more)
    with refused(code, pcfix.InputError, path=path):
        pcfix.read_water(path, UTM33)


# Meshes


def write_obj(path, vertices, faces):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in faces)]) + "\n")
    return path


SQUARE = [(0, 0, 1.0), (10, 0, 1.1), (10, 10, 1.1), (0, 10, 1.0)]


def test_orientation_of_facets(tmp_path):
    one = pcfix.read_water(write_obj(tmp_path / "a.obj", SQUARE, [(1, 2, 3), (1, 3, 4)]))
    other = pcfix.read_water(write_obj(tmp_path / "b.obj", SQUARE, [(1, 3, 2), (1, 3, 4)]))
    at = np.random.default_rng(1).uniform(0, 10, (200, 3))
    for name in ("height_m", "slope"):
        assert getattr(surface_above(one, at), name) == pytest.approx(
            getattr(surface_above(other, at), name), abs=1e-12
        )


def test_folds_and_walls(tmp_path):
    """Small ones do no harm, nor facets that overlap at one height."""
    more = [(9.0, 9.0, 2.0), (9.9, 9.0, 2.0), (9.0, 9.9, 2.0), (0, 0, 5.0)]
    plain = [(1, 2, 3), (1, 3, 4)]
    for faces in ([*plain, (5, 6, 7)], [*plain, (1, 2, 8)], plain + plain):
        mesh = pcfix.read_water(write_obj(tmp_path / "fold.obj", SQUARE + more, faces))
        assert len(mesh.triangles) == len(faces)


# Water and cloud


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    simulated = pcfix.simulate_scene(2000, seed=3)
    write_scene(simulated, folder, overwrite=False)
    return folder, simulated


def corrected(scene, output, water):
    folder, _ = scene
    pcfix.correct_file(folder / "cloud.laz", output, cameras=folder / "cameras.csv", water=water)


def test_raster_of_a_level(scene, tmp_path):
    simulated, path = scene[1], tmp_path / "water.tif"
    west, south = simulated.true_xyz[:, :2].min(axis=0) - 20.0
    east, north = simulated.true_xyz[:, :2].max(axis=0) + 20.0
    heights = np.full((int(north - south), int(east - west)), simulated.water_level_m)
    write(path, heights, from_origin(west, north, 1.0, 1.0), f"EPSG:{simulated.epsg}")
    corrected(scene, tmp_path / "a.las", path)
    corrected(scene, tmp_path / "b.las", simulated.water_level_m)
    one, other = laspy.read(tmp_path / "a.las"), laspy.read(tmp_path / "b.las")
    assert np.array_equal(one.classification, other.classification)
    for axis in "XYZ":  # a step of the file, where the last bit decides the rounding
        assert np.abs(one[axis] - other[axis]).max() <= 1


def test_steep_water(scene, tmp_path):
    x, y = scene[1].true_xyz[:, :2].mean(axis=0)
    plane = f"plane:{0.06 * -x + 0.37},0.06,0"
    corners = [(x - 200, y, -12), (x + 200, y, 12), (x, y + 200, 0), (x, y - 200, 0)]
    mesh = write_obj(tmp_path / "m.obj", corners, [(1, 2, 3), (1, 4, 2)])
    heights = np.tile(np.linspace(-9, 9, 300), (300, 1)).astype(np.float32)
    steep = write(tmp_path / "s.tif", heights, from_origin(x - 150, y + 150, 1, 1), "EPSG:32633")
    for water in (plane, mesh, steep):
        with pytest.raises(pcfix.GeometryError, match=r" 6\.0 %"):
            corrected(scene, tmp_path / "a.las", water)
