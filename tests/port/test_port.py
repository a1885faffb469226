"""Refraction at a housing port against closed forms, Fermat's principle and differences."""

import math

import numpy as np
import pytest

from pcfix.port.housing import (
    DomePort,
    FlatPort,
    cosine_at_port,
    port_of,
    ray_through,
    through_port,
    window_of,
)
from tests.utils.codes import refused
from tests.utils.compiled import compiled
from tests.utils.port_scenes import fermat_directions

through_port = compiled(through_port)
ray_through, cosine_at_port = compiled(ray_through), compiled(cosine_at_port)

N_WATER = 1.34
PORTS = {
    "thin": FlatPort(0.02),
    "thick": FlatPort(0.02, 0.008, 1.49),
    "leaning": FlatPort(0.1, 0.03, 1.52, (0.1, -0.05, 1.0)),
    "dome behind": DomePort(0.05, 0.004, 1.49, (0.003, -0.002, -0.01)),
    "dome before": DomePort(0.05, 0.004, 1.49, (0.0, 0.001, 0.02)),
    "thin dome": DomePort(0.08, 0.0, 1.49, (0.02, 0.0, 0.01)),
}


def points(seed=0, count=300):
    """Points up to 45 degrees off the axis, 0.3 to 10 m away; some on the axis, or next to it."""
    rng = np.random.default_rng(seed)
    away = rng.uniform(-1.0, 1.0, (count, 2))
    away[:3], away[3:6] = 0.0, 1e-8
    xyz = np.column_stack([away, np.ones(count)])
    return xyz * 10.0 ** rng.uniform(math.log10(0.3), 1.0, (count, 1))


def seen(port, xyz, n=N_WATER):
    """Return w with its derivatives, shape (m, 3, 5)."""
    out = np.empty((len(xyz), 3, 5))
    for i, point in enumerate(xyz):
        through_port(window_of(port), n, tuple(point), out[i])
    return out


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


ROUNDING = 1e-12  # rad: of sines and roots of numbers near one, a few times over


@pytest.mark.parametrize("thickness", [0.0, 0.008])
def test_flat_closed_form(thickness):
    # by hand: tangents of the angles in air, glass and water times the layers
    angle = np.radians([0.0, 0.001, 10.0, 35.0, 60.0, 80.0])
    tangents = [np.tan(np.arcsin(np.sin(angle) / index)) for index in (1.0, 1.49, N_WATER)]
    x = tangents[0] * 0.02 + tangents[1] * thickness + tangents[2] * 3.0
    w = seen(FlatPort(0.02, thickness), [(one, 0.0, 3.02 + thickness) for one in x])[:, :, 0]
    assert np.arctan2(w[:, 0], w[:, 2]) == pytest.approx(angle, abs=ROUNDING)
    assert not w[:, 1].any()


@pytest.mark.parametrize("name", PORTS)
def test_fermat(name):
    # the shortest path is found to 1e-13 m on a window 0.02 to 0.1 m away: 5e-12 rad
    xyz = points()
    w = unit(seen(PORTS[name], xyz)[:, :, 0])
    assert np.abs(w - fermat_directions(xyz, PORTS[name], N_WATER)).max() < 1e-11


@pytest.mark.parametrize(
    ("port", "n"),
    [
        (FlatPort(0.02, 0.008, 1.0), 1.0),
        (DomePort(0.05, 0.004, 1.0), 1.0),
        (DomePort(0.05, 0.004, 1.49), N_WATER),  # about the projection centre
    ],
)
def test_no_refraction(port, n):
    xyz = points()
    out = seen(port, xyz, n)
    assert np.abs(unit(out[:, :, 0]) - unit(xyz)).max() < ROUNDING
    if n > 1.0:
        assert np.abs(out[:, :, 4]).max() < ROUNDING


@pytest.mark.parametrize("name", PORTS)
def test_round_trip(name):
    port, xyz = PORTS[name], points(1)
    for point, w in zip(xyz, seen(port, xyz)[:, :, 0], strict=True):
        start, direction = np.array(ray_through(window_of(port), N_WATER, tuple(w)))
        assert np.linalg.norm(direction) == pytest.approx(1.0, abs=ROUNDING)
        # metres; the angle is known to 1e-13 and the point is up to 17 m away
        assert np.linalg.norm(np.cross(point - start, direction)) < 1e-10
        assert (point - start) @ direction > 0.0


def test_no_light():
    """From inside the housing, and backwards through a flat port."""
    for port in (FlatPort(0.02, 0.008), DomePort(0.05, 0.004)):
        assert np.isnan(seen(port, [(0.0, 0.001, 0.025)])).all()
    assert np.isnan(ray_through(window_of(FlatPort(0.02)), N_WATER, (0.1, 0.0, -1.0))).all()


def test_incidence_angle():
    flat = window_of(FlatPort(0.02, 0.008))
    cosine = math.cos(math.pi / 4)
    assert cosine_at_port(flat, (1.0, 0.0, 1.0)) == pytest.approx(cosine, abs=ROUNDING)
    # 0.03 m before the centre of a dome of 0.05 m, looking across: the sine is 0.03 / 0.05
    dome = window_of(DomePort(0.05, 0.004, 1.49, (0.0, 0.0, 0.03)))
    assert cosine_at_port(dome, (1.0, 0.0, 0.0)) == pytest.approx(0.8, abs=ROUNDING)


def test_port_of():
    assert port_of("flat:distance=0.02") == FlatPort(0.02)
    assert port_of("FLAT: distance=0.02, thickness=0.008, glass=1.52") == FlatPort(
        0.02, 0.008, 1.52
    )
    leaning = port_of("flat:distance=0.02,nx=0.6")
    assert leaning.normal == pytest.approx((0.6, 0.0, 0.8), abs=ROUNDING)
    dome = DomePort(0.05, 0.004, 1.49, (0.0, 0.001, -0.01))
    assert port_of("dome:radius=0.05,thickness=0.004,y=0.001,z=-0.01") == dome


@pytest.mark.parametrize(
    "text",
    [
        "", "round:radius=1", "flat", "flat:thickness=0.01", "dome:z=0.01", "flat:distance",
        "flat:distance=two", "flat:distance=nan", "flat:distance=0.02,,",
        "flat:distance=0.02,radius=1", "flat:distance=0.02,distance=0.03",
    ],
)  # fmt: skip
def test_text_refused(text):
    with refused("port.text", value=text):
        port_of(text)


@pytest.mark.parametrize(
    ("text", "option"),
    [
        ("flat:distance=-0.02", "distance"),
        ("flat:distance=0.02,thickness=-1", "thickness"),
        ("flat:distance=0.02,glass=0.9", "glass"),
        ("flat:distance=0.02,nx=0.8,ny=0.8", "normal"),
        ("dome:radius=0", "radius"),
        ("dome:radius=0.05,z=0.06", "centre"),
    ],
)
def test_values_refused(text, option):
    with refused("port.range", option=option):
        port_of(text)
    with refused("port.range", option="normal"):
        FlatPort(0.02, normal=(0.0, 0.0, -1.0))
