"""Which cameras a cloud hides from its own points: shadows known from plane geometry."""

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.io.views import ViewMatch, read_views
from pcfix.model import Views
from pcfix.refract.occlusion import occluded, visible_cameras
from tests.utils.clouds import occluder_of
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")

UTM = np.array([512_345.678, 4_987_654.321, 0.0])


def hidden_of(xyz, centres, occluder):
    """Return whether each camera is hidden from each point, shape (n, k)."""
    n, k = len(xyz), len(centres)
    of_all = Views(np.arange(n + 1) * k, np.tile(np.arange(k), n))
    return occluded(xyz, centres, of_all, occluder).reshape(n, k)


def ring(incidence_deg, away_m=100.0, k=8):
    """Return centres around the origin, all at one incidence angle."""
    azimuth = np.arange(k) * 2.0 * np.pi / k
    angle = np.radians(incidence_deg)
    plan = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * np.sin(angle)
    return away_m * np.column_stack([plan, np.full(k, np.cos(angle))])


def plain(rng, n=60_000, half_m=10.0, slope_deg=0.0, noise_m=0.0):
    """Return a bed 5 m below zero that falls towards one side, and its noise."""
    xy = rng.uniform(-half_m, half_m, (n, 2))
    rise = np.tan(np.radians(slope_deg)) * (xy @ [np.cos(0.5), np.sin(0.5)])
    return np.column_stack([xy, rise - 5.0 + rng.normal(0.0, 1.0, n) * noise_m])


# --- what hides ----------------------------------------------------------------------------------


WALL_M, THICK_M = 4.0, 1.0


@pytest.fixture(scope="module")
def walled():
    """Return a flat bed at zero with a wall along y at x = 0 to 1, and the surface of both."""
    rng = np.random.default_rng(3)
    bed = plain(rng, noise_m=0.01) + np.array([0.0, 0.0, 5.0])
    bed = bed[(bed[:, 0] < 0.0) | (bed[:, 0] > THICK_M)]
    top = np.column_stack(
        [rng.uniform([0, -10], [THICK_M, 10], (12_000, 2)), np.full(12_000, WALL_M)]
    )
    face = rng.uniform([0, -10, 0], [0, 10, WALL_M], (5_000, 3))
    return bed, face, occluder_of(np.vstack([bed, top, face]) + UTM)


@pytest.mark.parametrize("incidence_deg", [15.0, 30.0, 45.0, 60.0])
def test_wall(walled, incidence_deg):
    bed, _, occluder = walled
    centres = np.array([[200.0, 0.0, 200.0 / np.tan(np.radians(incidence_deg))]])
    bed = bed[np.abs(bed[:, 1]) < 8.0]
    found = hidden_of(bed + UTM, centres + UTM, occluder)[:, 0]
    # the rays rise towards the camera, so that it is the face at x = 0 that they meet, or miss
    rise = centres[0, 2] / (centres[0, 0] - bed[:, 0])
    in_shadow = (bed[:, 0] < 0.0) & (-bed[:, 0] * rise < WALL_M)
    # the wall's edges are known to a cell; the margin moves the limit by itself over the rise
    limit = WALL_M / rise
    sure = np.abs(-bed[:, 0] - limit) > occluder.cell_m + occluder.margin.max() / rise
    sure &= np.abs(bed[:, 0] - THICK_M) > occluder.cell_m
    assert occluder.cell_m < 0.3
    assert (found == in_shadow)[sure].all()
    assert in_shadow[sure].any()


def test_wall_face(walled):
    _, face, occluder = walled
    face = face[(face[:, 2] < WALL_M - 1.0) & (np.abs(face[:, 1]) < 8.0)]
    front, back = [-60.0, 0.0, 60.0], [60.0, 0.0, 20.0]
    found = hidden_of(face + UTM, np.array([front, back]) + UTM, occluder)
    assert not found[:, 0].any()
    # the ray to the back rises 1/3: after the 1 m of wall it is still below its top
    assert found[:, 1].all()


def hidden_by_small_steps(point, centre, occluder):
    """Return whether the ray is below some cell's height at the last of the steps within it."""
    origin = np.array([occluder.left_m, occluder.bottom_m])
    here, there = (point[:2] - origin) / occluder.cell_m, (centre[:2] - origin) / occluder.cell_m
    run = np.linalg.norm(there - here)
    t = np.arange(2.0, max(run, 2.0005), 1e-3)
    column, row = np.floor(here[:, None] + np.outer((there - here) / run, t)).astype(int)
    last = np.append((np.diff(row) != 0) | (np.diff(column) != 0), False)
    rows, columns = occluder.height.shape
    last &= (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    margin = occluder.margin[int(here[1]) // 16, int(here[0]) // 16]
    z = point[2] + t / run * (centre[2] - point[2]) + margin
    return bool((z[last] < occluder.height[row[last], column[last]]).any())


def test_blocks_of_cells():
    rng = np.random.default_rng(10)
    xyz = rng.uniform([0, 0, 0], [80, 80, 0], (60_000, 3))
    xyz[:, 2] = 4.0 * np.sin(xyz[:, 0] / 4.0) * np.sin(xyz[:, 1] / 5.0)
    xyz[:, 2] += 6.0 * (np.sin(xyz[:, 0] / 1.7) * np.sin(xyz[:, 1] / 1.9) > 0.7)  # crowns
    occluder = occluder_of(xyz)
    low = xyz[xyz[:, 2] < 1.0][:400]
    centres = rng.uniform([-20, -20, 15], [100, 100, 40], (6, 3))
    found = hidden_of(low, centres, occluder)
    twin = np.array([[hidden_by_small_steps(p, c, occluder) for c in centres] for p in low])
    # in steps of 1/1000 of a cell, cells whose corner is cut by less are not seen; a step
    # rises by some millimetres at most
    assert (found != twin).mean() < 0.002
    assert 0.05 < found.mean() < 0.95


# --- what does not -------------------------------------------------------------------------------


@pytest.mark.parametrize("slope_deg", [0.0, 20.0])
@pytest.mark.parametrize("noise_in_spacings", [0.0, 0.5, 1.0, 2.0])
def test_even_bed(slope_deg, noise_in_spacings):
    rng = np.random.default_rng(6)
    noise_m = noise_in_spacings * 20.0 / np.sqrt(60_000)
    bed = plain(rng, slope_deg=slope_deg, noise_m=noise_m)
    found = hidden_of(bed, ring(45.0), occluder_of(bed))
    # of noise with 2 spacings, which is far more than clouds have, one ray in 200 may be hidden
    assert found.mean() < (0.005 if noise_in_spacings else 1e-9)


def test_flying_points():
    rng = np.random.default_rng(8)
    bed = plain(rng, noise_m=0.02)
    flying = (rng.random(len(bed)) < 0.003) * rng.uniform(2.0, 15.0, len(bed))
    occluder = occluder_of(bed + flying[:, None] * [0.0, 0.0, 1.0])
    # a cell counts with two of them, beside another that has two: one in 1e5
    assert hidden_of(bed[flying == 0.0], ring(45.0), occluder).mean() < 1e-3


# --- views ---------------------------------------------------------------------------------------


def test_visible_cameras(walled):
    _, _, occluder = walled
    centres = np.array([[200.0, 0.0, 100.0], [-20.0, 0.0, 60.0], [-30.0, 0.0, 60.0]]) + UTM
    xyz = np.array([[-2.0, 0.0, 0.0], [-2.0, 1.0, 0.0], [-9.0, 0.0, 0.0]]) + UTM
    camera = np.array([0, 1, 2, 1, 0, 2, 0])
    views = Views(np.array([0, 3, 5, 7]), camera, np.arange(7, dtype=np.float32), "depth-maps")
    found = visible_cameras(xyz, centres, views, occluder)
    # the first camera is in the shadow of the wall for the first two points (8 m at 63 degrees)
    assert found.start.tolist() == [0, 2, 4, 6]
    assert found.camera.tolist() == [1, 2, 1, 0, 2, 0]
    assert found.weight.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0] and found.kind == "depth-maps"


@rendered
def test_real_views():
    cameras = pcfix.read_cameras(RENDERED / "cameras.csv")
    las = laspy.read(RENDERED / "cloud.las")
    xyz = np.column_stack([las.x, las.y, las.z])
    views = read_views(RENDERED / "dense.vis", cameras)
    match = ViewMatch(views, cameras, points=len(xyz))
    found = occluded(xyz, cameras.centres, match.views_of(xyz, 0)[0], occluder_of(xyz))
    assert found.mean() < 0.01  # of entries, all of which are of images that saw the point
