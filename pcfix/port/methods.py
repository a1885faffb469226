"""The correction of a cloud that was taken through a housing port: choose, intersect, invert."""

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
    """Return where the points of a cloud are that straight rays made under water, and how well.

    The parameters, errors and result are those of `intersect_through_port`; besides, `sigma_z_m`
    and `covariance_m2` are filled, of `pcfix.port.inversion.port_covariances`.
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
    """Return where the points of a cloud are that straight rays made under water.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Points where straight rays put them, metres, world frame; all of them under water.
    cameras : Cameras
        Poses that are right, world frame, and lenses; a lens that has taken on what the port does
        belongs to `pcfix adjust` first.
    port : Port
        The same before each camera.
    settings : ScienceOptions
        Refractive index of the water; the largest angle is that in air at the inner face, and of
        more than the most cameras those with the smallest are taken. With the method consistent
        the residuals of the straight rays count, with any other they are taken for zero.
    views : Views, optional
        The cameras of each point. Without it, every camera whose frame holds it: with the method
        consistent the image of the true point must be in the frame, with others the apparent one.

    Returns
    -------
    found : Intersection
        One row per input point, in the same order. The miss is that of the rays through the
        apparent point, the incidence that in air at the inner face.
    chosen : Views
        The cameras that were used.

    Raises
    ------
    SettingError
        If the cameras have no angles, or the method consistent finds no lenses.

    Notes
    -----
    Snell's law at each face (Skarlatos & Agrafiotis 2018, eq 10), then the point nearest to all
    rays (eq 11).
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
"""A point at the border of an image may go in and out; it stays as it is after so many rounds."""


def _intersect_chosen(
    xyz: FloatArray, chosen: Views, cameras: Cameras, port: Port, settings: ScienceOptions
) -> Intersection:
    """Intersect the rays through apparent points, shape (m, 3), with their cameras known."""
    owner = np.repeat(np.arange(len(xyz)), np.diff(chosen.start))
    ray = xyz[owner] - cameras.centres[chosen.camera]
    looking = np.einsum("oij,oj->oi", rotations_of(cameras)[chosen.camera], ray)
    found = intersect_rays(xyz, looking, chosen, cameras, port, settings)
    if settings.method != "consistent":
        return found
    return consistent_through_port(xyz, chosen, cameras, port, settings, found)


def _other_rows(one: Views, other: Views) -> IntArray:
    """Return the points that have other cameras in one list than in the other."""
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
