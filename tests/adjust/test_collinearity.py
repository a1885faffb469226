"""Analytic derivatives of one observation against central differences."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import plain_block
from pcfix.adjust.collinearity import (
    SURFACE,
    WIDTH,
    State,
    image_and_all_gradients,
    lens_gradients,
    workspace,
)
from pcfix.adjust.parameters import CODES, PLANES, PORT, SHAPE, Unknowns, moved_lens
from pcfix.adjust.problem import port_of, prepare
from pcfix.lens.formulas import coefficients
from pcfix.model import Cameras, Lens, TiePoints, Views, WaterPlane
from pcfix.port.housing import DomePort, FlatPort, window_of
from tests.utils.compiled import compiled

image_and_all_gradients = compiled(image_and_all_gradients)
lens_gradients = compiled(lens_gradients)

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
# Relative to the largest of a row: central differences of 0.1 mm steps are good to 1e-7 or so.
NEAR = 2e-6


def given_of(**changes):
    """Return one camera and one point, under water where it lies below it."""
    cameras = Cameras(("a",), np.zeros((1, 3)), DOWN[None], (PLAIN,))
    ties = TiePoints(np.zeros((1, 3)), Views(np.array([0, 1]), np.array([0])), np.zeros((1, 2)))
    block = plain_block(cameras, ties, WaterPlane(-60.0), 1.34, np.array([True]))
    return prepare(block, Unknowns(lens=()))[0].given._replace(**changes)


def pose(seed: int):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("zyx", rng.uniform([-180, -15, -15], [180, 15, 15]), degrees=True)
    return rng.uniform(-5.0, 5.0, 3), DOWN @ turn.as_matrix()


def at(q, centre, rotation, lens, water, given, port=None):
    return gradients(q, centre, rotation, lens, water, given, port)[0]


def gradients(q, centre, rotation, lens, water, given, port=None):
    work, out = workspace(given), np.zeros((2, WIDTH))
    numbers = np.pad(np.asarray(water, float), (0, PLANES - len(water)))
    port = window_of(port_of(SimpleNamespace(port=port), numbers))
    state = State(centre[None], rotation[None], lens[None], q[None], numbers, port)
    uv = image_and_all_gradients(state, given, 0, 0, work, out)
    return np.array(uv), out[:, : SURFACE + len(water)], work.ahead


def differences(q, centre, rotation, lens, water, surface, port=None):
    """Return the derivatives by omega, C, Q and the water's numbers, by central differences."""
    columns = []
    for i in range(SURFACE + len(water)):
        ends = []
        # metres; 1/m; radians, slopes, index and metres of a port
        step = 1e-4 if 3 <= i <= SURFACE else 1e-8 if SHAPE <= i - SURFACE < PORT else 1e-6
        for sign in (1.0, -1.0):
            moved = [q.copy(), centre.copy(), rotation, np.array(water, float)]
            if i < 3:
                omega = np.zeros(3)
                omega[i] = sign * step
                moved[2] = Rotation.from_rotvec(omega).as_matrix() @ rotation
            elif i < 6:
                moved[1][i - 3] += sign * step
            elif i < SURFACE:
                moved[0][i - 6] += sign * step
            else:
                moved[3][i - SURFACE] += sign * step
            ends.append(at(moved[0], moved[1], moved[2], lens, moved[3], surface, port))
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.column_stack(columns)


def close(found, wanted):
    scale = np.abs(wanted).max(axis=0) + 1e-3 * np.abs(wanted).max()
    np.testing.assert_array_less(np.abs(found - wanted) / scale, NEAR)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("water", WATERS)
@pytest.mark.parametrize("z", [-68.0, -60.9, -55.0])
def test_gradients(name, water, z):
    lens, given = coefficients(LENSES[name]), given_of()
    for seed in range(3):
        centre, rotation = pose(seed)
        q = np.array([*np.random.default_rng(seed + 50).uniform(-12.0, 12.0, 2), z])
        _, out, _ = gradients(q, centre, rotation, lens, WATERS[water], given)
        close(out, differences(q, centre, rotation, lens, WATERS[water], given))
    if z == -55.0:
        assert not out[:, SURFACE:].any()  # above the water nothing depends on it


@pytest.mark.parametrize("port", [
    FlatPort(0.02, 0.008), FlatPort(0.02, 0.0, 1.49, (0.05, -0.03, 1.0)),
    DomePort(0.05, 0.004, 1.49, (0.003, -0.002, 0.006)),
])  # fmt: skip
def test_port(port):
    surface = given_of(wet=np.array([False]))
    is_flat = isinstance(port, FlatPort)
    of_port = (port.distance_m, 0.0, 0.0, 0.0) if is_flat else (0.0, *port.centre_m)
    water = (0.0, 0.0, 0.0, 1.34, 0.0, 0.0, 0.0, *of_port)
    known = SURFACE + (np.array([PORT]) if is_flat else np.arange(PORT + 1, len(water)))
    centre, rotation = pose(5)
    q, lens = centre + rotation.T @ [0.9, -0.7, 3.0], coefficients(PLAIN)
    _, out, _ = gradients(q, centre, rotation, lens, water, surface, port)
    wanted = differences(q, centre, rotation, lens, water, surface, port)
    close(out[:, known], wanted[:, known])
    close(out[:, SURFACE + 3], wanted[:, SURFACE + 3])


@pytest.mark.parametrize("name", LENSES)
def test_lens(name):
    lens = LENSES[name]
    names = ["f", "cx", "cy", "b1", "b2", "k1", "k2", "k3"]
    if lens.tangential:
        names += ["p1", "p2"]
    codes = np.array([CODES[n] for n in names])
    centre, rotation = pose(7)
    q, out = np.array([9.0, -8.0, -66.0]), np.empty((2, len(codes)))
    _, _, ahead = gradients(q, centre, rotation, coefficients(lens), WATERS["tilted"], given_of())
    lens_gradients(coefficients(lens), ahead, codes, out)
    wanted = []
    for i, code in enumerate(codes):
        step = 1e-3 if names[i] in ("f", "cx", "cy", "b1", "b2") else 1e-6
        ends = [
            at(
                q, centre, rotation,
                coefficients(moved_lens(lens, (int(code),), np.array([sign * step]))),
                WATERS["tilted"], given_of(),
            )
            for sign in (1.0, -1.0)
        ]  # fmt: skip
        wanted.append((ends[0] - ends[1]) / (2.0 * step))
    wanted = np.column_stack(wanted)
    # px per unit of the parameter; rounding of u (4000 px) over the step
    np.testing.assert_allclose(out, wanted, rtol=1e-6, atol=2e-5)
