"""Slow twins of the method `consistent`: forwards through water into images, and what SfM makes.

Nothing of `pcfix.refract` is used. Light crosses a plane where Fermat's principle has it
(`tests.utils.twins.light_path`, scipy) and images by the formulas of the lens term by term; the
triangulations, straight and refractive, are general least squares over image residuals.
"""

import numpy as np
from scipy.optimize import least_squares, root

from tests.utils.bed_rays import piercing_points
from tests.utils.twins import image_slowly, light_path


def image_in(cameras, c, target):
    """Return u, v of a place in the world, straight, in camera c."""
    return np.array(
        image_slowly(cameras.lenses[c], cameras.rotations[c] @ (target - cameras.centres[c]))
    )


def seen_through_water(point, cameras, mine, planes, n):
    """Return the images of a true point; `planes` are (a, b, c), one for each of the cameras.

    A plane below the point lets its light go straight.
    """
    seen = []
    for c, (a, b, d) in zip(mine, planes, strict=True):
        wet = point[2] < a + b * point[0] + d * point[1]
        way = light_path(point, cameras.centres[c], (a, b, d), n) if wet else point
        seen.append(image_in(cameras, c, way))
    return np.array(seen)


def triangulated_straight(seen, cameras, mine, start):
    """Return the point with the least squared residuals of straight rays in the images."""

    def residuals(shift):
        images = [image_in(cameras, c, start + shift) for c in mine]
        return (np.array(images) - seen).ravel()

    found = least_squares(
        residuals, np.zeros(3), jac="3-point", x_scale=0.1, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    return start + found.x


def path_under(surface, point, centre, n, step=1e-5):
    """Return where light leaves the water under a smooth z = surface(x, y): Fermat by scipy."""

    def crossing(xy):
        return np.array([xy[0], xy[1], surface(xy[0], xy[1])])

    def gradient(xy):
        air, water = crossing(xy) - centre, crossing(xy) - point
        slopes = [
            (
                surface(xy[0] + step * i, xy[1] + step * j)
                - surface(xy[0] - step * i, xy[1] - step * j)
            )
            / (2 * step)
            for i, j in ((1, 0), (0, 1))
        ]
        along = np.array([[1.0, 0.0, slopes[0]], [0.0, 1.0, slopes[1]]])
        return along @ (air / np.linalg.norm(air) + n * water / np.linalg.norm(water))

    height, depth = centre[2] - surface(*point[:2]), surface(*point[:2]) - point[2]
    share = depth / n / (height + depth / n)
    found = root(gradient, point[:2] + share * (centre - point)[:2], tol=1e-13)
    assert np.abs(gradient(found.x)).max() < 1e-9
    return crossing(found.x)


def least_squares_points(images, seen, start, guess):
    """Return the points whose images are nearest to the given ones, shape (n, 3).

    The floor for noisy images: nothing unbiased is better. Gauss-Newton for all points at once,
    with derivatives from differences over 0.1 mm.

    Parameters
    ----------
    images : callable
        Of points, shape (n, 3): their images, shape (rays, 2), the rays of a point in turn.
    seen : array, shape (rays, 2)
    start : array, shape (n + 1,)
        First ray of each point.
    guess : array, shape (n, 3)
    """
    points, aside = guess.copy(), 1e-4
    for _ in range(10):
        steps = aside * np.eye(3)
        slopes = [(images(points + d) - images(points - d)) / (2.0 * aside) for d in steps]
        slope, residual = np.stack(slopes, axis=2), seen - images(points)
        left = np.add.reduceat(np.einsum("rki,rkj->rij", slope, slope), start[:-1])
        right = np.add.reduceat(np.einsum("rki,rk->ri", slope, residual), start[:-1])
        step = np.linalg.solve(left, right[:, :, None])[:, :, 0]
        points += step
        if np.abs(step).max() < 1e-6:
            return points
    raise ArithmeticError("the triangulation does not converge")


def images_through_level(points, cameras, camera, level_m, n):
    """Return u, v of true points through level water, one camera each, no distortion."""
    lens = cameras.lenses[0]
    way = piercing_points(points, cameras.centres[camera], level_m, n)
    x, y, z = np.einsum("rij,rj->ir", cameras.rotations[camera], way - cameras.centres[camera])
    return np.column_stack(
        [lens.principal_x + lens.focal * x / z, lens.principal_y + lens.focal * y / z]
    )
