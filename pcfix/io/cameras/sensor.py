"""Read the sensor of tables, and write a block as a table with its sensor next to it.

A block is written as ``cameras.csv`` (label, x, y, z, qw, qx, qy, qz: projection centre and
rotation from the world to the camera, x right, y down, z forward, after a comment with the CRS) and
``sensor.csv`` (the one lens of all images, in pixels with OpenCV's names or, of an undistorted lens
in mm, as focal, sensor_x, sensor_y).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import write_new
from pcfix.io.cameras.lenses import LensModel, lens_by_name, model_of
from pcfix.io.crs import is_topocentric
from pcfix.io.tables import read_table
from pcfix.model import Cameras, Lens
from pcfix.options.declare import File

MILLIMETRES = ("focal", "sensor_x", "sensor_y")
PIXELS = ("focal_px", "width_px", "height_px")
NAMES = {"d1": "k4", "d2": "k5", "d3": "k6", "p2": "p1", "p1": "p2"}
"""What OpenCV calls the parameters that have another name in `lenses`."""
OPENCV = {"OpenCV": LensModel("f cx cy k1 k2 k3 d1 d2 d3 p2 p1")}
TERMS = OPENCV["OpenCV"].names.split()[1:]
CENTRED = {"centred": LensModel("f")}
DISTORTION = ("k1", "k2", "k3", "k4", "t1", "t2")
FILM_MM = 36.0
"""Larger side of the film that 35 mm focal lengths mean."""


def sensor_file(source: checks.Source) -> Path | None:
    """Return the file with the lens of all images: that of the user, or ``sensor.csv``."""
    folder = source.path if source.path.is_dir() else source.path.parent
    default = folder / "sensor.csv"
    return source.sensor or (default if default.is_file() else None)


def read_sensor(path: Path) -> Lens:
    """Read the lens of all images.

    Parameters
    ----------
    path : Path
        A calibration of Metashape (XML), or a table of one row. Its columns are focal, sensor_x,
        sensor_y in mm, with the principal point in the centre; or focal_px, width_px, height_px
        and, if known, OpenCV's cx, cy (pixels from the upper left corner of the image),
        k1 ... k6, p1, p2.
    """
    if checks.Source(path).text.lstrip().startswith("<"):
        from pcfix.io.cameras.metashape import read_calibration

        return checks.lens(path, path.stem, read_calibration(path))
    names = (*MILLIMETRES, *PIXELS, *(NAMES.get(one, one) for one in TERMS))
    table = read_table(path, MILLIMETRES, PIXELS, spellings={name: (name,) for name in names})
    if len(table.rows) != 1:
        sentence = f"has {len(table.rows)} rows. Give one row for all images."
        raise bad_file(path, "cameras.sensor_rows", sentence, rows=len(table.rows))
    is_px = table.has(*PIXELS)
    (focal, width, height), given = table.of(PIXELS if is_px else MILLIMETRES)[0].tolist(), {}
    if is_px:
        values = table.where_there(NAMES.get(one, one) for one in TERMS)[0].tolist()
        given = {one: v for one, v in zip(TERMS, values, strict=True) if not math.isnan(v)}
    lens = lens_by_name({"f": focal} | given, width, height, unit="px" if is_px else "mm")
    checks.lens(path, path.stem, lens)
    if not all(0.25 < at < 0.75 for at in (lens.principal_x / width, lens.principal_y / height)):
        sentence = "cx, cy is far from the centre. Give pixels from the upper left corner."
        raise bad_file(path, "cameras.principal_point", sentence)
    return lens


POSE = ("label", "x", "y", "z", "qw", "qx", "qy", "qz")


def write_table(folder: File, cameras: Cameras) -> None:
    """Write ``cameras.csv`` and ``sensor.csv``.

    Parameters
    ----------
    folder : path
        Created if it does not exist.
    cameras : Cameras
        With rotations and lenses.
    """
    from scipy.spatial.transform import Rotation

    target = Path(folder)
    rotations, lenses = checks.block_to_write(target, cameras)
    if cameras.crs is not None and is_topocentric(cameras.crs):
        sentence = f"a table cannot hold the axes {cameras.crs}. Use a projected CRS."
        raise bad_file(target, "output.crs", sentence, crs=cameras.crs)
    given, *others = dict.fromkeys(lenses)
    if others:
        sentence = f"a table holds one lens, but the images have {1 + len(others)}. Use another"
        raise bad_file(target, "output.lens", f"{sentence} format.")
    is_px = given.unit == "px"
    _, values = model_of(target, given, OPENCV if is_px else CENTRED)
    frame = (values.pop("f"), given.width, given.height)
    sensor = dict(zip(PIXELS if is_px else MILLIMETRES, map(float, frame), strict=True))
    sensor |= {NAMES.get(name, name): float(value) for name, value in values.items()}
    turns = Rotation.from_matrix(rotations).as_quat(canonical=True)
    poses = np.column_stack([cameras.centres, np.roll(turns, 1, axis=1)]).tolist()
    has_crs = cameras.crs is not None and cameras.crs.strip().lower() != "local"
    comment = f"# CoordinateSystem: {' '.join((cameras.crs or '').split())}\n" if has_crs else ""
    rows = [[label, *row] for label, row in zip(cameras.labels, poses, strict=True)]
    contents = {
        "cameras.csv": comment.encode() + _csv(POSE, *rows),
        "sensor.csv": _csv(sensor, sensor.values()),
    }
    write_new(target, contents)


def _csv(*rows: Iterable[object]) -> bytes:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue().encode()
