"""The rendered blocks of the shared data, with known truth."""

from dataclasses import replace

import laspy
import numpy as np

import pcfix


def block_of(folder):
    """Return the cameras of a block in the frame of its COLMAP model, and in that of its cloud."""
    local = pcfix.read_cameras(folder / "colmap")
    return local, replace(local, centres=local.centres + np.loadtxt(folder / "offset.txt"))


def cloud_of(path):
    """Return the points of a cloud, shape (n, 3)."""
    return np.ascontiguousarray(laspy.read(path).xyz)


def truth_m(folder, xyz):
    """Return the true height at each point, NaN beyond the raster."""
    import rasterio
    from scipy.ndimage import map_coordinates

    with rasterio.open(folder / "truth_dsm.tif") as raster:
        left, up = ~raster.transform @ (xyz[:, 0], xyz[:, 1])
        at = np.array([up - 0.5, left - 0.5])
        return map_coordinates(raster.read(1).astype(float), at, order=1, cval=np.nan)
