"""The dense point cloud of OpenMVS (and so of ODM), a PLY file with two lists at each vertex.

``view_indices`` names the depth maps that were fused at the point, by the number of their image
in the scene, from 0; ``view_weights`` says what each counted for. The importers number the images
as they come: InterfaceCOLMAP in the order of ``images.txt``, OpenSfM's exporter (ODM) in the order
of the shots of the undistorted reconstruction. Defined by OpenMVS's source, libs/MVS/PointCloud.cpp
and apps/InterfaceCOLMAP. A depth map was itself matched against other images, which are not named.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.views.lists import RawList, images_of
from pcfix.io.views.ply import Vertices, read_header

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from pcfix.io.views.ply import Header
    from pcfix.model import FloatArray, IntArray

_IMAGES, _WEIGHTS = "view_indices", "view_weights"


def has_lists(path: Path) -> bool:
    """Whether the vertices of a PLY file have view lists."""
    return any(p.name == _IMAGES and p.length for p in read_header(path).properties)


def read(path: Path) -> RawList:
    """Read positions, view lists and, where there are any, weights.

    Raises
    ------
    InputError
        If there are no view lists, or the file is damaged.
    """
    header = read_header(path)
    if not has_lists(path):
        names = ", ".join(p.name for p in header.properties)
        raise InputError(
            f"{path}: its points have no {_IMAGES} (they have: {names}); other software drops the"
            " lists on saving, so give the dense PLY as OpenMVS wrote it, or COLMAP's"
            " fused.ply.vis."
        )
    vertices = _vertices(header)
    start, number = vertices.ragged(_IMAGES)
    xyz, resolution_m = _xyz(vertices)
    image = images_of(path, number)
    return RawList(
        path, "OpenMVS point cloud", start, image, _weights(vertices, start), xyz, resolution_m
    )


def positions(header: Header) -> tuple[FloatArray, float]:
    """Return the vertices of a PLY file and how coarse the type of their numbers is, metres."""
    return _xyz(_vertices(header))


def _vertices(header: Header) -> Vertices:
    scalars = {p.name for p in header.properties if not p.length}
    if not {"x", "y", "z"} <= scalars or header.vertices == 0:
        raise InputError(
            f"{header.path}: has no points with x, y and z; give the dense point cloud as the"
            " software wrote it."
        )
    return Vertices(header)


def _xyz(vertices: Vertices) -> tuple[FloatArray, float]:
    xyz = vertices.xyz()
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{vertices.header.path}: vertex {int(np.argmin(finite)):,} has no finite position;"
            " remove it or export the points again."
        )
    single = any(p.name == "x" and p.item == "f4" for p in vertices.header.properties)
    largest = float(np.abs(xyz).max())
    return xyz, float(np.spacing(np.float32(largest))) if single else 0.0


def _weights(vertices: Vertices, start: IntArray) -> npt.NDArray[np.float32] | None:
    header = vertices.header
    if not any(p.name == _WEIGHTS and p.length for p in header.properties):
        return None
    weight_start, weight = vertices.ragged(_WEIGHTS)
    if not np.array_equal(weight_start, start):
        row = int(np.argmax(np.diff(weight_start) != np.diff(start)))
        raise InputError(
            f"{header.path}: vertex {row:,} has not as many {_WEIGHTS} as {_IMAGES}; export it"
            " again."
        )
    if weight.size and not (weight.min() >= 0.0 and weight.max() < np.inf):
        raise InputError(f"{header.path}: a weight is negative or not finite; export it again.")
    return weight.astype(np.float32)
