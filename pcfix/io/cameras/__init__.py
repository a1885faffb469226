"""Read camera poses of any software: one module per format behind one `read_cameras`.

A format module has patterns by which `checks.recognises` knows its files, or ``recognises(source)``
of its own, then ``read(source)`` and, if the format has tie points, ``tie_points(source,
cameras)``. `read_cameras` turns what damaged contents raise into an `InputError`, checks rotations
and lenses, and collects warnings (`checks.warn`). A module raises an `InputError` itself if its
sentence is clearer. README.md of this folder says how to add a format.
"""

import re
import warnings
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import InputError, PcfixWarning, bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Angles, Source, reading
from pcfix.io.cameras.table import read_sensor, sensor_file
from pcfix.io.files import check_input
from pcfix.model import Cameras, TiePoints
from pcfix.options.declare import File

# The modules of this folder and their software, in the order in which they are asked.
FORMATS = {
    "metashape": "Agisoft Metashape, PhotoScan",
    "pix4d": "Pix4D",
    "opf": "OPF: PIX4Dmatic, PIX4Dcatch",
    "odm": "OpenDroneMap, OpenSfM",
    "colmap": "COLMAP",
    "micmac": "MicMac",
    "bundler": "Bundler, MVE, VisualSFM",
    "blocksexchange": "ContextCapture, iTwin Capture, DJI Terra",
    "realitycapture": "RealityCapture (XMP)",
    "table": "CSV table",
}
TAKE_SENSOR = ("table", "realitycapture")  # modules that look for the sensor themselves

POSES = "Give the file or folder with the camera poses"
OPK = "Write a table with the header label,x,y,z,omega,phi,kappa and give its lens by --sensor"
COLMAP = "Export a COLMAP model (cameras, images, points3D)"
GCPS = "a list of ground control points (ODM)", POSES
BARE = "a table without a header", "Write one, for example label,x,y,z,omega,phi,kappa"
MICMAC = "a calibration of MicMac", "Give the folder with its orientations"
NERF = "a scene of nerfstudio or instant-ngp", "Give the model from which it was converted"
PIX4D_PART = ["a part of the parameters of Pix4D", "Give calibrated_camera_parameters.txt"]
# Known files that are not read: patterns of the first bytes, what the file is, and what to do.
REFUSED: tuple[tuple[bytes, str, str], ...] = (
    (rb"\A(\xff\xd8\xff|II[*+]\0|MM\0[*+]|\x89PNG)", "an image", POSES),
    (rb"\ALASF", "a point cloud (LAS, LAZ)", POSES),
    (rb"\Aply\r?\n", "a point cloud or mesh (PLY)", POSES),
    (rb"\A(SQLite format 3\0|\0\0\x27\x0a)", "a vector file", POSES),
    (rb"\A(\x1f\x8b|PK[\x03\x05])", "an archive", POSES),
    (rb"\AMVS[I\0]", "a scene of OpenMVS", COLMAP),
    (rb"<!DOCTYPE Pix4D", "a project of Pix4D", "Give its folder 1_initial/params"),
    (rb"<Reality(Capture|Scan)", "a project of RealityCapture", "Export XMP files"),
    (rb"<kml[\s>]", "a map of Google Earth (KML)", POSES),
    (rb"\A(EPSG:|\+proj=|WGS84 UTM )[^\n]*\n\s*([-+.\d]+[ \t]+){2}", *GCPS),
    (rb"\A(\xef\xbb\xbf)?focal", "a table of the sensor", "Give it by --sensor"),
    (rb"\A\s*\$PROJECT\b|^\s*\$(PHOTO_NUM|EXT_ORI)\b", "a project of Inpho (Trimble)", OPK),
    (rb"^\s*(SENSOR_TYPE|TRIANGULATION_TYPE)\s", "a support file of SOCET SET", OPK),
    (rb"^\s*(ORI[AE]|PRO[JI]|GEOI|BILD)\s+\S+\s+\S", "a file of BINGO", OPK),
    (rb"<(CalibrationInternConique|InternalCalibration)>", *MICMAC),
    (rb'"projection_type"', "a list of lenses without poses (ODM)", "Give reconstruction.json"),
    (rb'"sfm_data_version"', "a scene of OpenMVG", COLMAP),
    (rb'"viewId"|"featuresFolders"|"pipelineVersion"', "a scene of AliceVision (Meshroom)", COLMAP),
    (rb'"transform_matrix"|"camera_angle_x"|"fl_x"', *NERF),
    # numbers, after one name at most
    (rb"\A\s*([^\s,;]+[,;\s]+)?[-+.\d]+([,; \t]+[-+.\d]+)+\s*$", *BARE),
)
# Files of Pix4D's parameters without poses, of which standard errors look like poses.
PART = re.compile(
    r"(?i)(.*_)?(calibrated_images_position\.txt|pmatrix\.txt|offset\.xyz"
    r"|internal_camera_parameters\.cam|camera_parameters(_wgs84)?_error\.txt)"
)


def read_cameras(
    path: File, sensor: File | None = None, *, angles: Angles | None = None
) -> Cameras:
    """Read the exterior (and interior) orientation of a block of images.

    Parameters
    ----------
    path : path
        A file or folder of photogrammetry software, recognised by its content, see the README
        of this folder. Or a table with the columns ``label, x, y, z`` (projection centres) and
        ``omega, phi, kappa``; ``yaw, pitch, roll``; ``qw, qx, qy, qz``; or ``r11 ... r33``:
        angles in degrees, or the rotation from world to camera, see `pcfix.io.cameras.table`.
    sensor : path, optional
        For tables, and files of poses without lenses: a CSV table of one row for all images,
        ``focal, sensor_x, sensor_y`` in millimetres or ``focal_px, width_px, height_px, ...``, or a
        calibration of Metashape. Default: a ``sensor.csv`` next to the cameras.
    angles : {"omega-phi-kappa", "yaw-pitch-roll", "aircraft"}, optional
        The kind of angles in a table whose header does not name it. For the angles of an aircraft
        or a gimbal, pitch -90 looks straight down.

    Returns
    -------
    Cameras
        World to camera rotations in OpenCV axes, all in the frame of the file:
        `pcfix.io.cameras.georeference.georeference` transforms them to the cloud's CRS.

    Raises
    ------
    InputError
        If a file is missing or damaged, is not a camera file, or has its own lenses and a
        `sensor`.

    Examples
    --------
    >>> import pcfix
    >>> cameras = pcfix.read_cameras("samples/scene/cameras.csv")
    >>> cameras.centres.shape
    (40, 3)
    """
    source, form = _recognised(path, sensor, angles)
    with reading(path), warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        cameras: Cameras = reader_of(form).read(source)
        if not len(cameras):
            raise checks.no_pose(source.path)
        has_angles, sensor_path = cameras.rotations is not None, sensor_file(source)
        if has_angles and cameras.lenses is None and sensor_path:
            cameras = replace(cameras, lenses=(read_sensor(sensor_path),) * len(cameras))
        elif has_angles and cameras.lenses is None and form == "table":
            sentence = "has angles but no sensor. Give --sensor a table with"
            sentence += " focal,sensor_x,sensor_y (mm)."
            raise bad_file(source.path, "cameras.sensor_missing", sentence)
        elif sensor is not None and not (has_angles and form in TAKE_SENSOR):
            why = "its own lenses" if has_angles else "no angles"
            sentence = f"has {why}, so --sensor {sensor} has no effect. Omit it."
            raise bad_file(source.path, "cameras.sensor_unused", sentence, sensor=sensor)
        cameras = checks.checked(source.path, cameras)
    for one in shown:
        warnings.warn(one.message, one.category, stacklevel=2)
    notes = [one.message for one in shown if isinstance(one.message, PcfixWarning)]
    return replace(cameras, notes=tuple(notes), source=FORMATS[form])


def read_tie_points(path: File, cameras: Cameras) -> TiePoints:
    """Read the tie points of the file or folder that `cameras` was read from, in its frame.

    Observations that are not finite are skipped. A position that is not finite is unknown (NaN).
    """
    source, form = _recognised(path, None, None)
    if not hasattr(reader_of(form), "tie_points"):
        raise checks.no_tie_points(source.path, f"the format ({FORMATS[form]}) has none")
    with reading(path), warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)  # shown when the cameras were read
        ties: TiePoints = reader_of(form).tie_points(source, cameras)
    if not len(ties.views.camera):
        raise checks.no_tie_points(source.path, "no point is visible in its images")
    return ties


def _recognised(path: File, sensor: File | None, angles: Angles | None) -> tuple[Source, str]:
    """Return the input and the module that reads it."""
    where = Path(path)
    is_folder = where.is_dir()
    own_sensor = None if sensor is None else check_input(sensor)
    source = Source(where if is_folder else check_input(where), own_sensor, angles)
    if form := _format_of(source):
        return source, form
    files = sorted(filter(Path.is_file, where.iterdir())) if is_folder else [where]
    for file in files:
        if form := _format_of(Source(file)):
            sentence = f"is a folder with a camera file ({FORMATS[form]}). Give {file}."
            raise bad_file(where, "cameras.folder", sentence, file=file.name)
    for file in files:
        head, found = b"", [PIX4D_PART] if PART.fullmatch(file.name) else []
        with suppress(InputError):  # in a folder
            head = Source(file).head
        found += [of for pattern, *of in REFUSED if re.search(pattern, head, re.MULTILINE)]
        if found:
            what, remedy = found[0]
            sentence = f"has {file.name}, {what}" if is_folder else f"is {what}"
            sentence += f", which pcfix does not read as cameras. {remedy}."
            raise bad_file(where, "cameras.not_read", sentence, what=what)
    sentence = "is not a camera file that pcfix knows. Give a file that pcfix/io/cameras/README.md"
    sentence += " lists, or a CSV table with label, x, y, z and, if known, yaw, pitch, roll."
    raise bad_file(where, "cameras.unknown", sentence)


def takes_sensor(path: File) -> bool:
    """Whether the format of a file keeps the lens in a file of its own."""
    return _recognised(path, None, None)[1] in TAKE_SENSOR


def reader_of(form: str) -> Any:
    """Return the module of a format."""
    return import_module(f"{__name__}.{form}")


def _format_of(source: Source) -> str | None:
    """Return the first format that recognises the content; none for a part of an export."""
    if PART.fullmatch(source.path.name) and source.path.is_file():
        return None
    for form in FORMATS:
        with suppress(Exception), np.errstate(all="ignore"):
            if checks.recognises(reader_of(form), source):
                return form
    return None
