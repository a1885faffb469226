"""A cloud cut into tiles, and the same points in one file."""

import laspy
import numpy as np

from pcfix.io.files import read_tally
from tests.utils.shared import SCENE


def cut(folder, count, *, cloud=SCENE / "cloud.laz", suffix=".laz", **changes):
    """Write so many tiles from west to east into a folder, and their points as merged.laz beside.

    `changes` are attributes of the headers; returns the folder and the merged cloud.
    """
    folder.mkdir(parents=True)
    las = laspy.read(cloud)
    x = np.asarray(las.x)
    tile = np.searchsorted(np.quantile(x, np.linspace(0, 1, count + 1)[1:-1]), x)
    rows = [np.flatnonzero(tile == i) for i in range(count)]
    for i, some in enumerate(rows):
        write(folder / f"tile{i:0{len(str(count - 1))}}{suffix}", las, some, **changes)
    return folder, write(folder.parent / "merged.laz", las, np.concatenate(rows), **changes)


def write(path, las, rows, **changes):
    part = laspy.LasData(las.header)
    part.points = las.points[rows]
    for name, value in changes.items():
        setattr(part.header, name, value)
    part.write(path)
    return path


def tiles_in(folder):
    return sorted(folder.glob("*.la[sz]"))


def figures(summary):
    """Return a summary without the values that differ between calls."""
    own = ("input", "output", "seconds", "cloud", "reference", "also")
    return {name: value for name, value in summary.as_dict().items() if name not in own}


def records(*paths):
    """Return the points of files as one array, field by field."""
    return np.concatenate([laspy.read(path).points.array for path in paths])


def finished(folder):
    """Return the outputs in a folder that are on record as finished, and when they were written."""
    found = [one for one in (folder / ".pcfix").glob("*.la?.tally") if read_tally(one)[0]]
    done = [folder / one.stem for one in found if (folder / one.stem).exists()]
    return {path: path.stat().st_mtime_ns for path in done}
