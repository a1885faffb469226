"""The tie points: coordinates in reconstruction.json, observations in tracks.csv beside it.

A line of tracks.csv is image, track, feature, x, y and more that differs between the versions
(0 without a header, 1 and 2 with one): scale, colour, segmentation. x and y are image coordinates
divided by the larger side, the origin in the image centre.
"""

from __future__ import annotations

from typing import IO, TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.opensfm.values import mapping, rows
from pcfix.model import TiePoints, Views

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pcfix.io.cameras.opensfm.reconstruction import Reconstruction
    from pcfix.model import FloatArray, IntArray, Lens

HEADER = b"OPENSFM_TRACKS_VERSION"
CHUNK_BYTES = 1 << 24


def read_tie_points(reconstruction: Reconstruction) -> TiePoints:
    """Return the points in the frame of the file, and where its images saw them.

    Raises
    ------
    InputError
        If there are no points or no tracks.csv, or a line of it is damaged.
    """
    path, points = reconstruction.path, reconstruction.points
    if not points:
        raise InputError(f"{path}: has no tie points.")
    tracks = path.with_name("tracks.csv")
    if not tracks.is_file():
        raise InputError(
            f"{path}: there is no tracks.csv beside it, so its tie points have no rays."
        )
    entries = [mapping(path, f"point {k}", v).get("coordinates") for k, v in points.items()]
    xyz = rows(path, "coordinates of a point", entries, 3)
    point, camera, xy = _observations(tracks, list(points), reconstruction.labels)
    order = np.lexsort((camera, point))
    start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(xyz)))])
    views = Views(start.astype(np.int64), camera[order])
    return TiePoints(xyz, views, _pixels(xy[order], camera[order], reconstruction.lenses))


def _observations(
    path: Path, points: list[str], labels: tuple[str, ...]
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return point row, camera row and normalised x, y of every line that has both."""
    point_of = {name.encode(errors="replace"): i for i, name in enumerate(points)}
    camera_of = {name.encode(errors="replace"): i for i, name in enumerate(labels)}
    parts = []
    with path.open("rb") as stream:
        for block in _blocks(stream):
            lines = [line.split(b"\t", 5) for line in block.split(b"\n") if line.strip()]
            if any(len(fields) < 5 for fields in lines):
                short = next(fields for fields in lines if len(fields) < 5)
                raise InputError(
                    f"{path}: the line beginning '{short[0][:40].decode(errors='replace')}' is cut"
                    " off; copy the file again."
                )
            point = np.array([point_of.get(fields[1], -1) for fields in lines], dtype=np.int64)
            camera = np.array([camera_of.get(fields[0], -1) for fields in lines], dtype=np.int64)
            xy = _numbers(path, lines)
            keep = (point >= 0) & (camera >= 0)
            parts.append((point[keep], camera[keep], xy[keep]))
    if not parts:
        raise InputError(f"{path}: is empty.")
    point, camera, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    return point, camera, xy


def _blocks(stream: IO[bytes]) -> Iterator[bytes]:
    """Yield whole lines in blocks, without the header."""
    rest = stream.readline()
    if rest.startswith(HEADER):
        rest = b""
    while chunk := stream.read(CHUNK_BYTES):
        whole, newline, tail = (rest + chunk).rpartition(b"\n")
        if newline:
            yield whole
        rest = tail
    if rest.strip():
        yield rest


def _numbers(path: Path, lines: list[list[bytes]]) -> FloatArray:
    """Return columns x and y."""
    try:
        xy = np.array([float(value) for fields in lines for value in fields[3:5]]).reshape(-1, 2)
    except ValueError as error:
        raise InputError(f"{path}: x or y of an observation is not a number ({error}).") from error
    if not np.isfinite(xy).all():
        raise InputError(f"{path}: x or y of an observation is not finite.")
    return xy


def _pixels(xy: FloatArray, camera: IntArray, lenses: tuple[Lens, ...]) -> FloatArray:
    """Return image positions from the upper left corner, from those divided by the larger side."""
    size = np.array([(lens.width, lens.height) for lens in lenses])[camera]
    return np.asarray(xy * size.max(axis=1, initial=0.0)[:, None] + size / 2.0)
