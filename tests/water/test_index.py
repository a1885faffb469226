"""The refractive index against measurements to which its formula was not fitted."""

import pytest

from pcfix.water.index import index_of, refractive_index
from tests.utils.codes import refused


def iapws_1997(temperature_c, wavelength_um, density_kg_m3):
    """Return n of pure water relative to vacuum (release R9-97 of the IAPWS)."""
    t, rho = (temperature_c + 273.15) / 273.15, density_kg_m3 / 1000.0
    w2 = (wavelength_um / 0.589) ** 2
    a = (0.244257733, 9.74634476e-3, -3.73234996e-3, 2.68678472e-4, 1.58920570e-3,
         2.45934259e-3, 0.900704920, -1.66626219e-2)  # fmt: skip
    uv2, ir2 = 0.2292020**2, 5.432937**2
    right = a[0] + a[1] * rho + a[2] * t + a[3] * w2 * t + a[4] / w2
    right += a[5] / (w2 - uv2) + a[6] / (w2 - ir2) + a[7] * rho * rho
    right *= rho
    return ((1.0 + 2.0 * right) / (1.0 - right)) ** 0.5


AIR = 1.000274  # index of air at 15 degrees and sea level; it varies by 2e-5 with the weather


PURE = [(0.0, 999.84), (10.0, 999.70), (20.0, 998.21), (30.0, 995.65)]


@pytest.mark.parametrize("wavelength_um", [0.42, 0.5, 0.5893, 0.65])
@pytest.mark.parametrize(("temperature_c", "density"), PURE)
# the scatter of Quan & Fry is 1.5e-5; IAPWS and the weather add as much. 1e-4 is 1 mm in 15 m.
# Eq 13 has fewer powers of the wavelength than dispersion: 4 mm in 15 m at the red end.
@pytest.mark.parametrize(("formula", "abs"), [("quan-fry", 1e-4), ("skarlatos", 3e-4)])
def test_pure_water_of_iapws(formula, abs, temperature_c, density, wavelength_um):
    vacuum = iapws_1997(temperature_c, wavelength_um, density)
    found = refractive_index(0.0, temperature_c, wavelength_um, formula)
    assert found == pytest.approx(vacuum / AIR, abs=abs)


def test_eq_13_as_printed():
    s, t, um = 35.0, 15.0, 0.53
    printed = (
        1.447824 + 3.0110e-4 * s - 1.8029e-5 * t - 1.6916e-6 * t**2 - 4.89040e-1 * um
        + 7.28364e-1 * um**2 - 3.83745e-1 * um**3
        - s * (7.9362e-7 * t - 8.0597e-9 * t**2)
        - s * (4.249e-4 * um - 5.847e-4 * um**2 + 2.812e-4 * um**3)
    )  # fmt: skip
    assert refractive_index(s, t, um) == pytest.approx(printed, abs=1e-14)


def test_iapws():
    # R9-97, table of check values: 0 degrees Celsius, 0.1 MPa, 0.589 um and 100 degrees
    assert iapws_1997(0.0, 0.5893, 999.843) == pytest.approx(1.33434, abs=2e-5)


def test_index_of():
    assert index_of("fresh")[0] == pytest.approx(1.335, abs=0.001)
    assert index_of(" Sea ")[0] == pytest.approx(1.342, abs=0.001)
    assert index_of("1.337") == index_of(1.337) == (1.337, "")
    assert index_of("sea") == (refractive_index(), "sea: 35 PSU, 15 C, 0.53 um")
    assert index_of("fresh", "quan-fry")[1] == "fresh: 0 PSU, 15 C, 0.53 um, by quan-fry"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("salinity", -1.0), ("temperature_c", 293.0), ("wavelength_um", 550.0),
        ("salinity", float("nan")), ("formula", "cauchy"),
    ],
)  # fmt: skip
def test_values_refused(name, value):
    with refused("option.choice" if name == "formula" else "option.range"):
        refractive_index(**{name: value})


@pytest.mark.parametrize("text", ["brackish", "", "35,warm", "1,34"])
def test_text_refused(text):
    with refused("option.index", value=text):
        index_of(text)
