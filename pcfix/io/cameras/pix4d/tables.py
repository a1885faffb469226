"""The tables of exterior orientation, the offset, the calibration file, and the lenses in them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.pix4d.files import read_text
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
MOST_NUMBERS = 100
SHAPE = re.compile(r"^(.*?)\s*\[\s*(\d{1,2})\s*x\s*(\d{1,2})\s*\]\s*$")
SENSOR = re.compile(r"sensor width of\s*([-+.\deE]+)\s*x\s*([-+.\deE]+)")


class Image(NamedTuple):
    """One image of the camera parameters; `fields` has its numbers by the names in `FIELDS`."""

    label: str
    width: float
    height: float
    fields: dict[str, FloatArray]


class Calibration(NamedTuple):
    """One camera of the calibration file: the sensor in mm, and what else it says."""

    sensor_mm: tuple[float, float]
    values: dict[str, list[float]]


def read_parameters(path: Path) -> list[Image]:
    """Read the camera parameters; their layout is what the header names with sizes."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    layout = _layout(path, lines)
    body = lines[_header_length(lines) :]
    images, row = [], 0
    while row < len(body):
        image, row = _image(path, body, row, layout)
        images.append(image)
    if not images:
        raise InputError(f"{path}: has a header but no images.")
    return images


def _header_length(lines: list[str]) -> int:
    """Return the number of lines up to the last that has a size in brackets or an equation."""
    last = 0
    for number, line in enumerate(lines[:20], start=1):
        if SHAPE.match(line) or line.strip().lower().startswith("camera model"):
            last = number
    return max(last, 1)


def _layout(path: Path, lines: list[str]) -> list[tuple[str, int]]:
    """Return the name and count of numbers of each field; fields that are not known are empty."""
    layout = []
    for line in lines[: _header_length(lines)]:
        match = SHAPE.match(line)
        if match:
            words = match[1].lower()
            name = next((name for word, name in FIELDS.items() if word in words), "")
            layout.append((name, int(match[2]) * int(match[3])))
    if (
        not {("centre", 3), ("rotation", 9)} <= set(layout)
        or sum(count for _, count in layout) > MOST_NUMBERS
    ):
        raise InputError(
            f"{path}: the header does not name the fields 'camera position t [3x1]' and 'camera"
            " rotation R [3x3]'; give calibrated_external_camera_parameters.txt instead."
        )
    return layout


def _image(
    path: Path, body: list[str], row: int, layout: list[tuple[str, int]]
) -> tuple[Image, int]:
    label, width, height = _name_and_size(path, body[row])
    need = sum(count for _, count in layout)
    words: list[str] = []
    row += 1
    while len(words) < need and row < len(body):
        words += body[row].split()
        row += 1
    if len(words) != need:
        raise InputError(
            f"{path}: image {label}: has {len(words)} numbers instead of {need}; the file is cut"
            " off or damaged, export it again."
        )
    values = _numbers(path, f"image {label}", words)
    ends = np.cumsum([count for _, count in layout])
    parts = np.split(values, ends[:-1])
    fields = {name: part for (name, _), part in zip(layout, parts, strict=True) if name}
    return Image(label, width, height, fields), row


def _name_and_size(path: Path, line: str) -> tuple[str, float, float]:
    words = line.rsplit(None, 2)
    if len(words) != 3:
        raise InputError(
            f"{path}: '{line.strip()[:60]}' should be the name, width and height of an image; the"
            " file is cut off or damaged, export it again."
        )
    width, height = _numbers(path, f"image {words[0]}", words[1:])
    return words[0].strip(), float(width), float(height)


def _numbers(path: Path, where: str, words: list[str]) -> FloatArray:
    try:
        values = np.array(words, dtype=float)
    except ValueError as error:
        raise InputError(f"{path}: {where}: {error}; the file is damaged.") from error
    if not np.isfinite(values).all():
        raise InputError(f"{path}: {where}: has a number that is not finite.")
    return values


def read_external(path: Path) -> tuple[list[str], FloatArray, FloatArray]:
    """Read the absolute table: labels, centres (k, 3) and rotations (k, 3, 3)."""
    rows = [line.rsplit(None, 6) for line in read_text(path).splitlines()[1:] if line.strip()]
    if not rows:
        raise InputError(f"{path}: has a header but no images.")
    for row in rows:
        if len(row) != 7:
            raise InputError(
                f"{path}: image {row[0]}: has {len(row) - 1} numbers instead of 6; the file is cut"
                " off or damaged, export it again."
            )
    values = np.array([_numbers(path, f"image {row[0]}", row[1:]) for row in rows])
    rotations = from_omega_phi_kappa(*values[:, 3:].T)
    return [row[0].strip() for row in rows], values[:, :3], rotations


def read_offsets(path: Path) -> list[tuple[str, FloatArray]]:
    """Read the offset: one line, or one for each group of images whose names begin alike."""
    offsets = []
    for line in read_text(path).replace(",", " ").splitlines():
        words = line.split()
        if words:
            if len(words) < 3:
                raise InputError(f"{path}: '{line.strip()[:60]}' is not an offset x y z.")
            label = " ".join(words[:-3])
            offsets.append((label, _numbers(path, "the offset", words[-3:])))
    if not offsets:
        raise InputError(f"{path}: is empty; it should have the offset x y z.")
    return offsets


def read_calibrations(path: Path) -> list[Calibration]:
    """Read the cameras of a ``pix4d_..._internal_camera_parameters.cam``."""
    cameras: list[Calibration] = []
    for line in read_text(path).splitlines():
        words = line.split()
        if line.lower().startswith("pix4d camera calibration file"):
            cameras.append(Calibration((0.0, 0.0), {}))
        elif cameras and (match := SENSOR.search(line)):
            size = _numbers(path, "the sensor size", [match[1], match[2]])
            cameras[-1] = cameras[-1]._replace(sensor_mm=(float(size[0]), float(size[1])))
        elif cameras and len(words) > 1 and not line.startswith("#"):
            values = _numbers(path, f"camera {len(cameras) - 1}, {words[0]}", words[1:])
            cameras[-1].values[words[0].lower()] = values.tolist()
    return cameras


SAME_FOCAL = 1e-6
"""Relative: the two files write the same number in pixels and in millimetres."""


def lenses_of_images(
    path: Path, images: list[Image], calibrations: list[Calibration]
) -> tuple[Lens, ...] | None:
    """Return the lens of each image; None when an image has none."""
    known: dict[tuple[object, ...], Lens | None] = {}
    lenses = []
    for image in images:
        names = ("matrix", "radial", "tangential", "affine", "polynomial", "principal")
        numbers = tuple(
            image.fields[name].tobytes() if name in image.fields else b"" for name in names
        )
        key = (image.width, image.height, *numbers)
        if key not in known:
            known[key] = _lens(path, image, calibrations)
        lens = known[key]
        if lens is None:
            return None
        lenses.append(lens)
    return tuple(lenses)


def _lens(path: Path, image: Image, calibrations: list[Calibration]) -> Lens | None:
    """Return the lens in pixels, from the block of the image or the only calibration."""
    fields = image.fields
    if {"affine", "polynomial"} <= fields.keys() and {"principal", "matrix"} & fields.keys():
        lens = _fisheye_of_image(image)
    elif "matrix" in fields:
        lens = _perspective_of_image(image)
    elif len(calibrations) == 1:
        return lens_of_calibration(path, calibrations[0], image)
    else:
        return None
    checks.lens(path, image.label, lens)
    return replace(lens, pixel_size_mm=_pixel_size_mm(lens, calibrations))


def _perspective_of_image(image: Image) -> Lens:
    k = image.fields["matrix"].reshape(3, 3)
    t1, t2 = (*image.fields.get("tangential", ()), 0.0, 0.0)[:2]
    return Lens(
        focal=float(k[1, 1]),
        width=image.width,
        height=image.height,
        principal_x=float(k[0, 2]),
        principal_y=float(k[1, 2]),
        b1=float(k[0, 0] - k[1, 1]),
        b2=float(k[0, 1]),
        radial=_floats(image.fields.get("radial")),
        tangential=(float(t2), float(t1)),
    )


def _fisheye_of_image(image: Image) -> Lens:
    fields = image.fields
    x, y = fields["principal"][:2] if "principal" in fields else fields["matrix"][[2, 5]]
    return _fisheye(
        image, (float(x), float(y)), _floats(fields["affine"]), _floats(fields["polynomial"])
    )


def _fisheye(
    image: Image,
    principal: tuple[float, float],
    affine: tuple[float, ...],
    polynomial: tuple[float, ...],
) -> Lens:
    """Return the lens (u, v) = principal + [c d; e f] rho, rho the polynomial of 2 theta / pi."""
    c, d, e, f = affine
    return Lens(
        focal=f,
        width=image.width,
        height=image.height,
        principal_x=principal[0],
        principal_y=principal[1],
        b1=c - f,
        b2=d,
        b3=e,
        projection="polynomial",
        shape=polynomial,
    )


def lens_of_calibration(
    path: Path, calibration: Calibration, image: Image | None = None
) -> Lens | None:
    """Return the lens of a calibration: in pixels where an image tells how many, else in mm.

    A fisheye needs the image, as its matrix is in pixels and its principal point in mm. None
    where the calibration does not say enough.
    """
    values = {name: numbers[0] for name, numbers in calibration.values.items()}
    width_mm, height_mm = calibration.sensor_mm
    if not {"px", "py"} <= values.keys() or not min(width_mm, height_mm) > 0.0:
        return None
    if {"c", "f"} <= values.keys():
        if image is None:
            return None
        scale = image.width / width_mm
        affine = (values["c"], values.get("d", 0.0), values.get("e", 0.0), values["f"])
        powers = (values.get("p0", 0.0), values.get("p1", 1.0))
        higher = tuple(values.get(f"p{i}", 0.0) for i in (2, 3, 4))
        principal = (values["px"] * scale, values["py"] * scale)
        lens = _fisheye(image, principal, affine, powers + higher)
        return replace(checks.lens(path, image.label, lens), pixel_size_mm=1.0 / scale)
    if "f" not in values:
        return None
    lens = Lens(
        focal=values["f"],
        width=width_mm,
        height=height_mm,
        principal_x=values["px"],
        principal_y=values["py"],
        radial=tuple(values.get(f"k{i}", 0.0) for i in (1, 2, 3)),
        tangential=(values.get("t2", 0.0), values.get("t1", 0.0)),
    )
    return checks.lens(path, "calibration", lens)


def _pixel_size_mm(lens: Lens, calibrations: list[Calibration]) -> float | None:
    """Return the pixel size by the calibration that has the same focal length."""
    for calibration in calibrations:
        pixel = calibration.sensor_mm[0] / lens.width
        focal_mm = calibration.values.get("f", [0.0])[0]
        fisheye = "c" in calibration.values
        expected = focal_mm if fisheye else focal_mm / pixel if pixel > 0.0 else 0.0
        if abs(expected - lens.focal) <= SAME_FOCAL * lens.focal:
            return pixel
    return None


def _floats(values: FloatArray | None) -> tuple[float, ...]:
    return () if values is None else tuple(float(value) for value in values)
