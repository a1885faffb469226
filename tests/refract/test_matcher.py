"""Which images are matched with which: loops over the formula, and what real software chose."""

import pytest

from pcfix.io.cameras import read_tie_points
from pcfix.refract.matcher import matcher_of, matcher_of_ties
from tests.utils.matchers import matched_scene
from tests.utils.rendered import block_of, cloud_of
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")


@pytest.mark.parametrize("obliques", [{}, {"obliques_deg": 35.0, "oblique_share": 0.5}])
def test_simulated_partners(obliques):
    """The simulator has the formula of its own, for features that are found again by chance."""
    area = {"area_m": (70.0, 50.0), "lidar_per_m2": 0.0}
    scene = matched_scene(600, cloud="depth-maps", **area, **obliques)
    found = matcher_of(scene.cameras, scene.xyz).matched
    partners = {i: [j for j in row if j >= 0] for i, row in enumerate(scene.neighbours.tolist())}
    assert share_found(found, partners) > 0.85  # 0.95 and 0.92 of larger blocks with more points


def share_found(matched, partners):
    found = sum(len(set(matched[i].tolist()) & set(row)) for i, row in partners.items())
    return found / sum(map(len, partners.values()))


@rendered
def test_real_partners():
    local, cameras = block_of(RENDERED)
    rows = {name.rpartition(".")[0]: i for i, name in enumerate(local.labels)}
    partners = {}
    for line in (RENDERED / "neighbours.txt").read_text().splitlines():
        if not line.startswith("#"):
            mine, *others = (rows[name.rpartition(".")[0]] for name in line.split())
            partners[mine] = others
    of_places = matcher_of(cameras, cloud_of(RENDERED / "cloud.las")[::60])
    # 147 of 160; the software went by tie points, and the cloud is denser where texture is good
    assert share_found(of_places.matched, partners) >= 0.88
    of_ties = matcher_of_ties(local, read_tie_points(RENDERED / "colmap", local))
    # 156 of 160, from a seventh of the tie points that the software had
    assert share_found(of_ties.matched, partners) >= 0.95
