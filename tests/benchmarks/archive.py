"""What a correction costs, from few measured constants: a cloud, an archive, all coasts.

The time of the processor is a sum: so much for each point (reading, packing, rows) and so much for
each ray; bytes go by the size of a point before and after. Start-up counts once for each tile.
Prints a table; the constants are those of `copy_ratio.py` and `scaling.py` on one machine.

    python -m tests.benchmarks.archive [--core-us-per-point 0.8] [--core-ns-per-ray 10]
        [--rays 17] [--cores 2 64 1024] [--start-up-s 2]
"""

import argparse

BYTES_IN, BYTES_OUT = 3.3, 6.4  # LAZ, a point
TILE_POINTS = 20e6
SIZES = (("5 million", 5e6), ("100 million", 1e8), ("a billion", 1e9), ("a trillion", 1e12))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--core-us-per-point", type=float, default=0.8)
    parser.add_argument("--core-ns-per-ray", type=float, default=10.0)
    parser.add_argument("--rays", type=float, default=17.0)
    parser.add_argument("--start-up-s", type=float, default=2.0)
    parser.add_argument("--cores", type=int, nargs="+", default=[2, 64, 1024])
    given = parser.parse_args()
    print(f"points        core-hours  {'  '.join(f'{c:>6,} cores' for c in given.cores)}  TB moved")
    for name, points in SIZES:
        used = core_s(points, given)
        most = max(points / TILE_POINTS, 2.0)  # a core or two work on one tile
        times = "  ".join(f"{words(used / min(count, most)):>12}" for count in given.cores)
        moved = points * (2.0 * BYTES_IN + BYTES_OUT) / 1e12  # learning reads it once more
        print(f"{name:<12}  {used / 3600.0:10,.1f}  {times}  {moved:8,.2f}")


def core_s(points, given):
    """Return the time of the processor."""
    per_point = 1e-6 * given.core_us_per_point + 1e-9 * given.core_ns_per_ray * given.rays
    return points * per_point + max(points / TILE_POINTS, 1.0) * given.start_up_s


def words(seconds):
    """Return a time in the unit that suits it."""
    for unit, size in (("days", 86400.0), ("hours", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:,.1f} {unit}"
    return f"{seconds:,.1f} s"


if __name__ == "__main__":
    main()
