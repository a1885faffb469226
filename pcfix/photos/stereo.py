"""A simple dense matcher by stereo pairs, for rounds without another program.

As on the slide "Processing of stereo images" of Mulsow 2024: pairs, matching, intersection of
straight rays, fusion, filtering. Each image is paired with a few neighbours and rectified, OpenCV's
semi-global matcher (Hirschmueller 2008) finds disparities in both directions, and each cell takes
the median of the heights from the pairs. There are no weights and no visibility, and the heights of
all pairs are in memory (a few hundred images). It suits land and bed seen from above.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pcfix.errors import GeometryError
from pcfix.grid.lattice import cell_statistics
from pcfix.lens.imaging import project
from pcfix.model import BoolArray, FloatArray
from pcfix.photos.mapping import Ground, Photo
from pcfix.photos.ortho import Picture

BASE_SHARES = (0.1, 0.3, 0.55)  # shortest, best and longest base, by the image's shorter side
SPARE_PX, BLOCK_PX = 4, 5  # disparities beyond those expected, and the side of matched blocks


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
    # the bed is searched half of the range of heights below the ground
    heights = float(low - 0.5 * (high - low) - 1.0), float(high + 1.0)
    middle = float(np.nanmedian(ground.height_m))
    pairs, cells, means = pairs_of(photos, middle), [], []
    for done, (one, other) in enumerate(pairs, start=1):
        xyz = pair_points(photos[one], photos[other], picture(one), picture(other), heights)
        # the mean height of each cell, by its row and column
        place = np.floor(xyz[:, 1::-1] / cell_m).astype(np.int64)
        own, cell = np.unique(place, axis=0, return_inverse=True)
        if len(own):
            cells.append(own)
            means.append(cell_statistics(cell.ravel(), xyz[:, 2], len(own))["mean"])
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
    own, cell = np.unique(np.concatenate(cells), axis=0, return_inverse=True)
    cell, z = cell.ravel(), np.concatenate(means)
    fused = cell_statistics(cell, z, len(own))
    agrees = np.abs(z - fused["median"][cell]) <= float(np.median(parallax))
    agreeing = np.bincount(cell[agrees], minlength=len(own))
    centre = cell_m * (own[:, ::-1] + 0.5)
    fine = agreeing >= np.maximum(2, 0.5 * fused["points"])
    return np.column_stack([centre, fused["median"]])[fine]


def pairs_of(photos: Sequence[Photo], ground_m: float) -> list[tuple[int, int]]:
    """Pair each image with the four neighbours whose bases are nearest to the best."""
    shortest, best, longest = BASE_SHARES
    centres = np.array([photo.centre for photo in photos])
    axes = np.array([photo.rotation[2] for photo in photos])
    chosen = set()
    for row, photo in enumerate(photos):
        side = min(photo.lens.width, photo.lens.height)
        base = np.linalg.norm(centres - photo.centre, axis=1)
        share = base * photo.lens.focal / (photo.centre[2] - ground_m) / side
        fits = (share > shortest) & (share < longest)
        fits &= axes @ axes[row] > np.cos(np.radians(30.0))  # nearly parallel axes
        near = np.flatnonzero(fits)
        for other in near[np.argsort(np.abs(share[near] - best), kind="stable")][:4]:
            chosen.add((min(row, int(other)), max(row, int(other))))
    return sorted(chosen)


def pair_points(
    left: Photo, right: Photo, one: Picture, other: Picture, heights: tuple[float, float]
) -> FloatArray:
    """Intersect what both images of a pair see, shape (n, 3), metres, world frame.

    Both are rectified to a common frame with x along the base, within the window that both see.
    """
    import cv2

    # the common frame: x along the base, z between the optical axes
    nothing, baseline = np.empty((0, 3)), right.centre - left.centre
    base = float(np.linalg.norm(baseline))
    x = baseline / base
    z = left.rotation[2] + right.rotation[2]
    z = z - (z @ x) * x
    z /= np.linalg.norm(z)
    rotation = np.stack([x, np.cross(z, x), z])
    # rays of the corners of both images, in the world and in the frame
    sizes = (np.array([photo.lens.width, photo.lens.height]) for photo in (left, right))
    places = [np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size for size in sizes]
    corners = [left.rays(places[0]), right.rays(places[1])]
    ahead = [rays @ rotation.T for rays in corners]
    if min(rays[:, 2].min() for rays in ahead) < 0.3:
        return nothing
    # the window that both images see, in pixels from the principal point
    focal = left.lens.focal
    plane = [focal * rays[:, :2] / rays[:, 2:] for rays in ahead]
    top = max(corner[:, 1].min() for corner in plane)
    bottom = min(corner[:, 1].max() for corner in plane)
    # disparity = focal length x base / depth: its range from the depths at the corners
    lengths = [(left.centre[2] - height) / -corners[0][:, 2] for height in heights]
    far = np.concatenate([length * ahead[0][:, 2] for length in lengths])
    far = far[far > 0.0]
    if not len(far) or bottom - top < 8 * BLOCK_PX:
        return nothing
    least = int(np.floor(focal * base / max(far))) - SPARE_PX
    most = int(np.ceil(focal * base / min(far))) + SPARE_PX
    start = max(plane[0][:, 0].min(), plane[1][:, 0].min() + least)
    stop = min(plane[0][:, 0].max(), plane[1][:, 0].max() + most)
    width, height = int(stop - start), int(bottom - top)
    disparities = -(-(most - least) // 16) * 16  # a multiple of 16, as OpenCV wants
    if width <= disparities + 8 * BLOCK_PX:
        return nothing
    u, v = np.arange(width) + 0.5 + start, np.arange(height) + 0.5 + top
    seen, lost = _turned(left, one, rotation, u / focal, v / focal)
    found, gone = _turned(right, other, rotation, (u - least) / focal, v / focal)
    matcher: Any = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=disparities, blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2, P2=32 * BLOCK_PX**2, disp12MaxDiff=1, preFilterCap=31,
        uniquenessRatio=5, speckleWindowSize=100, speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(seen, found).astype(np.float32) / 16.0  # it counts in sixteenths
    row, column = np.nonzero((disparity > 0.0) & ~lost)
    shift = disparity[row, column]
    partner = np.rint(column - shift).astype(int)
    fine = (partner >= 0) & ~gone[row, np.maximum(partner, 0)]
    row, column, shift = row[fine], column[fine], shift[fine].astype(np.float64)
    depth = focal * base / (shift + least)
    ray = np.column_stack([u[column] / focal, v[row] / focal, np.ones(len(row))])
    return np.asarray(left.centre + (depth[:, None] * ray) @ rotation)


def _turned(
    photo: Photo, picture: Picture, rotation: FloatArray, x: FloatArray, y: FloatArray
) -> tuple[Any, BoolArray]:
    """Rectify an image to a frame of some columns and rows, and return where it has no picture."""
    import cv2

    ahead = np.ones((len(y), len(x), 3))
    ahead[..., 0], ahead[..., 1] = x, y[:, None]
    directions = ahead.reshape(-1, 3) @ (photo.rotation @ rotation.T).T
    place = (project(photo.lens, directions) - 0.5).astype(np.float32)
    at = np.nan_to_num(place, nan=-9.0).reshape(len(y), len(x), 2)
    turned = cv2.remap(picture.pixels, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
    blank = cv2.remap(
        np.asarray(picture.blank, np.uint8), at, None, cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT, borderValue=1,
    )  # fmt: skip
    return turned, np.asarray(blank > 0)
