"""Whether the standard errors of an adjustment hold where more than noise is wrong.

Adjusts blocks of a dozen or two images from poses that an adjustment without water left, as ``pcfix
adjust`` does by default: with a lens that has a term of 0.2 to 0.5 px at the corner which the model
lacks, with 5 to 10 % of mismatches, and with a water level that is off by its standard error of
3 cm. Prints the root mean square of errors over standard errors, and of the bed before and after.

    python -m tests.benchmarks.adjust_model_error [--blocks 40] [--seed 1000]
                                                  [--kinds lens mismatches level] [--each]
"""

import argparse
from collections import defaultdict

import numpy as np

from pcfix.errors import PcfixError
from tests.utils.model_errors import KINDS, run

COLUMNS = ("f", "cx", "cy", "omega", "phi", "kappa", "X", "Y", "Z")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blocks", type=int, default=40, help="of each kind")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--kinds", nargs="+", choices=("none", *KINDS), default=KINDS)
    parser.add_argument("--each", action="store_true", help="a line for every block too")
    arguments = parser.parse_args()
    header = " ".join(f"{name:>6}" for name in COLUMNS)
    print(f"{'':<12} {header}  bed before -> after, GSD", flush=True)
    squares, beds = defaultdict(list), defaultdict(list)
    for kind in arguments.kinds:
        for seed in range(arguments.seed, arguments.seed + arguments.blocks):
            try:
                made = run(kind, seed)
            except PcfixError as error:
                print(kind, seed, error)
                continue
            rows = [float((made.normalised[name] ** 2).mean()) for name in COLUMNS]
            for words in (kind, "all"):
                squares[words].append(rows)
                beds[words].append(made.bed_gsd)
            if arguments.each:
                show(f"{kind} {seed}", [rows], [made.bed_gsd])
                print("  ", " | ".join(made.found.notes))
        show(kind, squares[kind], beds[kind])
    show("all", squares["all"], beds["all"])


def show(words, squares, beds):
    known = np.isfinite(squares).sum(axis=0)  # cx and cy are held where the block does not tell
    means = np.nansum(squares, axis=0) / np.where(known, known, np.nan)
    figures = " ".join(f"{value:6.2f}" for value in np.sqrt(means))
    before, after = np.sqrt(np.mean(np.square(beds), axis=0))
    print(f"{words:<12} {figures}  {before:6.2f} -> {after:.2f}", flush=True)


if __name__ == "__main__":
    main()
