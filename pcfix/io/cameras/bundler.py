"""Bundler's ``bundle.out``, MVE's ``synth_0.out`` and VisualSFM's ``.nvm``: cameras and points.

*Bundler*: N. Snavely, "Bundler v0.4 User's Manual", section "Output format", of files that begin
with ``# Bundle file v0.3`` (https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html).
After the numbers of cameras and points come, for each camera, f k1 k2, R and t, and then the points
with their views (image, feature, x, y). ``X_cam = R X + t`` is in axes x right, y up, z backward.
The image is ``f (1 + k1 r^2 + k2 r^4) (-X_cam / Z_cam)``, x right and y up from the middle of the
frame. f = 0 marks an image without a pose. ``list.txt`` has a name for each camera.

*MVE* ("drews 1.0", https://github.com/simonfuhrmann/mve/wiki/MVE-File-Format) has OpenCV's axes, f
in units of the longer side of the frame, and views (image, feature, nothing).

*VisualSFM*: C. Wu, "VisualSFM: documentation", section "The output format: N-View Match"
(http://ccwu.me/vsfm/doc.html#nvm). The first line can state a fixed calibration, ``FixedK fx cx fy
cy``. Then come models, up to a 0 or the end: a number of cameras, a line for each (name with ``"``
for a space, f, quaternion with the scalar first, projection centre, k, 0), a number of points, a
line for each (x y z, colour, n, then n times image, feature, x, y). A model without points has the
images without a pose. The quaternion is world to camera in OpenCV's axes; ``NVM_V3_R9T`` has R and
t of ``x_cam = R x + t`` instead. The undistorted place is ``(1 + k r^2) m / f`` with r = |m| / f;
m is counted from the principal point, the middle of the frame unless FixedK states another.

OpenSfM and ODM write .nvm files with places from the upper left corner, and scale the shorter side
of the frame by its own length instead of the longer one's. In such a file no place is negative, and
places are far from the projected points, which then show the frame.

None has the sizes of the images: they are those of the images next to the file, or else the
smallest that contain all tie points. The files name no CRS.
"""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Observations, Source, damaged, lens_by_name
from pcfix.io.tables import read_lines
from pcfix.lens.rotations import from_photogrammetric
from pcfix.model import Cameras, FloatArray, TiePoints

CONTENT = r"\A\s*(#\s*Bundle file v0\.3|drews 1\.0|NVM_V3)"
_CAMERA_NUMBERS = 15
_NVM = re.compile(r"NVM_V3(_R9T)?\b(?:\s*FixedK\s+(.*))?")
_BEFORE_VIEWS = 7  # numbers of a point before its views: x, y, z, red, green, blue, count of views
_LARGEST_PX = 1e6


class Model(NamedTuple):
    """The contents of a file: posed cameras without lenses, and points.

    `least_px` is the width and height that contain the tie points of each image, 0 if there are
    none. The views of the `points` have u, v from the principal point, v down.
    """

    cameras: Cameras
    lenses: list[dict[str, float]]  # parameters; f is relative in files of MVE
    least_px: FloatArray
    points: Observations
    is_mve: bool = False
    is_nvm: bool = False


def read(source: Source) -> Cameras:
    """Read the poses of the largest model, and its lenses if sizes are known.

    A size is that of the image, or else of the smallest frame, about the middle, that contains the
    tie points of all images.
    """
    cameras, parameters, least_px, _, is_mve, is_nvm = _model(source)
    folder = source.path.parent
    sizes = np.array([checks.image_size(folder, one) or (0, 0) for one in cameras.labels], float)
    missing = sizes[:, 0] == 0
    if missing.any() and not least_px.any():
        return cameras
    if missing.any():
        width, height = sizes[missing] = least_px.max(axis=0)
        sentence = f"the size of {missing.sum()} images is unknown; {width:.0f} x {height:.0f} px"
        sentence += " is estimated. Put the images next to the file."
        checks.warn(source.path, "cameras.frames_estimated", sentence, size_px=[width, height])
    lens = partial(lens_by_name, relative=is_mve, inverse=is_nvm)
    return replace(cameras, lenses=tuple(map(lens, parameters, *sizes.T.tolist())))


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points of the largest model and where the images saw them."""
    model = _model(source)
    if model.is_mve:
        raise checks.no_tie_points(source.path, "MVE writes no image coordinates")
    middles = [(one.principal_x, one.principal_y) for one in cameras.lenses or ()]
    uv = np.array(middles).reshape(-1, 2)[model.points.camera] + model.points.uv
    return checks.tie_points(model.points._replace(uv=uv))


def _model(source: Source) -> Model:
    """Read a file of Bundler or MVE, or the largest model of a file of VisualSFM."""
    path = source.path
    if _NVM.match(source.text.lstrip()):
        return _read_nvm(path)
    head, *body = read_lines(path)
    is_mve = "drews" in head
    values = np.array(" ".join(body).split(), np.float64)
    count, end = int(values[0]), 2 + _CAMERA_NUMBERS * int(values[0])
    rows = values[2:end].reshape(count, _CAMERA_NUMBERS)
    points = _points(path, values[end:], int(values[1]), count, 3 if is_mve else 4)
    # the names are in the first list next to the file that has one for each image
    own = path.with_name(f"{path.name.removesuffix('.out').removesuffix('.bundle')}.list.txt")
    lists = (own, path.with_name("list.txt"), path.parent.parent / "list.txt")
    named = [list(filter(str.strip, read_lines(place))) for place in lists if place.is_file()]
    kind = "view" if is_mve else "camera"
    unnamed = [f"{kind} {i}" for i in range(count)]
    found = next((some for some in named if len(some) == count), unnamed)
    names = [re.sub(r"\s+0\s+[\d.]+$", "", name.strip()) for name in found]  # no focal length
    rows, points, labels = _posed(path, rows, points, names)
    rotations = checks.rotations(path, labels, rows[:, 3:12])
    centres, least = checks.centres(rotations, rows[:, 12:]), np.zeros((len(rows), 2))
    if not is_mve:
        rotations = from_photogrammetric(rotations)
        points = points._replace(uv=points.uv * (1.0, -1.0))
        least = _least_frames(points, len(rows))
    given = [dict(zip(("f", "k1", "k2"), row, strict=True)) for row in rows[:, :3].tolist()]
    cameras = Cameras(labels, centres, rotations, unposed=tuple(sorted({*names} - {*labels})))
    return Model(cameras, given, least, points, is_mve)


def _posed(
    path: Path, rows: FloatArray, points: Observations, names: list[str]
) -> tuple[FloatArray, Observations, tuple[str, ...]]:
    """Return the rows, the views and the names of images with a pose; the first column is f."""
    has_pose = rows[:, 0] > 0.0
    if not has_pose.any():
        raise checks.no_pose(path)
    number = np.where(has_pose, np.cumsum(has_pose) - 1, -1)
    points = points._replace(camera=number[points.camera])
    return rows[has_pose], points, tuple(names[i] for i in np.flatnonzero(has_pose))


def _least_frames(points: Observations, count: int) -> FloatArray:
    """Return the smallest frames about the principal points that contain all views, (count, 2)."""
    least, is_posed = np.zeros((count, 2)), points.camera >= 0
    np.maximum.at(least, points.camera[is_posed], 2.0 * np.abs(points.uv[is_posed]))
    return least


def _read_nvm(path: Path) -> Model:
    """Read the model with most posed images, of those with points if there are any."""
    head, *lines = [x for line in read_lines(path) if (x := line.strip()) and x[0] != "#"]
    found = _NVM.match(head)
    matrix, stated = found.groups() if found else (None, None)
    width = 15 if matrix else 10
    fixed = dict(zip(("fx", "cx", "fy", "cy"), map(float, (stated or "").split()), strict=False))
    models: list[tuple[list[str], FloatArray, Observations]] = []
    at = 0
    while at < len(lines) and (count := int(lines[at])) > 0:
        listed = [line.rsplit(None, width) for line in lines[at + 1 : at + 1 + count]]
        names = [row[0].strip().strip('"').replace('"', " ") for row in listed]
        numbers = np.array([row[1:] for row in listed], np.float64).reshape(count, width)
        at += 1 + count
        views = int(lines[at])
        values = np.array(" ".join(lines[at + 1 : at + 1 + views]).split(), np.float64)
        models.append((names, numbers, _points(path, values, views, count, 4)))
        at += 1 + views
    if not models:
        raise checks.no_pose(path)
    among = [model for model in models if len(model[2].xyz)] or models
    names, rows, points = max(among, key=lambda model: (model[1][:, 0] > 0.0).sum())
    every = {name for model in models for name in model[0]}
    rows, points, labels = _posed(path, rows, points, names)
    if matrix:
        rotations = checks.rotations(path, labels, rows[:, 1:10])
        centres = checks.centres(rotations, rows[:, 10:13])
    else:
        rotations, centres = checks.quaternions(path, labels, rows[:, 1:5]), rows[:, 5:8]
    if fixed:
        least = np.tile([2.0 * fixed["cx"], 2.0 * fixed["cy"]], (len(rows), 1))
    else:
        rays = points.xyz[points.point] - centres[points.camera]
        x, y, z = np.einsum("nij,nj->in", rotations[points.camera], rays)
        z = np.where((points.camera >= 0) & (z > 0.0), z, np.nan)
        expected = rows[points.camera, :1] * np.column_stack([x / z, y / z])
        points, least = _from_the_middle(points, expected, rows[:, 0])
    given = [{"f": f, "k1": k1} | fixed for f, k1 in rows[:, [0, -2]].tolist()]
    checks.warn_several(path, len(among), len(labels))
    cameras = Cameras(labels, centres, rotations, unposed=tuple(sorted(every - {*labels})))
    return Model(cameras, given, least, points, is_nvm=True)


def _points(path: Path, body: FloatArray, count: int, images: int, width: int) -> Observations:
    """Parse a list of x y z, red green blue, n, and n views of `width` numbers.

    `count` and `images` are the numbers of points and images of the file. The first number of a
    view is its image, from 0; the last two are x and y.
    """
    xyz, parts, at = [], [], 0
    for i in range(count):
        n = int(body[at + _BEFORE_VIEWS - 1]) if at + _BEFORE_VIEWS <= len(body) else -1
        end = at + _BEFORE_VIEWS + width * n
        if n < 0 or end > len(body):
            raise damaged(path, f"it ends at point {i} of {count}")
        xyz.append(body[at : at + 3])
        parts.append(body[at + _BEFORE_VIEWS : end].reshape(n, width))
        at = end
    point = np.repeat(np.arange(count), [len(part) for part in parts])
    views = np.concatenate([np.empty((0, width)), *parts])
    image = views[:, 0].astype(np.int64)
    bad = ~((image >= 0) & (image < images))
    if bad.any():
        raise damaged(path, f"point {point[np.argmax(bad)]} is in image {image[np.argmax(bad)]}")
    return Observations(np.array(xyz).reshape(-1, 3), point, image, views[:, -2:])


def _from_the_middle(
    points: Observations, expected: FloatArray, focal: FloatArray
) -> tuple[Observations, FloatArray]:
    """Return views from the principal point, and the smallest frame of each image.

    `expected` are the places without distortion, `focal` is that of each image.
    """
    image, seen = points.camera, points.uv.copy()
    expected = np.where(np.abs(expected) < _LARGEST_PX, expected, np.nan)
    known = np.isfinite(expected).all(axis=1)
    is_from_corner = ((seen >= 0.0) & (seen < _LARGEST_PX)).all() and known.any()
    # 5 px: more than the median residual of any block, less than half of any frame
    if not (is_from_corner and np.median(np.abs(seen - expected)[known]) > 5.0):
        return points, _least_frames(points, len(focal))
    least = np.zeros((len(focal), 2))
    for f in np.unique(focal[image[known]]):  # OpenSfM's, from the corner
        rows = focal[image] == f
        here = rows & known
        if here.sum() >= 10:
            # seen = side / longer side (expected + longer side / 2); medians tolerate outliers
            half = np.median(seen[here] - expected[here], axis=0).max()
            frame = np.round(2.0 * half * np.median(seen[here] / (expected[here] + half), axis=0))
            seen[rows] = (seen[rows] - frame / 2.0) * frame.max() / frame
            least[focal == f] = frame
    return points._replace(uv=seen), least
