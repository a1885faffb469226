"""OpenDroneMap: a project folder, its reconstruction.json or its shots.geojson.

ODM reconstructs with OpenSfM and delivers its cloud in a projected CRS, named in proj.txt or in
the first line of coords.txt. Its reconstruction has been in three frames:

- up to 2020 topocentric as OpenSfM writes it, with geocoords_transformation.txt, an affine map
  (turn by the meridian convergence, scale, shift) that makes projected coordinates of it, and so
  of the cloud;
- then with the axes of the projected CRS, less its coordinates of the reference; the reference is
  at whole metres, which tells this frame from a true topocentric one;
- topocentric again in versions that project the finished cloud point by point, and in
  reconstruction.topocentric.json, which the second kind keeps.

Where the reference is at whole metres, shots.geojson decides between the last two, or the GNSS
positions (always topocentric). Poses come out in the projected CRS in the first two frames,
topocentric in the third.

shots.geojson has per image `translation`, the projection centre in the projected CRS, `rotation`,
axis times angle from the axes of that CRS to the camera (x right, y down, z forward), and size and
focal length, by which its lens is found in cameras.json (OpenSfM's models).

References: "Outputs" in the ODM manual, https://docs.opendronemap.org/outputs; the stages
`opensfm` and `odm_report` of https://github.com/OpenDroneMap/ODM.
"""

from __future__ import annotations

import mmap
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError, PcfixError
from pcfix.io.cameras import opensfm
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.odm import project as files
from pcfix.io.cameras.odm.project import SHOTS, TOPOCENTRIC, TRANSFORMATION, Project
from pcfix.model import Cameras, FloatArray, TiePoints

ALIGNED_M = 0.1

_OWN_FILES = ("proj.txt", "coords.txt", "odm_georeferencing_model_geo.txt", SHOTS, TOPOCENTRIC)
_SHOTS_HEAD = re.compile(
    r'\s*\{.*"features"\s*:\s*\[.*"(translation|rotation|filename)"', re.DOTALL
)


def recognises(source: Source) -> bool:
    """Whether it is shots.geojson, or a reconstruction in a project of ODM."""
    try:
        project = files.locate(source.path)
        if project.poses is None:
            return False
        if not source.path.is_dir() and _SHOTS_HEAD.match(source.text):
            return True
        poses = files.whole_file(project)
        found = source if poses == source.path else Source(poses)
        if _SHOTS_HEAD.match(found.text):
            return True
        return opensfm.recognises(found) and _is_odm(project, poses)
    except (OSError, ValueError, RuntimeError, PcfixError):  # damaged files around it
        return False


def read(source: Source) -> Cameras:
    """Read the poses, of a folder rather from the reconstruction than from shots.geojson."""
    project, path = _poses(source)
    if not opensfm.recognises(Source(path)):
        return files.read_shots(project, path)
    found = opensfm.read_reconstruction(path)
    own, placed = found.cameras, frame(project, found)
    gnss, listed = files.read_images(project.find("images.json"), own.labels)
    cameras = replace(
        own,
        centres=placed.points(own.centres),
        rotations=placed.rotations(np.asarray(own.rotations)),
        crs=placed.crs,
        project_crs=placed.project_crs,
        gnss=gnss or own.gnss,
        unposed=opensfm.left_out(own.labels, [*own.unposed, *listed]),
        source="OpenDroneMap",
    )
    return cameras if placed.project_crs else _compared(project, cameras)


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read points and tracks, in the frame of the poses."""
    project, path = _poses(source)
    found = opensfm.read_reconstruction(path)
    points = opensfm.read_tie_points(found)
    return replace(points, xyz=frame(project, found).points(points.xyz))


def _poses(source: Source) -> tuple[Project, Path]:
    project = files.locate(source.path)
    return project, files.whole_file(project)


def _is_odm(project: Project, poses: Path) -> bool:
    """Whether ODM's own files lie around a reconstruction, or its reference is ODM's choice."""
    if any(project.find(name) for name in _OWN_FILES):
        return True
    reference = reference_of(poses)
    return reference is not None and files.whole_metres(*reference, None) is not None


def _compared(project: Project, cameras: Cameras) -> Cameras:
    """Return the cameras with a note where the project was moved after the reconstruction."""
    truth, own = _in_shots(project, cameras)
    apart = float(np.median(np.hypot(*(own - truth)[:, :2].T))) if len(own) else 0.0
    if apart < ALIGNED_M:
        return cameras
    note = (
        f"{project.poses}: its cameras are {apart:.2f} m from those of {project.find(SHOTS)}; where"
        " the project was aligned to a reference, its cloud goes with shots.geojson, so give that."
    )
    return replace(cameras, notes=(*cameras.notes, note))


SCALE_TOLERANCE = 0.1
"""Of the squared scale of a map projection; feet, or a matrix of nonsense, are outside."""

_REFERENCE = re.compile(rb'"(latitude|longitude)"\s*:\s*(-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)')


class Frame(NamedTuple):
    """The affine map from a reconstruction to `crs`: p -> matrix p + shift, metres."""

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


def frame(project: Project, found: opensfm.Reconstruction) -> Frame:
    """Decide the frame; see the package for the rules."""
    crs = project.crs()
    unmoved = Frame(np.eye(3), np.zeros(3), found.cameras.crs or "", crs)
    if found.reference is None or found.path.name == TOPOCENTRIC:
        return unmoved
    transformation = project.find(TRANSFORMATION)
    turned = _transformed(transformation, found.reference, crs) if transformation else None
    if turned is not None:
        return turned
    whole = files.whole_metres(*found.reference[:2], crs)
    if whole is None:
        return unmoved
    crs, east, north = whole
    moved = Frame(np.eye(3), np.array([east, north, 0.0]), crs)
    if _is_topocentric(project, found.cameras, found.reference, moved):
        return unmoved._replace(project_crs=crs)
    return moved


def reference_of(path: Path) -> tuple[float, float] | None:
    """Return latitude and longitude of a reconstruction's origin without reading all of it."""
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as view:
        at = view.find(b'"reference_lla"')
        text = view[at : at + 400] if at >= 0 else b""
    values = {key: float(value) for key, value in _REFERENCE.findall(text)[:2]}
    return (values[b"latitude"], values[b"longitude"]) if len(values) == 2 else None


def _in_shots(project: Project, cameras: Cameras) -> tuple[FloatArray, FloatArray]:
    """Return the centres in shots.geojson and ours of the images that are in both."""
    path = project.find(SHOTS)
    there = files.positions(path) if path is not None else {}
    shared = [i for i, label in enumerate(cameras.labels) if label in there]
    truth = np.array([there[cameras.labels[i]] for i in shared]).reshape(-1, 3)
    return truth, cameras.centres[shared]


def _transformed(
    path: Path, reference: tuple[float, float, float], crs: str | None
) -> Frame | None:
    """Return the frame after geocoords_transformation.txt; None where it is of another origin."""
    text = path.read_bytes()[:4096].decode("utf-8", errors="replace")
    try:
        matrix = np.array([line.split()[:4] for line in text.splitlines() if line.strip()], float)
    except ValueError:
        matrix = np.empty((0, 0))
    matrix = matrix if matrix.shape == (4, 4) else np.zeros((4, 4))
    turn, shift = matrix[:3, :3], matrix[:3, 3]
    if not np.isfinite(matrix).all() or np.abs(turn.T @ turn - np.eye(3)).max() > SCALE_TOLERANCE:
        raise InputError(
            f"{path}: is not four rows of four numbers that turn and shift the reconstruction."
        )
    lat, lon, _ = reference
    named = files.crs_of_place(lon, lat, shift[0], shift[1], [crs] if crs else None)
    return Frame(turn, shift, named) if named else None


def _is_topocentric(
    project: Project, cameras: Cameras, reference: tuple[float, float, float], moved: Frame
) -> bool:
    """Whether a reconstruction with its origin at whole metres was left as OpenSfM made it.

    The centres of shots.geojson tell, or else the GNSS positions, which stay topocentric in any
    case: the two readings differ by the meridian convergence and the scale.
    """
    truth, own = _in_shots(project, cameras)
    if len(own) < 3 and cameras.gnss is not None:
        known = np.isfinite(cameras.gnss.xyz).all(axis=1)
        truth = files.from_topocentric(cameras.gnss.xyz[known], reference, moved.crs)
        own = cameras.centres[known]
    if len(own) < 3:
        return False
    misses = [
        np.sqrt(np.mean((guess - truth)[:, :2] ** 2))
        for guess in (files.from_topocentric(own, reference, moved.crs), moved.points(own))
    ]
    return bool(misses[0] < 0.5 * misses[1])
