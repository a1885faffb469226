"""The refractive index of natural waters, relative to air."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

from pcfix.errors import SettingError
from pcfix.options.correct import MethodOptions
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX

Options = TypeVar("Options", bound=MethodOptions)

SALINITY_PSU, TEMPERATURE_C, WAVELENGTH_UM = (0.0, 40.0), (0.0, 30.0), (0.4, 0.7)
"""Where the formula was fitted (its salinities end at 35; natural seas go a little beyond)."""

GREEN_UM = 0.53
"""Where cameras see most through water: the peak of their green pixels."""


class Water(NamedTuple):
    """What decides the refractive index; PSU, degrees Celsius and micrometres."""

    salinity: float = 35.0
    temperature: float = 15.0
    wavelength: float = GREEN_UM


WATERS = {"fresh": Water(0.0), "sea": Water()}
"""Waters by name."""


def refractive_index(
    salinity: float = 35.0, temperature_c: float = 15.0, wavelength_um: float = GREEN_UM
) -> float:
    """Return the refractive index of water relative to air.

    Parameters
    ----------
    salinity : float
        PSU (grams of salt in a kilogram, nearly), 0 to 40.
    temperature_c : float
        Degrees Celsius, 0 to 30.
    wavelength_um : float
        Of the light, micrometres, 0.4 to 0.7.

    Returns
    -------
    float

    Raises
    ------
    SettingError
        If a value is outside its range.

    Notes
    -----
    Skarlatos & Agrafiotis 2018, eq 13, which is the fit of Quan & Fry 1995 (*Applied Optics* 34,
    3477, eq 3) to the measurements of Austin & Halikas 1976. The wavelength enters in nanometres;
    the term in T^2 alone and the one in 1 / lambda^2 are negative. Without dispersion in mind a
    camera's green, 0.53 um, is a fair choice; blue and red differ by 0.004.

    Examples
    --------
    >>> import pcfix
    >>> round(pcfix.refractive_index(salinity=0.0, temperature_c=20.0, wavelength_um=0.5893), 4)
    1.333
    """
    for name, value, (low, high), unit in (
        ("salinity", salinity, SALINITY_PSU, "PSU"),
        ("temperature", temperature_c, TEMPERATURE_C, "degrees Celsius"),
        ("wavelength", wavelength_um, WAVELENGTH_UM, "micrometres"),
    ):
        if not (math.isfinite(value) and low <= value <= high):
            raise SettingError(
                f"{name} {value:g} is outside {low:g} to {high:g}: give it in {unit}."
            )
    s, t, nm = float(salinity), float(temperature_c), 1000.0 * wavelength_um
    return (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t * t) * s
        - 2.02e-6 * t * t
        + (15.868 + 0.01155 * s - 0.00423 * t) / nm
        - 4382.0 / nm**2
        + 1.1455e6 / nm**3
    )


def with_index(options: Options) -> Options:
    """Return options whose refractive index is a number, and which say what water it is of.

    They come with an index, or where they have them salinity, temperature or wavelength.

    Raises
    ------
    SettingError
        If both are given, or a value is outside its range.
    """
    own = {name: getattr(options, name) for name in Water._fields if hasattr(options, name)}
    given = {name: value for name, value in own.items() if value is not None}
    index = options.index
    if given:
        if index is not None:
            raise SettingError(
                "index and salinity, temperature or wavelength say the same twice; give one of"
                " them."
            )
        index = ",".join(map(repr, Water(**given)))
    number, origin = index_of(index)
    silent: dict[str, Any] = dict.fromkeys(own)
    return replace(options, index=number, index_from=origin or options.index_from, **silent)


def index_of(given: float | str | None) -> tuple[float, str]:
    """Return the refractive index that a number or a word means, and what water that is.

    Parameters
    ----------
    given : float, str or None
        A number, by default `DEFAULT_REFRACTIVE_INDEX`; ``fresh`` or ``sea``; or ``S,T`` or
        ``S,T,W``: salinity in PSU, temperature in degrees Celsius and wavelength in micrometres.

    Returns
    -------
    index : float
    water : str
        In words; empty where only a number was given.

    Raises
    ------
    SettingError
        If it is none of these, or a value is outside its range.
    """
    if given is None:
        return DEFAULT_REFRACTIVE_INDEX, ""
    text = str(given).strip().lower()
    water = WATERS.get(text)
    try:
        if water is None and "," in text:
            water = Water(*(float(word) for word in text.split(",")))
        if water is None:
            return float(text), ""
    except (ValueError, TypeError):
        raise SettingError(
            f"index '{given}' is neither a number nor {' nor '.join(WATERS)}, nor salinity,"
            " temperature and wavelength as 35,15,0.53."
        ) from None
    name = f"{text}: " if text in WATERS else ""
    return refractive_index(*water), (
        f"{name}{water.salinity:g} PSU, {water.temperature:g} C, {water.wavelength:g} um"
    )
