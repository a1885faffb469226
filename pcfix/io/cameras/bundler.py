"""Bundler's ``bundle.out`` and MVE's ``synth_0.out``, which looks like it.

Definition: N. Snavely, "Bundler v0.4 User's Manual", section "Output format", which describes
files that begin with ``# Bundle file v0.3``
(https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html). After the numbers of
cameras and points come, for each camera, f k1 k2, a matrix R and a vector t, and then the points
with their views (image, feature, x, y). ``X_cam = R X + t`` is in axes x right, y up, z backward,
thus the camera looks along -z; the rows of y and z change sign for OpenCV's axes. The image is
``f (1 + k1 r^2 + k2 r^4) (-X_cam / Z_cam)``, x right and y up from the middle of the frame. f = 0
says that an image has no pose.

MVE ("drews 1.0", https://github.com/simonfuhrmann/mve/wiki/MVE-File-Format) has OpenCV's axes, f
in units of the longer side of the frame, and views (image, feature, nothing).

Neither has names or sizes of the images. Names are in ``list.txt``, a line for each camera. Sizes
are taken as `pcfix.io.cameras.tracks` says. The files name no CRS.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.checks import Source
from pcfix.io.tables import read_lines
from pcfix.lens.rotations import from_photogrammetric
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints

_BUNDLER, _MVE = re.compile(r"#\s*Bundle file v(\d+\.\d+)"), re.compile(r"drews 1\.0")
_VERSION = "0.3"
_CAMERA_NUMBERS = 15
_FOCAL_OF_LIST = re.compile(r"\s+0\s+[\d.]+$")


def recognises(source: Source) -> bool:
    """Whether the first line is that of Bundler, of any version, or of MVE."""
    return bool(_BUNDLER.match(source.text) or _MVE.match(source.text))


def read(source: Source) -> Cameras:
    """Read the poses of images with a focal length, and their lenses where sizes are known."""
    path = source.path
    is_mve, listed, posed, points = _read(path)
    names = [f"{'view' if is_mve else 'camera'} {i}" for i in range(len(listed))]
    stem = path.name.removesuffix(".out")
    own = (stem, path.name, stem.removesuffix(".bundle"))
    places = [path.with_name(name) for name in (*(f"{one}.list.txt" for one in own), "list.txt")]
    for place in (path.parent.parent / "list.txt", *places[::-1]):  # the last that fits counts
        if place.is_file():
            lines = [line.strip() for line in read_lines(place) if line.strip()]
            if len(lines) == len(names):
                names = [_FOCAL_OF_LIST.sub("", line) for line in lines]
    labels, rows = tuple(names[i] for i in posed), listed[posed]
    rotations = checks.rotations(path, labels, rows[:, 3:12])
    focal, k1, k2 = rows[:, :3].T
    bounds = np.zeros((len(names), 2))
    if not is_mve:
        np.maximum.at(bounds, points.image, np.abs(points.rest[:, 1:]))
    frames, notes = tracks.frame_sizes(path, labels, focal, 2.0 * bounds[posed])
    lenses = None
    if frames is not None:
        focal = focal * frames.max(axis=1) if is_mve else focal
        numbers = np.column_stack([focal, frames, k1, k2]).tolist()
        lenses = tuple(Lens(f, w, h, w / 2.0, h / 2.0, radial=tuple(k)) for f, w, h, *k in numbers)
    return Cameras(
        labels=labels,
        centres=checks.centres(rotations, rows[:, 12:]),
        rotations=rotations if is_mve else from_photogrammetric(rotations),
        lenses=lenses,
        notes=notes,
        unposed=tuple(np.delete(names, posed).tolist()),
        source="MVE" if is_mve else f"Bundler v{_VERSION}",
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points and where the images saw them."""
    is_mve, _, posed, points = _read(source.path)
    if is_mve:
        raise tracks.no_tie_points(source.path, "MVE writes no image coordinates")
    if not len(points.xyz) or cameras.lenses is None:
        raise tracks.no_tie_points(source.path, "it lists no points")
    return points.seen(posed, cameras, points.rest[:, 1:] * (1.0, -1.0))


def _read(path: Path) -> tuple[bool, FloatArray, IntArray, tracks.PointList]:
    """Return if it is MVE's, f k1 k2 R t of each camera, rows of those with a pose, the points."""
    head, *body = read_lines(path)
    version = _BUNDLER.match(head)
    if version and version[1] != _VERSION:
        what = f"Bundler's format v{version[1]}"
        raise checks.unsupported(path, what, f"Export v{_VERSION}", version=version[1])
    values = np.array(" ".join(body).split(), np.float64)
    count, points = int(values[0]), int(values[1])
    end = 2 + _CAMERA_NUMBERS * count
    listed = tracks.point_list(path, values[end:], points, count, 4 if version else 3)
    cameras = values[2:end].reshape(count, _CAMERA_NUMBERS)
    posed = np.flatnonzero(cameras[:, 0] != 0.0)
    if not len(posed):
        raise checks.no_pose(path, "no image has a pose (all focal lengths are 0)")
    return version is None, cameras, posed, listed
