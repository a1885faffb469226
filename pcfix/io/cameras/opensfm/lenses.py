"""The camera models of OpenSfM as a Lens in pixels.

Image coordinates are divided by the larger side of the image, the origin is its centre, x right
and y down; so are `focal`, `focal_x`, `focal_y`, `c_x` and `c_y`. The tangential terms follow
OpenCV (p1 with 2 x y in x). Distortion acts on the projected coordinates, which are angles for
the fisheye models.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.opensfm.values import number
from pcfix.model import Lens

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import Projection

PANORAMAS = frozenset({"equirectangular", "spherical"})

_MODELS: dict[str, tuple[Projection, int]] = {
    "perspective": ("perspective", 2),
    "simple_radial": ("perspective", 1),
    "radial": ("perspective", 2),
    "brown": ("perspective", 3),
    "fisheye": ("equidistant", 2),
    "fisheye_opencv": ("equidistant", 4),
    "fisheye62": ("equidistant", 6),
    "fisheye624": ("equidistant", 6),
    "dual": ("dual", 2),
}
_TANGENTIAL = frozenset({"brown", "fisheye62", "fisheye624"})
_SIZE = re.compile(r" (\d{2,6}) (\d{2,6}) [a-z_]+\d* ")


def is_panorama(camera: dict[str, Any]) -> bool:
    """Whether a camera sees all around, which no plane image with a frame can hold."""
    return str(camera.get("projection_type")) in PANORAMAS


def lens(path: Path, name: str, camera: dict[str, Any]) -> Lens:
    """Return the lens of an entry of `cameras`.

    Raises
    ------
    InputError
        If the model is unknown, or a parameter is missing or cannot be one.
    """
    model = str(camera.get("projection_type", "perspective"))
    if model not in _MODELS:
        raise InputError(
            f"{path}: camera {name}: the projection_type '{model}' is none that pcfix knows"
            f" ({', '.join(_MODELS)})."
        )
    projection, radial = _MODELS[model]
    width, height = _size(path, name, camera)
    scale = max(width, height)
    fx, fy = _focal(path, name, camera)
    cx, cy, p1, p2, *prism = (
        _value(path, name, camera, key)
        for key in ("c_x", "c_y", "p1", "p2", "s0", "s1", "s2", "s3")
    )
    return checks.lens(
        path,
        name,
        Lens(
            focal=fy * scale,
            width=width,
            height=height,
            principal_x=width / 2.0 + cx * scale,
            principal_y=height / 2.0 + cy * scale,
            b1=(fx - fy) * scale,
            projection=projection,
            shape=(_value(path, name, camera, "transition", 0.5),) if model == "dual" else (),
            radial=tuple(_value(path, name, camera, f"k{i + 1}") for i in range(radial)),
            tangential=(p2, p1) if model in _TANGENTIAL else (),
            thin_prism=tuple(prism) if model == "fisheye624" else (),
            sensor=name,
        ),
    )


def _value(
    path: Path, name: str, camera: dict[str, Any], key: str, default: float | None = 0.0
) -> float:
    value = camera.get(key, default)
    if value is None:
        raise InputError(f"{path}: camera {name} lacks {key}.")
    return number(path, f"camera {name}, {key}", value)


def _focal(path: Path, name: str, camera: dict[str, Any]) -> tuple[float, float]:
    """Return both focal lengths; models of one focal length have `focal`."""
    if "focal_x" not in camera:
        focal = _value(path, name, camera, "focal", None)
        return focal, focal
    fx = _value(path, name, camera, "focal_x")
    return fx, _value(path, name, camera, "focal_y", fx)


def _size(path: Path, name: str, camera: dict[str, Any]) -> tuple[float, float]:
    """Return width and height; old files have them only in the name of the camera."""
    width, height = (_value(path, name, camera, key) for key in ("width", "height"))
    named = _SIZE.search(name)
    if not (width and height) and named:
        width, height = float(named[1]), float(named[2])
    if not (width and height):
        raise InputError(
            f"{path}: camera {name}: the size of its images is missing; write their width and"
            " height in pixels into this camera's entry."
        )
    return width, height
