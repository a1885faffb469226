"""Read view lists, which say which cameras contributed to each point of a dense cloud.

Read one with `read_views`, or make one of tie points with `track_views`; then `ViewMatch` gives its
lists to the rows of a cloud, chunk by chunk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.files import check_input
from pcfix.io.views.lists import (
    COLMAP_LIST,
    ImageOrder,
    RawList,
    ViewList,
    fitted,
    image_orders,
    read_list,
    tracks_as_list,
)
from pcfix.io.views.matching import ViewMatch, ViewReport, spacing_m
from pcfix.model import Cameras, FloatArray, TiePoints, ViewKind
from pcfix.options.declare import File

__all__ = ["ViewList", "ViewMatch", "ViewReport", "read_views", "track_views"]

Transformation: TypeAlias = "Callable[[FloatArray], FloatArray]"

_SPACINGS = {"depth-maps": 0.05, "tracks": 2.0}
"""Default tolerance of a match by position. On a real block the nearest track holds 77 % of a dense
point's images at any distance up to two spacings, so that a tie point represents its surroundings
as a dense point does not."""


def read_views(path: File, cameras: Cameras, *, to_cloud: Transformation | None = None) -> ViewList:
    """Read the view list of a dense cloud.

    Parameters
    ----------
    path : path
        COLMAP's ``fused.ply.vis``, or the dense PLY file of OpenMVS with its ``view_indices``. For
        COLMAP the ``fused.ply`` will do if the list lies beside it. Images are counted as in a
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
    """Make a view list of the tracks of a sparse model that was read from `path`.

    The tie points count the images as `cameras` does; for the others see `read_views`.
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
    """Return a list whose cameras see its points, if it has positions to test that."""
    if raw.xyz is not None:
        xyz = raw.xyz if to_cloud is None else to_cloud(raw.xyz)
        placed = replace(raw, xyz=np.ascontiguousarray(xyz, np.float64))
        views = ViewList(placed, orders, None, spacing_m(xyz), _SPACINGS[kind], kind)
        try:
            return fitted(views, cameras, xyz, np.arange(len(views)))
        except InputError:
            if raw.what != COLMAP_LIST:
                raise
        sentence = f"{raw.path}: the PLY file beside it is in another frame and is not used."
        note = PcfixWarning("views.other_frame", sentence, path=raw.path)
        raw = replace(raw, xyz=None, notes=(*raw.notes, note))
    return ViewList(raw, orders, None, None, _SPACINGS[kind], kind)
