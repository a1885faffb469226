"""A raster made slowly: one cell after the other, in exact fractions where it can be."""

import math
from fractions import Fraction
from itertools import combinations
from statistics import fmean, median, pstdev

import numpy as np


def exact(values, scale, offset):
    """Return the coordinates that whole steps of a LAS file stand for."""
    return [Fraction(int(v)) * Fraction(scale) + Fraction(offset) for v in values]


def slow_raster(x, y, z, resolution, method, widest=0.0):
    """Return left, top (in cells) and the dicts height, count and spread by (row, column).

    x, y, z and resolution are fractions.
    """
    columns = [math.floor(v / resolution) for v in x]
    rows = [math.floor(v / resolution) for v in y]
    left, top = min(columns), max(rows)
    inside: dict[tuple[int, int], list[int]] = {}
    for i, (column, row) in enumerate(zip(columns, rows, strict=True)):
        inside.setdefault((top - row, column - left), []).append(i)
    u = [float(v / resolution - left) for v in x]
    v = [float(top + 1 - w / resolution) for w in y]
    heights = [float(w) for w in z]
    shape = top - min(rows) + 1, max(columns) - left + 1
    height, count, spread = (np.full(shape, np.nan) for _ in range(3))
    for cell in np.ndindex(shape):
        own = [heights[i] for i in inside.get(cell, [])]
        count[cell] = len(own)
        spread[cell] = pstdev(own) if own else np.nan
        if method == "tin":
            height[cell] = slow_tin(u, v, heights, cell[1] + 0.5, cell[0] + 0.5, widest)
        elif own:
            height[cell] = {"mean": fmean, "median": median, "min": min, "max": max}[method](own)
    return left, top, height, count, spread


def slow_tin(u, v, z, x, y, widest):
    """Try every three points: the triangle around the place whose circle is empty."""
    for three in combinations(range(len(u)), 3):
        a, b = [u[i] for i in three], [v[i] for i in three]
        if not (min(a) <= x <= max(a) and min(b) <= y <= max(b)):
            continue
        corners = np.array([[u[i], v[i], 1.0] for i in three])
        if abs(np.linalg.det(corners)) < 1e-12:
            continue
        shares = np.linalg.solve(corners.T, [x, y, 1.0])
        if shares.min() < 0.0:
            continue
        # |p|^2 = 2 c.p + (r^2 - |c|^2) on the circle about c
        cx, cy, rest = np.linalg.solve(corners * [2, 2, 1], (corners[:, :2] ** 2).sum(axis=1))
        radius = math.sqrt(rest + cx * cx + cy * cy)
        others = (i for i in range(len(u)) if i not in three)
        if all(math.hypot(u[i] - cx, v[i] - cy) > radius for i in others):
            return float(shares @ [z[i] for i in three]) if 2.0 * radius <= widest else math.nan
    return math.nan


def slow_hillshade(height, resolution, azimuth, altitude):
    """Light one cell after the other; the normal and the sun are vectors."""
    a, e = math.radians(azimuth), math.radians(altitude)
    sun = np.array([math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)])
    out = np.full(height.shape, np.nan)
    for row, column in np.ndindex(height.shape):
        own = height[row, column]
        if math.isnan(own):
            continue
        dx = dy = 0.0
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                r, c = row + down, column + right
                there = own
                if 0 <= r < height.shape[0] and 0 <= c < height.shape[1]:
                    there = own if math.isnan(height[r, c]) else height[r, c]
                weight = 2 if 0 in (down, right) else 1
                dx += weight * right * there / (8.0 * resolution)
                dy -= weight * down * there / (8.0 * resolution)
        normal = np.array([-dx, -dy, 1.0])
        out[row, column] = round(254 * max(0.0, normal @ sun / np.linalg.norm(normal))) / 254
    return out
