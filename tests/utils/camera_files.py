"""Read camera files as a user does; what they warn of stays in their notes."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import pcfix
from pcfix.io.cameras import FORMATS, read_tie_points
from pcfix.io.cameras.formats import Source

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import Cameras, TiePoints


def read(path: Path, *args: Any, **options: Any) -> Cameras:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pcfix.PcfixWarning)
        return pcfix.read_cameras(path, *args, **options)


def read_ties(path: Path) -> TiePoints:
    return read_tie_points(path, read(path))


def notes(cameras: Cameras) -> list[str]:
    """Return the codes of what was noted on reading."""
    return [note.code for note in cameras.notes]


def is_of(path: Path, reader: Any) -> bool:
    """Whether a reader is the first of all that knows a file."""
    found = (form.reader for form in FORMATS if _knows(form.reader, Source(path)))
    return next(found, None) is reader


def _knows(reader: Any, source: Source) -> bool:
    try:
        return bool(reader.recognises(source))
    except Exception:  # of a damaged file, which read_cameras passes on to the next reader
        return False
