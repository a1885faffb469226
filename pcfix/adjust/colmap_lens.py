"""Lenses as COLMAP's cameras, and which of their parameters its flags can set free.

COLMAP frees parameters in three lots: all focal lengths, both coordinates of the principal point,
all coefficients of distortion. A lens goes as the simplest of COLMAP's models that is exactly this
lens and of which the flags free what is to move and nothing else; where its models have two focal
lengths only, b1 moves along with f.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pcfix.errors import InputError, SettingError
from pcfix.io.cameras.colmap.models import BY_NAME, Camera, Model, lens
from pcfix.io.cameras.colmap.writing import PREFERRED, _values
from pcfix.io.cameras.same_lens import is_same_lens

if TYPE_CHECKING:
    from pcfix.model import Lens

WHERE = Path("adjustment")
"""Stands for a file in messages on lenses."""

INTERIOR = frozenset({"f", "fx", "fy", "cx", "cy"})


class Flags(NamedTuple):
    """What COLMAP refines: focal lengths, principal point, distortion."""

    focal: bool
    principal: bool
    extra: bool


def flags_for(model: Model, names: frozenset[str]) -> Flags | None:
    """Return the flags that free exactly these parameters of a model; None where none do."""
    focal = frozenset({"f"} if "f" in model.parameters else {"f", "b1"})
    lots = (focal, frozenset({"cx", "cy"}), frozenset(model.parameters) - INTERIOR)
    flags = Flags(*(bool(lot & names) for lot in lots))
    freed = {name for lot, flag in zip(lots, flags, strict=True) if flag for name in lot}
    return flags if freed == names else None


def camera_for(given: Lens, names: frozenset[str]) -> tuple[Camera, Flags]:
    """Return COLMAP's camera of a lens of which some parameters move, and the flags.

    Parameters
    ----------
    given : Lens
        In pixels.
    names : set of str
        Of `pcfix.adjust.state.CODES`.

    Raises
    ------
    SettingError
        If COLMAP has no such camera, or cannot free these parameters without others.
    """
    held = [camera for name in PREFERRED if (camera := _held(given, BY_NAME[name])) is not None]
    if not held:
        raise SettingError(
            f"COLMAP has no camera model for the lens {given.sensor or 'of the images'}; take the"
            " direct engine."
        )
    for wanted in (names, names | {"b1"}) if "f" in names else (names,):
        for camera in held:
            flags = flags_for(camera.model, wanted)
            if flags is not None:
                return camera, flags
    raise SettingError(
        f"COLMAP cannot free {', '.join(sorted(names))} of a {held[0].model.name} lens and nothing"
        " else: it frees all focal lengths, cx with cy, and all distortion at once; free those"
        " together, or take the direct engine."
    )


def _held(given: Lens, model: Model) -> Camera | None:
    """Return the lens as a camera of a model, None where the model does not hold it."""
    whole = float(given.width).is_integer() and float(given.height).is_integer()
    if given.unit != "px" or not whole or model.projection != given.projection:
        return None
    camera = with_values(Camera(model, given.width, given.height, ()), given)
    try:
        same = is_same_lens(lens(WHERE, 1, camera), given)
    except InputError:
        return None
    return camera if same else None


def with_values(camera: Camera, given: Lens) -> Camera:
    """Return a camera of the same model with the numbers of a lens."""
    values = _values(given)
    numbers = tuple(float(values.get(key, 0.0)) for key in camera.model.parameters)
    return camera._replace(values=numbers)


def lens_of(camera: Camera, before: Lens) -> Lens:
    """Return a camera as a lens, under the name that it had before."""
    made = lens(WHERE, 1, camera)
    return replace(made, sensor=before.sensor, pixel_size_mm=before.pixel_size_mm)
