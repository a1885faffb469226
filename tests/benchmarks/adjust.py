"""Adjustments of simulated blocks: how fast, whether their standard errors hold, how far off.

    python -m tests.benchmarks.adjust speed [--points 25000 50000 100000]
    python -m tests.benchmarks.adjust errors [--blocks 40] [--seed 1000]
    python -m tests.benchmarks.adjust kinds [--kinds "no land"] [--seeds 0 1] [--ties cloud]

speed : Blocks of nadir images over land and bed, from poses that are off; kernels are compiled
    before. The peak memory is that of the process so far.

errors : Blocks of a dozen or two images from poses that an adjustment without water left, adjusted
    as ``pcfix adjust`` does by default: with a lens that has a term of 0.2 to 0.5 px at the corner
    which the model lacks, with 5 to 10 % of mismatches, and with a water level that is off by its
    standard error of 3 cm. Prints the root mean square of errors over standard errors, and of the
    bed before and after.

kinds : Blocks of other shapes. Poses as an unaware adjustment left them, GNSS of 2.5 cm, 900 tie
    points; ``pcfix adjust``, then ``pcfix correct``. A row per block: RMSE of the bed's heights in
    GSD with the true poses, before and after the adjustment, its bias, the RMS of SigmaZ, the share
    of the bed within 1.96 SigmaZ, and the codes of the warnings. A bed that is off by more than 1.5
    GSD counts as in SigmaZ if four fifths of it are within these bounds.
"""

import argparse
import resource
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from pathlib import Path

import laspy
import numpy as np

import pcfix
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.problem import solved_cameras
from pcfix.errors import PcfixError, PcfixWarning
from tests.utils import block_kinds, model_errors
from tests.utils.tie_blocks import adjusted, block_of
from tests.utils.tie_points import simulate_tie_points

COLUMNS = ("f", "cx", "cy", "omega", "phi", "kappa", "X", "Y", "Z")
GOOD_GSD, COVERED = 1.5, 0.8


def speed(given):
    print("points   images  observations   wall s    cpu s  us/obs    MB  centres m")
    for points in (1000, *given.points):
        scene = simulate_tie_points(
            points=points, area_m=(240.0, 160.0), position_noise_m=0.05, attitude_noise_deg=0.06
        )
        block = block_of(scene)
        started, cpu = time.perf_counter(), time.process_time()
        problem, found = adjusted(block, Unknowns(lens=("f",)))
        off = solved_cameras(problem, found).centres - scene.true_cameras.centres
        wall, cpu = time.perf_counter() - started, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        if points > 1000:  # the first block compiles the kernels
            print(
                f"{points:<8} {len(block.cameras):>6} {len(block.camera):>13} {wall:>8.1f}"
                f" {cpu:>8.1f} {1e6 * cpu / len(block.camera):>7.1f} {peak:>5.0f}"
                f" {np.sqrt((off**2).sum(axis=1).mean()):>10.4f}",
                flush=True,
            )


def errors(given):
    header = " ".join(f"{name:>6}" for name in COLUMNS)
    print(f"{'':<12} {header}  bed before -> after, GSD", flush=True)
    squares, beds = defaultdict(list), defaultdict(list)
    for kind in (*model_errors.KINDS, "all"):
        for seed in range(given.seed, given.seed + given.blocks) if kind != "all" else ():
            try:
                data = model_errors.run(kind, seed)
            except PcfixError as error:
                print(kind, seed, error)
                continue
            rows = [float((data.normalised[name] ** 2).mean()) for name in COLUMNS]
            for name in (kind, "all"):
                squares[name].append(rows)
                beds[name].append(data.bed_gsd)
        known = np.isfinite(squares[kind]).sum(axis=0)  # a principal point that is held has none
        means = np.nansum(squares[kind], axis=0) / np.where(known, known, np.nan)
        figures = " ".join(f"{value:6.2f}" for value in np.sqrt(means))
        before, after = np.sqrt(np.mean(np.square(beds[kind]), axis=0))
        print(f"{kind:<12} {figures}  {before:6.2f} -> {after:.2f}", flush=True)


def kinds(given):
    print("kind          seed   true  before   after    bias  SigmaZ  within  verdict, warnings")
    rows = defaultdict(list)
    for kind in given.kinds:
        for seed in given.seeds:
            with tempfile.TemporaryDirectory() as scratch:
                *figures, codes = one_kind(Path(scratch), kind, seed, given.ties)
            true, before, after, bias, sigma, within = figures
            verdict = "off, SILENT" if not codes else "off, in words alone"
            if within >= COVERED:
                verdict = "off, in SigmaZ"
            if after <= GOOD_GSD:
                verdict = "good"
            rows[kind].append((true, before, after, sigma, verdict))
            print(
                f"{kind:13} {seed:4} {true:6.2f} {before:7.2f} {after:7.2f} {bias:+7.2f}"
                f" {sigma:7.2f} {within:7.0%}  {verdict}: {' '.join(codes)}",
                flush=True,
            )
    print("\nkind           true  before   after  SigmaZ  blocks: how they ended")
    for kind, some in rows.items():
        *figures, verdicts = zip(*some, strict=True)
        ends = ", ".join(f"{count} {end}" for end, count in sorted(Counter(verdicts).items()))
        medians = " ".join(f"{np.median(one):7.2f}" for one in figures)
        print(f"{kind:12} {medians}  {len(some)}: {ends}")


def one_kind(folder, kind, seed, ties):
    """Make a block, adjust it, correct its cloud; return its figures and the warnings' codes."""
    truth = block_kinds.write_kind(folder, kind, seed)
    cloud, model, out = folder / "cloud.las", folder / "model", folder / "out"

    def corrected(cameras, **more):
        pcfix.correct_file(
            cloud, folder / "corrected.las", cameras=cameras, water=0.0, overwrite=True, **more
        )
        las = laspy.read(folder / "corrected.las")
        wet = (truth[:, 2] < -0.1) & (np.asarray(las.RayCount) > 0)
        return (np.asarray(las.z) - truth[:, 2])[wet], np.asarray(las.SigmaZ)[wet]

    def rms(values):
        return float(np.sqrt(np.mean(np.square(values)))) / block_kinds.GSD_M

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        before, _ = corrected(model)
        best, _ = corrected(folder / "true", adjusted_from=model)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PcfixWarning)
        try:
            found = pcfix.adjust_cameras(
                model, out, water=0.0, cloud=cloud, gnss=folder / "gnss.csv", ties=ties
            )
            off, sigma = corrected(out / "colmap", adjusted_from=model)
        except PcfixError as error:
            return rms(best), rms(before), *[np.nan] * 4, [error.code]
    shown = [one.message for one in caught if isinstance(one.message, PcfixWarning)]
    codes = sorted({one.code for one in [*found.notes, *shown] if isinstance(one, PcfixWarning)})
    bias, within = np.mean(off) / block_kinds.GSD_M, (np.abs(off) <= 1.96 * sigma).mean()
    return rms(best), rms(before), rms(off), float(bias), rms(sigma), float(within), codes


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    actions = parser.add_subparsers(required=True)
    action = actions.add_parser("speed")
    action.set_defaults(run=speed)
    action.add_argument("--points", type=int, nargs="+", default=[25_000, 50_000, 100_000])
    action = actions.add_parser("errors")
    action.set_defaults(run=errors)
    action.add_argument("--blocks", type=int, default=40, help="of each kind")
    action.add_argument("--seed", type=int, default=1000)
    action = actions.add_parser("kinds")
    action.set_defaults(run=kinds)
    every = list(block_kinds.KINDS)
    action.add_argument("--kinds", nargs="+", choices=every, default=every)
    action.add_argument("--seeds", type=int, nargs="+", default=list(range(9)))
    action.add_argument("--ties", choices=("auto", "cloud"), default="auto")
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
