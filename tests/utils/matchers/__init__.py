"""Scenes whose clouds were made by simulated dense matchers."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pcfix.model import Views
from pcfix.simulate.scene import (
    Scene,
    find_visible,
    lay_out,
    points_on,
    scene_of,
    simulate_scene,
    starts,
)
from pcfix.simulate.settings import SceneSettings, Terrain
from tests.utils.matchers.depth_maps import fuse_depth_maps, keep_single_maps, stereo_models
from tests.utils.matchers.pairs import SAMPLE, TIES, match_pairs, neighbour_table, openmvs_partners

# Images with which each is matched.
NEIGHBOURS = {"pairs": 4, "depth-maps": 5, "single-map": 6, "nearest-map": 6}
PAIRS_AT_ONCE = 50_000


@dataclass(frozen=True, eq=False)
class MatchedScene(Scene):
    """A scene with the images that each image was matched with, shape (k, c), -1 for none."""

    neighbours: np.ndarray | None = None


def matched_scene(points: int, *, cloud: str = "tracks", **keywords) -> Scene:
    """Simulate a scene as `pcfix.simulate_scene`, with a cloud of tracks or of `NEIGHBOURS`."""
    if cloud == "tracks":
        return MatchedScene(**vars(simulate_scene(points, **keywords)))
    chosen = SceneSettings(points=points, **keywords)
    site, count = lay_out(chosen), NEIGHBOURS[cloud]
    truth = points_on(site.terrain, points, site.rng)
    rng, matching = map(np.random.default_rng, (0, [chosen.seed, 4]))
    sure, parts = replace(site, detection=1.0), []
    if cloud == "pairs":
        sample = truth[:: max(1, len(truth) // SAMPLE)][:SAMPLE]
        table = neighbour_table(find_visible(sample, sure, rng), count)
    elif cloud in ("single-map", "nearest-map"):
        partners = stereo_models(site.given, float(np.median(truth[:, 2])), count)
        table = partners.matched
    else:
        sample = points_on(site.terrain, max(TIES, 10 * len(site.true)), rng)
        every = find_visible(sample, sure, rng)
        partners = openmvs_partners(every.intersected(every.ideal), every, count, rng)
        table = partners.matched

    at_once = max(1, PAIRS_AT_ONCE // len(site.true))
    for some in np.split(truth, range(at_once, len(truth), at_once)):
        imaged = find_visible(some, site, site.luck)
        if cloud == "depth-maps":
            normals = normals_of(site.terrain, *some[:, :2].T)
            parts.append(fuse_depth_maps(imaged, normals, partners, matching))
        elif cloud in ("single-map", "nearest-map"):
            normals, nearest = normals_of(site.terrain, *some[:, :2].T), cloud == "nearest-map"
            parts.append(keep_single_maps(imaged, normals, partners, matching, nearest=nearest))
        else:
            parts.append(match_pairs(imaged, table, matching))
    xyz, true, camera, counts, *weight = map(np.concatenate, zip(*parts, strict=True))
    scene = vars(scene_of(chosen, site, xyz, true, Views(starts(counts), camera, *weight)))
    return MatchedScene(**scene, neighbours=table)


def normals_of(ground: Terrain, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return unit normals of a terrain, up, shape (m, 3), from differences over 0.2 mm.

    Beside the wall of a step, a slope steeper than 10, the bed is level.
    """
    d, water = 1e-4, ground.water
    along_x = (ground.height(x + d, y) - ground.height(x - d, y)) / (2.0 * d)
    along_y = (ground.height(x, y + d) - ground.height(x, y - d)) / (2.0 * d)
    wall = np.hypot(along_x, along_y) > 10.0
    slopes = np.where(wall, water.b, along_x), np.where(wall, water.c, along_y)
    up = np.column_stack([-slopes[0], -slopes[1], np.ones(len(x))])
    return up / np.linalg.norm(up, axis=1)[:, None]


simulated = lru_cache(maxsize=8)(matched_scene)
