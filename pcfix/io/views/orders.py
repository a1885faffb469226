"""What the image numbers of a view list mean.

No list names its images. A number counts them in the order in which the dense matcher had them:

- COLMAP takes the registered images of its sparse model. Some versions keep them in the order of
  ``images.bin`` or ``images.txt``, which is none in particular; others by ascending IMAGE_ID;
  those with rigs frame by frame, by ascending FRAME_ID (``Reconstruction::RegImageIds``).
- OpenMVS takes what its importer gave, for COLMAP in the order of ``images.txt``.

So every order that a sparse model beside the list allows is a candidate, then that of the cameras
as they were given; `pcfix.io.views.geometry` tells which of them is right.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.views.sparse import model_orders

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy.typing as npt

    from pcfix.io.views.lists import RawList
    from pcfix.model import Cameras


@dataclass(frozen=True, eq=False)
class ImageOrder:
    """One meaning of the image numbers.

    Attributes
    ----------
    what : str
        Where it is from.
    camera : array of int32, shape (images,)
        The row of `Cameras` of each image, -1 where it has none.
    unposed : tuple of str
        Images without a row.
    """

    what: str
    camera: npt.NDArray[np.int32]
    unposed: tuple[str, ...] = ()


def image_orders(
    raw: RawList, cameras: Cameras, names: Sequence[str] | None
) -> tuple[ImageOrder, ...]:
    """Return the orders that the image numbers may follow, the likeliest first.

    Raises
    ------
    InputError
        If a number is beyond the images of all of them, or the names are not those of the cameras.
    """
    if names is not None:
        found = [_by_name("the given names", names, cameras)]
    else:
        found = [_by_name(what, order, cameras) for what, order in model_orders(raw.path.parent)]
        found.append(ImageOrder("the cameras as given", np.arange(len(cameras), dtype=np.int32)))
    most = int(raw.image.max()) if raw.image.size else -1
    fitting = [order for order in found if most < len(order.camera)]
    if not fitting:
        largest = max(found, key=lambda order: len(order.camera))
        raise InputError(
            f"{raw.path}: names image number {most} (from 0), but there are"
            f" {len(largest.camera)} in {largest.what}; put the sparse model of the dense"
            " workspace beside the list, or give the cameras that it was made with."
        )
    known = [order for order in fitting if (order.camera >= 0).any()]
    if not known:
        raise InputError(
            f"{raw.path}: none of the images in {fitting[0].what} is among the cameras (the"
            f" first are {fitting[0].unposed[0]} and {cameras.labels[0]}); give the cameras of this"
            " block."
        )
    return tuple(_distinct(known))


def _distinct(orders: list[ImageOrder]) -> list[ImageOrder]:
    kept: list[ImageOrder] = []
    for order in orders:
        if not any(np.array_equal(order.camera, other.camera) for other in kept):
            kept.append(order)
    return kept


def _by_name(what: str, names: Sequence[str], cameras: Cameras) -> ImageOrder:
    """Find each name among the labels: whole, without its folder, without its extension."""
    row = np.full(len(names), -1, np.int32)
    keys: tuple[Callable[[str], str], ...] = (str, _file_name, _stem)
    for key in keys:
        labels = [key(label) for label in cameras.labels]
        unique = {k for k, n in Counter(labels).items() if n == 1}
        unique &= {k for k, n in Counter(map(key, names)).items() if n == 1}
        rows = {label: i for i, label in enumerate(labels) if label in unique}
        for i, name in enumerate(names):
            if row[i] < 0:
                row[i] = rows.get(key(name), -1)
    return ImageOrder(what, row, tuple(n for n, r in zip(names, row, strict=True) if r < 0))


def _file_name(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name


def _stem(name: str) -> str:
    return PurePosixPath(_file_name(name)).stem.lower()
