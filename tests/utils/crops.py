"""The middle of a rendered cloud, as dense as the whole, with its rows of the list of images."""

import laspy
import numpy as np


def middle_of(folder, target, half_m=25.0):
    """Write the points within so many metres of the middle as ``cloud.las``; return its folder.

    And the images of each as ``dense.vis``, in COLMAP's layout: counts, each before its images.
    """
    las = laspy.read(folder / "cloud.las")
    away_m = np.abs(las.xyz[:, :2] - (las.header.mins + las.header.maxs)[:2] / 2.0).max(axis=1)
    inside = np.flatnonzero(away_m < half_m)
    las.points = las.points[inside]
    las.write(target / "cloud.las")
    words = np.fromfile(folder / "dense.vis", "<u4")[2:]
    starts, at = np.empty(len(away_m), int), 0
    for row in range(len(away_m)):
        starts[row] = at
        at += 1 + words[at]
    rows = [words[at : at + 1 + words[at]] for at in starts[inside]]
    head = np.array([len(inside)], "<u8").tobytes()
    (target / "dense.vis").write_bytes(head + np.concatenate(rows).tobytes())
    return target
