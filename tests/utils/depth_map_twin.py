"""Slow twins of dense matching: partners by loops, depths by scipy, maps fused by bisection.

Light is traced by `pcfix.simulate.tracing`; nothing of `pcfix.refract` is used. The matcher may
have had other cameras, `before`, than those that took the images; both have the same image points.
"""

from itertools import combinations

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.spatial.transform import Rotation

from pcfix.model import Cameras, Lens
from pcfix.simulate.tracing import piercing_points_of_planes
from tests.utils.bed_rays import bed_points

LENS = Lens(3600.0, 5472.0, 3648.0, 2736.0, 1824.0)
DOWN = np.diag([1.0, -1.0, -1.0])


def looking(centres, tilts_deg, headings_deg, lens=LENS):
    """Return cameras tilted from nadir towards a heading (from east, counterclockwise)."""
    rotations = []
    for tilt, heading in zip(tilts_deg, headings_deg, strict=True):
        axis = np.array([np.sin(np.radians(heading)), -np.cos(np.radians(heading)), 0.0])
        rotations.append(DOWN @ Rotation.from_rotvec(np.radians(tilt) * axis).as_matrix().T)
    names = tuple(map(str, range(len(centres))))
    return Cameras(names, np.asarray(centres, float), np.array(rotations), (lens,) * len(names))


def pixel(cameras, c, target):
    """Return u, v of a place, straight, of a lens without distortion."""
    x, y, z = cameras.rotations[c] @ (target - cameras.centres[c])
    lens = cameras.lenses[c]
    return np.array([lens.principal_x + lens.focal * x / z, lens.principal_y + lens.focal * y / z])


def way_of(cameras, c, image):
    """Return the unit direction in which a camera sees a place in its image."""
    lens = cameras.lenses[c]
    way = [*((image - [lens.principal_x, lens.principal_y]) / lens.focal), 1.0]
    return cameras.rotations[c].T @ way / np.linalg.norm(way)


def plane_of(plane):
    """Return a point and the unit normal of z = a + b x + c y, as rows of arrays."""
    a, b, c = plane
    normal = np.array([-b, -c, 1.0]) / np.sqrt(1.0 + b * b + c * c)
    return np.array([[0.0, 0.0, a]]), normal[None]


def costs_of(p, u, q, cameras, partners, planes, n, metric, before=None):
    """Return for each partner its squared residual, px^2, as a function of the way t beyond p.

    In pixels, or as angles times the focal length as seen from where it is least.
    """
    before = before or cameras

    def one(j):
        centre, focal = before.centres[j], before.lenses[j].focal
        now = cameras.centres[j][None]
        piercing = piercing_points_of_planes(q[None], now, *plane_of(planes[j]), n)[0]
        there = pixel(cameras, j, piercing)
        if metric == "pixels":
            return lambda t: float(((pixel(before, j, p + t * u) - there) ** 2).sum())
        ray = way_of(before, j, there)

        def miss2(t):
            return float((np.cross(p + t * u - centre, ray) ** 2).sum())

        least = minimize_scalar(miss2, bracket=(-0.5, 0.5), options={"xtol": 1e-11}).x
        scale = (focal / ((p + least * u - centre) @ ray)) ** 2
        return lambda t: scale * miss2(t)

    return [one(j) for j in partners]


def slow_depth(costs, tolerance):
    """Return t at which pairs agree best: the mean over pairs, weighted by exp(-squares / tol)."""
    found = []
    for one, other in combinations(costs, 2):

        def both(t, one=one, other=other):
            return one(t) + other(t)

        at = minimize_scalar(both, bracket=(-0.5, 0.5), options={"xtol": 1e-11}).x
        found.append((both(at), at))
    squares, at = np.array(found).T
    return float(np.average(at, weights=np.exp((squares.min() - squares) / tolerance)))


def fused_slowly(
    start, maps, weights, cameras, matched, planes, bed, n, tolerance, metric, before=None
):
    """Return the fused point of a bed on the plumb line of a start, and what it shows.

    At the height at which the weighted ways along the rays add up to nothing up or down; the
    plane of the bed is (a, b, c) of z = a + b x + c y.
    """
    before = before or cameras

    def ways(z):
        p = np.array([*start[:2], z])
        total, shown = 0.0, []
        for c, w in zip(maps, weights, strict=True):
            u = (p - before.centres[c]) / np.linalg.norm(p - before.centres[c])
            way = way_of(cameras, c, pixel(before, c, p))
            seen = cameras.centres[c][None], way[None], plane_of(planes[c]), plane_of(bed)
            q = bed_points(*seen, n)[0]
            costs = costs_of(p, u, q, cameras, matched[c], planes, n, metric, before)
            total += w * u[2] * slow_depth(costs, tolerance)
            shown.append(q)
        return total, np.average(shown, 0, weights)

    z = brentq(lambda z: ways(z)[0], start[2] - 3.0, start[2] + 3.0, xtol=1e-7)
    return np.array([*start[:2], z]), ways(z)[1]
