"""Image measurements of tie points and control points, and what is known of the points."""

from __future__ import annotations

from pathlib import PurePath
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.pix4d.files import find, read_text
from pcfix.io.cameras.tracks import tie_points as gathered

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.formats import Source
    from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints


class Measured(NamedTuple):
    """Lines of measurements: names of points, cameras (-1: not posed), x and y as text."""

    points: list[str]
    cameras: list[int]
    xy: list[list[str]]
    sensor_mm: list[tuple[str, str]]
    last_line: list[int]


def read_observations(source: Source, cameras: Cameras) -> TiePoints:
    """Read ``tp_bingo.txt``, or ``tp_pix4d.txt`` where there is no other."""
    files = find(source)
    path = None if files is None else files.bingo or files.ties
    if files is None or path is None:
        raise InputError(
            f"{source.path}: has no tp_bingo.txt or tp_pix4d.txt beside it, and so no tie points."
        )
    if cameras.lenses is None:
        raise InputError(f"{path}: its measurements need the lenses, which the cameras lack.")
    measured = _measured(path, _rows(cameras))
    camera = np.array(measured.cameras, dtype=np.int64)
    xy = _finite(path, measured.xy).reshape(-1, 2)
    if path == files.bingo:
        xy = _from_centre_mm(path, xy, measured, camera, cameras.lenses)
    posed = camera >= 0
    names, point = np.unique(np.array(measured.points)[posed], return_inverse=True)
    if len(names) == 0:
        raise InputError(f"{path}: measures nothing in the images that are posed.")
    known = {} if files.gcps is None else _estimated(files.gcps)
    unknown = np.full(3, np.nan)
    xyz = np.array([known.get(name.partition("_")[2], unknown) for name in names.tolist()])
    return gathered(xyz, point, camera[posed], xy[posed])


def _rows(cameras: Cameras) -> dict[str, int]:
    """Return the row of each image by its name, with and without extension."""
    rows = {PurePath(label).stem: i for i, label in reversed(list(enumerate(cameras.labels)))}
    rows.update({label: i for i, label in reversed(list(enumerate(cameras.labels)))})
    return rows


def _measured(path: Path, rows: dict[str, int]) -> Measured:
    """Read the lines: an image (and the size of its sensor), its points, and -99."""
    found = Measured([], [], [], [], [])
    camera, inside = -1, False
    for line in read_text(path).splitlines():
        words = line.split()
        if not words or words[0] == "-99":
            inside = False
        elif not inside:
            camera, inside = _image(line, rows), True
            found.sensor_mm.append(_sensor(words[-1]))
            found.last_line.append(len(found.points))
        elif len(words) in (3, 4):
            found.points.append(words[0])
            found.cameras.append(camera)
            found.xy.append(words[1:3])
        else:
            raise InputError(
                f"{path}: '{line.strip()[:60]}' is not a point and its x and y; the file is"
                " damaged, export it again."
            )
    return found


def _image(line: str, rows: dict[str, int]) -> int:
    """Return the row of the image that a line names, with or without a sensor after it."""
    text = line.strip()
    return rows.get(text, rows.get(text.rpartition(" ")[0].strip(), -1))


def _sensor(word: str) -> tuple[str, str]:
    """Return width and height out of a word like H_23.52_15.68."""
    parts = word.split("_")
    return (parts[-2], parts[-1]) if len(parts) >= 3 else ("nan", "nan")


def _finite(path: Path, words: list[list[str]] | list[tuple[str, str]]) -> FloatArray:
    try:
        return np.array(words, dtype=float)
    except ValueError as error:
        raise InputError(f"{path}: {error}; the file is damaged, export it again.") from error


def _from_centre_mm(
    path: Path, xy: FloatArray, measured: Measured, camera: IntArray, lenses: tuple[Lens, ...]
) -> FloatArray:
    """Turn mm from the image centre, y up, into the unit of the lens from the upper left."""
    lengths = np.diff([*measured.last_line, len(xy)])
    sensor = np.repeat(_finite(path, measured.sensor_mm).reshape(-1, 2), lengths, axis=0)
    frame = np.array([(lens.width, lens.height) for lens in lenses])[camera]
    if not (sensor[camera >= 0] > 0.0).all():
        raise InputError(f"{path}: the line of an image lacks its sensor size H_width_height.")
    return np.asarray(frame / 2.0 + xy * np.array([1.0, -1.0]) * frame / sensor)


def _estimated(path: Path) -> dict[str, FloatArray]:
    """Read where the adjustment placed the control points, by their labels."""
    lines = [line.split(",") for line in read_text(path).splitlines()[1:] if line.strip()]
    if any(len(fields) < 7 for fields in lines):
        raise InputError(f"{path}: a line has fewer than 7 fields; the file is damaged.")
    return {fields[0].strip(): _finite(path, [fields[4:7]])[0] for fields in lines}
