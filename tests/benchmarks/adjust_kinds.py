"""Blocks of other kinds, mended and corrected by default: how far off, and was it said.

    python -m tests.benchmarks.adjust_kinds [--kinds "no land"] [--seeds 0 1] [--ties cloud]
                                            [--words]

Poses as an unaware adjustment left them, GNSS of 2.5 cm, 900 tie points; `pcfix adjust`, then
`pcfix correct`. A row per block: RMSE of the bed's heights in GSD with the true poses, before and
after the adjustment, its bias, the RMS of SigmaZ, the share of the bed within 1.96 SigmaZ, and what
was said, by the letters below the table. A bed that is off by more than 1.5 GSD counts as in SigmaZ
where four fifths of it lie within these bounds.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np

import pcfix
from pcfix.errors import PcfixError, PcfixWarning
from pcfix.report.adjustment import adjustment_dict, all_notes, before_of
from tests.utils.block_kinds import GSD_M, KINDS, write_kind

GOOD_GSD, COVERED = 1.5, 0.8
DOUBTS = {
    "B": "The heights of the bed are known to",
    "L": "nothing but GNSS and control points",
    "O": "The GNSS positions lie",
    "W": "hold the block weakly",
    "C": "hardly told apart",
    "P": "stand poorly for the old tie points",
    "E": "exit:",
}
"""What is said, by a letter and some words of it; other notes are no doubts of the result."""


class Row(NamedTuple):
    """What a block came to; all lengths in GSD."""

    true: float
    before: float
    after: float
    bias: float
    sigma: float
    within: float
    said: list[str]

    @property
    def codes(self) -> str:
        """The letters of `DOUBTS`."""
        return "".join(c for c, words in DOUBTS.items() if any(words in one for one in self.said))

    @property
    def verdict(self) -> str:
        """Whether the bed is good, and if not, what tells it."""
        if self.after <= GOOD_GSD:
            return "good"
        if self.within >= COVERED:
            return "off, in SigmaZ"
        return "off, in words alone" if self.codes else "off, SILENT"


def bed_errors(path: Path, truth):
    """Return errors of the bed's heights and their standard errors."""
    las = laspy.read(path)
    sigma = np.asarray(las.SigmaZ)
    wet = (truth[:, 2] < -0.1) & (np.asarray(las.RayCount) > 0)
    return (np.asarray(las.z) - truth[:, 2])[wet], sigma[wet]


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) / GSD_M


def run(folder: Path, kind: str, seed: int, ties: str) -> Row:
    """Make a block, mend it, correct its cloud."""
    truth = write_kind(folder, kind, seed)
    cloud, model, out = folder / "cloud.las", folder / "model", folder / "out"

    def corrected(cameras, name, **more):
        target = folder / f"{name}.las"
        pcfix.correct_file(cloud, target, cameras=cameras, water=0.0, **more)
        return bed_errors(target, truth)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        before, _ = corrected(model, "before")
        best, _ = corrected(folder / "true", "best", adjusted_from=model)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", PcfixWarning)
        try:
            found = pcfix.adjust_cameras(
                model, out, water=0.0, cloud=cloud, gnss=folder / "gnss.csv", ties=ties
            )
            off, sigma = corrected(out / "colmap", "after", adjusted_from=model)
        except PcfixError as error:
            return Row(rms(best), rms(before), np.nan, np.nan, np.nan, np.nan, [f"exit: {error}"])
    notes = all_notes(adjustment_dict(found, before_of(found)))
    said = notes + [str(one.message) for one in heard if issubclass(one.category, PcfixWarning)]
    within = float((np.abs(off) <= 1.96 * sigma).mean())
    bias = float(np.mean(off)) / GSD_M
    return Row(rms(best), rms(before), rms(off), bias, rms(sigma), within, said)


def main() -> None:
    """Print a row per block, and a summary of each kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(9)))
    parser.add_argument("--ties", choices=("auto", "cloud"), default="auto")
    parser.add_argument("--words", action="store_true", help="print all notes and warnings")
    given = parser.parse_args()
    print("kind          seed   true  before   after    bias  SigmaZ  within  said  verdict")
    rows: dict[str, list[Row]] = {}
    for kind in given.kinds:
        for seed in given.seeds:
            with tempfile.TemporaryDirectory() as scratch:
                r = run(Path(scratch), kind, seed, given.ties)
            rows.setdefault(kind, []).append(r)
            print(
                f"{kind:13} {seed:4} {r.true:6.2f} {r.before:7.2f} {r.after:7.2f} {r.bias:+7.2f}"
                f" {r.sigma:7.2f} {r.within:7.0%}  {r.codes:4}  {r.verdict}",
                flush=True,
            )
            if given.words:
                print("".join(f"      {one}\n" for one in r.said), end="", flush=True)
    print("\nkind           true  before   after  SigmaZ  blocks: how they ended")
    for kind, some in rows.items():
        true, before, after, sigma = (
            np.median([getattr(r, name) for r in some])
            for name in ("true", "before", "after", "sigma")
        )
        ends = Counter(r.verdict for r in some)
        print(
            f"{kind:13} {true:5.2f} {before:7.2f} {after:7.2f} {sigma:7.2f}  {len(some)}: "
            + ", ".join(f"{count} {end}" for end, count in sorted(ends.items()))
        )
    print("".join(f"\n{code}: {words}" for code, words in DOUBTS.items()))


if __name__ == "__main__":
    main()
