"""Neighbours against brute force over all pairs, and outliers against open3d."""

import numpy as np
import pytest

from pcfix.errors import load_open3d
from pcfix.options.steps import CleanRules
from pcfix.points.neighbours import Neighbours, make_tiles
from tests.points.scenes import reasons_of, spoilt_scene
from tests.utils.nightly import mostly_nightly

K = 12
FEW, OUTLIERS = 15_000, 75


def test_neighbours_of_all_pairs() -> None:
    """Clusters of many densities in UTM, with one point at the origin of the coordinates."""
    rng = np.random.default_rng(2)
    centres = rng.uniform(0.0, 50.0, (9, 3))
    spread = 10.0 ** rng.uniform(-1.5, 1.0, (9, 1))
    which = rng.integers(0, 9, 500)
    xyz = centres[which] + rng.normal(size=(500, 3)) * spread[which]
    xyz += (410_200.0, 4_650_300.0, 0.0)
    xyz[250] = 0.0
    for axes in (2, 3):
        every = np.linalg.norm(xyz[:, None, :axes] - xyz[None, :, :axes], axis=2)
        twin = np.sort(every, axis=1)[:, :K]
        for points in (2, 20, 90, 400, 1_000_000):
            cut = make_tiles(xyz, points=points)
            near, found = Neighbours(cut, axes), np.empty(twin.shape)
            for piece in cut.pieces(100):
                found[cut.row[piece]], place = near.nearest(cut.xyz[piece], K)
                difference = cut.xyz[place][..., :axes] - cut.xyz[piece][:, None, :axes]
                far = np.linalg.norm(difference, axis=2)
                np.testing.assert_allclose(far, found[cut.row[piece]], rtol=1e-12)
            np.testing.assert_allclose(found, twin, rtol=1e-12)


OPEN3D = [
    ("statistical", {"neighbours": 8, "deviations": 2.0}, (8, 2.0)),
    ("statistical", {"neighbours": 20, "deviations": 2.0}, (20, 2.0)),
    ("statistical", {"neighbours": 20, "deviations": 0.5}, (20, 0.5)),
    ("radius", {"deviations": None, "radius": 0.6, "radius_neighbours": 1}, (1, 0.6)),
    ("radius", {"deviations": None, "radius": 1.0, "radius_neighbours": 6}, (6, 1.0)),
]


@pytest.mark.parametrize(
    ("test", "rules", "arguments"), mostly_nightly(OPEN3D, OPEN3D[0], OPEN3D[-1])
)
def test_outliers_of_open3d(test: str, rules: dict, arguments: tuple) -> None:
    o3d, xyz = load_open3d(), spoilt_scene(FEW, OUTLIERS).xyz
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
    _, inliers = getattr(cloud, f"remove_{test}_outlier")(*arguments)
    settings = CleanRules(**rules, below=None, floating=None)
    found = reasons_of(xyz, rules=settings)
    assert np.array_equal(np.flatnonzero(found == 0), np.asarray(inliers))
    assert len(inliers) < len(xyz)
