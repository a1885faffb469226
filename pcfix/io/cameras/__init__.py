"""Read camera poses of any software: one module per format behind one `read_cameras`.

A format module has patterns by which `checks.recognises` knows its files, or ``recognises(source)``
of its own, then ``read(source)`` and, if the format has tie points, ``tie_points(source,
cameras)``. `read_cameras` turns what damaged contents raise into an `InputError`, checks rotations
and lenses, and collects warnings (`checks.warn`). A module raises an `InputError` itself if its
sentence is clearer. README.md of this folder says how to add a format.
"""

from __future__ import annotations

import warnings
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import PcfixWarning, SettingError, bad_file
from pcfix.io.cameras import checks, unsupported
from pcfix.io.cameras.checks import Angles, Source, reading
from pcfix.io.cameras.table import read_sensor, sensor_file
from pcfix.io.files import check_input
from pcfix.model import Cameras, TiePoints
from pcfix.options.declare import File

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
"""The modules of this folder and their software, in the order in which they are asked."""
TAKE_SENSOR = ("table", "realitycapture")
"""Modules that look for the sensor themselves."""


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
    try:
        with reading(path), warnings.catch_warnings(record=True) as shown:
            warnings.simplefilter("always")
            cameras: Cameras = reader_of(form).read(source)
            sensor_path = sensor_file(source)
            if cameras.rotations is not None and cameras.lenses is None and sensor_path:
                lenses = (read_sensor(sensor_path),) * len(cameras)
                cameras = replace(cameras, lenses=lenses)
            elif cameras.rotations is None or form not in TAKE_SENSOR:
                if source.sensor is not None and len(cameras):
                    why = "no angles" if cameras.rotations is None else "its own lenses"
                    sentence = f"has {why}, so --sensor {sensor} has no effect. Omit it."
                    raise bad_file(source.path, "cameras.sensor_unused", sentence, sensor=sensor)
            elif cameras.lenses is None and form == "table":
                raise checks.no_sensor(source.path)
            cameras = checks.checked(source.path, cameras)
    except SettingError as error:  # numbers that are finite in the file and not in the world
        raise checks.damaged(path, str(error).rstrip(".")) from error
    if not len(cameras):
        raise checks.no_pose(source.path)
    for one in shown:
        warnings.warn(one.message, one.category, stacklevel=2)
    notes = [one.message for one in shown if isinstance(one.message, PcfixWarning)]
    return replace(cameras, notes=tuple(notes), source=FORMATS[form])


def read_tie_points(path: File, cameras: Cameras) -> TiePoints:
    """Read the tie points of a sparse model, in the frame of the file.

    Parameters
    ----------
    path : path
        The file or folder that `cameras` was read from.
    cameras : Cameras
        As `read_cameras` gave them.

    Returns
    -------
    TiePoints
        Without observations that are not finite; such a position is unknown (NaN).
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
    source = Source(
        where if where.is_dir() else check_input(where),
        None if sensor is None else check_input(sensor),
        angles,
    )
    if form := _format_of(source):
        return source, form
    for file in sorted(filter(Path.is_file, where.glob("*"))):
        if form := _format_of(Source(file)):
            sentence = f"is a folder with a camera file ({FORMATS[form]}). Give {file}."
            raise bad_file(where, "cameras.folder", sentence, file=file.name)
    unsupported.refuse(source)
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
    """Return the first format that recognises the content."""
    for form in () if unsupported.is_part(source.path) else FORMATS:
        with suppress(Exception), np.errstate(all="ignore"):
            if checks.recognises(reader_of(form), source):
                return form
    return None
