"""Gather tie points and look for the sizes of images: shared by readers of sparse models."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from pcfix.errors import NoTiePointsError, PcfixWarning
from pcfix.io.cameras.checks import note
from pcfix.model import BoolArray, FloatArray, IntArray, TiePoints, Views

NO_TIE_POINTS = TiePoints(
    np.empty((0, 3)), Views(np.zeros(1, np.int64), np.empty(0, np.int64)), np.empty((0, 2))
)


def no_tie_points(path: Path, why: str) -> NoTiePointsError:
    """Return the error for a file without tie points."""
    sentence = f"{path}: has no tie points, as {why}."
    return NoTiePointsError("cameras.no_tie_points", sentence, path=path)


class Seen(NamedTuple):
    """Points, and observations of them in any order: row of the point and camera, u and v.

    The camera -1 is one without a pose, the point -1 one that is not there.
    """

    xyz: FloatArray
    point: IntArray
    camera: IntArray
    uv: FloatArray


def rows_of(wanted: IntArray, identifiers: IntArray) -> IntArray:
    """Return the first row of each of the wanted in a list of identifiers, -1 where it is none."""
    if not len(identifiers):
        return np.full(len(wanted), -1)
    order, rising = np.argsort(identifiers, kind="stable"), np.argsort(wanted)
    place = np.empty(len(wanted), np.int64)  # a search in rising order is far quicker
    place[rising] = np.searchsorted(identifiers[order], wanted[rising])
    row = order[np.minimum(place, len(order) - 1)]
    return np.where(identifiers[row] == wanted, row, -1)


def tie_points(*parts: Seen) -> TiePoints:
    """Join points and gather their observations by point, without those of a camera -1."""
    before = np.cumsum([0, *(len(part.xyz) for part in parts)])
    xyz = np.concatenate([part.xyz for part in parts])
    point = np.concatenate([part.point + n for part, n in zip(parts, before, strict=False)])
    is_there = np.concatenate([(part.camera >= 0) & (part.point >= 0) for part in parts])
    camera = np.concatenate([part.camera for part in parts])
    uv = np.concatenate([part.uv for part in parts])
    kept = np.flatnonzero(is_there)
    kept = kept[np.argsort(point[kept], kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(point[kept], minlength=len(xyz)))])
    return TiePoints(xyz, Views(start, camera[kept]), uv[kept])


def finite(path: Path, ties: TiePoints) -> tuple[TiePoints, PcfixWarning | None]:
    """Return tie points without those that are not finite, and a note on how many these were.

    A point without any coordinate is one that the source has not placed, and stays.
    """
    kept = np.asarray(np.isfinite(ties.xyz).all(axis=1) | np.isnan(ties.xyz).all(axis=1))
    seen = np.isfinite(ties.image_xy).all(axis=1)
    if kept.all() and seen.all():
        return ties, None
    point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    rows = np.flatnonzero(seen & kept[point])
    number = np.cumsum(kept) - 1
    left = Seen(ties.xyz[kept], number[point[rows]], ties.views.camera[rows], ties.image_xy[rows])
    points, observations = int((~kept).sum()), int((~seen).sum())
    sentence = f"{points:,} tie points and {observations:,} observations are not finite; ignored."
    code = "cameras.tie_points_not_finite"
    return tie_points(left), note(path, code, sentence, points=points, observations=observations)


def are_seen(tie_points: TiePoints) -> BoolArray:
    """Return which points have a position and a view."""
    seen = np.diff(tie_points.views.start) > 0
    return np.asarray(np.isfinite(tie_points.xyz).all(axis=1) & seen)


def image_size(folder: Path, name: str) -> tuple[int, int] | None:
    """Return width and height of an image, None when it is not there or cannot be opened.

    It is looked for in the folder, one folder up, and in ``images``.
    """
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
