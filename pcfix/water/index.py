"""The refractive index of natural waters, relative to air."""

import math
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar, get_args

from pcfix.errors import SettingError
from pcfix.options.correct import MethodOptions
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX, IndexFormula

Options = TypeVar("Options", bound=MethodOptions)

GREEN_UM = 0.53  # peak of the green pixels, where cameras see most through water


class Water(NamedTuple):
    """Properties that determine the refractive index: PSU, degrees Celsius, micrometres."""

    salinity: float = 35.0
    temperature: float = 15.0
    wavelength: float = GREEN_UM


WATERS = {"fresh": Water(0.0), "sea": Water()}


def refractive_index(
    salinity: float = 35.0,
    temperature_c: float = 15.0,
    wavelength_um: float = GREEN_UM,
    formula: IndexFormula = "skarlatos",
) -> float:
    """Return the refractive index of water relative to air.

    Parameters
    ----------
    salinity : float
        PSU (nearly grams of salt per kilogram), 0 to 40.
    temperature_c : float
        Degrees Celsius, 0 to 30.
    wavelength_um : float
        Wavelength of the light, micrometres, 0.4 to 0.7.
    formula : {"skarlatos", "quan-fry"}
        Skarlatos & Agrafiotis 2018, eq 13, as printed, or Quan & Fry 1995 (*Applied Optics* 34,
        3477, eq 3).

    Raises
    ------
    SettingError
        ``option.range`` or ``option.choice``.

    Notes
    -----
    Both formulas are fits to measurements of about 1970. Within the ranges they differ by up to
    4.5e-4, for fresh water at 18 degrees and 0.7 um (3 mm in 10 m of water), and in green light by
    less than 1e-4. Blue and red differ from green by 0.004.

    Examples
    --------
    >>> import pcfix
    >>> round(pcfix.refractive_index(salinity=0.0, temperature_c=20.0, wavelength_um=0.589), 5)
    1.33301
    """
    for name, value, low, high, unit in (
        ("salinity", salinity, 0.0, 40.0, "PSU"),  # fitted up to 35; natural seas have more
        ("temperature", temperature_c, 0.0, 30.0, "degrees Celsius"),
        ("wavelength", wavelength_um, 0.4, 0.7, "micrometres"),
    ):
        if not (math.isfinite(value) and low <= value <= high):
            text = f"{name} {value:g} is outside {low:g} to {high:g}. Give it in {unit}."
            raise SettingError("option.range", text, option=name, value=value)
    if formula not in get_args(IndexFormula):
        known = " or ".join(get_args(IndexFormula))
        text = f"The index formula '{formula}' is unknown. Use {known}."
        raise SettingError("option.choice", text, option="index_formula", value=formula)
    s, t, um = float(salinity), float(temperature_c), float(wavelength_um)
    if formula == "quan-fry":  # Quan & Fry 1995, eq 3, with the wavelength in nanometres
        nm = 1000.0 * um
        return (
            1.31405
            + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t * t) * s
            - 2.02e-6 * t * t
            + (15.868 + 0.01155 * s - 0.00423 * t) / nm
            - 4382.0 / nm**2
            + 1.1455e6 / nm**3
        )
    # Skarlatos & Agrafiotis 2018, eq 13, with the wavelength in micrometres
    fresh = 1.447824 - 1.8029e-5 * t - 1.6916e-6 * t * t
    fresh += -4.89040e-1 * um + 7.28364e-1 * um**2 - 3.83745e-1 * um**3
    by_salt = 7.9362e-7 * t - 8.0597e-9 * t * t
    by_salt += 4.249e-4 * um - 5.847e-4 * um**2 + 2.812e-4 * um**3
    return fresh + 3.0110e-4 * s - s * by_salt


def with_index(options: Options) -> Options:
    """Return options whose refractive index is a number, with a description of the water.

    They have an index, or salinity, temperature or wavelength. Raises SettingError
    ``option.exclusive`` if both are given.
    """
    own = {name: getattr(options, name, None) for name in Water._fields}
    given: dict[str, Any] = {name: value for name, value in own.items() if value is not None}
    if given and options.index is not None:
        raise SettingError(
            "option.exclusive",
            "index excludes salinity, temperature and wavelength. Give one or the others.",
            options=["index", *given],
        )
    water = Water(**given) if given else None
    number, origin = index_of(options.index, options.index_formula, water)
    # the number replaces the properties
    given.update(dict.fromkeys(given), index=number, index_from=origin or options.index_from)
    return replace(options, **given)


def index_of(
    given: float | str | None, formula: IndexFormula = "skarlatos", water: Water | None = None
) -> tuple[float, str]:
    """Return a refractive index and a description of its water, empty if only a number is given.

    It is that of `water`, or given as a number, by default `DEFAULT_REFRACTIVE_INDEX`, or as
    ``fresh`` or ``sea``. Raises SettingError ``option.index`` if it is none of these.
    """
    text = str(DEFAULT_REFRACTIVE_INDEX if given is None else given).strip().lower()
    named = WATERS.get(text)
    water = water or named
    if water is None:
        try:
            return float(text), ""
        except ValueError:
            raise SettingError(
                "option.index",
                f"index '{given}' is not known. Give a number such as 1.34, {' or '.join(WATERS)}.",
                value=given,
            ) from None
    by = "" if formula == "skarlatos" else f", by {formula}"
    return refractive_index(*water, formula=formula), (
        f"{f'{text}: ' if named else ''}{water.salinity:g} PSU, {water.temperature:g} C,"
        f" {water.wavelength:g} um{by}"
    )
