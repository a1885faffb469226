"""Camera poses, whatever wrote them: one module per format behind one `read_cameras`.

A format module has two functions: ``recognises(path, head)`` looks at the first bytes, and
``read(path, sensor)`` returns `Cameras`. To add a format, write its module and name it in
`FORMATS`; nothing else changes.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.cameras import table
from pcfix.io.files import check_input

if TYPE_CHECKING:
    import os

    from pcfix.model import Cameras

FORMATS = (table,)
_HEAD_BYTES = 4096


def read_cameras(
    path: str | os.PathLike[str], sensor: str | os.PathLike[str] | None = None
) -> Cameras:
    """Read the exterior (and interior) orientation of a block of images.

    Parameters
    ----------
    path : path
        A CSV table with a header line. Columns, in any order, upper or lower case:

        ``label, x, y, z``
            Projection centres, metres, in the cloud's own CRS. Every camera is then a candidate
            for every point.
        ``label, x, y, z, yaw, pitch, roll``
            and the angles in degrees: yaw clockwise from north, pitch 0 straight down and
            positive when the view lifts towards the yaw direction, roll positive when the right
            side goes down (the reference angles of Metashape, the table of pyBathySfM). Needs
            the sensor.
    sensor : path, optional
        A CSV table ``focal, sensor_x, sensor_y`` in millimetres, one row, for all images.
        Default: a ``sensor.csv`` beside the cameras.

    Returns
    -------
    Cameras
        World to camera rotations in OpenCV axes.

    Warns
    -----
    PcfixWarning
        When labels repeat: different positions are kept, exact copies dropped.

    Raises
    ------
    InputError
        If a file is missing, or a row or column is not what it should be; the message names it.

    Examples
    --------
    >>> import pcfix
    >>> cameras = pcfix.read_cameras("samples/scene/cameras.csv")
    >>> cameras.centres.shape
    (40, 3)
    """
    source = check_input(path)
    sensor_file = None if sensor is None else check_input(sensor)
    with source.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    for candidate in FORMATS:
        if candidate.recognises(source, head):
            cameras: Cameras = candidate.read(source, sensor_file)
            for note in cameras.notes:
                warnings.warn(note, PcfixWarning, stacklevel=2)
            return cameras
    raise InputError(
        f"{source}: is not a camera file that pcfix knows; give a CSV table with the columns"
        " label, x, y, z and, if you have them, yaw, pitch, roll."
    )
