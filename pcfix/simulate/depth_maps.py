"""A cloud of fused depth maps, as OpenMVS and COLMAP make it.

Every image is a reference: along a ray of its own it has a depth, the one with the least residuals
in its neighbours, where each shows with noise what the reference sees there. One reference of a
point is picked by chance; its depth gives the place to which all references of the point look.
Depths that agree within 1 % with this place are fused: the weighted mean of the points on their
own rays, with weights confidence / depth^2 and a random confidence.

What a reference sees is on the bed, which near a point is taken as the tangent plane of the true
surface: refraction lets the rays of different images through one apparent place meet different
places of the bed. The true point is the same weighted mean of those places, so it lies on the
tangent plane.

The fused point itself lies a few centimetres beside the rays where the images are all on one
side: rays that pass it and also have it for their mean do not exist in general.

Departures from the programs: rays are not rounded to pixels, the local water plane of each image
(see `pcfix.simulate.water`) is that at the point for which the picture was begun, and a point is
fused once, not from whatever other points have left.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.model import Views
from pcfix.simulate.tracing import bed_points, piercing_points_of_planes, project
from pcfix.simulate.tracks import straight

if TYPE_CHECKING:
    from pcfix.model import Cameras, FloatArray, IntArray, Lens
    from pcfix.simulate.sight import Rig, Sight

AGREE = 0.01
LEAST_NEIGHBOURS = 2
LEAST_FUSED = 2
LEAST_CONFIDENCE = 0.3
_STEPS = 20
_CONVERGED_M = 1e-9


class DepthCloud(NamedTuple):
    """Points, shape (n, 3), what they are points of, and the fused cameras with weights."""

    xyz: FloatArray
    true_xyz: FloatArray
    views: Views


class Matching(NamedTuple):
    """What the depths of all references are found with.

    `water` has an anchor and a normal for each row of `sight`; `bed` for each point. Edge e
    compares the reference row ``reference[e]`` with the row ``neighbour[e]``, where its image
    point has the error ``noise[e]`` in pixels; edges are sorted by reference.
    """

    sight: Sight
    rig: Rig
    water: tuple[FloatArray, FloatArray]
    bed: tuple[FloatArray, FloatArray]
    reference: IntArray
    neighbour: IntArray
    noise: FloatArray


class Depths(NamedTuple):
    """Of some references: depth (m,), the point there and the place of the bed, both (m, 3)."""

    depth: FloatArray
    xyz: FloatArray
    bed: FloatArray


def fuse_depth_maps(
    bed: tuple[FloatArray, FloatArray],
    sight: Sight,
    rig: Rig,
    table: IntArray,
    rng: np.random.Generator,
) -> DepthCloud:
    """Return the fused point of each place of the bed.

    A point for which fewer than two depths agree stays where it is and has no cameras.

    Parameters
    ----------
    bed : tuple of array, shape (n, 3)
        Points of the true surface, and its unit normals.
    sight : Sight
    rig : Rig
    table : array, shape (k, c)
        Neighbours of each camera, -1 for none.
    rng : Generator
        Of noise and confidence.
    """
    matching = _matching(bed, sight, rig, table, rng)
    confidence = rng.uniform(LEAST_CONFIDENCE, 1.0, len(sight.point))
    place = straight(bed[0], sight, rig, sight.ideal)
    usable = np.unique(matching.reference)
    picked = usable[_picked(sight.point[usable], confidence[usable])]
    place[sight.point[picked]] = reference_depths(matching, place, picked).xyz
    found = reference_depths(matching, place, usable)
    agree = _agree(matching, place, usable, found.depth)
    references, found = usable[agree], Depths(*(part[agree] for part in found))
    point = sight.point[references]
    weight = confidence[references] / found.depth**2
    fused, true = (_means(v, weight, point, bed[0]) for v in (found.xyz, found.bed))
    count = np.bincount(point, minlength=len(fused))
    views = Views(
        np.concatenate([[0], np.cumsum(count)]),
        sight.camera[references],
        weight.astype(np.float32),
    )
    return DepthCloud(fused, true, views)


def _matching(
    bed: tuple[FloatArray, FloatArray],
    sight: Sight,
    rig: Rig,
    table: IntArray,
    rng: np.random.Generator,
) -> Matching:
    neighbour = sight.rows(len(table))[sight.point[:, None], table[sight.camera]]
    there = (neighbour >= 0) & (table[sight.camera] >= 0)
    there &= there.sum(axis=1, keepdims=True) >= LEAST_NEIGHBOURS
    reference, slot = np.nonzero(there)
    points, centres = bed[0][sight.point], rig.true.centres[sight.camera]
    return Matching(
        sight,
        rig,
        rig.water.tangent_planes(points, centres, sight.camera),
        bed,
        reference,
        neighbour[reference, slot],
        rng.normal(0.0, rig.image_noise_px, (len(reference), 2)),
    )


def _picked(point: IntArray, confidence: FloatArray) -> IntArray:
    """Return the row with the greatest confidence of each point; rows are sorted by point."""
    order = np.lexsort((confidence, point))
    last = np.append(point[1:] != point[:-1], True)[: len(point)]
    return np.asarray(order[last])


def _agree(matching: Matching, place: FloatArray, rows: IntArray, depth: FloatArray) -> np.ndarray:
    """Return which references have the depth of their point's place, where two at least have."""
    sight, rig = matching.sight, matching.rig
    point, camera = sight.point[rows], sight.camera[rows]
    _, expected = project(place[point], rig.given, camera, rig.optics.lens)
    agree = np.abs(depth - expected) <= AGREE * expected
    agree &= np.bincount(point[agree], minlength=len(place))[point] >= LEAST_FUSED
    return np.asarray(agree)


def _means(
    values: FloatArray, weight: FloatArray, point: IntArray, otherwise: FloatArray
) -> FloatArray:
    """Return weighted means of each point's rows, shape (n, 3), or the other value."""
    total = np.bincount(point, weight, len(otherwise))
    made, means = total > 0.0, otherwise.copy()
    for axis in range(3):
        # the sums are of differences, so that nothing is lost where the values are the same
        apart = weight * (values[:, axis] - otherwise[point, axis])
        means[made, axis] += np.bincount(point, apart, len(otherwise))[made] / total[made]
    return means


def reference_depths(matching: Matching, place: FloatArray, rows: IntArray) -> Depths:
    """Return the depth that each reference finds along its ray through a place.

    Parameters
    ----------
    matching : Matching
    place : array, shape (n, 3)
        Of each point.
    rows : array, shape (m,)
        References: sorted rows of ``matching.sight`` that have edges.
    """
    sight, rig = matching.sight, matching.rig
    point, camera, lens = sight.point[rows], sight.camera[rows], rig.optics.lens
    pixels, depth = project(place[point], rig.given, camera, lens)
    seen = bed_points(
        rig.true.centres[camera],
        _rays(pixels, rig.true, camera, lens),
        (matching.water[0][rows], matching.water[1][rows]),
        (matching.bed[0][point], matching.bed[1][point]),
        rig.water.refractive_index,
    )
    number = np.full(len(sight.point), -1)
    number[rows] = np.arange(len(rows))
    edges = np.flatnonzero(number[matching.reference] >= 0)
    owner, other = number[matching.reference[edges]], sight.camera[matching.neighbour[edges]]
    measured = _measured(matching, edges, seen[owner])
    origin, ray = rig.given.centres[camera], _rays(pixels, rig.given, camera, lens)
    depth = _best_depths((origin, ray, depth), owner, (measured, other), rig)
    return Depths(depth, origin + depth[:, None] * ray, seen)


def _measured(matching: Matching, edges: IntArray, seen: FloatArray) -> FloatArray:
    """Return where the neighbour of each edge shows a place of the bed, ideal pixels."""
    rig, row = matching.rig, matching.neighbour[edges]
    camera = matching.sight.camera[row]
    anchors, normals = (part[row] for part in matching.water)
    centres, n = rig.true.centres[camera], rig.water.refractive_index
    surface = piercing_points_of_planes(seen, centres, anchors, normals, n)
    ideal, _ = project(surface, rig.true, camera, rig.optics.lens)
    return rig.optics.to_ideal(rig.optics.to_image(ideal) + matching.noise[edges])


def _rays(pixels: FloatArray, cameras: Cameras, camera: IntArray, lens: Lens) -> FloatArray:
    """Return directions in the world whose component along the optical axis is 1, (m, 3)."""
    if cameras.rotations is None:
        raise ValueError("rays need cameras with angles")
    plane = (pixels - [lens.principal_x, lens.principal_y]) / lens.focal
    inside = np.column_stack([plane, np.ones(len(plane))])
    return np.asarray(np.einsum("mij,mi->mj", cameras.rotations[camera], inside))


def _best_depths(
    rays: tuple[FloatArray, FloatArray, FloatArray],
    owner: IntArray,
    measured: tuple[FloatArray, IntArray],
    rig: Rig,
) -> FloatArray:
    """Return the depths along rays with least squared residuals in other images, by Gauss-Newton.

    `rays` are origin, direction and a first depth; edge e belongs to the ray ``owner[e]`` and has
    measured pixels and a camera.
    """
    (origin, ray, depth), (pixels, camera) = rays, measured
    lens, rotations = rig.optics.lens, rig.given.rotations
    if rotations is None:
        raise ValueError("depths need cameras with angles")
    turned = np.einsum("mij,mj->mi", rotations[camera], ray[owner])
    for _ in range(_STEPS):
        xyz = (origin + depth[:, None] * ray)[owner]
        seen, z = project(xyz, rig.given, camera, lens)
        offset = (seen - [lens.principal_x, lens.principal_y]) / lens.focal
        slope = (lens.focal / z)[:, None] * (turned[:, :2] - offset * turned[:, 2:])
        right = np.bincount(owner, (slope * (pixels - seen)).sum(axis=1), len(depth))
        step = right / np.bincount(owner, (slope**2).sum(axis=1), len(depth))
        depth = depth + step
        if np.abs(step).max(initial=0.0) < _CONVERGED_M:
            break
    return np.asarray(depth)
