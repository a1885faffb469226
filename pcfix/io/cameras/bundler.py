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
from typing import NamedTuple

import numpy as np

from pcfix.errors import PcfixWarning
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
    bundle = _read(source.path)
    names, notes = _names(bundle)
    rows = bundle.posed.tolist()
    if not rows:
        raise checks.no_pose(bundle.path, "no image has a pose (all focal lengths are 0)")
    labels, posed = tuple(names[i] for i in rows), bundle.cameras[rows]
    rotations = checks.rotations(bundle.path, labels, posed[:, 3:12])
    lenses, more = _lenses(bundle, labels)
    return Cameras(
        labels=labels,
        centres=-np.einsum("kji,kj->ki", rotations, posed[:, 12:]),
        rotations=rotations if bundle.mve else _UP_BACK_TO_DOWN_FORWARD @ rotations,
        lenses=lenses,
        notes=(*notes, *more),
        unposed=tuple(name for i, name in enumerate(names) if i not in rows),
        source="MVE" if bundle.mve else f"Bundler v{_VERSION}",
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points and where the images saw them."""
    bundle = _read(source.path)
    points = bundle.points
    if bundle.mve:
        raise tracks.no_tie_points(bundle.path, "MVE writes no image coordinates")
    if not len(points.xyz) or cameras.lenses is None:
        raise tracks.no_tie_points(bundle.path, "it lists no points")
    places = points.rest[:, 1:] * (1.0, -1.0)
    return tracks.from_principal_point(points, bundle.posed, cameras, places)


def _read(path: Path) -> Bundle:
    head, _, body = path.read_bytes().decode("utf-8-sig", "replace").partition("\n")
    version = _BUNDLER.match(head)
    if version and version[1] != _VERSION:
        what = f"Bundler's format v{version[1]}"
        raise checks.unsupported(path, what, f"Export v{_VERSION}", version=version[1])
    values = tracks.numbers(body)
    cameras, points = int(values[0]), int(values[1])
    end = 2 + _CAMERA_NUMBERS * cameras
    listed = tracks.point_list(path, values[end:], points, cameras, 4 if version else 3)
    rows = values[2:end].reshape(cameras, _CAMERA_NUMBERS)
    return Bundle(path, version is None, rows, listed)


def _lenses(
    bundle: Bundle, labels: tuple[str, ...]
) -> tuple[tuple[Lens, ...] | None, tuple[PcfixWarning, ...]]:
    focal, k1, k2 = bundle.cameras[bundle.posed, :3].T
    bounds = np.zeros((len(bundle.cameras), 2))
    if not bundle.mve:
        np.maximum.at(bounds, bundle.points.image, np.abs(bundle.points.rest[:, 1:]))
    frames, notes = tracks.frame_sizes(bundle.path, labels, focal, 2.0 * bounds[bundle.posed])
    if frames is None:
        return None, notes
    if bundle.mve:
        focal = focal * frames.max(axis=1)
    rows = np.column_stack([focal, frames, k1, k2]).tolist()
    return tuple(Lens(f, w, h, w / 2.0, h / 2.0, radial=tuple(k)) for f, w, h, *k in rows), notes


def _names(bundle: Bundle) -> tuple[list[str], tuple[PcfixWarning, ...]]:
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
    if len(names) == count:
        return names, ()
    note = PcfixWarning(
        "cameras.list_unused",
        f"{found}: lists {len(names)} images, but {path.name} has {count} cameras. The images are"
        " numbered instead.",
        path=found,
    )
    return numbered, (note,)
