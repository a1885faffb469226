"""The image through calm water from frames taken through waves: registration and median.

Mulsow 2024, "strategies for wavy water", the simple method: a wave moves the part of the bed that a
pixel sees to and fro about its place under calm water, so the median over a sequence is about the
image through flat water. Before that, the movement of the hovering camera is removed: a homography
maps each frame to the first.

The homographies rest on what does not move. Corners of the first frame are tracked through all
others, and each is weighted by the inverse variance of its scatter in the registered frames. So
land decides where there is some, and elsewhere many corners, each about its mean over the frames.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import photo_library
from pcfix.model import BoolArray, FloatArray
from pcfix.photos.mapping import by_bands

FOLLOWED_PX = 2048  # longer side of the images in which corners are tracked; others are reduced
LEAST_CORNERS = 12
OUTLIER_PX = 5.0  # waves move corners; what lies farther off in the reduced image is a mismatch


def grey8(image: npt.NDArray[Any], longest_px: int | None = None) -> npt.NDArray[np.uint8]:
    """Return an image, shape (rows, columns, bands), as 8-bit grey, reduced where larger.

    Bands have equal weight; images of more bits are stretched between the 1st and 99th percentile.
    """
    cv2 = photo_library("cv2")
    grey = image[..., :3].mean(axis=2, dtype=np.float32)
    step = 1.0 if longest_px is None else max(1.0, max(grey.shape) / longest_px)
    if step > 1.0:
        size = (round(grey.shape[1] / step), round(grey.shape[0] / step))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    if image.dtype != np.uint8:
        low, high = np.percentile(grey, (1.0, 99.0))
        grey = (grey - low) * (255.0 / max(high - low, 1e-9))
    return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))


def corners_in(frames: Iterable[npt.NDArray[Any]]) -> Iterator[FloatArray]:
    """Yield the corners of the first frame in each frame, shape (k, 2), pixels; NaN where lost.

    Frames have the shape (rows, columns, bands); the centre of the first pixel is (0, 0).
    """
    cv2 = photo_library("cv2")
    how: dict[str, Any] = {
        "winSize": (21, 21), "maxLevel": 2, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }  # fmt: skip
    others = iter(frames)
    whole = next(others)
    first = grey8(whole, FOLLOWED_PX)
    scale, features = whole.shape[1] / first.shape[1], _features(first)
    found = cv2.goodFeaturesToTrack(first, 2000, 0.01, max(first.shape) / 80.0)
    start = np.empty((0, 1, 2), np.float32) if found is None else found
    yield (start[:, 0].astype(np.float64) + 0.5) * scale - 0.5  # pixels of the whole image
    for frame in others:
        grey = grey8(frame, FOLLOWED_PX)
        coarse = _coarse(features, _features(grey))
        if coarse is None or len(start) < LEAST_CORNERS:
            yield np.full((len(start), 2), np.nan)
            continue
        guess = cv2.perspectiveTransform(start, coarse)
        there, found, _ = cv2.calcOpticalFlowPyrLK(first, grey, start, guess, **how)
        back, again, _ = cv2.calcOpticalFlowPyrLK(grey, first, there, start.copy(), **how)
        back[(found & again).ravel() == 0] = np.inf
        returned = np.hypot(*(back - start)[:, 0].T) < 0.7  # px: tracked there and back again
        yield np.where(returned[:, None], (there[:, 0] + 0.5) * scale - 0.5, np.nan)


def _features(grey: Any) -> tuple[FloatArray, Any]:
    """Return places, in pixels of the image, and descriptors, for a first homography."""
    cv2 = photo_library("cv2")
    step = max(1.0, max(grey.shape) / 1024)
    small = cv2.resize(grey, None, fx=1.0 / step, fy=1.0 / step, interpolation=cv2.INTER_AREA)
    keys, described = cv2.SIFT_create(nfeatures=1500).detectAndCompute(small, None)
    return np.array([key.pt for key in keys], np.float32).reshape(-1, 2) * step, described


def _coarse(one: tuple[FloatArray, Any], other: tuple[FloatArray, Any]) -> Any:
    """Return the homography from an image to another, or None."""
    cv2 = photo_library("cv2")
    if min(len(one[0]), len(other[0])) < LEAST_CORNERS:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one[1], other[1], k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
    if len(good) < LEAST_CORNERS:
        return None
    mine = one[0][[match.queryIdx for match in good]]
    theirs = other[0][[match.trainIdx for match in good]]
    found, inliers = cv2.findHomography(mine, theirs, cv2.RANSAC, OUTLIER_PX)
    return None if found is None or inliers.sum() < LEAST_CORNERS else found


def register(places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Register frames to the first by the pixels of corners, shape (f, k, 2); NaN where lost.

    Returns the homographies to the first frame, shape (f, 3, 3), NaN where a frame has none, with
    the centre of the first pixel at (0, 0); and the standard deviations of the corners along an
    axis, shape (k,), pixels.
    """
    cv2 = photo_library("cv2")
    found = np.isfinite(places[..., 0])
    often = found & (found.sum(axis=0) >= max(2, len(places) // 2))
    homographies = np.full((len(places), 3, 3), np.nan)
    for one, there, known in zip(homographies, places, often & often[0], strict=True):
        if known.sum() >= LEAST_CORNERS:
            first = cv2.findHomography(there[known], places[0][known], cv2.RANSAC, OUTLIER_PX)[0]
            one[:] = np.nan if first is None else first
    scatter = np.empty(0)
    for _ in range(20):
        on = np.stack([_moved(one, there) for one, there in zip(homographies, places, strict=True)])
        on[~often] = np.nan
        counted = np.flatnonzero(np.isfinite(on[..., 0]).sum(axis=0) >= 2)
        mean = np.nanmedian(on[:, counted], axis=0)
        off = np.hypot(*np.moveaxis(on[:, counted] - mean, 2, 0))
        # by the median of Rayleigh's distribution, but at least the precision of tracking
        scatter = np.maximum(np.nanmedian(off, axis=0) / 1.1774, 0.1)
        # inverse variance, and less for what is off by more than twice its scatter (Huber)
        weight = np.minimum(1.0, 2.0 * scatter / np.maximum(off, 1e-9)) / scatter**2
        for one, there, each in zip(homographies, places[:, counted], weight, strict=True):
            known = np.isfinite(each)
            if known.sum() >= LEAST_CORNERS:
                one[:] = _fitted(there[known], mean[known], each[known])
    homographies = np.linalg.inv(homographies[0]) @ homographies
    homographies[0] = np.eye(3)  # to the last bit
    return homographies, scatter


def _moved(homography: FloatArray, places: FloatArray) -> FloatArray:
    whole = np.column_stack([places, np.ones(len(places))]) @ homography.T
    return np.asarray(whole[:, :2] / whole[:, 2:])


def _fitted(one: FloatArray, other: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the homography between places by weighted least squares, linear: it is near 1."""
    middle, size = one.mean(axis=0), one.std() + 1e-9
    (x, y), (u, v) = ((one - middle) / size).T, ((other - middle) / size).T
    # u (g x + h y + 1) = a x + b y + c and the same for v, linear in a to h
    zero, full = np.zeros(len(x)), np.ones(len(x))
    of_u = np.column_stack([x, y, full, zero, zero, zero, -u * x, -u * y])
    of_v = np.column_stack([zero, zero, zero, x, y, full, -v * x, -v * y])
    rows = np.vstack([of_u, of_v])
    root = np.sqrt(np.tile(weight, 2))
    found = np.linalg.lstsq(rows * root[:, None], np.concatenate([u, v]) * root, rcond=None)[0]
    scale = np.array([[size, 0.0, middle[0]], [0.0, size, middle[1]], [0.0, 0.0, 1.0]])
    return np.asarray(scale @ np.append(found, 1.0).reshape(3, 3) @ np.linalg.inv(scale))


def warped(frame: npt.NDArray[Any], homography: FloatArray) -> npt.NDArray[Any]:
    """Resample a frame, shape (rows, columns, bands), by a homography; bicubic."""
    cv2 = photo_library("cv2")
    how: Any = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REPLICATE}
    size = frame.shape[1], frame.shape[0]
    return by_bands(partial(cv2.warpPerspective, M=homography, dsize=size, **how), frame)


def covered(homography: FloatArray, shape: tuple[int, int], top: int, bottom: int) -> BoolArray:
    """Return which pixels of rows `top` to `bottom` of the first frame another one covers."""
    rows, columns = shape
    edge = np.array([[0.0, 0.0], [columns, 0.0], [columns, rows], [0.0, rows]]) - 0.5
    corners = _moved(homography, edge) - [0.0, top]
    inside = np.ones((bottom - top, columns), bool)
    x, y = np.arange(columns)[None, :], np.arange(bottom - top)[:, None]
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inside &= (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) >= -1e-6 * np.hypot(columns, rows)
    return inside


def median_of(
    frames: npt.NDArray[Any], known: BoolArray
) -> tuple[npt.NDArray[Any], npt.NDArray[np.float32]]:
    """Return the median over registered frames and their spread about it.

    Frames have the shape (f, rows, columns, bands); `known`, shape (f, rows, columns), is where
    each has pixels. The median, shape (rows, columns, bands), has their type and is 0 where no
    frame is known. The spread, shape (rows, columns), is the NMAD, mean over the bands; NaN where
    fewer than three frames are known.
    """
    count = known.sum(axis=0)[..., None, None]
    values = frames.astype(np.float32)
    values[~known] = np.inf
    median = _middle(np.moveaxis(values, 0, -1), count)
    np.abs(values - median, out=values, where=known[..., None])
    spread = 1.4826 * _middle(np.moveaxis(values, 0, -1), count).mean(axis=2)
    spread[count[..., 0, 0] < 3] = np.nan
    whole = np.issubdtype(frames.dtype, np.integer)
    return (np.rint(median) if whole else median).astype(frames.dtype), spread


def _middle(values: npt.NDArray[np.float32], count: Any) -> npt.NDArray[np.float32]:
    """Return the medians of the `count` smallest values along the last axis."""
    ordered = np.sort(values, axis=-1)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=-1)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[-1] - 1), axis=-1)
    middle = 0.5 * (low + high)[..., 0]
    return np.where(count[..., 0] > 0, middle, np.float32(0.0))
