"""An interior orientation of MicMac (`CalibrationInternConique` or `Interne`) as a Lens.

An ideal position F (x, y) / z + PP, in pixels, goes through the distortions of the file to the
observed one (eConvApero_DistM2C); of several the last comes first. With eConvApero_DistC2M they
go from the observed to the ideal position.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.micmac import distortion
from pcfix.io.cameras.xml import number, numbers
from pcfix.model import Lens

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.model import FloatArray

_CONVENTIONS = {None: False, "eConvApero_DistM2C": False, "eConvApero_DistC2M": True}
_POLYNOMIALS = {f"eModelePolyDeg{n}": n * (n + 3) - 4 for n in range(2, 8)}
_RADIAL_TERMS = {"7x2": 3, "11x2": 5, "15x2": 7, "19x2": 9}
_FISHEYES = {
    "eModele_FishEye_10_5_5": "linear",
    "eModele_EquiSolid_FishEye_10_5_5": "equisolid",
    "eModele_Stereographik_FishEye_10_5_5": "stereographic",
}


@dataclass(frozen=True, eq=False)
class Step:
    """One `CalibDistortion`.

    Attributes
    ----------
    move : function
        From positions to positions, pixels, shape (n, 2).
    centre : tuple of 2 float, or None
        Its centre of distortion in pixels, where it has one.
    radial, tangential : tuple of float
        Coefficients in pixels; Brown's model whole only where `exact`.
    exact : bool
    fisheye : float or None
        The focal length in pixels inside a fisheye's tangent.
    """

    move: Callable[[FloatArray], FloatArray]
    centre: tuple[float, float] | None = None
    radial: tuple[float, ...] = ()
    tangential: tuple[float, ...] = ()
    exact: bool = False
    fisheye: float | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a calibration says; pixels. The steps go from observed to ideal where `inverse`."""

    path: Path
    name: str
    focal: float
    principal: tuple[float, float]
    width: float
    height: float
    steps: tuple[Step, ...]
    inverse: bool
    useful_radius: float | None

    def move(self, xy: FloatArray) -> FloatArray:
        """Return positions after all steps."""
        for step in self.steps:
            xy = step.move(xy)
        return xy

    def brown(self) -> Lens:
        """Return the lens with what Brown's model holds of the steps; all of it where exact."""
        step = next((s for s in self.steps if s.centre), None)
        f, (x, y) = np.float64(self.focal), self.principal
        cx, cy = step.centre if step and step.centre else (x, y)
        with np.errstate(over="ignore", invalid="ignore"):
            radial = [k * f ** (2 * i + 2) for i, k in enumerate(step.radial if step else ())]
            tangential = [p * f for p in (step.tangential if step else ())]
        lens = Lens(
            focal=self.focal,
            width=self.width,
            height=self.height,
            principal_x=x,
            principal_y=y,
            radial=tuple(map(float, radial)),
            tangential=tuple(map(float, tangential)),
            distortion_centre=((cx - x) / self.focal, (cy - y) / self.focal),
            inverse=self.inverse,
            sensor=self.name,
        )
        return checks.lens(self.path, self.name, lens)

    @property
    def exact(self) -> bool:
        """Whether `brown` is the whole calibration."""
        return not self.steps or (len(self.steps) == 1 and self.steps[0].exact)


def parse(path: Path, element: Element) -> Calibration:
    """Read the element.

    Raises
    ------
    InputError
        If a number is missing, or the model or convention is none that pcfix knows.
    """
    convention = element.findtext("KnownConv", "").strip() or None
    if convention not in _CONVENTIONS:
        raise InputError(
            f"{path}: the calibration is in the convention {convention}; pcfix reads those of"
            " MicMac's own results (eConvApero_DistM2C, eConvApero_DistC2M)."
        )
    focal = number(path, "F", element.findtext("F"))
    if focal <= 0.0:
        raise InputError(f"{path}: the focal length F is {focal:g}; calibrate again.")
    x, y = _pair(path, "PP", element)
    width, height = _pair(path, "SzIm", element)
    useful = element.findtext("RayonUtile")
    steps = [
        _step(path, model, (x, y)) for entry in element.iter("CalibDistortion") for model in entry
    ]
    if _CONVENTIONS[convention] and len(steps) > 1:
        raise InputError(
            f"{path}: several distortions from observed to ideal positions ({convention}) are not"
            " read; convert the calibration to one formula (mm3d ConvertCalib)."
        )
    return Calibration(
        path=path,
        name=path.stem,
        focal=focal,
        principal=(x, y),
        width=width,
        height=height,
        steps=tuple(step for step in reversed(steps) if step),
        inverse=_CONVENTIONS[convention],
        useful_radius=None if useful is None else number(path, "RayonUtile", useful),
    )


def _step(path: Path, model: Element, principal: tuple[float, float]) -> Step | None:
    """Return one distortion; None where there is none."""
    if model.tag == "ModNoDist":
        return None
    if model.tag == "ModRad":
        centre, radial = _radial(path, model)
        return Step(
            partial(distortion.radial, centre=centre, coefficients=radial), centre, radial, (), True
        )
    if model.tag == "ModPhgrStd":
        part = model.find("RadialePart")
        centre, radial = _radial(path, model if part is None else part)
        p1, p2, b1, b2 = (
            number(path, tag, model.findtext(tag, "0")) for tag in ("P1", "P2", "b1", "b2")
        )
        return _fraser(centre, radial, p1, p2, b1, b2)
    if model.tag == "ModUnif":
        return _unified(path, model, principal)
    raise InputError(
        f"{path}: the distortion model {model.tag} is not read; convert the calibration to one of"
        " MicMac's formulas (mm3d ConvertCalib)."
    )


def _fraser(
    centre: tuple[float, float],
    radial: tuple[float, ...],
    p1: float,
    p2: float,
    b1: float,
    b2: float,
) -> Step:
    move = partial(
        distortion.fraser, centre=centre, coefficients=radial, p1=p1, p2=p2, b1=b1, b2=b2
    )
    return Step(move, centre, radial, (p1, p2), exact=b1 == b2 == 0.0)


def _unified(path: Path, model: Element, principal: tuple[float, float]) -> Step | None:
    """Return the model of a `ModUnif` by its name."""
    name = model.findtext("TypeModele", "").strip()
    given = tuple(number(path, "Params", e.text) for e in model.findall("Params"))
    states = tuple(number(path, "Etats", e.text) for e in model.findall("Etats"))
    fourier = _RADIAL_TERMS.get(name.removeprefix("eModeleRadFour"))
    if name == "eModelePolyDeg0":
        return None
    if name in ("eModele_DRad_PPaEqPPs", "eModele_Fraser_PPaEqPPs"):
        p = _filled(path, name, given, 9)
        return _fraser(principal, p[:5], *p[5:])
    if name in _POLYNOMIALS:
        p, s = _filled(path, name, given, _POLYNOMIALS[name]), _states(path, name, states, 3)
        return Step(partial(distortion.polynomial, params=p, states=s))
    if name in ("eModeleEbner", "eModeleDCBrown"):
        formula = distortion.ebner if name == "eModeleEbner" else distortion.brown
        p, s = _filled(path, name, given, 14), _states(path, name, states, 1)
        return Step(partial(formula, params=p, states=s))
    if fourier:
        p, s = _filled(path, name, given, 8 + 2 * fourier), _states(path, name, states, 3)
        move = partial(distortion.radial_and_second_degree, params=p, states=s, terms=fourier)
        return Step(move)
    if name in _FISHEYES:
        p, s = _filled(path, name, given, 50), _states(path, name, states, 1)
        move = partial(distortion.fisheye, params=p, states=s, kind=_FISHEYES[name])
        return Step(move, (p[0], p[1]), fisheye=s[0])
    raise InputError(f"{path}: the distortion model '{name}' is none that pcfix knows.")


def _filled(path: Path, name: str, params: Sequence[float], count: int) -> tuple[float, ...]:
    """Return the parameters with those that the file leaves out as zero."""
    if any(params[count:]):
        raise InputError(f"{path}: {name} has {len(params)} Params instead of {count}.")
    return (*params[:count], *(0.0,) * (count - len(params)))


def _states(path: Path, name: str, states: Sequence[float], count: int) -> tuple[float, ...]:
    if len(states) < count or states[0] == 0.0:
        raise InputError(f"{path}: {name} needs {count} Etats, the first not zero.")
    return tuple(states[:count])


def _radial(path: Path, element: Element) -> tuple[tuple[float, float], tuple[float, ...]]:
    coefficients = (number(path, "CoeffDist", e.text) for e in element.findall("CoeffDist"))
    return _pair(path, "CDist", element), tuple(coefficients)


def _pair(path: Path, tag: str, element: Element) -> tuple[float, float]:
    x, y = numbers(path, tag, element.findtext(tag), 2)
    return float(x), float(y)
