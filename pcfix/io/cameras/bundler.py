"""Bundler's ``bundle.out``, MVE's ``synth_0.out`` and VisualSFM's ``.nvm``: cameras and points.

*Bundler*: N. Snavely, "Bundler v0.4 User's Manual", section "Output format", which describes files
that begin with ``# Bundle file v0.3``
(https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html). After the numbers of
cameras and points come, for each camera, f k1 k2, a matrix R and a vector t, and then the points
with their views (image, feature, x, y). ``X_cam = R X + t`` is in axes x right, y up, z backward,
thus the camera looks along -z; the rows of y and z change sign for OpenCV's axes. The image is
``f (1 + k1 r^2 + k2 r^4) (-X_cam / Z_cam)``, x right and y up from the middle of the frame. f = 0
says that an image has no pose. Names are in ``list.txt``, a line for each camera.

*MVE* ("drews 1.0", https://github.com/simonfuhrmann/mve/wiki/MVE-File-Format) has OpenCV's axes, f
in units of the longer side of the frame, and views (image, feature, nothing).

*VisualSFM*: C. Wu, "VisualSFM: documentation", section "The output format: N-View Match"
(http://ccwu.me/vsfm/doc.html#nvm). The first line may go on with the calibration that was held,
``FixedK fx cx fy cy``. Then come models: a number of cameras, a line for each (name, f, quaternion
with the scalar first, projection centre, k, 0), a number of points, a line for each (x y z, colour,
n, then n times image, feature, x, y). A model without points holds the images that have no pose.
A 0 or the end of the file ends the models. In names, ``"`` stands for a space. The quaternion is
world to camera in OpenCV's axes; ``NVM_V3_R9T`` has the matrix and the translation of
``x_cam = R x + t`` instead (``pba/src/pba/util.h`` of Multicore Bundle Adjustment). k is of the
measured place: ``(1 + k r^2) m / f`` is the undistorted one, with ``r = |m| / f``. Measured places
m are counted from the principal point, which is the middle of the frame unless FixedK says
otherwise, x right, y down.

OpenSfM and ODM write .nvm files with places from the upper left corner, and scale the shorter side
of the frame by its own length instead of the longer one's. Such a file is recognised by places none
of which is negative and which are far from where the points project. The middle of its frame, and
whether the shorter side is squeezed, then follow from the points themselves.

None has the sizes of the images: they are those of the images beside the file, or else the smallest
that hold all tie points. The files name no CRS.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Seen, Source, damaged, note
from pcfix.io.cameras.lenses import lens_by_name
from pcfix.io.tables import read_lines
from pcfix.lens.rotations import from_photogrammetric
from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, TiePoints

_BUNDLER, _MVE = re.compile(r"#\s*Bundle file v(\d+\.\d+)"), re.compile(r"drews 1\.0")
_VERSION = "0.3"
_CAMERA_NUMBERS = 15
_FOCAL_OF_LIST = re.compile(r"\s+0\s+[\d.]+$")
_NVM = re.compile(r"NVM_V3(_R9T)?\b(?:\s*FixedK\s+(.*))?")
_QUATERNION_NUMBERS, _MATRIX_NUMBERS = 10, 15
_BEFORE_VIEWS = 7
"""Numbers of a point before its views: x, y, z, red, green, blue, count of views."""
_FAR_PX = 5.0
"""Larger than a median residual that any block has, smaller than half of any frame."""
_LARGEST_PX = 1e6
_LEAST_VIEWS = 10
"""Views of one camera from which the middle of its frame is estimated."""


class Model(NamedTuple):
    """A model of a file.

    `names` are those of all images, `posed` the rows of those with a pose, which the other arrays
    are of: `lenses` has f, k1, k2, where f is of the longer side of the frame in files of MVE, and
    `least_px` the width and height that hold the tie points, 0 where there are none. The views of
    the `points` have rows of all images for cameras, and u, v from the principal point, v down.
    """

    software: str
    names: list[str]
    posed: IntArray
    rotations: FloatArray
    centres: FloatArray
    lenses: FloatArray
    least_px: FloatArray
    points: Seen
    held: dict[str, float]  # FixedK
    elsewhere: tuple[str, ...] = ()  # images of other models
    notes: tuple[PcfixWarning, ...] = ()


def recognises(source: Source) -> bool:
    """Whether the first line is that of Bundler, of any version, of MVE or VisualSFM."""
    text = source.text.lstrip()
    return any(form.match(text) for form in (_BUNDLER, _MVE, _NVM))


def read(source: Source) -> Cameras:
    """Read the poses of the largest model, and its lenses where sizes are known."""
    path, model = source.path, _read(source)
    labels = tuple(model.names[i] for i in model.posed)
    frames, notes = _frame_sizes(path, labels, model.least_px)
    lenses = []
    for (f, k1, k2), (w, h) in zip(model.lenses.tolist(), frames.tolist(), strict=False):
        given = {"f": f * max(w, h) if model.software == "MVE" else f, "k1": k1, "k2": k2}
        is_inverse = model.software == "VisualSFM"
        lenses.append(lens_by_name(given | model.held, w, h, inverse=is_inverse))
    everything = dict.fromkeys((*model.elsewhere, *model.names))
    return Cameras(
        labels=labels,
        centres=model.centres,
        rotations=model.rotations,
        lenses=tuple(lenses) or None,
        notes=(*model.notes, *notes),
        unposed=tuple(name for name in everything if name not in set(labels)),
        source=model.software,
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points of the largest model and where the images saw them."""
    model = _read(source)
    if model.software == "MVE":
        raise checks.no_tie_points(source.path, "MVE writes no image coordinates")
    row = np.full(len(model.names), -1)
    row[model.posed] = np.arange(len(cameras))
    camera = row[model.points.camera]
    middles = [(one.principal_x, one.principal_y) for one in cameras.lenses or ()]
    uv = np.array(middles).reshape(-1, 2)[camera] + model.points.uv
    return checks.tie_points(model.points._replace(camera=camera, uv=uv))


def _read(source: Source) -> Model:
    is_nvm = _NVM.match(source.text.lstrip()) is not None
    return (_read_nvm if is_nvm else _read_bundler)(source.path)


def _read_bundler(path: Path) -> Model:
    """Read a file of Bundler or MVE."""
    head, *body = read_lines(path)
    version = _BUNDLER.match(head)
    if version and version[1] != _VERSION:
        what = f"Bundler's format v{version[1]}"
        raise checks.unsupported(path, what, f"Export v{_VERSION}", version=version[1])
    values = np.array(" ".join(body).split(), np.float64)
    count, end = int(values[0]), 2 + _CAMERA_NUMBERS * int(values[0])
    points = _points(path, values[end:], int(values[1]), count, 4 if version else 3)
    names = _listed_names(path, count)
    if not names:
        names = [f"{'camera' if version else 'view'} {i}" for i in range(count)]
    rows = values[2:end].reshape(count, _CAMERA_NUMBERS)
    posed = _posed(path, rows[:, 0] != 0.0)
    rows = rows[posed]
    rotations = checks.rotations(path, [names[i] for i in posed], rows[:, 3:12])
    centres, least = checks.centres(rotations, rows[:, 12:]), np.zeros((count, 2))
    if version:
        rotations = from_photogrammetric(rotations)
        points = points._replace(uv=points.uv * (1.0, -1.0))
        np.maximum.at(least, points.camera, 2.0 * np.abs(points.uv))
    software = f"Bundler v{_VERSION}" if version else "MVE"
    return Model(software, names, posed, rotations, centres, rows[:, :3], least[posed], points, {})


def _posed(path: Path, has_focal: BoolArray) -> IntArray:
    """Return the rows of images with a pose."""
    if not has_focal.any():
        raise checks.no_pose(path, "no image has a pose (all focal lengths are 0)")
    return np.flatnonzero(has_focal)


def _listed_names(path: Path, count: int) -> list[str]:
    """Return the names in the first list next to a file that has one for each image."""
    stem = path.name.removesuffix(".out")
    own = (f"{one}.list.txt" for one in (stem, path.name, stem.removesuffix(".bundle")))
    for place in (*map(path.with_name, (*own, "list.txt")), path.parent.parent / "list.txt"):
        if place.is_file():
            lines = [line.strip() for line in read_lines(place) if line.strip()]
            if len(lines) == count:
                return [_FOCAL_OF_LIST.sub("", line) for line in lines]
    return []


def _read_nvm(path: Path) -> Model:
    """Read the model with most posed images, of those with points if there are any."""
    head, *lines = [x for line in read_lines(path) if (x := line.strip()) and x[0] != "#"]
    found = _NVM.match(head)
    matrix, held = found.groups() if found else (None, None)
    width = _MATRIX_NUMBERS if matrix else _QUATERNION_NUMBERS
    fixed = dict(zip(("fx", "cx", "fy", "cy"), map(float, (held or "").split()), strict=False))
    models: list[tuple[list[str], FloatArray, Seen]] = []
    at = 0
    while at < len(lines) and (count := int(lines[at])) > 0:
        cameras = [line.rsplit(None, width) for line in lines[at + 1 : at + 1 + count]]
        names = [row[0].strip().strip('"').replace('"', " ") for row in cameras]
        numbers = np.array([row[1:] for row in cameras], np.float64).reshape(count, width)
        at += 1 + count
        views = int(lines[at])
        values = np.array(" ".join(lines[at + 1 : at + 1 + views]).split(), np.float64)
        models.append((names, numbers, _points(path, values, views, count, 4)))
        at += 1 + views
    if not models:
        raise checks.no_pose(path, "has no model")
    among = [model for model in models if len(model[2].xyz)] or models
    names, rows, points = max(among, key=lambda model: (model[1][:, 0] > 0.0).sum())
    posed = _posed(path, rows[:, 0] > 0.0)
    labels, own = [names[i] for i in posed], rows[posed]
    if matrix:
        rotations = checks.rotations(path, labels, own[:, 1:10])
        centres = checks.centres(rotations, own[:, 10:13])
    else:
        rotations, centres = checks.quaternions(path, labels, own[:, 1:5]), own[:, 5:8]
    least = np.zeros((len(rows), 2))
    if fixed:
        least[:] = 2.0 * fixed["cx"], 2.0 * fixed["cy"]
    else:
        row = np.full(len(rows), -1)
        row[posed] = np.arange(len(posed))
        row = row[points.camera]
        x, y, z = np.einsum("nij,nj->in", rotations[row], points.xyz[points.point] - centres[row])
        z = np.where((row >= 0) & (z > 0.0), z, np.nan)
        expected = rows[points.camera, :1] * np.column_stack([x / z, y / z])
        points, least = _from_the_middle(points, expected, rows[:, 0])
    lenses = np.column_stack([own[:, 0], own[:, -2], np.zeros(len(own))])
    return Model(
        *("VisualSFM", names, posed, rotations, centres, lenses, least[posed], points, fixed),
        elsewhere=tuple(name for model in models for name in model[0]),
        notes=(checks.several(path, len(among), len(labels)),) if len(among) > 1 else (),
    )


def _points(path: Path, body: FloatArray, count: int, images: int, width: int) -> Seen:
    """Take apart a list of x y z, red green blue, n, and n views of `width` numbers.

    `count` is the number of points that the file announces, `images` that of its images, which the
    first number of a view counts from 0; its last two are x and y.
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
    return Seen(np.array(xyz).reshape(-1, 3), point, image, views[:, -2:])


def _from_the_middle(
    points: Seen, expected: FloatArray, focal: FloatArray
) -> tuple[Seen, FloatArray]:
    """Return views from the principal point, and the least frame of each of the images.

    `expected` are the places without distortion, `focal` is that of each image.
    """
    image, seen, least = points.camera, points.uv.copy(), np.zeros((len(focal), 2))
    expected = np.where(np.abs(expected) < _LARGEST_PX, expected, np.nan)
    known = np.isfinite(expected).all(axis=1)
    is_from_corner = ((seen >= 0.0) & (seen < _LARGEST_PX)).all() and known.any()
    if not (is_from_corner and np.median(np.abs(seen - expected)[known]) > _FAR_PX):
        np.maximum.at(least, image, 2.0 * np.abs(seen))
        return points, least
    for f in np.unique(focal[image[known]]):  # OpenSfM's, from the corner
        rows = focal[image] == f
        if (rows & known).sum() >= _LEAST_VIEWS:
            squeeze, frame = _squeeze_and_frame(expected[rows & known], seen[rows & known])
            seen[rows] = (seen[rows] - frame / 2.0) / squeeze
            least[focal == f] = frame
    return points._replace(uv=seen), least


def _squeeze_and_frame(expected: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit seen = squeeze x expected + frame / 2 on each axis, the second time without outliers.

    The frame is whole pixels, and the squeeze is 1 or its sides in units of the longer one,
    whichever is nearer.
    """
    slopes, offsets = np.empty((2, 2))
    for axis, (e, s) in enumerate(zip(expected.T, seen.T, strict=True)):
        good = np.full(len(e), True)
        for _ in range(2):
            offsets[axis], slopes[axis] = np.polynomial.polynomial.polyfit(e[good], s[good], 1)
            apart = np.abs(s - slopes[axis] * e - offsets[axis])
            good = apart <= 3.0 * np.median(apart)
    frame = np.round(2.0 * offsets)
    squeeze = frame / frame.max()
    nearer = np.abs(slopes - squeeze) < np.abs(slopes - 1.0)
    return np.where(nearer, squeeze, 1.0), frame


def _frame_sizes(
    path: Path, labels: tuple[str, ...], least_px: FloatArray
) -> tuple[FloatArray, tuple[PcfixWarning, ...]]:
    """Return width and height of images, from the images themselves or from their tie points.

    Where an image cannot be opened, its frame is the smallest that holds the tie points of all
    images, about the middle of the frame. Where neither is known there are no sizes.
    """
    sizes = np.array([checks.image_size(path.parent, one) or (0, 0) for one in labels], float)
    missing = sizes[:, 0] == 0
    if not missing.any():
        return sizes, ()
    if not least_px.any():
        return np.empty((0, 2)), ()
    first = sizes[missing] = least_px.max(axis=0)
    sentence = f"the size of {missing.sum()} images is unknown. Put the images next to the file;"
    sentence += f" until then they are estimated as {first[0]:.0f} x {first[1]:.0f} px."
    return sizes, (note(path, "cameras.frames_estimated", sentence, size_px=first.tolist()),)
