"""Lenses from parameters by name, and back.

All packages have the same few parameters. Here they are called ``f``, or ``fx`` across and ``fy``
down the image; ``cx``, ``cy``, the principal point from the upper left corner of the image;
``skew`` and ``b3``, the affine terms off the diagonal; ``k1``, ``k2``, ... radial and ``d1``, ...
in the denominator; ``p1``, ``p2``, ... in Brown's order, so OpenCV's p1 is ``p2``; ``s1``, ... of
thin prisms; and the parameters of a projection, see `SHAPES`. `pcfix.model.Lens` has the formulas.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import bad_file
from pcfix.lens.imaging import project
from pcfix.model import Lens, Projection

SHAPES: Mapping[Projection, str] = {
    "fov": "omega",
    "division": "k",
    "eucm": "alpha beta",
    "dual": "transition",
}
LETTERS = {"radial": "k", "denominator": "d", "tangential": "p", "thin_prism": "s"}
ROUNDING = 1e-11
"""Of the image of a lens that is written, in focal lengths."""


class LensModel(NamedTuple):
    """A model of a package: the names of its parameters, in the order of its files."""

    names: str
    projection: Projection | None = "perspective"  # None for a panorama, which is no lens
    in_turn: bool = False


def lens_by_name(given: Mapping[str, float], width: float, height: float, **more: Any) -> Lens:
    """Return the lens with the given parameters; `more` are other fields of a `Lens`.

    Without ``cx`` and ``cy`` the principal point is in the middle of the frame.
    """
    value = defaultdict(float, given)
    focal = given.get("fy", value["f"])
    most = max((int(name[1:]) for name in given if name[1:].isdecimal()), default=0)
    numbers = range(1, most + 1)
    terms = {
        field: tuple(np.trim_zeros([given.get(f"{letter}{i}", 0.0) for i in numbers], "b"))
        for field, letter in LETTERS.items()
    }
    shape = tuple(value[name] for name in SHAPES.get(more.get("projection", ""), "").split())
    middle = given.get("cx", width / 2.0), given.get("cy", height / 2.0)
    affine = given.get("fx", focal) - focal, value["skew"], value["b3"]
    return Lens(focal, width, height, *middle, *affine, **{"shape": shape} | terms | more)


def model_of(
    path: Path, lens: Lens, models: Mapping[str, LensModel], *, whole: bool = False
) -> tuple[str, dict[str, float]]:
    """Return the simplest model that is exactly this lens, and its parameters in their order.

    With `whole` the frame must be whole pixels. An `InputError` if there is no model for `path`.
    """
    values = {
        f"{letter}{i}": value
        for field, letter in LETTERS.items()
        for i, value in enumerate(getattr(lens, field), start=1)
    }
    values |= {"f": lens.focal, "fx": lens.focal + lens.b1, "fy": lens.focal}
    values |= {"cx": lens.principal_x, "cy": lens.principal_y, "skew": lens.b2, "b3": lens.b3}
    values |= dict(zip(SHAPES.get(lens.projection, "").split(), lens.shape, strict=False))
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, 8) * side for side in (lens.width, lens.height)))
    rays = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, lens.focal)])
    exact = project(lens, rays)
    fits = not whole or (lens.unit == "px" and lens.width % 1.0 == lens.height % 1.0 == 0.0)
    alike = [one for one in models if models[one].projection == lens.projection] if fits else []
    for name in sorted(alike, key=lambda one: models[one].names.count(" ")):
        given = {one: values.get(one, 0.0) for one in models[name].names.split()}
        more = {"projection": lens.projection, "in_turn": models[name].in_turn}
        held = project(lens_by_name(given, lens.width, lens.height, **more), rays)
        if np.allclose(held, exact, rtol=0.0, atol=ROUNDING * lens.focal, equal_nan=True):
            return name, given
    kind = f"{lens.sensor or 'of the images'} ({lens.projection} in {lens.unit})"
    sentence = f"the format cannot hold the lens {kind} exactly. Use another format."
    raise bad_file(path, "output.lens", sentence, lens=lens.sensor)
