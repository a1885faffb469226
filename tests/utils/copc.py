"""COPC files of three levels, written by copclib."""

from pathlib import Path

import laspy
import numpy as np


def write_copc(path: Path, las: laspy.LasData) -> Path:
    """Write the points of a LAS 1.4 cloud without extra dimensions as an octree.

    Every sixteenth point is in the root, every fourth of the others in its octant, the rest below.
    """
    import copclib

    header = las.header
    scale, offset = (copclib.Vector3(*map(float, v)) for v in (header.scales, header.offsets))
    config = copclib.CopcConfigWriter(header.point_format.id, scale, offset)
    low, side = las.xyz.min(axis=0), float(np.ptp(las.xyz, axis=0).max()) * 1.001
    config.las_header.min = copclib.Vector3(*low)
    config.las_header.max = copclib.Vector3(*(low + side))
    info = config.copc_info
    info.center_x, info.center_y, info.center_z = map(float, low + side / 2)
    info.halfsize, info.spacing = side / 2, side / 8
    writer = copclib.FileWriter(str(path), config)
    rows = np.arange(len(las))
    level = np.where(rows % 16 == 0, 0, np.where(rows % 4 == 0, 1, 2))
    place = np.floor((las.xyz - low) / side * 2.0 ** level[:, None]).astype(int)
    keys = np.column_stack([level, place])
    for key in np.unique(keys, axis=0):
        some = las.points.array[(keys == key).all(axis=1)]
        data = copclib.VectorChar(np.frombuffer(some.tobytes(), np.int8))
        writer.AddNode(copclib.VoxelKey(*key.tolist()), data)
    writer.Close()
    return path
