"""Lenses: round trips, the slow implementation, and the fold of the distortion."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pcfix
from pcfix.lens.formulas import coefficients
from pcfix.lens.imaging import image_and_gradients, project, unproject
from tests.utils.compiled import compiled
from tests.utils.twins import brown_slowly, image_slowly

image_and_gradients = compiled(image_and_gradients)

RELATIVE = 1e-10  # of the focal length: a millionth of a pixel

KINDS = {
    "perspective": (3000.0, st.just(())),
    "equidistant": (1000.0, st.just(())),
    "equisolid": (1600.0, st.just(())),
    "polynomial": (
        1600.0,
        st.tuples(st.just(0.0), st.just(1.0), st.floats(-0.05, 0.05), st.floats(-0.15, 0.05)),
    ),
    "fov": (2500.0, st.tuples(st.floats(0.3, 1.2))),
    "dual": (2500.0, st.tuples(st.floats(0.1, 0.9))),
    "division": (2500.0, st.tuples(st.floats(-0.4, -0.01) | st.floats(0.01, 0.2))),
    "eucm": (1500.0, st.tuples(st.floats(0.2, 0.8), st.floats(0.7, 1.5))),
}


def small(most, **count):
    return st.lists(st.floats(-most, most), **count).map(tuple)


@st.composite
def lenses(draw):
    """Draw a lens of a drone or a fisheye, 4000 by 3000 pixels."""
    projection = draw(st.sampled_from(sorted(KINDS)))
    focal, shape = KINDS[projection]
    far = 2500.0 / focal  # of the corners, in plane coordinates
    k = [draw(st.floats(-0.12, 0.12)) / far ** (2 * i + 2) for i in range(draw(st.integers(0, 4)))]
    d = [draw(st.floats(0.0, 0.1)) / far ** (2 * i + 2) for i in range(draw(st.integers(0, 3)))]
    return pcfix.Lens(
        focal * draw(st.floats(0.95, 1.2)), 4000.0, 3000.0,
        draw(st.floats(1900, 2100)), draw(st.floats(1400, 1600)),
        b1=draw(st.floats(-20, 20)), b2=draw(st.floats(-20, 20)), b3=draw(st.floats(-5, 5)),
        projection=projection, shape=draw(shape), radial=tuple(k), denominator=tuple(d),
        tangential=draw(small(3e-3, max_size=4)), thin_prism=draw(small(2e-3, max_size=4)),
        distortion_centre=draw(st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))),
        inverse=draw(st.booleans()), in_turn=draw(st.booleans()),
    )  # fmt: skip


def image_grid(n=13):
    u, v = np.meshgrid(np.linspace(0, 4000, n), np.linspace(0, 3000, n))
    return np.column_stack([u.ravel(), v.ravel()])


def one(lens, *place):
    return unproject(lens, np.array([place]))[0]


@given(lens=lenses())
def test_round_trip_from_image(lens):
    image = image_grid()
    directions = unproject(lens, image)
    there = np.isfinite(directions).all(axis=1)
    assert there[len(image) // 2]  # the middle of an image is always one
    assert np.linalg.norm(directions[there], axis=1) == pytest.approx(1.0, abs=1e-14)
    assert np.abs(project(lens, directions)[there] - image[there]).max() <= RELATIVE * lens.focal


@given(lens=lenses(), seed=st.integers(0, 2**32 - 1))
def test_round_trip_from_direction(lens, seed):
    directions = np.random.default_rng(seed).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    image = project(lens, directions)
    near = (np.abs(image - (2000, 1500)) < 6000).all(axis=1)  # NaN is not near
    back = unproject(lens, image[near])
    # a place is 1e-10 of the focal length sharp; near a fold a direction is less so, by the
    # derivative of the inverse, but it never is on the other side: that is degrees away
    assert np.linalg.norm(back - directions[near], axis=1).max(initial=0.0) < 1e-4
    assert np.median(np.linalg.norm(back - directions[near], axis=1)) < 1e-9 or not near.any()


@given(lens=lenses())
def test_slow_implementation(lens):
    directions = unproject(lens, image_grid(5))
    for direction in directions[np.isfinite(directions).all(axis=1)]:
        u, v = project(lens, 3.7 * direction[None])[0]  # the length does not matter
        # where the formula has little slope, the twin's inversion and mine differ by more
        assert (u, v) == pytest.approx(image_slowly(lens, direction), abs=1e-7 * lens.focal)


@given(lens=lenses())
def test_gradients(lens):
    directions, h = unproject(lens, image_grid(3)), 1e-6
    for direction in directions[np.isfinite(directions).all(axis=1)]:
        gradients = image_and_gradients(coefficients(lens), *direction)[2]
        ends = [project(lens, direction + way * h * np.eye(3)) for way in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * h)
        if np.isfinite(expected).all():
            found = np.reshape(gradients, (2, 3)).T
            assert found == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_brown_terms_by_hand():
    """Metashape's order of p1 and p2, b1 and b2 in the first row, from its manual's formulas."""
    lens = pcfix.Lens(
        1000.0, 2000.0, 1000.0, 1010.0, 495.0, b1=7.0, b2=3.0,
        radial=(0.1, 0.01), tangential=(0.002, 0.0005),
    )  # fmt: skip
    x, y, r2 = 0.3, -0.2, 0.13
    g = 1 + 0.1 * r2 + 0.01 * r2**2
    xd = x * g + 0.002 * (r2 + 2 * 0.09) + 2 * 0.0005 * x * y
    yd = y * g + 0.0005 * (r2 + 2 * 0.04) + 2 * 0.002 * x * y
    expected = (1010 + 1000 * xd + 7 * xd + 3 * yd, 495 + 1000 * yd)
    assert project(lens, np.array([[x, y, 1.0]]))[0] == pytest.approx(expected, abs=1e-10)


SIZE = (4000.0, 3000.0, 2000.0, 1500.0)
FOLDING = pcfix.Lens(1000.0, *SIZE, radial=(-0.6,))
FOLD = math.sqrt(1.0 / 1.8)  # 1 - 3 * 0.6 r^2 = 0


def test_beyond_the_fold():
    radii = np.array([0.0, 0.5, FOLD - 1e-6, FOLD + 1e-6, 1.0, 1.29, 50.0])
    image = project(FOLDING, np.column_stack([radii, 0 * radii, 1 + 0 * radii]))
    assert np.isfinite(image[:3]).all()
    assert np.isnan(image[3:]).all()
    assert 0 < 1000 * brown_slowly(FOLDING, 1.29, 0.0)[0] < 3  # it would be in the middle
    farthest = 2000 + 1000 * FOLD * (1 - 0.6 * FOLD**2)
    assert np.isfinite(one(FOLDING, farthest - 1e-6, 1500.0)).all()
    assert np.isnan(one(FOLDING, farthest + 1e-6, 1500.0)).all()
    assert np.isnan(one(FOLDING, 3999.0, 2999.0)).all()


def test_fold_of_inverse_formula():
    """With the inverse formula the fold bounds the image, not the directions."""
    lens = pcfix.Lens(1000.0, *SIZE, radial=(-0.6,), inverse=True)
    assert np.isfinite(one(lens, 2000 + 999.999 * FOLD, 1500.0)).all()
    assert np.isnan(one(lens, 2000 + 1000.001 * FOLD, 1500.0)).all()
    widest = FOLD * (1 - 0.6 * FOLD**2)
    image = project(lens, np.array([[widest - 1e-9, 0, 1], [widest + 1e-9, 0, 1], [3, 0, 1.0]]))
    assert image[0] == pytest.approx((2000 + 1000 * FOLD, 1500), abs=0.1)
    assert np.isnan(image[1:]).all()


def test_strong_tangential_terms():
    lens = pcfix.Lens(1000.0, *SIZE, tangential=(0.03, -0.01))
    rng = np.random.default_rng(4)
    plane = rng.uniform(-1, 1, (20_000, 2)) * 10 ** rng.uniform(-1, 3, (20_000, 1))
    directions = np.column_stack([plane, np.ones(len(plane))])
    image = project(lens, directions)
    seen = np.isfinite(image).all(axis=1)
    assert 0.2 < seen.mean() < 0.9
    back = unproject(lens, image[seen])
    assert back[:, :2] / back[:, 2:] == pytest.approx(plane[seen], abs=1e-6)


def test_behind_the_camera():
    behind = np.array([[0.1, 0.2, -1.0], [0, 0, -1.0], [1, 0, 0.0], [0, 0, 0.0], [np.nan, 0, 1]])
    for kind, shape, seen in (
        ("perspective", (), []),
        ("equidistant", (), [0, 2]),  # beside and a little behind; the others have no azimuth
        ("equisolid", (), [0, 2]),
        ("fov", (0.9,), [2]),  # beside is the end of its image
    ):
        lens = pcfix.Lens(800.0, *SIZE, projection=kind, shape=shape)
        found = np.isfinite(project(lens, behind)).all(axis=1)
        assert np.flatnonzero(found).tolist() == seen


def test_fisheye_beyond_90_deg():
    lens, angle = pcfix.Lens(900.0, *SIZE, projection="equidistant"), math.radians(120)
    direction = np.array([[math.sin(angle), 0.0, math.cos(angle)]])
    image = project(lens, direction)
    assert image[0] == pytest.approx((2000 + 900 * angle, 1500), abs=1e-9)
    assert unproject(lens, image) == pytest.approx(direction, abs=1e-12)
    assert np.isnan(one(lens, 2000 + 900 * 3.2, 1500.0)).all()  # more than half a turn


def test_ends_of_the_projections():
    """A polynomial that turns back, the division model's pole, a shape that is none."""
    base = (1000.0, *SIZE)
    turning = pcfix.Lens(*base, projection="polynomial", shape=(0.0, 1.0, 0.0, -0.5))
    q = math.sqrt(2 / 3)  # 1 - 1.5 q^2 = 0
    for share, seen in ((0.999, True), (1.001, False)):
        theta = share * q * math.pi / 2
        image = project(turning, np.array([[math.sin(theta), 0.0, math.cos(theta)]]))
        assert np.isfinite(image).all() == seen
    division = pcfix.Lens(*base, projection="division", shape=(0.25,))
    image = project(division, np.array([[0.999, 0, 1], [1.001, 0, 1.0]]))  # m = 2 at tan = 1
    assert np.isfinite(image).all(axis=1).tolist() == [True, False]
    nothing = pcfix.Lens(*base, projection="polynomial", shape=(0.0, -1.0))
    assert np.isnan(project(nothing, np.array([[0.1, 0.1, 1.0]]))).all()
