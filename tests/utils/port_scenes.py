"""A scene under water, taken through the port of a housing, with known truth.

Light takes the shortest optical path (Fermat): length times refractive index, summed over air,
glass and water. The correction uses Snell's law instead, and shares nothing with this file.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.model import Cameras, FloatArray, Lens, Views
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.port.housing import DomePort, Port
from pcfix.simulate.tracing import triangulate

ORIGIN = np.array([512_000.0, 4_987_000.0, -12.0])
LENS = Lens(focal=1500.0, width=2000.0, height=1500.0, principal_x=1004.0, principal_y=747.0)
NEWTON_STEPS, CONVERGED_M, STEP_M = 60, 1e-13, 1e-6


@dataclass(frozen=True, eq=False)
class PortScene:
    """A block of images through a port, and the cloud of software that ignores the port."""

    cameras: Cameras  # true poses and lens
    port: Port
    refractive_index: float  # of the water
    truth: FloatArray  # (n, 3), metres, world frame
    views: Views  # two images or more for each point
    image_xy: FloatArray  # (o, 2), pixels with noise, as ``views.camera``
    apparent: FloatArray  # (n, 3), intersections of straight rays


def simulate_port(
    port: Port, *, points: int = 1000, noise_px: float = 0.0, seed: int = 0
) -> PortScene:
    """Simulate 4 x 3 images, 0.5 m apart, that look down at a rough bed 3 m below.

    Points in fewer than two images are left out.
    """
    rng, k, n = np.random.default_rng(seed), 12, DEFAULT_REFRACTIVE_INDEX
    x, y = np.meshgrid(0.5 * (np.arange(4) - 1.5), 0.5 * (np.arange(3) - 1.0))
    centres = np.column_stack([x.ravel(), y.ravel(), np.zeros(k)])
    centres += rng.normal(0.0, 0.05, (k, 3))
    tilted = Rotation.from_euler("xyz", rng.normal(0.0, 8.0, (k, 3)), degrees=True)
    turned = Rotation.from_euler("z", rng.uniform(0.0, 360.0, (k, 1)), degrees=True)
    rotations = (turned * tilted).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    labels = tuple(f"port{i:03d}" for i in range(k))
    cameras = Cameras(labels, centres + ORIGIN, rotations, (LENS,) * k)
    plan = rng.uniform([-1.0, -0.75], [1.0, 0.75], (points, 2))
    truth = np.column_stack([plan, rng.normal(-3.0, 0.4, points)]) + ORIGIN
    image, seen = images_of(truth, cameras, port, n)
    several = seen.sum(axis=1) >= 2
    truth, image, seen = truth[several], image[several], seen[several]
    point, camera = np.nonzero(seen)
    start = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
    measured = image[point, camera] + rng.normal(0.0, noise_px, (len(point), 2))
    apparent = triangulate(measured, cameras, camera, start, LENS, truth)
    return PortScene(cameras, port, n, truth, Views(start, camera), measured, apparent)


def images_of(
    truth: FloatArray, cameras: Cameras, port: Port, n: float
) -> tuple[FloatArray, np.ndarray]:
    """Return the images of points in each camera, shape (n, k, 2), and whether in its frame."""
    ray = truth[:, None, :] - cameras.centres
    local = np.einsum("kij,nkj->nki", cameras.rotations, ray)
    direction = fermat_directions(local.reshape(-1, 3), port, n).reshape(local.shape)
    x, y = (LENS.focal * direction[..., i] / direction[..., 2] for i in (0, 1))
    image = np.stack([x + LENS.principal_x, y + LENS.principal_y], axis=-1)
    inside = ((image > 0.0) & (image < [LENS.width, LENS.height])).all(axis=-1)
    return image, inside & (direction[..., 2] > 0.0)


def fermat_directions(points: FloatArray, port: Port, n: float) -> FloatArray:
    """Return the unit vectors from the projection centre towards the images of points.

    Points, shape (m, 3), are in the water: camera frame, metres. Each path lies in the plane of an
    axis and its point. A face is a line across the axis, or a circle about the centre of a dome.
    """
    is_dome = isinstance(port, DomePort)
    centre = np.array(port.centre_m) if is_dome else np.zeros(3)
    first = port.radius_m if is_dome else port.distance_m
    faces = list(dict.fromkeys([first, first + port.thickness_m]))
    indices = [1.0, *[port.glass_index] * (len(faces) - 1), n]
    axis = points - centre if is_dome else np.broadcast_to(np.array(port.normal), points.shape)
    axis = axis / np.linalg.norm(axis, axis=1)[:, None]
    across = points - (points * axis).sum(axis=1)[:, None] * axis
    length = np.linalg.norm(across, axis=1)[:, None]
    across = np.where(length > 1e-13, across / np.maximum(length, 1e-300), 0.0)
    ends = [
        np.column_stack([(xyz * axis).sum(axis=1), (xyz * across).sum(axis=1)])
        for xyz in (np.broadcast_to(-centre, points.shape), points - centre)
    ]

    def place(face: float, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the place at s (m) along a face, and the tangent there."""
        if not is_dome:
            return np.column_stack([face + 0.0 * s, s]), np.column_stack([0.0 * s, 1.0 + 0.0 * s])
        cosine, sine = np.cos(s / face), np.sin(s / face)
        return face * np.column_stack([cosine, sine]), np.column_stack([-sine, cosine])

    def slope(s: FloatArray) -> FloatArray:
        """Return the derivatives of the optical length by the places at the faces."""
        at = [place(face, s[:, i]) for i, face in enumerate(faces)]
        nodes = [ends[0], *(where for where, _ in at), ends[1]]
        ways = [b - a for a, b in pairwise(nodes)]
        pulls = [
            index * way / np.linalg.norm(way, axis=1)[:, None]
            for index, way in zip(indices, ways, strict=True)
        ]
        return np.column_stack(
            [((pulls[i] - pulls[i + 1]) * at[i][1]).sum(axis=1) for i in range(len(faces))]
        )

    s = np.zeros((len(points), len(faces)))
    if not is_dome:  # where the straight line passes the faces
        share = (np.array(faces) - ends[0][:, :1]) / (ends[1][:, :1] - ends[0][:, :1])
        s = ends[0][:, 1:] + share * (ends[1][:, 1:] - ends[0][:, 1:])
    for _ in range(NEWTON_STEPS):
        steps = STEP_M * np.eye(len(faces))
        hessian = np.stack([(slope(s + one) - slope(s - one)) / (2 * STEP_M) for one in steps], 2)
        step = np.linalg.solve(hessian, slope(s)[:, :, None])[:, :, 0]
        s -= step
        if np.abs(step).max(initial=0.0) < CONVERGED_M:
            break
    else:
        raise ArithmeticError("the shortest path through the port was not found")
    x, y = place(faces[0], s[:, 0])[0].T
    found = x[:, None] * axis + y[:, None] * across + centre
    return np.asarray(found / np.linalg.norm(found, axis=1)[:, None])
