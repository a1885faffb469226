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

import re
from dataclasses import replace
from typing import TYPE_CHECKING

from pcfix.errors import PcfixError
from pcfix.io.cameras import opensfm
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.odm.crs import whole_metres
from pcfix.io.cameras.odm.frames import distance_to_shots, frame, reference_of
from pcfix.io.cameras.odm.project import SHOTS, TOPOCENTRIC, locate, whole_file
from pcfix.io.cameras.odm.shots import read_images, read_shots
from pcfix.io.cameras.opensfm.reconstruction import left_out, read_reconstruction
from pcfix.io.cameras.opensfm.tracks import read_tie_points
from pcfix.model import Cameras

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.odm.project import Project
    from pcfix.model import TiePoints

SOFTWARE = "OpenDroneMap"
ALIGNED_M = 0.1

_OWN_FILES = ("proj.txt", "coords.txt", "odm_georeferencing_model_geo.txt", SHOTS, TOPOCENTRIC)
_SHOTS_HEAD = re.compile(
    r'\s*\{.*"features"\s*:\s*\[.*"(translation|rotation|filename)"', re.DOTALL
)


def recognises(source: Source) -> bool:
    """Whether it is shots.geojson, or a reconstruction in a project of ODM."""
    try:
        project = locate(source.path)
        if project.poses is None:
            return False
        if not source.path.is_dir() and _SHOTS_HEAD.match(source.text):
            return True
        poses = whole_file(project)
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
        return read_shots(project, path, SOFTWARE)
    found = read_reconstruction(path)
    placed = frame(project, found)
    gnss, listed = read_images(project.find("images.json"), found.labels)
    cameras = Cameras(
        labels=found.labels,
        centres=placed.points(found.centres),
        rotations=placed.rotations(found.rotations),
        lenses=found.lenses,
        crs=placed.crs,
        notes=found.notes,
        project_crs=placed.project_crs,
        gnss=gnss or opensfm.gnss(found),
        unposed=left_out(found.labels, [*found.left_out, *listed]),
        source=SOFTWARE,
    )
    return cameras if placed.project_crs else _compared(project, cameras)


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read points and tracks, in the frame of the poses."""
    project, path = _poses(source)
    found = read_reconstruction(path)
    points = read_tie_points(found)
    return replace(points, xyz=frame(project, found).points(points.xyz))


def _poses(source: Source) -> tuple[Project, Path]:
    project = locate(source.path)
    return project, whole_file(project)


def _is_odm(project: Project, poses: Path) -> bool:
    """Whether ODM's own files lie around a reconstruction, or its reference is ODM's choice."""
    if any(project.find(name) for name in _OWN_FILES):
        return True
    reference = reference_of(poses)
    return reference is not None and whole_metres(*reference, None) is not None


def _compared(project: Project, cameras: Cameras) -> Cameras:
    """Return the cameras with a note where the project was moved after the reconstruction."""
    apart = distance_to_shots(project, cameras.labels, cameras.centres)
    if apart < ALIGNED_M:
        return cameras
    note = (
        f"{project.poses}: its cameras are {apart:.2f} m from those of {project.find(SHOTS)}; where"
        " the project was aligned to a reference, its cloud goes with shots.geojson, so give that."
    )
    return replace(cameras, notes=(*cameras.notes, note))
