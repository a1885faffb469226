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
are taken as `pcfix.io.cameras.tracks` says. The CRS is not told.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError, NoTiePointsError
from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.formats import Source
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints

_BUNDLER, _MVE = re.compile(r"#\s*Bundle file v(\d+\.\d+)"), re.compile(r"drews 1\.0")
_VERSION = "0.3"
_CAMERA_NUMBERS = 15
_UP_BACK_TO_DOWN_FORWARD = np.diag([1.0, -1.0, -1.0])
_FOCAL_OF_LIST = re.compile(r"\s+0\s+[\d.]+$")


class Bundle(NamedTuple):
    """The file: a row of f k1 k2 R t for each camera, and the points."""

    path: Path
    mve: bool
    cameras: FloatArray
    points: tracks.PointList

    @property
    def posed(self) -> IntArray:
        """Row numbers of the cameras with a pose."""
        return np.flatnonzero(self.cameras[:, 0] != 0.0)


def recognises(source: Source) -> bool:
    """Whether the first line is that of Bundler, of any version, or of MVE."""
    return bool(_BUNDLER.match(source.text) or _MVE.match(source.text))


def read(source: Source) -> Cameras:
    """Read the poses of images with a focal length, and their lenses where sizes are known."""
    bundle = _read(source)
    names, notes = _names(bundle)
    posed = bundle.posed.tolist()
    if not posed:
        raise InputError(f"{bundle.path}: no image has a pose (all focal lengths are 0).")
    poses = [_pose(bundle, names[i], bundle.cameras[i]) for i in posed]
    rotations, centres = zip(*poses, strict=True)
    labels, rows = tuple(names[i] for i in posed), set(posed)
    lenses, more = _lenses(bundle, labels)
    return Cameras(
        labels=labels,
        centres=np.array(centres),
        rotations=np.array(rotations),
        lenses=lenses,
        notes=(*notes, *more),
        unposed=tuple(name for i, name in enumerate(names) if i not in rows),
        source="MVE" if bundle.mve else f"Bundler v{_VERSION}",
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points and where the images saw them."""
    bundle = _read(source)
    points = bundle.points
    if bundle.mve:
        raise NoTiePointsError(f"{bundle.path}: MVE writes no image coordinates; no tie points.")
    if not len(points.xyz) or cameras.lenses is None:
        raise NoTiePointsError(f"{bundle.path}: has no points; no tie points.")
    places = points.rest[:, 1:] * (1.0, -1.0)
    return tracks.from_principal_point(points, bundle.posed, cameras, places)


def _read(source: Source) -> Bundle:
    path = source.path
    head, _, body = path.read_bytes().decode("utf-8-sig", "replace").partition("\n")
    version = _BUNDLER.match(head)
    if version and version[1] != _VERSION:
        raise InputError(
            f"{path}: is of Bundler's format v{version[1]}, which pcfix does not read; export"
            f" v{_VERSION}."
        )
    values = tracks.numbers(path, body)
    counts = values[:2]
    whole = np.isfinite(counts) & (counts >= 0) & (counts == np.floor(counts))
    if len(counts) < 2 or not whole.all():
        raise InputError(f"{path}: line 2 must give the numbers of cameras and points.")
    cameras, points = (int(count) for count in counts)
    end = 2 + _CAMERA_NUMBERS * cameras
    if end > len(values) or cameras == 0:
        raise InputError(
            f"{path}: is cut off: it announces {cameras} cameras, but there are"
            f" {(len(values) - 2) // _CAMERA_NUMBERS}; export it again."
        )
    width = 4 if version else 3
    listed = tracks.point_list(path, values[end:], points, cameras, width)
    rows = values[2:end].reshape(cameras, _CAMERA_NUMBERS)
    return Bundle(path, version is None, rows, listed)


def _pose(bundle: Bundle, name: str, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation, in OpenCV's axes, and projection centre."""
    matrix = checks.rotation(bundle.path, name, numbers[3:12].reshape(3, 3))
    centre = -matrix.T @ numbers[12:]
    if not np.isfinite(centre).all():
        raise InputError(f"{bundle.path}: image {name}: its position is not finite.")
    return (matrix if bundle.mve else _UP_BACK_TO_DOWN_FORWARD @ matrix), centre


def _lenses(
    bundle: Bundle, labels: tuple[str, ...]
) -> tuple[tuple[Lens, ...] | None, tuple[str, ...]]:
    focal, k1, k2 = bundle.cameras[bundle.posed, :3].T
    bounds = np.zeros((len(bundle.cameras), 2))
    if not bundle.mve:
        np.maximum.at(bounds, bundle.points.image, np.abs(bundle.points.rest[:, 1:]))
    frames, notes = tracks.frame_sizes(bundle.path, labels, focal, 2.0 * bounds[bundle.posed])
    if frames is None:
        return None, notes
    if bundle.mve:
        focal = focal * frames.max(axis=1)
    lenses = []
    rows = np.column_stack([focal, frames, k1, k2]).tolist()
    for label, (f, w, h, *radial) in zip(labels, rows, strict=True):
        lens = Lens(f, w, h, w / 2.0, h / 2.0, radial=tuple(radial))
        lenses.append(checks.lens(bundle.path, f"of image {label}", lens))
    return tuple(lenses), notes


def _names(bundle: Bundle) -> tuple[list[str], tuple[str, ...]]:
    """Return the names of all images, from the list beside the file if it fits."""
    path, count = bundle.path, len(bundle.cameras)
    stem = path.name.removesuffix(".out")
    own = (f"{stem}.list.txt", f"{path.name}.list.txt", f"{stem.removesuffix('.bundle')}.list.txt")
    places = [path.with_name(name) for name in (*own, "list.txt")]
    found = next((p for p in (*places, path.parent.parent / "list.txt") if p.is_file()), None)
    numbered = [f"{'view' if bundle.mve else 'camera'} {i}" for i in range(count)]
    if found is None:
        return numbered, ()
    lines = found.read_bytes().decode("utf-8-sig", "replace").splitlines()
    names = [_FOCAL_OF_LIST.sub("", line.strip()) for line in lines if line.strip()]
    if len(names) != count:
        return numbered, (
            f"{found}: lists {len(names)} images, but {path.name} has {count} cameras; the images"
            " are numbered instead.",
        )
    return names, ()
