"""The frame of images whose camera file does not tell their size."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pcfix.model import FloatArray, IntArray

_SAME_CAMERA = 1.1
"""Largest ratio between the focal lengths of neighbours among images of one camera."""


def frames(
    path: Path, names: Sequence[str], focal_px: FloatArray, smallest_px: FloatArray
) -> tuple[FloatArray | None, tuple[str, ...]]:
    """Return width and height of images, from the images themselves or from their tie points.

    Where an image cannot be opened, its frame is the smallest that holds all tie points that
    images of about the same focal length have, about the middle of the frame.

    Parameters
    ----------
    path : Path
        The camera file; images are looked for where it lies, one folder up, and in ``images``.
    names : sequence of str, length k
        What the file calls them, with or without a folder.
    focal_px : array, shape (k,)
    smallest_px : array, shape (k, 2)
        The smallest width and height that hold the tie points of the image; 0 where it has none.

    Returns
    -------
    array, shape (k, 2), or None
        None where nothing tells them.
    tuple of str
        What to tell the user.
    """
    sizes = np.array([image_size(path.parent, name) or (0, 0) for name in names], float)
    missing = sizes[:, 0] == 0
    if not missing.any():
        return sizes, ()
    if not smallest_px.any():
        return None, (
            f"{path}: tells no size of {missing.sum()} images, and the images are not beside it;"
            " every point is taken as inside their frames. Put the images beside the file.",
        )
    sizes[missing] = _bounds(focal_px, smallest_px)[missing]
    return sizes, (
        f"{path}: tells no size of {missing.sum()} images, and the images are not beside it; their"
        f" frames are estimated from the tie points, that of {names[missing.argmax()]} as"
        f" {sizes[missing][0, 0]:.0f} x {sizes[missing][0, 1]:.0f} px. Put the images beside the"
        " file.",
    )


def _bounds(focal_px: FloatArray, smallest_px: FloatArray) -> FloatArray:
    """Return for each image the bound of all images of about its focal length."""
    bounds = np.empty_like(smallest_px)
    group = _same_camera(focal_px)
    for i in range(int(group.max()) + 1):
        members = group == i
        bound = smallest_px[members].max(axis=0)
        bounds[members] = bound if bound.all() else smallest_px.max(axis=0)
    return bounds


def _same_camera(focal_px: FloatArray) -> IntArray:
    """Return a number for each image, the same for those of neighbouring focal lengths."""
    order = np.argsort(focal_px)
    steps = focal_px[order][1:] > _SAME_CAMERA * focal_px[order][:-1]
    group = np.empty(len(order), np.int64)
    group[order] = np.concatenate([[0], np.cumsum(steps)])
    return group


def image_size(folder: Path, name: str) -> tuple[int, int] | None:
    """Return width and height of an image, None when it is not there or cannot be opened."""
    from PIL import Image

    plain = name.replace("\\", "/")
    file = PureWindowsPath(name).name
    for place in (folder / plain, folder / file, folder.parent / plain, folder / "images" / file):
        try:
            if place.is_file():
                with Image.open(place) as image:
                    return image.size
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            continue
    return None
