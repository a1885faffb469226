"""The plain CSV table: label, x, y, z, with or without yaw, pitch, roll."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.errors import InputError
from pcfix.io.files import check_input
from pcfix.io.tables import read_table, split_header
from pcfix.model import Cameras, FloatArray, Lens

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.formats import Source
    from pcfix.io.tables import Table

SOFTWARE = "CSV table"
POSITION = ("label", "x", "y", "z")
ANGLES = ("yaw", "pitch", "roll")
SENSOR = ("focal", "sensor_x", "sensor_y")
UP_BACK_TO_DOWN_FORWARD = np.diag([1.0, -1.0, -1.0])


def recognises(source: Source) -> bool:
    """Whether the first line is a header with at least two of the four needed names."""
    line = source.text.partition("\n")[0]
    return len(set(POSITION) & set(split_header(line.strip())[0])) >= 2


def read(source: Source) -> Cameras:
    """Read the table; see `pcfix.read_cameras`."""
    path = source.path
    table = read_table(path, POSITION)
    labels = table.column("label")
    centres = np.column_stack([table.numbers(axis) for axis in "xyz"])
    rotations, lens = _orientation(table, source.sensor)
    keep, notes = _without_copies(path, labels, centres)
    return Cameras(
        labels=tuple(labels[i] for i in keep),
        centres=centres[keep],
        rotations=None if rotations is None else rotations[keep],
        lenses=None if lens is None else (lens,) * len(keep),
        notes=notes,
    )


def _orientation(table: Table, sensor: Path | None) -> tuple[FloatArray | None, Lens | None]:
    """Return rotations and lens, or neither where the table has no angles."""
    there = [name for name in ANGLES if name in table.header]
    if not there:
        if sensor is not None:
            raise InputError(
                f"{table.path}: has no yaw, pitch and roll, so the sensor {sensor} says nothing;"
                " add the angles or leave the sensor out."
            )
        return None, None
    if len(there) < len(ANGLES):
        missing = ", ".join(name for name in ANGLES if name not in there)
        raise InputError(f"{table.path}: line 1 has {', '.join(there)} but lacks {missing}.")
    beside = table.path.with_name("sensor.csv")
    if sensor is None and not beside.is_file():
        raise InputError(
            f"{table.path}: has yaw, pitch and roll, but there is no sensor: give --sensor, put"
            " sensor.csv (focal,sensor_x,sensor_y in mm) beside it, or leave the angles out."
        )
    lens = read_sensor(sensor or beside)
    return rotations_from_yaw_pitch_roll(*(np.array(table.numbers(a)) for a in ANGLES)), lens


def read_sensor(path: Path) -> Lens:
    """Read focal, sensor_x, sensor_y (mm); the principal point is taken as the centre."""
    table = read_table(check_input(path), SENSOR)
    focal, width, height = (table.numbers(name)[0] for name in SENSOR)
    if len(table.rows) != 1 or min(focal, width, height) <= 0.0:
        raise InputError(
            f"{path}: give one row of positive focal, sensor_x and sensor_y in mm, not"
            f" {len(table.rows)} row(s) beginning {focal:g}, {width:g}, {height:g}."
        )
    return Lens(focal, width, height, width / 2.0, height / 2.0)


def rotations_from_yaw_pitch_roll(
    yaw_deg: FloatArray, pitch_deg: FloatArray, roll_deg: FloatArray
) -> FloatArray:
    """Return world to camera rotations, OpenCV axes, shape (k, 3, 3).

    With all angles zero the camera looks straight down and the top of the image is north.
    Camera axes x right, y up, z back go to the world by Rz(-yaw) Rx(pitch) Ry(roll).
    """
    angles = np.radians(np.column_stack([-yaw_deg, pitch_deg, roll_deg]))
    to_world = Rotation.from_euler("ZXY", angles).as_matrix()
    return np.asarray(UP_BACK_TO_DOWN_FORWARD @ to_world.transpose(0, 2, 1))


def _without_copies(
    path: Path, labels: list[str], centres: FloatArray
) -> tuple[list[int], tuple[str, ...]]:
    """Return the rows to keep and what to tell: labels are no key, but a copy counts once."""
    seen: set[tuple[str, bytes]] = set()
    keep = []
    for i, label in enumerate(labels):
        key = (label, centres[i].tobytes())
        if key not in seen:
            seen.add(key)
            keep.append(i)
    repeated = [label for label, count in Counter(labels).items() if count > 1]
    if not repeated:
        return keep, ()
    copies = len(labels) - len(keep)
    note = (
        f"{path}: {len(repeated)} labels occur more than once ({', '.join(repeated[:10])}"
        f"{', ...' if len(repeated) > 10 else ''}); cameras at different positions are kept"
        f" as different images, {copies} exact copies dropped."
    )
    return keep, (note,)
