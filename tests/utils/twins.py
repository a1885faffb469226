"""Slow twins: the same physics by other means, for the kernels to agree with.

No code of pcfix is used here. Snell's law is solved in the plane of incidence with angles
(the kernels use the vector form), and the intersection is a stacked linear system for numpy.
"""

import math

import numpy as np
from scipy.optimize import root


def bend(direction, normal, n):
    """Refract a downward unit direction by rotating it in the plane of incidence."""
    incidence = math.acos(min(1.0, -float(normal @ direction)))
    refraction = math.asin(math.sin(incidence) / n)
    sideways = direction + math.cos(incidence) * normal
    length = np.linalg.norm(sideways)
    if length < 1e-15:
        return direction
    return math.sin(refraction) * sideways / length - math.cos(refraction) * normal


def stacked_intersection(anchors, directions):
    """Solve eq 11 of Skarlatos & Agrafiotis 2018 as one system: Q - s_i t_i = A_i.

    Unknowns are Q and the length along each ray; two rays give 6 equations for 5 unknowns.
    """
    k = len(anchors)
    system, right = np.zeros((3 * k, 3 + k)), np.zeros(3 * k)
    for i in range(k):
        system[3 * i : 3 * i + 3, :3] = np.eye(3)
        system[3 * i : 3 * i + 3, 3 + i] = -directions[i]
        right[3 * i : 3 * i + 3] = anchors[i]
    return np.linalg.lstsq(system, right, rcond=None)[0][:3]


def correct_slowly(point, centres, plane, n):
    """Return the true point, its rms distance from the rays, and the largest incidence, deg.

    `plane` is (a, b, c) of z = a + b x + c y.
    """
    a, b, c = plane
    normal = np.array([-b, -c, 1.0]) / math.sqrt(1.0 + b * b + c * c)
    anchors, directions, angles = [], [], []
    for centre in centres:
        down = (point - centre) / np.linalg.norm(point - centre)
        gap = centre[2] - (a + b * centre[0] + c * centre[1])
        reach = gap / (b * down[0] + c * down[1] - down[2])
        anchors.append(centre + reach * down - point)
        directions.append(bend(down, normal, n))
        angles.append(math.degrees(math.acos(min(1.0, -float(normal @ down)))))
    shift = stacked_intersection(anchors, directions)
    distances = [
        np.linalg.norm((shift - p) - ((shift - p) @ t) * t)
        for p, t in zip(anchors, directions, strict=True)
    ]
    return point + shift, float(np.sqrt(np.mean(np.square(distances)))), max(angles)


def light_path(point, centre, plane, n):
    """Return where light from a point to a camera crosses a plane: least optical length.

    Fermat's principle: the gradient of |C - A| + n |A - P| along the plane is zero. Solved by
    scipy's general root finder in the two coordinates of the plane.
    """
    a, b, c = plane
    along = np.array([[1.0, 0.0, b], [0.0, 1.0, c]])

    def crossing(xy):
        return np.array([xy[0], xy[1], a + b * xy[0] + c * xy[1]])

    def gradient(xy):
        air, water = crossing(xy) - centre, crossing(xy) - point
        return along @ (air / np.linalg.norm(air) + n * water / np.linalg.norm(water))

    height = centre[2] - crossing(centre[:2])[2]
    depth = crossing(point[:2])[2] - point[2]
    share = height / (height + depth / n)
    found = root(gradient, centre[:2] + share * (point - centre)[:2], tol=1e-14)
    assert np.abs(gradient(found.x)).max() < 1e-11
    return crossing(found.x)
