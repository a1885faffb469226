"""Analytic derivatives of one observation against central differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import (
    CODES,
    PORT,
    SHAPE,
    WATER_NAMES,
    Given,
    Loss,
    PointPriors,
    Seen,
    State,
    Surface,
    columns_of,
    moved_lens,
)
from pcfix.adjust.normal import linearise
from pcfix.adjust.observe import (
    WATER,
    WIDTH,
    image,
    image_and_all_gradients,
    lens_gradients,
    scratch,
)
from pcfix.lens.imaging import coefficients, lens_table
from pcfix.model import Lens, WaterRaster
from pcfix.port.light import coefficients as port_coefficients
from pcfix.port.shapes import DomePort, FlatPort
from pcfix.water.surface import build_field
from tests.utils.compiled import compiled

image = compiled(image)
image_and_all_gradients = compiled(image_and_all_gradients)
lens_gradients = compiled(lens_gradients)
linearise = compiled(linearise)

DOWN = np.diag([1.0, -1.0, -1.0])
PLAIN = Lens(3600.0, 5472.0, 3648.0, 2730.0, 1830.0)
BROWN = Lens(
    3600.0, 5472.0, 3648.0, 2730.0, 1830.0, b1=1.5, b2=-0.8,
    radial=(-0.05, 0.02, -0.004), tangential=(1e-3, -5e-4),
)  # fmt: skip
FISHEYE = Lens(
    1400.0, 4000.0, 3000.0, 2010.0, 1490.0, projection="equidistant", radial=(0.02, -0.003)
)
INVERSE = Lens(
    3600.0, 5472.0, 3648.0, 2730.0, 1830.0,
    radial=(0.03, -0.01), tangential=(4e-4, 2e-4), inverse=True,
)  # fmt: skip
RATIONAL = Lens(
    3600.0, 5472.0, 3648.0, 2730.0, 1830.0, radial=(0.1, 0.02, 0.0), denominator=(0.12, 0.01, 0.0)
)
LENSES = {
    "plain": PLAIN, "Brown": BROWN, "fisheye": FISHEYE, "inverse": INVERSE, "rational": RATIONAL,
}  # fmt: skip
WATERS = {"level": (-60.0, 0.0, 0.0, 1.34), "tilted": (-60.0, 0.03, -0.05, 1.34)}
NEAR = 2e-6
"""Relative to the largest of a row: central differences of 0.1 mm steps are good to 1e-7 or so."""


def no_surface() -> Surface:
    return Surface(True, None, None, np.zeros(3), np.zeros(0))


def planar_raster(b: float, c: float) -> Surface:
    """Return a raster that is the plane z = b x + c y, so that it has one slope everywhere."""
    rows, columns = 80, 80
    x = -200.0 + 5.0 * (np.arange(columns) + 0.5)
    y = 200.0 - 5.0 * (np.arange(rows) + 0.5)
    raster = WaterRaster(b * x[None, :] + c * y[:, None] - 60.0, -200.0, 200.0, (5.0, 5.0))
    return Surface(True, None, build_field(raster), np.zeros(3), np.zeros(0))


def pose(seed: int):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("zyx", rng.uniform([-180, -15, -15], [180, 15, 15]), degrees=True)
    return rng.uniform(-5.0, 5.0, 3), DOWN @ turn.as_matrix()


def one(q, centre, rotation, lens, water):
    """Return the state and the observation of one point, under water where it lies below it."""
    state = State(centre[None], rotation[None], lens[None], q[None], np.asarray(water, float))
    return state, Seen(
        np.array([0, 1]), np.array([0]), np.zeros((1, 2)), np.ones(1), np.array([True]),
        np.zeros(1, np.int64), np.zeros(1, np.int64),
    )  # fmt: skip


def at(q, centre, rotation, lens, water, surface):
    return np.array(image(*one(q, centre, rotation, lens, water), surface, 0, 0, scratch()))


def gradients(q, centre, rotation, lens, water, surface):
    room, out = scratch(), np.zeros((2, WIDTH))
    seen = one(q, centre, rotation, lens, water)
    uv = image_and_all_gradients(*seen, surface, 0, 0, room, out)
    return np.array(uv), out[:, : WATER + len(water)], room.ahead


def differences(q, centre, rotation, lens, water, surface):
    """Return the derivatives by omega, C, Q and the water's numbers, by central differences."""
    columns = []
    for i in range(WATER + len(water)):
        ends = []
        # metres; 1/m; radians, slopes, index and metres of a port
        step = 1e-4 if 3 <= i <= WATER else 1e-8 if SHAPE <= i - WATER < PORT else 1e-6
        for sign in (1.0, -1.0):
            moved = [q.copy(), centre.copy(), rotation, np.array(water, float)]
            if i < 3:
                omega = np.zeros(3)
                omega[i] = sign * step
                moved[2] = Rotation.from_rotvec(omega).as_matrix() @ rotation
            elif i < 6:
                moved[1][i - 3] += sign * step
            elif i < WATER:
                moved[0][i - 6] += sign * step
            else:
                moved[3][i - WATER] += sign * step
            ends.append(at(moved[0], moved[1], moved[2], lens, moved[3], surface))
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.column_stack(columns)


def close(found, wanted):
    scale = np.abs(wanted).max(axis=0) + 1e-3 * np.abs(wanted).max()
    np.testing.assert_array_less(np.abs(found - wanted) / scale, NEAR)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("water", WATERS)
@pytest.mark.parametrize("z", [-68.0, -60.9, -55.0])
def test_all_gradients_of_an_observation(name, water, z):
    lens = coefficients(LENSES[name])
    for seed in range(3):
        centre, rotation = pose(seed)
        q = np.array([*np.random.default_rng(seed + 50).uniform(-12.0, 12.0, 2), z])
        uv, out, _ = gradients(q, centre, rotation, lens, WATERS[water], no_surface())
        same = at(q, centre, rotation, lens, WATERS[water], no_surface())
        np.testing.assert_allclose(uv, same, atol=1e-9)  # px: one formula, written twice
        close(out, differences(q, centre, rotation, lens, WATERS[water], no_surface()))
    if z == -55.0:
        assert not out[:, WATER:].any()  # above the water nothing depends on it


def test_straight_below_the_camera():
    q, centre = np.array([0.0, 0.0, -66.0]), np.zeros(3)
    _, out, _ = gradients(q, centre, DOWN, coefficients(PLAIN), WATERS["level"], no_surface())
    close(out, differences(q, centre, DOWN, coefficients(PLAIN), WATERS["level"], no_surface()))


@pytest.mark.parametrize("bend", [(0.0, 0.0, 0.0), (4e-4, -3e-4, 6e-4)], ids=["flat", "bent"])
def test_gradients_through_water_of_second_order(bend):
    """A bend of 4e-4 / m is 4 cm in 10 m, which no water has."""
    surface = no_surface()._replace(curved=True)
    water = (-60.0, 0.01, -0.02, 1.34, *bend)
    for seed in range(3):
        centre, rotation = pose(seed)
        q = np.array([*np.random.default_rng(seed + 50).uniform(-12.0, 12.0, 2), -68.0])
        _, out, _ = gradients(q, centre, rotation, coefficients(BROWN), water, surface)
        close(out, differences(q, centre, rotation, coefficients(BROWN), water, surface))


@pytest.mark.parametrize("port", [
    FlatPort(0.02, 0.008), FlatPort(0.02, 0.0, 1.49, (0.05, -0.03, 1.0)),
    DomePort(0.05, 0.004, 1.49, (0.003, -0.002, 0.006)),
])  # fmt: skip
def test_gradients_by_the_port(port):
    surface = no_surface()._replace(port=port_coefficients(port))
    is_flat = isinstance(port, FlatPort)
    of_port = (port.distance_m, 0.0, 0.0, 0.0) if is_flat else (0.0, *port.centre_m)
    water = (0.0, 0.0, 0.0, 1.34, 0.0, 0.0, 0.0, *of_port)
    known = WATER + (np.array([PORT]) if is_flat else np.arange(PORT + 1, len(water)))
    centre, rotation = pose(5)
    q, lens = centre + rotation.T @ [0.9, -0.7, 3.0], coefficients(PLAIN)
    _, out, _ = gradients(q, centre, rotation, lens, water, surface)
    wanted = differences(q, centre, rotation, lens, water, surface)
    close(out[:, known], wanted[:, known])
    close(out[:, WATER + 3], wanted[:, WATER + 3])


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.02, -0.03)])
def test_gradients_through_a_raster(slope):
    """Of a raster that is a plane: its slope does not change with the place."""
    surface, water, lens = planar_raster(*slope), (0.2, 0.0, 0.0, 1.34), coefficients(BROWN)
    centre, rotation = pose(4)
    q = np.array([7.0, -9.0, -66.0])
    uv, out, _ = gradients(q, centre, rotation, lens, water, surface)
    wanted = differences(q, centre, rotation, lens, water, surface)
    known = [*range(10), 12]  # slopes cannot be free over a raster
    close(out[:, known], wanted[:, known])
    plane = (-60.0 + water[0], *slope, 1.34)
    # px: the raster's corners are the plane's to rounding
    np.testing.assert_allclose(uv, at(q, centre, rotation, lens, plane, no_surface()), atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_gradients_by_the_lens(name):
    lens = LENSES[name]
    names = ["f", "cx", "cy", "b1", "b2", "k1", "k2", "k3"]
    if lens.tangential:
        names += ["p1", "p2"]
    codes = np.array([CODES[n] for n in names])
    centre, rotation = pose(7)
    q, out = np.array([9.0, -8.0, -66.0]), np.empty((2, len(codes)))
    _, _, ahead = gradients(q, centre, rotation, coefficients(lens), WATERS["tilted"], no_surface())
    lens_gradients(coefficients(lens), ahead, codes, out)
    wanted = []
    for i, code in enumerate(codes):
        step = 1e-3 if names[i] in ("f", "cx", "cy", "b1", "b2") else 1e-6
        ends = [
            at(
                q, centre, rotation,
                coefficients(moved_lens(lens, (int(code),), np.array([sign * step]))),
                WATERS["tilted"], no_surface(),
            )
            for sign in (1.0, -1.0)
        ]  # fmt: skip
        wanted.append((ends[0] - ends[1]) / (2.0 * step))
    wanted = np.column_stack(wanted)
    # px per unit of the parameter; rounding of u (4000 px) over the step
    np.testing.assert_allclose(out, wanted, rtol=1e-6, atol=2e-5)


def test_columns_of_a_similarity():
    """A shift, turn and scale of all poses together, about a pivot."""
    centre, rotation = pose(9)
    lens, water, q = coefficients(BROWN), np.array(WATERS["tilted"]), np.array([6.0, 5.0, -65.0])
    pivot = np.array([3.0, -14.0, 2.0])
    state, seen = one(q, centre, rotation, lens_table((BROWN,))[1][0], water)
    nothing = PointPriors(np.zeros((1, 3)), np.zeros((1, 3)))
    columns = columns_of([()], [False] * len(WATER_NAMES), True, pivot)
    own, shared = np.empty((2, WIDTH)), np.zeros((2, 7))
    given = Given(seen, no_surface(), columns, nothing)
    assert linearise(state, given, Loss(), 0, 0, scratch(), own, shared, np.empty(2))
    assert not own[:, :6].any()  # the poses do not move on their own
    wanted = []
    for i in range(7):
        ends = []
        step = 1e-4 if i < 3 else 1e-6
        for sign in (1.0, -1.0):
            by = np.zeros(7)
            by[i] = sign * step
            turn = Rotation.from_rotvec(by[3:6]).as_matrix()
            moved = pivot + by[:3] + (1.0 + by[6]) * turn @ (centre - pivot)
            ends.append(at(q, moved, rotation @ turn.T, lens, water, no_surface()))
        wanted.append((ends[0] - ends[1]) / (2.0 * step))
    close(shared, np.column_stack(wanted))
