"""Tie points: those that can be adjusted, their start values, and points of the cloud as such."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.lens.imaging import straight_images, unproject
from pcfix.model import Cameras, FloatArray, IntArray, TiePoints, Views

LEAST_VIEWS = 2
LEAST_ANGLE_DEG = 2.0
"""Between the rays of a tie point; the depth of points with smaller angles is hardly determined."""

LEAST_DETERMINANT = 1e-5
"""Of the normal matrix of unit rays: two at a third of a degree."""

TIE_POINTS = 150_000
"""At most; more reduce only the noise, which is no longer the largest error then."""


def some_ties(ties: TiePoints, rows: IntArray) -> TiePoints:
    """Return some of the tie points, in the given order."""
    first, counts = ties.views.start[rows], np.diff(ties.views.start)[rows]
    begin = np.cumsum(counts) - counts
    where = np.repeat(first - begin, counts) + np.arange(counts.sum())
    return TiePoints(ties.xyz[rows], ties.views.take(rows), ties.image_xy[where])


def usable_ties(ties: TiePoints, cameras: Cameras, most: int = TIE_POINTS) -> TiePoints:
    """Return the tie points that can be adjusted; a random part of them if there are very many.

    They have coordinates, two images or more, and a sufficient angle between their rays: twice the
    largest angle between a ray and the mean ray of its point.
    """
    seen = np.diff(ties.views.start) >= LEAST_VIEWS
    rows = np.flatnonzero(np.isfinite(ties.xyz).all(axis=1) & seen)
    some = some_ties(ties, rows)
    owner = np.repeat(np.arange(len(rows)), np.diff(some.views.start))
    ray = cameras.centres[some.views.camera] - some.xyz[owner]
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    mean = np.zeros((len(rows), 3))
    np.add.at(mean, owner, ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    cosine = np.full(len(rows), 1.0)
    np.minimum.at(cosine, owner, np.einsum("oi,oi->o", ray, mean[owner]))
    angle_deg = 2.0 * np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    rows = rows[angle_deg >= LEAST_ANGLE_DEG]
    if len(rows) > most:
        rows = np.sort(np.random.default_rng(0).choice(rows, most, replace=False))
    return some_ties(ties, rows)


def with_places(ties: TiePoints, cameras: Cameras) -> TiePoints:
    """Return tie points in which those without coordinates are intersected by straight rays.

    The sum of squared distances from the rays is minimised, which is good enough as a start.
    """
    lost = np.flatnonzero(~np.isfinite(ties.xyz).all(axis=1) & (np.diff(ties.views.start) >= 2))
    rotations, lenses = np.asarray(cameras.rotations), cameras.lenses or ()
    some = some_ties(ties, lost)
    owner, camera = np.repeat(np.arange(len(lost)), np.diff(some.views.start)), some.views.camera
    ray = np.full((len(owner), 3), np.nan)
    for c in np.unique(camera):
        ray[camera == c] = unproject(lenses[c], some.image_xy[camera == c]) @ rotations[c]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    middle = cameras.centres.mean(axis=0)
    normal, right = np.zeros((len(lost), 3, 3)), np.zeros((len(lost), 3))
    np.add.at(normal, owner, across)
    np.add.at(right, owner, np.einsum("oij,oj->oi", across, cameras.centres[camera] - middle))
    known = np.linalg.det(normal) > LEAST_DETERMINANT  # NaN is not
    xyz = ties.xyz.copy()
    xyz[lost[known]] = np.linalg.solve(normal[known], right[known][:, :, None])[:, :, 0] + middle
    return replace(ties, xyz=xyz)


def ties_of_cloud(
    xyz: FloatArray, views: Views, cameras: Cameras, least: int = LEAST_VIEWS
) -> TiePoints:
    """Return apparent points in enough images, shape (m, 3), as tie points with straight rays.

    The views say which cameras contributed to them, or have them in their frame.
    """
    owner = np.repeat(np.arange(len(xyz)), np.diff(views.start))
    image = straight_images(xyz[owner], np.asarray(views.camera), cameras)
    seen = np.isfinite(image).all(axis=1)
    counts = np.bincount(owner[seen], minlength=len(xyz))
    start = np.concatenate([[0], np.cumsum(counts)])
    tracks = Views(start, np.asarray(views.camera)[seen])
    return some_ties(TiePoints(xyz, tracks, image[seen]), np.flatnonzero(counts >= least))
