"""Photographs: JPEG, TIFF and PNG, read and written again with all that stands beside the pixels.

A photograph that was changed in part is the file that it was but for that: its metadata, and in
JPEG the blocks of pixels that nothing touched, which are copied as they are stored.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, PcfixError
from pcfix.io.drafts import replaced_when_whole
from pcfix.libraries import photo_library
from pcfix.model import BoolArray

JPEG, TIFF, PNG = (".jpg", ".jpeg"), (".tif", ".tiff"), (".png",)
SUFFIXES = (*JPEG, *TIFF, *PNG)
_PNG_PIXELS = {b"IHDR", b"PLTE", b"IDAT", b"tRNS", b"IEND"}
Pixels = npt.NDArray[Any]


def photographs_in(folder: Path) -> list[Path]:
    """Return the photographs directly in a folder, in the order of their names."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give the one that holds the photographs.")
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    if not found:
        raise InputError(f"{folder}: holds no photograph ({', '.join(SUFFIXES)}).")
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
    """Return the pixels as stored, shape (rows, columns, bands); no turning by EXIF.

    Raises
    ------
    InputError
        If the file is damaged, or is of another format.
    """
    with _readable(path):
        pixels = _pixels(path)
    return pixels if pixels.ndim == 3 else pixels[..., None]


def read_colours(path: Path) -> Pixels:
    """Return the pixels as `read_photograph`, red before blue in every format, without alpha.

    Raises
    ------
    InputError
        If they are numbers of another kind than 8 or 16 bits.
    """
    pixels = read_photograph(path)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: has {pixels.dtype} pixels; give photographs of 8 or 16 bits.")
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
    """Turn what the libraries say of a damaged file into a sentence."""
    try:
        yield
    except PcfixError:
        raise
    except Exception as error:  # of any kind, where a tag has another type than it should
        raise InputError(
            f"{path}: is damaged, or no photograph that can be read ({error}); copy it from the"
            " camera again."
        ) from error


def write_photograph(source: Path, target: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write a photograph that was changed in part, beside its name first.

    Parameters
    ----------
    source : path
        The photograph taken; all but its pixels is kept.
    target : path
        Of the same suffix.
    pixels : array, shape (rows, columns, bands)
    touched : array of bool, shape (rows, columns)
        Where the pixels are other than those of the source.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    suffix = source.suffix.lower()
    write = _write_jpeg if suffix in JPEG else _write_tiff if suffix in TIFF else _write_png
    with replaced_when_whole(target) as draft:
        if touched.any():
            write(source, draft, pixels, touched)
        else:
            shutil.copyfile(source, draft)


def _write_jpeg(source: Path, draft: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write the blocks that were touched anew, by the tables of the source, and copy the others."""
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
    """Return for each block, so many pixels high and wide, whether one of them was touched."""
    rows, columns = (int(a) for a in side)
    wide = np.zeros((shape[0] * rows, shape[1] * columns), bool)
    high, across = min(touched.shape[0], wide.shape[0]), min(touched.shape[1], wide.shape[1])
    wide[:high, :across] = touched[:high, :across]
    return np.asarray(wide.reshape(shape[0], rows, shape[1], columns).any(axis=(1, 3)))


def _write_tiff(source: Path, draft: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write the pixels into a copy where they lie plain; else a new file with the same tags."""
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
"""Texts, resolution, turning, XMP, GeoTIFF keys, and what multispectral cameras write."""


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
