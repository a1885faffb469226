"""VisualSFM's N-view match files, ``NVM_V3``.

Definition: C. Wu, "VisualSFM: documentation", section "The output format: N-View Match"
(http://ccwu.me/vsfm/doc.html#nvm). The first line may go on with the calibration that was held,
``FixedK fx cx fy cy``. Then come models: a number of cameras, a line for each (name, f, quaternion
with the scalar first, projection centre, k, 0), a number of points, a line for each (x y z, colour,
n, then n times image, feature, x, y). A model without points holds the images that have no pose.
A 0 or the end of the file ends the models. In names, ``"`` stands for a space.

The quaternion is world to camera in OpenCV's axes. ``NVM_V3_R9T`` has the matrix and the
translation of ``x_cam = R x + t`` instead (``pba/src/pba/util.h`` of Multicore Bundle Adjustment).
k is of the measured place: ``(1 + k r^2) m / f`` is the undistorted one, with ``r = |m| / f``.
Measured places m are counted from the principal point, which is the middle of the frame unless
FixedK says otherwise, x right, y down.

OpenSfM and ODM write files of this form with places from the upper left corner, and scale the
shorter side of the frame by its own length instead of the longer one's. Such a file is recognised
by places none of which is negative and which are far from where the points project. The middle of
its frame, and whether the shorter side is squeezed, then follow from the points themselves.

Sizes of the images are taken as `pcfix.io.cameras.tracks` says. The files name no CRS.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.checks import Source
from pcfix.io.tables import read_lines
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints

_HEAD = re.compile(r"NVM_V3(_R9T)?\b(?:\s*FixedK\s+(.*))?")
_QUATERNION_NUMBERS, _MATRIX_NUMBERS = 10, 15
_FAR_PX = 5.0
"""Larger than a median residual that any block has, smaller than half of any frame."""
_LARGEST_PX = 1e6
_LEAST_VIEWS = 10
"""Views of one camera from which the middle of its frame is estimated."""


class Model(NamedTuple):
    """A model of the file: names, a row of numbers for each camera, points, FixedK or nothing."""

    names: list[str]
    rows: FloatArray
    points: tracks.PointList
    fixed: tuple[float, ...] | None

    @property
    def posed(self) -> IntArray:
        """Row numbers of the cameras with a focal length, so with a pose."""
        return np.flatnonzero(self.rows[:, 0] > 0.0)


def recognises(source: Source) -> bool:
    """Whether the first word is that of the format."""
    return _HEAD.match(source.text.lstrip()) is not None


def read(source: Source) -> Cameras:
    """Read the poses and lenses of the largest model."""
    path = source.path
    model, models = _largest(path)
    labels = tuple(model.names[i] for i in model.posed)
    rotations, centres = _poses(path, model)
    rows, smallest = model.rows[model.posed], _placed(path, model)[1][model.posed]
    frames, notes = tracks.frame_sizes(path, labels, rows[:, 0], smallest)
    lenses = []
    for row, (w, h) in zip(rows.tolist(), () if frames is None else frames.tolist(), strict=False):
        fx, cx, fy, cy = (row[0], w / 2.0, row[0], h / 2.0) if model.fixed is None else model.fixed
        lenses.append(Lens(fy, w, h, cx, cy, b1=fx - fy, radial=(row[-2],), inverse=True))
    with_points = sum(len(one.points.xyz) > 0 for one in models) or len(models)
    if with_points > 1:
        notes = (checks.several(path, with_points, len(labels)), *notes)
    everything = dict.fromkeys(name for one in models for name in one.names)
    return Cameras(
        labels=labels,
        centres=centres,
        rotations=rotations,
        lenses=tuple(lenses) or None,
        notes=notes,
        unposed=tuple(name for name in everything if name not in set(labels)),
        source="VisualSFM",
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points of the largest model and where the images saw them."""
    model, _ = _largest(source.path)
    if not len(model.points.image) or cameras.lenses is None:
        raise tracks.no_tie_points(source.path, "it lists no points")
    return model.points.seen(model.posed, cameras, _placed(source.path, model)[0])


def _largest(path: Path) -> tuple[Model, list[Model]]:
    """Return the model with most posed images, of those with points if there are any, and all."""
    head, *lines = [x for line in read_lines(path) if (x := line.strip()) and x[0] != "#"]
    found = _HEAD.match(head)
    matrix, held = found.groups() if found else (None, None)
    width = _MATRIX_NUMBERS if matrix else _QUATERNION_NUMBERS
    fixed = tuple(map(float, held.split()[:4])) if held else None
    models = []
    at = 0
    while at < len(lines) and (count := int(lines[at])) > 0:
        rows = [line.rsplit(None, width) for line in lines[at + 1 : at + 1 + count]]
        names = [row[0].strip().strip('"').replace('"', " ") for row in rows]
        numbers = np.array([row[1:] for row in rows], np.float64).reshape(count, width)
        at += 1 + count
        points = int(lines[at])
        values = np.array(" ".join(lines[at + 1 : at + 1 + points]).split(), np.float64)
        listed = tracks.point_list(path, values, points, count, 4)
        models.append(Model(names, numbers, listed, fixed))
        at += 1 + points
    if not models:
        raise checks.no_pose(path, "has no model")
    with_points = [model for model in models if len(model.points.xyz)]
    largest = max(with_points or models, key=lambda model: len(model.posed))
    if not len(largest.posed):
        raise checks.no_pose(path, "no image has a pose (all focal lengths are 0)")
    return largest, models


def _poses(path: Path, model: Model) -> tuple[FloatArray, FloatArray]:
    """Return rotations and projection centres of the posed cameras."""
    rows, labels = model.rows[model.posed], [model.names[i] for i in model.posed]
    if rows.shape[1] == _QUATERNION_NUMBERS:
        return checks.quaternions(path, labels, rows[:, 1:5]), rows[:, 5:8]
    rotations = checks.rotations(path, labels, rows[:, 1:10])
    return rotations, checks.centres(rotations, rows[:, 10:13])


def _placed(path: Path, model: Model) -> tuple[FloatArray, FloatArray]:
    """Return the places of views from the principal point, and the least frame of each image."""
    image, seen = model.points.image, model.points.rest[:, 1:].copy()
    least = np.zeros((len(model.rows), 2))
    if model.fixed is not None:
        least[:] = 2.0 * np.array(model.fixed[1::2])
        return seen, least
    in_frame = len(seen) and ((seen >= 0.0) & (seen < _LARGEST_PX)).all()
    expected = np.full_like(seen, np.nan)
    if in_frame:  # where points project without distortion
        row_of = np.full(len(model.rows), -1)
        row_of[model.posed] = np.arange(len(model.posed))
        rotations, centres = _poses(path, model)
        row = row_of[image]
        rays = model.points.xyz[model.points.point] - centres[row]
        x, y, z = np.einsum("nij,nj->in", rotations[row], rays)
        z = np.where((row >= 0) & (z > 0.0), z, np.nan)
        places = model.rows[image, 0][:, None] * np.column_stack([x / z, y / z])
        expected = np.where(np.abs(places) < _LARGEST_PX, places, np.nan)
    apart = np.abs(seen - expected)
    if np.isfinite(apart).any() and np.nanmedian(apart) > _FAR_PX:  # OpenSfM's, from the corner
        for focal in np.unique(model.rows[model.posed, 0]):
            rows = model.rows[image, 0] == focal
            if np.isfinite(expected[rows]).all(axis=1).sum() >= _LEAST_VIEWS:
                squeeze, frame = _squeeze_and_frame(expected[rows], seen[rows])
                seen[rows] = (seen[rows] - frame / 2.0) / squeeze
                least[model.rows[:, 0] == focal] = frame
    else:
        np.maximum.at(least, image, 2.0 * np.abs(seen))
    return seen, least


def _squeeze_and_frame(expected: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit seen = squeeze x expected + frame / 2 on each axis, the second time without outliers.

    The frame is whole pixels, and the squeeze is 1 or its sides in units of the longer one,
    whichever is nearer.
    """
    slopes, offsets = np.empty((2, 2))
    there = np.isfinite(expected).all(axis=1)
    for axis, (e, s) in enumerate(zip(expected[there].T, seen[there].T, strict=True)):
        good = np.full(len(e), True)
        for _ in range(2):
            offsets[axis], slopes[axis] = np.polynomial.polynomial.polyfit(e[good], s[good], 1)
            apart = np.abs(s - slopes[axis] * e - offsets[axis])
            good = apart <= 3.0 * np.median(apart)
    frame = np.round(2.0 * offsets)
    squeeze = frame / frame.max()
    nearer = np.abs(slopes - squeeze) < np.abs(slopes - 1.0)
    return np.where(nearer, squeeze, 1.0), frame
