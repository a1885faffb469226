"""Rays of cameras through a plane water surface to a plane bed."""

import numpy as np

from pcfix.model import FloatArray
from pcfix.simulate.tracing import piercing_points_of_planes


def bed_points(
    centres: FloatArray,
    directions: FloatArray,
    water: tuple[FloatArray, FloatArray],
    bed: tuple[FloatArray, FloatArray],
    refractive_index: float,
) -> FloatArray:
    """Return where the ray of each camera meets the bed, refracted at the water, (m, 3).

    Directions have any length; `water` and `bed` are points and unit normals of the planes of each
    ray. A ray that meets the bed above the water is straight.
    """
    (anchors, normals), (places, bed_normals) = water, bed
    straight = _on_plane(centres, directions, places, bed_normals)
    wet = np.einsum("mi,mi->m", straight - anchors, normals) < 0.0
    surface = _on_plane(centres[wet], directions[wet], anchors[wet], normals[wet])
    unit = directions[wet] / np.linalg.norm(directions[wet], axis=1)[:, None]
    down = np.einsum("mi,mi->m", unit, normals[wet])[:, None]
    # Snell: the part along the surface shrinks by n, the rest is what a unit vector has left
    sideways = (unit - down * normals[wet]) / refractive_index
    rest = np.sqrt(1.0 - np.einsum("mi,mi->m", sideways, sideways))[:, None]
    refracted = sideways - rest * normals[wet]
    straight[wet] = _on_plane(surface, refracted, places[wet], bed_normals[wet])
    return straight


def _on_plane(
    origins: FloatArray, directions: FloatArray, anchors: FloatArray, normals: FloatArray
) -> FloatArray:
    gap = np.einsum("mi,mi->m", anchors - origins, normals)
    speed = np.einsum("mi,mi->m", directions, normals)
    return np.asarray(origins + (gap / speed)[:, None] * directions)


def piercing_points(
    points: FloatArray, centres: FloatArray, water_level_m: float, refractive_index: float
) -> FloatArray:
    """Return where the light from each point to its camera passes a level surface, (m, 3)."""
    anchor, normal = np.array([0.0, 0.0, water_level_m]), np.array([0.0, 0.0, 1.0])
    shape = points.shape
    return piercing_points_of_planes(
        points, centres, np.broadcast_to(anchor, shape), np.broadcast_to(normal, shape),
        refractive_index,
    )  # fmt: skip
