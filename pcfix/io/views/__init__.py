"""View lists: which cameras made each point of a dense cloud.

Read one with `read_views`, or make one of tie points with `track_views`; then `ViewMatch` gives its
lists to the rows of a cloud, chunk by chunk.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from pcfix.io.files import check_input
from pcfix.io.views.lists import ImageOrder, RawList, ViewList, read_list, tracks_as_list
from pcfix.io.views.matching import ViewMatch, ViewReport, spacing_m
from pcfix.io.views.orders import fitted, image_orders
from pcfix.model import Cameras, FloatArray, TiePoints

__all__ = ["ViewList", "ViewMatch", "ViewReport", "read_views", "track_views"]

Transformation: TypeAlias = "Callable[[FloatArray], FloatArray]"

_SPACINGS = {"depth-maps": 0.05, "tracks": 2.0}
"""Default tolerance of a match by position. On a real block the nearest track holds 77 % of a dense
point's images at any distance up to two spacings, so that a tie point speaks for its surroundings
as a dense point does not."""


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
    raw = _moved(read_list(check_input(path)), to_cloud)
    return _fitted(raw, image_orders(raw, cameras, names), "depth-maps", cameras)


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
    raw = _moved(tracks_as_list(path, tie_points), to_cloud)
    order = ImageOrder("the cameras of the tie points", np.arange(len(cameras), dtype=np.int32))
    return _fitted(raw, (order,), "tracks", cameras)


def _moved(raw: RawList, to_cloud: Transformation | None) -> RawList:
    if raw.xyz is None or to_cloud is None:
        return raw
    return replace(raw, xyz=np.ascontiguousarray(to_cloud(raw.xyz), np.float64))


def _fitted(
    raw: RawList,
    orders: tuple[ImageOrder, ...],
    kind: Literal["tracks", "depth-maps"],
    cameras: Cameras,
) -> ViewList:
    """Return a list whose cameras see its points, as far as it says where these are."""
    if raw.xyz is None:
        return ViewList(raw, orders, None, None, _SPACINGS[kind], kind)
    views = ViewList(raw, orders, None, spacing_m(raw.xyz), _SPACINGS[kind], kind)
    return fitted(views, cameras, raw.xyz, np.arange(len(views)))
