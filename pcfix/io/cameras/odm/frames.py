"""In which of OpenDroneMap's frames a reconstruction is, and how it comes to the project's CRS."""

from __future__ import annotations

import mmap
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.odm.crs import crs_of_place, from_topocentric, whole_metres
from pcfix.io.cameras.odm.project import SHOTS, TOPOCENTRIC, TRANSFORMATION
from pcfix.io.cameras.odm.shots import positions
from pcfix.io.cameras.opensfm import topocentric

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.odm.project import Project
    from pcfix.io.cameras.opensfm.reconstruction import Reconstruction
    from pcfix.model import FloatArray

SCALE_TOLERANCE = 0.1
"""Of the squared scale of a map projection; feet, or a matrix of nonsense, are outside."""

_REFERENCE = re.compile(rb'"(latitude|longitude)"\s*:\s*(-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)')


@dataclass(frozen=True, eq=False)
class Frame:
    """The affine map from a reconstruction to `crs`: p -> matrix p + shift.

    Attributes
    ----------
    matrix : array, shape (3, 3)
    shift : array, shape (3,)
        Metres.
    crs : str
    project_crs : str or None
        As in `Cameras`.
    """

    matrix: FloatArray
    shift: FloatArray
    crs: str
    project_crs: str | None = None

    def points(self, xyz: FloatArray) -> FloatArray:
        """Return points in `crs`."""
        return np.asarray(xyz @ self.matrix.T + self.shift)

    def rotations(self, rotations: FloatArray) -> FloatArray:
        """Return world to camera rotations in `crs`: the nearest ones, as the map scales a bit."""
        u, _, v = np.linalg.svd(rotations @ np.linalg.inv(self.matrix))
        return np.asarray(u @ v)


def frame(project: Project, found: Reconstruction) -> Frame:
    """Decide the frame; see the package for the rules."""
    crs = project.crs()
    unmoved = Frame(np.eye(3), np.zeros(3), topocentric(found), crs)
    if found.reference is None or found.path.name == TOPOCENTRIC:
        return unmoved
    transformation = project.find(TRANSFORMATION)
    turned = _transformed(transformation, found.reference, crs) if transformation else None
    if turned is not None:
        return turned
    whole = whole_metres(*found.reference[:2], crs)
    if whole is None:
        return unmoved
    crs, east, north = whole
    moved = Frame(np.eye(3), np.array([east, north, 0.0]), crs)
    if _is_topocentric(project, found, found.reference, moved):
        return Frame(np.eye(3), np.zeros(3), unmoved.crs, crs)
    return moved


def reference_of(path: Path) -> tuple[float, float] | None:
    """Return latitude and longitude of a reconstruction's origin without reading all of it."""
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as view:
        at = view.find(b'"reference_lla"')
        text = view[at : at + 400] if at >= 0 else b""
    values = {key: float(value) for key, value in _REFERENCE.findall(text)[:2]}
    return (values[b"latitude"], values[b"longitude"]) if len(values) == 2 else None


def distance_to_shots(project: Project, labels: tuple[str, ...], centres: FloatArray) -> float:
    """Return the median distance in plan between cameras and those of shots.geojson, metres."""
    truth, own = _in_shots(project, labels, centres)
    return float(np.median(np.hypot(*(own - truth)[:, :2].T))) if len(own) else 0.0


def _in_shots(
    project: Project, labels: tuple[str, ...], centres: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the centres in shots.geojson and ours of the images that are in both."""
    path = project.find(SHOTS)
    there = positions(path) if path is not None else {}
    shared = [i for i, label in enumerate(labels) if label in there]
    truth = np.array([there[labels[i]] for i in shared]).reshape(-1, 3)
    return truth, centres[shared]


def _transformed(
    path: Path, reference: tuple[float, float, float], crs: str | None
) -> Frame | None:
    """Return the frame after geocoords_transformation.txt; None where it is of another origin."""
    text = path.read_bytes()[:4096].decode("utf-8", errors="replace")
    try:
        matrix = np.array([line.split()[:4] for line in text.splitlines() if line.strip()], float)
    except ValueError:
        matrix = np.empty((0, 0))
    turn, shift = matrix[:3, :3], matrix[:3, 3:].ravel()
    if (
        matrix.shape != (4, 4)
        or not np.isfinite(matrix).all()
        or np.abs(turn.T @ turn - np.eye(3)).max() > SCALE_TOLERANCE
    ):
        raise InputError(
            f"{path}: is not four rows of four numbers that turn and shift the reconstruction."
        )
    lat, lon, _ = reference
    named = crs_of_place(lon, lat, shift[0], shift[1], [crs] if crs else None)
    return Frame(turn, shift, named) if named else None


def _is_topocentric(
    project: Project, found: Reconstruction, reference: tuple[float, float, float], moved: Frame
) -> bool:
    """Whether a reconstruction with its origin at whole metres was left as OpenSfM made it.

    The centres of shots.geojson tell, or else the GNSS positions, which stay topocentric in any
    case: the two readings differ by the meridian convergence and the scale.
    """
    truth, own = _in_shots(project, found.labels, found.centres)
    if len(own) < 3:
        known = np.isfinite(found.gnss_xyz).all(axis=1)
        truth = from_topocentric(found.gnss_xyz[known], reference, moved.crs)
        own = found.centres[known]
    if len(own) < 3:
        return False
    misses = [
        np.sqrt(np.mean((guess - truth)[:, :2] ** 2))
        for guess in (from_topocentric(own, reference, moved.crs), moved.points(own))
    ]
    return bool(misses[0] < 0.5 * misses[1])
