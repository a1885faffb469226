"""Draw the figures of pcfix/README.md, with every ray computed by Snell's law.

python samples/figures/draw.py     writes the SVG files next to this script

All figures are sections: x to the right, z up, the water surface at z = 0. The refractive index is
that of the default, 1.34. Depths are large compared with the flying heights, so that the geometry
can be seen.
"""

from itertools import combinations
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Arc, Ellipse, FancyArrowPatch, Wedge
from scipy.optimize import brentq, least_squares, minimize_scalar, root

HERE = Path(__file__).parent
N = 1.34
GLASS = 1.49
WATER, LINE = "#dcebf6", "#2c6fa6"
REFRACTED, STRAIGHT, WRONG, GROUND = "#17324d", "#8a8f94", "#c2452d", "#8a6a3b"
UP = np.array([0.0, 1.0])


def unit(vector):
    return vector / np.linalg.norm(vector)


def refracted(ray, normal, ratio):
    """Return the unit ray behind the surface; ``ratio`` is n before it / n behind it."""
    c = -normal @ ray
    return ratio * ray + (ratio * c - np.sqrt(1 - ratio**2 * (1 - c**2))) * normal


def in_water(camera, air_point):
    """Return the piercing point of a straight ray to a point, and its refracted ray."""
    ray = unit(air_point - camera)
    piercing = camera - ray * camera[1] / ray[1]
    return piercing, refracted(ray, UP, 1 / N)


def piercing_point(camera, point):
    """Return where the light from a point under water to the camera leaves the water (Fermat)."""

    def off(x):
        air, water = np.array([x, 0.0]) - camera, point - np.array([x, 0.0])
        return air[0] / np.linalg.norm(air) - N * water[0] / np.linalg.norm(water)

    if camera[0] == point[0]:
        return np.array([point[0], 0.0])
    return np.array([brentq(off, *sorted((camera[0], point[0]))), 0.0])


def crossing(p, s, q, t):
    """Return where the lines p + a s and q + b t intersect."""
    a = np.linalg.solve(np.column_stack([s, -t]), q - p)[0]
    return p + a * s


def image(camera, point):
    """Return the image coordinate of a point in a nadir camera with the focal length 1."""
    return (point[0] - camera[0]) / (camera[1] - point[1])


# Drawing


def axes(columns=1, width=6.4, height=3.0, **sharing):
    figure, found = plt.subplots(1, columns, figsize=(width, height), **sharing)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.02, top=0.98, wspace=0.04)
    return figure, found


def scene(ax, left, right, bottom, top, surface=True):
    """Set the frame of a section, with water below z = 0."""
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    ax.axis("off")
    if surface:
        ax.fill_between([left, right], bottom, 0, color=WATER, lw=0, zorder=0)
        ax.plot([left, right], [0, 0], color=LINE, lw=1.2, zorder=1)


def line(ax, *points, color=REFRACTED, style="-", width=1.2, order=3):
    x, z = np.transpose(points)
    ax.plot(x, z, color=color, ls=style, lw=width, zorder=order, solid_capstyle="round")


def straight(ax, *points, color=STRAIGHT):
    line(ax, *points, color=color, style=(0, (4, 2.5)), width=1.0, order=2)


def text(ax, where, words, dx=0.0, dz=0.0, ha="center", va="center", color="black", size=9):
    ax.text(where[0] + dx, where[1] + dz, words, ha=ha, va=va, color=color, fontsize=size, zorder=6)


def camera_at(ax, centre, label="", dx=0.0, dz=0.16, look=(0.0, -1.0), size=0.13, ha="center"):
    """Draw a camera as a triangle with its projection centre on top."""
    look = unit(np.array(look))
    side = np.array([-look[1], look[0]])
    corners = [centre, centre + size * (look + 0.7 * side), centre + size * (look - 0.7 * side)]
    ax.fill(*np.transpose(corners), fc="white", ec="black", lw=1.0, zorder=4)
    ax.plot(*centre, "o", ms=2.6, color="black", zorder=5)
    text(ax, centre, label, dx, dz, ha=ha)


def apparent(ax, where, label="A", dx=0.0, dz=0.0, color=WRONG, **place):
    ax.plot(*where, "o", ms=6, mfc="white", mec=color, mew=1.5, zorder=5)
    text(ax, where, label, dx, dz, color=color, **place)


def true(ax, where, label="Q", dx=0.0, dz=0.0, **place):
    ax.plot(*where, "o", ms=6, color=REFRACTED, zorder=5)
    text(ax, where, label, dx, dz, color=REFRACTED, **place)


def angle(ax, centre, start_deg, end_deg, radius, label, factor=1.3):
    ax.add_patch(Arc(centre, 2 * radius, 2 * radius, theta1=start_deg, theta2=end_deg, lw=0.9))
    middle = np.radians((start_deg + end_deg) / 2)
    text(ax, centre, label, *(factor * radius * np.array([np.cos(middle), np.sin(middle)])))


def zoomed(ax, place, centre, half):
    """Return an inset that shows the surroundings of a point enlarged."""
    inset = ax.inset_axes(place)
    inset.set(
        xlim=(centre[0] - half[0], centre[0] + half[0]),
        ylim=(centre[1] - half[1], centre[1] + half[1]), xticks=[], yticks=[], facecolor=WATER,
    )  # fmt: skip
    ax.indicate_inset_zoom(inset, edgecolor="black", lw=0.7)
    return inset


def arrow(ax, start, end, color="black", style="-|>", size=8):
    ax.add_patch(
        FancyArrowPatch(
            start, end, arrowstyle=style, mutation_scale=size, color=color, lw=1.0, zorder=4,
            shrinkA=0, shrinkB=0,
        )
    )  # fmt: skip


# Figures


def snell():
    """One ray at a plane surface."""
    figure, ax = axes(height=3.3)
    scene(ax, -3.3, 3.7, -2.25, 1.6)
    a = np.radians(42.0)
    b = np.arcsin(np.sin(a) / N)
    c, p, q = np.array([-1.35 * np.tan(a), 1.35]), np.zeros(2), 1.95 * np.array([np.tan(b), -1])
    point_a = np.array([q[0], -q[0] / np.tan(a)])
    line(ax, c, p, q)
    straight(ax, p, point_a)
    line(ax, (0, 1.25), (0, -1.1), color="black", style=":", width=1.0)
    line(ax, point_a, q, color=STRAIGHT, style=":", width=0.9, order=1)
    camera_at(ax, c, "C  projection centre", dx=-0.15, dz=0.1, look=p - c, ha="right")
    ax.plot(*p, "o", ms=4, color="black", zorder=5)
    text(ax, p, "P  piercing point", -0.12, -0.17, ha="right")
    text(ax, (0, 1.38), "N")
    angle(ax, p, 90, 90 + np.degrees(a), 0.55, "a", 1.28)
    angle(ax, p, 270, 270 + np.degrees(b), 0.75, "b", 1.18)
    apparent(ax, point_a, "A  apparent point", 0.16, ha="left")
    true(ax, q, "Q  true point", 0.16, ha="left")
    text(ax, (3.6, 0.13), "water surface", ha="right", color=LINE)
    text(ax, (3.6, 1.1), "sin a = n sin b", ha="right")
    text(ax, (-3.2, 0.13), "air", ha="left", color=STRAIGHT)
    text(ax, (-3.2, -0.16), "water, n = 1.34", ha="left", color=LINE)
    text(ax, 0.45 * point_a, "straight ray", 0.12, 0.05, ha="left", color=STRAIGHT, size=8)
    text(ax, 0.72 * q, "refracted ray", -0.12, -0.05, ha="right", color=REFRACTED, size=8)
    return figure


def intersection():
    """The point with the smallest sum of squared distances from the refracted rays of A."""
    figure, ax = axes(height=3.9)
    scene(ax, -4.3, 3.9, -2.95, 1.75)
    point_a = np.array([0.0, -1.3])
    matrix, right, rays = np.zeros((2, 2)), np.zeros(2), []
    cameras = [np.array([x, 1.25]) for x in (-2.9, -0.8, 1.5)]
    for centre in cameras:
        p, t = in_water(centre, point_a)
        m = np.eye(2) - np.outer(t, t)
        matrix, right = matrix + m, right + m @ p
        rays.append((p, t))
    q = np.linalg.solve(matrix, right)
    zoom = zoomed(ax, (0.68, 0.06, 0.3, 0.44), q, (0.42, 0.34))
    for k, (centre, (p, t)) in enumerate(zip(cameras, rays, strict=True)):
        straight(ax, p, point_a)
        camera_at(ax, centre, f"C{'₁₂₃'[k]}", look=p - centre)
        ax.plot(*p, "o", ms=3, color="black", zorder=5)
        text(ax, p, f"P{'₁₂₃'[k]}", -0.2 if k < 2 else 0.2, -0.17)
        for one in (ax, zoom):
            line(one, centre, p, p + 1.35 * np.linalg.norm(q - p) * t)
        line(zoom, q, p + ((q - p) @ t) * t, color=WRONG, width=2.0, order=4)
    apparent(ax, point_a, "A", 0.45, 0.05)
    true(ax, q, "")
    true(zoom, q, "Q", 0.12, 0.06)
    text(ax, rays[0][0] + 0.55 * rays[0][1], "t₁", -0.22, -0.08, color=REFRACTED)
    text(ax, (3.8, 0.15), "water surface", ha="right", color=LINE)
    text(ax, (3.72, -0.45), "red: distances from the rays", ha="right", color=WRONG, size=8)
    text(ax, (-4.2, -2.3), "dashed: straight rays, through A", ha="left", color=STRAIGHT, size=8)
    text(ax, (-4.2, -2.53), "solid: refracted rays", ha="left", color=REFRACTED, size=8)
    return figure


def triangulated(cameras, images):
    """Return the point with the smallest image residuals of straight rays."""

    def residuals(x):
        return [image(c, x) - found for c, found in zip(cameras, images, strict=True)]

    return least_squares(residuals, [0.0, -1.0], xtol=1e-14, ftol=1e-14).x


def tracks():
    """Straight-ray triangulation of the images of a true point."""
    figure, ax = axes(height=3.9)
    scene(ax, -4.3, 3.9, -2.95, 1.75)
    q = np.array([0.0, -2.3])
    cameras = [np.array([x, 1.25]) for x in (-3.0, -0.9, 1.6)]
    piercing = [piercing_point(c, q) for c in cameras]
    point_a = triangulated(cameras, [image(c, p) for c, p in zip(cameras, piercing, strict=True)])
    zoom = zoomed(ax, (0.68, 0.06, 0.3, 0.44), point_a, (0.62, 0.5))
    for k, (c, p) in enumerate(zip(cameras, piercing, strict=True)):
        for one in (ax, zoom):
            line(one, q, p, c)
            straight(one, p, p + 1.2 * np.linalg.norm(point_a - p) * unit(p - c))
        line(zoom, c, point_a, color=WRONG, style=(0, (1, 1.5)))
        camera_at(ax, c, f"C{'₁₂₃'[k]}")
        ax.plot(*p, "o", ms=3, color="black", zorder=5)
    true(ax, q, "Q", -0.24, -0.05)
    apparent(ax, point_a, "")
    apparent(zoom, point_a, "A", 0.0, 0.16)
    text(ax, (3.8, 0.15), "water surface", ha="right", color=LINE)
    text(ax, (3.72, -0.45), "red: rays from A to the cameras", ha="right", color=WRONG, size=8)
    text(ax, (-4.2, -2.3), "solid: light from Q", ha="left", color=REFRACTED, size=8)
    text(
        ax, (-4.2, -2.53), "dashed: straight rays of its images", ha="left", color=STRAIGHT, size=8
    )
    return figure


def depth_of_image(camera, ray, partners, bed_m):
    """Return the piercing point and true point of a ray, the point at its depth, and more.

    The last are the piercing points of the partners, which see the true point, too.
    """
    p = camera - ray * camera[1] / ray[1]
    t = refracted(ray, UP, 1 / N)
    q = p + t * (bed_m - p[1]) / t[1]
    piercing = [piercing_point(k, q) for k in partners]
    images = [image(k, x) for k, x in zip(partners, piercing, strict=True)]

    def cost(d):
        x = camera + d * ray
        return sum((image(k, x) - found) ** 2 for k, found in zip(partners, images, strict=True))

    surface = np.linalg.norm(p - camera)
    d = minimize_scalar(cost, bounds=(surface, surface + 3), method="bounded").x
    return p, q, camera + d * ray, piercing


def depth_maps():
    """The depth of one image, and the mean of the depths of several."""
    figure, (one, fused) = axes(2, width=7.4, height=3.7)
    for ax in (one, fused):
        scene(ax, -2.5, 2.5, -2.65, 2.2)
    camera, partners = np.array([-1.4, 1.1]), [np.array([x, 1.1]) for x in (0.15, 1.7)]
    ray = unit(np.array([0.0, -1.5]) - camera)
    p, q, base, piercing = depth_of_image(camera, ray, partners, -2.1)
    line(one, camera, p, q)
    straight(one, p, base + 0.45 * ray)
    for k, (partner, x) in enumerate(zip(partners, piercing, strict=True)):
        line(one, q, x, partner, color=LINE, width=0.9)
        straight(one, x, x + 1.75 * unit(x - partner))
        camera_at(one, partner, f"partner {k + 1}", dz=0.19)
    camera_at(one, camera, "image i", dz=0.19)
    text(one, (camera + p) / 2, "sᵢ", -0.2, -0.05)
    text(one, (-2.4, -1.0), "dᵢ: length from\nCᵢ to A", ha="left", color=STRAIGHT, size=8)
    apparent(one, base, "A", 0.27, 0.0)
    true(one, q, "Q", 0.22, -0.12)
    text(one, (0, 2.05), "Single depth map: A is on the ray of image i,", size=8.5)
    text(one, (0, 1.82), "where its two best partners agree best", size=8.5)

    cameras = [np.array([x, 1.1]) for x in (-2.2, -0.6, 1.2)]
    point_a = np.array([0.0, -1.4])
    base = np.array([0.6, 0.0])
    others = [[c + base, c - base] for c in cameras]

    def maps(bed_m):
        return [
            depth_of_image(c, unit(point_a - c), k, bed_m)
            for c, k in zip(cameras, others, strict=True)
        ]

    bed_m = brentq(lambda h: np.mean([d[1] for _, _, d, _ in maps(h)]) - point_a[1], -3.0, -1.45)
    found = maps(bed_m)
    for k, (c, (p, q, place, _)) in enumerate(zip(cameras, found, strict=True)):
        line(fused, c, p, q)
        straight(fused, p, point_a + 0.45 * unit(point_a - c))
        camera_at(fused, c, f"C{'₁₂₃'[k]}", dz=0.19)
        fused.plot(*q, "o", ms=3.5, color=REFRACTED, zorder=5)
        fused.plot(*place, "s", ms=5, mfc="white", mec=LINE, mew=1.3, zorder=5)
    line(fused, (-2.4, bed_m), (2.4, bed_m), color=GROUND, width=1.0)
    text(fused, (2.4, bed_m), "bed at the height h", 0, -0.16, ha="right", color=GROUND, size=8)
    true(fused, np.array([np.mean([q[0] for _, q, _, _ in found]), bed_m]), "Q", 0.0, -0.24)
    apparent(fused, point_a, "A", 0.27, 0.0)
    text(fused, (-2.4, -1.0), "squares: depths\nof the images", ha="left", color=LINE, size=8)
    text(fused, (0, 2.05), "Fused depth maps: A is the mean of the depths", size=8.5)
    text(fused, (0, 1.82), "of several images, each on its own ray", size=8.5)
    return figure


def stereo_pairs():
    """The median of the intersections of straight rays, pair by pair."""
    figure, ax = axes(height=3.9)
    scene(ax, -4.3, 3.9, -2.95, 1.75)
    q = np.array([0.0, -2.3])
    cameras = [np.array([x, 1.25]) for x in (-3.2, -1.5, 0.4, 2.3)]
    piercing = [piercing_point(c, q) for c in cameras]
    rays = [unit(p - c) for c, p in zip(cameras, piercing, strict=True)]
    places = np.array(
        [crossing(cameras[i], rays[i], cameras[k], rays[k]) for i, k in combinations(range(4), 2)]
    )
    point_a = np.median(places, axis=0)
    zoom = zoomed(ax, (0.68, 0.06, 0.3, 0.44), places.mean(0), (0.55, 0.75))
    for k, (c, p, s) in enumerate(zip(cameras, piercing, rays, strict=True)):
        for one in (ax, zoom):
            line(one, q, p, c)
            straight(one, p, p + 1.3 * np.linalg.norm(point_a - p) * s)
        camera_at(ax, c, f"C{'₁₂₃₄'[k]}")
        ax.plot(*p, "o", ms=3, color="black", zorder=5)
    zoom.plot(*places.T, "s", ms=5, mfc="white", mec=LINE, mew=1.3, zorder=5)
    apparent(ax, point_a, "")
    apparent(zoom, point_a, "A", -0.15, 0.0)
    true(ax, q, "Q", -0.24, -0.05)
    text(ax, (3.8, 0.15), "water surface", ha="right", color=LINE)
    text(ax, (3.72, -0.45), "squares: intersections of two rays", ha="right", color=LINE, size=8)
    text(ax, (-4.2, -2.3), "solid: light from Q", ha="left", color=REFRACTED, size=8)
    text(
        ax, (-4.2, -2.53), "dashed: straight rays of its images", ha="left", color=STRAIGHT, size=8
    )
    return figure


def through(start, ray, surfaces):
    """Trace a ray through surfaces: functions that return place and normal, and index ratios."""
    path = [start]
    for meet, ratio in surfaces:
        place, normal = meet(path[-1], ray)
        ray = refracted(ray, normal, ratio)
        path.append(place)
    return path, ray


def port():
    """A flat port, and a dome port whose centre is not the projection centre."""
    figure, (flat, dome) = axes(2, width=7.4, height=3.0)
    for ax in (flat, dome):
        scene(ax, -0.9, 3.4, -1.5, 1.5, surface=False)
        ax.fill_between([-0.9, 3.4], -1.5, 1.5, color=WATER, lw=0, zorder=0)
        text(ax, (3.3, -1.36), "water", ha="right", color=LINE, size=8)
    glass = "#a9c9b6"
    centre = np.zeros(2)

    near, far = 0.9, 1.2
    flat.fill([-0.6, near, near, -0.6], [-1.25, -1.25, 1.25, 1.25], fc="white", ec="black", lw=1)
    flat.fill([near, far, far, near], [-1.25, -1.25, 1.25, 1.25], fc=glass, lw=0)

    def plane(x):
        return lambda start, ray: (start + ray * (x - start[0]) / ray[0], np.array([-1.0, 0.0]))

    for degrees in (-42.0, 0.0, 42.0):
        ray = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        path, out = through(centre, ray, [(plane(near), 1 / GLASS), (plane(far), GLASS / N)])
        line(flat, *path, path[-1] + 0.8 * out)
        if degrees:
            straight(flat, path[1], path[1] + 0.8 * ray)
    camera_at(flat, centre, "C", dx=-0.17, dz=0.0, look=(1.0, 0.0), size=0.22)
    line(flat, (0, -1.0), (near, -1.0), color="black", width=0.8)
    for x in (0.0, near):
        line(flat, (x, -1.06), (x, -0.94), color="black", width=0.8)
    text(flat, (near / 2, -1.13), "distance", size=8)
    text(flat, (1.05, 1.36), "glass", size=8)
    text(flat, (-0.5, 1.1), "air", ha="left", size=8)
    text(flat, (3.3, 1.34), "flat port", ha="right", size=9)

    inner, outer = 1.0, 1.2
    middle = np.array([0.45, 0.0])
    box = [[middle[0], -0.6, -0.6, middle[0]], [-outer, -outer, outer, outer]]
    dome.fill(*box, fc="white", lw=0, zorder=1)
    dome.plot(*box, color="black", lw=1, zorder=3)
    dome.add_patch(Wedge(middle, outer, -90, 90, fc=glass, lw=0, zorder=1))
    dome.add_patch(Wedge(middle, inner, -90, 90, fc="white", lw=0, zorder=2))

    def sphere(radius):
        def meet(start, ray):
            to = start - middle
            b = to @ ray
            place = start + (-b + np.sqrt(b * b - to @ to + radius**2)) * ray
            return place, -unit(place - middle)

        return meet

    for degrees in (-38.0, 0.0, 38.0):
        ray = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        path, out = through(centre, ray, [(sphere(inner), 1 / GLASS), (sphere(outer), GLASS / N)])
        line(dome, *path, path[-1] + 0.9 * out)
        if degrees:
            straight(dome, path[1], path[1] + 1.2 * ray)
            line(dome, middle, path[1], color="black", style=":", width=0.9)
    camera_at(dome, centre, "C", dx=-0.17, dz=0.0, look=(1.0, 0.0), size=0.22)
    dome.plot(*middle, "+", ms=9, color="black", zorder=6)
    text(dome, (-0.05, -0.95), "centre of\nthe dome", size=8)
    line(dome, (0.1, -0.76), (0.43, -0.09), color="black", width=0.7)
    text(dome, (3.3, 1.34), "dome port", ha="right", size=9)
    return figure


def discontinuities():
    """The bed of a cloud of stereo pairs, corrected as what it is and as tracks."""
    figure, ax = axes(height=2.7)
    figure.subplots_adjust(left=0.13, right=0.98, bottom=0.19, top=0.97)
    height_m, depth_m, reach = 3.0, 1.0, 0.62
    cameras = [np.array([x, height_m]) for x in np.arange(-6.0, 6.1, 1.0)]
    places, heights, counts = np.linspace(-1.6, 1.6, 161), [], []
    for x in places:
        q = np.array([x, -depth_m])
        shown = [(c, piercing_point(c, q)) for c in cameras]
        shown = [(c, p) for c, p in shown if abs(image(c, p)) < reach]
        rays = [unit(p - c) for c, p in shown]
        point_a = np.median(
            [
                crossing(shown[i][0], rays[i], shown[k][0], rays[k])
                for i, k in combinations(range(len(shown)), 2)
            ],
            axis=0,
        )

        def equations(found, shown=shown, point_a=point_a):
            total = np.zeros(2)
            for c, _ in shown:
                down = c[1] - point_a[1]
                j = np.array([1 / down, (point_a[0] - c[0]) / down**2])
                total += j * (image(c, piercing_point(c, found)) - image(c, point_a))
            return total

        heights.append(root(equations, q, tol=1e-10).x[1])
        counts.append(len(shown))
    ax.plot(places, np.full(len(places), -100.0 * depth_m), color=REFRACTED, lw=1.5)
    ax.plot(places, 100.0 * np.array(heights), color=WRONG, lw=1.5)
    edges = places[1:][np.diff(counts) != 0]
    ax.vlines(edges, -100.8, -99.3, color=STRAIGHT, lw=0.7, ls=":")
    ax.set(xlim=(-1.6, 1.6), ylim=(-101.3, -98.8))
    ax.set(xlabel="x (m)", ylabel="height of the bed (cm)")
    ax.spines[["top", "right"]].set_visible(False)
    ax.text(-1.55, -99.1, "corrected as tracks: wrong", color=WRONG, fontsize=8)
    ax.text(-1.55, -101.1, "corrected as stereo pairs: right", color=REFRACTED, fontsize=8)
    ax.text(1.58, -99.1, "dotted: the visible images change", ha="right", fontsize=8)
    return figure


def adjustment():
    """Refractive collinearity, and the transfer of a point to the adjusted poses."""
    figure, (one, two) = axes(2, width=7.4, height=3.5)
    for ax in (one, two):
        scene(ax, -2.5, 2.5, -2.2, 2.3)
    one.fill([-2.5, -1.25, -2.5], [0.45, 0.0, 0.0], color="#e9dfcf", lw=0, zorder=2)
    bed = [(-2.5, 0.45), (-1.25, 0.0), (-0.3, -1.3), (2.5, -1.75)]
    line(one, *bed, color=GROUND)
    x = np.array([0.45, -1.3 - 0.75 * 0.45 / 2.8])
    land = np.array([-1.95, 0.252])
    cameras = [np.array([-1.0, 1.45]), np.array([1.3, 1.45])]
    right_of_it = np.array([0.32, 0.0])
    for k, c in enumerate(cameras):
        p = piercing_point(c, x)
        line(one, c, p, x)
        line(one, c, land, width=0.9, color=GROUND)
        camera_at(one, c, f"C{'₁₂'[k]}", dx=0.0, dz=0.2)
        one.plot(*p, "o", ms=3.5, color="black", zorder=5)
        text(one, p, f"P{'₁₂'[k]}", 0.2, 0.14)
        one.errorbar(*(c + right_of_it), yerr=0.14, fmt="none", ecolor=WRONG, capsize=2, lw=1)
        text(one, c + right_of_it, "GNSS", 0.1, 0.0, ha="left", color=WRONG, size=8)
    true(one, x, "X  tie point under water", -0.1, -0.42)
    one.plot(*land, "o", ms=5, color=GROUND, zorder=5)
    text(one, (-2.42, 0.68), "land", ha="left", color=GROUND, size=8)
    text(one, (0, 2.12), "Adjustment: rays to points under water are refracted", size=8.5)

    q = np.array([0.1, -1.45])
    adjusted = [np.array([-1.35, 1.35]), np.array([1.5, 1.35])]
    # The original poses: higher, and closer to each other
    original = [np.array([-1.2, 1.62]), np.array([1.38, 1.62])]
    rays = [unit(piercing_point(c, q) - c) for c in adjusted]
    point_a = crossing(original[0], rays[0], original[1], rays[1])
    point_b = crossing(adjusted[0], rays[0], adjusted[1], rays[1])
    for k, (old, new) in enumerate(zip(original, adjusted, strict=True)):
        straight(two, old, point_a)
        line(two, new, point_b, color=WRONG, style=(0, (4, 2.5)), width=1.0)
        line(two, new, piercing_point(new, q), q)
        camera_at(two, old, "original" if k else "", dx=0.2, dz=0.05, ha="left")
        camera_at(two, new, "adjusted" if k else "", dx=0.2, dz=-0.05, ha="left")
        arrow(two, old, new, color=WRONG)
    apparent(two, point_a, "A", 0.0, 0.23, color=STRAIGHT)
    apparent(two, point_b, "A'", 0.38, 0.0)
    true(two, q, "Q", 0.25, -0.05)
    text(two, (0, 2.12), "Transfer: the image rays of A intersect at A'", size=8.5)
    text(two, (-2.4, -1.75), "grey: original poses", ha="left", color=STRAIGHT, size=8)
    text(two, (-2.4, -1.95), "red: the same rays, adjusted poses", ha="left", color=WRONG, size=8)
    return figure


def intersected(cameras, rays, level=0.0):
    """Return the intersection of the refracted rays of the cameras below a water level."""
    matrix, right = np.zeros((2, 2)), np.zeros(2)
    for c, ray in zip(cameras, rays, strict=True):
        p = c - ray * (c[1] - level) / ray[1]
        t = refracted(ray, UP, 1 / N)
        m = np.eye(2) - np.outer(t, t)
        matrix, right = matrix + m, right + m @ p
    return np.linalg.solve(matrix, right)


def turned(ray, radians):
    c, s = np.cos(radians), np.sin(radians)
    return np.array([[c, -s], [s, c]]) @ ray


def uncertainty():
    """Errors of single rays, and an error that all rays share."""
    figure, (one, two) = axes(2, width=7.4, height=3.3)
    for ax in (one, two):
        scene(ax, -2.3, 2.3, -2.1, 1.9)
    q = np.array([0.1, -1.5])
    cameras = [np.array([x, 1.2]) for x in (-1.5, -0.1, 1.5)]
    rays = [unit(piercing_point(c, q) - c) for c in cameras]
    sigma, step = np.radians(1.8), 1e-5
    columns = []
    for k, (c, ray) in enumerate(zip(cameras, rays, strict=True)):
        changed = [*rays[:k], turned(ray, step), *rays[k + 1 :]]
        columns.append((intersected(cameras, changed) - intersected(cameras, rays)) / step)
        band = []
        for side in (-sigma, sigma):
            s = turned(ray, side)
            p = c - s * c[1] / s[1]
            band.append((p, p + 2.2 * refracted(s, UP, 1 / N)))
        (p, far), (p2, far2) = band
        one.fill(*np.transpose([c, p, far, far2, p2]), color=REFRACTED, alpha=0.15, lw=0, zorder=2)
        line(one, c, piercing_point(c, q), q)
        camera_at(one, c, f"C{'₁₂₃'[k]}", dz=0.19)
    values, vectors = np.linalg.eigh(sigma**2 * sum(np.outer(g, g) for g in columns))
    degrees = np.degrees(np.arctan2(*vectors[::-1, 1]))
    wide, narrow = 2 * 2.45 * np.sqrt(values[::-1])  # 95 % in two dimensions
    one.add_patch(Ellipse(q, wide, narrow, angle=degrees, fc="none", ec=WRONG, lw=1.6, zorder=5))
    true(one, q, "Q", -0.36, 0.0)
    text(one, (-2.2, -1.9), "bands: standard deviation", ha="left", color=STRAIGHT, size=8)
    text(one, (-2.2, -1.7), "ellipse: 95 %", ha="left", color=WRONG, size=8)
    text(one, (0, 1.72), "Errors of single rays: error ellipse of Q", size=8.5)

    level = 0.35
    q2 = intersected(cameras, rays, level)
    line(two, (-2.3, level), (2.3, level), color=WRONG, style=(0, (4, 2.5)), order=2)
    for k, (c, ray) in enumerate(zip(cameras, rays, strict=True)):
        line(two, c, piercing_point(c, q), q)
        p, t = c - ray * (c[1] - level) / ray[1], refracted(ray, UP, 1 / N)
        end = p + t * (q2[1] - level) / t[1]
        line(two, p, end, color=WRONG, style=(0, (4, 2.5)), width=1.0)
        camera_at(two, c, f"C{'₁₂₃'[k]}", dz=0.19)
    true(two, q, "Q", -0.3, 0.05)
    apparent(two, q2, "Q'", 0.28, -0.06)
    text(two, (2.2, level), "wrong level", 0, 0.12, ha="right", color=WRONG, size=8)
    text(two, (0, 1.72), "An error that all rays share: the water level", size=8.5)
    return figure


FIGURES = (
    snell, intersection, tracks, depth_maps, stereo_pairs, port, discontinuities, adjustment,
    uncertainty,
)  # fmt: skip

if __name__ == "__main__":
    # Text remains text: the files are small, and the browser chooses the font.
    mpl.rcParams.update({"svg.hashsalt": "pcfix", "svg.fonttype": "none", "font.size": 9})
    for draw in FIGURES:
        figure = draw()
        figure.savefig(HERE / f"{draw.__name__}.svg", metadata={"Date": None})
        plt.close(figure)
