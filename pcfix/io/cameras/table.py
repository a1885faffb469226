"""Plain tables of poses: a header line, then one image a row.

Fields are separated by comma, semicolon, tab or spaces; the header may be a comment (#), and have
units (x[m], omega[gon]). `SPELLINGS` has the names of the columns: image, projection centre
(degrees are of WGS 84, EPSG:4326, or EPSG:4979 if the header calls the heights ellipsoidal), and
the rotation, or none. P are photogrammetric camera axes, x right, y up, z back:

- omega, phi, kappa: P to world is Rx(omega) Ry(phi) Rz(kappa); a matrix next to them is ignored.
- yaw, pitch, roll, 0 for a view straight down (Metashape, ODM, RealityCapture's heading): P to
  world is Rz(-yaw) Rx(pitch) Ry(roll).
- yaw, pitch, roll of a gimbal, -90 for a view straight down (``angles="aircraft"``, or exiftool's
  GimbalPitchDegree): Rz(-yaw) Rx(90 + pitch) Rz(-roll). If these fit better and the user has not
  set the kind, the table is refused.
- qw, qx, qy, qz: world to camera with axes x right, y down, z forward, as in COLMAP.
- only r11 ... r33: world to camera, to either of the two axes; the cameras look down.

World axes are those of the CRS of the positions, or for degrees east, north and up. Values called
``_est`` are adjusted ones; the others are then GNSS positions (Metashape's reference table).

RealityCapture's ``f, px, py, k1 ... k4, t1, t2``: f in mm for a film of 36 mm along the larger side
of the image, px and py in units of that side from the centre, Brown's distortion in his order.

A block is written as ``cameras.csv`` (label, x, y, z, qw, qx, qy, qz, after a comment with the CRS)
and ``sensor.csv`` (the one lens of all images, in pixels with OpenCV's names or, of an undistorted
lens in mm, as focal, sensor_x, sensor_y).

References: Agisoft Metashape User Manual; OpenDroneMap documentation, "Image Geolocation Files";
one camera of RealityCapture in XMP and in CSV at
https://forums.unrealengine.com/t/different-rotation-of-cameras-in-xmp-and-csv/710449 ; the scale of
f, px, py and the order of t1, t2 as in AliceVision's reader.
"""

import csv
import io
import math
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcfix.errors import InputError, bad_file
from pcfix.io import tables
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Angles, LensModel, Source, lens_by_name, model_of
from pcfix.io.crs import is_topocentric, shortened
from pcfix.io.tables import Table
from pcfix.lens import rotations
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens
from pcfix.options.declare import File

# Roles of columns, and their names; if a table has several, the first counts.
SPELLINGS: dict[str, tuple[str, ...]] = {
    "label": (
        *("label", "name", "image", "imagename", "image_name", "filename", "file_name", "file"),
        *("photoid", "photo_id", "photo", "photoname", "photo_name", "picture", "sourcefile"),
    ),
    "x": ("x", "easting", "east", "projectedx"),
    "y": ("y", "northing", "north", "projectedy"),
    "z": (
        *("z", "altitude", "height", "alt", "elevation", "projectedz", "gpsaltitude"),
        *("ellipsoidal_height", "ellipsoid_height", "ellipsoidalheight", "ellipsoidheight"),
    ),
    "longitude": ("longitude", "lon", "long", "lng", "gpslongitude"),
    "latitude": ("latitude", "lat", "gpslatitude"),
    "yaw": ("yaw", "heading", "gimbalyawdegree"),
    "pitch": ("pitch", "gimbalpitchdegree"),
    "roll": ("roll", "gimbalrolldegree"),
    "sigma_x": ("sigma_x", "accuracy_x", "accuracy_x/y", "accuracy_x/y/z", "accuracy_horz", "hacc"),
    "sigma_y": ("sigma_y", "accuracy_y", "accuracy_x/y", "accuracy_x/y/z", "accuracy_horz", "hacc"),
    "sigma_z": ("sigma_z", "accuracy_z", "accuracy_x/y/z", "accuracy_vert", "vacc"),
}
POSE = ("x", "y", "z", "longitude", "latitude", "yaw", "pitch", "roll", "omega", "phi", "kappa")
REALITY_CAPTURE = ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
QUATERNION, MATRIX = ("qw", "qx", "qy", "qz"), tuple(f"r{i}{j}" for i in "123" for j in "123")
_OWN_NAMES = ("omega", "phi", "kappa", "enable", *QUATERNION, *MATRIX, *REALITY_CAPTURE)
SPELLINGS |= {name: (name,) for name in _OWN_NAMES}
SPELLINGS |= {f"{role}_est": (f"{role}_est",) for role in POSE}
AXES = (("x", "y", "z"), ("longitude", "latitude", "z"))
POSITION = {"label", "x", "y", "z", "longitude", "latitude", "x_est", "y_est", "z_est"}
MANY = ("label", *(f"sigma_{axis}" for axis in "xyz"))  # the first spelling counts


def recognises(source: Source) -> bool:
    """Whether a header has at least two of the names that are needed, or it is ODM's geo.txt."""
    text = source.text.lstrip()
    if text[:1] in ("", "<", "{") or "\0" in text:
        return False
    lines = text.splitlines()
    is_crs = lines[0].lower().startswith("# coordinatesystem:")  # it may fill the head
    return is_crs or is_geo(lines) or has_header(lines)


def has_header(lines: list[str]) -> bool:
    """Whether a line names at least two of the columns that every table of cameras has."""
    names = tables.find_header(lines, SPELLINGS)[1]
    return len(POSITION & tables.places(names, SPELLINGS).keys()) >= 2


def read(source: Source) -> Cameras:
    """Read a table; see `pcfix.read_cameras`."""
    columns = measured = open_table(source.path)
    place = columns.place
    adjusted = {role[:-4]: i for role, i in place.items() if role.endswith("_est")}
    has_both = axes(adjusted) is not None
    if has_both:
        columns = replace(columns, place=adjusted | {"label": place["label"]})
    by_gnss = any(name in tables.EXIF for name in columns.header)  # measured, not adjusted
    by_gnss |= columns.has("sigma_x")
    lost = np.isnan(centres(columns)).any(axis=1) & (has_both or by_gnss)  # else it is a mistake
    if lost.all():
        raise checks.no_pose(source.path)
    unposed = columns.take(np.flatnonzero(lost)).labels
    rows = np.flatnonzero(~lost)
    columns, measured = columns.take(rows), measured.take(rows)
    turns = _rotations(columns, source.angles)
    system, unknown = crs(measured)
    if unknown:
        checks.warn(source.path, "cameras.crs_unknown", f"{unknown} The cloud's is assumed.")
    if by_gnss:
        sentence = "its positions are those of the GNSS, not adjusted ones."
        checks.warn(source.path, "cameras.not_adjusted", sentence)
    labels, xyz = tuple(columns.labels), columns.of(axes(columns.place) or ())
    lenses, sensor = list[Lens](), sensor_file(source)
    if turns is not None and sensor and columns.has(*REALITY_CAPTURE[:3]):
        frame, names = read_sensor(sensor), ("dx", "dy", "k1", "k2", "k3", "k4", "p1", "p2")
        given = [columns.of(REALITY_CAPTURE[:3]), columns.where_there(REALITY_CAPTURE[3:])]
        for focal, *others in np.nan_to_num(np.hstack(given)).tolist():
            values = dict(zip(names, others, strict=True)) | {"f": focal / FILM_MM}
            lenses.append(lens_by_name(values, frame.width, frame.height, relative=True))
    gnss = gnss_positions(measured) if has_both else None
    known = tuple(lenses) or None
    return Cameras(labels, xyz, turns, known, system, gnss=gnss, unposed=tuple(unposed))


# Fields of ODM's geo.txt, the last six optional; more may follow.
GEO = ("label", "x", "y", "z", "yaw", "pitch", "roll", "accuracy_horz", "accuracy_vert")


def open_table(path: Path) -> Table:
    """Read a table with a header, which may be a comment, or ODM's geo.txt, which has none."""
    lines = tables.read_lines(path)
    if is_geo(lines):
        split = [(i, line.split()) for i, line in enumerate(lines[1:], start=2) if line.strip()]
        rows = [[*fields, *[""] * len(GEO)][: len(GEO)] for _, fields in split]
        place = {name: GEO.index(name) for name in ("label", "x", "y", "z")}
        place |= {"sigma_x": 7, "sigma_y": 7, "sigma_z": 8}  # its angles may be 0 for unknown
        return Table(path, [*GEO], rows, [i for i, _ in split], place, crs=lines[0].strip())
    kinds = [("label", *three) for three in (*AXES, ("x_est", "y_est", "z_est"))]
    table = tables.read_table(path, *kinds, spellings=SPELLINGS)
    for role, spellings in SPELLINGS.items():  # a column with the role's own name counts
        alike = [name for name in table.header if name in spellings]
        if len(alike) > 1 and role not in MANY and (role not in alike or alike.count(role) > 1):
            sentence = f"the columns {', '.join(alike)} may all be {role}. Remove all but one."
            raise bad_file(path, "table.columns_alike", sentence, columns=alike)
    projection = path.with_suffix(".prj")
    if table.crs is None and projection.is_file():
        return replace(table, crs=" ".join(tables.read_lines(projection)).strip() or None)
    return table


def gnss_positions(columns: Table) -> GnssPositions | None:
    """Return the positions by GNSS, or None if there are only adjusted ones."""
    if axes(columns.place) is None:
        return None
    xyz = centres(columns)
    if columns.has("enable"):
        xyz[[text == "0" for text in columns.column("enable")]] = np.nan
    sigma = columns.where_there(("sigma_x", "sigma_y", "sigma_z"))
    return GnssPositions(xyz, sigma, crs(columns)[0])


def axes(place: Iterable[str]) -> tuple[str, str, str] | None:
    """Return the three columns of a position: x, y, z or longitude, latitude, z."""
    return next((three for three in AXES if {*three} <= {*place}), None)


def centres(columns: Table) -> FloatArray:
    """Return positions, shape (k, 3), NaN for rows without."""
    xyz = columns.where_there(axes(columns.place) or AXES[0])
    xyz[np.isnan(xyz).any(axis=1)] = np.nan
    return xyz


def crs(columns: Table) -> tuple[str | None, str]:
    """Return the CRS that a table states or implies, and a sentence if PROJ does not know it.

    Longitude and latitude without a CRS are those of WGS 84. Their heights are ellipsoidal only if
    the header calls them so; else the CRS has no heights.
    """
    if columns.crs is None:
        if axes(columns.place) != ("longitude", "latitude", "z"):
            return None, ""
        ellipsoidal = columns.name("z").startswith("ellipsoid")
        return "EPSG:4979" if ellipsoidal else "EPSG:4326", ""
    try:
        return checks.crs(columns.path, columns.crs), ""
    except InputError:
        return None, f"PROJ does not know its CRS '{shortened(columns.crs)}'."


def is_geo(lines: list[str]) -> bool:
    """Whether these lines are a CRS and then images, not control points."""
    if not re.fullmatch(r"(?i)(EPSG:\d+|\+proj=.+|WGS84 UTM \d\d?\s*[NS])\s*", [*lines, ""][0]):
        return False
    first = next((line.split() for line in lines[1:] if line.strip()), [])
    return len(first) >= 3 and np.isnan(tables.number(first[0]))


OMEGA_PHI_KAPPA, YAW_PITCH_ROLL = ("omega", "phi", "kappa"), ("yaw", "pitch", "roll")
CONVERSIONS = {
    "omega-phi-kappa": rotations.from_omega_phi_kappa,
    "yaw-pitch-roll": rotations.from_yaw_pitch_roll,
    "aircraft": rotations.from_aircraft,
}


def _rotations(columns: Table, angles: Angles | None) -> FloatArray | None:
    """Return world to camera rotations, or None if the table has none.

    `angles` is their kind if the user sets it. Otherwise the header decides, or the assumption that
    the cameras look down at the ground.
    """
    path, wanted = columns.path, tuple[str, ...]()
    if angles is not None:
        wanted = OMEGA_PHI_KAPPA if angles == "omega-phi-kappa" else YAW_PITCH_ROLL
    for kind in (OMEGA_PHI_KAPPA, YAW_PITCH_ROLL, QUATERNION, MATRIX):
        missing = [role for role in kind if not columns.has(role)]
        if len(missing) < len(kind) or kind == wanted:
            tables.check_columns(path, columns.header, kind, missing)
    if angles is not None:
        return CONVERSIONS[angles](*_degrees(columns, wanted))
    if columns.has(*OMEGA_PHI_KAPPA):
        reality_capture = columns.after_hash and columns.name("label") == "name"
        if columns.place["phi"] < columns.place["omega"] or reality_capture:
            sentence = "omega, phi, kappa may be turns in another order here. Export heading,"
            sentence += " pitch, roll, or give --angles omega-phi-kappa."
            raise bad_file(path, "cameras.angles", sentence)
        return rotations.from_omega_phi_kappa(*_degrees(columns, OMEGA_PHI_KAPPA))
    if columns.has(*QUATERNION):
        return checks.quaternions(path, columns.labels, columns.of(QUATERNION))
    if columns.has(*MATRIX):  # to axes either y up, z back or y down, z forward
        found = checks.rotations(path, columns.labels, columns.of(MATRIX))
        back_is_up = found[:, 2, 2] > 0.0
        if back_is_up.any() and not back_is_up.all():
            sentence = "r33 has both signs, so the axes are not clear. Give omega, phi, kappa."
            raise bad_file(path, "cameras.angles", sentence)
        return rotations.from_photogrammetric(found) if back_is_up.all() else found
    if not columns.has(*YAW_PITCH_ROLL):
        return None
    values = _degrees(columns, YAW_PITCH_ROLL)
    found, gimbal = rotations.from_yaw_pitch_roll(*values), rotations.from_aircraft(*values)
    if columns.name("yaw").startswith("gimbal"):
        return gimbal
    down, other = -found[:, 2, 2], -gimbal[:, 2, 2]  # cosines of the tilt from straight down
    reality_capture = columns.after_hash and columns.name("yaw") == "heading"
    # a camera that looks at the ground is tilted by at most 80 degrees
    is_likely = other.min() > 0.17 and np.median(other) > np.median(down)
    if is_likely and not reality_capture:
        sentence = "yaw, pitch, roll are likely those of a gimbal. Give --angles aircraft, or"
        sentence += " --angles yaw-pitch-roll."
        raise bad_file(path, "cameras.angles", sentence)
    return found


def _degrees(columns: Table, roles: tuple[str, ...]) -> FloatArray:
    """Return angles, shape (3, k), none of which is larger than a full turn."""
    values = columns.of(roles)
    for i, k in np.argwhere(np.abs(values) > 360.0)[:1].tolist():
        name, value = columns.name(roles[k]), float(values[i, k])
        sentence = f"{name} = {value:g} is no angle in degrees. Name its unit, as in {name}[gon] or"
        sentence += f" {name}[rad], or check the columns."
        raise columns.error(i, "cameras.angle_range", sentence, column=name, value=value)
    return values.T


# ---- sensors ----


MILLIMETRES = ("focal", "sensor_x", "sensor_y")
PIXELS = ("focal_px", "width_px", "height_px")
OPENCV = LensModel("f cx cy k1 k2 k3 d1 d2 d3 p2 p1")
# What OpenCV calls the parameters of `OPENCV` after the focal length.
TERMS = ("cx", "cy", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
FILM_MM = 36.0  # larger side of the film that 35 mm focal lengths mean


def sensor_file(source: Source) -> Path | None:
    """Return the file with the lens of all images: that of the user, or ``sensor.csv``."""
    folder = source.path if source.path.is_dir() else source.path.parent
    default = folder / "sensor.csv"
    return source.sensor or (default if default.is_file() else None)


def read_sensor(path: Path) -> Lens:
    """Read the lens of all images: a calibration of Metashape (XML), or a table of one row.

    Its columns are focal, sensor_x, sensor_y in mm, with the principal point in the centre; or
    focal_px, width_px, height_px and, if known, OpenCV's cx, cy (pixels from the upper left corner
    of the image), k1 ... k6, p1, p2.
    """
    if Source(path).text.lstrip().startswith("<"):
        from pcfix.io.cameras.metashape import read_calibration

        return checks.lens(path, path.stem, read_calibration(path))
    spellings = {name: (name,) for name in (*MILLIMETRES, *PIXELS, *TERMS)}
    table = tables.read_table(path, MILLIMETRES, PIXELS, spellings=spellings)
    if len(table.rows) != 1:
        sentence = f"has {len(table.rows)} rows. Give one row for all images."
        raise bad_file(path, "cameras.sensor_rows", sentence, rows=len(table.rows))
    is_px = table.has(*PIXELS)
    focal, width, height = table.of(PIXELS if is_px else MILLIMETRES)[0].tolist()
    terms = table.where_there(TERMS)[0].tolist() if is_px else []
    given = zip(OPENCV.names.split(), [focal, *terms], strict=False)
    stated = {name: value for name, value in given if not math.isnan(value)}
    lens = lens_by_name(stated, width, height, unit="px" if is_px else "mm")
    checks.lens(path, path.stem, lens)
    if not all(0.25 < at < 0.75 for at in (lens.principal_x / width, lens.principal_y / height)):
        sentence = "cx, cy is far from the centre. Give pixels from the upper left corner."
        raise bad_file(path, "cameras.principal_point", sentence)
    return lens


def write_table(folder: File, cameras: Cameras) -> None:
    """Write ``cameras.csv`` and ``sensor.csv`` into a folder, which need not exist."""
    target = Path(folder)
    turns, lenses = checks.block_to_write(target, cameras)
    if cameras.crs is not None and is_topocentric(cameras.crs):
        sentence = f"a table cannot have the axes {cameras.crs}. Use a projected CRS."
        raise bad_file(target, "output.crs", sentence, crs=cameras.crs)
    given, *others = dict.fromkeys(lenses)
    if others:
        sentence = f"a table has one lens, but the images have {1 + len(others)}. Use another"
        raise bad_file(target, "output.lens", f"{sentence} format.")
    is_px = given.unit == "px"
    _, values = model_of(target, given, {"": OPENCV if is_px else LensModel("f")})
    focal, *terms = map(float, values.values())
    header = (*PIXELS, *TERMS) if is_px else MILLIMETRES
    sensor = focal, float(given.width), float(given.height), *terms
    poses = np.column_stack([cameras.centres, turns]).tolist()
    has_crs = cameras.crs is not None and cameras.crs.strip().lower() != "local"
    comment = f"# CoordinateSystem: {' '.join((cameras.crs or '').split())}\n" if has_crs else ""
    names = ("label", "x", "y", "z", *QUATERNION)
    rows = [[label, *row] for label, row in zip(cameras.labels, poses, strict=True)]
    contents = {
        "cameras.csv": comment.encode() + _csv(names, *rows),
        "sensor.csv": _csv(header, sensor),
    }
    checks.write_new(target, contents)


def _csv(*rows: Iterable[object]) -> bytes:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue().encode()
