"""Read tide tables, and times and flying heights of images; compute the level at each image.

Times with a zone (or Z) are UTC moments. Times without one are the readings of one clock that
table and images share. The two cannot be compared, so both must be of one kind.

The heights above the take-off place are those that drones recorded in their images: DJI's XMP has
``drone-dji:RelativeAltitude`` (metres, by the barometer).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import bad_file, warn
from pcfix.io.files import check_input, refusing
from pcfix.io.tables import match_labels, read_table
from pcfix.model import FloatArray
from pcfix.options.declare import File

IMAGES = (".jpg", ".jpeg", ".tif", ".tiff", ".png", ".webp", ".heic", ".dng")
_EXIF_DATE = re.compile(r"^(\d{4}):(\d\d):(\d\d)\b")
_DATE_TIME_ORIGINAL, _OFFSET_ORIGINAL, _SUBSECONDS, _EXIF = 0x9003, 0x9011, 0x9291, 0x8769
LONG_GAP_S = 3600.0
"""Between rows. Half a tide lasts 6.2 h; with an amplitude A of 2 m the chord over one hour is up
to A (2 pi 1 h / 12.4 h)^2 / 8 = 6 cm off, that over two hours 26 cm."""


class Times(NamedTuple):
    """Times of k images, or of the rows of a tide table."""

    time_s: FloatArray  # (k,), seconds since 1970, UTC if `zoned`, else of a local clock
    zoned: bool
    name: str  # of the source, for messages


def read_image_times(path: File, labels: Sequence[str]) -> Times:
    """Find out when images were taken.

    Parameters
    ----------
    path : path
        A table with the columns ``label`` and ``time`` (ISO 8601), or a folder with the images,
        whose EXIF data has DateTimeOriginal, and OffsetTimeOriginal for the zone.
    labels : sequence of str
        Names of the k images; a folder or an extension may be missing on either side.
    """
    found = Path(path)
    if found.is_dir():
        return _from_exif(found, labels)
    table = read_table(check_input(found), ("label", "time"))
    rows = _rows(table.column("label"), labels, found)
    texts = table.column("time")
    where = [f"line {table.line[row]}" for row in rows]
    return _times(found, where, [texts[row] for row in rows])


def _from_exif(folder: Path, labels: Sequence[str]) -> Times:
    from PIL import Image

    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in IMAGES)
    chosen = [files[row] for row in _rows([str(p) for p in files], labels, folder)]
    texts = []
    for file in chosen:
        sentence = "is not a readable image ({})."
        with refusing(file, "photos.unreadable", sentence), Image.open(file) as image:
            tags = image.getexif().get_ifd(_EXIF)
        codes = (_DATE_TIME_ORIGINAL, _SUBSECONDS, _OFFSET_ORIGINAL)
        text, fraction, zone = (str(tags.get(code, "")).strip("\0 ") for code in codes)
        if not text:
            sentence = "its EXIF data has no DateTimeOriginal. Give a CSV table label,time instead."
            raise bad_file(file, "image_times.missing", sentence)
        texts.append(text + (f".{fraction}" if fraction.isdecimal() else "") + zone)
    return _times(folder, [f"image {file.name}" for file in chosen], texts)


def _rows(names: Sequence[str], labels: Sequence[str], source: Path) -> list[int]:
    """Return for each label the row of its name."""
    rows: list[int] = match_labels(labels, names, one_to_one=False)[0].tolist()
    missing = [label for label, row in zip(labels, rows, strict=True) if row < 0]
    if missing:
        sentence = f"{len(missing)} images are missing or have ambiguous names: {missing[0]}, ..."
        raise bad_file(source, "image_times.missing", sentence, images=missing)
    return rows


def _times(source: Path, where: Sequence[str], texts: Sequence[str]) -> Times:
    """Parse times; all must have zones, or none."""
    moments = []
    for at, text in zip(where, texts, strict=True):
        iso = _EXIF_DATE.sub(r"\1-\2-\3", text.strip())
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


def read_tide(path: File) -> tuple[Times, FloatArray]:
    """Read a table of increasing ``time`` (ISO 8601) and ``level_m``, above any datum."""
    source = check_input(path)
    table = read_table(source, ("time", "level_m"))
    level = table.of(("level_m",))[:, 0]
    times = _times(source, [f"line {line}" for line in table.line], table.column("time"))
    late = np.flatnonzero(np.diff(times.time_s) <= 0.0)
    if late.size:
        line = table.line[late[0] + 1]
        sentence = f"line {line}: the time is not later than the one before. Sort the rows by time."
        raise bad_file(source, "tide.order", sentence, line=line)
    if len(level) < 2:
        raise bad_file(source, "tide.one_row", "has one row. Give at least two.")
    return times, level


def level_offsets(
    tide: Times, level_m: FloatArray, times: Times, labels: Sequence[str]
) -> FloatArray:
    """Return how much higher than on average the water was at each of k images, metres.

    The level is linear between the rows of the table. The average over the images is the level that
    the user gives.
    """
    clock = tide.time_s
    if tide.zoned != times.zoned:
        without = times if tide.zoned else tide
        sentence = "its times have no zone, those of the other file have. Add +02:00, or Z for UTC."
        raise bad_file(without.name, "time.zone", sentence)
    outside = np.flatnonzero((times.time_s < clock[0]) | (times.time_s > clock[-1]))
    if outside.size:
        image, at = labels[outside[0]], float(times.time_s[outside[0]])
        taken = datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M:%S")
        sentence = f"does not cover image {image}, taken at {taken} ({outside.size} of"
        sentence += f" {len(labels)} images are outside). Add rows, or check the zones."
        raise bad_file(
            tide.name, "tide.not_covered", sentence, image=image, count=int(outside.size)
        )
    level = np.interp(times.time_s, clock, level_m)
    row = np.clip(np.searchsorted(clock, times.time_s) - 1, 0, len(clock) - 2)
    longest_s = float(np.diff(clock)[row].max())
    if longest_s > LONG_GAP_S:
        hours = longest_s / 3600.0
        sentence = f"its rows are up to {hours:.1f} h apart; give one each hour."
        warn(tide.name, "tide.sparse", sentence, hours=hours)
    return np.asarray(level - level.mean())


MOST_IMAGES, HEAD_BYTES = 30, 2**17
_ABOVE = re.compile(rb"RelativeAltitude(?:=[\"']|>)\s*([+-]?\d+(?:\.\d*)?)")


def read_altitudes(cameras: File, labels: Sequence[str]) -> FloatArray:
    """Return how high each image was taken above the take-off place, shape (k,), metres.

    NaN where it is not recorded. At most `MOST_IMAGES` images near the camera file are read.
    """
    path, found = Path(cameras), dict[str, float]()
    root = path if path.is_dir() else path.parent
    with suppress(OSError):  # no correction needs them
        inside = [*sorted(root.glob("*")), *sorted(root.glob("images/*"))]
        images = [one for one in inside if one.suffix.lower() in IMAGES and one.is_file()]
        for image in images[:: 1 + len(images) // MOST_IMAGES]:
            with image.open("rb") as stream:
                if above := _ABOVE.search(stream.read(HEAD_BYTES)):
                    found[image.name] = float(above[1])
    altitudes = np.array([*found.values(), np.nan])
    return np.asarray(altitudes[match_labels(labels, list(found))[0]])  # -1 for those without
