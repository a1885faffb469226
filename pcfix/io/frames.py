"""Frames of one place: a folder of photographs, or a video file, one frame in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, SettingError
from pcfix.io.drafts import replaced_when_whole
from pcfix.io.files import check_output
from pcfix.io.photographs import PNG, photographs_in, read_photograph, size_of, write_photograph
from pcfix.libraries import photo_library
from pcfix.model import FloatArray
from pcfix.options.declare import File

LEAST_FRAMES = 3


@dataclass(frozen=True)
class Frames:
    """A sequence of images of one size.

    Attributes
    ----------
    path : path
        Of the folder or the video.
    photographs : tuple of path
        Empty for a video.
    names : tuple of str
        Of the frames, without a suffix.
    columns, rows : int
    interval_s : float or None
        Between frames, where a video says it.
    every : int
        So many frames of the video make a step.
    """

    path: Path
    photographs: tuple[Path, ...]
    names: tuple[str, ...]
    columns: int
    rows: int
    interval_s: float | None = None
    every: int = 1

    def __iter__(self) -> Iterator[npt.NDArray[Any]]:
        """Yield the pixels of each frame, shape (rows, columns, bands), as they are stored."""
        if self.photographs:
            yield from map(read_photograph, self.photographs)
            return
        film = _opened(self.path)
        try:
            for number in range(len(self.names) * self.every):
                if not film.grab():
                    raise InputError(
                        f"{self.path}: cannot be read beyond frame {number}; convert it again."
                    )
                if number % self.every == 0:
                    pixels = film.retrieve()[1]
                    yield pixels if pixels.ndim == 3 else pixels[..., None]
        finally:
            film.release()


def read_frames(path: File, every: int = 1) -> Frames:
    """Return the frames of a folder or a video; none is decoded for good yet.

    Parameters
    ----------
    path : path
    every : int
        Take every so many of them.

    Raises
    ------
    InputError
        If there are fewer than three, they differ in size, or the video cannot be read.
    """
    place = Path(path)
    if not place.exists():
        raise InputError(f"{place}: there is no such folder or video.")
    found = _film(place, every) if place.is_file() else _folder(place, every)
    if len(found.names) < LEAST_FRAMES:
        raise InputError(
            f"{place}: has {len(found.names)} frames, and a median needs {LEAST_FRAMES} at least;"
            " give more, or take every one of them."
        )
    return found


def _folder(place: Path, every: int) -> Frames:
    paths = tuple(photographs_in(place)[::every])
    sizes = [size_of(one) for one in paths]
    for one, size in zip(paths, sizes, strict=True):
        if size != sizes[0]:
            raise InputError(
                f"{one}: has {size[0]} x {size[1]} pixels, and {paths[0].name}"
                f" {sizes[0][0]} x {sizes[0][1]}; a sequence is of one camera, held one way."
            )
    return Frames(place, paths, tuple(one.stem for one in paths), *sizes[0])


def _opened(path: Path) -> Any:
    cv2 = photo_library("cv2")
    film = cv2.VideoCapture(str(path))
    if not film.isOpened():
        raise InputError(
            f"{path}: is no video that OpenCV can read; give a folder of frames, or convert it to"
            " MP4 (H.264)."
        )
    film.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return film


def _film(path: Path, every: int) -> Frames:
    """Count the frames by going through them, as the headers of videos may be wrong."""
    cv2 = photo_library("cv2")
    film = _opened(path)
    try:
        rate = float(film.get(cv2.CAP_PROP_FPS))
        count = 0
        while film.grab():
            count += 1
        columns, rows = (
            int(film.get(one)) for one in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
    finally:
        film.release()
    steps = count // every
    names = tuple(f"{path.stem}_{every * number:05d}" for number in range(steps))
    known = 0.1 <= rate <= 10_000.0
    return Frames(path, (), names, columns, rows, every / rate if known else None, every)


def check_calm(path: File, frames: Frames, *, overwrite: bool) -> tuple[Path, Path]:
    """Return the paths of the median and of its spread, which may be written.

    Raises
    ------
    SettingError
        If one exists, or the median is of another format than the frames.
    """
    inputs = frames.photographs or (frames.path,)
    target = check_output(path, overwrite=overwrite, inputs=inputs)
    suffixes = (frames.photographs[0].suffix.lower(),) if frames.photographs else PNG
    if target.suffix.lower() not in suffixes:
        of = "photographs" if frames.photographs else "a video"
        raise SettingError(f"{target}: the median of {of} here ends in {suffixes[0]}; name it so.")
    if frames.photographs and target.parent.resolve() == frames.path.resolve():
        raise SettingError(
            f"{target}: stands among the frames, and would be one of them the next time; give a"
            " file in another folder."
        )
    spread = target.with_name(f"{target.stem}_spread.tif")
    return target, check_output(spread, overwrite=overwrite, inputs=inputs)


def write_calm(target: Path, frames: Frames, pixels: npt.NDArray[Any]) -> None:
    """Write the median, shape (rows, columns, bands): with all that the first photograph has."""
    if frames.photographs:
        everywhere = np.ones(pixels.shape[:2], bool)
        write_photograph(frames.photographs[0], target, pixels, everywhere)
        return
    with replaced_when_whole(target) as draft:
        draft.write_bytes(photo_library("cv2").imencode(".png", pixels)[1].tobytes())


def write_spread(target: Path, spread: FloatArray) -> None:
    """Write what the frames differ by, shape (rows, columns), as TIFF of float32."""
    with replaced_when_whole(target) as draft:
        photo_library("tifffile").imwrite(
            draft, spread.astype(np.float32), compression="zlib", metadata=None
        )
