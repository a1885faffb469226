"""One word that says what the water surface is."""

import numpy as np
import pytest

import pcfix
from tests.utils.shared import needs

RIVER, river = needs("river")


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
def test_words(spec, expected):
    assert pcfix.read_water(spec) == expected


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


def test_obj_keeps_every_digit_and_splits_polygons(tmp_path):
    path = tmp_path / "water.obj"
    path.write_text(OBJ)
    mesh = pcfix.read_water(path)
    assert mesh.vertices[0].tolist() == [512000.12345, 4987000.54321, 10.001]
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_ply_keeps_double_precision(tmp_path, layout):
    vertices = np.array(
        [[512000.12345, 4987000.54321, 10.001], [512010.5, 4987000.5, 10], [512000, 4987010, 10]]
    )
    head = (
        f"ply\nformat {layout} 1.0\nelement vertex 3\nproperty double x\nproperty double y\n"
        "property double z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if layout == "ascii":
        body = "".join(" ".join(map(repr, map(float, v))) + "\n" for v in vertices) + "3 0 1 2\n"
        data = head + body.encode()
    else:
        data = head + vertices.astype("<f8").tobytes() + b"\x03"
        data += np.array([0, 1, 2], "<i4").tobytes()
    path = tmp_path / "water.ply"
    path.write_bytes(data)
    mesh = pcfix.read_water(path)
    assert np.array_equal(mesh.vertices, vertices)
    assert mesh.triangles.tolist() == [[0, 1, 2]]


@river
def test_river_mesh():
    mesh = pcfix.read_water(RIVER / "water_surface.obj")
    assert mesh.vertices.shape == (22, 3)
    assert mesh.triangles.shape == (31, 3)
    assert mesh.vertices[0].tolist() == [338418.55069, 272913.3172, 174.798798]
