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


def test_all_facets():
    vertices, triangles = random_mesh(relief=0.5)
    mesh = pcfix.WaterMesh(vertices, triangles)
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(10, 40, (40, 2)), rng.uniform(-9, -3, 40)]) + UTM
    centres = np.column_stack([rng.uniform(0, 50, (4, 2)), rng.uniform(55, 65, 4)]) + UTM
    result = pcfix.correct_points(points, pcfix.Cameras(tuple("abcd"), centres), mesh)
    assert result.corrected.all()
    for point, found in zip(points, result.xyz, strict=True):
        hits = [first_hit(vertices[triangles], centre, point) for centre in centres]
        anchors = [at - point for at, _ in hits]
        down = [(point - c) / np.linalg.norm(point - c) for c in centres]
        refracted = [
            refract_ray(d, normal, 1.34) for d, (_, normal) in zip(down, hits, strict=True)
        ]
        expected = point + stacked_intersection(anchors, refracted)
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
    vertices, triangles = random_mesh(relief=0.5)
    mesh = pcfix.WaterMesh(vertices, triangles)
    rng = np.random.default_rng(9)
    points = np.column_stack([rng.uniform(10, 40, (30, 2)), rng.uniform(-9, -3, 30)]) + UTM
    centres = np.column_stack([rng.uniform(0, 50, (12, 2)), rng.uniform(55, 65, 12)]) + UTM
    cameras = pcfix.Cameras(tuple("abcdefghijkl"), centres)
    result = pcfix.correct_points(points, cameras, mesh, max_angle=limit_deg)
    for i, point in enumerate(points):
        angles = np.array([local_incidence_deg(vertices[triangles], c, point) for c in centres])
        assert result.ray_count[i] in (0, np.sum(angles <= limit_deg))
        if result.corrected[i]:
            assert result.incidence_deg[i] == pytest.approx(
                angles[angles <= limit_deg].max(), abs=1e-6
            )


def local_incidence_deg(facets, centre, point):
    _, normal = first_hit(facets, centre, point)
    up = (centre - point) / np.linalg.norm(centre - point)
    return np.degrees(np.arccos(min(1.0, float(normal @ up))))
