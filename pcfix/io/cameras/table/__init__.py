"""Plain tables of poses: a header line, then one image a row.

Fields are separated by comma, semicolon, tab or spaces; the header may be a comment (#), and units
may stand in it (x[m], omega[gon]). What its columns may be called is in `columns.SPELLINGS`:

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

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcfix.errors import PcfixWarning, bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import note
from pcfix.io.cameras.formats import Angles, Source
from pcfix.io.cameras.table.columns import (
    EXIF,
    Columns,
    axes,
    column_missing,
    headers,
    is_header,
    read_columns,
)
from pcfix.io.cameras.table.sensor import read_lenses, read_sensor
from pcfix.io.crs import shortened
from pcfix.io.tables import Table, number, read_lines
from pcfix.lens import rotations
from pcfix.model import Cameras, FloatArray, GnssPositions

__all__ = ["read", "read_sensor", "recognises"]


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
    columns = open_table(source.path)
    suffix = "_est" if axes(columns.place, "_est") else ""
    by_gnss = any(name in EXIF for name in columns.table.header)  # measured, not adjusted
    by_gnss |= columns.has("sigma_x") and not suffix
    unposed = tuple[str, ...]()
    if suffix or by_gnss:  # else a position that is not there is a mistake
        lost = np.isnan(centres(columns, suffix)).any(axis=1)
        if lost.all():
            raise checks.no_pose(source.path, "no image has a position")
        unposed = tuple(columns.labels[i] for i in np.flatnonzero(lost))
        columns = columns.take(np.flatnonzero(~lost))
    xyz = centres(columns, suffix, needed=True)
    turns = _rotations(columns, source.angles, suffix)
    if turns is None and source.sensor is not None:
        raise checks.sensor_unused(source, "no angles")
    lenses = None if turns is None else read_lenses(columns, source.sensor)
    first: dict[tuple[str, bytes], int] = {}  # labels are no key, but an exact copy counts once
    for i, label in enumerate(columns.labels):
        first.setdefault((label, xyz[i].tobytes()), i)
    keep = np.array(list(first.values()))
    system, notes = crs(columns)
    if by_gnss:
        sentence = "its positions are those of the GNSS, not adjusted ones."
        notes += (note(columns.path, "cameras.not_adjusted", sentence),)
    dropped = len(columns.labels) - len(keep)
    gnss = gnss_positions(columns) if suffix else None
    return Cameras(
        labels=tuple(columns.labels[i] for i in keep),
        centres=xyz[keep],
        rotations=None if turns is None else turns[keep],
        lenses=None if lenses is None else tuple(lenses[i] for i in keep),
        crs=system,
        notes=(*checks.repeated(columns.path, columns.labels, dropped), *notes),
        gnss=gnss and GnssPositions(gnss.xyz[keep], gnss.sigma_m[keep], gnss.crs),
        unposed=unposed,
        source="CSV table",
    )


WGS84, WGS84_ELLIPSOIDAL = "EPSG:4326", "EPSG:4979"
GEO = ("label", "x", "y", "z", "yaw", "pitch", "roll", "accuracy_horz", "accuracy_vert")
"""Fields of ODM's geo.txt, the last six optional; more may follow."""
_GEO_CRS = re.compile(r"(EPSG:\d+|\+proj=.+|WGS84 UTM \d\d?\s*[NS])\s*", re.IGNORECASE)


def open_table(path: Path) -> Columns:
    """Read a table with a header, or ODM's geo.txt, which has none."""
    lines = read_lines(path)
    if not is_geo(lines):
        return read_columns(path)
    split = [(i, line.split()) for i, line in enumerate(lines[1:], start=2)]
    rows = [[*fields, *[""] * len(GEO)][: len(GEO)] for _, fields in split if fields]
    table = Table(path, list(GEO), rows, [i for i, fields in split if fields])
    place = {name: GEO.index(name) for name in ("label", "x", "y", "z")}
    place |= {"sigma_x": 7, "sigma_y": 7, "sigma_z": 8}  # its angles may be 0 for unknown
    crs = checks.utm_as_code(lines[0].strip())
    return Columns(table, place, [""] * len(GEO), after_hash=False, crs=crs)


def gnss_positions(columns: Columns) -> GnssPositions | None:
    """Return the positions by GNSS, or None where only adjusted ones are there."""
    if axes(columns.place) is None:
        return None
    xyz = centres(columns)
    if columns.has("enable"):
        off = [text == "0" for text in columns.table.column(columns.name("enable"))]
        xyz[off] = np.nan
    sigma = columns.where_there(("sigma_x", "sigma_y", "sigma_z"))
    return GnssPositions(xyz, sigma, crs(columns)[0])


def centres(columns: Columns, suffix: str = "", *, needed: bool = False) -> FloatArray:
    """Return positions, shape (k, 3), NaN for rows without when they are not `needed`."""
    from pyproj import CRS

    three = axes(columns.place, suffix)
    if three is None:
        return np.full((len(columns.labels), 3), np.nan)
    xyz = columns.of(three) if needed else columns.where_there(three)
    for i, side in enumerate(("longitude_ref", "latitude_ref")):
        if columns.has(side):
            texts = columns.table.column(columns.name(side))
            beyond = [text[:1].upper() in ("S", "W") for text in texts]
            xyz[beyond, i] = -np.abs(xyz[beyond, i])
    system = crs(columns)[0] or "local"
    if three[0].startswith("longitude") or (system != "local" and CRS(system).is_geographic):
        bad = (np.abs(xyz[:, :2]) > [360.0, 90.0]).any(axis=1)
        if bad.any():
            i = int(np.argmax(bad))
            sentence = f"longitude {xyz[i, 0]:g}, latitude {xyz[i, 1]:g} is no place on earth."
            raise columns.error(i, "cameras.degrees", sentence)
    xyz[np.isnan(xyz).any(axis=1)] = np.nan
    return xyz


def crs(columns: Columns) -> tuple[str | None, tuple[PcfixWarning, ...]]:
    """Return the CRS that a table says or shows, and what to tell about it.

    Longitude and latitude without more are those of WGS 84. Heights then are ellipsoidal only
    if the header calls them so; else the CRS has no heights. A ``.prj`` of the table's name beside
    it counts where the table itself says nothing.
    """
    said, beside = columns.crs, columns.path.with_suffix(".prj")
    if not said and beside != columns.path and beside.is_file():
        said = checks.read_text(beside).strip() or None
    if said is None:
        if axes(columns.place) != ("longitude", "latitude", "z"):
            return None, ()
        ellipsoidal = columns.name("z").startswith("ellipsoid")
        return WGS84_ELLIPSOIDAL if ellipsoidal else WGS84, ()
    if said.startswith("LOCAL_CS"):
        return "local", ()
    if not checks.names_crs(said):
        sentence = f"PROJ does not know its CRS '{shortened(said)}'. The cloud's is assumed."
        return None, (note(columns.path, "cameras.crs_unknown", sentence, crs=said),)
    return said, ()


def is_geo(lines: list[str]) -> bool:
    """Whether these lines are a CRS and then images, not control points."""
    if not lines or not _GEO_CRS.fullmatch(lines[0]):
        return False
    first = next((line.split() for line in lines[1:] if line.strip()), [])
    return len(first) >= 3 and np.isnan(number(first[0]))


OMEGA_PHI_KAPPA = ("omega", "phi", "kappa")
YAW_PITCH_ROLL = ("yaw", "pitch", "roll")
QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{i}{j}" for i in "123" for j in "123")
AGREEMENT_DEG = 0.05
"""Of angles with the matrix beside them; angles with two decimals pass."""
LOOKS_DOWN_DEG = 80.0
"""Largest tilt from the vertical of a camera that looks at the ground."""


def _rotations(columns: Columns, angles: Angles | None, suffix: str = "") -> FloatArray | None:
    """Return world to camera rotations, or None where the table has nothing that turns.

    `angles` is what the user says that they are, `suffix` is ``_est`` for adjusted values.
    """
    opk, ypr = (tuple(a + suffix for a in kind) for kind in (OMEGA_PHI_KAPPA, YAW_PITCH_ROLL))
    for kind in (opk, ypr, QUATERNION, MATRIX):
        there = [role for role in kind if columns.has(role)]
        missing = [role for role in kind if not columns.has(role)]
        if there and missing:
            raise column_missing(columns.path, missing, columns.table.header)
    if angles is not None:
        roles = opk if angles == "omega-phi-kappa" else ypr
        if not columns.has(*roles):
            raise column_missing(columns.path, roles, columns.table.header)
        return FROM_ANGLES[angles](*columns.of(roles).T)
    if columns.has(*opk):
        place = columns.place
        reality_capture = columns.after_hash and columns.name("label") == "name"
        if place[opk[1]] < place[opk[0]] or reality_capture:
            sentence = "omega, phi, kappa may be turns in another order here. Export heading,"
            sentence += " pitch, roll, or give --angles omega-phi-kappa."
            raise bad_file(columns.path, "cameras.angles", sentence)
        found = rotations.from_omega_phi_kappa(*columns.of(opk).T)
        if columns.has(*MATRIX) and opk == OMEGA_PHI_KAPPA:  # they must be the same turn
            half_chord = np.linalg.norm(found - _from_matrix(columns), axis=(1, 2)) / np.sqrt(8.0)
            apart_deg = np.degrees(2.0 * np.arcsin(np.minimum(half_chord, 1.0)))
            worst, apart = int(np.argmax(apart_deg)), float(apart_deg.max())
            if apart > AGREEMENT_DEG:
                sentence = f"omega, phi, kappa and r11 to r33 are {apart:.3g} degrees apart."
                raise columns.error(worst, "cameras.angles_differ", sentence, degrees=apart)
        return found
    if columns.has(*QUATERNION):
        return checks.quaternions(columns.path, columns.labels, columns.of(QUATERNION))
    if columns.has(*MATRIX):
        return _from_matrix(columns)
    return _from_yaw_pitch_roll(columns, ypr) if columns.has(*ypr) else None


FROM_ANGLES = {
    "omega-phi-kappa": rotations.from_omega_phi_kappa,
    "yaw-pitch-roll": rotations.from_yaw_pitch_roll,
    "aircraft": rotations.from_aircraft,
}


def _from_matrix(columns: Columns) -> FloatArray:
    """Return rotations from r11 ... r33, to axes either y up, z back or y down, z forward.

    Both turn world to camera. Which one it is shows where the cameras look: at the ground.
    """
    matrices = columns.of(MATRIX).reshape(-1, 3, 3)
    found = checks.rotations(columns.path, columns.labels, matrices)
    back_is_up = found[:, 2, 2] > 0.0
    if back_is_up.any() and not back_is_up.all():
        sentence = "r33 has both signs, so the axes are not clear. Give omega, phi, kappa."
        raise bad_file(columns.path, "cameras.angles", sentence)
    return rotations.from_photogrammetric(found) if back_is_up.all() else found


def _from_yaw_pitch_roll(columns: Columns, ypr: Sequence[str]) -> FloatArray:
    """Return rotations from angles of the view; what the header cannot say, the view must.

    Refused are angles that are more likely those of a gimbal, which are -90 straight down.
    """
    values = columns.of(ypr).T
    found, aircraft = rotations.from_yaw_pitch_roll(*values), rotations.from_aircraft(*values)
    if columns.name(ypr[0]).startswith("gimbal"):
        return aircraft
    if columns.after_hash and columns.name(ypr[0]) == "heading":  # RealityCapture's
        return found
    tilt, other = (  # the angles between the views and straight down
        np.degrees(np.arctan2(np.hypot(each[:, 2, 0], each[:, 2, 1]), -each[:, 2, 2]))
        for each in (found, aircraft)
    )
    if other.max() < LOOKS_DOWN_DEG and np.median(other) < np.median(tilt):
        sentence = "yaw, pitch, roll are likely those of a gimbal. Give --angles aircraft, or"
        sentence += " --angles yaw-pitch-roll."
        raise bad_file(columns.path, "cameras.angles", sentence)
    return found
