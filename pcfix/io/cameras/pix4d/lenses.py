"""Lenses out of the camera parameters and the calibration file."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from pcfix.io.cameras import checks
from pcfix.model import Lens

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.pix4d.tables import Calibration, Image
    from pcfix.model import FloatArray

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
