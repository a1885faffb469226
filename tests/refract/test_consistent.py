"""The method consistent: truth forwards through water and SfM, and back; twins, noise, bits."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.errors import SettingError
from pcfix.model import Cameras, Lens, Outcome, Views, WaterMesh, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.intersect import consistent, intersect
from pcfix.refract.methods import correct
from pcfix.simulate.tracing import triangulate
from pcfix.water.surface import surface_above
from tests.refract import test_surfaces as surfaces
from tests.refract.test_surfaces import UTM, in_utm
from tests.utils.batches import batch_of
from tests.utils.codes import refused, warned
from tests.utils.consistent_twin import (
    image_in,
    images_through_level,
    least_squares_points,
    path_under,
    seen_through_water,
    triangulated_straight,
)
from tests.utils.depth_map_twin import looking
from tests.utils.nightly import mostly_nightly

MICROMETRE, NANOMETRE = 1e-6, 1e-9
N_WATER, HEIGHT_M = 1.34, 80.0
PLAIN = Lens(3600.0, 5472.0, 3648.0, 2736.0, 1824.0)
GSD_M = HEIGHT_M / PLAIN.focal
DISTORTED = replace(
    PLAIN,
    radial=(-0.12, 0.05, -0.01),
    tangential=(1e-3, -6e-4),
    b1=1.5,
    b2=-0.4,
    principal_x=2750.0,
)
FISHEYE = replace(PLAIN, focal=2200.0, projection="equidistant", radial=(0.02, -0.004))


def nadir_block(rng, lens=PLAIN):
    x, y = np.meshgrid(np.arange(-60.0, 61.0, 16.0), np.arange(-60.0, 61.0, 30.0))
    centres = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_M)])
    centres += rng.normal(0, 0.5, centres.shape)
    return looking(centres, rng.normal(0, 1.5, x.size), rng.uniform(0, 360, x.size), lens)


def oblique_block(rng, lens=PLAIN):
    """Return a nadir block with obliques of 35 degrees from four sides."""
    nadir, every = nadir_block(rng, lens), np.arange(16) // 4
    x, y = np.tile(np.reshape(np.meshgrid([-20.0, 20.0], [-20.0, 20.0]), (2, 4)), 4)
    turn = Rotation.from_euler("z", 90.0 * every[:, None], degrees=True)
    back = turn.apply([-HEIGHT_M * np.tan(np.radians(35.0)), 0.0, 0.0])
    centres = np.column_stack([x, y, np.full(16, HEIGHT_M)]) + back
    oblique = looking(centres, np.full(16, 35.0), 90.0 * every, lens)
    return Cameras(
        tuple(map(str, range(len(nadir) + 16))),
        np.vstack([nadir.centres, oblique.centres]),
        np.vstack([nadir.rotations, oblique.rotations]),
        nadir.lenses + oblique.lenses,
    )


BLOCKS = {"nadir": nadir_block, "oblique": oblique_block}


def moved(cameras, by):
    return replace(cameras, centres=cameras.centres + by)


def views_of(lists):
    start = np.concatenate([[0], np.cumsum([len(mine) for mine in lists])]).astype(np.int64)
    return Views(start, np.concatenate(lists).astype(np.int64))


def run(points, cameras, water, views, *, method="consistent", n=N_WATER, offset=None):
    settings = ScienceOptions(method=method, index=n)
    above = surface_above(water, points)
    return correct(batch_of(points, above, water, cameras, settings, views, offset))


def bed(count, seed=3, spread=20.0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-spread, spread, (count, 2)), rng.uniform(-9, -1, count)])


def in_frame(points, cameras, most=8, seed=5):
    """Return for each point some cameras whose frame holds it."""
    rng, lists = np.random.default_rng(seed), []
    for point in points:
        mine = []
        for c, lens in enumerate(cameras.lenses):
            u, v = image_in(cameras, c, point)
            if 0 < u < lens.width and 0 < v < lens.height:
                mine.append(c)
        lists.append(np.sort(rng.permutation(mine)[:most]))
    return lists


def apparent_of(points, cameras, lists, planes_of, n=N_WATER):
    """Return what SfM makes of true points, all by the slow twins; planes for each camera."""
    found = []
    for point, mine in zip(points, lists, strict=True):
        seen = seen_through_water(point, cameras, mine, [planes_of[c] for c in mine], n)
        found.append(triangulated_straight(seen, cameras, mine, point))
    return np.array(found)


def as_raster(plane):
    return surfaces.raster(surfaces.plane(*plane))


def as_mesh(plane, half=60.0, count=25):
    a, b, c = plane
    at = np.linspace(-half, half, count)
    x, y = (grid.ravel() for grid in np.meshgrid(at, at))
    i = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    triangles = np.vstack(
        [np.column_stack([i, i + 1, i + count]), np.column_stack([i + 1, i + count + 1, i + count])]
    )
    return WaterMesh(np.column_stack([x, y, a + b * x + c * y]) + UTM, triangles)


LEVEL, TILTED = (0.4, 0.0, 0.0), (0.4, 0.03, -0.02)
CASES = {
    "nadir": ("nadir", PLAIN, LEVEL),
    "oblique": ("oblique", PLAIN, LEVEL),
    "tilted": ("oblique", PLAIN, TILTED),
    "distorted": ("oblique", DISTORTED, LEVEL),
    "fisheye": ("nadir", FISHEYE, TILTED),
}


@pytest.fixture(scope="module", params=CASES)
def exact(request):
    """Return a noise-free scene about the origin: cameras, plane, truth, apparent, lists."""
    block, lens, plane = CASES[request.param]
    cameras, truth = BLOCKS[block](np.random.default_rng(1), lens), bed(12)
    lists = in_frame(truth, cameras)
    return cameras, plane, truth, apparent_of(truth, cameras, lists, [plane] * len(cameras)), lists


@pytest.mark.parametrize("shape", mostly_nightly([in_utm, as_mesh, as_raster], in_utm, as_raster))
def test_truth_recovered(exact, shape):
    cameras, plane, truth, apparent, lists = exact
    result = run(apparent + UTM, moved(cameras, UTM), shape(plane), views_of(lists))
    assert (result.outcome == Outcome.CORRECTED).all()
    # the iteration ends at a tenth of it
    assert apparent + result.shift_m == pytest.approx(truth, abs=MICROMETRE)


def test_frames_hold_images():
    """Without a list the cameras are those that image the true point, not the apparent one."""
    cameras, truth = oblique_block(np.random.default_rng(2)), bed(300, spread=45.0)
    every, size = np.arange(len(cameras)), [PLAIN.width, PLAIN.height]
    lists = []
    for point in truth:
        seen = seen_through_water(point, cameras, every, [LEVEL] * len(every), N_WATER)
        lists.append(every[((seen >= 0.0) & (seen <= size)).all(axis=1)])
    apparent = apparent_of(truth, cameras, lists, [LEVEL] * len(every))
    held = in_frame(apparent, cameras, most=len(every))
    differ = [i for i in range(len(truth)) if not np.array_equal(held[i], lists[i])]
    assert len(differ) >= 10
    result = run(apparent[differ] + UTM, moved(cameras, UTM), in_utm(LEVEL), None)
    error = np.abs(apparent[differ] + result.shift_m - truth[differ]).max(axis=1)
    # where the first estimate of the true point is off, a border may lie between the two
    assert np.count_nonzero(error < MICROMETRE) >= 0.7 * len(differ)


def test_level_per_camera():
    cameras, truth = oblique_block(np.random.default_rng(1)), bed(10, seed=8)
    truth[:5, 2] = np.linspace(0.05, 0.3, 5)  # above the water of some cameras
    offset = np.where(np.arange(len(cameras)) % 2, 0.3, -0.3)
    planes = [(0.4 + up, 0.01, 0.0) for up in offset]
    lists = in_frame(truth, cameras)
    apparent = apparent_of(truth, cameras, lists, planes)
    water = in_utm((0.4, 0.01, 0.0))
    result = run(apparent + UTM, moved(cameras, UTM), water, views_of(lists), offset=offset)
    assert apparent + result.shift_m == pytest.approx(truth, abs=MICROMETRE)


def test_waves():
    def waves(x, y):
        return 0.4 + 0.15 * np.sin(x / 4.0) * np.cos(y / 3.0)

    cameras, truth = oblique_block(np.random.default_rng(1)), bed(25, seed=9)
    truth[:, 2] = truth[:, 2] / 2.0 - 0.5
    lists, apparent = in_frame(truth, cameras), []
    for point, mine in zip(truth, lists, strict=True):
        ways = [path_under(waves, point, cameras.centres[c], N_WATER) for c in mine]
        seen = np.array([image_in(cameras, c, way) for c, way in zip(mine, ways, strict=True)])
        apparent.append(triangulated_straight(seen, cameras, mine, point))
    water, miss = surfaces.raster(waves, (0.25, 0.25)), {}
    for method in ("snell", "consistent"):
        result = run(
            np.array(apparent) + UTM, moved(cameras, UTM), water, views_of(lists), method=method
        )
        assert (result.outcome == Outcome.CORRECTED).all()
        miss[method] = np.linalg.norm(apparent + result.shift_m - truth, axis=1)
    # slopes of the raster are off by up to 0.0035, a ray of 5 m by 4 mm, and eight average
    assert miss["consistent"].max() < 4e-3
    assert miss["snell"].max() > 0.02


# with noise


def every_view(truth, cameras, plane_level, rng, noise_px):
    """Return noisy image points of all cameras that show each true point through level water."""
    size, margin = np.array([PLAIN.width, PLAIN.height]), 300.0  # refraction is a few dozen pixels
    ray = truth[:, None] - cameras.centres
    x, y, z = np.einsum("kij,nkj->ink", cameras.rotations, ray)
    straight = PLAIN.focal * np.stack([x / z, y / z], axis=2)
    point, camera = np.nonzero((np.abs(straight) < size / 2 + margin).all(axis=2))
    pixels = images_through_level(truth[point], cameras, camera, plane_level, N_WATER)
    inside = ((pixels > 0) & (pixels < size)).all(axis=1)
    views = Views(
        np.concatenate([[0], np.cumsum(np.bincount(point[inside], minlength=len(truth)))]),
        camera[inside],
    )
    return views, pixels[inside] + rng.normal(0.0, noise_px, (inside.sum(), 2))


def turned(cameras, points, turn):
    """Return a scene turned about the origin: with it the level water is a tilted plane."""
    rotations = cameras.rotations @ turn.T
    return replace(cameras, centres=cameras.centres @ turn.T, rotations=rotations), points @ turn.T


SAMPLE, COUNT = 1_500, 20_000


@lru_cache
def noisy(block):
    """Return a scene through level water at 0 m with half a pixel of noise, and its floor."""
    rng = np.random.default_rng(11)
    cameras, truth = BLOCKS[block](rng), bed(COUNT)
    views, pixels = every_view(truth, cameras, 0.0, rng, 0.5)
    apparent = triangulate(pixels, cameras, views.camera, views.start, PLAIN, truth)
    start = views.start[: SAMPLE + 1]
    owner, camera = np.repeat(np.arange(SAMPLE), np.diff(start)), views.camera[: start[-1]]

    def images(points):
        return images_through_level(points[owner], cameras, camera, 0.0, N_WATER)

    floor = least_squares_points(images, pixels[: start[-1]], start, truth[:SAMPLE])
    return cameras, truth, apparent, views, floor


@pytest.mark.parametrize("scene", mostly_nightly(["nadir", "oblique", "river"]))
def test_noise_floor(scene):
    cameras, truth, apparent, views, floor = noisy("nadir" if scene == "nadir" else "oblique")
    turn, plane = np.eye(3), (0.0, 0.0, 0.0)
    if scene == "river":  # a fall of 1 in 100, slantwise
        turn = Rotation.from_rotvec([0.006, 0.008, 0.0]).as_matrix()
        up = turn[:, 2]
        plane = (0.0, -up[0] / up[2], -up[1] / up[2])
    there, points = turned(cameras, apparent, turn)
    result = run(points + UTM, moved(there, UTM), in_utm(plane), views)
    assert (result.outcome == Outcome.CORRECTED).all()
    error = result.shift_m @ turn + apparent - truth
    # 20,000 points whose errors are half a GSD tell the bias to 0.004 GSD
    assert np.abs(error.mean(axis=0)).max() < 0.05 * GSD_M
    below = floor - truth[:SAMPLE]
    ratio = np.sqrt((error[:SAMPLE] ** 2).mean(axis=0) / (below**2).mean(axis=0))
    assert ratio.max() < 1.05


# the same bits, and what cannot be done


@pytest.fixture(scope="module")
def many():
    rng = np.random.default_rng(12)
    cameras, truth = oblique_block(rng), bed(400)
    views, pixels = every_view(truth, cameras, 0.4, rng, 0.5)
    apparent = triangulate(pixels, cameras, views.camera, views.start, PLAIN, truth)
    return apparent + UTM, moved(cameras, UTM), in_utm(LEVEL), views


def test_counts_as_snell(many):
    one, other = (run(*many, method=method) for method in ("consistent", "snell"))
    for name in ("outcome", "ray_count", "camera_used"):
        assert np.array_equal(getattr(one, name), getattr(other, name))
    assert one.incidence_deg == pytest.approx(other.incidence_deg, abs=1e-9)
    # the solution of snell is the nearest to the refracted rays, nothing else can be nearer
    assert (one.ray_miss_m >= other.ray_miss_m - NANOMETRE).all()


def test_ray_miss(many):
    points, cameras, water, views = many
    result = run(points, cameras, water, views)
    for i in (5, 105, 205):
        mine = views.camera[views.start[i] : views.start[i + 1]]
        squares = []
        for centre in cameras.centres[mine]:
            down = (points[i] - centre) / np.linalg.norm(points[i] - centre)
            pierced = centre + down * (centre[2] - water.a) / -down[2]
            side = np.hypot(*down[:2])
            refracted = np.append(down[:2] / N_WATER, -np.sqrt(1.0 - (side / N_WATER) ** 2))
            away = points[i] + result.shift_m[i] - pierced
            squares.append(np.sum(np.cross(away, refracted) ** 2))
        # coordinates of UTM are known to 1e-9 m
        assert result.ray_miss_m[i] == pytest.approx(np.sqrt(np.mean(squares)), abs=MICROMETRE)


def test_unsolved_keep_snell():
    # the second camera looks away: it has no image of the point, and no list gives it a ray
    cameras = looking([[-20.0, 0, 70], [20.0, 0, 70]], [15.0, 170.0], [0.0, 0.0])
    water = WaterPlane(0.0)
    points, views = np.array([[0.0, 0, -3], [0.0, 1, -2]]), views_of([[0, 1], [0, 1]])
    listed = run(points, cameras, water, views)
    assert (listed.outcome == Outcome.ONE_CAMERA).all()
    batch = batch_of(points, surface_above(water, points), water, cameras, ScienceOptions(), views)
    with warned("points.unsolved", points=2):
        result = consistent(batch)
    expected = intersect(batch)
    assert (result.outcome == Outcome.CORRECTED).all()
    assert result.shift_m == pytest.approx(expected.shift_m, abs=NANOMETRE)


@pytest.mark.parametrize("missing", [["lenses"], ["angles", "lenses"]])
def test_no_orientation(missing):
    bare = replace(looking([[-20.0, 0, 70], [20.0, 0, 70]], [15.0] * 2, [0.0, 180.0]), lenses=None)
    if "angles" in missing:
        bare = replace(bare, rotations=None)
    with refused("cameras.no_orientation", SettingError, missing=missing):
        pcfix.correct_points(np.array([[0.0, 0, -3]]), bare, 0.0, method="consistent")
