"""A block that has absorbed the refraction, adjusted and corrected, against the truth.

    python -m tests.benchmarks.absorbed [FOLDER --truth TIF --cameras MODEL] [--every N]

Default: ``rendered_a_free`` of PCFIX_SHARED. The folder has sparse/, cloud.las, dense.vis,
gnss.csv, gcps.csv and offset.txt; water level 0.37 m, n 1.34. Bias / RMSE of Z in GSD (5 cm), bed
below and land above the water by 10 cm in the truth; errors of the projection centres in metres
against the true model, in the frame of the map.
"""

import argparse
import os
import tempfile
import time
import warnings
from pathlib import Path

import laspy
import numpy as np

import pcfix
from tests.benchmarks.accuracy import true_surface

LEVEL, GSD, MARGIN = 0.37, 0.05, 0.1
CASES = {
    "tie points, GNSS": {"ties": "auto"},
    "tie points, GNSS, GCPs": {"ties": "auto", "gcps": True},
    "cloud only, GNSS": {"ties": "cloud"},
    "cloud only, GNSS, GCPs": {"ties": "cloud", "gcps": True},
}
CORRECTIONS = {
    "all in frame": {},
    "view list, snell": {"views": True, "views_are": "tracks"},
    "view list, consistent": {"views": True, "method": "consistent"},
    "no list, consistent": {"method": "consistent"},
    "all in frame, consistent": {"method": "consistent", "camera_set": "all"},
}


def errors(path: Path, truth, every: int) -> str:
    """Return bias and RMSE of Z on bed and land."""
    cloud = laspy.read(path)
    xyz = np.column_stack([cloud.x, cloud.y, cloud.z])[::every]
    true = truth(xyz[:, :2])
    off = (xyz[:, 2] - true) / GSD
    parts = []
    for name, mine in (("bed", true < LEVEL - MARGIN), ("land", true > LEVEL + MARGIN)):
        z = off[mine & np.isfinite(off)]
        parts.append(f"{name} {z.mean():+6.2f} / {np.sqrt((z**2).mean()):5.2f}")
    return "   ".join(parts)


def main() -> None:
    """Adjust and correct in each way, and print a line for each."""
    shared = Path(os.environ.get("PCFIX_SHARED", "../shared")) / "data"
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("folder", nargs="?", type=Path, default=shared / "rendered_a_free")
    words.add_argument("--truth", type=Path, default=shared / "rendered_a" / "truth_dsm.tif")
    words.add_argument("--cameras", type=Path, default=shared / "rendered_a" / "colmap")
    words.add_argument("--every", type=int, default=1, help="compare every so many-th point")
    given = words.parse_args()
    warnings.simplefilter("ignore", pcfix.PcfixWarning)
    folder, truth = given.folder, true_surface(given.truth)
    offset = tuple(np.loadtxt(folder / "offset.txt").tolist())
    true = pcfix.read_cameras(given.cameras)
    where = dict(zip(true.labels, true.centres + offset, strict=True))
    print(f"apparent                      {errors(folder / 'cloud.las', truth, given.every)}")
    with tempfile.TemporaryDirectory() as scratch:
        for name, case in CASES.items():
            adjust_and_correct(name, dict(case), folder, Path(scratch), offset, where, truth, given)


def adjust_and_correct(name, case, folder, scratch, offset, where, truth, given) -> None:
    """Print the errors of one way."""
    out = scratch / name.replace(" ", "_").replace(",", "")
    gcps = folder / "gcps.csv" if case.pop("gcps", False) else None
    started = time.perf_counter()
    found = pcfix.adjust_cameras(
        folder / "sparse", out, water=LEVEL, cloud=folder / "cloud.las", gcps=gcps,
        gnss=folder / "gnss.csv", cameras_offset=offset, views=folder / "dense.vis", **case,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    off = found.cameras.centres - np.array([where[label] for label in found.cameras.labels])
    lens = found.cameras.lenses[0]
    print(
        f"{name}: focal length {lens.focal:.2f} px, principal point {lens.principal_x:.2f}"
        f" {lens.principal_y:.2f}, centres {np.sqrt((off**2).sum(axis=1).mean()):.4f} m rms,"
        f" {seconds:.0f} s"
    )
    for label, how in CORRECTIONS.items():
        options = dict(how)
        if options.pop("views", False):
            options["views"] = folder / "dense.vis"
        target = out / "corrected.las"
        pcfix.correct_file(
            folder / "cloud.las", target, cameras=out / "colmap", water=LEVEL,
            adjusted_from=folder / "sparse", cameras_offset=offset, overwrite=True, **options,
        )  # fmt: skip
        print(f"   {label:26s} {errors(target, truth, given.every)}", flush=True)


if __name__ == "__main__":
    main()
