"""View lists: which cameras made each point of a dense cloud.

Read one with `read_views`, or make one of tie points with `track_views`; then `ViewMatch` gives its
lists to the rows of a cloud, chunk by chunk.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_input
from pcfix.io.views import colmap_vis, openmvs, tracks
from pcfix.io.views.geometry import fitted
from pcfix.io.views.lists import RawList, ViewList
from pcfix.io.views.matching import ViewMatch
from pcfix.io.views.orders import ImageOrder, image_orders
from pcfix.io.views.report import ViewReport
from pcfix.io.views.spacing import spacing_m

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from pcfix.model import Cameras, FloatArray, TiePoints

__all__ = ["ViewList", "ViewMatch", "ViewReport", "read_views", "track_views"]

Transformation: TypeAlias = "Callable[[FloatArray], FloatArray]"

_DENSE_SPACINGS = 0.05
_TRACK_SPACINGS = 2.0
"""On a real block the nearest track holds 77 % of a dense point's images at any distance up to
this, so that a tie point speaks for its surroundings as a dense point does not."""

_OTHERS = {
    b"LASF": "a LAS file: the cloud, not the list of its images",
    b"MVSI": "an OpenMVS scene: give the dense PLY file beside it",
    b"PK\x03\x04": "a ZIP archive or a project",
    b"SQLi": "a database",
}
"""What people give instead, by its first bytes."""


def read_views(
    path: str | os.PathLike[str],
    cameras: Cameras,
    *,
    names: Sequence[str] | None = None,
    to_cloud: Transformation | None = None,
) -> ViewList:
    """Read the view list of a dense cloud.

    Parameters
    ----------
    path : path
        COLMAP's ``fused.ply.vis``, or the dense PLY file of OpenMVS with its ``view_indices``. For
        COLMAP the ``fused.ply`` will do where the list lies beside it.
    cameras : Cameras
        In the cloud's frame.
    names : sequence of str, optional
        The images in the order in which the list counts them. Default: those of a sparse model
        beside the list, or of the cameras, whichever the geometry confirms.
    to_cloud : callable, optional
        Takes positions, shape (n, 3), from the list's frame to the cloud's. Default: the same.

    Returns
    -------
    ViewList

    Raises
    ------
    InputError
        If the file is not a whole view list, names images that are not there, or its cameras
        do not see its points.
    """
    raw = _moved(_read(check_input(path)), to_cloud)
    views = _listed(raw, image_orders(raw, cameras, names), "depth-maps")
    if raw.xyz is None:
        return views
    return fitted(views, cameras, raw.xyz, np.arange(len(views)))


def track_views(
    path: Path,
    tie_points: TiePoints,
    cameras: Cameras,
    *,
    to_cloud: Transformation | None = None,
) -> ViewList:
    """Take the tracks of a sparse model as a view list.

    Parameters
    ----------
    path : Path
        Where the tie points are from, for messages.
    tie_points : TiePoints
    cameras : Cameras
        Those that the tie points count, in the cloud's frame.
    to_cloud : callable, optional
        Takes positions, shape (n, 3), from the frame of the tie points to the cloud's.

    Returns
    -------
    ViewList

    Raises
    ------
    InputError
        If no tie point has a position, or the cameras do not see them.
    """
    raw = _moved(tracks.read(path, tie_points), to_cloud)
    order = ImageOrder("the cameras of the tie points", np.arange(len(cameras), dtype=np.int32))
    views = _listed(raw, (order,), "tracks")
    return views if raw.xyz is None else fitted(views, cameras, raw.xyz, np.arange(len(views)))


def _listed(
    raw: RawList, orders: tuple[ImageOrder, ...], kind: Literal["tracks", "depth-maps"]
) -> ViewList:
    spacing = None if raw.xyz is None else spacing_m(raw.xyz)
    spacings = _TRACK_SPACINGS if kind == "tracks" else _DENSE_SPACINGS
    return ViewList(raw, orders, None, spacing, spacings, kind)


def _moved(raw: RawList, to_cloud: Transformation | None) -> RawList:
    if raw.xyz is None or to_cloud is None:
        return raw
    return replace(raw, xyz=np.ascontiguousarray(to_cloud(raw.xyz), np.float64))


def _read(path: Path) -> RawList:
    with path.open("rb") as stream:
        head = stream.read(4)
    if head in _OTHERS:
        raise InputError(
            f"{path}: is {_OTHERS[head]}; a view list is the fused.ply.vis of COLMAP or the dense"
            " PLY of OpenMVS."
        )
    if not head.startswith(b"ply"):
        return colmap_vis.read(path)
    beside = path.with_name(f"{path.name}.vis")
    if not openmvs.has_lists(path) and beside.is_file():
        return colmap_vis.read(beside)
    return openmvs.read(path)
