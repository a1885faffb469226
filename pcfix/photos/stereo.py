"""A simple dense matcher by stereo pairs, for rounds without another program.

As on the slide "Processing of stereo images" of Mulsow 2024: pairs, matching, intersection of
straight rays, fusion, filtering. Each image is paired with a few neighbours and rectified, OpenCV's
semi-global matcher (Hirschmueller 2008) finds disparities in both directions, and each cell takes
the median of the heights from the pairs. There are no weights and no visibility, and the heights of
all pairs are in memory (a few hundred images). It suits land and bed seen from above.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import GeometryError
from pcfix.grid.heights import cell_statistics
from pcfix.lens.imaging import project, unproject
from pcfix.model import BoolArray, FloatArray
from pcfix.photos.mapping import Ground, Photo
from pcfix.photos.ortho import Picture

PARTNERS = 4
BASE_SHARES = (0.1, 0.3, 0.55)
"""Shortest, best and longest base, as shares of the shorter side of the image."""
MOST_ANGLE_DEG = 30.0
"""Between the axes of a pair."""
SPARE_PX = 4
SPARE_RELIEF = 0.5
"""The bed is searched this share of the range of heights below the ground."""
BLOCK_PX = 5
FEWEST_PAIRS = 2
"""Pairs, and half of its own, that a cell needs within a pixel of parallax of the median."""
HALF = 1 << 31
"""Added to columns, so that those west of x = 0 do not run into the row of their number."""


class Rectified(NamedTuple):
    """The common frame of a pair, x along the base, and its window."""

    rotation: FloatArray  # from the world
    base_m: float
    focal_px: float
    left_px: float  # the corner of the window in the left image, from the foot of the axis
    top_px: float
    width: int
    height: int
    least_px: int  # at which disparities begin
    disparities: int


def stereo_cloud(
    photos: Sequence[Photo],
    ground: Ground,
    cell_m: float,
    picture: Callable[[int], Picture],
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Return a point, shape (n, 3), for each cell of land and bed in two or more pairs of images.

    The ground, which need only be approximate, gives the range of depths and the flying height;
    `picture` returns the grey pixels, uint8, shape (rows, columns), of an image by its place in
    `photos`, and where it has no picture.
    """
    low, high = np.nanquantile(ground.height_m, [0.001, 0.999])
    heights = float(low - SPARE_RELIEF * (high - low) - 1.0), float(high + 1.0)
    middle = float(np.nanmedian(ground.height_m))
    pairs, cells, means = pairs_of(photos, middle), [], []
    for done, (one, other) in enumerate(pairs, start=1):
        xyz = pair_points(photos[one], photos[other], picture(one), picture(other), heights)
        column, row = np.floor(xyz[:, :2] / cell_m).astype(np.int64).T
        own, cell = np.unique((row << 32) + column + HALF, return_inverse=True)
        if len(own):
            cells.append(own)
            means.append(cell_statistics(cell, xyz[:, 2], len(own))["mean"])
        if progress is not None:
            progress(done, len(pairs))
    if not cells:
        raise GeometryError(
            "photos.no_pairs",
            "Stereo found no pairs of images that overlap and match. Rebuild with the command of a"
            " photogrammetry package.",
            pairs=len(pairs),
        )
    # the median height of each cell, where most pairs agree to a pixel of parallax
    parallax = [
        (photo.centre[2] - middle) / (BASE_SHARES[1] * min(photo.lens.width, photo.lens.height))
        for photo in photos
    ]
    own, cell = np.unique(np.concatenate(cells), return_inverse=True)
    z = np.concatenate(means)
    fused = cell_statistics(cell, z, len(own))
    agrees = np.abs(z - fused["median"][cell]) <= float(np.median(parallax))
    agreeing = np.bincount(cell[agrees], minlength=len(own))
    row = own >> 32
    centre = cell_m * (np.column_stack([own - (row << 32) - HALF, row]) + 0.5)
    fine = agreeing >= np.maximum(FEWEST_PAIRS, 0.5 * fused["points"])
    return np.column_stack([centre, fused["median"]])[fine]


def pairs_of(photos: Sequence[Photo], ground_m: float) -> list[tuple[int, int]]:
    """Pair each image with the neighbours whose bases are nearest to the best."""
    shortest, best, longest = BASE_SHARES
    centres = np.array([photo.centre for photo in photos])
    axes = np.array([photo.rotation[2] for photo in photos])
    chosen = set()
    for row, photo in enumerate(photos):
        side = min(photo.lens.width, photo.lens.height)
        base = np.linalg.norm(centres - photo.centre, axis=1)
        share = base * photo.lens.focal / (photo.centre[2] - ground_m) / side
        fits = (share > shortest) & (share < longest)
        fits &= axes @ axes[row] > np.cos(np.radians(MOST_ANGLE_DEG))
        near = np.flatnonzero(fits)
        for other in near[np.argsort(np.abs(share[near] - best), kind="stable")][:PARTNERS]:
            chosen.add((min(row, int(other)), max(row, int(other))))
    return sorted(chosen)


def rectified(left: Photo, right: Photo, heights: tuple[float, float]) -> Rectified | None:
    """Return the common frame of a pair; None where they have no ground in common."""
    way = right.centre - left.centre
    base = float(np.linalg.norm(way))
    x = way / base
    z = left.rotation[2] + right.rotation[2]
    z = z - (z @ x) * x
    z /= np.linalg.norm(z)
    rotation = np.stack([x, np.cross(z, x), z])
    corners = []  # directions of the corners of both images, world frame
    for photo in (left, right):
        w, h = photo.lens.width, photo.lens.height
        places = np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
        corners.append(np.asarray(unproject(photo.lens, places) @ photo.rotation))
    ahead = [one @ rotation.T for one in corners]
    if min((one[:, 2] / np.linalg.norm(one, axis=1)).min() for one in ahead) < 0.3:
        return None
    focal = left.lens.focal
    plane = [focal * one[:, :2] / one[:, 2:] for one in ahead]
    top = max(one[:, 1].min() for one in plane)
    bottom = min(one[:, 1].max() for one in plane)
    lengths = [(left.centre[2] - height) / -corners[0][:, 2] for height in heights]
    far = [one for length in lengths for one in length * ahead[0][:, 2] if one > 0.0]
    if not far or bottom - top < 8 * BLOCK_PX:
        return None
    least = int(np.floor(focal * base / max(far))) - SPARE_PX
    most = int(np.ceil(focal * base / min(far))) + SPARE_PX
    start = max(plane[0][:, 0].min(), plane[1][:, 0].min() + least)
    stop = min(plane[0][:, 0].max(), plane[1][:, 0].max() + most)
    width, height = int(stop - start), int(bottom - top)
    disparities = -(-(most - least) // 16) * 16
    if width <= disparities + 8 * BLOCK_PX:
        return None
    return Rectified(rotation, base, focal, start, top, width, height, least, disparities)


def pair_points(
    left: Photo, right: Photo, one: Picture, other: Picture, heights: tuple[float, float]
) -> FloatArray:
    """Intersect what both images of a pair see, shape (n, 3), metres, world frame."""
    import cv2

    frame = rectified(left, right, heights)
    if frame is None:
        return np.empty((0, 3))
    seen, lost = _turned(left, one, frame, 0)
    found, gone = _turned(right, other, frame, frame.least_px)
    matcher: Any = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=frame.disparities, blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2, P2=32 * BLOCK_PX**2, disp12MaxDiff=1, preFilterCap=31,
        uniquenessRatio=5, speckleWindowSize=100, speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(seen, found).astype(np.float32) / 16.0
    row, column = np.nonzero((disparity > 0.0) & ~lost)
    shift = disparity[row, column]
    partner = np.rint(column - shift).astype(int)
    fine = (partner >= 0) & ~gone[row, np.maximum(partner, 0)]
    row, column, shift = row[fine], column[fine], shift[fine].astype(np.float64)
    depth = frame.focal_px * frame.base_m / (shift + frame.least_px)
    x = (column + 0.5 + frame.left_px) / frame.focal_px
    y = (row + 0.5 + frame.top_px) / frame.focal_px
    ahead = depth[:, None] * np.column_stack([x, y, np.ones_like(x)])
    return np.asarray(left.centre + ahead @ frame.rotation)


def _turned(
    photo: Photo, picture: Picture, frame: Rectified, least_px: int
) -> tuple[Any, BoolArray]:
    """Rectify an image to the frame of a pair, and return where it has no picture there."""
    import cv2

    u = np.arange(frame.width) + 0.5 + frame.left_px - least_px
    v = np.arange(frame.height) + 0.5 + frame.top_px
    ahead = np.ones((frame.height, frame.width, 3))
    ahead[..., 0], ahead[..., 1] = u / frame.focal_px, v[:, None] / frame.focal_px
    directions = ahead.reshape(-1, 3) @ (photo.rotation @ frame.rotation.T).T
    place = (project(photo.lens, directions) - 0.5).astype(np.float32)
    at = np.nan_to_num(place, nan=-9.0).reshape(frame.height, frame.width, 2)
    turned = cv2.remap(picture.pixels, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
    blank = cv2.remap(
        np.asarray(picture.blank, np.uint8), at, None, cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT, borderValue=1,
    )  # fmt: skip
    return turned, np.asarray(blank > 0)
