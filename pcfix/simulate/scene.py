"""A scene: ground, water, images, and the cloud that software would reconstruct from them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcfix.lens.rotations import from_yaw_pitch_roll
from pcfix.model import Cameras, FloatArray, IntArray, Views, WaterPlane
from pcfix.options.declare import taken
from pcfix.options.steps import SceneOptions
from pcfix.simulate.settings import Optics, SceneSettings, Terrain
from pcfix.simulate.tracing import (
    anchors_and_normals,
    piercing_points_of_planes,
    project,
    triangulate,
)

ORIGIN_M = np.array([410_200.0, 4_650_300.0, 0.0])  # in UTM zone 33 north
EPSG = 32633
PAIRS_AT_ONCE = 2_000_000  # points times images that are traced at once, which bounds the memory


@dataclass(frozen=True, eq=False)
class Scene:
    """A simulated scene; metres, UTM.

    A point in fewer than three images has no views and is not moved. The cloud is intersected with
    `cameras`; the images were taken with `true_cameras`, the same object without pose noise.
    """

    apparent_xyz: FloatArray  # (n, 3), the cloud of the SfM software
    true_xyz: FloatArray  # (n, 3), the truth, row by row
    views: Views  # the cameras of each point
    cameras: Cameras
    yaw_pitch_roll_deg: FloatArray
    lidar_xyz: FloatArray  # (m, 3), a reference cloud of the true surface with noise
    water_level_m: float  # of the mean water plane `water` in the middle of the area
    refractive_index: float
    gsd_m: float
    sensor_mm: tuple[float, float, float]  # focal length, sensor width and height
    epsg: int
    settings: dict[str, Any]  # the arguments that made it
    water: WaterPlane
    true_cameras: Cameras
    true_yaw_pitch_roll_deg: FloatArray

    @property
    def xyz(self) -> FloatArray:
        """`apparent_xyz`, by a shorter name."""
        return self.apparent_xyz

    def depth_m(self, xyz: FloatArray) -> FloatArray:
        """Return the vertical distance of points below the mean water plane, metres."""
        # about the scene, as the plane's height at the origin of the coordinates is a large number
        near = xyz - ORIGIN_M
        level = self.water.a + self.water.b * ORIGIN_M[0] + self.water.c * ORIGIN_M[1]
        return np.asarray(level + near[:, :2] @ [self.water.b, self.water.c] - xyz[:, 2])

    @property
    def description(self) -> str:
        """One line about the scene."""
        per_point = len(self.views.camera) / len(self.true_xyz)
        return (
            f"{len(self.true_xyz):,} points seen by {per_point:.0f} of {len(self.cameras)} cameras"
            f" each, GSD {self.gsd_m:.2g} m, water level {self.water_level_m:g} m, refractive index"
            f" {self.refractive_index:g}"
        )


def simulate_scene(
    points: int | None = None,
    *,
    options: SceneOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keywords: Any,
) -> Scene:
    """Make a scene with known truth: ground and water under a block of images.

    Every point is traced through the water surface into every image that shows it; the image points
    get noise and are intersected with straight rays. By default: a shore from land to 12 m of
    depth, level water, nadir images, true poses, and each point from all its images.

    Parameters
    ----------
    points : int, optional
        Points of the cloud; default 100,000.
    options : SceneOptions, optional
        Or its attributes as keywords, as for ``pcfix simulate``.
    progress : callable, optional
        Called with (points done, points in all).

    Examples
    --------
    >>> import pcfix
    >>> scene = pcfix.simulate_scene(500, bed="flat", flying_height_m=60)
    >>> scene.apparent_xyz.shape
    (500, 3)
    """
    if points is not None:
        keywords["points"] = points
    chosen = taken(SceneOptions, options, keywords, "simulate_scene").part(SceneSettings)
    site = lay_out(chosen)
    truth = points_on(site.terrain, chosen.points, site.rng)
    parts, at_once = [], max(1, PAIRS_AT_ONCE // len(site.true))
    for first in range(0, len(truth), at_once):
        imaged = find_visible(truth[first : first + at_once], site, site.luck)
        apparent = imaged.intersected(site.observed(imaged.ideal, site.rng))
        parts.append((apparent, imaged.camera, np.diff(imaged.start)))
        if progress is not None:
            progress(min(first + at_once, len(truth)), len(truth))
    xyz, camera, counts = (np.concatenate(one) for one in zip(*parts, strict=True))
    return scene_of(chosen, site, xyz, truth, Views(starts(counts), camera))


def scene_of(
    chosen: SceneSettings, site: "Site", xyz: FloatArray, truth: FloatArray, views: Views
) -> Scene:
    """Return the scene of a site, with a cloud and its true points, both of shape (n, 3)."""
    terrain, rng = site.terrain, site.rng
    lidar = points_on(terrain, round(terrain.length_m * terrain.width_m * chosen.lidar_per_m2), rng)
    lidar[:, 2] += rng.normal(0.0, chosen.lidar_noise_m, len(lidar))
    cameras = cameras_in_world(site.given)
    return Scene(
        apparent_xyz=xyz + ORIGIN_M,
        true_xyz=truth + ORIGIN_M,
        views=views,
        cameras=cameras,
        yaw_pitch_roll_deg=site.given_angles,
        lidar_xyz=lidar + ORIGIN_M,
        water_level_m=chosen.water,
        refractive_index=chosen.refractive_index,
        gsd_m=chosen.gsd_m,
        sensor_mm=(chosen.focal_mm, *chosen.sensor_mm),
        epsg=EPSG,
        settings=chosen.as_dict(),
        water=plane_in_world(terrain.water),
        true_cameras=cameras if site.given is site.true else cameras_in_world(site.true),
        true_yaw_pitch_roll_deg=site.true_angles,
    )


def lay_out(chosen: SceneSettings) -> "Site":
    """Return ground and block of a scene, in local coordinates."""
    # poses and detection have their own random numbers, as they can be switched on
    rng, extent = np.random.default_rng(chosen.seed), chosen.area_m
    of_poses, luck = (np.random.default_rng([chosen.seed, i]) for i in (1, 3))
    if chosen.cameras is not None:  # the area that about this number of nadir images covers
        (length, width), (base, spacing) = extent, chosen.base_and_spacing_m
        side = float(np.sqrt(chosen.cameras * base * spacing * length / width))
        across = chosen.cameras * base * spacing / side - 1.5 * spacing
        extent = max(side - 1.5 * base, base), max(across, spacing / 2.0)
    terrain = Terrain.random(chosen.bed, extent, chosen.water_plane(extent), chosen.depth_m, rng)
    true, true_angles = fly_block(extent, chosen, rng)
    given, given_angles = true, true_angles
    if chosen.position_noise_m or chosen.attitude_noise_deg:
        # noise on every coordinate, and on yaw, pitch and roll
        shape = true_angles.shape
        given_angles = true_angles + of_poses.normal(0.0, chosen.attitude_noise_deg, shape)
        centres = true.centres + of_poses.normal(0.0, chosen.position_noise_m, shape)
        given = replace(true, centres=centres, rotations=from_yaw_pitch_roll(*given_angles.T))
    fall_m = chosen.water_tilt * float(np.hypot(*extent)) / 2.0
    return Site(
        terrain, true, true_angles, given, given_angles, chosen.optics,
        chosen.refractive_index, chosen.water - chosen.depth_m - fall_m,
        chosen.image_noise, chosen.detection, rng, luck,
    )  # fmt: skip


def points_on(terrain: Terrain, count: int, rng: np.random.Generator) -> FloatArray:
    """Return random points of the surface, west to east in narrow bands, as matchers write."""
    plan = rng.uniform(0.0, 1.0, (count, 2)) * [terrain.length_m, terrain.width_m]
    plan = plan[np.lexsort((plan[:, 0], np.floor(plan[:, 1])))]
    return np.column_stack([plan, terrain.height(*plan.T)])


def cameras_in_world(cameras: Cameras) -> Cameras:
    """Return cameras in the world's coordinates."""
    return replace(cameras, centres=cameras.centres + ORIGIN_M)


def plane_in_world(plane: WaterPlane) -> WaterPlane:
    """Return a plane in the world's coordinates."""
    a = plane.a - plane.b * ORIGIN_M[0] - plane.c * ORIGIN_M[1]
    return WaterPlane(float(a), plane.b, plane.c)


# Blocks as drones fly them: nadir strips, and obliques around them

_RING_BASES, _RING_SPACINGS = 2.0, 1.5  # steps of a ring of obliques in those of the nadir images


def fly_block(
    extent_m: tuple[float, float], chosen: SceneSettings, rng: np.random.Generator
) -> tuple[Cameras, FloatArray]:
    """Cover a rectangle from the origin with images; strips run along x.

    Returns the cameras, and yaw, pitch and roll of each, degrees, shape (k, 3).
    """
    plan, attitude = _plan(extent_m, chosen)
    attitude = attitude + rng.normal(0.0, 1.5, attitude.shape)  # degrees
    sd = 0.5 * min(1.0, chosen.flying_height_m / 80.0)  # metres, of a drone; less if it flies low
    height = chosen.water + chosen.flying_height_m + rng.normal(0.0, sd, len(plan))
    centres = np.column_stack([plan + rng.normal(0.0, sd, plan.shape), height])
    cameras = Cameras(
        labels=tuple(f"IMG_{i + 1:04d}.JPG" for i in range(len(centres))),
        centres=centres,
        rotations=from_yaw_pitch_roll(*attitude.T),
        lenses=(chosen.optics.lens,) * len(centres),
    )
    return cameras, attitude


def _plan(extent_m: tuple[float, float], chosen: SceneSettings) -> tuple[FloatArray, FloatArray]:
    """Return plan positions and yaw, pitch, roll, nadir images first."""
    base, spacing = chosen.base_and_spacing_m
    places, angles = [], []
    if chosen.oblique_share != 1.0:
        nadir = _grid(*extent_m, base, spacing)
        yaw = np.where(np.rint(nadir[:, 1] / spacing) % 2, 270.0, 90.0)  # to and fro
        places.append(nadir)
        angles.append(np.column_stack([yaw, np.zeros((len(nadir), 2))]))
    pitch = 20.0 if chosen.obliques_deg is None else chosen.obliques_deg
    back = chosen.flying_height_m * np.tan(np.radians(pitch))
    directions = chosen.oblique_directions if chosen.has_obliques else 0
    share = chosen.oblique_share
    stretch = 1.0  # of the steps of a ring
    if share is not None and share != 1.0:
        density = share / (1.0 - share) / chosen.oblique_directions
        stretch = float(np.sqrt(1.0 / (_RING_BASES * _RING_SPACINGS) / density))
    steps = _RING_BASES * base * stretch, _RING_SPACINGS * spacing * stretch
    for heading in 360.0 / max(directions, 1) * np.arange(directions):
        away = back * np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
        ring = _grid(*extent_m, *steps) - away
        places.append(ring)
        angles.append(np.tile([heading, pitch, 0.0], (len(ring), 1)))
    return np.vstack(places), np.vstack(angles)


def _grid(length_m: float, width_m: float, base_m: float, spacing_m: float) -> FloatArray:
    """Return plan positions that reach half a step beyond the rectangle on every side."""
    x = np.arange(-base_m / 2.0, length_m + base_m, base_m)
    y = np.arange(-spacing_m / 2.0, width_m + spacing_m, spacing_m)
    return np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x))])


# Which images show which points, and where straight rays through their pixels intersect

LEAST_VIEWS = 3


def starts(counts: IntArray) -> IntArray:
    """Return where the rows of each point begin, and the end, from their numbers."""
    return np.concatenate([[0], np.cumsum(counts)])


@dataclass(frozen=True, eq=False)
class Site:
    """Ground, water and images of a scene in local coordinates, and its random numbers.

    `true` are the poses of the images, `given` those for the intersection, and the angles are yaw,
    pitch and roll, degrees, shape (k, 3). Nothing is below `lowest_m`. What is detected has random
    numbers of its own, `luck`.
    """

    terrain: Terrain
    true: Cameras
    true_angles: FloatArray
    given: Cameras
    given_angles: FloatArray
    optics: Optics
    refractive_index: float
    lowest_m: float
    image_noise_px: float
    detection: float
    rng: np.random.Generator
    luck: np.random.Generator

    def observed(self, ideal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return ideal pixels as measured: noise is on the image, which is then undistorted.

        Dense matchers and the rays of tie points use undistorted images too.
        """
        image = self.optics.to_image(ideal)
        return self.optics.to_ideal(image + rng.normal(0.0, self.image_noise_px, image.shape))


@dataclass(frozen=True, eq=False)
class Visible:
    """The m pairs of one of n points and an image that shows it, sorted by point, then camera.

    Point i of `truth`, shape (n, 3), has the pairs from ``start[i]`` to ``start[i + 1]``; `ideal`,
    shape (m, 2), are ideal pixels without noise.
    """

    site: Site
    truth: FloatArray
    start: IntArray
    point: IntArray
    camera: IntArray
    ideal: FloatArray

    @property
    def paired(self) -> np.ndarray:
        """Which points have pairs, shape (n,)."""
        return np.asarray(np.diff(self.start) > 0)

    def intersected(self, pixels: FloatArray) -> FloatArray:
        """Return where straight rays through ideal pixels, (m, 2), meet with least residuals.

        Shape (n, 3); a point without pairs stays where it is.
        """
        paired, apparent, site = self.paired, self.truth.copy(), self.site
        if paired.any():
            begin = np.concatenate([self.start[:-1][paired], self.start[-1:]])
            rays = pixels, site.given, self.camera, begin, site.optics.lens
            apparent[paired] = triangulate(*rays, apparent[paired])
        return apparent


def find_visible(truth: FloatArray, site: Site, rng: np.random.Generator) -> Visible:
    """Trace every point, shape (n, 3), into every image; those in fewer than three have no pairs.

    `rng` says what is detected; the luckiest three images of a point always are.
    """
    cameras = site.true
    # how far from below each camera it can see anything: the most oblique ray of the frame's
    # corner, prolonged as if there were no refraction
    off_nadir = np.arccos(np.clip(-np.asarray(cameras.rotations)[:, 2, 2], -1.0, 1.0))
    widest = np.minimum(np.arctan(site.optics.reach) + off_nadir, np.radians(80.0))
    reach = (cameras.centres[:, 2] - site.lowest_m) * np.tan(widest)
    across = truth[:, None, 0] - cameras.centres[:, 0], truth[:, None, 1] - cameras.centres[:, 1]
    point, camera = np.nonzero(np.hypot(*across) < reach)
    planes = anchors_and_normals(site.terrain.water, len(point))
    pairs = truth[point], cameras.centres[camera]
    surface = piercing_points_of_planes(*pairs, *planes, site.refractive_index)
    ideal, z = project(surface, cameras, camera, site.optics.lens)
    image, size = site.optics.to_image(ideal), [site.optics.lens.width, site.optics.lens.height]
    inside = (z > 0) & ((image >= 0) & (image < size)).all(axis=1)
    point, camera, ideal = point[inside], camera[inside], ideal[inside]
    taken = np.bincount(point, minlength=len(truth))[point] >= LEAST_VIEWS
    if site.detection < 1.0:
        luck = rng.uniform(0.0, 1.0, len(point))
        rank = np.empty(len(point), np.int64)
        rank[np.lexsort((luck, point))] = np.arange(len(point)) - np.searchsorted(point, point)
        taken &= (luck < site.detection) | (rank < LEAST_VIEWS)
    point, camera, ideal = point[taken], camera[taken], ideal[taken]
    begin = starts(np.bincount(point, minlength=len(truth)))
    return Visible(site, truth, begin, point, camera, ideal)
