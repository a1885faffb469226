"""A cloud of fused depth maps, as OpenMVS makes it.

Every image is a reference. Along its ray the depth is where the two best of its partners agree
best: each partner shows at a place, with noise, what the reference sees, and its cost of a depth is
the squared distance from that place, pixels^2. A depth is scored by the mean of its two lowest
costs, so the best depth is that of the pair of partners with the least sum of squares. Each depth
is then averaged with those of up to eight neighbouring maps that see the same place within 1.2 %.

Fusion takes images in the order of how many others they share tie points with. An unused depth is a
seed: it is fused with those of up to twelve neighbours that agree within 1 % and are unused. If
there are three, they are used up, with the neighbours' depths behind the seed. So a place can make
several points; one of them, by chance, is returned: the mean of points on each image's own ray,
with the weights 1 / depth^2.

The reference sees the bed, here the tangent plane of the true surface; the rays of different images
through one apparent place meet different places of it. The true point is the mean of these places,
with the weights of their depths in the mean.

A patch of texture matches a little worse than its distance says, so costs have noise of their own:
`COST_NOISE` times the variance of the image noise, 0.1 pixels^2 of a pair at half a pixel.

Differences from OpenMVS: costs are squares of distances, not correlations of patches (the same to
first order); rays are not rounded to pixels; all confidences are alike; a neighbour's map near a
place is a plane parallel to the bed; and the local water plane of each image (see
`pcfix.simulate.tracing`) is that at the first estimate of the point.
"""

from typing import NamedTuple

import numpy as np

from pcfix.model import Cameras, FloatArray, IntArray, Lens
from pcfix.simulate.scene import Visible
from pcfix.simulate.tracing import anchors_and_normals, piercing_points_of_planes, project
from tests.utils.bed_rays import bed_points
from tests.utils.matchers.pairs import Partners, rows_of

AVERAGED_WITHIN = 0.012
AGREE = 0.01
LEAST_PARTNERS = 2
LEAST_FUSED = 3
LEAST_COVER = 2
MOST_OFF = 0.3
COST_NOISE = 0.28  # scale of Gumbel's distribution of one cost; a sum of two varies like one of 0.4

_STEPS = 20
_CONVERGED_M = 1e-9


class Sightings(NamedTuple):
    """Places of rays in other images: e measured ideal pixels.

    `owner` is the row of the ray, shape (e,). In the frame of the other camera the ray is
    ``start + depth * way``, both of shape (3, e).
    """

    owner: IntArray
    measured: FloatArray
    start: FloatArray
    way: FloatArray


class Maps(NamedTuple):
    """Rays of m references, their depths before and after averaging, and the bed.

    Depths are along the optical axis, NaN for none; rays have the component 1 there. `seen` is the
    place of the bed, `shown` the mean over all depths in the averaged one.
    """

    origin: FloatArray
    ray: FloatArray
    depth: FloatArray
    averaged: FloatArray
    seen: FloatArray
    shown: FloatArray

    def points(self, rows: IntArray, depth: FloatArray) -> FloatArray:
        """Return the points at depths along some rays."""
        return np.asarray(self.origin[rows] + depth[:, None] * self.ray[rows])


def fuse_depth_maps(
    imaged: Visible, normals: FloatArray, partners: Partners, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Return a fused point for each place of the bed, its truth, images, their number and weight.

    A place with fewer than three matching depth maps is not moved and has no cameras. `normals`,
    shape (n, 3), are unit normals of the true surface; `rng` makes noise and selects points.
    """
    site, matching = imaged.site, _Matching(imaged, normals, partners, rng)
    luck = rng.uniform(0.0, 1.0, len(imaged.point))
    place = imaged.intersected(imaged.ideal)
    maps = matching.maps(place)
    seed, group = matching.groups(maps, luck)
    seeded = np.flatnonzero(seed >= 0)
    place[seeded] = maps.points(seed[seeded], maps.averaged[seed[seeded]])
    maps = matching.maps(place)
    rows = np.flatnonzero((group >= 0) & (group == seed[imaged.point]))
    # without those whose depth is not that of their point's place
    _, z = project(place[imaged.point[rows]], site.given, imaged.camera[rows], site.optics.lens)
    rows = rows[np.abs(maps.averaged[rows] - z) < AGREE * z]
    count = np.bincount(imaged.point[rows], minlength=len(seed))
    rows = rows[count[imaged.point[rows]] >= LEAST_FUSED]
    point, weight = imaged.point[rows], 1.0 / maps.averaged[rows] ** 2
    xyz = maps.points(rows, maps.averaged[rows])
    fused, true = (_means(v, weight, point, imaged.truth) for v in (xyz, maps.shown[rows]))
    count = np.bincount(point, minlength=len(fused))
    return fused, true, imaged.camera[rows], count, weight.astype(np.float32)


BASE_TO_HEIGHT, BEST_BASE, AXES_WITHIN_DEG, LEAST_MODELS = (0.1, 0.5), 0.25, 30.0, 3


def stereo_models(cameras: Cameras, ground_m: float, count: int) -> Partners:
    """Return the images that software without averaging compares with each base image.

    Those of a similar attitude whose base is nearest to a quarter of the height.
    """
    base = np.linalg.norm(cameras.centres[:, None] - cameras.centres, axis=2)
    base /= (cameras.centres[:, 2] - ground_m)[:, None]
    axes, (low, high) = cameras.rotations[:, 2], BASE_TO_HEIGHT
    usable = (base >= low) & (base <= high) & (axes @ axes.T > np.cos(np.radians(AXES_WITHIN_DEG)))
    off = np.where(usable, np.abs(base - BEST_BASE), np.inf)
    best = np.argsort(off, axis=1, kind="stable")[:, :count]
    matched = np.where(np.isfinite(np.take_along_axis(off, best, axis=1)), best, -1)
    none = np.zeros((len(base), 0), int)
    return Partners(matched, none, none, (matched >= 0).sum(axis=1))


def keep_single_maps(
    imaged: Visible, normals: FloatArray, partners: Partners, rng: np.random.Generator, *,
    nearest: bool,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Return a point of each place along the ray of one base image; see `fuse_depth_maps`.

    Its depth has the least squared residuals in all images that show the place, of those that the
    base image was compared with, three or more. The base image is the nearest in plan or drawn by
    lot. A place without one is not moved and has no cameras.
    """
    matching = _Matching(imaged, normals, partners, rng)
    place = imaged.intersected(imaged.ideal)
    maps = matching.maps(place, best_pair=False)
    possible = (matching.partner >= 0).sum(axis=1) >= LEAST_MODELS
    rows = np.flatnonzero(possible & np.isfinite(maps.depth))
    centres = imaged.site.given.centres[imaged.camera[rows], :2]
    distance = np.linalg.norm(centres - place[imaged.point[rows], :2], axis=1)
    order = np.lexsort((distance if nearest else rng.uniform(size=len(rows)), imaged.point[rows]))
    point, first = np.unique(imaged.point[rows[order]], return_index=True)
    base = rows[order[first]]
    true = imaged.truth.copy()
    place[point], true[point] = maps.points(base, maps.depth[base]), maps.seen[base]
    place[~np.isin(np.arange(len(place)), point)] = true[~np.isin(np.arange(len(place)), point)]
    count = np.zeros(len(place), int)
    count[point] = 1
    return place, true, imaged.camera[base], count


class _Matching:
    """What the depths of all m references, the rows of `imaged`, are found with.

    `water` has an anchor and a normal for each row of `imaged`, `normals` the bed's for each point.
    Partners and neighbours are rows of `imaged`, -1 for none, shape (m, c), (m, 8) and (m, 12).
    Partner j of row i has the image noise ``noise_px[i, j]`` and the extra cost ``cost_px2[i, j]``.
    """

    def __init__(
        self, imaged: Visible, normals: FloatArray, partners: Partners, rng: np.random.Generator
    ) -> None:
        site, row_of = imaged.site, rows_of(imaged)

        def there(table: IntArray) -> IntArray:
            """Return the rows of the images that a table names for the image of each row."""
            others = table[imaged.camera]
            return np.where(others >= 0, row_of[imaged.point[:, None], others], -1)

        self.imaged, self.normals, self.known = imaged, normals, partners.known
        self.water = anchors_and_normals(site.terrain.water, len(imaged.point))
        self.partner = there(partners.matched)
        self.partner[(self.partner >= 0).sum(axis=1) < LEAST_PARTNERS] = -1
        self.averaged, self.fused = there(partners.averaged), there(partners.fused)
        shape = self.partner.shape
        self.noise_px = rng.normal(0.0, site.image_noise_px, (*shape, 2))
        self.cost_px2 = rng.gumbel(0.0, COST_NOISE * site.image_noise_px**2, shape)

    def maps(self, place: FloatArray, *, best_pair: bool = True) -> Maps:
        """Return the depths of all references along their rays through a place of each point."""
        imaged, site = self.imaged, self.imaged.site
        point, camera, lens = imaged.point, imaged.camera, site.optics.lens
        pixels, depth = project(place[point], site.given, camera, lens)
        seen = bed_points(
            site.true.centres[camera],
            _rays(pixels, site.true, camera, lens),
            self.water,
            (imaged.truth[point], self.normals[point]),
            site.refractive_index,
        )
        origin, ray = site.given.centres[camera], _rays(pixels, site.given, camera, lens)
        depth = self._depths((origin, ray, depth), seen, best_pair=best_pair)
        maps = Maps(origin, ray, depth, depth, seen, seen)
        averaged, shown = self._averaged(maps)
        return maps._replace(averaged=averaged, shown=shown)

    def _depths(
        self, rays: tuple[FloatArray, FloatArray, FloatArray], seen: FloatArray, *, best_pair: bool
    ) -> FloatArray:
        """Return the depth of the best pair of partners, or of all, along each ray.

        From a first depth.
        """
        site, (reference, slot) = self.imaged.site, np.nonzero(self.partner >= 0)
        row = self.partner[reference, slot]
        measured = self._measured(row, seen[reference], self.noise_px[reference, slot])
        origin, ray, first = rays
        camera, given, lens = self.imaged.camera[row], site.given, site.optics.lens
        turn = given.rotations[camera]
        sightings = Sightings(
            reference,
            measured,
            np.einsum("mij,mj->im", turn, origin[reference] - given.centres[camera]),
            np.einsum("mij,mj->im", turn, ray[reference]),
        )
        depth = _least_squares(first, sightings, lens)
        depth[~(np.abs(depth - first) < MOST_OFF * first)] = np.nan  # the images agree nowhere
        if not best_pair:
            return depth
        residual, slope = _residuals(depth, sightings, lens)
        shape = self.partner.shape
        squares, right, curved = np.full(shape, np.inf), np.zeros(shape), np.ones(shape)
        squares[reference, slot] = (residual**2).sum(axis=1) + self.cost_px2[reference, slot]
        right[reference, slot] = (slope * residual).sum(axis=1)
        curved[reference, slot] = (slope**2).sum(axis=1)
        # the pair whose sum of squares becomes least: sum - (sum of right)^2 / sum of curved
        one, other = np.triu_indices(shape[1], 1)
        gain = (right[:, one] + right[:, other]) ** 2 / (curved[:, one] + curved[:, other])
        best = np.argmin(squares[:, one] + squares[:, other] - gain, axis=1)
        taken = (one[best][reference] == slot) | (other[best][reference] == slot)
        sightings = Sightings(
            reference[taken], measured[taken], sightings.start[:, taken], sightings.way[:, taken]
        )
        depth = _least_squares(depth, sightings, lens)
        return np.where(np.abs(depth - first) < MOST_OFF * first, depth, np.nan)

    def _measured(self, row: IntArray, seen: FloatArray, noise_px: FloatArray) -> FloatArray:
        """Return where the images of some rows of `imaged` show places of the bed, ideal pixels."""
        site, camera = self.imaged.site, self.imaged.camera[row]
        anchors, normals = (part[row] for part in self.water)
        centres, n = site.true.centres[camera], site.refractive_index
        surface = piercing_points_of_planes(seen, centres, anchors, normals, n)
        ideal, _ = project(surface, site.true, camera, site.optics.lens)
        return site.optics.to_ideal(site.optics.to_image(ideal) + noise_px)

    def _averaged(self, maps: Maps) -> tuple[FloatArray, FloatArray]:
        """Return the mean depths of each and its neighbouring maps, and the mean places of the bed.

        A depth is dropped if less than two neighbours see its place, if none agrees, or if as many
        disagree as agree, itself among them.
        """
        rows = np.arange(len(maps.depth))
        total, shown, agreeing = maps.depth.copy(), maps.seen.copy(), np.ones(len(rows))
        disagreeing = np.zeros(len(rows))
        normal = self.normals[self.imaged.point]
        for neighbour in self.averaged.T:
            # where the ray meets the neighbour's map, a plane through its point parallel to the bed
            own = np.flatnonzero(neighbour >= 0)
            there = maps.points(neighbour[own], maps.depth[neighbour[own]])
            gap = np.einsum("mi,mi->m", there - maps.origin[own], normal[own])
            depth = np.full(len(rows), np.nan)
            depth[own] = gap / np.einsum("mi,mi->m", maps.ray[own], normal[own])
            agrees = np.abs(depth - maps.depth) < AVERAGED_WITHIN * maps.depth
            total[agrees] += depth[agrees]
            shown[agrees] += maps.seen[neighbour[agrees]]
            agreeing += agrees
            disagreeing += np.isfinite(depth) & ~agrees
        accepted = (
            (agreeing > 1.0) & (agreeing > disagreeing) & (agreeing + disagreeing > LEAST_COVER)
        )
        depth = np.where(accepted, total / agreeing, np.nan)
        return depth, shown / agreeing[:, None]

    def groups(self, maps: Maps, luck: FloatArray) -> tuple[IntArray, IntArray]:
        """Return the seed of the luckiest point of each place, and the seed that used up each row.

        Both are rows of `imaged`, -1 where there is none.
        """
        imaged = self.imaged
        chosen, group = np.full(len(imaged.start) - 1, -1), np.full(len(imaged.point), -1)
        free = np.isfinite(maps.averaged)
        for camera in np.argsort(-self.known, kind="stable"):
            seeds = np.flatnonzero((imaged.camera == camera) & free)
            there = self.fused[seeds]
            # how far beyond the points of the seeds these maps are, relative
            at = maps.points(seeds, maps.averaged[seeds])[:, None]
            normal = self.normals[imaged.point[seeds]][:, None]
            reach = (maps.averaged[there][..., None] * maps.ray[there] * normal).sum(axis=2)
            distance = reach / ((at - maps.origin[there]) * normal).sum(axis=2) - 1.0
            usable = (there >= 0) & free[there]
            members = usable & (np.abs(distance) < AGREE)
            accepted = 1 + members.sum(axis=1) >= LEAST_FUSED
            behind = usable & (distance >= AGREE)
            free[there[(members | behind) & accepted[:, None]]] = False
            seeds, there, members = seeds[accepted], there[accepted], members[accepted]
            free[seeds] = False
            group[seeds] = seeds
            group[there[members]] = np.repeat(seeds, members.sum(axis=1))
            point = imaged.point[seeds]
            luckier = (chosen[point] < 0) | (luck[seeds] > luck[chosen[point]])
            chosen[point[luckier]] = seeds[luckier]
        return chosen, group


def _rays(pixels: FloatArray, cameras: Cameras, camera: IntArray, lens: Lens) -> FloatArray:
    """Return directions in the world whose component along the optical axis is 1, (m, 3)."""
    plane = (pixels - [lens.principal_x, lens.principal_y]) / lens.focal
    inside = np.column_stack([plane, np.ones(len(plane))])
    return np.asarray(np.einsum("mij,mi->mj", cameras.rotations[camera], inside))


def _least_squares(depth: FloatArray, sightings: Sightings, lens: Lens) -> FloatArray:
    """Return the depths along rays with least squared residuals in other images, by Gauss-Newton.

    From first depths; a ray without sightings gets NaN.
    """
    owner, count = sightings.owner, len(depth)
    for _ in range(_STEPS):
        residual, slope = _residuals(depth, sightings, lens)
        right = np.bincount(owner, (slope * residual).sum(axis=1), count)
        curved = np.bincount(owner, (slope**2).sum(axis=1), count)
        step = np.divide(right, curved, out=np.full(count, np.nan), where=curved > 0.0)
        depth = depth + step
        if np.nanmax(np.abs(step), initial=0.0) < _CONVERGED_M:
            break
    return np.asarray(depth)


def _residuals(
    depth: FloatArray, sightings: Sightings, lens: Lens
) -> tuple[FloatArray, FloatArray]:
    """Return measured minus predicted pixels, and how the predicted move with the depth."""
    way = sightings.way
    x, y, z = sightings.start + depth[sightings.owner] * way
    u, v, scale = x / z, y / z, lens.focal / z
    seen = np.column_stack([lens.focal * u + lens.principal_x, lens.focal * v + lens.principal_y])
    slope = np.column_stack([scale * (way[0] - u * way[2]), scale * (way[1] - v * way[2])])
    return sightings.measured - seen, slope


def _means(
    values: FloatArray, weight: FloatArray, point: IntArray, otherwise: FloatArray
) -> FloatArray:
    """Return weighted means of each point's rows, shape (n, 3), or the other value."""
    total = np.bincount(point, weight, len(otherwise))
    held, means = total > 0.0, otherwise.copy()
    for axis in range(3):
        # the sums are of differences, so that nothing is lost where the values are the same
        apart = weight * (values[:, axis] - otherwise[point, axis])
        means[held, axis] += np.bincount(point, apart, len(otherwise))[held] / total[held]
    return means
