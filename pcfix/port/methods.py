"""Correct a cloud taken through a housing port: choose cameras, intersect, invert."""

from __future__ import annotations

import numpy as np

from pcfix.model import Cameras, FloatArray, IntArray, Outcome, Views
from pcfix.options.correct import ScienceOptions
from pcfix.port.intersection import intersect_rays, port_views, rotations_of
from pcfix.port.inversion import consistent_through_port, port_covariances
from pcfix.port.shapes import Port
from pcfix.refract.batch import Intersection
from pcfix.refract.methods import batches, joined
from pcfix.refract.tiling import spatial_order


def correct_through_port(
    xyz: FloatArray,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    views: Views | None = None,
) -> Intersection:
    """Correct points reconstructed with straight rays under water, with their uncertainty.

    As `intersect_through_port`, with `sigma_z_m` and `covariance_m2` of
    `pcfix.port.inversion.port_covariances`.
    """
    parts, order = [], spatial_order(xyz)
    for rows in batches(order):
        own_views = None if views is None else views.take(rows)
        found, chosen = intersect_through_port(xyz[rows], cameras, port, settings, own_views)
        covariance = port_covariances(xyz[rows] + found.shift_m, chosen, cameras, port, settings)
        covariance[found.outcome != Outcome.CORRECTED] = 0.0
        sigma_z = np.sqrt(covariance[:, 5])
        parts.append(found._replace(covariance_m2=covariance, sigma_z_m=sigma_z))
    return joined(parts, order, len(cameras))


def intersect_through_port(
    xyz: FloatArray,
    cameras: Cameras,
    port: Port,
    settings: ScienceOptions,
    views: Views | None = None,
) -> tuple[Intersection, Views]:
    """Correct points reconstructed with straight rays under water.

    Snell's law at each face (Skarlatos & Agrafiotis 2018, eq 10), then the point nearest to all
    rays (eq 11).

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Apparent points, metres, world frame; all of them under water.
    cameras : Cameras
        Correct poses, world frame, and lenses. (If the lens absorbed the port, run `pcfix adjust`
        first.)
    port : Port
        The same for all cameras.
    settings : ScienceOptions
        The incidence angle is that in air at the inner face. With the method consistent the
        residuals of the straight rays are used, with any other they are taken as zero.
    views : Views, optional
        The cameras of each point. Without it, every camera whose frame holds the image of the true
        point (method consistent) or of the apparent one (other methods).

    Returns
    -------
    found : Intersection
        One row per input point. The ray distance is that of the rays through the apparent point.
    chosen : Views
        The cameras that were used.

    Raises
    ------
    SettingError
        If the cameras have no angles, or the method consistent finds no lenses.
    """
    chosen = port_views(xyz, cameras, port, settings, views)
    found = _intersect_chosen(xyz, chosen, cameras, port, settings)
    if views is not None or settings.method != "consistent":
        return found, chosen
    for _ in range(ROUNDS):
        seen = port_views(xyz, cameras, port, settings, shift_m=found.shift_m)
        rows = _other_rows(chosen, seen)
        if not rows.size:
            break
        part = _intersect_chosen(xyz[rows], seen.take(rows), cameras, port, settings)
        found, chosen = _with_rows(found, part, rows), seen
    return found, chosen


ROUNDS = 6
"""At the border of an image a point may alternate in and out; after so many rounds it stays."""


def _intersect_chosen(
    xyz: FloatArray, chosen: Views, cameras: Cameras, port: Port, settings: ScienceOptions
) -> Intersection:
    """Intersect the rays through apparent points, shape (m, 3), of known cameras."""
    owner = np.repeat(np.arange(len(xyz)), np.diff(chosen.start))
    ray = xyz[owner] - cameras.centres[chosen.camera]
    looking = np.einsum("oij,oj->oi", rotations_of(cameras)[chosen.camera], ray)
    found = intersect_rays(xyz, looking, chosen, cameras, port, settings)
    if settings.method != "consistent":
        return found
    return consistent_through_port(xyz, chosen, cameras, port, settings, found)


def _other_rows(one: Views, other: Views) -> IntArray:
    """Return the points whose cameras differ between two lists."""
    same = np.diff(one.start) == np.diff(other.start)
    rows = np.flatnonzero(same)
    a, b = one.take(rows), other.take(rows)
    owner = np.repeat(rows, np.diff(a.start))
    same[owner[a.camera != b.camera]] = False
    return np.flatnonzero(~same)


def _with_rows(found: Intersection, part: Intersection, rows: IntArray) -> Intersection:
    """Return the result with some rows replaced."""
    values = found._asdict()
    for name in ("shift_m", "outcome", "ray_count", "ray_miss_m", "sigma_z_m", "incidence_deg"):
        values[name] = values[name].copy()
        values[name][rows] = getattr(part, name)
    values["camera_used"] = found.camera_used | part.camera_used
    return Intersection(**values)
