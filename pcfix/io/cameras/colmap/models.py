"""COLMAP's camera models: their numbers, names, parameters, and the lens that each one is.

The parameters are those of COLMAP's own list, in its order (https://colmap.github.io/cameras.html
and, for models that are not there yet, ``src/colmap/sensor/models`` of COLMAP 4). The image's
origin is the upper left corner of the upper left pixel, as in `pcfix.model.Lens`, so principal
points are taken as they are. p1 and p2 are in OpenCV's order, except in the model of Project
Aria's cameras (RAD_TAN_THIN_PRISM_FISHEYE), where they are in Brown's, and where the tangential
and prism terms are of the radially distorted place.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.model import Lens, Projection

if TYPE_CHECKING:
    from pathlib import Path

_SMALLEST_OMEGA = 1e-6
"""Below, in radians, the FOV model is a perspective one to double precision."""


class Model(NamedTuple):
    """A camera model; `parameters` are the names in the order of the file."""

    name: str
    parameters: tuple[str, ...]
    projection: Projection | None


def _model(name: str, parameters: str, projection: Projection | None = "perspective") -> Model:
    return Model(name, tuple(parameters.split()), projection)


MODELS = (
    _model("SIMPLE_PINHOLE", "f cx cy"),
    _model("PINHOLE", "fx fy cx cy"),
    _model("SIMPLE_RADIAL", "f cx cy k1"),
    _model("RADIAL", "f cx cy k1 k2"),
    _model("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    _model("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    _model("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    _model("FOV", "fx fy cx cy omega", "fov"),
    _model("SIMPLE_RADIAL_FISHEYE", "f cx cy k1", "equidistant"),
    _model("RADIAL_FISHEYE", "f cx cy k1 k2", "equidistant"),
    _model("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3", "equidistant"),
    _model(
        "RAD_TAN_THIN_PRISM_FISHEYE",
        "fx fy cx cy k1 k2 k3 k4 k5 k6 p2 p1 s1 s2 s3 s4",
        "equidistant",
    ),
    _model("SIMPLE_DIVISION", "f cx cy k", "division"),
    _model("DIVISION", "fx fy cx cy k", "division"),
    _model("SIMPLE_FISHEYE", "f cx cy", "equidistant"),
    _model("FISHEYE", "fx fy cx cy", "equidistant"),
    _model("EUCM", "fx fy cx cy alpha beta", "eucm"),
    _model("EQUIRECTANGULAR", "w h", None),
)
"""In the order of their numbers in binary files, from 0."""

BY_NAME = {model.name: model for model in MODELS}


class Camera(NamedTuple):
    """A row of the camera list."""

    model: Model
    width: float
    height: float
    values: tuple[float, ...]


def lens(path: Path, identifier: int, camera: Camera) -> Lens:
    """Return the lens of a camera.

    Raises
    ------
    InputError
        If the model is one that `Lens` cannot express, or a number is none of a camera.
    """
    model = camera.model
    if model.projection is None:
        raise InputError(
            f"{path}: camera {identifier}: pcfix has no lens for the model {model.name}; give the"
            " undistorted model (colmap image_undistorter)."
        )
    given = dict(zip(model.parameters, camera.values, strict=True))
    focal_x, focal = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    projection, shape = _projection(model.projection, given)
    made = Lens(
        *(focal, camera.width, camera.height, given["cx"], given["cy"]),
        b1=focal_x - focal,
        projection=projection,
        shape=shape,
        radial=_some(given, "k1", "k2", "k3", "k4", "k5", "k6"),
        denominator=_some(given, "d1", "d2", "d3"),
        tangential=_some(given, "p2", "p1"),
        thin_prism=_some(given, "s1", "s2", "s3", "s4"),
        in_turn=model.name == "RAD_TAN_THIN_PRISM_FISHEYE",
        sensor=f"{identifier} {model.name}",
    )
    checks.lens(path, str(identifier), made)
    if not focal_x > 0.0:
        raise InputError(
            f"{path}: camera {identifier}: focal length fx {focal_x:g} must be positive; export the"
            " model again."
        )
    return made


def _some(given: dict[str, float], *names: str) -> tuple[float, ...]:
    """Return the values up to the last name that the model has, 0 for those between."""
    there = [i for i, name in enumerate(names) if name in given]
    return tuple(given.get(name, 0.0) for name in names[: there[-1] + 1]) if there else ()


def _projection(
    projection: Projection, given: dict[str, float]
) -> tuple[Projection, tuple[float, ...]]:
    match projection:
        case "division":
            return projection, (given["k"],)
        case "eucm":
            return projection, (given["alpha"], given["beta"])
        case "fov" if abs(given["omega"]) < _SMALLEST_OMEGA:
            return "perspective", ()
        case "fov":
            return projection, (given["omega"],)
        case _:
            return projection, ()
