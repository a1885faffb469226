"""The orthophoto of the bed: each cell takes the colour of the images closest to nadir.

Each cell of the DSM is located in the images themselves: under water, the light is traced from the
bed through the surface to the projection centre. So original images serve as well as those without
water, and they are resampled only once.

Images whose rays are nearly as steep as the steepest are mixed, weighted by the difference, so that
seams do not show.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.model import BoolArray, FloatArray
from pcfix.photos.mapping import Photo, Scene, occluded
from pcfix.refract.tracing import trace

FEATHER = 0.01  # images are mixed within this difference of tangents (15 px at f = 1500 px)
SPARE_SHARE = 0.15  # of the frame, by which a straight ray may miss it where the refracted one hits
REMAP_COLUMNS = 1024


class Picture(NamedTuple):
    """The pixels of an image, shape (rows, columns, bands), reduced by a whole factor.

    `blank`, shape (rows, columns), is where there is no picture, if that was asked for.
    """

    pixels: npt.NDArray[Any]
    shrunk: int = 1
    blank: BoolArray | None = None

    def at(self, place: FloatArray) -> npt.NDArray[Any]:
        """Return the pixels at places, shape (n, bands), bicubic."""
        import cv2

        n = len(place)
        at = np.zeros((-(-n // REMAP_COLUMNS) * REMAP_COLUMNS, 2), np.float32)
        at[:n] = place / self.shrunk - 0.5
        u, v = (np.ascontiguousarray(one).reshape(-1, REMAP_COLUMNS) for one in at.T)
        found = cv2.remap(self.pixels, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found.reshape(len(at), -1)[:n])


def picture_of(pixels: npt.NDArray[Any], shrunk: int = 1, *, blanks: bool = False) -> Picture:
    """Return an image, reduced for coarse rasters; with `blanks`, black areas have no picture."""
    import cv2

    blank = blank_in(pixels) if blanks else None
    if shrunk > 1:
        rows, columns, bands = pixels.shape
        size = columns // shrunk, rows // shrunk
        inner = np.ascontiguousarray(pixels[: size[1] * shrunk, : size[0] * shrunk])
        pixels = cv2.resize(inner, size, interpolation=cv2.INTER_AREA).reshape(*size[::-1], bands)
        if blank is not None:
            inner = blank[: size[1] * shrunk, : size[0] * shrunk]
            blank = np.asarray(inner.reshape(size[1], shrunk, size[0], shrunk).any(axis=(1, 3)))
    return Picture(pixels, shrunk, blank)


def blank_in(pixels: npt.NDArray[Any]) -> BoolArray:
    """Return the black areas of an image without water, and the pixels next to them."""
    import cv2

    limit = 3 * (257 if pixels.dtype == np.uint16 else 1)  # 3 of 255
    dark = (pixels.max(axis=2) <= limit).astype(np.uint8)
    square = np.ones((7, 7), np.uint8)
    wide = cv2.morphologyEx(
        dark, cv2.MORPH_OPEN, square, borderType=cv2.BORDER_REPLICATE
    )  # single dark pixels are shadows
    return np.asarray(cv2.dilate(wide, square) > 0)


def mosaic(
    xyz: FloatArray, photos: Sequence[Photo], scene: Scene, picture: Callable[[int], Picture]
) -> tuple[FloatArray, BoolArray] | None:
    """Return the colours of places on the ground, shape (n, 3), and whether any image sees them.

    Colours have the shape (n, bands); None if no image sees any place. `picture` returns the pixels
    of an image by its place in `photos`.
    """
    slopes = []  # tangents of straight rays from nadir; infinite far outside the frame
    for photo in photos:
        away, at = xyz - photo.centre, photo.pixels(xyz) / [photo.lens.width, photo.lens.height]
        inside = ((at > -SPARE_SHARE) & (at < 1.0 + SPARE_SHARE)).all(axis=1) & (away[:, 2] < 0.0)
        tangent = np.hypot(away[:, 0], away[:, 1]) / np.where(inside, -away[:, 2], 1.0)
        slopes.append(np.where(inside, tangent, np.inf).astype(np.float32))
    near = [k for k, one in enumerate(slopes) if np.isfinite(one).any()]
    if not near:
        return None
    slope = np.stack([slopes[k] for k in near])
    place = np.zeros((*slope.shape, 2), np.float32)
    looked = np.zeros(slope.shape, bool)
    while True:
        best = slope.min(axis=0)
        wanted = np.isfinite(slope) & (slope <= best + FEATHER) & ~looked
        if not wanted.any():
            break
        for k in np.flatnonzero(wanted.any(axis=1)):
            rows = np.flatnonzero(wanted[k])
            place[k, rows], seen = seen_at(photos[near[k]], xyz[rows], scene)
            image = picture(near[k])
            if image.blank is not None:
                column, row = (place[k, rows[seen]] / image.shrunk).astype(int).T
                last = np.array(image.blank.shape) - 1
                seen[seen] = ~image.blank[np.clip(row, 0, last[0]), np.clip(column, 0, last[1])]
            slope[k, rows[~seen]] = np.inf
            looked[k, rows] = True
    covered = np.isfinite(best)
    if not covered.any():
        return None
    share = np.clip(1.0 - (slope - np.where(covered, best, 0.0)) / FEATHER, 0.0, 1.0)
    share /= np.maximum(share.sum(axis=0), 1e-9)
    used = np.flatnonzero((share > 0.0).any(axis=1))
    colour: Any = np.zeros((len(xyz), picture(near[used[0]]).pixels.shape[2]), np.float32)
    for k in used:
        rows = np.flatnonzero(share[k] > 0.0)
        colour[rows] += share[k, rows, None] * picture(near[k]).at(place[k, rows])
    return colour, covered


def seen_at(photo: Photo, xyz: FloatArray, scene: Scene) -> tuple[FloatArray, BoolArray]:
    """Return the pixels of places on the ground, shape (n, 3), and whether the image sees them.

    A place is seen if it lies in the frame and the ground does not occlude its ray in air or water.
    """
    n = scene.refractive_index
    pierced = trace(photo.centre, xyz, scene.water, refractive_index=n).piercing_xyz
    place = photo.pixels(pierced)  # NaN where no path was found
    frame = np.array([photo.lens.width, photo.lens.height])
    seen = np.asarray(((place >= 0.0) & (place <= frame)).all(axis=1))
    centre = np.broadcast_to(photo.centre, xyz.shape)
    for start, end in (centre, pierced), (pierced, xyz):
        seen[seen] = ~occluded(scene.ground, start[seen], end[seen])
    return place, seen
