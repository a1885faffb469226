"""Slow twins: the same physics by other means, for the kernels to agree with.

No code of pcfix is used here. Snell's law is solved in the plane of incidence with angles
(the kernels use the vector form), and the intersection is a stacked linear system for numpy.
"""

import math

import numpy as np
from scipy.optimize import brentq, root


def refract_ray(direction, normal, n):
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
        directions.append(refract_ray(down, normal, n))
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


def first_crossing(surface, point, centre):
    """Return where the line from a camera to a point meets z = surface(x, y), and the normal.

    A root by bisection and interpolation (Brent) of the height above the surface, and the slope
    by differences over a micrometre.
    """
    ray = centre - point

    def gap(share):
        at = point + share * ray
        return surface(at[0], at[1]) - at[2]

    low = brentq(gap, 0.0, 0.9, xtol=1e-15, rtol=1e-14)
    at = point + low * ray
    d = 1e-6
    slope_x = (surface(at[0] + d, at[1]) - surface(at[0] - d, at[1])) / (2 * d)
    slope_y = (surface(at[0], at[1] + d) - surface(at[0], at[1] - d)) / (2 * d)
    normal = np.array([-slope_x, -slope_y, 1.0])
    return at, normal / np.linalg.norm(normal)


def correct_under(surface, point, centres, n):
    """Return the true point where rays bend at z = surface(x, y), one function or one a camera."""
    surfaces = [surface] * len(centres) if callable(surface) else surface
    anchors, directions = [], []
    for above, centre in zip(surfaces, centres, strict=True):
        at, normal = first_crossing(above, point, centre)
        anchors.append(at - point)
        directions.append(refract_ray((point - centre) / np.linalg.norm(point - centre), normal, n))
    return point + stacked_intersection(anchors, directions)


def plane_slowly(lens, direction):
    """Return the plane coordinates of a direction from the published formula of the projection."""
    x, y, z = (float(value) for value in direction)
    across = math.hypot(x, y)
    if lens.projection == "perspective":
        return x / z, y / z
    theta = math.acos(z / math.sqrt(x * x + y * y + z * z))
    s = lens.shape
    if lens.projection == "equidistant":  # Kannala & Brandt 2006; OpenCV's fisheye
        rho = theta
    elif lens.projection == "equisolid":
        rho = 2.0 * math.sin(theta / 2.0)
    elif lens.projection == "polynomial":  # Pix4D's fisheye: theta runs from 0 to 1 at 90 degrees
        rho = sum(s[i] * (2.0 * theta / math.pi) ** i for i in range(len(s)))
    elif lens.projection == "fov":  # Devernay & Faugeras 2001
        rho = math.atan(2.0 * math.tan(s[0] / 2.0) * across / z) / s[0]
    elif lens.projection == "dual":
        rho = s[0] * across / z + (1.0 - s[0]) * theta
    elif lens.projection == "division":  # Fitzgibbon 2001: (x, y, 1 + k r^2) is the direction
        end = 1.0 / math.sqrt(s[0]) if s[0] > 0.0 else 1e6
        rho = brentq(lambda m: m * z - across * (1.0 + s[0] * m * m), 0.0, end, xtol=1e-15)
    else:  # Khomutenko, Garcia & Martinet 2016
        d = math.sqrt(s[1] * across**2 + z * z)
        rho = across / (s[0] * d + (1.0 - s[0]) * z)
    return (rho * x / across, rho * y / across) if across > 0.0 else (0.0, 0.0)


def brown_slowly(lens, x, y):
    """Return Brown's formula (Fraser 1997; OpenCV's denominators and thin prism), term by term."""
    x, y = x - lens.distortion_centre[0], y - lens.distortion_centre[1]
    r = math.hypot(x, y)
    above = 1.0 + sum(k * r ** (2 * i + 2) for i, k in enumerate(lens.radial))
    below = 1.0 + sum(k * r ** (2 * i + 2) for i, k in enumerate(lens.denominator))
    straight = x * above / below, y * above / below
    if lens.in_turn:
        x, y = straight
        r = math.hypot(x, y)
    p1, p2, p3, p4 = (*lens.tangential, 0.0, 0.0, 0.0, 0.0)[:4]
    s1, s2, s3, s4 = (*lens.thin_prism, 0.0, 0.0, 0.0, 0.0)[:4]
    more = 1.0 + p3 * r**2 + p4 * r**4
    side = (p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y) * more + s1 * r**2 + s2 * r**4
    down = (p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y) * more + s3 * r**2 + s4 * r**4
    return (
        straight[0] + side + lens.distortion_centre[0],
        straight[1] + down + lens.distortion_centre[1],
    )


def image_slowly(lens, direction):
    """Return u, v of a direction; folds are not looked for."""
    x, y = plane_slowly(lens, direction)
    if lens.inverse:
        found = root(lambda q: np.subtract(brown_slowly(lens, *q), (x, y)), (x, y), tol=1e-15)
        xd, yd = found.x
    else:
        xd, yd = brown_slowly(lens, x, y)
    u = lens.principal_x + (lens.focal + lens.b1) * xd + lens.b2 * yd
    return u, lens.principal_y + lens.focal * yd + lens.b3 * xd
