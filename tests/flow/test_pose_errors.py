"""What the errors of an adjustment add to SigmaZ: a slow twin, repeats, and the doors."""

from dataclasses import replace

import laspy
import numpy as np
import pytest
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.adjust.precision import Members
from pcfix.adjust.transfer import CloudTransfer
from pcfix.flow.poses import variances
from pcfix.flow.surfaces import Points
from pcfix.io.files import ENSEMBLE, write_members
from pcfix.model import Cameras, Lens, Views, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Survey
from pcfix.simulate.tracing import project, triangulate
from tests.utils.bed_rays import piercing_points
from tests.utils.beyond_frames import BEYOND_FRAMES
from tests.utils.clouds import WATER_M, cameras_csv, framed_block, write_cloud

pytestmark = [BEYOND_FRAMES, pytest.mark.usefixtures("one_thread")]

LENS = Lens(1500.0, 1600.0, 1200.0, 800.0, 600.0)
EXACT = ScienceOptions(
    method="consistent", camera_set="all", max_angle=None, sigma_image=0.0, sigma_level=0.0,
    sigma_index=0.0,
)  # fmt: skip


UNKNOWNS = 21  # turn and centre of each camera, focal length, level and index
N, LEVEL_M = 1.34, 0.2


class SlowTwin:
    """Points from their places in three images, cameras and water given as one vector."""

    def __init__(self, cameras, image):
        self.cameras, self.image = cameras, image
        self.camera, self.start = np.arange(len(image)) % 3, np.arange(0, len(image) + 1, 3)

    def straight(self, image, cameras, near):
        return triangulate(image, cameras, self.camera, self.start, cameras.lenses[0], near)

    def true(self, x, near):
        """Return the points whose bent images meet, straight, where the measured ones do."""
        poses, (focal, level, n) = x[:18].reshape(3, 6), x[18:]
        turned = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ self.cameras.rotations
        cameras = replace(
            self.cameras, centres=self.cameras.centres + poses[:, 3:], rotations=turned,
            lenses=(replace(LENS, focal=LENS.focal + focal),) * 3,
        )  # fmt: skip
        met = self.straight(self.image, cameras, near)

        def miss(flat):
            xyz = np.repeat(flat.reshape(-1, 3), 3, axis=0)
            piercing = piercing_points(xyz, cameras.centres[self.camera], LEVEL_M + level, N + n)
            image, _ = project(piercing, cameras, self.camera, cameras.lenses[0])
            return (self.straight(image, cameras, met) - met).ravel()

        return fsolve(miss, near.ravel(), xtol=1e-10).reshape(-1, 3)


@pytest.mark.parametrize("moved", [False, True], ids=["adjusted before", "adjusted since"])
def test_same_as_twin(moved):
    rng = np.random.default_rng(5)
    centres = np.array([[-18.0, -3.0, 62.0], [2.0, 9.0, 60.0], [17.0, -6.0, 61.0]])
    tilts = Rotation.from_rotvec([[0.02, 0.15, 0.3], [-0.1, 0.03, 0.1], [0.05, -0.2, -0.2]])
    down = np.diag([1.0, -1.0, -1.0])
    new = Cameras(("a", "b", "c"), centres, tilts.as_matrix() @ down, (LENS,) * 3)
    turn = Rotation.from_rotvec(rng.normal(0.0, 2e-3, (3, 3))).as_matrix()
    old = replace(
        new, centres=new.centres + rng.normal(0.0, 0.1, (3, 3)), rotations=turn @ new.rotations
    )
    old = old if moved else new
    xyz = np.column_stack([rng.uniform(-6.0, 6.0, (4, 2)), [-1.0, -2.5, -4.0, -6.0]])
    sigma = np.array([1e-4, 1e-4, 1e-4, 0.02, 0.02, 0.03] * 3 + [0.5, 0.01, 0.001])
    mix = rng.normal(size=(UNKNOWNS, 2 * UNKNOWNS))
    correlation = np.corrcoef(mix)

    image, _ = project(np.repeat(xyz, 3, axis=0), old, np.arange(12) % 3, LENS)
    twin, zero = SlowTwin(new, image), np.zeros(UNKNOWNS)
    near = twin.true(zero, xyz)
    by = np.array(
        [(twin.true(step, near) - twin.true(-step, near))[:, 2] / 2.0 for step in np.diag(sigma)]
    )
    wanted = np.einsum("an,ab,bn->n", by, correlation, by)

    # members whose mean square is exactly the covariance of the unknowns of the twin
    covariance = correlation * sigma * sigma[:, None]
    steps = np.sqrt(UNKNOWNS) * np.linalg.cholesky(covariance).T
    poses, lens = steps[:, :18].reshape(-1, 3, 6), np.repeat(steps[:, None, 18:19], 3, axis=1)
    nothing = np.zeros(UNKNOWNS)
    members = Members(
        new.labels, np.full(3, LENS.focal), poses[:, :, :3],
        np.einsum("kij,mkj->mki", new.rotations, poses[:, :, 3:]), ("f",), lens,
        np.column_stack([steps[:, 19], nothing, nothing, steps[:, 20], *[nothing] * 3]),
    )  # fmt: skip
    views = Views(np.arange(0, 13, 3), np.arange(12) % 3)
    sample = Points(xyz, None, np.zeros(4, np.uint8), views=views)
    survey = Survey(WaterPlane(LEVEL_M), new, replace(EXACT, index=N))
    found = variances(sample, survey, members, CloudTransfer(old, new, np.arange(3)))
    assert np.sqrt(wanted).min() > 0.05
    # the twin is of first order, the members are not
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(wanted), rtol=0.01)


def members_of(cameras, sigma_m):
    """Return members in which the block stands higher or lower as a whole."""
    up = np.array([-1.0, 1.0])[:, None, None] * np.array([0.0, 0.0, sigma_m])
    nothing = np.zeros((2, len(cameras), 3))
    return Members(
        cameras.labels, np.array([lens.focal for lens in cameras.lenses]),
        nothing, nothing + up @ cameras.rotations[0].T, (), nothing[:, :, :0], np.zeros((2, 7)),
    )  # fmt: skip


@pytest.fixture
def files(tmp_path):
    (tmp_path / "out").mkdir()
    cameras = framed_block()
    path = cameras_csv(tmp_path / "out" / "cameras.csv", cameras, angles=True)
    (tmp_path / "out" / "sensor.csv").write_text("focal,sensor_x,sensor_y\n24,24,9.6\n")
    return write_cloud(tmp_path / "cloud.las", 7), path


def corrected(files, **more):
    cloud, cameras = files
    out = cloud.with_name("c.las")
    given = {"method": "snell", "max_angle": None, **more}
    summary = pcfix.correct_file(
        cloud, out, cameras=cameras, water=WATER_M, overwrite=True, sigma_level=0.0, **given
    )
    return summary, laspy.read(out)


def test_file(files):
    before, bare = corrected(files)
    assert "poses_m" not in before.uncertainty
    write_members(files[1].parent, members_of(pcfix.read_cameras(files[1]), 0.1))
    summary, las = corrected(files)
    moved = np.array(bare.SigmaZ) > 0.0
    # a block that stands higher by 0.1 m over fixed water has its bed higher by about that
    assert summary.uncertainty["poses_m"] == pytest.approx(0.1, rel=0.5)
    more = np.sqrt(np.array(las.SigmaZ)[moved] ** 2 - np.array(bare.SigmaZ)[moved] ** 2)
    assert np.median(more) == pytest.approx(summary.uncertainty["poses_m"], rel=0.1)
    assert not np.array(las.SigmaZ)[~moved].any()
    np.testing.assert_array_equal(las.xyz, bare.xyz)
    since, _ = corrected(files, adjusted_from=files[1])
    assert since.uncertainty["poses_m"] == pytest.approx(summary.uncertainty["poses_m"], rel=0.01)


def test_other_ensemble(files):
    _, bare = corrected(files)
    cameras = pcfix.read_cameras(files[1])
    lenses = tuple(replace(lens, focal=1.001 * lens.focal) for lens in cameras.lenses)
    where = files[1].parent
    write_members(where, members_of(replace(cameras, lenses=lenses), 0.1))
    summary, las = corrected(files)
    assert any(
        "ensemble.npz: belongs to other cameras" in note["message"] for note in summary.warnings
    )
    np.testing.assert_array_equal(las.SigmaZ, bare.SigmaZ)
    (where / ENSEMBLE).write_bytes(b"nothing of use")
    summary, las = corrected(files)
    assert any(
        "is not an ensemble of an adjustment" in note["message"] for note in summary.warnings
    )
    np.testing.assert_array_equal(las.SigmaZ, bare.SigmaZ)
    summary, _ = corrected(files, dimensions="minimal")  # then nobody asks for it
    assert not any("ensemble" in note["message"] for note in summary.warnings)
