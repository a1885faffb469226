"""Plain tables of poses: a header line, then one image a row.

Fields are separated by comma, semicolon, tab or spaces; the header may be a comment (#), and units
may stand in it (x[m], omega[gon]). What its columns may be called is in `headers.SPELLINGS`:

- the image: label, name, image, filename, PhotoID, imageName, SourceFile, ...
- its projection centre: x, y, z; easting, northing, height; or longitude, latitude, altitude in
  degrees of WGS 84 (EPSG:4326; EPSG:4979 if the header says that the heights are ellipsoidal);
- how it is turned, or nothing:

  - omega, phi, kappa: photogrammetric camera axes (x right, y up, z back) go to the world by
    Rx(omega) Ry(phi) Rz(kappa). Beside them r11 ... r33, rows of the matrix from the world to
    those axes, must agree (Metashape's export of omega, phi, kappa).
  - yaw, pitch, roll, 0 for a view straight down: those axes go to the world by
    Rz(-yaw) Rx(pitch) Ry(roll). So are Metashape's reference angles, ODM's, and the heading,
    pitch, roll of RealityCapture.
  - yaw, pitch, roll of a gimbal, -90 for a view straight down (``angles="aircraft"``, or
    exiftool's GimbalPitchDegree): Rz(-yaw) Rx(90 + pitch) Rz(-roll). Angles that fit this better
    than the former are refused until the user says which they are.
  - qw, qx, qy, qz: world to camera with axes x right, y down, z forward, as in COLMAP.
  - r11 ... r33 alone: world to camera, to either of the two axes; the cameras look down.

Axes of the world are those of the CRS of the positions: its grid north, or for degrees the east,
north and up of the place. Values called ``_est`` are adjusted ones; the others beside them are then
positions by GNSS, with the stated accuracies (Metashape's reference table).

RealityCapture's ``f, px, py, k1 ... k4, t1, t2``: f in mm for a film of 36 mm along the larger side
of the image, px and py in units of that side from the centre, Brown's distortion with t1 and t2 in
his order.

References: Agisoft Metashape User Manual; OpenDroneMap documentation, "Image Geolocation Files".
The turn of RealityCapture is shown by one camera in XMP and in CSV at
https://forums.unrealengine.com/t/different-rotation-of-cameras-in-xmp-and-csv/710449 ; the scale of
its f, px, py and the order of t1, t2 are those of AliceVision's reader of the same numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.table.attitude import read_rotations
from pcfix.io.cameras.table.headers import axes, headers, is_header
from pcfix.io.cameras.table.positions import (
    are_by_gnss,
    centres,
    crs,
    gnss_positions,
    is_geo,
    open_table,
    read_gnss,
)
from pcfix.io.cameras.table.sensor import read_lenses, read_sensor
from pcfix.lens.rotations import from_yaw_pitch_roll as rotations_from_yaw_pitch_roll
from pcfix.model import Cameras, GnssPositions

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.formats import Angles, Source
    from pcfix.io.cameras.table.columns import Columns
    from pcfix.model import FloatArray, IntArray, Lens

SOFTWARE = "CSV table"

__all__ = [
    "SOFTWARE",
    "read",
    "read_gnss",
    "read_sensor",
    "recognises",
    "rotations_from_yaw_pitch_roll",
]


def recognises(source: Source) -> bool:
    """Whether a header has at least two of the names that are needed, or it is ODM's geo.txt."""
    text = source.text.lstrip()
    if text[:1] in ("", "<", "{") or "\0" in text:
        return False
    lines = text.splitlines()
    if lines[0].lower().startswith("# coordinatesystem:"):  # it may fill the head
        return True
    return is_geo(lines) or any(is_header(header.names) for header in headers(lines))


def read(source: Source) -> Cameras:
    """Read a table; see `pcfix.read_cameras`."""
    everything = open_table(source.path)
    suffix = "_est" if axes(everything.place, "_est") else ""
    columns, unposed = _with_a_pose(everything, suffix)
    xyz = centres(columns, suffix, needed=True)
    rotations, lenses = _orientation(columns, source.sensor, source.angles, suffix)
    keep, notes = _without_copies(columns, xyz)
    gnss = gnss_positions(columns) if suffix else None
    system, doubt = crs(columns)
    return Cameras(
        labels=tuple(columns.labels[i] for i in keep),
        centres=xyz[keep],
        rotations=None if rotations is None else rotations[keep],
        lenses=None if lenses is None else tuple(lenses[i] for i in keep),
        crs=system,
        notes=(*notes, *doubt, *_not_adjusted(columns)),
        gnss=gnss and GnssPositions(gnss.xyz[keep], gnss.sigma_m[keep], gnss.crs),
        unposed=unposed,
        source=SOFTWARE,
    )


def _with_a_pose(columns: Columns, suffix: str) -> tuple[Columns, tuple[str, ...]]:
    """Return the rows with a position, and the images of the others.

    In a table of poses a position that is not there is a mistake; in one of measurements, or of
    adjusted beside measured values, it is an image that has none.
    """
    if not suffix and not are_by_gnss(columns):
        return columns, ()
    lost = np.isnan(centres(columns, suffix)).any(axis=1)
    if lost.all():
        raise InputError(f"{columns.path}: no image has a position; align the images first.")
    unposed = tuple(columns.labels[i] for i in np.flatnonzero(lost))
    return columns.take(np.flatnonzero(~lost)), unposed


def _orientation(
    columns: Columns, sensor: Path | None, angles: Angles | None, suffix: str
) -> tuple[FloatArray | None, tuple[Lens, ...] | None]:
    """Return rotations and lenses, or neither where the table has no angles."""
    rotations = read_rotations(columns, angles, suffix)
    if rotations is not None:
        return rotations, read_lenses(columns, sensor)
    if sensor is not None:
        raise InputError(
            f"{columns.path}: has no yaw, pitch and roll or other angles, so the sensor {sensor}"
            " says nothing; add the angles or leave the sensor out."
        )
    return None, None


def _not_adjusted(columns: Columns) -> tuple[str, ...]:
    if not are_by_gnss(columns):
        return ()
    return (
        f"{columns.path}: its positions are those of the GNSS, not adjusted ones; export the poses"
        " from the photogrammetry software if you can.",
    )


def _without_copies(columns: Columns, xyz: FloatArray) -> tuple[IntArray, tuple[str, ...]]:
    """Return the rows to keep and what to tell: labels are no key, but a copy counts once."""
    labels = columns.labels
    seen: set[tuple[str, bytes]] = set()
    keep = []
    for i, label in enumerate(labels):
        key = (label, xyz[i].tobytes())
        if key not in seen:
            seen.add(key)
            keep.append(i)
    return np.array(keep), checks.repeated(columns.path, labels, len(labels) - len(keep))
