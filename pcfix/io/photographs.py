"""Photographs (JPEG, TIFF, PNG), sequences of frames, and times and flying heights of images.

A JPEG or TIFF photograph that changes in part keeps its metadata and, in JPEG, its unchanged blocks
of pixels, which are copied as they are stored.

Times with a zone (or Z) are UTC moments. Times without one are the readings of one clock that
images and a table of tides share. The two cannot be compared, so both must be of one kind.

The heights above the take-off place are those that drones recorded in their images: DJI's XMP has
``drone-dji:RelativeAltitude`` (metres, by the barometer).
"""

import re
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError, bad_file, photo_library
from pcfix.io.files import check_input, check_output, refusing, temporary_output
from pcfix.io.tables import match_labels, read_table
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
        sentence = "is not a folder of photographs."
        raise bad_file(folder, "photos.no_folder", sentence)
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    if not found:
        raise bad_file(folder, "photos.none", f"has no photographs ({', '.join(SUFFIXES)}).")
    return found


@contextmanager
def _opened(path: Path, *mode: str, **how: Any) -> Iterator[Any]:
    """Open an image without a georeference with GDAL."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, *mode, **how) as image:
            yield image


def size_of(path: Path) -> tuple[int, int]:
    """Return columns and rows of a photograph, from its header."""
    with refusing(path, *DAMAGED), _opened(path) as image:
        return image.width, image.height


def read_photograph(path: Path) -> Pixels:
    """Return the pixels as stored, shape (rows, columns, bands), not rotated by EXIF."""
    with refusing(path, *DAMAGED):
        if path.suffix.lower() not in JPEG:
            with _opened(path) as image:
                return np.moveaxis(image.read(), 0, -1)
        from PIL import Image

        with Image.open(path) as photograph:
            return np.atleast_3d(np.asarray(photograph))


def read_colours(path: Path) -> Pixels:
    """Return pixels of 8 or 16 bits, without alpha."""
    pixels = read_photograph(path)
    if pixels.dtype not in (np.uint8, np.uint16):
        sentence = f"has {pixels.dtype} pixels. Give photographs of 8 or 16 bits."
        raise bad_file(path, "photos.kind", sentence, kind=pixels.dtype)
    if pixels.shape[2] == 4 and path.suffix.lower() not in TIFF:
        pixels = pixels[..., :3]
    return np.ascontiguousarray(pixels)


def write_photograph(source: Path, target: Path, pixels: Pixels, touched: BoolArray) -> None:
    """Write a photograph whose pixels differ from the source where `touched`.

    Both files have the same suffix, except for PNG files of a video; the shapes are (rows, columns,
    bands) and (rows, columns).
    """
    suffix = target.suffix.lower()
    with temporary_output(target) as path:
        if not touched.any():
            shutil.copyfile(source, path)
        elif suffix in JPEG:
            _write_jpeg(source, path, pixels, touched)
        elif suffix in TIFF:
            _write_tiff(source, path, pixels)
        else:
            rows, columns, count = pixels.shape
            how = {"width": columns, "height": rows, "count": count, "dtype": pixels.dtype.name}
            with _opened(path, "w", driver="PNG", **how) as image:
                image.write(np.moveaxis(pixels, -1, 0))


_ONE_AT_A_TIME = Lock()  # jpeglib in two threads loses the EXIF data of one image in a thousand


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
    with _ONE_AT_A_TIME:
        stored, new = jpeglib.read_dct(str(source)), jpeglib.read_dct(str(path))
    most = stored.samp_factor.max(axis=0)
    for name, factor in zip(("Y", "Cb", "Cr"), stored.samp_factor, strict=False):
        blocks = getattr(stored, name)
        if blocks is not None:
            side = 8 * most // factor  # pixels of a block, more if the component is subsampled
            high, wide = blocks.shape[0] * side[0], blocks.shape[1] * side[1]
            grid = np.zeros((high, wide), bool)  # the last blocks may reach beyond the image
            part = touched[:high, :wide]
            grid[: part.shape[0], : part.shape[1]] = part
            # rows and columns of blocks, with their pixels: any changed one changes its block
            changed = grid.reshape(-1, side[0], blocks.shape[1], side[1]).any(axis=(1, 3))
            blocks[changed] = getattr(new, name)[changed]
    with _ONE_AT_A_TIME:
        stored.write_dct(str(path))


def _write_tiff(source: Path, path: Path, pixels: Pixels) -> None:
    """Write the pixels into a copy if they are uncompressed, else a new file with the same tags."""
    tifffile = photo_library("tifffile")
    with tifffile.TiffFile(source) as file:
        page = file.pages[0]
        plain, planar = page.is_memmappable and page.is_contiguous, page.planarconfig == 2
        tags = [tag for tag in page.tags.values() if tag.code in _COPIED_TAGS]
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


# Texts, resolution, rotation, XMP, GeoTIFF keys, and tags of multispectral cameras.
_COPIED_TAGS = {270, 271, 272, 274, 282, 283, 296, 305, 306, 315, 700, 33432, 33550, 33922, 34735,
              34736, 34737, 48020, 48021, 48022}  # fmt: skip


@dataclass(frozen=True)
class Burst:
    """A burst: the photographs of a sequence in a folder, all of one size, or frames of a video."""

    path: Path
    photographs: tuple[Path, ...]  # none of a video
    names: tuple[str, ...]  # of the frames, without a suffix
    columns: int
    rows: int
    every: int = 1  # frames of the video for one of the burst
    interval_s: float | None = None  # between frames of the burst, if a video states it

    def __iter__(self) -> Iterator[Pixels]:
        """Yield the pixels of each frame, shape (rows, columns, bands), as they are stored."""
        if self.photographs:
            return map(read_photograph, self.photographs)
        return islice(_video_frames(self.path), 0, None, self.every)


def read_frames(path: File, every: int = 1) -> Burst:
    """Return the frames of a folder or of a video, one in `every`."""
    place = Path(path)
    if place.is_file():
        # headers of videos may state a wrong number of frames, so they are counted
        shapes = [frame.shape for frame in _video_frames(place)][::every]
        if not shapes:
            sentence = "has no frames that OpenCV can read. Convert it to MP4, or give a folder."
            raise bad_file(place, "video.unreadable", sentence)
        cv2 = photo_library("cv2")
        rate = float(cv2.VideoCapture(str(place)).get(cv2.CAP_PROP_FPS))
        names = tuple(f"{place.stem}_{every * number:05d}" for number in range(len(shapes)))
        interval_s = every / rate if 0.1 <= rate <= 10_000.0 else None
        found = Burst(place, (), names, shapes[0][1], shapes[0][0], every, interval_s)
    else:
        paths = tuple(photographs_in(place)[::every])
        sizes = [size_of(one) for one in paths]
        for one, size in zip(paths, sizes, strict=True):
            if size != sizes[0]:
                sentence = f"has {size} pixels, {paths[0].name} {sizes[0]}. Give one size."
                raise bad_file(one, "photos.size", sentence, size=size)
        found = Burst(place, paths, tuple(one.stem for one in paths), *sizes[0])
    if (count := len(found.names)) < LEAST_FRAMES:
        sentence = f"gives {count} frames, of {LEAST_FRAMES} at least. Give more, or lower --every."
        raise bad_file(place, "frames.too_few", sentence, frames=count)
    return found


def _video_frames(path: Path) -> Iterator[Pixels]:
    """Yield the frames of a video, red first."""
    cv2 = photo_library("cv2")
    film = cv2.VideoCapture(str(path))
    film.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as stored, like photographs
    found, pixels = film.read()
    while found:
        yield pixels[..., ::-1]
        found, pixels = film.read()
    film.release()


def check_calm(path: File, frames: Burst, *, overwrite: bool) -> tuple[Path, Path]:
    """Return the paths of the median and of its spread; refuse names that cannot be used."""
    suffixes = (frames.photographs[0].suffix.lower(),) if frames.photographs else PNG
    how: dict[str, Any] = {"overwrite": overwrite, "inputs": frames.photographs or (frames.path,)}
    target = check_output(path, suffixes=suffixes, **how)
    if frames.photographs and target.parent.resolve() == frames.path.resolve():
        sentence = f"{target}: is in the folder of the frames. Give a file in another folder."
        raise SettingError("output.is_input", sentence, path=target)
    return target, check_output(target.with_name(f"{target.stem}_spread.tif"), **how)


def write_spread(target: Path, spread: FloatArray) -> None:
    """Write the spread of the frames, shape (rows, columns), as TIFF of float32."""
    tifffile = photo_library("tifffile")
    with temporary_output(target) as path:
        tifffile.imwrite(path, spread.astype(np.float32), compression="zlib", metadata=None)


# Files that may state when and how high they were taken.
IMAGES = (".jpg", ".jpeg", ".tif", ".tiff", ".png", ".webp", ".heic", ".dng")


class Times(NamedTuple):
    """Times of k images, or of the rows of a tide table."""

    time_s: FloatArray  # (k,), seconds since 1970, UTC if `zoned`, else of a local clock
    zoned: bool
    name: str  # of the source, for messages


def read_image_times(path: File, labels: Sequence[str]) -> Times:
    """Find out when k images were taken, by their names (with or without folder and suffix).

    A table has the columns ``label`` and ``time`` (ISO 8601). A folder has the images, whose EXIF
    data has DateTimeOriginal, and OffsetTimeOriginal for the zone.
    """
    found = Path(path)
    if not found.is_dir():
        table = read_table(check_input(found), ("label", "time"))
        rows, times = _rows(table.column("label"), labels, found), table.column("time")
        where = [f"line {table.line[row]}" for row in rows]
        return parse_times(found, where, [times[row] for row in rows])
    from PIL import ExifTags, Image

    files = sorted(p for p in found.rglob("*") if p.suffix.lower() in IMAGES)
    chosen = [files[row] for row in _rows([str(p) for p in files], labels, found)]
    texts = []
    for file in chosen:
        sentence = "is not a readable image ({})."
        with refusing(file, "photos.unreadable", sentence), Image.open(file) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
        own = ExifTags.Base
        codes = (own.DateTimeOriginal, own.SubsecTimeOriginal, own.OffsetTimeOriginal)
        text, fraction, zone = (str(tags.get(code, "")).strip("\0 ") for code in codes)
        if not text:
            sentence = "its EXIF data has no DateTimeOriginal. Give a CSV table label,time instead."
            raise bad_file(file, "image_times.missing", sentence)
        texts.append(text + (f".{fraction}" if fraction.isdecimal() else "") + zone)
    return parse_times(found, [f"image {file.name}" for file in chosen], texts)


def _rows(names: Sequence[str], labels: Sequence[str], source: Path) -> list[int]:
    """Return for each label the row of its name."""
    rows: list[int] = match_labels(labels, names, one_to_one=False)[0].tolist()
    missing = [label for label, row in zip(labels, rows, strict=True) if row < 0]
    if missing:
        sentence = f"{len(missing)} images are missing or have ambiguous names: {missing[0]}, ..."
        raise bad_file(source, "image_times.missing", sentence, images=missing)
    return rows


def parse_times(source: Path, where: Sequence[str], texts: Sequence[str]) -> Times:
    """Parse times; all must have zones, or none."""
    moments = []
    for at, text in zip(where, texts, strict=True):
        iso = re.sub(r"^(\d{4}):(\d\d):(\d\d)\b", r"\1-\2-\3", text.strip())  # of EXIF data
        try:
            moments.append(datetime.fromisoformat(iso if len(iso) > len("2026-05-01") else ""))
        except ValueError:
            sentence = f"{at}: '{text}' is not a date and time. Write 2026-05-01T12:00:00Z."
            raise bad_file(source, "time.format", sentence, value=text) from None
    zoned = [moment.tzinfo is not None for moment in moments]
    if any(zoned) != all(zoned):
        odd = zoned.index(not zoned[0])
        sentence = f"{where[odd]}: only some times have a zone ('{texts[odd]}'). Write all alike."
        raise bad_file(source, "time.zone", sentence, value=texts[odd])
    utc = [moment if zoned[0] else moment.replace(tzinfo=UTC) for moment in moments]
    return Times(np.array([moment.timestamp() for moment in utc]), zoned[0], str(source))


def read_altitudes(cameras: File, labels: Sequence[str]) -> FloatArray:
    """Return how high each image was taken above the take-off place, shape (k,), metres.

    NaN where it is not recorded. At most 30 images near the camera file are read.
    """
    path, found = Path(cameras), dict[str, float]()
    root = path if path.is_dir() else path.parent
    above = re.compile(rb"RelativeAltitude(?:=[\"']|>)\s*([+-]?\d+(?:\.\d*)?)")
    with suppress(OSError):  # no correction needs them
        inside = [*sorted(root.glob("*")), *sorted(root.glob("images/*"))]
        images = [one for one in inside if one.suffix.lower() in IMAGES and one.is_file()]
        for image in images[:: 1 + len(images) // 30]:
            with image.open("rb") as stream:
                if stated := above.search(stream.read(2**17)):
                    found[image.name] = float(stated[1])
    altitudes = np.array([*found.values(), np.nan])
    return np.asarray(altitudes[match_labels(labels, list(found))[0]])  # -1 for those without
