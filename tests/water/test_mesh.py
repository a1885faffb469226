"""Water meshes: the height above a point, and refraction at the right facet."""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

import pcfix
from pcfix.water.surface import surface_above
from tests.utils.nightly import mostly_nightly
from tests.utils.twins import refract_ray, stacked_intersection

UTM = np.array([512_000.0, 4_987_000.0, 100.0])


def random_mesh(seed=3, n=60, relief=0.2):
    rng = np.random.default_rng(seed)
    plan = np.vstack([rng.uniform(0, 50, (n, 2)), [[0, 0], [0, 50], [50, 0], [50, 50]]])
    vertices = np.column_stack([plan, rng.normal(0, relief, len(plan))]) + UTM
    return vertices, Delaunay(plan).simplices.astype(np.int64)


def test_height():
    vertices, triangles = random_mesh()
    mesh = pcfix.WaterMesh(vertices, triangles)
    plan = np.random.default_rng(0).uniform(-5, 55, (5000, 2)) + UTM[:2]
    heights = surface_above(mesh, np.column_stack([plan, np.zeros(5000)])).height_m
    local = LinearNDInterpolator(Delaunay(vertices[:, :2] - UTM[:2]), vertices[:, 2])
    expected = local(plan - UTM[:2])
    assert np.array_equal(np.isnan(heights), np.isnan(expected))
    inside = ~np.isnan(heights)
    assert heights[inside] == pytest.approx(expected[inside], abs=1e-9)


def scene(labels, m=40):
    """Return points below a rough mesh, cameras above it, the mesh, and its facets' corners."""
    vertices, triangles = random_mesh(relief=0.5)
    rng, k = np.random.default_rng(8), len(labels)
    points = np.column_stack([rng.uniform(10, 40, (m, 2)), rng.uniform(-9, -3, m)]) + UTM
    centres = np.column_stack([rng.uniform(0, 50, (k, 2)), rng.uniform(55, 65, k)]) + UTM
    mesh = pcfix.WaterMesh(vertices, triangles)
    return points, pcfix.Cameras(tuple(labels), centres), mesh, vertices[triangles]


def test_all_facets():
    points, cameras, mesh, facets = scene("abcd")
    result = pcfix.correct_points(points, cameras, mesh)
    assert result.corrected.all()
    for point, found in zip(points, result.xyz, strict=True):
        at, normals = zip(*(first_hit(facets, c, point) for c in cameras.centres), strict=True)
        down = [(point - c) / np.linalg.norm(point - c) for c in cameras.centres]
        refracted = [refract_ray(d, normal, 1.34) for d, normal in zip(down, normals, strict=True)]
        expected = point + stacked_intersection(np.array(at) - point, refracted)
        assert found == pytest.approx(expected, abs=1e-8)


def first_hit(corners, centre, point):
    """Return where the line meets the mesh, and the normal, by trying every triangle."""
    ray = point - centre
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal *= (np.sign(normal[:, 2]) / np.linalg.norm(normal, axis=1))[:, None]
    far = ((corners[:, 0] - centre) * normal).sum(axis=1) / (normal @ ray)
    at = centre + far[:, None] * ray
    around = np.cross(np.roll(corners, -1, axis=1) - corners, at[:, None] - corners)
    sides = (around * normal[:, None]).sum(axis=2)
    hit = (sides >= -1e-12).all(axis=1) | (sides <= 1e-12).all(axis=1)
    assert hit.any(), "the line misses the mesh"
    first = np.flatnonzero(hit)[0]
    return at[first], normal[first]


@pytest.mark.parametrize("limit_deg", mostly_nightly((12.0, 18.0, 25.0), 18.0))
def test_max_angle(limit_deg):
    points, cameras, mesh, facets = scene("abcdefghijkl", 30)
    result = pcfix.correct_points(points, cameras, mesh, max_angle=limit_deg)
    for i, point in enumerate(points):
        up = (cameras.centres - point) / np.linalg.norm(cameras.centres - point, axis=1)[:, None]
        normals = [first_hit(facets, c, point)[1] for c in cameras.centres]
        angles = np.degrees(np.arccos(np.minimum((up * normals).sum(axis=1), 1.0)))
        used = angles[angles <= limit_deg]
        assert result.ray_count[i] in (0, len(used))
        if result.corrected[i]:
            assert result.incidence_deg[i] == pytest.approx(used.max(), abs=1e-6)
