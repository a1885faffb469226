"""Photographs (JPEG, TIFF, PNG), written with all metadata, and sequences of frames.

A photograph that changes in part keeps its metadata and, in JPEG, its unchanged blocks of pixels,
which are copied as they are stored.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, PcfixError, SettingError
from pcfix.io.atomic import temporary_output
from pcfix.io.files import check_output
from pcfix.libraries import photo_library
from pcfix.model import BoolArray, FloatArray
from pcfix.options.declare import File

JPEG, TIFF, PNG = (".jpg", ".jpeg"), (".tif", ".tiff"), (".png",)
SUFFIXES = (*JPEG, *TIFF, *PNG)
_PNG_PIXELS = {b"IHDR", b"PLTE", b"IDAT", b"tRNS", b"IEND"}
LEAST_FRAMES = 3
Pixels = npt.NDArray[Any]


def photographs_in(folder: Path) -> list[Path]:
    """Return the photographs directly in a folder, in the order of their names."""
    if not folder.is_dir():
        raise InputError(
            "photos.no_folder",
            f"{folder}: is not a folder. Give that of the photographs.",
            path=folder,
        )
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    if not found:
        raise InputError(
            "photos.none", f"{folder}: has no photographs ({', '.join(SUFFIXES)}).", path=folder
        )
    return found


def size_of(path: Path) -> tuple[int, int]:
    """Return columns and rows of a photograph, from its header."""
    with _readable(path):
        if path.suffix.lower() in TIFF:
            tifffile = photo_library("tifffile")
            with tifffile.TiffFile(path) as file:
                page: Any = file.pages[0]
                return int(page.imagewidth), int(page.imagelength)
        from PIL import Image

        with Image.open(path) as image:
            return image.size


def read_photograph(path: Path) -> Pixels:
    """Return the pixels as stored, shape (rows, columns, bands), not rotated by EXIF."""
    with _readable(path):
        pixels = _pixels(path)
    return pixels if pixels.ndim == 3 else pixels[..., None]


def read_colours(path: Path) -> Pixels:
    """Return pixels of 8 or 16 bits, red before blue in every format, without alpha."""
    pixels = read_photograph(path)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(
            "photos.kind",
            f"{path}: has {pixels.dtype} pixels. Give photographs of 8 or 16 bits.",
            path=path,
            kind=pixels.dtype,
        )
    if pixels.shape[2] == 4 and path.suffix.lower() not in TIFF:
        pixels = pixels[..., :3]
    if pixels.shape[2] == 3 and path.suffix.lower() in PNG:
        pixels = pixels[..., ::-1]
    return np.ascontiguousarray(pixels)


def _pixels(path: Path) -> Pixels:
    suffix = path.suffix.lower()
    if suffix in TIFF:
        tifffile = photo_library("tifffile")
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            return page.asarray() if page.planarconfig == 1 else np.moveaxis(page.asarray(), 0, -1)
    if suffix in PNG:
        cv2 = photo_library("cv2")
        found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if found is None:
            raise ValueError("no PNG")
        return np.asarray(found)
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Refuse a damaged file, whatever its library raises."""
    try:
        yield
    except PcfixError:
        raise
    except Exception as error:  # of any kind, where a tag has another type than it should
        raise InputError(
            "photos.damaged",
            f"{path}: is damaged, or not a photograph ({error}). Copy it from the camera again.",
            path=path,
        ) from error


def write_photograph(source: Path, target: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write a photograph that changed in part.

    Parameters
    ----------
    source, target : path
        The original, whose metadata are kept, and the new file, of the same suffix.
    pixels : array, shape (rows, columns, bands)
    touched : array of bool, shape (rows, columns)
        Where the pixels differ from the source.
    """
    suffix = source.suffix.lower()
    write = _write_jpeg if suffix in JPEG else _write_tiff if suffix in TIFF else _write_png
    with temporary_output(target) as draft:
        if touched.any():
            write(source, draft, pixels, touched)
        else:
            shutil.copyfile(source, draft)


def _write_jpeg(source: Path, draft: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Encode the changed blocks with the tables of the source, and copy the others."""
    jpeglib = photo_library("jpeglib")
    from PIL import Image
    from PIL.JpegImagePlugin import JpegImageFile, get_sampling

    with JpegImageFile(source) as old:
        how: dict[str, Any] = {"qtables": old.quantization}
        if old.mode != "L":
            how["subsampling"] = get_sampling(old)
    Image.fromarray(pixels.squeeze()).save(draft, "JPEG", **how)
    whole, new = jpeglib.read_dct(str(source)), jpeglib.read_dct(str(draft))
    most = whole.samp_factor.max(axis=0)
    for name, factor in zip(("Y", "Cb", "Cr"), whole.samp_factor, strict=False):
        blocks = getattr(whole, name)
        if blocks is not None:
            side = 8 * most // factor
            changed = _any_in_blocks(touched, side, blocks.shape[:2])
            blocks[changed] = getattr(new, name)[changed]
    whole.write_dct(str(draft))


def _any_in_blocks(touched: BoolArray, side: npt.NDArray[Any], shape: tuple[int, int]) -> BoolArray:
    """Return for each block, whose sides are in pixels, whether any of its pixels changed."""
    rows, columns = (int(a) for a in side)
    wide = np.zeros((shape[0] * rows, shape[1] * columns), bool)
    high, across = min(touched.shape[0], wide.shape[0]), min(touched.shape[1], wide.shape[1])
    wide[:high, :across] = touched[:high, :across]
    return np.asarray(wide.reshape(shape[0], rows, shape[1], columns).any(axis=(1, 3)))


def _write_tiff(source: Path, draft: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write the pixels into a copy if they are uncompressed, else a new file with the same tags."""
    tifffile = photo_library("tifffile")
    with tifffile.TiffFile(source) as file:
        page = file.pages[0]
        plain = page.is_memmappable and page.is_contiguous
        planar = page.planarconfig == 2
        kept = [
            (tag.code, tag.dtype, tag.count, tag.value, True)
            for tag in page.tags.values()
            if tag.code in _TIFF_KEPT
        ]
        how: dict[str, Any] = {
            "photometric": page.photometric, "compression": page.compression, "extratags": kept,
            "planarconfig": "separate" if planar else "contig",
        }  # fmt: skip
    stored = np.moveaxis(pixels, -1, 0) if planar else pixels
    stored = stored[..., 0] if pixels.shape[2] == 1 and not planar else stored
    if plain:
        shutil.copyfile(source, draft)
        place = tifffile.memmap(draft, page=0, mode="r+")
        place[...] = stored.reshape(place.shape)
        place.flush()
        return
    tifffile.imwrite(draft, stored, metadata=None, **how)


_TIFF_KEPT = {270, 271, 272, 274, 282, 283, 296, 305, 306, 315, 700, 33432, 33550, 33922, 34735,
              34736, 34737, 48020, 48021, 48022}  # fmt: skip
"""Texts, resolution, rotation, XMP, GeoTIFF keys, and tags of multispectral cameras."""


def _write_png(source: Path, draft: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write the pixels, and every other chunk of the source."""
    cv2 = photo_library("cv2")
    _, data = cv2.imencode(".png", pixels)
    new, old = _chunks(data.tobytes()), _chunks(source.read_bytes())
    beside = [chunk for name, chunk in old if name not in _PNG_PIXELS]
    out = io.BytesIO()
    out.write(data.tobytes()[:8])
    for name, chunk in new:
        out.write(chunk)
        if name == b"IHDR":
            out.writelines(beside)
    draft.write_bytes(out.getvalue())


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Return the chunks of a PNG, each with its name."""
    found, at = [], 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        found.append((data[at + 4 : at + 8], data[at : at + 12 + length]))
        at += 12 + length
    return found


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
    interval_s : float or None
        Between frames, where a video states it.
    every : int
        Only every so many-th frame of a video is used.
    """

    path: Path
    photographs: tuple[Path, ...]
    names: tuple[str, ...]
    columns: int
    rows: int
    interval_s: float | None = None
    every: int = 1

    def __iter__(self) -> Iterator[Pixels]:
        """Yield the pixels of each frame, shape (rows, columns, bands), as they are stored."""
        if self.photographs:
            yield from map(read_photograph, self.photographs)
            return
        film = _opened(self.path)
        try:
            for number in range(len(self.names) * self.every):
                if not film.grab():
                    raise InputError(
                        "video.damaged",
                        f"{self.path}: cannot be read beyond frame {number}. Convert it again.",
                        path=self.path,
                        frame=number,
                    )
                if number % self.every == 0:
                    pixels = film.retrieve()[1]
                    yield pixels if pixels.ndim == 3 else pixels[..., None]
        finally:
            film.release()


def read_frames(path: File, every: int = 1) -> Frames:
    """Return the frames of a folder or a video, every so many-th; none is decoded yet."""
    place = Path(path)
    if not place.exists():
        raise InputError("frames.missing", f"{place}: there is no such file.", path=place)
    found = _film(place, every) if place.is_file() else _folder(place, every)
    if len(found.names) < LEAST_FRAMES:
        raise InputError(
            "frames.too_few",
            f"{place}: gives {len(found.names)} frames, but a median needs {LEAST_FRAMES}. Give"
            " more, or lower --every.",
            path=place,
            frames=len(found.names),
        )
    return found


def _folder(place: Path, every: int) -> Frames:
    paths = tuple(photographs_in(place)[::every])
    sizes = [size_of(one) for one in paths]
    for one, size in zip(paths, sizes, strict=True):
        if size != sizes[0]:
            raise InputError(
                "photos.size",
                f"{one}: has {size[0]} x {size[1]} pixels, but {paths[0].name} {sizes[0][0]} x"
                f" {sizes[0][1]}. Give frames of one size.",
                path=one,
                size=size,
            )
    return Frames(place, paths, tuple(one.stem for one in paths), *sizes[0])


def _opened(path: Path) -> Any:
    cv2 = photo_library("cv2")
    film = cv2.VideoCapture(str(path))
    if not film.isOpened():
        raise InputError(
            "video.unreadable",
            f"{path}: OpenCV cannot read this video. Convert it to MP4 (H.264), or give a folder of"
            " frames.",
            path=path,
        )
    film.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return film


def _film(path: Path, every: int) -> Frames:
    """Count the frames by reading them, as the headers of videos may be wrong."""
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
    """Return the paths of the median and of its spread; refuse names that cannot be used."""
    inputs = frames.photographs or (frames.path,)
    target = check_output(path, overwrite=overwrite, inputs=inputs)
    suffixes = (frames.photographs[0].suffix.lower(),) if frames.photographs else PNG
    if target.suffix.lower() not in suffixes:
        raise SettingError(
            "output.suffix",
            f"{target}: must end in {suffixes[0]}, as the frames do (PNG for a video).",
            path=target,
            suffix=suffixes[0],
        )
    if frames.photographs and target.parent.resolve() == frames.path.resolve():
        raise SettingError(
            "output.is_input",
            f"{target}: is in the folder of the frames. Give a file in another folder.",
            path=target,
        )
    spread = target.with_name(f"{target.stem}_spread.tif")
    return target, check_output(spread, overwrite=overwrite, inputs=inputs)


def write_calm(target: Path, frames: Frames, pixels: Pixels) -> None:
    """Write the median, shape (rows, columns, bands), with the metadata of the first photograph."""
    if frames.photographs:
        everywhere = np.ones(pixels.shape[:2], bool)
        write_photograph(frames.photographs[0], target, pixels, everywhere)
        return
    with temporary_output(target) as draft:
        draft.write_bytes(photo_library("cv2").imencode(".png", pixels)[1].tobytes())


def write_spread(target: Path, spread: FloatArray) -> None:
    """Write the spread of the frames, shape (rows, columns), as TIFF of float32."""
    with temporary_output(target) as draft:
        photo_library("tifffile").imwrite(
            draft, spread.astype(np.float32), compression="zlib", metadata=None
        )
