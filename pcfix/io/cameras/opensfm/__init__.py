"""OpenSfM: reconstruction.json, and tracks.csv beside it.

The file is a list of reconstructions, each with `cameras`, `shots` and `points`. A shot's
`rotation` (axis times angle, radians) and `translation` take world to camera, x right, y down, z
forward, so the projection centre is -R't. The world is topocentric, metres east, north and up at
`reference_lla`, which stands in the reconstruction or in reference_lla.json; `gps_position` is in
the same frame, `gps_dop` its standard deviation in metres. Without a reference the frame is local.
Where a shot rides on a rig and has no pose of its own, it is that of the rig camera (rig to
camera) after that of the rig instance (world to rig). Coordinates too large to be topocentric come
from ``export_geocoords --reconstruction``; that file does not name its CRS.

References: "Reconstruction file", "Coordinate Systems" and "Rig Models" in the manual,
https://opensfm.org/docs.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from pcfix.io.cameras.opensfm.reconstruction import read_reconstruction
from pcfix.io.cameras.opensfm.tracks import read_tie_points
from pcfix.model import Cameras, GnssPositions

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.formats import Source
    from pcfix.io.cameras.opensfm.reconstruction import Reconstruction
    from pcfix.model import TiePoints

SOFTWARE = "OpenSfM"
TOPOCENTRIC_LIMIT_M = 1e5

_NAMES = "cameras|shots|points|pano_shots|reference_lla|biases|rig_cameras|rig_instances"
_HEAD = re.compile(rf'\[\s*\{{\s*"({_NAMES})"\s*:\s*\{{')


def recognises(source: Source) -> bool:
    """Whether a file begins as a list of reconstructions, or a folder holds one by name."""
    if source.path.is_dir():
        return "reconstruction.json" in source.names
    return _HEAD.match(source.text.lstrip()) is not None


def read(source: Source) -> Cameras:
    """Read the poses of the largest reconstruction."""
    found = read_reconstruction(_file(source))
    crs = topocentric(found)
    absolute = np.abs(np.median(found.centres[:, :2], axis=0)).max() > TOPOCENTRIC_LIMIT_M
    return Cameras(
        labels=found.labels,
        centres=found.centres,
        rotations=found.rotations,
        lenses=found.lenses,
        crs=None if absolute else crs,
        notes=found.notes,
        gnss=gnss(found),
        unposed=found.left_out,
        source=SOFTWARE,
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read points and tracks."""
    return read_tie_points(read_reconstruction(_file(source)))


def topocentric(found: Reconstruction) -> str:
    """Return the frame of a reconstruction that was not moved to a projected CRS."""
    if found.reference is None:
        return "local"
    return "ENU:" + ",".join(repr(value) for value in found.reference)


def gnss(found: Reconstruction) -> GnssPositions | None:
    """Return the positions of the images as the reconstruction keeps them."""
    if found.reference is None or not np.isfinite(found.gnss_xyz).any():
        return None
    return GnssPositions(found.gnss_xyz, found.gnss_sigma_m, topocentric(found))


def _file(source: Source) -> Path:
    return source.path / "reconstruction.json" if source.path.is_dir() else source.path
