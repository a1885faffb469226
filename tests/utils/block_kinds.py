"""Blocks of several shapes over water, and what adjustments make of their poses.

Light is traced by `pcfix.simulate.tracing`, which shares nothing with the adjustment.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import Block, plain_block
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.problem import prepare, solved_cameras
from pcfix.adjust.solve import solve
from pcfix.io.cameras.colmap import write_colmap
from pcfix.lens.imaging import unproject
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    GnssPositions,
    Lens,
    TiePoints,
    Views,
    WaterPlane,
)
from pcfix.simulate.scene import ORIGIN_M
from pcfix.simulate.tracing import triangulate
from tests.utils.adjust_files import EPSG, write_gnss
from tests.utils.bed_rays import piercing_points
from tests.utils.clouds import write_las
from tests.utils.unaware_blocks import similarity

GNSS_M, NOISE_PX = 0.025, 0.5
HEIGHT_M, DEPTH_M = 75.0, 6.0
FOCAL_PX, SIZE, N = 1500.0, (1600.0, 1200.0), 1.34
DOWN = np.diag([1.0, -1.0, -1.0])
GSD_M = HEIGHT_M / FOCAL_PX
BASE_M, STRIP_M = 12.0, 28.0
ALONG, ACROSS = 90.0, 0.0


def _strips(count, images, heading=ALONG, height=HEIGHT_M, spacing=STRIP_M):
    """Return x, y, z and heading of images in strips to and fro about the origin."""
    row, step = (a.ravel() for a in np.indices((count, images)))
    along = (step - (images - 1) / 2.0) * BASE_M * height / HEIGHT_M
    side = (row - (count - 1) / 2.0) * spacing
    x, y = (along, side) if heading == ALONG else (side, along)
    return np.column_stack([x, y, np.full(x.size, height), heading + 180.0 * (row % 2)])


def _two_heights():
    return np.vstack([_strips(3, 6, height=60.0, spacing=24.0), _strips(2, 5, height=90.0)])


def _river(x, y, reach):
    """Return the height of a winding channel and its banks."""
    across = (y - 5.0 * np.sin(x / 25.0)) / (0.5 * reach[1])
    return np.minimum(-0.5 * DEPTH_M * (1.0 - across**2), 1.5)


def _shore(share):
    """Return ground of which so much at the west end is land."""

    def height(x, _, reach):
        east = (x / reach[0] + 1.0) / 2.0
        bed = -0.2 - DEPTH_M * (east - share) / (1.0 - share)
        return np.where(east < share, 0.3 + 1.5 * (share - east) / max(share, 1e-9), bed)

    return height


def _open(x, y, reach):
    """Return a bed that leans to both sides, all of it under water."""
    return -0.5 * DEPTH_M * (1.0 + 0.4 * x / reach[0] + 0.3 * y / reach[1])


# How each kind is flown, and the height of its ground above the water at n places of an area that
# reaches so far to either side.
KINDS = {
    "corridor": (lambda: _strips(2, 12), _river),
    "single strip": (lambda: _strips(1, 14), _shore(0.35)),
    "cross strips": (lambda: np.vstack([_strips(3, 6), _strips(3, 6, ACROSS)]), _shore(0.3)),
    "two heights": (_two_heights, _shore(0.3)),
    "20 % land": (lambda: _strips(4, 6), _shore(0.2)),
    "no land": (lambda: _strips(4, 6), _open),
}


class KindBlock:
    """A block of one of `KINDS`, about the origin; water at zero.

    True cameras with GNSS positions, true points, and image places with noise.
    """

    def __init__(self, kind: str, seed: int, points: int = 900, cloud: int = 3000):
        rng = np.random.default_rng([seed, *kind.encode()])
        flown, ground = KINDS[kind]
        plan = flown()
        lens = Lens(FOCAL_PX, *SIZE, 800.0 + rng.normal(0, 3), 600.0 + rng.normal(0, 3))
        centres = plan[:, :3] + rng.normal(0.0, 0.5, (len(plan), 3))
        angles = rng.normal(0.0, 2.0, centres.shape)
        angles[:, 0] += plan[:, 3]
        rotations = DOWN @ Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
        gnss = centres + rng.normal(0.0, GNSS_M, centres.shape)
        self.cameras = Cameras(
            tuple(f"{i:03d}.jpg" for i in range(len(plan))), centres, rotations,
            (lens,) * len(plan),
            gnss=GnssPositions(gnss, np.full(centres.shape, GNSS_M), None),
        )  # fmt: skip
        reach = np.abs(centres[:, :2]).max(axis=0) + 15.0
        xy = rng.uniform(-reach, reach, (points + cloud, 2))
        swell = 0.4 * np.sin(xy[:, 0] / 9) * np.sin(xy[:, 1] / 7)
        z = ground(*xy.T, reach)
        xyz = np.column_stack([xy, z + np.where(z < 0.0, swell * np.minimum(1.0, -z), swell)])
        self._look(xyz, lens, rng)
        self.ties = int(points * len(self.xyz) / len(xyz))

    def _look(self, xyz: FloatArray, lens: Lens, rng: np.random.Generator) -> None:
        point, camera = (a.ravel() for a in np.indices((len(xyz), len(self.cameras))))
        centres = self.cameras.centres[camera]
        straight = piercing_points(xyz[point], centres, 0.0, N) - centres
        local = np.einsum("oij,oj->oi", self.cameras.rotations[camera], straight)
        uv = lens.focal * local[:, :2] / local[:, 2:] + [lens.principal_x, lens.principal_y]
        inside = (local[:, 2] > 0) & (uv > 0).all(axis=1) & (uv < SIZE).all(axis=1)
        inside &= np.bincount(point[inside], minlength=len(xyz))[point] >= 3
        number = np.cumsum(np.bincount(point[inside], minlength=len(xyz)) > 0) - 1
        seen = np.unique(point[inside])
        self.xyz, self.camera = xyz[seen], camera[inside]
        counts = np.bincount(number[point[inside]], minlength=len(seen))
        self.start = np.concatenate([[0], np.cumsum(counts)])
        self.image_xy = uv[inside] + rng.normal(0.0, NOISE_PX, (inside.sum(), 2))

    def block(
        self, cameras: Cameras, water: WaterPlane | None = None, wet: BoolArray | None = None
    ) -> Block:
        """Return what was measured as a block with given cameras."""
        ties = TiePoints(self.xyz, Views(self.start, self.camera), self.image_xy)
        return plain_block(cameras, ties, water, N, wet)

    def adjusted(
        self, cameras: Cameras, unknowns: Unknowns, water: WaterPlane | None = None, *,
        weighs_gnss: bool = True,
    ) -> Cameras:  # fmt: skip
        """Return cameras after an adjustment, with water, or with straight rays."""
        gnss = self.cameras.gnss.xyz
        block = self.block(cameras, water, np.full(len(self.xyz), water is not None))
        block = replace(block, sigma_px=np.full(len(block.camera), NOISE_PX))
        if weighs_gnss:
            block = replace(block, gnss=GnssPositions(gnss, np.full(gnss.shape, 0.1), None))
        problem, start = prepare(block, unknowns)
        return solved_cameras(problem, solve(problem, start))

    def unaware(self, *, weighs_gnss: bool) -> Cameras:
        """Return the cameras as an adjustment with straight rays leaves them.

        One with a full lens and GNSS positions of 10 cm; or one with focal length and k1, the
        principal point in the middle of the image, that is laid onto the positions afterwards.
        """
        middle = replace(self.cameras.lenses[0], principal_x=SIZE[0] / 2, principal_y=SIZE[1] / 2)
        cameras = replace(self.cameras, lenses=(middle,) * len(self.cameras))
        unknowns = Unknowns(lens=("f", "k1"), free_network=True)
        if weighs_gnss:
            unknowns = Unknowns(lens=("f", "cx", "cy", "k1", "k2", "p1", "p2"))
        ties = self.part(slice(0, self.ties))
        found = ties.adjusted(cameras, unknowns, weighs_gnss=weighs_gnss)
        if not weighs_gnss:
            scale, turn, shift = similarity(found.centres, self.cameras.gnss.xyz)
            found = replace(
                found, centres=scale * found.centres @ turn.T + shift,
                rotations=found.rotations @ turn.T,
            )  # fmt: skip
        return replace(found, gnss=None)

    def part(self, rows: slice) -> "KindBlock":
        """Return the block with some of its points."""
        first, last, _ = rows.indices(len(self.xyz))
        some = object.__new__(KindBlock)
        here = slice(self.start[first], self.start[last])
        some.cameras, some.xyz = self.cameras, self.xyz[first:last]
        some.start = self.start[first : last + 1] - self.start[first]
        some.camera, some.image_xy = self.camera[here], self.image_xy[here]
        return some

    def apparent(self, cameras: Cameras) -> FloatArray:
        """Return where straight rays of some cameras meet."""
        lens = cameras.lenses[0]
        ahead = unproject(lens, self.image_xy)
        principal = [lens.principal_x, lens.principal_y]
        plain = lens.focal * ahead[:, :2] / ahead[:, 2:] + principal
        return triangulate(plain, cameras, self.camera, self.start, lens, self.xyz)


def write_kind(
    folder: Path, kind: str, seed: int, points: int = 900, cloud: int = 3000
) -> FloatArray:
    """Write what the user of such a block has, and return the true points of the cloud.

    model/ : COLMAP, with tie points; cloud.las; gnss.csv; true/ : the model as it is in truth.
    """
    data = KindBlock(kind, seed, points, cloud)
    old = data.unaware(weighs_gnss=seed % 2 == 0)
    ties, cloud = data.part(slice(0, data.ties)), data.part(slice(data.ties, None))
    tracks = TiePoints(ties.apparent(old) + ORIGIN_M, Views(ties.start, ties.camera), ties.image_xy)
    placed = replace(old, centres=old.centres + ORIGIN_M, crs=EPSG)
    write_colmap(folder / "model", placed, tracks)
    true = replace(data.cameras, centres=data.cameras.centres + ORIGIN_M, gnss=None, crs=EPSG)
    write_colmap(folder / "true", true)
    write_las(folder / "cloud.las", cloud.apparent(old) + ORIGIN_M)
    gnss = data.cameras.gnss
    write_gnss(folder / "gnss.csv", data.cameras.labels, gnss.xyz + ORIGIN_M, gnss.sigma_m)
    return cloud.xyz + ORIGIN_M
