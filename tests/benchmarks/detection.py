"""How often the reconstruction type of simulated clouds is detected, and how sure of it pcfix is.

    python -m tests.benchmarks.detection [--seeds 1 2] [--points 80000]

Clouds of every type over four blocks, as dense as those of matchers. Printed are the detected type
of each cloud with its confidence and the error of the bed, the table of detected against true
types, and how many of the cases of a confidence are right.
"""

import argparse
import sys
from collections import Counter

import numpy as np

import pcfix
from pcfix.model import Outcome
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Survey
from pcfix.refract.learning import learn_of_sample
from pcfix.refract.reconstructions import IN_FRAME
from pcfix.water.surface import surface_above
from tests.utils.matchers import matched_scene

TYPES = dict(
    zip(("tracks", "depth-maps", "pairs", "single-map", "nearest-map"), IN_FRAME, strict=True)
)
COARSE = {"sensor_px": (1824, 1216), "area_m": (80.0, 60.0), "lidar_per_m2": 0.0}
# Images of large pixels, for which few points are nearly as dense as those of matchers.
BLOCKS = {
    "nadir": COARSE,
    "oblique": {**COARSE, "obliques_deg": 25.0},
    "river": {**COARSE, "bed": "river"},
    "wide": {**COARSE, "focal_mm": 6.0, "forward_overlap": 0.9},
}
LEAST_DEPTH_M = 0.2
CONFIDENCES = (0.5, 0.8, 0.95, 0.99)


def detected(kind: str, block: str, seed: int, points: int) -> tuple[str, float, float]:
    """Return the detected type of a cloud, its confidence, and the RMSE of the bed in GSD."""
    scene = matched_scene(points, cloud=kind, seed=seed, **BLOCKS[block])
    rows = np.flatnonzero((np.diff(scene.views.start) > 0) & np.isfinite(scene.xyz).all(axis=1))
    xyz, water = scene.xyz[rows], scene.water
    settings = ScienceOptions(method="auto", index=scene.refractive_index)
    batch = Batch(xyz, surface_above(water, xyz), Survey(water, scene.cameras, settings))
    _, verdicts = learn_of_sample(batch)
    found = pcfix.correct_points(
        xyz, scene.cameras, water, method="auto", index=scene.refractive_index
    )
    deep = (found.outcome == Outcome.CORRECTED) & (scene.depth_m(found.xyz) > LEAST_DEPTH_M)
    error = (found.xyz - scene.true_xyz[rows])[deep, 2] / scene.gsd_m
    rmse = float(np.sqrt(np.mean(error**2)))
    if not verdicts:  # too few points, or too sparse
        return "none", 0.5, rmse
    return verdicts[0].chosen.words, verdicts[0].confidence, rmse


def main(arguments: list[str]) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--points", type=int, default=80_000)
    given = parser.parse_args(arguments)
    table, cases = Counter[tuple[str, str]](), []
    for block in BLOCKS:
        for kind, true in TYPES.items():
            for seed in given.seeds:
                words, confidence, rmse = detected(kind, block, seed, given.points)
                table[kind, words] += 1
                cases.append((confidence, words == true.words))
                print(
                    f"{block:8} {kind:12} {words:40} {confidence:6.1%} {rmse:6.2f} GSD", flush=True
                )
    names = [one.words for one in TYPES.values()]
    print("\ntrue type    " + "".join(f"{name[-14:]:>16}" for name in names))
    for kind in TYPES:
        print(f"{kind:13}" + "".join(f"{table[kind, name]:16}" for name in names))
    print("\nconfidence     cases  right")
    for low, high in zip(CONFIDENCES, (*CONFIDENCES[1:], 1.01), strict=True):
        right = [ok for confidence, ok in cases if low <= confidence < high]
        print(f"from {low:4.0%} {len(right):10} {sum(right):6}")


if __name__ == "__main__":
    main(sys.argv[1:])
