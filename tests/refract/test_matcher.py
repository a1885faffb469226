"""Which images are matched with which: loops over the formula, and what real software chose."""

from dataclasses import replace

import numpy as np
import pytest

import pcfix
from pcfix.io.cameras import read_tie_points
from pcfix.model import TiePoints, Views
from pcfix.refract.matcher import REPEATED_DEG, matcher_of, matcher_of_ties
from tests.utils.depth_map_twin import in_frame, looking, scores_slowly
from tests.utils.matchers import matched_scene
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")


def block(rng):
    """Return fourteen nadir and six oblique images, and places that they see."""
    grid = np.stack(np.meshgrid(np.arange(-40, 41, 14.0), [-18.0, 16.0]), axis=2).reshape(-1, 2)
    nadir = np.column_stack([grid, np.full(len(grid), 70.0)]) + rng.normal(0, 1.5, (len(grid), 3))
    far = [[-70, 0, 66], [68, 8, 70], [3, -66, 69], [-5, 71, 72], [-60, 30, 110], [20, 60, 30]]
    centres = np.vstack([nadir, np.array(far, float)])
    tilts = [*rng.uniform(0, 3, len(nadir)), 35, 35, 35, 35, 30, 50]
    headings = [*rng.uniform(0, 360, len(nadir)), 0, 180, 90, 270, 330, 250]
    places = np.column_stack([rng.uniform(-45, 45, (220, 2)), rng.uniform(-6, 3, 220)])
    return looking(centres, tilts, headings), places


def table_of(score, columns):
    """Return the best columns of each row of scores, -1 where a score is zero."""
    best = np.argsort(-score, axis=1, kind="stable")[:, :columns]
    return np.where(np.take_along_axis(score, best, axis=1) > 0.0, best, -1)


def test_partners_of_places():
    cameras, places = block(np.random.default_rng(1))
    found = matcher_of(cameras, places)
    slow = scores_slowly(cameras, places, in_frame(cameras, places), REPEATED_DEG)
    assert (slow[:, -2:] == 0.0).any() and (slow > 0.0).any(axis=1).all()
    for table, columns in ((found.matched, 5), (found.averaged, 8), (found.fused, 12)):
        assert np.array_equal(table, table_of(slow, columns))


def test_partners_of_ties():
    rng = np.random.default_rng(2)
    cameras, places = block(rng)
    places[7] = np.nan  # a tie point without coordinates
    seen = in_frame(cameras, places) & (rng.uniform(0, 1, (len(cameras), len(places))) < 0.5)
    point, camera = np.nonzero(seen.T)
    start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(places)))])
    ties = TiePoints(places, Views(start, camera), np.zeros((len(camera), 2)))
    slow = scores_slowly(cameras, places, seen)
    assert np.array_equal(matcher_of_ties(cameras, ties).fused, table_of(slow, 12))


@pytest.mark.parametrize("obliques", [{}, {"obliques_deg": 35.0, "oblique_share": 0.5}])
def test_simulated_partners(obliques):
    """The simulator has the formula of its own, for features that are found again by chance."""
    area = {"area_m": (70.0, 50.0), "lidar_per_m2": 0.0}
    scene = matched_scene(600, cloud="depth-maps", **area, **obliques)
    found = matcher_of(scene.cameras, scene.xyz).matched
    partners = {i: [j for j in row if j >= 0] for i, row in enumerate(scene.neighbours.tolist())}
    assert share_found(found, partners) > 0.85  # 0.95 and 0.92 of larger blocks with more points


def real_block():
    local = pcfix.read_cameras(RENDERED / "colmap")
    offset = np.loadtxt(RENDERED / "offset.txt")
    rows = {name.rpartition(".")[0]: i for i, name in enumerate(local.labels)}
    partners = {}
    for line in (RENDERED / "neighbours.txt").read_text().splitlines():
        if not line.startswith("#"):
            mine, *others = (rows[name.rpartition(".")[0]] for name in line.split())
            partners[mine] = others
    return local, replace(local, centres=local.centres + offset), partners


def share_found(matched, partners):
    found = sum(len(set(matched[i].tolist()) & set(row)) for i, row in partners.items())
    return found / sum(map(len, partners.values()))


@rendered
def test_real_partners_of_places():
    import laspy

    _, cameras, partners = real_block()
    xyz = np.ascontiguousarray(laspy.read(RENDERED / "cloud.las").xyz[::60])
    # 147 of 160; the software went by tie points, and the cloud is denser where texture is good
    assert share_found(matcher_of(cameras, xyz).matched, partners) >= 0.88


@rendered
def test_real_partners_of_ties():
    local, _, partners = real_block()
    ties = read_tie_points(RENDERED / "colmap", local)
    # 156 of 160, from a seventh of the tie points that the software had
    assert share_found(matcher_of_ties(local, ties).matched, partners) >= 0.95
