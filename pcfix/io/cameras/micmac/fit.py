"""The nearest Lens to a calibration that Brown's model does not hold whole."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks

if TYPE_CHECKING:
    from pcfix.io.cameras.micmac.calibration import Calibration
    from pcfix.model import FloatArray, Lens

RINGS, SPOKES = 40, 72
FEWEST = 200
ROUNDS = 12
ROOM = 1.3
"""How far the sampling goes beyond the corners of the frame, as distortion may draw them in."""

FISHEYE_TERMS, TERMS = 8, 6


def nearest(calibration: Calibration) -> tuple[Lens, float]:
    """Return the lens, and the largest distance in the frame from the calibration, pixels.

    Raises
    ------
    InputError
        If the calibration cannot be one.
    """
    plain = calibration.brown()
    with np.errstate(all="ignore"):
        plane, image = _samples(calibration)
    fisheye = next((s.fisheye for s in calibration.steps if s.fisheye), None)
    lens = replace(plain, radial=(), tangential=(), inverse=False)
    terms = TERMS
    if fisheye:
        # tan t = (F / fisheye) tan(theta): the fov projection with this shape
        shape = 2.0 * np.arctan(calibration.focal / fisheye / 2.0)
        plane, terms = _fov(plane, shape), FISHEYE_TERMS
        lens = replace(
            lens,
            focal=fisheye * shape,
            projection="fov",
            shape=(float(shape),),
            distortion_centre=(0.0, 0.0),
        )
    if len(image) < FEWEST:
        raise InputError(
            f"{calibration.path}: the distortion takes nearly nothing into the frame of"
            f" {calibration.width:g} x {calibration.height:g} pixels; the calibration is damaged."
        )
    try:
        fitted, miss = _fitted(lens, plane, image, terms)
    except np.linalg.LinAlgError as error:
        raise InputError(
            f"{calibration.path}: the distortion folds the frame ({error}); calibrate again."
        ) from error
    return checks.lens(calibration.path, calibration.name, fitted), miss


def _samples(calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """Return perspective plane coordinates all over the frame and their image positions."""
    c = calibration
    principal = np.array(c.principal)
    corners = np.array([[0, 0], [c.width, 0], [0, c.height], [c.width, c.height]])
    reach = float(np.hypot(*(corners - principal).T).max())
    if any(step.fisheye for step in c.steps):
        radius = c.focal * np.tan(np.linspace(0.0, np.radians(89.0), 2 * RINGS))
    else:
        radius = np.linspace(0.0, ROOM * reach, RINGS)
    turn = np.linspace(0.0, 2.0 * np.pi, SPOKES, endpoint=False)
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    given = principal + (radius[:, None, None] * ring).reshape(-1, 2)
    moved = c.move(given)
    ideal, image = (moved, given) if c.inverse else (given, moved)
    inside = (image >= 0.0).all(axis=1) & (image <= [c.width, c.height]).all(axis=1)
    inside &= np.isfinite(ideal).all(axis=1)
    if c.useful_radius:
        inside &= np.hypot(*(image - principal).T) <= c.useful_radius
    return (ideal[inside] - principal) / c.focal, image[inside]


def _fov(plane: FloatArray, shape: float) -> FloatArray:
    tangent = np.hypot(*plane.T)
    near = tangent < 1e-12
    radius = np.arctan(2.0 * np.tan(shape / 2.0) * tangent) / shape
    scale = np.where(near, 2.0 * np.tan(shape / 2.0) / shape, radius / np.where(near, 1.0, tangent))
    return np.asarray(plane * scale[:, None])


def _fitted(lens: Lens, plane: FloatArray, image: FloatArray, terms: int) -> tuple[Lens, float]:
    """Fit affinity, principal point and Brown's model by least squares.

    With the affinity held, everything else is linear; what is left of an affinity in each round
    goes into the next one.
    """
    centre = np.array(lens.distortion_centre)
    columns = _columns(plane - centre, terms)
    affine = np.diag([lens.focal, lens.focal])
    shift = np.array([lens.principal_x, lens.principal_y])
    for _ in range(ROUNDS):
        seen = (image - shift) @ np.linalg.inv(affine).T - plane
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0.0] = 1.0
        found = np.linalg.lstsq(columns / scale, seen.T.ravel(), rcond=None)[0] / scale
        turn, move = np.eye(2) + found[-4:].reshape(2, 2), found[-6:-4]
        shift = shift + affine @ (move - found[-4:].reshape(2, 2) @ centre)
        affine = affine @ turn
    k, p, s = found[:terms], found[terms : terms + 2], found[terms + 2 : terms + 6]
    bent = plane + (columns[:, :-6] @ found[:-6]).reshape(2, -1).T
    miss = np.hypot(*(bent @ affine.T + shift - image).T).max()
    fitted = replace(
        lens,
        focal=float(affine[1, 1]),
        b1=float(affine[0, 0] - affine[1, 1]),
        b2=float(affine[0, 1]),
        b3=float(affine[1, 0]),
        principal_x=float(shift[0]),
        principal_y=float(shift[1]),
        radial=tuple(k.tolist()),
        tangential=tuple(p.tolist()),
        thin_prism=tuple(s.tolist()),
    )
    return fitted, float(miss)


def _columns(away: FloatArray, terms: int) -> FloatArray:
    """Return the design matrix: x of all samples, then y; k, p1 p2, s1 to s4, shift, affinity."""
    x, y = away.T
    r2, zero, one = x * x + y * y, np.zeros_like(x), np.ones_like(x)
    pairs = [(x * r2**i, y * r2**i) for i in range(1, terms + 1)]
    pairs += [(r2 + 2 * x * x, 2 * x * y), (2 * x * y, r2 + 2 * y * y)]
    pairs += [(r2, zero), (r2 * r2, zero), (zero, r2), (zero, r2 * r2)]
    pairs += [(one, zero), (zero, one), (x, zero), (y, zero), (zero, x), (zero, y)]
    return np.column_stack([np.concatenate(pair) for pair in pairs])
