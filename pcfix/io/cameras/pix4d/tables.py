"""The tables of exterior orientation, the offset, the calibration file, and the lenses in them."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.io.cameras.checks import damaged, number, read_text
from pcfix.lens.rotations import from_omega_phi_kappa
from pcfix.model import FloatArray, Lens

FIELDS = {
    "camera matrix": "matrix",
    "radial": "radial",
    "tangential": "tangential",
    "affine": "affine",
    "polynomial": "polynomial",
    "principal": "principal",
    "position": "centre",
    "rotation": "rotation",
}
SHAPE = re.compile(r"^(.*?)\s*\[\s*(\d{1,2})\s*x\s*(\d{1,2})\s*\]\s*$")
SENSOR = re.compile(r"sensor width of\s*([-+.\deE]+)\s*x\s*([-+.\deE]+)")
Calibrations = list[dict[str, float]]
SAME_FOCAL = 1e-6
"""Relative: the two files write the same number in pixels and in millimetres."""


class Image(NamedTuple):
    """One image of the camera parameters; `fields` has its numbers by the names in `FIELDS`."""

    label: str
    width: float
    height: float
    fields: dict[str, FloatArray]


def read_parameters(path: Path) -> list[Image]:
    """Read the camera parameters; their layout is what the header names with sizes."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    layout, row = [], 1
    for i, line in enumerate(lines[:20], start=1):
        if shape := SHAPE.match(line):
            words = shape[1].lower()
            name = next((name for word, name in FIELDS.items() if word in words), "")
            layout.append((name, int(shape[2]) * int(shape[3])))
        if shape or line.strip().lower().startswith("camera model"):
            row = i
    if not {("centre", 3), ("rotation", 9)} <= set(layout):
        raise damaged(path, "its header has no 'camera position t [3x1]' or 'rotation R [3x3]'")
    ends = np.cumsum([count for _, count in layout])
    images = []
    while row < len(lines):
        label, *size = lines[row].rsplit(None, 2)
        words_of: list[str] = []
        row += 1
        while len(words_of) < ends[-1] and row < len(lines):
            words_of += lines[row].split()
            row += 1
        if len(words_of) != ends[-1]:
            raise damaged(path, f"image {label}: {len(words_of)} numbers instead of {ends[-1]}")
        width, height = _numbers(path, f"image {label}", size)
        parts = np.split(_numbers(path, f"image {label}", words_of), ends[:-1])
        fields = {name: part for (name, _), part in zip(layout, parts, strict=True) if name}
        images.append(Image(label.strip(), float(width), float(height), fields))
    if not images:
        raise damaged(path, "has a header but no images")
    return images


def _numbers(path: Path, where: str, words: list[str]) -> FloatArray:
    return np.array([number(path, where, word) for word in words])


def read_external(path: Path) -> tuple[list[str], FloatArray, FloatArray]:
    """Read the absolute table: labels, centres (k, 3) and rotations (k, 3, 3)."""
    rows = [line.rsplit(None, 6) for line in read_text(path).splitlines()[1:] if line.strip()]
    if not rows:
        raise damaged(path, "has a header but no images")
    values = np.array([_numbers(path, f"image {row[0]}", row[1:]) for row in rows])
    rotations = from_omega_phi_kappa(*values[:, 3:].T)
    return [row[0].strip() for row in rows], values[:, :3], rotations


def read_offsets(path: Path) -> list[tuple[str, FloatArray]]:
    """Read the offset: one line, or one for each group of images whose names begin alike."""
    lines = [line.split() for line in read_text(path).replace(",", " ").splitlines()]
    offsets = [
        (" ".join(words[:-3]), _numbers(path, "the offset", words[-3:])) for words in lines if words
    ]
    if not offsets or any(len(values) != 3 for _, values in offsets):
        raise damaged(path, "it should have the offset x y z")
    return offsets


def read_calibrations(path: Path) -> list[dict[str, float]]:
    """Read the cameras of a ``pix4d_..._internal_camera_parameters.cam``.

    Of each come the first number of each line by its name, and `width`, `height` of the sensor, mm.
    """
    cameras: list[dict[str, float]] = []
    for line in read_text(path).splitlines():
        words = line.split()
        if line.lower().startswith("pix4d camera calibration file"):
            cameras.append({"width": 0.0, "height": 0.0})
        elif cameras and (match := SENSOR.search(line)):
            size = _numbers(path, "the sensor size", [match[1], match[2]]).tolist()
            cameras[-1] |= dict(zip(("width", "height"), size, strict=True))
        elif cameras and len(words) > 1 and not line.startswith("#"):
            value = number(path, f"camera {len(cameras) - 1}, {words[0]}", words[1])
            cameras[-1][words[0].lower()] = value
    return cameras


def lens_of_image(image: Image, calibrations: Calibrations) -> Lens | None:
    """Return the lens in pixels, from the block of the image or the only calibration."""
    fields: dict[str, list[float]] = {k: v.tolist() for k, v in image.fields.items()}
    matrix = fields.get("matrix", [])
    if {"affine", "polynomial"} <= fields.keys() and (matrix or "principal" in fields):
        x, y = fields["principal"][:2] if "principal" in fields else (matrix[2], matrix[5])
        lens = _fisheye(image, (x, y), fields["affine"], fields["polynomial"])
    elif matrix:
        fx, skew, x, _, fy, y, *_ = matrix
        t1, t2 = (*fields.get("tangential", ()), 0.0, 0.0)[:2]
        lens = Lens(
            *(fy, image.width, image.height, x, y, fx - fy, skew),
            radial=tuple(fields.get("radial", ())),
            tangential=(t2, t1),
        )
    else:
        return lens_of_calibration(calibrations[0], image) if len(calibrations) == 1 else None
    for calibration in calibrations:  # the pixel size is that of the one with the focal length
        pixel, focal_mm = calibration["width"] / lens.width, calibration.get("f", 0.0)
        is_fisheye = "c" in calibration
        expected = focal_mm if is_fisheye else focal_mm / pixel if pixel > 0.0 else 0.0
        if abs(expected - lens.focal) <= SAME_FOCAL * lens.focal:
            return replace(lens, pixel_size_mm=pixel)
    return lens


def _fisheye(
    image: Image, principal: Sequence[float], affine: Sequence[float], shape: Sequence[float]
) -> Lens:
    """Return the lens (u, v) = principal + [c d; e f] rho, rho the polynomial of 2 theta / pi."""
    c, d, e, f = affine
    frame = (f, image.width, image.height, principal[0], principal[1])
    return Lens(*frame, c - f, d, e, projection="polynomial", shape=tuple(shape))


def lens_of_calibration(calibration: dict[str, float], image: Image | None = None) -> Lens | None:
    """Return the lens of a calibration: in pixels where an image tells how many, else in mm.

    A fisheye needs the image, as its matrix is in pixels and its principal point in mm. None
    where the calibration does not say enough.
    """
    value, is_fisheye = defaultdict(float, {"p1": 1.0} | calibration), "c" in calibration
    width_mm, height_mm = value["width"], value["height"]
    known = {"px", "py", "f"} <= calibration.keys() and min(width_mm, height_mm) > 0.0
    if not known or (is_fisheye and image is None):
        return None
    if is_fisheye and image is not None:
        scale = image.width / width_mm
        principal = (value["px"] * scale, value["py"] * scale)
        affine, shape = ([value[n] for n in t.split()] for t in ("c d e f", "p0 p1 p2 p3 p4"))
        return replace(_fisheye(image, principal, affine, shape), pixel_size_mm=1.0 / scale)
    return Lens(
        *(value["f"], width_mm, height_mm, value["px"], value["py"]),
        radial=(value["k1"], value["k2"], value["k3"]),
        tangential=(value["t2"], value["t1"]),
    )
