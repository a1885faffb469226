"""A water level that moves: tide tables, and how high the water stood at each image.

Times with a zone (or Z) are moments; times without one are the readings of one clock that table
and images share. The two cannot be compared, so both must be of one kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_input
from pcfix.io.image_times import seconds_of
from pcfix.io.tables import read_table

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    from pcfix.io.image_times import ImageTimes
    from pcfix.model import FloatArray

LONG_GAP_S = 3600.0
"""Between rows. Half a tide lasts 6.2 h; with an amplitude A of 2 m the chord over one hour is up
to A (2 pi 1 h / 12.4 h)^2 / 8 = 6 cm off, that over two hours 26 cm."""


@dataclass(frozen=True, eq=False)
class TideTable:
    """Water levels over time.

    Attributes
    ----------
    time_s : array, shape (m,)
        Increasing; seconds since 1970, UTC where `zoned`, else of a local clock.
    level_m : array, shape (m,)
        Above any datum, as only differences count.
    zoned : bool
    name : str
    """

    time_s: FloatArray
    level_m: FloatArray
    zoned: bool
    name: str


def read_tide(path: str | os.PathLike[str]) -> TideTable:
    """Read a table with the columns ``time`` (ISO 8601) and ``level_m``.

    Raises
    ------
    InputError
        If a time or level is not one, times do not increase, or some have a zone and some not.
    """
    table = read_table(check_input(path), ["time", "level_m"])
    level = table.numbers("level_m")
    where = [f"line {line}" for line in table.line]
    seconds, zoned = seconds_of(str(path), where, table.column("time"))
    late = np.flatnonzero(np.diff(seconds) <= 0.0)
    if late.size:
        raise InputError(
            f"{path}: line {table.line[late[0] + 1]}: the time is not later than the one before;"
            " sort the rows, and use one zone where clocks are changed."
        )
    if len(level) < 2:
        raise InputError(f"{path}: has one row; a level that moves needs two at least.")
    return TideTable(seconds, np.array(level), zoned, str(path))


def level_offsets(
    tide: TideTable, times: ImageTimes, labels: Sequence[str]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return how much higher than on average the water stood when each image was taken.

    The level is linear between the rows of the table, and beyond its ends for at most as long as
    the two rows there are apart. The average is over the images, each counting once; the surface
    that is given as the water's is that of the average.

    Parameters
    ----------
    tide : TideTable
    times : ImageTimes
        Of k images.
    labels : sequence of str
        Their names, for messages.

    Returns
    -------
    offset_m : array, shape (k,)
        With the mean zero.
    notes : tuple of str

    Raises
    ------
    InputError
        If the table does not cover an image, or zones are given on one side only.
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
