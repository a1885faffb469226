"""Photographs (JPEG, TIFF, PNG), and sequences of frames.

A JPEG or TIFF photograph that changes in part keeps its metadata and, in JPEG, its unchanged blocks
of pixels, which are copied as they are stored.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError, bad_file
from pcfix.io.atomic import temporary_output
from pcfix.io.files import check_output, refusing, write_bytes
from pcfix.libraries import photo_library
from pcfix.model import BoolArray, FloatArray
from pcfix.options.declare import File

JPEG, TIFF, PNG = (".jpg", ".jpeg"), (".tif", ".tiff"), (".png",)
SUFFIXES = (*JPEG, *TIFF, *PNG)
DAMAGED = ("photos.damaged", "is damaged, or not a photograph ({}). Copy it from the camera again.")
LEAST_FRAMES = 3
Pixels = npt.NDArray[Any]


def photographs_in(folder: Path) -> list[Path]:
    """Return the photographs directly in a folder, in the order of their names."""
    if not folder.is_dir():
        raise bad_file(folder, "photos.no_folder", "is not a folder. Give that of the photographs.")
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    if not found:
        raise bad_file(folder, "photos.none", f"has no photographs ({', '.join(SUFFIXES)}).")
    return found


def size_of(path: Path) -> tuple[int, int]:
    """Return columns and rows of a photograph, from its header."""
    with refusing(path, *DAMAGED):
        if path.suffix.lower() in TIFF:
            with photo_library("tifffile").TiffFile(path) as file:
                return int(file.pages[0].imagewidth), int(file.pages[0].imagelength)
        from PIL import Image

        with Image.open(path) as image:
            return image.size


def read_photograph(path: Path) -> Pixels:
    """Return the pixels as stored, shape (rows, columns, bands), not rotated by EXIF."""
    suffix = path.suffix.lower()
    with refusing(path, *DAMAGED):
        if suffix in TIFF:
            with photo_library("tifffile").TiffFile(path) as file:
                page = file.pages[0]
                pixels = page.asarray()
                pixels = pixels if page.planarconfig == 1 else np.moveaxis(pixels, 0, -1)
        elif suffix in PNG:
            cv2 = photo_library("cv2")
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            if pixels is None:
                raise ValueError("no PNG")
        else:
            from PIL import Image

            with Image.open(path) as image:
                pixels = np.asarray(image)
    return pixels if pixels.ndim == 3 else pixels[..., None]


def read_colours(path: Path) -> Pixels:
    """Return pixels of 8 or 16 bits, red before blue in every format, without alpha."""
    pixels = read_photograph(path)
    if pixels.dtype not in (np.uint8, np.uint16):
        sentence = f"has {pixels.dtype} pixels. Give photographs of 8 or 16 bits."
        raise bad_file(path, "photos.kind", sentence, kind=pixels.dtype)
    if pixels.shape[2] == 4 and path.suffix.lower() not in TIFF:
        pixels = pixels[..., :3]
    if pixels.shape[2] == 3 and path.suffix.lower() in PNG:
        pixels = pixels[..., ::-1]
    return np.ascontiguousarray(pixels)


def write_photograph(source: Path, target: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write a photograph whose pixels differ from the source where `touched`.

    Both files have the same suffix; the shapes are (rows, columns, bands) and (rows, columns).
    """
    suffix = source.suffix.lower()
    with temporary_output(target) as path:
        if not touched.any():
            shutil.copyfile(source, path)
        elif suffix in JPEG:
            _write_jpeg(source, path, pixels, touched)
        elif suffix in TIFF:
            _write_tiff(source, path, pixels)
        else:
            path.write_bytes(_png(pixels))


def _write_jpeg(source: Path, path: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Encode the changed blocks with the tables of the source, and copy the others."""
    jpeglib = photo_library("jpeglib")
    from PIL import Image
    from PIL.JpegImagePlugin import JpegImageFile, get_sampling

    with JpegImageFile(source) as old:
        how: dict[str, Any] = {"qtables": old.quantization}
        if old.mode != "L":
            how["subsampling"] = get_sampling(old)
    Image.fromarray(pixels.squeeze()).save(path, "JPEG", **how)
    stored, new = jpeglib.read_dct(str(source)), jpeglib.read_dct(str(path))
    most = stored.samp_factor.max(axis=0)
    for name, factor in zip(("Y", "Cb", "Cr"), stored.samp_factor, strict=False):
        blocks = getattr(stored, name)
        if blocks is not None:
            side = 8 * most // factor
            high, wide = blocks.shape[0] * side[0], blocks.shape[1] * side[1]
            grid = np.zeros((high, wide), bool)  # the last blocks may reach beyond the image
            part = touched[:high, :wide]
            grid[: part.shape[0], : part.shape[1]] = part
            changed = grid.reshape(-1, side[0], blocks.shape[1], side[1]).any(axis=(1, 3))
            blocks[changed] = getattr(new, name)[changed]
    stored.write_dct(str(path))


def _write_tiff(source: Path, path: Path, pixels: Pixels) -> None:
    """Write the pixels into a copy if they are uncompressed, else a new file with the same tags."""
    tifffile = photo_library("tifffile")
    with tifffile.TiffFile(source) as file:
        page = file.pages[0]
        plain, planar = page.is_memmappable and page.is_contiguous, page.planarconfig == 2
        tags = [tag for tag in page.tags.values() if tag.code in _TIFF_KEPT]
        how: dict[str, Any] = {
            "photometric": page.photometric, "compression": page.compression,
            "extratags": [(tag.code, tag.dtype, tag.count, tag.value, True) for tag in tags],
            "planarconfig": "separate" if planar else "contig",
        }  # fmt: skip
    stored = np.moveaxis(pixels, -1, 0) if planar else pixels
    stored = stored[..., 0] if pixels.shape[2] == 1 and not planar else stored
    if plain:
        shutil.copyfile(source, path)
        place = tifffile.memmap(path, page=0, mode="r+")
        place[...] = stored.reshape(place.shape)
        place.flush()
    else:
        tifffile.imwrite(path, stored, metadata=None, **how)


_TIFF_KEPT = {270, 271, 272, 274, 282, 283, 296, 305, 306, 315, 700, 33432, 33550, 33922, 34735,
              34736, 34737, 48020, 48021, 48022}  # fmt: skip
"""Texts, resolution, rotation, XMP, GeoTIFF keys, and tags of multispectral cameras."""


def _png(pixels: Pixels) -> bytes:
    """Return the bytes of a PNG file."""
    return bytes(photo_library("cv2").imencode(".png", pixels)[1].tobytes())


@dataclass(frozen=True)
class Frames:
    """A sequence of images of one size, from a folder or from every n-th frame of a video.

    `photographs` is empty for a video. `interval_s` is the time between frames, where a video
    states it.
    """

    path: Path
    photographs: tuple[Path, ...]
    names: tuple[str, ...]  # without a suffix
    columns: int
    rows: int
    interval_s: float | None = None
    every: int = 1

    def __iter__(self) -> Iterator[Pixels]:
        """Yield the pixels of each frame, shape (rows, columns, bands), as they are stored."""
        if self.photographs:
            yield from map(read_photograph, self.photographs)
            return
        with _opened(self.path) as film:
            for number in range(len(self.names) * self.every):
                if not film.grab():
                    sentence = f"cannot be read beyond frame {number}. Convert it again."
                    raise bad_file(self.path, "video.damaged", sentence, frame=number)
                if number % self.every == 0:
                    pixels = film.retrieve()[1]
                    yield pixels if pixels.ndim == 3 else pixels[..., None]


def read_frames(path: File, every: int = 1) -> Frames:
    """Return the frames of a folder or a video, one in `every`; none is decoded yet."""
    place = Path(path)
    if not place.exists():
        raise bad_file(place, "frames.missing", "there is no such file.")
    if place.is_file():
        cv2, count = photo_library("cv2"), 0
        with _opened(place) as film:  # headers of videos may be wrong, so the frames are counted
            rate = float(film.get(cv2.CAP_PROP_FPS))
            while film.grab():
                count += 1
            columns = int(film.get(cv2.CAP_PROP_FRAME_WIDTH))
            rows = int(film.get(cv2.CAP_PROP_FRAME_HEIGHT))
        names = tuple(f"{place.stem}_{every * number:05d}" for number in range(count // every))
        interval_s = every / rate if 0.1 <= rate <= 10_000.0 else None
        found = Frames(place, (), names, columns, rows, interval_s, every)
    else:
        paths = tuple(photographs_in(place)[::every])
        sizes = [size_of(one) for one in paths]
        for one, size in zip(paths, sizes, strict=True):
            if size != sizes[0]:
                sentence = f"has {size} pixels, {paths[0].name} {sizes[0]}. Give one size."
                raise bad_file(one, "photos.size", sentence, size=size)
        found = Frames(place, paths, tuple(one.stem for one in paths), *sizes[0])
    count = len(found.names)
    if count < LEAST_FRAMES:
        sentence = f"gives {count} frames, of {LEAST_FRAMES} at least. Give more, or lower --every."
        raise bad_file(place, "frames.too_few", sentence, frames=count)
    return found


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    cv2 = photo_library("cv2")
    film = cv2.VideoCapture(str(path))
    try:
        if not film.isOpened():
            sentence = "OpenCV cannot read this video. Convert it to MP4, or give its frames."
            raise bad_file(path, "video.unreadable", sentence)
        film.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield film
    finally:
        film.release()


def check_calm(path: File, frames: Frames, *, overwrite: bool) -> tuple[Path, Path]:
    """Return the paths of the median and of its spread; refuse names that cannot be used."""
    inputs = frames.photographs or (frames.path,)
    suffixes = (frames.photographs[0].suffix.lower(),) if frames.photographs else PNG
    target = check_output(path, overwrite=overwrite, inputs=inputs, suffixes=suffixes)
    if frames.photographs and target.parent.resolve() == frames.path.resolve():
        sentence = f"{target}: is in the folder of the frames. Give a file in another folder."
        raise SettingError("output.is_input", sentence, path=target)
    spread = target.with_name(f"{target.stem}_spread.tif")
    return target, check_output(spread, overwrite=overwrite, inputs=inputs)


def write_calm(target: Path, frames: Frames, pixels: Pixels) -> None:
    """Write the median, shape (rows, columns, bands), with the metadata of the first photograph."""
    if frames.photographs:
        everywhere = np.ones(pixels.shape[:2], bool)
        write_photograph(frames.photographs[0], target, pixels, everywhere)
        return
    write_bytes(target, _png(pixels), overwrite=True)


def write_spread(target: Path, spread: FloatArray) -> None:
    """Write the spread of the frames, shape (rows, columns), as TIFF of float32."""
    tifffile = photo_library("tifffile")
    with temporary_output(target) as path:
        tifffile.imwrite(path, spread.astype(np.float32), compression="zlib", metadata=None)
