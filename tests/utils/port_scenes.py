"""A scene under water, taken through the port of a housing, with known truth.

Where the light from a point to a projection centre passes the faces of the port is found by
Fermat's principle: the optical path, length times refractive index summed over air, glass and
water, is the shortest. Nothing here is shared with the correction, which has Snell's law instead.

All arrays of `fermat_directions` are flat over (point, camera) pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.model import Cameras, FloatArray, Lens, Views
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.port.shapes import DomePort, FlatPort, Port
from pcfix.simulate.tracing import triangulate

_NEWTON_STEPS = 60
_CONVERGED_M = 1e-13
_AXIAL_M = 1e-13
_ORIGIN = np.array([512_000.0, 4_987_000.0, -12.0])


@dataclass(frozen=True, eq=False)
class PortScene:
    """A scene, its images and what software makes of them that knows nothing of the port.

    Attributes
    ----------
    cameras : Cameras
        As they really were, lens included.
    port : Port
    refractive_index : float
        Of the water.
    truth : array, shape (n, 3)
        Metres, world frame.
    views : Views
        Which cameras saw each point; two at least.
    image_xy : array, shape (o, 2)
        Where, one row per entry of ``views.camera``: pixels, with noise.
    apparent : array, shape (n, 3)
        The least squared reprojection errors over straight rays from the true cameras.
    """

    cameras: Cameras
    port: Port
    refractive_index: float
    truth: FloatArray
    views: Views
    image_xy: FloatArray
    apparent: FloatArray


def simulate_port(
    port: Port,
    *,
    points: int = 1000,
    columns: int = 4,
    rows: int = 3,
    spacing_m: float = 0.5,
    range_m: float = 3.0,
    relief_m: float = 0.4,
    tilt_deg: float = 8.0,
    noise_px: float = 0.0,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    seed: int = 0,
) -> PortScene:
    """Return a block of images of a rough bed.

    Parameters
    ----------
    port : Port
    points : int
        To begin with; those that fewer than two cameras see are left out.
    columns, rows, spacing_m
        Of the projection centres, which lie nearly in a level plane.
    range_m, relief_m : float
        Mean distance of the bed from them, and its standard deviation.
    tilt_deg : float
        Standard deviation of the attitude about each axis; straight down is the mean.
    noise_px : float
        Standard deviation of an image coordinate.
    refractive_index : float
    seed : int
    """
    rng = np.random.default_rng(seed)
    cameras = _rig(rng, columns, rows, spacing_m, tilt_deg)
    reach = spacing_m * np.array([columns, rows]) / 2.0
    plan = rng.uniform(-reach, reach, (points, 2))
    truth = np.column_stack([plan, rng.normal(-range_m, relief_m, points)]) + _ORIGIN
    image, seen = images_of(truth, cameras, port, refractive_index)
    several = seen.sum(axis=1) >= 2
    truth, image, seen = truth[several], image[several], seen[several]
    point, camera = np.nonzero(seen)
    start = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
    measured = image[point, camera] + rng.normal(0.0, noise_px, (len(point), 2))
    lens = _LENS
    apparent = triangulate(measured, cameras, camera, start, lens, truth)
    return PortScene(
        cameras, port, refractive_index, truth, Views(start, camera), measured, apparent
    )


_LENS = Lens(focal=1500.0, width=2000.0, height=1500.0, principal_x=1004.0, principal_y=747.0)


def _rig(
    rng: np.random.Generator, columns: int, rows: int, spacing_m: float, tilt_deg: float
) -> Cameras:
    """Return cameras that look down, each a bit askew and turned about its axis."""
    from scipy.spatial.transform import Rotation

    k = columns * rows
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    centres = np.column_stack([spacing_m * x.ravel(), spacing_m * y.ravel(), np.zeros(k)])
    centres += rng.normal(0.0, 0.1 * spacing_m, (k, 3))
    askew = Rotation.from_euler("xyz", rng.normal(0.0, tilt_deg, (k, 3)), degrees=True)
    turned = Rotation.from_euler("z", rng.uniform(0.0, 360.0, (k, 1)), degrees=True)
    down = np.diag([1.0, -1.0, -1.0])
    return Cameras(
        tuple(f"port{i:03d}" for i in range(k)),
        centres + _ORIGIN,
        (turned * askew).as_matrix() @ down,
        (_LENS,) * k,
    )


def images_of(
    truth: FloatArray, cameras: Cameras, port: Port, n: float
) -> tuple[FloatArray, np.ndarray]:
    """Return where each camera images each point, shape (n, k, 2), and whether in its frame."""
    if cameras.rotations is None:
        raise ValueError("a port needs cameras with angles")
    ray = truth[:, None, :] - cameras.centres
    local = np.einsum("kij,nkj->nki", cameras.rotations, ray)
    direction = fermat_directions(local.reshape(-1, 3), port, n).reshape(local.shape)
    x, y = (_LENS.focal * direction[..., i] / direction[..., 2] for i in (0, 1))
    image = np.stack([x + _LENS.principal_x, y + _LENS.principal_y], axis=-1)
    frame = np.array([_LENS.width, _LENS.height])
    inside = ((image > 0.0) & (image < frame)).all(axis=-1)
    return image, inside & (direction[..., 2] > 0.0)


def fermat_directions(points: FloatArray, port: Port, n: float) -> FloatArray:
    """Return in which directions light from points comes to the projection centre.

    Parameters
    ----------
    points : array, shape (m, 3)
        In the water; camera frame, metres.
    port : Port
    n : float
        Refractive index of the water.

    Returns
    -------
    array, shape (m, 3)
        Unit vectors, camera frame.

    Raises
    ------
    ArithmeticError
        If no shortest path is found.
    """
    pivot, axis, faces = _plane_of_light(points, port)
    camera = -pivot if isinstance(port, DomePort) else np.zeros_like(pivot)
    target = points + camera
    # two coordinates in the plane of each path: along the axis, and across
    across = target - camera - _dot(target - camera, axis)[:, None] * axis
    length = np.linalg.norm(across, axis=1)
    # straight through the pole there is no across, but rounding
    across = np.where((length > _AXIAL_M)[:, None], across / np.maximum(length, 1e-300)[:, None], 0)
    ends = [np.column_stack([_dot(end, axis), _dot(end, across)]) for end in (camera, target)]
    indices = [1.0, port.glass_index, n] if len(faces) == 2 else [1.0, n]
    first = _shortest(ends[0], ends[1], faces, indices)
    place = first[:, :1] * axis + first[:, 1:] * across - camera
    return np.asarray(place / np.linalg.norm(place, axis=1)[:, None])


def _plane_of_light(
    points: FloatArray, port: Port
) -> tuple[FloatArray, FloatArray, list[_Plane | _Sphere]]:
    """Return the centre of the faces, an axis for each point, and the faces, inner one first."""
    if isinstance(port, FlatPort):
        axis = np.broadcast_to(np.array(port.normal), points.shape)
        at = [port.distance_m, port.distance_m + port.thickness_m]
        planes: list[_Plane | _Sphere] = [_Plane(x) for x in dict.fromkeys(at)]
        return np.zeros_like(points), axis, planes
    centre = np.broadcast_to(np.array(port.centre_m), points.shape)
    axis = points - centre
    radii = [port.radius_m, port.radius_m + port.thickness_m]
    spheres: list[_Plane | _Sphere] = [_Sphere(r) for r in dict.fromkeys(radii)]
    return centre, axis / np.linalg.norm(axis, axis=1)[:, None], spheres


@dataclass(frozen=True)
class _Plane:
    """A face across the axis: a place on it, by its height, with two derivatives."""

    x: float

    def at(self, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        zero = np.zeros_like(s)
        return (
            np.column_stack([zero + self.x, s]),
            np.column_stack([zero, zero + 1.0]),
            np.column_stack([zero, zero]),
        )

    def crossing(self, camera: FloatArray, target: FloatArray) -> FloatArray:
        share = (self.x - camera[:, 0]) / (target[:, 0] - camera[:, 0])
        return np.asarray(camera[:, 1] + share * (target[:, 1] - camera[:, 1]))


@dataclass(frozen=True)
class _Sphere:
    """A face about the origin: a place on it, by its arc (m), with two derivatives."""

    r: float

    def at(self, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        cosine, sine = np.cos(s / self.r), np.sin(s / self.r)
        return (
            self.r * np.column_stack([cosine, sine]),
            np.column_stack([-sine, cosine]),
            -np.column_stack([cosine, sine]) / self.r,
        )

    def crossing(self, camera: FloatArray, target: FloatArray) -> FloatArray:
        way = target - camera
        a, b = _dot(way, way), _dot(way, camera)
        t = (-b + np.sqrt(b * b + a * (self.r**2 - _dot(camera, camera)))) / a
        place = camera + t[:, None] * way
        return np.asarray(self.r * np.arctan2(place[:, 1], place[:, 0]))


def _shortest(
    camera: FloatArray, target: FloatArray, faces: list[_Plane | _Sphere], indices: list[float]
) -> FloatArray:
    """Return where the shortest optical path passes the first face, shape (m, 2).

    Newton's method on the places at the faces, from where the straight line passes them; a step
    that does not make the path shorter is halved.
    """
    s = np.column_stack([face.crossing(camera, target) for face in faces])
    for _ in range(_NEWTON_STEPS):
        length, gradient, hessian = _path(s, camera, target, faces, indices)
        step = -np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
        for _ in range(_NEWTON_STEPS):
            longer = _path(s + step, camera, target, faces, indices)[0] > length + 1e-14
            if not longer.any():
                break
            step[longer] *= 0.5
        s = s + step
        if np.abs(step).max(initial=0.0) < _CONVERGED_M:
            return faces[0].at(s[:, 0])[0]
    raise ArithmeticError("the shortest path through the port was not found")


def _path(
    s: FloatArray, camera: FloatArray, target: FloatArray, faces: list[_Plane | _Sphere],
    indices: list[float],
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return the optical length of paths, its gradient and its Hessian by the places s."""
    at = [face.at(s[:, i]) for i, face in enumerate(faces)]
    nodes = [camera, *(place for place, _, _ in at), target]
    count = len(faces)
    length = np.zeros(len(s))
    gradient, hessian = np.zeros((len(s), count)), np.zeros((len(s), count, count))
    for j, index in enumerate(indices):
        way = nodes[j + 1] - nodes[j]
        far = np.sqrt(_dot(way, way))
        unit = way / far[:, None]
        length += index * far
        ends = [(i, sign) for i, sign in ((j - 1, -1.0), (j, 1.0)) if 0 <= i < count]
        for i, sign in ends:
            gradient[:, i] += index * sign * _dot(unit, at[i][1])
            hessian[:, i, i] += index * sign * _dot(unit, at[i][2])
            for k, other in ends:
                a, b = at[i][1], at[k][1]
                bend = (_dot(a, b) - _dot(a, unit) * _dot(b, unit)) / far
                hessian[:, i, k] += index * sign * other * bend
    return length, gradient, hessian


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("mi,mi->m", a, b))
