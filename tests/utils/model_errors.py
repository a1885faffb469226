"""Blocks whose observations are off by more than noise, adjusted as by default.

The errors are those of a lens with a term that its formula lacks, of wrong matches, and of the
water level. Poses are those that an adjustment without water has left.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import block_of as block_to_adjust
from pcfix.adjust.block import usable_ties
from pcfix.adjust.methods import adjust_block
from pcfix.adjust.normal import CAUCHY, SQUARES
from pcfix.adjust.parameters import Unknowns, default_lens
from pcfix.adjust.problem import intersect_fixed
from pcfix.adjust.result import Adjusted
from pcfix.model import Cameras, FloatArray, TiePoints, WaterPlane
from tests.utils.tie_blocks import block_of
from tests.utils.tie_points import TieScene, simulate_tie_points
from tests.utils.unaware_blocks import unaware

KINDS = ("lens", "mismatches", "level")
SIGMA_LEVEL_M = 0.03


class Run(NamedTuple):
    """A block after its adjustment: errors over standard errors, and the bed before and after.

    normalised : name of a kind of unknown to its errors; bed_gsd : rms errors of Z, in GSD.
    """

    found: Adjusted
    normalised: dict[str, FloatArray]
    bed_gsd: tuple[float, float]


def run(kind: str, seed: int, **settings: object) -> Run:
    """Simulate a block with errors of one of `KINDS`, or of none, and adjust it."""
    seed += 100_000 * (("none", *KINDS).index(kind))  # kinds share no scene
    rng = np.random.default_rng([seed, 77])
    chosen = {
        "points": int(rng.integers(400, 900)),
        "area_m": (float(rng.uniform(45, 80)), float(rng.uniform(40, 60))),
        "forward_overlap": float(rng.uniform(0.7, 0.8)),
        "side_overlap": float(rng.uniform(0.6, 0.7)),
        "greatest_depth_m": float(rng.uniform(3, 8)),
        "image_noise": float(rng.uniform(0.2, 0.6)),
        "position_noise_m": 0.3, "attitude_noise_deg": 0.2, "seed": seed,
    }  # fmt: skip
    if rng.random() < 0.7:
        chosen |= {"obliques_deg": float(rng.uniform(20, 35)), "oblique_share": 0.3}
    scene = simulate_tie_points(**(chosen | settings))
    if kind == "lens":
        scene = with_lens_error(scene, rng)
    if kind == "mismatches":
        scene = with_mismatches(scene, rng)
    off_m = rng.normal(0.0, SIGMA_LEVEL_M) if kind == "level" else 0.0
    water = WaterPlane(scene.water.a + off_m, scene.water.b, scene.water.c)
    data = unaware(scene, loss=CAUCHY if kind == "mismatches" else SQUARES)
    gnss = scene.cameras.gnss
    ties, lens = usable_ties(data.ties, data.cameras), default_lens(data.cameras.lenses)
    block = block_to_adjust(data.cameras, ties, water, scene.refractive_index)
    surface = {"level": SIGMA_LEVEL_M} if kind == "level" else {}
    found = adjust_block(replace(block, gnss=gnss), Unknowns(lens=lens, surface=surface))
    bed = tuple(
        bed_rms_m(scene, cameras, surface) / (80.0 / cameras.lenses[0].focal)
        for cameras, surface in ((data.cameras, water), (found.cameras, found.water))
    )
    return Run(found, normalised(found, scene.true_cameras), bed)


def normalised(found: Adjusted, true: Cameras) -> dict[str, FloatArray]:
    """Return errors over standard errors."""
    row = [true.labels.index(label) for label in found.cameras.labels]
    centres = (found.cameras.centres - true.centres[row]) / found.precision.centre_sigma_m
    turn = found.cameras.rotations @ true.rotations[row].transpose(0, 2, 1)
    angles = np.degrees(Rotation.from_matrix(turn).as_rotvec()) / found.precision.angle_sigma_deg
    lens, data = found.cameras.lenses[0], true.lenses[0]
    off = {
        "f": lens.focal - data.focal, "cx": lens.principal_x - data.principal_x,
        "cy": lens.principal_y - data.principal_y,
    }  # fmt: skip
    errors, shared = {name: np.array([np.nan]) for name in off}, found.precision.shared  # if fixed
    errors |= {name: off[name] / np.array([shared[name].sigma]) for name in off if name in shared}
    errors |= dict(zip(("omega", "phi", "kappa"), angles.T, strict=True))
    return errors | dict(zip("XYZ", centres.T, strict=True))


def bed_rms_m(scene: TieScene, cameras: Cameras, water: WaterPlane) -> float:
    """Return the rms error of the height of points under water, seen without noise."""
    block = block_of(scene, exact=True, cameras=cameras, water=water)
    off = (intersect_fixed(block)[0] - scene.truth)[scene.is_wet, 2]
    return float(np.sqrt(np.nanmean(off * off)))


def with_lens_error(scene: TieScene, rng: np.random.Generator) -> TieScene:
    """Return a scene whose lens has one more term, which moves the corner by 0.2 to 0.5 px.

    Half of them are terms of Brown's formula; the others no formula here has: skew, a radial
    term of high order, and a plate that is bent by waves.
    """
    lens = scene.true_cameras.lenses[0]
    half = 0.5 * np.hypot(lens.width, lens.height)
    x, y = ((scene.exact_xy - [lens.principal_x, lens.principal_y]) / half).T
    r2, nothing = x * x + y * y, np.zeros(len(x))
    turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    wave = np.cos(2.0 * np.pi * (x * np.cos(turn) + y * np.sin(turn)) + phase)
    shapes = [
        (x * r2, y * r2), (x * r2**3, y * r2**3), (r2 + 2 * x * x, 2 * x * y), (x, nothing),
        (y, nothing), (x * r2**5, y * r2**5), (wave * np.cos(phase), wave * np.sin(phase)),
        (x * (1.0 - r2) * np.sqrt(r2), y * (1.0 - r2) * np.sqrt(r2)),
    ]  # fmt: skip
    shape = np.column_stack(shapes[int(rng.integers(len(shapes)))])
    largest = np.percentile(np.hypot(*shape.T), 99.5)
    size_px = float(rng.uniform(0.2, 0.5)) * rng.choice([-1.0, 1.0]) / largest
    return moved(scene, size_px * shape, in_truth=True)


def with_mismatches(scene: TieScene, rng: np.random.Generator) -> TieScene:
    """Return a scene of whose observations 5 to 10 % are off by 2 to 30 px.

    Half of them by chance; half as texture that repeats has it: all points of a patch of 3 m are
    off alike in two or three images that follow one another.
    """
    views, o = scene.views, len(scene.views.camera)
    owner = np.repeat(np.arange(len(scene.truth)), np.diff(views.start))
    wanted, by = float(rng.uniform(0.05, 0.10)) * o, np.zeros((o, 2))
    single = rng.random(o) < 0.5 * wanted / o
    by[single] = drawn_px(rng, int(single.sum()))
    while (by != 0.0).any(axis=1).sum() < wanted:
        middle = scene.truth[rng.integers(len(scene.truth)), :2]
        near = np.hypot(*(scene.truth[:, :2] - middle).T) < 3.0
        first = int(rng.integers(len(scene.cameras)))
        images = np.arange(first, first + int(rng.integers(2, 4)))
        by[near[owner] & np.isin(views.camera, images)] = drawn_px(rng, 1)
    return moved(scene, by, in_truth=False)


def drawn_px(rng: np.random.Generator, count: int) -> FloatArray:
    """Return shifts of 2 to 30 px, small ones more often, in any direction."""
    size, way = np.exp(rng.uniform(np.log(2.0), np.log(30.0), count)), rng.uniform(0, 6.283, count)
    return np.column_stack([size * np.cos(way), size * np.sin(way)])


def moved(scene: TieScene, by_px: FloatArray, *, in_truth: bool) -> TieScene:
    """Return a scene with its image points moved, those without noise too where so it is."""
    ties = TiePoints(scene.ties.xyz, scene.ties.views, scene.ties.image_xy + by_px)
    exact = scene.exact_xy + by_px if in_truth else scene.exact_xy
    return replace(scene, ties=ties, exact_xy=exact)
