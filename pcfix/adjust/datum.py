"""Whether the datum of an adjusted block is good: GNSS positions enough, and without an offset.

An antenna's lever arm, another height datum or a wrong water level put all positions beside the
projection centres by the same way. The block follows them, focal length and heights take the
offset up, and residuals hardly show it; what speaks against it are the water level, control
points and strips that are flown to and fro.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.adjust.equations import solver, undamped
from pcfix.adjust.problem import gnss_weights, prepare
from pcfix.adjust.result import Adjusted
from pcfix.adjust.rounds import noise_px, with_sigma
from pcfix.model import FloatArray

UNKNOWN_M = 10.0
"""Standard deviation of an offset before; what stays near it is not determined."""

SIGMAS, OF_GNSS = 3.0, 2.0
"""An offset is said if it exceeds so many standard errors, and so many of a position: the smaller
ones are of lens parameters that were held, and move the bed by less."""

WEAK, FEW = 3.0, 6
"""A datum is weak if a centre's standard error exceeds so many of a position. From the cloud alone
there is none; then so many positions and control points are few."""

IN_LINE = 0.1
"""Spread of positions across over that along, below which they lie in a line."""

BED_GSD = 1.5
"""Standard error of the bed's heights, in ground pixels, from which it deserves a word."""

SIDES = (("to the right of", "to the left of"), ("ahead of", "behind"), ("above", "below"))
"""Seen from the projection centres, the upper edge of the image ahead."""


class Offset(NamedTuple):
    """GNSS minus projection centres to the right, ahead and up, shape (3,), metres."""

    m: FloatArray
    sigma_m: FloatArray


def offset_of(found: Adjusted) -> Offset | None:
    """Return the offset with which an adjusted block would fit best; None if all is held.

    It is one more unknown that all positions share; this is the step that it takes from where the
    block lies, with all others.
    """
    block = replace(
        found.block, cameras=found.cameras, xyz=found.xyz,
        sigma_px=np.where(found.used, found.block.sigma_px, np.inf),
    )  # fmt: skip
    problem, now = prepare(block, found.unknowns, found.origin)
    if found.numbers is not None:
        now = replace(now, state=now.state._replace(water=found.numbers))
    problem = with_sigma(problem, noise_px(problem, now))
    weight, ways = gnss_weights(block), _ways(np.asarray(found.cameras.rotations))
    with_centres = np.zeros((len(weight), 6, 3))
    with_centres[:, 3:] = weight[:, :, None] * ways.transpose(0, 2, 1)
    shared = np.zeros((problem.columns.total, 3))
    reduced = undamped(problem, now).reduced
    taken_up = np.vstack([with_centres.reshape(-1, 3), shared])[reduced.active]
    solve_for = solver(reduced)
    if solve_for is None or not taken_up.any():
        return None
    own = np.einsum("kij,kj,klj->il", ways, weight, ways) + np.eye(3) / UNKNOWN_M**2
    covariance = np.linalg.inv(own - taken_up.T @ solve_for(taken_up))
    right = -np.einsum("kij,kj->i", ways, weight * np.nan_to_num(found.gnss_residual_m))
    step = covariance @ (right - taken_up.T @ solve_for(reduced.right))
    return Offset(step, max(found.sigma0, 1.0) * np.sqrt(np.diag(covariance)))


def _ways(rotations: FloatArray) -> FloatArray:
    """Return right, ahead and up of each image in the world, shape (k, 3, 3)."""
    right = rotations[:, 0] * [1.0, 1.0, 0.0]
    right /= np.maximum(np.linalg.norm(right, axis=1), 1e-9)[:, None]
    up = np.broadcast_to([0.0, 0.0, 1.0], right.shape)
    return np.stack([right, np.cross(up, right), up], axis=1)


def datum_notes(found: Adjusted) -> list[str]:
    """Return a sentence if GNSS positions hold a block weakly, and one if they have an offset."""
    known = np.isfinite(found.gnss_residual_m)
    if not known.any() or found.unknowns.poses != "free" or found.unknowns.free_network:
        return []
    stated = float(np.median(found.block.gnss_sigma_m[known]))
    offset = None if found.source == "cloud" else offset_of(found)
    return _weakness(found, stated) + ([] if offset is None else _beside(found, offset, stated))


def _weakness(found: Adjusted, stated_m: float) -> list[str]:
    places, way = _line(found)
    control = sum(row.role == "control" for row in found.control)
    what = f"{len(places)} GNSS positions and {control} control points hold the block"
    remedy = "give positions of more images, spread over the block, or control points."
    if found.precision is None or found.source == "cloud":
        few = len(places) + control < FEW
        return [f"only {what} and say how much the cloud counts: {remedy}"] if few else []
    sigma = found.precision.centre_sigma_m.max(axis=1)
    if sigma.max() <= WEAK * stated_m:
        return []
    line = "" if way is None else ", the positions in a line"
    return [
        f"{what} weakly{line}: the standard error of its centres grows to {sigma.max():.2f} m"
        f" ({found.cameras.labels[int(sigma.argmax())]}), that of a position is {stated_m:.2f} m;"
        f" {remedy}"
    ]


def _line(found: Adjusted) -> tuple[FloatArray, FloatArray | None]:
    """Return the GNSS positions that count, and the direction of the line in which they lie."""
    places = found.block.gnss_xyz[np.isfinite(found.gnss_residual_m[:, :2]).all(axis=1)]
    if len(places) < 2:
        return places, None
    off = places[:, :2] - places[:, :2].mean(axis=0)
    _, spread, ways = np.linalg.svd(off, full_matrices=False)
    return places, np.append(ways[0], 0.0) if spread[1] < IN_LINE * spread[0] else None


def bed_notes(found: Adjusted) -> list[str]:
    """Return a sentence if the heights of the bed are known poorly: how, and what it comes from."""
    precision, used = found.precision, np.zeros(len(found.xyz), np.bool_)
    used[found.block.owner[found.used]] = True
    bed = found.is_wet & used
    if precision is None or precision.point_sigma_m is None or not bed.any():
        return []
    sigma_m = float(np.nanmedian(precision.point_sigma_m[bed, 2]))
    focal = float(np.median([lens.focal for lens in found.cameras.lenses or ()]))
    away_m = float(np.median(found.cameras.centres[:, 2]) - np.median(found.xyz[bed, 2]))
    gsd = sigma_m / (away_m / focal)
    if gsd < BED_GSD:
        return []
    why, (places, way) = "", _line(found)
    of_focal = precision.sigma_of("f")
    if way is not None and not any(row.role == "control" for row in found.control):
        about = np.asarray(found.cameras.rotations) @ way
        turn = np.einsum("ki,kij,kj->k", about, precision.pose_covariance[:, :3, :3], about)
        tilt = np.degrees(np.sqrt(np.median(turn)))
        why = (
            f" The {len(places)} GNSS positions lie in a line, so the tilt across it is known to"
            f" {tilt:.2f} degrees only: give control points beside it, or fly a second strip."
        )
    elif of_focal is not None and of_focal / focal * away_m > 0.5 * sigma_m:
        why = (
            f" Most of it is the focal length (standard error {of_focal:.2g}): give a calibrated"
            " lens, or control points."
        )
    return [f"the heights of the bed are known to {sigma_m:.2f} m ({gsd:.1f} ground pixels).{why}"]


def _beside(found: Adjusted, offset: Offset, stated_m: float) -> list[str]:
    least = np.maximum(SIGMAS * offset.sigma_m, OF_GNSS * stated_m)
    rows = zip(offset.m.tolist(), offset.sigma_m.tolist(), SIDES, strict=True)
    parts = [
        f"{abs(m):.2f} m {side[m < 0.0]} the projection centres (standard error {sigma:.2f} m)"
        for (m, sigma, side), limit in zip(rows, least, strict=True)
        if abs(m) > limit
    ]
    if not parts:
        return []
    level = ""
    if abs(offset.m[2]) > least[2] and found.water is not None:
        level = f", or a water level that is too {'low' if offset.m[2] > 0.0 else 'high'}"
    return [
        f"the GNSS positions lie {' and '.join(parts)}: an antenna's lever arm, another"
        f" datum{level}; the block followed them. Correct them, or leave them out where there are"
        " control points."
    ]
