"""A water level that moves: tide tables, when each image was taken, how high the water stood then.

Times with a zone (or Z) are moments; times without one are the readings of one clock that table
and images share. The two cannot be compared, so both must be of one kind.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_input, read_json
from pcfix.io.labels import match_labels
from pcfix.io.tables import read_table
from pcfix.model import FloatArray
from pcfix.options.declare import File

IMAGES = (".jpg", ".jpeg", ".tif", ".tiff", ".png", ".webp", ".heic", ".dng")
_EXIF_DATE = re.compile(r"^(\d{4}):(\d\d):(\d\d)\b")
_DATE_TIME_ORIGINAL, _OFFSET_ORIGINAL, _SUBSECONDS, _EXIF = 0x9003, 0x9011, 0x9291, 0x8769


class ImageTimes(NamedTuple):
    """When k images were taken.

    Seconds since 1970, shape (k,), UTC where `zoned`, else of a local clock; `name` says where the
    times came from.
    """

    time_s: FloatArray
    zoned: bool
    name: str


def read_image_times(path: File, labels: Sequence[str]) -> ImageTimes:
    """Find out when images were taken.

    An `InputError` if the time of an image is not there, or some have a zone and some not.

    Parameters
    ----------
    path : path
        A table with the columns ``label`` and ``time`` (ISO 8601); a folder with the images,
        whose EXIF data has DateTimeOriginal, and OffsetTimeOriginal for the zone; ODM's
        ``images.json`` or ``shots.geojson``, or OpenSfM's ``reconstruction.json``. These last
        count as UTC; where the images' EXIF data states no zone they hold local time.
    labels : sequence of str
        Names of the k images; a folder or an extension may be missing on either side.
    """
    found = Path(path)
    if found.is_dir():
        return _from_exif(found, labels)
    if check_input(found).suffix.lower() in (".json", ".geojson"):
        return _from_json(found, labels)
    table = read_table(found, ["label", "time"])
    row = _rows(table.column("label"), labels, str(path))
    texts, where = table.column("time"), [f"line {table.line[r]}" for r in row]
    return _times(str(path), where, [texts[r] for r in row])


def _from_exif(folder: Path, labels: Sequence[str]) -> ImageTimes:
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in IMAGES)
    if not files:
        raise InputError(f"{folder}: holds no images; give the folder with those of the block.")
    chosen = [files[row] for row in _rows([str(p) for p in files], labels, str(folder))]
    where = [f"image {file.name}" for file in chosen]
    return _times(str(folder), where, [_exif_time(file) for file in chosen])


def _exif_time(file: Path) -> str:
    """Return DateTimeOriginal with fraction and zone, as far as they are there."""
    from PIL import Image

    try:
        with Image.open(file) as image:
            tags = image.getexif().get_ifd(_EXIF)
    except Exception as error:  # of any kind, where a tag has another type than it should
        raise InputError(f"{file}: is not an image that can be read ({error}).") from error
    text = str(tags.get(_DATE_TIME_ORIGINAL, "")).strip("\0 ")
    if not text:
        raise InputError(
            f"{file}: its EXIF data has no DateTimeOriginal; give a CSV table label,time instead."
        )
    fraction = str(tags.get(_SUBSECONDS, "")).strip("\0 ")
    zone = str(tags.get(_OFFSET_ORIGINAL, "")).strip("\0 ")
    return text + (f".{fraction}" if fraction.isdecimal() else "") + zone


def _from_json(path: Path, labels: Sequence[str]) -> ImageTimes:
    try:
        times = {str(name): time_s for name, time_s in _json_times(read_json(path)).items()}
    except (OSError, ValueError, TypeError, AttributeError, LookupError) as error:
        raise InputError(f"{path}: is not a file of OpenDroneMap or OpenSfM ({error}).") from error
    if not times:
        raise InputError(f"{path}: has no times of images; give a CSV table label,time instead.")
    names = list(times)
    chosen = [names[row] for row in _rows(names, labels, str(path))]
    for name in chosen:
        if not 0.0 < times[name] < np.inf:
            raise InputError(f"{path}: does not say when image {name} was taken.")
    return ImageTimes(np.array([times[name] for name in chosen]), True, str(path))


def _json_times(content: Any) -> dict[str, float]:
    """Return seconds since 1970 by image name, of any of the three layouts."""
    if isinstance(content, dict):  # shots.geojson
        shots = [feature["properties"] for feature in content.get("features", ())]
        return {shot["filename"]: float(shot.get("capture_time") or 0.0) for shot in shots}
    if content and "shots" in content[0]:  # reconstruction.json
        shots = [item for part in content for item in part["shots"].items()]
        return {name: float(shot.get("capture_time") or 0.0) for name, shot in shots}
    return {one["filename"]: float(one.get("utc_time") or 0.0) / 1000.0 for one in content}


def _rows(names: Sequence[str], labels: Sequence[str], source: str) -> list[int]:
    """Return for each label the row of its name."""
    rows: list[int] = match_labels(labels, names, one_to_one=False).row.tolist()
    missing = [label for label, row in zip(labels, rows, strict=True) if row < 0]
    if missing:
        raise InputError(
            f"{source}: does not say when image {missing[0]} was taken ({len(missing)} of"
            f" {len(labels)} images are missing, or not told apart by their names)."
        )
    return rows


def _times(source: str, where: Sequence[str], texts: Sequence[str]) -> ImageTimes:
    """Return times that are given as text: all have zones, or none."""
    moments = [_moment(source, at, text) for at, text in zip(where, texts, strict=True)]
    zoned = [moment.tzinfo is not None for moment in moments]
    if any(zoned) != all(zoned):
        odd = zoned.index(not zoned[0])
        raise InputError(
            f"{source}: {where[odd]}: '{texts[odd]}' has {'a' if zoned[odd] else 'no'} zone, others"
            f" have {'none' if zoned[odd] else 'one'}; write all times alike."
        )
    utc = [m if m.tzinfo is not None else m.replace(tzinfo=UTC) for m in moments]
    return ImageTimes(np.array([moment.timestamp() for moment in utc]), zoned[0], source)


def _moment(source: str, where: str, text: str) -> datetime:
    iso = _EXIF_DATE.sub(r"\1-\2-\3", text.strip())
    try:
        moment = datetime.fromisoformat(iso)
    except ValueError:
        moment = None
    if moment is None or len(iso) <= len("2026-05-01"):
        raise InputError(
            f"{source}: {where}: '{text}' is not a date with a time of day as ISO 8601 writes it"
            " (2026-05-01T12:00:00Z)."
        )
    return moment


LONG_GAP_S = 3600.0
"""Between rows. Half a tide lasts 6.2 h; with an amplitude A of 2 m the chord over one hour is up
to A (2 pi 1 h / 12.4 h)^2 / 8 = 6 cm off, that over two hours 26 cm."""


class TideTable(NamedTuple):
    """Water levels, shape (m,), over increasing times as in `ImageTimes`.

    Levels are above any datum, as only differences count.
    """

    time_s: FloatArray
    level_m: FloatArray
    zoned: bool
    name: str


def read_tide(path: File) -> TideTable:
    """Read a table with the columns ``time`` (ISO 8601) and ``level_m``.

    An `InputError` if a time or level is not one, times do not increase, or some have a zone and
    some not.
    """
    table = read_table(check_input(path), ["time", "level_m"])
    level = table.numbers("level_m")
    where = [f"line {line}" for line in table.line]
    times = _times(str(path), where, table.column("time"))
    late = np.flatnonzero(np.diff(times.time_s) <= 0.0)
    if late.size:
        raise InputError(
            f"{path}: line {table.line[late[0] + 1]}: the time is not later than the one before;"
            " sort the rows, and use one zone where clocks are changed."
        )
    if len(level) < 2:
        raise InputError(f"{path}: has one row; a level that moves needs two at least.")
    return TideTable(times.time_s, np.array(level), times.zoned, times.name)


def level_offsets(
    tide: TideTable, times: ImageTimes, labels: Sequence[str]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return how much higher than on average the water stood when each of k images was taken.

    The level is linear between the rows of the table, and beyond its ends for at most as long as
    the two rows there are apart. The average is over the images, each counting once; the surface
    that is given as the water's is that of the average. With the offsets, shape (k,), metres, come
    notes. A table that does not cover an image is an `InputError`, as are zones on one side only.
    """
    if tide.zoned != times.zoned:
        with_zone, without = (tide, times) if tide.zoned else (times, tide)
        raise InputError(
            f"{without.name}: times have no zone, those of {with_zone.name} have one; add the zone"
            " (2026-05-01T12:00:00+02:00, or Z for UTC) to all, or leave it out of all that are"
            " readings of one clock."
        )
    _check_covered(tide, times, labels)
    row = np.clip(np.searchsorted(tide.time_s, times.time_s) - 1, 0, len(tide.time_s) - 2)
    gap_s = np.diff(tide.time_s)[row]
    share = (times.time_s - tide.time_s[row]) / gap_s
    level = tide.level_m[row] + share * np.diff(tide.level_m)[row]
    offset = level - level.mean()
    return offset, _notes(tide, share, gap_s)


def _check_covered(tide: TideTable, times: ImageTimes, labels: Sequence[str]) -> None:
    gaps = np.diff(tide.time_s)
    first, last = tide.time_s[0] - gaps[0], tide.time_s[-1] + gaps[-1]
    outside = np.flatnonzero((times.time_s < first) | (times.time_s > last))
    if outside.size:
        at = outside[0]
        raise InputError(
            f"{tide.name}: covers {_when(tide.time_s[0], tide.zoned)} to"
            f" {_when(tide.time_s[-1], tide.zoned)}, but image {labels[at]} was taken at"
            f" {_when(times.time_s[at], times.zoned)} ({outside.size} of {len(labels)} images are"
            " outside); give a table of that time, and check the zones."
        )


def _when(seconds: float, zoned: bool) -> str:
    moment = datetime.fromtimestamp(float(seconds), UTC).replace(tzinfo=None)
    return moment.isoformat(" ", "seconds") + (" UTC" if zoned else "")


def _notes(tide: TideTable, share: FloatArray, gap_s: FloatArray) -> tuple[str, ...]:
    notes = []
    beyond = int(((share < 0.0) | (share > 1.0)).sum())
    if beyond:
        notes.append(
            f"{tide.name}: {beyond} images were taken before its first or after its last row; the"
            " level goes on in a straight line there."
        )
    longest = float(gap_s.max())
    if longest > LONG_GAP_S:
        notes.append(
            f"{tide.name}: rows are {longest / 3600.0:.1f} h apart about some images; between them"
            " a tide bends by decimetres, so give hourly rows at least."
        )
    return tuple(notes)
