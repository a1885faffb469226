"""View lists: which cameras made each point of a dense cloud.

Read one with `read_views`, or make one of tie points with `track_views`; then `ViewMatch` gives its
lists to the rows of a cloud, chunk by chunk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_input
from pcfix.io.views.lists import ImageOrder, RawList, ViewList, read_list, tracks_as_list
from pcfix.io.views.matching import ViewMatch, ViewReport, spacing_m
from pcfix.io.views.orders import fitted, image_orders
from pcfix.model import Cameras, FloatArray, TiePoints, ViewKind
from pcfix.options.declare import File

__all__ = ["ViewList", "ViewMatch", "ViewReport", "read_views", "track_views"]

Transformation: TypeAlias = "Callable[[FloatArray], FloatArray]"

_SPACINGS = {"depth-maps": 0.05, "tracks": 2.0}
"""Default tolerance of a match by position. On a real block the nearest track holds 77 % of a dense
point's images at any distance up to two spacings, so that a tie point speaks for its surroundings
as a dense point does not."""


def read_views(path: File, cameras: Cameras, *, to_cloud: Transformation | None = None) -> ViewList:
    """Read the view list of a dense cloud.

    An `InputError` if the file is not a whole view list, names images that are not there, or its
    cameras do not see its points.

    Parameters
    ----------
    path : path
        COLMAP's ``fused.ply.vis``, or the dense PLY file of OpenMVS with its ``view_indices``. For
        COLMAP the ``fused.ply`` will do where the list lies beside it. Images are counted as in a
        sparse model beside the list, or as the cameras are, whichever the geometry confirms.
    cameras : Cameras
        In the cloud's frame.
    to_cloud : callable, optional
        Takes positions, shape (n, 3), from the list's frame to the cloud's. Default: the same.
    """
    raw = read_list(check_input(path))
    return _fitted(raw, image_orders(raw, cameras), "depth-maps", cameras, to_cloud)


def track_views(
    path: Path, tie_points: TiePoints, cameras: Cameras, *, to_cloud: Transformation | None = None
) -> ViewList:
    """Take the tracks of a sparse model, read from `path`, as a view list; see `read_views`.

    The tie points count the cameras. One without positions, or whose cameras do not see its points,
    is an `InputError`.
    """
    order = ImageOrder("the cameras of the tie points", np.arange(len(cameras), dtype=np.int32))
    return _fitted(tracks_as_list(path, tie_points), (order,), "tracks", cameras, to_cloud)


def _fitted(
    raw: RawList,
    orders: tuple[ImageOrder, ...],
    kind: ViewKind,
    cameras: Cameras,
    to_cloud: Transformation | None,
) -> ViewList:
    """Return a list whose cameras see its points, as far as it says where these are."""
    if raw.xyz is None:
        return ViewList(raw, orders, None, None, _SPACINGS[kind], kind)
    if to_cloud is not None:
        raw = replace(raw, xyz=np.ascontiguousarray(to_cloud(raw.xyz), np.float64))
    xyz = np.asarray(raw.xyz)
    views = ViewList(raw, orders, None, spacing_m(xyz), _SPACINGS[kind], kind)
    try:
        return fitted(views, cameras, xyz, np.arange(len(views)))
    except InputError:
        if not raw.is_beside:
            raise
    note = (
        f"{raw.path}: the PLY file beside it is in another frame than the cameras, as a local one"
        " is; its positions are not used, and the list goes by the rows of the cloud."
    )
    raw = replace(raw, xyz=None, notes=(*raw.notes, note))
    return ViewList(raw, orders, None, None, _SPACINGS[kind], kind)
