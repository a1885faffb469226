"""Tie points and where the photos saw them, in the document or in a file of their own.

The text is taken apart without a tree of elements: what counts are a few tags, the text after
each, and which Position, Measurement and TiePoint began last before it.
"""

from __future__ import annotations

import re
from pathlib import PureWindowsPath
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.blocksexchange.document import read_bytes
from pcfix.io.cameras.blocksexchange.groups import FIRST_PIXEL
from pcfix.io.cameras.tracks import tie_points

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.blocksexchange.document import TieText
    from pcfix.io.cameras.blocksexchange.groups import Photogroup
    from pcfix.io.cameras.blocksexchange.photos import Rows
    from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, TiePoints

BEGINS = ("TiePoint", "Position", "Measurement")
NAMES = (*BEGINS, "x", "y", "z", "xmm", "ymm", "PhotoId", "SRSId")
CODES = {name: code for code, name in enumerate(NAMES)}
TOKEN = re.compile(f"<({'|'.join(NAMES)})>\\s*([^<]*)")
EXTERNAL = re.compile(rb"<Path>\s*([^<]*?)\s*</Path>")


class Tokens:
    """The tags of a text that count, with the number of the point and measurement each is in."""

    def __init__(self, path: Path, text: str) -> None:
        self.path = path
        found = TOKEN.findall(text)
        self.texts = [word for _, word in found]
        self.code = np.array([CODES[name] for name, _ in found], dtype=np.int8)
        self.point = np.cumsum(self.code == CODES["TiePoint"]) - 1
        self.measurement = np.cumsum(self.code == CODES["Measurement"]) - 1
        begun = np.where(self.code < len(BEGINS), np.arange(len(self.code)), 0)
        self.inside = self.code[np.maximum.accumulate(begun)] if len(begun) else self.code

    def rows(self, name: str, within: str) -> IntArray:
        """Return the rows of a tag inside the latest element of a name."""
        return np.flatnonzero((self.code == CODES[name]) & (self.inside == CODES[within]))

    def numbers(self, names: tuple[str, ...], within: str) -> FloatArray:
        """Return one row per point (within Position) or measurement; NaN where there is none."""
        number = self.point if within == "Position" else self.measurement
        values = np.full((int(number[-1]) + 1 if len(number) else 0, len(names)), np.nan)
        for column, name in enumerate(names):
            rows = self.rows(name, within)
            try:
                values[number[rows], column] = np.array([self.texts[row] for row in rows], float)
            except ValueError as error:
                raise InputError(
                    f"{self.path}: {name} of a tie point: {error}; the file is damaged, export it"
                    " again."
                ) from error
        return values

    def owned(self, name: str, number: IntArray, count: int) -> list[str]:
        """Return the text of a tag in each point or measurement, empty where there is none."""
        texts = [""] * count
        for row in np.flatnonzero((self.code == CODES[name]) & (number >= 0)):
            texts[number[row]] = self.texts[row].strip()
        return texts


def read_ties(path: Path, texts: list[TieText], cameras: Cameras, rows: Rows) -> TiePoints:
    """Read all tie points that a posed photo saw."""
    xyz, point, camera, uv = [np.empty((0, 3))], [], [], [np.empty((0, 2))]
    for block, text in texts:
        where, inside = _text(path, text)
        tokens = Tokens(where, inside)
        positions = _positions(tokens, rows.srs_of_blocks[block], rows.srs)
        if len(positions):
            point.append(len(np.concatenate(xyz)) + _point_of_measurement(tokens))
            xyz.append(positions)
            ids = tokens.owned("PhotoId", tokens.measurement, len(point[-1]))
            camera.append(np.array([rows.of.get((block, name), -1) for name in ids], np.int64))
            uv.append(_places(tokens, camera[-1], [rows.groups.get((block, n)) for n in ids], ids))
    cameras_of_all = np.concatenate([np.empty(0, np.int64), *camera])
    if not (cameras_of_all >= 0).any():
        raise InputError(f"{path}: has no tie points that one of its {len(cameras)} photos saw.")
    points = np.concatenate(point)
    seen, points[cameras_of_all >= 0] = np.unique(points[cameras_of_all >= 0], return_inverse=True)
    return tie_points(np.concatenate(xyz)[seen], points, cameras_of_all, np.concatenate(uv))


def _text(path: Path, text: bytes) -> tuple[Path, str]:
    """Return the text itself, or that of the file beside the document that it names."""
    other = EXTERNAL.search(text)
    if other is None:
        return path, text.decode(errors="replace")
    plain = other[1].decode(errors="replace").replace("\\", "/")
    for place in (path.parent / plain, path.parent / PureWindowsPath(plain).name):
        if place.is_file():
            data = read_bytes(place)
            if not data.rstrip().endswith((b"</TiePoint>", b"</TiePoints>")):
                raise InputError(f"{place}: is cut off; export it again.")
            return place, data.decode(errors="replace")
    raise InputError(f"{path}: its tie points are in {plain}, which is not beside it.")


def _point_of_measurement(tokens: Tokens) -> IntArray:
    return np.asarray(tokens.point[tokens.code == CODES["Measurement"]])


def _positions(tokens: Tokens, srs_of_block: str, srs: str) -> FloatArray:
    """Return the points, NaN without a position or with one in another reference system."""
    xyz = tokens.numbers(("x", "y", "z"), "Position")
    before = (tokens.code == CODES["SRSId"]) & (tokens.point < 0)
    default = next((tokens.texts[row].strip() for row in np.flatnonzero(before)), srs_of_block)
    own = tokens.owned("SRSId", tokens.point, len(xyz))
    other = np.array([(name or default) != srs for name in own], dtype=bool)
    xyz[other] = np.nan
    return xyz


def _places(
    tokens: Tokens, camera: IntArray, groups: list[Photogroup | None], ids: list[str]
) -> FloatArray:
    """Return u, v in pixels from the corner, of places in pixels or in mm."""
    uv = tokens.numbers(("x", "y"), "Measurement") + FIRST_PIXEL
    missing: BoolArray = ~np.isfinite(uv).all(axis=1) & (camera >= 0)
    if missing.any():
        mm = tokens.numbers(("xmm", "ymm"), "Measurement")
        for row in np.flatnonzero(missing):
            uv[row] = _from_mm(mm[row], groups[row])
            if not np.isfinite(uv[row]).all():
                raise InputError(
                    f"{tokens.path}: photo {ids[row]}: a measurement of a tie point has no x and"
                    " y, or is in mm and the photogroup has no pixel size."
                )
    return uv


def _from_mm(mm: FloatArray, group: Photogroup | None) -> FloatArray:
    pixel = None if group is None else group.pixel_size_mm()
    if group is None or pixel is None:
        return np.full(2, np.nan)
    return np.asarray(group.principal_point() + group.axes()[:2, :2] @ mm / pixel)
