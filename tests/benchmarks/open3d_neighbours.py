"""Whether open3d finds neighbours and outliers quicker than pcfix does.

On a wavy bed of random points, in memory, by turns in one process; the least of all turns counts,
as other work on the machine only adds. Building the tree is part of every time. Says whether
results are the same, and what loading the libraries adds to the start of a process.

    python tests/benchmarks/open3d_neighbours.py [--points 1000000] [--runs 5]
"""

import argparse
import subprocess
import sys
import time

import numpy as np

from pcfix.clean.neighbours import make_tiles, nearest_of
from pcfix.clean.points import clean_points
from pcfix.compare.nearest import cloud_to_cloud
from pcfix.libraries import load_open3d
from pcfix.options.steps import CleanRules

PLANE_POINTS, NEIGHBOURS, DEVIATIONS = 8, 20, 4.0  # the defaults of compare and clean
RADIUS_M = 1.0  # of the hybrid search, which leaves points off the bed without neighbours
LOADING = {
    "scipy": "import scipy.spatial",
    "open3d": "from pcfix.libraries import load_open3d; load_open3d()",
}


def bed(count, seed):
    """Return points (count, 3), 10 a square metre, a hundredth of them off the bed."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0.0, np.sqrt(count / 10.0), (count, 2))
    z = -5.0 + 2.0 * np.sin(xy[:, 0] / 30.0) + np.cos(xy[:, 1] / 17.0)
    z += rng.normal(0.0, 0.02, count)
    z[::100] += rng.uniform(-3.0, 3.0, len(z[::100]))
    return np.column_stack([xy, z])


def in_strips(xyz):
    return make_tiles(xyz).row


def jobs(cloud, reference):
    """Return for each task what does it, the way of pcfix first."""
    o3d = load_open3d()
    rules = CleanRules(
        neighbours=NEIGHBOURS, deviations=DEVIATIONS, weak=False, below=None, floating=None
    )

    def ours(count):
        found = np.empty((len(cloud), count))
        for rows, _, distance, _ in nearest_of(cloud, reference, count, 3):
            found[rows] = distance
        return found[:, -1]

    def tensors(search, order_of):
        order, found = order_of(cloud), np.empty(len(cloud))
        targets = np.ascontiguousarray(reference[order_of(reference)])
        tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(targets))
        places = o3d.core.Tensor(np.ascontiguousarray(cloud[order]))
        found[order] = np.sqrt(search(tree, places)[1].numpy()[:, -1])
        return found

    def as_they_come(xyz):
        return np.arange(len(xyz))

    def knn(count, order_of=as_they_come):
        return tensors(lambda tree, at: (tree.knn_index(), tree.knn_search(at, count))[1], order_of)

    def hybrid(count):
        def search(tree, places):
            tree.hybrid_index(RADIUS_M)
            return tree.hybrid_search(places, RADIUS_M, count)

        return tensors(search, as_they_come)

    def points(xyz):
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))

    def outliers(order):
        kept = np.zeros(len(cloud), bool)
        found = points(cloud[order]).remove_statistical_outlier(NEIGHBOURS, DEVIATIONS)[1]
        kept[order[found]] = True
        return kept

    return {
        "nearest": {
            "pcfix": lambda: cloud_to_cloud(cloud, reference),
            "scipy": lambda: ours(1),
            "open3d KDTreeFlann": lambda: np.asarray(
                points(cloud).compute_point_cloud_distance(points(reference))
            ),
            "open3d nns knn": lambda: knn(1),
            "open3d nns hybrid": lambda: hybrid(1),
        },
        f"{PLANE_POINTS} nearest": {
            "pcfix": lambda: ours(PLANE_POINTS),
            "open3d nns knn": lambda: knn(PLANE_POINTS),
            "open3d nns, in strips": lambda: knn(PLANE_POINTS, in_strips),
            "open3d nns hybrid": lambda: hybrid(PLANE_POINTS),
        },
        "statistical outliers": {
            "pcfix": lambda: clean_points(cloud, settings=rules) == 0,
            "open3d": lambda: outliers(as_they_come(cloud)),
            "open3d, in strips": lambda: outliers(in_strips(cloud)),
        },
    }


def same(one, other):
    if one.dtype == bool:
        return f"{np.count_nonzero(one != other)} of {len(one):,} points differ"
    found = one > 0.0  # a hybrid search has zero where it found none
    return f"{found.mean():.1%} found, largest difference {np.abs(one - other)[found].max():.0e} m"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--task", default="", help="the one alone that begins so")
    arguments = parser.parse_args()
    small = jobs(bed(5_000, 0), bed(5_000, 1))  # compiles the kernels
    for ways in small.values():
        for way in ways.values():
            way()
    for task, ways in jobs(bed(arguments.points, 0), bed(arguments.points, 1)).items():
        if not task.startswith(arguments.task):
            continue
        seconds, results = {name: [] for name in ways}, {}
        for _ in range(arguments.runs):
            for name, way in ways.items():
                started = time.perf_counter()
                results[name] = way()
                seconds[name].append(time.perf_counter() - started)
        for name, taken in seconds.items():
            ratio = min(taken) / min(seconds["pcfix"])
            said = same(results[name], results["pcfix"])
            print(
                f"{task:<22}{name:<20}{min(taken):7.2f} s  ratio {ratio:5.2f}  {said}", flush=True
            )
    for name, program in LOADING.items():
        taken = []
        for _ in range(arguments.runs):
            started = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True)
            taken.append(time.perf_counter() - started)
        print(f"a process that loads {name}: {min(taken):.2f} s")


if __name__ == "__main__":
    main()
